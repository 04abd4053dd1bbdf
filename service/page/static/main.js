// The page: one source of events, a watch over it, and the cards.
import { element, put } from "./format.js";
import { NodeCard } from "./node.js";
import { askToken, change, redeemFragment } from "./session.js";
import { StreamCard } from "./stream.js";

const LOST_MS = 1300; // without a message for so long, the page has lost its connection
const AGAIN_MS = 6000;

const byId = (id) => document.getElementById(id);
const streams = new Map();
const nodes = new Map();
const links = new Map();
let source = null;
let heardAt = performance.now();
let openedAt = 0;
let everHeard = false;
let role = "viewer";
let mayOperate = false;
let askedForToken = false;

function open() {
  source?.close();
  openedAt = performance.now();
  source = new EventSource("/feed");
  source.addEventListener("hello", (event) => hello(JSON.parse(event.data)));
  source.addEventListener("news", (event) => show(JSON.parse(event.data)));
}

function hello(state) {
  role = state.role;
  mayOperate = state.operator;
  put(byId("version"), `NeuroVE ${state.version}`);
  byId("operate").hidden = !mayOperate || role === "operator";
  show(state);
}

function show(state) {
  heardAt = performance.now();
  everHeard = true;
  watch();
  const empty = state.streams.length === 0;
  byId("empty").hidden = !empty;
  if (empty) put(byId("empty-text"), state.problem || "No stream yet. The page shows streams as soon as a driver publishes.");
  banner(empty ? "" : state.problem);
  each(streams, state.streams, byId("streams"), (one) => new StreamCard(one.name, state.history_s), (card, one) => card.show(one, state.now_s));
  if (state.nodes) each(nodes, state.nodes, byId("nodes"), (one) => new NodeCard(one.name, change), (card, one) => card.show(one, role === "operator"));
  byId("streams").classList.toggle("many", state.streams.length > 1);
  each(links, state.streams, byId("nav"), link, (one, stream) => one.show(stream));
  const bad = state.streams.filter((one) => one.level === "bad").length;
  document.title = bad ? `(${bad} stalled) NeuroVE` : "NeuroVE";
}

function each(cards, list, parent, make, use) {
  const names = new Set(list.map((one) => one.name));
  for (const [name, card] of cards) {
    if (names.has(name)) continue;
    card.close();
    cards.delete(name);
  }
  list.forEach((one, i) => {
    if (!cards.has(one.name)) cards.set(one.name, make(one));
    const card = cards.get(one.name);
    if (parent.children[i] !== card.root) parent.insertBefore(card.root, parent.children[i] ?? null);
    use(card, one);
  });
}

function link({ name }) {
  const root = element("a");
  root.href = `#stream-${encodeURIComponent(name)}`;
  const mark = element("i");
  root.append(mark, element("span", "", name));
  const marks = { ok: "●", warn: "▲", bad: "■", idle: "○" };
  return {
    root,
    show(stream) {
      mark.className = `level-${stream.level}`;
      put(mark, marks[stream.level]);
      root.setAttribute("aria-label", `${name}: ${stream.verdict}`);
    },
    close: () => root.remove(),
  };
}

function banner(text) {
  byId("banner").hidden = !text;
  put(byId("banner"), text ? text.charAt(0).toUpperCase() + text.slice(1) : "");
}

function watch() {
  const silentMs = performance.now() - heardAt;
  const lost = silentMs > LOST_MS;
  document.body.classList.toggle("lost", lost && everHeard);
  const live = byId("live");
  live.className = `live ${lost ? "off" : everHeard ? "on" : ""}`;
  put(live, lost ? "connection lost" : everHeard ? "live" : "connecting");
  if (!lost) return;
  banner(`This page lost its connection ${Math.floor(silentMs / 1000)} s ago. What it shows is old. It reconnects by itself.`);
  const waitedMs = performance.now() - openedAt;
  if (waitedMs > AGAIN_MS || (source?.readyState === EventSource.CLOSED && waitedMs > 1000)) retry();
}

async function retry() {
  openedAt = performance.now();
  if (!askedForToken && !everHeard) {
    const answer = await fetch("/feed", { method: "HEAD" }).catch(() => null);
    if (answer?.status === 401) {
      askedForToken = true;
      askToken("This page is visible to other machines, so it needs the token that `neurove page` printed.", open);
    }
  }
  open();
}

byId("operate").addEventListener("click", () => {
  askToken("`neurove page --operator` printed a token that works once. With it, this browser may change models.", open);
});
setInterval(watch, 250);
await redeemFragment();
open();
