// The card of one stream.
import { about, gravity } from "./flags.js";
import { count, degrees, element, facts, fixed, put, short } from "./format.js";
import { Picture } from "./picture.js";
import { Plots } from "./plots.js";

const SOURCES = {
  network: "network",
  refined: "network, refined by events",
  gyro: "network, turning from the gyroscope",
};

function bigNumber(name, kind, unit) {
  const root = element("div", kind);
  const value = element("div", "value");
  const number = element("span", "", "–");
  value.append(number, element("span", "unit", unit));
  const sigma = element("div", "sigma");
  root.append(element("div", "name", name), value, sigma);
  return { root, number, sigma };
}

export class StreamCard {
  constructor(name, historyS) {
    this.root = element("article", "card stream");
    this.root.id = `stream-${name}`;
    this.root.tabIndex = -1;
    const head = element("div", "head");
    this.verdict = element("span", "verdict");
    this.why = element("span", "why");
    head.append(element("h2", "", name), this.verdict, this.why);
    const body = element("div", "body");
    const left = element("div", "left");
    this.speed = bigNumber("Speed", "linear", "m/s");
    this.turn = bigNumber("Turning", "angular", "deg/s");
    const big = element("div", "big");
    big.append(this.speed.root, this.turn.root);
    this.picture = new Picture(name);
    this.facts = element("dl", "facts");
    this.flags = element("ul", "flags");
    this.flags.setAttribute("aria-label", "Flags now");
    left.append(big, this.picture.root, this.facts, this.flags);
    this.plots = new Plots(historyS);
    body.append(left, this.plots.root);
    this.root.append(head, body);
    this.seen = true;
    this.observer = new IntersectionObserver(([entry]) => { this.seen = entry.isIntersecting; });
    this.observer.observe(this.root);
  }

  show(stream, now) {
    const stale = stream.level === "bad" && stream.verdict !== "unstable" || stream.level === "idle";
    this.root.className = `card stream level-${stream.level}${stale ? " stale" : ""}`;
    put(this.verdict, stream.verdict);
    put(this.why, stream.why);
    const old = stale && stream.age_s !== null ? `${stream.age_s.toFixed(0)} s old` : "";
    this.number(this.speed, stream.speed, 2, "m/s", old);
    this.number(this.turn, stream.turn?.map(degrees), 1, "deg/s", old);
    const lost = Object.entries(stream.lost ?? {}).map(([cause, n]) => `${cause.replaceAll("_", " ")} ${count(n)}`);
    const latency = stream.latency_ms;
    facts(this.facts, [
      ["rate", `${fixed(stream.rate_hz, 1)} estimates/s`],
      ["latency", latency ? `p50 ${fixed(latency[0], 1)} ms, p99 ${fixed(latency[1], 1)} ms` : undefined],
      ["lost", stream.lost ? lost.join(", ") || "nothing" : undefined],
      ["source", SOURCES[stream.source] ?? stream.source],
      ["events", stream.events_s === undefined ? undefined : `${short(stream.events_s)} per second`],
      ["sensor", stream.sensor?.[0] ? `${stream.sensor[0]} × ${stream.sensor[1]} px` : undefined],
      ["model", stream.model ? `${stream.model} on ${stream.node}` : undefined],
      ["refused", stream.refusal],
    ]);
    this.showFlags(stale ? [] : stream.flags ?? []);
    this.plots.push(stream.points);
    if (this.seen && !document.hidden) this.plots.draw(now);
  }

  number(target, pair, digits, unit, old) {
    put(target.number, fixed(pair?.[0], digits));
    const sigma = pair?.[1];
    const band = sigma === null || sigma === undefined ? "no uncertainty" : `± ${fixed(2 * sigma, digits)} ${unit}`;
    put(target.sigma, old || (pair ? band : "no estimate yet"));
  }

  showFlags(flags) {
    while (this.flags.children.length > flags.length) this.flags.lastChild.remove();
    flags.forEach((flag, i) => {
      if (!this.flags.children[i]) {
        const item = element("li");
        item.append(element("b"), element("span"));
        this.flags.append(item);
      }
      const item = this.flags.children[i];
      item.className = gravity(flag);
      put(item.children[0], flag);
      put(item.children[1], about(flag));
    });
  }

  close() {
    this.picture.close();
    this.observer.disconnect();
    this.root.remove();
  }
}
