// The event images: received only while a card is on screen and the page is visible. One answer, which lasts, has the new
// images of all these streams; the server draws them in rounds, at most ten times per second.
import { element } from "./format.js";

const RETRY_MS = 700;
const SETTLE_MS = 100; // cards that come into view together are asked for together
const SILENT_MS = 6000; // the server sends something every two seconds
const BEHIND_MS = 1500; // a slow link: what waits on it is dropped with the connection
const MOST = 12;
const HEAD_BYTES = 16; // time of sending [s], place of the stream in the request, length of the image
const looking = new Set();
let receiving = null;
let planned = 0;

function plan(waitMs) {
  clearTimeout(planned);
  planned = setTimeout(begin, waitMs);
}

function begin() {
  const wanted = document.hidden ? [] : [...looking].slice(0, MOST);
  const same = receiving && receiving.wanted.length === wanted.length && wanted.every((one, i) => one === receiving.wanted[i]);
  if (same) return;
  receiving?.stop.abort();
  receiving = null;
  if (wanted.length) receive(wanted);
}

async function receive(wanted) {
  const own = { wanted, stop: new AbortController(), leastMs: Infinity };
  receiving = own;
  let silent = 0;
  const alive = () => {
    clearTimeout(silent);
    silent = setTimeout(() => own.stop.abort(), SILENT_MS);
  };
  try {
    alive();
    const query = new URLSearchParams(wanted.map((one) => ["s", one.stream]));
    const answer = await fetch(`/images?${query}`, { signal: own.stop.signal });
    if (!answer.ok) throw new Error(answer.statusText);
    const reader = answer.body.getReader();
    let rest = new Uint8Array(0);
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      alive();
      const data = new Uint8Array(rest.length + value.length);
      data.set(rest);
      data.set(value, rest.length);
      rest = await show(own, data);
    }
  } catch {
    // ended by the server, by the network, or by begin()
  } finally {
    clearTimeout(silent);
    own.stop.abort();
    if (receiving === own) {
      receiving = null;
      plan(RETRY_MS);
    }
  }
}

// Draw the newest image of each stream in the data; returns the bytes of an image that is not complete.
async function show(own, data) {
  const view = new DataView(data.buffer);
  const newest = new Map();
  let at = 0;
  while (at + HEAD_BYTES <= data.length) {
    const end = at + HEAD_BYTES + view.getUint32(at + 12);
    if (end > data.length) break;
    const lagMs = performance.now() - 1000 * view.getFloat64(at); // of two clocks: only its growth has a meaning
    own.leastMs = Math.min(own.leastMs, lagMs);
    if (lagMs - own.leastMs > BEHIND_MS) own.stop.abort();
    if (end > at + HEAD_BYTES) newest.set(view.getUint32(at + 8), data.subarray(at + HEAD_BYTES, end));
    at = end;
  }
  for (const [place, png] of newest) {
    own.wanted[place]?.draw(await createImageBitmap(new Blob([png], { type: "image/png" })));
  }
  return data.subarray(at);
}

document.addEventListener("visibilitychange", () => plan(0));

export class Picture {
  constructor(stream) {
    this.stream = stream;
    this.root = element("div", "picture");
    this.canvas = element("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `events of ${stream}`);
    const legend = element("span");
    legend.append(element("b", "on", "brighter "), element("b", "off", "darker"));
    this.root.append(this.canvas, legend);
    this.drawn = 0;
    this.observer = new IntersectionObserver(([entry]) => {
      if (entry.isIntersecting) looking.add(this);
      else looking.delete(this);
      plan(SETTLE_MS);
    });
    this.observer.observe(this.root);
  }

  draw(image) {
    this.drawn += 1;
    if (this.canvas.width !== image.width || this.canvas.height !== image.height) {
      this.canvas.width = image.width;
      this.canvas.height = image.height;
      this.root.style.aspectRatio = `${image.width} / ${image.height}`;
    }
    this.canvas.getContext("2d").drawImage(image, 0, 0);
    image.close();
    this.root.dataset.images = String(this.drawn);
  }

  close() {
    looking.delete(this);
    plan(SETTLE_MS);
    this.observer.disconnect();
  }
}
