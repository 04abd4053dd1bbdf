// Numbers and elements. Every text goes through textContent, so nothing from the network becomes markup.

export function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

export function put(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

export function fixed(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−");
}

export function signed(value, digits) {
  const text = fixed(value, digits);
  return value > 0 && Number(value.toFixed(digits)) !== 0 ? `+${text}` : text.replace(/^−(0(\.0+)?)$/, "$1");
}

export const degrees = (radians) => (radians === null || radians === undefined ? null : (radians * 180) / Math.PI);

export const count = (value) => value.toLocaleString("en-US");

export function short(value) {
  if (value >= 1e6) return `${(value / 1e6).toFixed(2)} M`;
  return value >= 1e3 ? `${(value / 1e3).toFixed(value >= 1e5 ? 0 : 1)} k` : String(value);
}

export function duration(seconds) {
  const s = Math.floor(seconds);
  if (s < 120) return `${s} s`;
  if (s < 7200) return `${Math.floor(s / 60)} min`;
  if (s < 172800) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

export const clock = (unixSeconds) => new Date(unixSeconds * 1000).toLocaleTimeString("en-GB");

export function facts(list, pairs) {
  const wanted = pairs.filter((pair) => pair[1] !== undefined && pair[1] !== "");
  while (list.children.length > 2 * wanted.length) list.lastChild.remove();
  wanted.forEach(([name, value], i) => {
    if (!list.children[2 * i]) list.append(element("dt"), element("dd"));
    put(list.children[2 * i], name);
    put(list.children[2 * i + 1], value);
  });
}
