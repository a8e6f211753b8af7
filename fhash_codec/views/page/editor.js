// The editor of opacities over a histogram: drag points, click for a new one, double-click or Delete takes one away.
import { colourAt, colourCode } from "./colours.js";
import { interpolate } from "./transfer.js";

const NEAR = 12;
const STRIP = 10;

/** Editor on a canvas; `changed` is told new points [value, opacity]. */
export class Editor {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.chosen = -1;
    canvas.onpointerdown = (event) => this.press(event);
    canvas.onpointermove = (event) => this.drag(event);
    canvas.onpointerup = canvas.onpointercancel = () => { this.held = false; };
    canvas.ondblclick = (event) => this.remove(this.nearest(event));
    canvas.oncontextmenu = (event) => { event.preventDefault(); this.remove(this.nearest(event)); };
    canvas.onkeydown = (event) => this.key(event);
  }

  show({ tf, counts, range }) {
    Object.assign(this, { tf, counts, range });
    if (!this.held) this.points = tf.points.map((point) => [...point]);
    this.draw();
  }

  place([value, opacity]) {
    const { clientWidth: wide, clientHeight: tall } = this.canvas, [low, high] = this.range;
    return [((value - low) / (high - low || 1)) * (wide - 12) + 6, (1 - Math.sqrt(opacity)) * (tall - STRIP - 12) + 6];
  }

  point(event) {
    const box = this.canvas.getBoundingClientRect(), [low, high] = this.range, clip = (one) => Math.min(Math.max(one, 0), 1);
    const share = clip((event.clientX - box.left - 6) / (box.width - 12));
    return [low + share * (high - low), clip(1 - (event.clientY - box.top - 6) / (box.height - STRIP - 12)) ** 2];
  }

  nearest(event) {
    const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    let best = -1, least = NEAR;
    this.points.forEach((point, n) => {
      const [px, py] = this.place(point), far = Math.hypot(px - x, py - y);
      if (far < least) [best, least] = [n, far];
    });
    return best;
  }

  press(event) {
    if (event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.chosen = this.nearest(event);
    if (this.chosen < 0) {
      const point = this.point(event);
      this.chosen = this.points.findIndex((one) => one[0] > point[0]);
      if (this.chosen < 0) this.chosen = this.points.length;
      this.points.splice(this.chosen, 0, point);
      this.set(this.chosen, point);
    }
    this.held = true;
    this.draw();
  }

  drag(event) {
    if (this.held) this.set(this.chosen, this.point(event));
  }

  /** Move a point between its neighbours. */
  set(n, [value, opacity]) {
    const gap = 1e-6 * (this.range[1] - this.range[0] || 1), low = this.points[n - 1]?.[0] ?? -Infinity, high = this.points[n + 1]?.[0] ?? Infinity;
    this.points[n] = [Math.min(Math.max(value, low + gap), high - gap), opacity];
    this.changed(this.points.map((point) => [...point]));
    this.draw();
  }

  remove(n) {
    if (n < 0 || this.points.length < 2) return;
    this.points.splice(n, 1);
    this.chosen = -1;
    this.changed(this.points.map((point) => [...point]));
    this.draw();
  }

  key(event) {
    const point = this.points[this.chosen], width = (this.range[1] - this.range[0]) / 100;
    const moves = { ArrowLeft: [-width, 0], ArrowRight: [width, 0], ArrowUp: [0, 0.02], ArrowDown: [0, -0.02] };
    if (event.key === "Delete" || event.key === "Backspace") this.remove(this.chosen);
    else if (point && moves[event.key]) this.set(this.chosen, [point[0] + moves[event.key][0], Math.min(Math.max(point[1] + moves[event.key][1], 0), 1)]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  draw() {
    const { canvas, counts, tf } = this, dense = devicePixelRatio, wide = canvas.clientWidth, tall = canvas.clientHeight;
    if (!tf || !wide) return;
    canvas.width = wide * dense;
    canvas.height = tall * dense;
    const context = canvas.getContext("2d"), style = getComputedStyle(canvas), inner = tall - STRIP;
    context.scale(dense, dense);
    const most = Math.log1p(Math.max(...counts, 1)), [low, high] = this.range;
    for (let x = 6; x < wide - 6; x++) {
      const share = (x - 6) / (wide - 12), value = low + share * (high - low), colour = colourCode(colourAt(tf.colours, value));
      const bar = (Math.log1p(counts[Math.min(Math.floor(share * counts.length), counts.length - 1)]) / most) * (inner - 12);
      context.globalAlpha = 0.45;
      context.fillStyle = style.color;
      context.fillRect(x, inner - 6 - bar, 1, bar);
      const rise = Math.sqrt(Math.max(interpolate(this.points, value), 0)) * (inner - 12);
      context.globalAlpha = 0.6;
      context.fillStyle = colour;
      context.fillRect(x, inner - 6 - rise, 1, rise);
      context.globalAlpha = 1;
      context.fillRect(x, inner - 2, 1, STRIP);
    }
    context.strokeStyle = style.color;
    context.lineWidth = 1.5;
    context.beginPath();
    this.points.forEach((point) => context.lineTo(...this.place(point)));
    context.stroke();
    this.points.forEach((point, n) => {
      context.beginPath();
      context.arc(...this.place(point), n === this.chosen ? 6 : 4.5, 0, 7);
      context.fillStyle = colourCode(colourAt(tf.colours, point[0]));
      context.fill();
      context.stroke();
    });
  }
}
