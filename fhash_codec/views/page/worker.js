// Decodes a container by fhash.wasm (fhash.h). It reads synchronously: of a URL by ranges, or of a file.

const BLOCK = 1 << 14;
const TAIL = 4;
const MOST_AHEAD = 64;
const KEPT = 4096;
const SIDE = 8;
const FLOAT32 = 10;
const PRIORS = ["prior.bin", "mask_prior.bin", "fast_prior.bin"];

let source = null;
let library = null;
let file = 0;
let reason = "";
let priors = [];

/** Answer of a URL, by a request that waits. */
function asked(method, url, range) {
  const request = new XMLHttpRequest();
  request.open(method, url, false);
  request.responseType = "arraybuffer";
  if (range) request.setRequestHeader("Range", range);
  try {
    request.send();
  } catch {
    throw new Error("cannot be reached, or its server does not allow pages of other sites to read it (CORS)");
  }
  if (request.status !== 206 && request.status !== 200) throw new Error(`the server answers ${request.status} ${request.statusText}`);
  return request;
}

/** Bytes of a container in blocks, which are kept, those used last the longest. The last block ends with the file. */
class Source {
  constructor({ url, blob, blocks, size }) {
    this.url = url;
    this.blob = blob;
    this.bytes = null;
    this.blocks = new Map(blocks ?? []);
    this.size = size ?? this.blob?.size;
    this.end = -1;
    this.ahead = 1;
    if (this.size === undefined) this.measure();
  }

  /** Ask for the end of the file, which says its size, too. */
  measure() {
    const tail = this.ask(`bytes=-${TAIL * BLOCK}`), data = new Uint8Array(tail.response);
    if (tail.status === 200) {
      this.bytes = data;
      this.size = data.length;
      return;
    }
    const range = tail.getResponseHeader("Content-Range")?.match(/(\d+)-(\d+)\/(\d+)/);
    this.size = Number(range ? range[3] : asked("HEAD", this.url).getResponseHeader("Content-Length"));
    if (!(this.size >= data.length && this.size > 0)) throw new Error("the server does not say how large the file is");
    this.keep(Math.max(this.count - TAIL, 0), data);
  }

  /** Number of blocks. */
  get count() {
    return Math.ceil(this.size / BLOCK);
  }

  /** First byte of a block; that of the first one may lie before the file. */
  start(n) {
    return n * BLOCK - (this.count * BLOCK - this.size);
  }

  /** Keep bytes that begin with block n and end with a block. */
  keep(n, data) {
    for (let at = Math.max(this.start(n), 0), from = at; at - from < data.length; n++) {
      const stop = this.start(n + 1);
      this.blocks.set(n, data.slice(at - from, stop - from));
      at = stop;
    }
  }

  ask(range) {
    const request = asked("GET", this.url, range);
    postMessage({ loaded: request.response.byteLength, requests: 1 });
    return request;
  }

  /** Bytes from `offset` on; blocks that are missing are asked for in one request for each run of them. */
  read(offset, length, to) {
    if (offset < 0 || offset + length > this.size) throw new Error("the file ends before what it promises");
    if (this.bytes) return void to.set(this.bytes.subarray(offset, offset + length));
    const pad = this.count * BLOCK - this.size, first = Math.floor((offset + pad) / BLOCK), last = Math.floor((offset + pad + length - 1) / BLOCK);
    for (let n = first; n <= last; n++) {
      if (this.blocks.has(n)) continue;
      let stop = n + 1;
      while (stop <= last && !this.blocks.has(stop)) stop++;
      this.load(n, stop);
      if (this.bytes) return this.read(offset, length, to);
    }
    for (let n = first; n <= last; n++) {
      const block = this.blocks.get(n), begin = Math.max(this.start(n), 0), from = Math.max(offset - begin, 0);
      this.blocks.delete(n);
      this.blocks.set(n, block);
      to.set(block.subarray(from, Math.min(offset + length - begin, block.length)), begin + from - offset);
    }
    for (const n of this.blocks.keys()) {
      if (this.blocks.size <= Math.max(KEPT, last - first + 2)) break;
      this.blocks.delete(n);
    }
  }

  /** Load blocks n to stop; who reads on where the last request ended gets more at once. */
  load(n, stop) {
    this.ahead = n === this.end ? Math.min(2 * this.ahead, MOST_AHEAD) : 1;
    while (stop < Math.min(n + this.ahead, this.count) && !this.blocks.has(stop)) stop++;
    this.end = stop;
    const from = Math.max(this.start(n), 0), end = this.start(stop);
    let data;
    if (this.blob) {
      data = new Uint8Array(new FileReaderSync().readAsArrayBuffer(this.blob.slice(from, end)));
      postMessage({ loaded: data.length, requests: 0 });
    } else {
      const part = this.ask(`bytes=${from}-${end - 1}`);
      data = new Uint8Array(part.response);
      if (part.status === 200) { // a server without ranges
        this.bytes = data;
        return;
      }
    }
    if (data.length !== end - from) throw new Error("the server sent other bytes than were asked for; the file may have changed");
    this.keep(n, data);
  }
}

async function load(module) {
  const imports = {};
  for (const { module: from, name, kind } of WebAssembly.Module.imports(module)) {
    if (kind === "function") (imports[from] ??= {})[name] = () => 52; // what a page has not: files of a system, a clock
  }
  imports.fhash = {
    read(_, offset, length, at) {
      try {
        source.read(offset, length, new Uint8Array(library.memory.buffer, at, length));
        return 0;
      } catch (error) {
        reason = error.message;
        return 1;
      }
    },
  };
  imports.fhash.prior = (number, size) => {
    priors[number] ??= asked("GET", new URL(PRIORS[number], location.href)).response;
    const bytes = new Uint8Array(priors[number]), at = library.malloc(bytes.length);
    new Uint8Array(library.memory.buffer).set(bytes, at);
    view().setUint32(size, bytes.length, true);
    return at;
  };
  const instance = await WebAssembly.instantiate(module, imports);
  instance.exports._initialize?.();
  return instance.exports;
}

const view = () => new DataView(library.memory.buffer);

function text(at) {
  const bytes = new Uint8Array(library.memory.buffer);
  return at ? new TextDecoder().decode(bytes.subarray(at, bytes.indexOf(0, at))) : "";
}

/** Room of the library for the time of a call. */
function within(sizes, work) {
  const places = sizes.map((size) => library.malloc(Math.max(size, 8)));
  try {
    if (places.includes(0)) throw new Error("there is not enough memory in this browser");
    return work(...places);
  } finally {
    places.forEach((at) => library.free(at));
  }
}

/** Call a function of fhash.h that takes an error last; throws its text. */
function call(name, ...words) {
  return within([504], (error) => {
    reason = "";
    if (library[name](...words, error) !== 0) throw new Error(reason || text(error + 4) || "the file cannot be read");
  });
}

const numbers = (at, count) => Array.from({ length: count }, (_, n) => Number(view().getBigInt64(at + 8 * n, true)));

function parsed(at) {
  try {
    return JSON.parse(text(at) || "{}");
  } catch {
    return {};
  }
}

/** Facts about a variable: fhash_variable of fhash.h, whose places are those of wasm32. */
function variable(number) {
  const size = 176;
  return within([size], (at) => {
    view().setUint32(at, size, true);
    call("fhash_variable_get", file, number, at);
    const now = view(), double = (place) => now.getFloat64(at + place, true);
    return {
      name: text(now.getUint32(at + 4, true)), units: text(now.getUint32(at + 8, true)), attributes: parsed(now.getUint32(at + 12, true)),
      type: now.getInt32(at + 16, true), levels: now.getInt32(at + 20, true), shape: numbers(at + 24, 4), tile: numbers(at + 56, 4),
      box: numbers(at + 88, 6), low: double(136), high: double(144), background: double(152), maxError: double(160), psnr: double(168),
    };
  });
}

/** The coordinates along t, z, y, x: name, values and attributes. */
function coordinates(number, shape) {
  return shape.map((length, axis) => within([8 * length, 4], (at, attributes) => {
    call("fhash_coordinate", file, number, axis, at, attributes);
    const about = parsed(view().getUint32(attributes, true));
    return { name: about.name ?? "tzyx"[axis], attributes: about.attributes ?? {}, values: Array.from(new Float64Array(library.memory.buffer, at, length)) };
  }));
}

/** A frame: the vertices of the box whose indices are multiples of 2^lod, and the extremes of its bricks. */
function frame({ number, step, lod, box, smoothing, error }) {
  const stride = 2 ** lod, ends = [0, 2, 4].map((n) => [Math.ceil(box[n] / stride), Math.floor((box[n + 1] - 1) / stride) + 1]);
  const shape = ends.map(([low, stop]) => stop - low), count = shape[0] * shape[1] * shape[2];
  const begin = performance.now();
  const values = within([4 * count, 48], (at, region) => {
    box.forEach((one, n) => view().setBigInt64(region + 8 * n, BigInt(one), true));
    call("fhash_read", file, number, step, region, lod, FLOAT32, at);
    return new Float32Array(library.memory.buffer, at, count).slice();
  });
  const result = { values, shape, first: ends.map(([low]) => low * stride).reverse(), stride, ms: performance.now() - begin, ...extremes(values, shape) };
  if (smoothing) result.smoothed = smoothed(values, shape, smoothing, error);
  return result;
}

/** Least and largest value of each brick of SIDE cells along a side, which share the vertices of their faces. */
function extremes(values, [nz, ny, nx]) {
  const bricks = [nz, ny, nx].map((n) => Math.max(Math.ceil((n - 1) / SIDE), 1)), [mz, my, mx] = bricks;
  const brickLow = new Float32Array(mz * my * mx).fill(Infinity), brickHigh = new Float32Array(mz * my * mx).fill(-Infinity);
  const lower = new Float32Array(mx), higher = new Float32Array(mx);
  let holes = 0;
  for (let z = 0, at = 0; z < nz; z++) {
    for (let y = 0; y < ny; y++) {
      lower.fill(Infinity);
      higher.fill(-Infinity);
      for (let x = 0; x < nx; x++, at++) {
        const value = values[at];
        if (value !== value) { holes++; continue; }
        const b = Math.min(Math.floor(x / SIDE), mx - 1);
        if (value < lower[b]) lower[b] = value;
        if (value > higher[b]) higher[b] = value;
        if (x % SIDE === 0 && x > 0 && b > 0) {
          const c = Math.floor(x / SIDE) - 1;
          if (value < lower[c]) lower[c] = value;
          if (value > higher[c]) higher[c] = value;
        }
      }
      for (const bz of sharing(z, mz)) {
        for (const by of sharing(y, my)) {
          for (let b = 0, n = (bz * my + by) * mx; b < mx; b++, n++) {
            if (lower[b] < brickLow[n]) brickLow[n] = lower[b];
            if (higher[b] > brickHigh[n]) brickHigh[n] = higher[b];
          }
        }
      }
    }
  }
  return { bricks, brickLow, brickHigh, holes };
}

/** Numbers of the bricks along an axis that have a vertex. */
function sharing(at, count) {
  const own = Math.min(Math.floor(at / SIDE), count - 1);
  return at % SIDE === 0 && at > 0 && at / SIDE - 1 < own ? [own - 1, own] : [own];
}

/** Values smoothed by a Gaussian, within `error` of their own: what lossy files are shaded by (rendering/bricks.py). */
function smoothed(values, shape, deviation, error) {
  const radius = Math.ceil(3 * deviation), weights = Array.from({ length: radius + 1 }, (_, n) => Math.exp(-0.5 * (n / deviation) ** 2));
  const sum = weights.reduce((all, one, n) => all + (n ? 2 * one : one), 0);
  let from = values;
  [[1, shape[2]], [shape[2], shape[1]], [shape[2] * shape[1], shape[0]]].forEach(([stride, length]) => {
    const to = new Float32Array(values.length);
    for (let at = 0; at < values.length; at++) {
      const here = from[at], place = Math.floor(at / stride) % length;
      let all = weights[0] * here;
      for (let n = 1; n <= radius; n++) {
        const pair = place >= n && place + n < length ? from[at - n * stride] + from[at + n * stride] : NaN;
        all += weights[n] * (pair === pair ? pair : 2 * here);
      }
      to[at] = all / sum;
    }
    from = to;
  });
  for (let at = 0; at < values.length; at++) from[at] = Math.min(Math.max(from[at], values[at] - error), values[at] + error);
  return from;
}

const work = {
  async open({ wasm, ...given }) {
    priors = given.priors ?? [];
    library ??= await load(wasm);
    source = new Source(given);
    const context = library.fhash_context_create(0n, 1);
    within([4], (at) => {
      call("fhash_open_page", context, 0, source.size, at);
      file = view().getUint32(at, true);
    });
    const count = library.fhash_variables(file);
    return { header: parsed(library.fhash_header(file)), variables: Array.from({ length: count }, (_, n) => variable(n)), size: source.size, blocks: [...source.blocks] };
  },
  coordinates: ({ number, shape }) => coordinates(number, shape),
  frame,
};

onmessage = async ({ data: { id, name, given } }) => {
  try {
    const result = await work[name](given);
    const moved = [result.values, result.smoothed, result.brickLow, result.brickHigh].flatMap((one) => (one?.buffer ? [one.buffer] : []));
    postMessage({ id, result }, moved);
  } catch (error) {
    const full = error instanceof WebAssembly.RuntimeError || error instanceof RangeError;
    postMessage({ id, fatal: name === "frame", error: full ? "there is not enough memory in this browser for it" : error.message });
  }
};
