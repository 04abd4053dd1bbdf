// The event image of a stream: asked for only while the card is on screen and the page is visible, at most 10 per second.
import { element } from "./format.js";

const PERIOD_MS = 100;
const SHARE_MS = 50; // several pictures on screen share 20 images per second
const looking = new Set();
const RETRY_MS = 700;

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
    this.seen = false;
    this.closed = false;
    this.number = 0;
    this.busy = false;
    this.observer = new IntersectionObserver(([entry]) => {
      this.seen = entry.isIntersecting;
      if (this.seen) looking.add(this);
      else looking.delete(this);
      this.next(0);
    });
    this.observer.observe(this.root);
    this.onVisible = () => this.next(0);
    document.addEventListener("visibilitychange", this.onVisible);
  }

  next(delayMs) {
    if (this.busy || this.closed || !this.seen || document.hidden) return;
    this.busy = true;
    setTimeout(() => this.load(), delayMs);
  }

  load() {
    const started = performance.now();
    const image = new Image();
    const done = (delayMs) => {
      this.busy = false;
      this.next(delayMs);
    };
    image.onload = () => {
      this.draw(image);
      done(Math.max(PERIOD_MS, SHARE_MS * looking.size) - (performance.now() - started));
    };
    image.onerror = () => done(RETRY_MS);
    this.number += 1;
    image.src = `/image/${encodeURIComponent(this.stream)}.png?n=${this.number}`;
  }

  draw(image) {
    if (this.canvas.width !== image.naturalWidth || this.canvas.height !== image.naturalHeight) {
      this.canvas.width = image.naturalWidth;
      this.canvas.height = image.naturalHeight;
      this.root.style.aspectRatio = `${image.naturalWidth} / ${image.naturalHeight}`;
    }
    this.canvas.getContext("2d").drawImage(image, 0, 0);
    this.root.dataset.images = String(this.number);
  }

  close() {
    this.closed = true;
    looking.delete(this);
    this.observer.disconnect();
    document.removeEventListener("visibilitychange", this.onVisible);
  }
}
