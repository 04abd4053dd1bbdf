// The event images: asked for only while a card is on screen and the page is visible. One request has all of them; the
// server answers it at its next round, at most ten times per second.
import { element } from "./format.js";

const RETRY_MS = 700;
const MOST = 12;
const HEAD_BYTES = 8; // number and length of an image
const looking = new Set();
let asking = false;

async function round() {
  if (asking || document.hidden || !looking.size) return;
  asking = true;
  try {
    const asked = [...looking].slice(0, MOST);
    const query = new URLSearchParams();
    asked.forEach((one) => query.append("s", one.stream));
    asked.forEach((one) => query.append("n", one.number));
    const answer = await fetch(`/images?${query}`, { signal: AbortSignal.timeout(10000) });
    if (!answer.ok) throw new Error(answer.statusText);
    await show(asked, await answer.arrayBuffer());
    setTimeout(round, 0);
  } catch {
    setTimeout(round, RETRY_MS);
  } finally {
    asking = false;
  }
}

async function show(asked, data) {
  const view = new DataView(data);
  let at = 0;
  for (const one of asked) {
    const number = view.getUint32(at);
    const bytes = view.getUint32(at + 4);
    at += HEAD_BYTES;
    if (bytes) one.draw(await createImageBitmap(new Blob([new Uint8Array(data, at, bytes)], { type: "image/png" })), number);
    at += bytes;
  }
}

document.addEventListener("visibilitychange", round);

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
    this.number = 0;
    this.drawn = 0;
    this.observer = new IntersectionObserver(([entry]) => {
      if (entry.isIntersecting) looking.add(this);
      else looking.delete(this);
      round();
    });
    this.observer.observe(this.root);
  }

  draw(image, number) {
    this.number = number;
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
    this.observer.disconnect();
  }
}
