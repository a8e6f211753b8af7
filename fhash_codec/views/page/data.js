// Frames of a container: read in workers, kept, and read ahead.
import { interpolate } from "./transfer.js";

const MEMORY = Math.min((navigator.deviceMemory ?? 4) * 128, 1024) * 2 ** 20;
const MAX_WORKERS = Math.max(1, Math.min((navigator.hardwareConcurrency ?? 2) - 1, 4));

/** A container of a URL or a file: `{url}` or `{blob}`; priors and script where the page has no address. */
export class Container {
  constructor(source, { wasm, changed }) {
    this.source = source;
    this.wasm = wasm;
    this.changed = changed;
    this.loaded = this.requests = 0;
    this.workers = [];
    this.frames = new Map();
    this.waiting = new Map();
  }

  async open() {
    const about = await this.ask(this.worker(0), "open", { ...this.source, wasm: await this.wasm() });
    this.about = { size: about.size, blocks: about.blocks };
    this.header = about.header;
    this.variables = about.variables;
    await this.prepare(0);
  }

  /** Fetch the coordinates of a variable. */
  async prepare(number) {
    const each = this.variables[number];
    each.coords ??= await this.ask(this.worker(0), "coordinates", { number, shape: each.shape });
    return each;
  }

  worker(n) {
    if (this.workers[n]) return this.workers[n];
    const made = new Worker(this.source.script ?? new URL("worker.js", import.meta.url));
    const own = { worker: made, answers: new Map(), ready: null, busy: 0 };
    this.workers[n] = own;
    made.onmessage = ({ data }) => {
      if (data.loaded !== undefined) {
        this.loaded += data.loaded;
        this.requests += data.requests;
        this.changed();
        return;
      }
      const answer = own.answers.get(data.id);
      own.answers.delete(data.id);
      own.busy--;
      if (data.fatal) this.drop(n);
      if (data.error !== undefined) answer?.reject(new Error(data.error));
      else answer?.resolve(data.result);
    };
    made.onerror = (event) => {
      event.preventDefault();
      for (const { reject } of own.answers.values()) reject(new Error(`the decoder could not be started: ${event.message ?? ""}`));
      this.drop(n);
    };
    if (n > 0 || this.about) {
      own.ready = this.wasm().then((wasm) => this.ask(own, "open", { ...this.source, wasm, ...this.about }));
      own.ready.catch(() => {});
    }
    return own;
  }

  drop(n) {
    this.workers[n]?.worker.terminate();
    delete this.workers[n];
  }

  ask(own, name, given) {
    own.busy++;
    return new Promise((resolve, reject) => {
      const id = (this.last = (this.last ?? 0) + 1);
      own.answers.set(id, { resolve, reject });
      own.worker.postMessage({ id, name, given });
    });
  }

  /** Key of a frame; `smoothing` is the deviation of the Gaussian of what it is shaded by, 0 for none. */
  key({ number, step, lod, smoothing }) {
    return `${number}/${step}/${lod}/${smoothing}`;
  }

  /** A frame that is there, or null. */
  kept(wanted) {
    const key = this.key(wanted), found = this.frames.get(key);
    if (found) {
      this.frames.delete(key);
      this.frames.set(key, found);
    }
    return found ?? null;
  }

  /** A frame, read where it is not there. A worker reads all steps of a tile, so that it decodes the tile once. */
  async frame(wanted) {
    const key = this.key(wanted), found = this.kept(wanted);
    if (found) return found;
    if (!this.waiting.has(key)) this.waiting.set(key, this.read(wanted).finally(() => this.waiting.delete(key)));
    return this.waiting.get(key);
  }

  async read(wanted) {
    const about = this.variables[wanted.number];
    const layer = Math.floor(wanted.step / Math.max(about.tile[0], 1));
    const own = this.worker(layer % MAX_WORKERS && this.frames.size ? layer % MAX_WORKERS : 0);
    if (own.ready) await own.ready;
    const frame = await this.ask(own, "frame", { ...wanted, box: about.box, error: about.maxError });
    frame.range = [about.low, about.high];
    Object.assign(frame, { number: wanted.number, step: wanted.step, lod: wanted.lod });
    this.frames.set(this.key(wanted), frame);
    let bytes = 0;
    for (const one of this.frames.values()) bytes += one.values.byteLength * (one.smoothed ? 2 : 1);
    for (const [other, one] of this.frames) {
      if (bytes <= MEMORY || one === frame) break;
      bytes -= one.values.byteLength * (one.smoothed ? 2 : 1);
      this.frames.delete(other);
    }
    return frame;
  }

  /** Read a frame for later, where few are being read. */
  ahead(wanted) {
    const reading = this.waiting.size;
    if (reading < 2 * MAX_WORKERS && !this.kept(wanted) && !this.waiting.has(this.key(wanted))) this.frame(wanted).catch(() => {});
  }

  close() {
    this.workers.forEach((_, n) => this.drop(n));
    this.frames.clear();
  }
}

/** Counts of finite values of a frame in `bins` bins over a range. */
export function histogram(frames, [low, high], bins) {
  const counts = new Array(bins).fill(0), scale = bins / (high - low || 1);
  for (const { values } of frames) {
    for (let n = 0; n < values.length; n++) {
      const value = values[n];
      if (value === value) counts[Math.min(Math.max(Math.floor((value - low) * scale), 0), bins - 1)]++;
    }
  }
  return counts;
}

/** How different neighbouring vertices look: opacity and, where there is some, place in the colours. */
export function structure({ values, shape }, { points, colours }, surfaces) {
  const low = colours.positions[0], width = colours.positions.at(-1) - low;
  const looks = Float64Array.from(values, (value) => {
    if (value !== value) return 0;
    const opacity = interpolate(points, value), shown = opacity > 0 ? opacity * (1 + Math.min(Math.max((value - low) / width, 0), 1)) : 0;
    return surfaces.reduce((sum, one) => sum + (value >= one.value ? one.opacity ?? 1 : 0), shown);
  });
  const [, ny, nx] = shape, strides = [ny * nx, nx, 1];
  let sum = 0;
  strides.forEach((stride, axis) => {
    for (let n = 0; n < looks.length; n++) if (Math.floor(n / stride) % shape[axis] + 1 < shape[axis]) sum += Math.abs(looks[n + stride] - looks[n]);
  });
  return sum;
}

/** Value of a frame at a vertex (x, y, z) of the domain; NaN where there is none. */
export function valueAt(frame, place) {
  const at = place.map((one, n) => Math.round((one - frame.first[n]) / frame.stride)), [nz, ny, nx] = frame.shape;
  if (at[0] < 0 || at[1] < 0 || at[2] < 0 || at[0] >= nx || at[1] >= ny || at[2] >= nz) return NaN;
  return frame.values[(at[2] * ny + at[1]) * nx + at[0]];
}
