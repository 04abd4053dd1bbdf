// The card of one node: its model, its history of model changes, and the controls of an operator.
import { clock, count, duration, element, facts, put } from "./format.js";

const SIGNATURES = {
  trusted: "✓ signed by a trusted key",
  unsigned: "not signed",
  unchecked: "signed; this node trusts no key",
  untrusted: "✗ refused",
};

export class NodeCard {
  constructor(name, act) {
    this.name = name;
    this.act = act;
    this.root = element("article", "card node");
    const head = element("div", "head");
    this.verdict = element("span", "verdict");
    this.why = element("span", "why");
    head.append(element("h2", "", `node ${name}`), this.verdict, this.why);
    this.facts = element("dl", "facts");
    this.history = element("ol", "history");
    this.history.tabIndex = 0;
    this.history.setAttribute("aria-label", "Model changes, newest first");
    this.historyKey = "";
    const left = element("div");
    left.append(this.facts, this.controls());
    const right = element("div");
    right.append(element("h3", "", "Model changes since the page started"), this.history);
    const body = element("div", "sides");
    body.append(left, right);
    this.root.append(head, body);
  }

  controls() {
    this.operator = element("div", "operator");
    this.select = element("select");
    this.select.setAttribute("aria-label", "Model to activate");
    this.activate = element("button", "", "Activate");
    this.rollback = element("button", "", "Roll back");
    this.result = element("div", "result");
    this.result.setAttribute("role", "status");
    this.activate.type = this.rollback.type = "button";
    this.activate.addEventListener("click", () => this.change("activate"));
    this.rollback.addEventListener("click", () => this.change("rollback"));
    this.operator.append(this.select, this.activate, this.rollback, this.result);
    this.operator.hidden = true;
    return this.operator;
  }

  async change(what) {
    const digest = this.select.value;
    const wanted = what === "activate" ? this.select.selectedOptions[0]?.textContent : this.node.previous?.name;
    const about = `The active model is ${this.node.model.name}. If another client changes it first, nothing happens.`;
    const title = what === "activate" ? `Activate ${wanted} on ${this.name}?` : `Roll back to ${wanted} on ${this.name}?`;
    const body = { node: this.name, expect: this.node.model.digest, ...(what === "activate" ? { model: digest } : {}) };
    this.busy = true;
    try {
      this.outcome = await this.act(what, title, about, body);
    } finally {
      this.busy = false;
    }
    if (this.outcome !== null) put(this.result, this.outcome);
    this.focusAgain(this[what]);
  }

  // A button is disabled while its change runs, and loses the focus by it: who works with the keyboard gets it back.
  focusAgain(button) {
    this.showControls(this.node, !this.operator.hidden);
    const now = document.activeElement; // for a moment still in the dialog that has closed
    if (now === document.body || now.closest("dialog:not([open])")) (button.disabled ? this.select : button).focus();
  }

  show(node, operator) {
    this.node = node;
    this.root.className = `card node level-${node.level}`;
    put(this.verdict, node.verdict);
    put(this.why, node.why);
    const model = node.model;
    facts(this.facts, [
      ["model", model ? `${model.name}${model.trained ? "" : " (untrained)"}` : undefined],
      ["digest", model ? model.digest.slice(0, 16) : undefined],
      ["signature", model ? SIGNATURES[model.signature] ?? model.signature : undefined],
      ["release", model?.release ? String(model.release) : undefined],
      ["parameters", model ? count(model.parameters) : undefined],
      ["made", model?.provenance],
      ["up", node.uptime_s === undefined ? undefined : `${duration(node.uptime_s)}, version ${node.version}`],
      ["streams", node.streams === undefined ? undefined : String(node.streams)],
      ["missing", node.missing?.join(", ")],
      ["rollbacks", node.rollbacks ? `${node.rollbacks} automatic` : undefined],
    ]);
    this.showControls(node, operator);
    this.showHistory(node.history);
  }

  showControls(node, operator) {
    this.operator.hidden = !operator || !node.available;
    if (this.operator.hidden) return;
    const key = JSON.stringify(node.available.map((one) => one.digest));
    if (key !== this.modelsKey) {
      this.modelsKey = key;
      this.select.replaceChildren(...node.available.map((one) => {
        const option = element("option", "", `${one.name} (${one.digest.slice(0, 8)})`);
        option.value = one.digest;
        return option;
      }));
    }
    const gone = node.level === "bad";
    this.activate.disabled = this.busy || gone || this.select.value === node.model?.digest;
    this.rollback.disabled = this.busy || gone || !node.previous;
    if (this.busy && node.running) put(this.result, node.running);
  }

  showHistory(history) {
    const key = JSON.stringify(history);
    if (key === this.historyKey) return;
    this.historyKey = key;
    this.history.replaceChildren(...history.map((entry) => {
      const item = element("li");
      const what = element("div");
      what.append(element("b", "", entry.model), element("code", "", entry.digest), element("span", "", entry.reason));
      const time = element("time", "", clock(entry.at));
      time.dateTime = new Date(entry.at * 1000).toISOString();
      item.append(time, what);
      return item;
    }));
  }

  close() {
    this.root.remove();
  }
}
