// Tokens and changes: each is a POST of this origin; the cookie that proves a token is not visible to scripts.

const byId = (id) => document.getElementById(id);

export async function post(path, body) {
  try {
    const answer = await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
    const text = await answer.text();
    try {
      return { ok: answer.ok, ...JSON.parse(text) };
    } catch {
      return { ok: false, error: text.slice(0, 200) };
    }
  } catch {
    return { ok: false, error: "the page does not reach its server" };
  }
}

export async function redeemFragment() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return null;
  history.replaceState(null, "", location.pathname);
  const { ok } = await post("/session", { token });
  return ok;
}

export function askToken(about, done) {
  const dialog = byId("token-dialog");
  if (dialog.open) return;
  byId("token-about").textContent = about;
  byId("token-error").textContent = "";
  byId("token").value = "";
  byId("token-cancel").onclick = () => dialog.close();
  byId("token-ok").onclick = async (event) => {
    event.preventDefault();
    const given = byId("token").value.trim();
    const token = new URLSearchParams(given.split("#")[1] ?? "").get("token") ?? given;
    const { ok, error } = await post("/session", { token });
    if (!ok) {
      byId("token-error").textContent = error;
      return;
    }
    dialog.close();
    done();
  };
  dialog.showModal();
}

export function confirmed(title, about) {
  const dialog = byId("confirm");
  byId("confirm-title").textContent = title;
  byId("confirm-about").textContent = about;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}

export async function change(what, title, about, body) {
  if (!(await confirmed(title, about))) return null;
  const { ok, done, error } = await post(`/operate/${what}`, body);
  return ok ? done : `Refused: ${error}`;
}
