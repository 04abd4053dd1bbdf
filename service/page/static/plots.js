// Six plots with bands of two sigma, on one time axis, and the strip of flags below them.
import { element, fixed, put, signed } from "./format.js";
import { gravity } from "./flags.js";

const AXES = [
  ["vx", "right", "linear"], ["vy", "down", "linear"], ["vz", "forward", "linear"],
  ["ωx", "pitch", "angular"], ["ωy", "yaw", "angular"], ["ωz", "roll", "angular"],
];
const AXIS_PX = 40;
const ROW_PX = 16;
const GAP_S = 0.6;
const LEAST_SPAN = { linear: 0.5, angular: 5 };

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// The range holds every value and the usual band; a band that widens for a moment may leave the plot.
function range(kind) {
  return (u) => {
    const [, values, , highs] = u.data;
    const known = values.filter((value) => value !== null);
    if (!known.length) return [-LEAST_SPAN[kind], LEAST_SPAN[kind]];
    const bands = highs.map((high, i) => (high === null ? null : high - values[i])).filter((band) => band !== null);
    bands.sort((a, b) => a - b);
    const band = bands.length ? bands[Math.floor(bands.length * 0.9)] : 0;
    const low = Math.min(...known) - band;
    const high = Math.max(...known) + band;
    const room = Math.max((high - low) * 0.08, (LEAST_SPAN[kind] - (high - low)) / 2, 0);
    return [low - room, high + room];
  };
}

function zeroLine(u) {
  const y = u.valToPos(0, "y", true);
  if (y < u.bbox.top || y > u.bbox.top + u.bbox.height) return;
  u.ctx.save();
  u.ctx.strokeStyle = colour("--zero");
  u.ctx.lineWidth = devicePixelRatio;
  u.ctx.beginPath();
  u.ctx.moveTo(u.bbox.left, y);
  u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
  u.ctx.stroke();
  u.ctx.restore();
}

export class Plots {
  constructor(historyS) {
    this.historyS = historyS;
    this.times = [];
    this.flags = [];
    this.columns = AXES.map(() => [[], [], []]); // value, low, high
    this.now = 0;
    this.root = element("div", "plots");
    this.rows = AXES.map(([name, about, kind]) => this.row(name, about, kind));
    this.strip();
    this.charts = null;
    new ResizeObserver(() => this.resize()).observe(this.root);
  }

  row(name, about, kind) {
    const row = element("div", `row ${kind}`);
    const label = element("div", "label");
    label.append(element("b", "", name), element("small", "", about));
    const chart = element("div", "chart");
    chart.setAttribute("role", "img");
    chart.setAttribute("aria-label", `${name}, ${about}, over the last ${this.historyS} seconds`);
    const now = element("div", "now");
    const value = element("span");
    const sigma = element("small");
    now.append(value, sigma);
    row.append(label, chart, now);
    this.root.append(row);
    return { chart, value, sigma, kind };
  }

  strip() {
    const row = element("div", "row strip");
    this.names = element("div", "names");
    this.states = element("div", "states");
    const middle = element("div");
    this.canvas = element("canvas");
    this.canvas.setAttribute("role", "img");
    const ticks = element("div", "ticks");
    for (let s = this.historyS; s >= 0; s -= 10) {
      const tick = element("span", "", s ? `−${s} s` : "now");
      tick.style.left = `${100 * (1 - s / this.historyS)}%`;
      ticks.append(tick);
    }
    middle.append(this.canvas, ticks);
    row.append(this.names, middle, this.states);
    this.root.append(row);
  }

  push(points) {
    for (const point of points) {
      const last = this.times.at(-1) ?? -Infinity;
      const t = point[0];
      if (t <= last) continue;
      if (t - last > GAP_S && last > 0) this.append(last + 0.001, null, "");
      this.append(t, point, point[13]);
    }
  }

  append(t, point, flags) {
    this.times.push(t);
    this.flags.push(flags);
    this.columns.forEach((column, axis) => {
      const scale = axis < 3 ? 1 : 180 / Math.PI;
      const value = point === null ? null : point[1 + axis] * scale;
      const sigma = point === null || point[7 + axis] === null ? null : 2 * point[7 + axis] * scale;
      column[0].push(value);
      column[1].push(sigma === null ? null : value - sigma);
      column[2].push(sigma === null ? null : value + sigma);
    });
  }

  trim() {
    let old = 0;
    while (old < this.times.length && this.times[old] < this.now - this.historyS - 1) old += 1;
    if (!old) return;
    this.times.splice(0, old);
    this.flags.splice(0, old);
    this.columns.flat().forEach((column) => column.splice(0, old));
  }

  tell() {
    this.rows.forEach(({ value, sigma, kind }, axis) => {
      const [values, , highs] = this.columns[axis];
      const newest = values.at(-1);
      const band = highs.at(-1) === null || newest === undefined ? null : highs.at(-1) - newest;
      const [digits, unit] = kind === "linear" ? [2, "m/s"] : [1, "deg/s"];
      put(value, newest === undefined || newest === null ? "–" : signed(newest, digits));
      put(sigma, band === null || newest === null ? unit : `± ${fixed(band, digits)} ${unit}`);
    });
  }

  draw(now) {
    this.now = now;
    this.trim();
    this.tell();
    this.charts ??= this.rows.map((row, axis) => this.chart(row, axis));
    this.charts.forEach((chart, axis) => chart.setData([this.times, ...this.columns[axis]]));
    this.drawFlags();
  }

  chart(row, axis) {
    const line = `--${row.kind}`;
    const edge = { width: 0, points: { show: false }, stroke: "transparent" };
    const options = {
      width: row.chart.clientWidth || 300,
      height: row.chart.clientHeight || 72,
      padding: [5, 0, 5, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: () => [this.now - this.historyS, this.now] }, y: { range: range(row.kind) } },
      axes: [
        { size: 0, grid: { stroke: () => colour("--grid"), width: 1 }, ticks: { show: false }, values: () => [],
          splits: (u) => [30, 20, 10, 0].map((s) => u.scales.x.max - s) },
        { size: AXIS_PX, gap: 4, space: 22, font: "11px system-ui, sans-serif", stroke: () => colour("--soft"),
          grid: { stroke: () => colour("--grid"), width: 1 }, ticks: { show: false },
          values: (_, ticks) => ticks.map((one) => String(Number(one.toFixed(2))).replace("-", "−")) },
      ],
      series: [{}, { stroke: () => colour(line), width: 1.5, points: { show: false } }, edge, edge],
      bands: [{ series: [3, 2], fill: () => colour(`${line}-band`) }],
      hooks: { drawAxes: [zeroLine] },
    };
    return new window.uPlot(options, [this.times, ...this.columns[axis]], row.chart);
  }

  drawFlags() {
    const seen = [...new Set(this.flags.flatMap((text) => (text ? text.split(" ") : [])))].slice(0, 8);
    const rows = Math.max(seen.length, 1);
    const width = this.canvas.clientWidth;
    const scale = devicePixelRatio;
    if (this.canvas.width !== width * scale || this.canvas.height !== rows * ROW_PX * scale) {
      this.canvas.width = width * scale;
      this.canvas.height = rows * ROW_PX * scale;
      this.canvas.style.height = `${rows * ROW_PX}px`;
    }
    const newest = (this.flags.at(-1) ?? "").split(" ");
    this.lines(this.names, seen.length ? seen : ["no flags"]);
    this.lines(this.states, seen.length ? seen.map((flag) => (newest.includes(flag) ? "now" : "")) : [""]);
    this.canvas.setAttribute("aria-label", seen.length ? `flags: ${seen.join(", ")}` : "no flags");
    const brush = this.canvas.getContext("2d");
    brush.setTransform(scale, 0, 0, scale, 0, 0);
    brush.clearRect(0, 0, width, rows * ROW_PX);
    const x = (t) => AXIS_PX + ((width - AXIS_PX) * (t - this.now + this.historyS)) / this.historyS;
    brush.fillStyle = colour("--grid");
    for (let i = 0; i < rows; i += 1) brush.fillRect(AXIS_PX, i * ROW_PX + 7, width - AXIS_PX, 2);
    seen.forEach((flag, i) => {
      const grave = gravity(flag);
      brush.fillStyle = colour(grave ? `--flag-${grave}` : "--flag");
      let from = null;
      this.flags.forEach((text, k) => {
        const on = text !== "" && text.split(" ").includes(flag);
        const t = this.times[k];
        if (on) from ??= k ? Math.max(this.times[k - 1], t - GAP_S) : t;
        const ends = from !== null && (!on || k === this.flags.length - 1);
        if (!ends) return;
        const left = Math.max(AXIS_PX, x(from));
        brush.fillRect(left, i * ROW_PX + 4, Math.max(1.5, x(on ? t : this.times[k - 1]) - left), 8);
        from = null;
      });
    });
  }

  lines(list, texts) {
    while (list.children.length > texts.length) list.lastChild.remove();
    texts.forEach((text, i) => {
      if (!list.children[i]) list.append(element("div"));
      put(list.children[i], text);
    });
  }

  resize() {
    this.charts?.forEach((chart, axis) => {
      const { clientWidth: width, clientHeight: height } = this.rows[axis].chart;
      if (width && (width !== chart.width || height !== chart.height)) chart.setSize({ width, height });
    });
  }
}

