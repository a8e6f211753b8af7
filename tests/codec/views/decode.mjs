// Digests of the values that fhash.wasm reads of containers: node decode.mjs FHASH.wasm PRIORS RUN.fhz...
// With --values in place of the first container: the values of all steps of the next, float64.
import { createHash } from "node:crypto";
import { readFileSync, writeSync } from "node:fs";
import { join } from "node:path";

const [wasm, priors, ...runs] = process.argv.slice(2);
const module = new WebAssembly.Module(readFileSync(wasm));
const imports = {};
let data = null, library = null;

for (const { module: from, name } of WebAssembly.Module.imports(module)) (imports[from] ??= {})[name] = () => 52;
imports.fhash = {
  read(_, offset, length, at) {
    new Uint8Array(library.memory.buffer, at, length).set(data.subarray(offset, offset + length));
    return 0;
  },
  prior(number, size) {
    const bytes = readFileSync(join(priors, ["prior.bin", "mask_prior.bin", "fast_prior.bin"][number])), at = library.malloc(bytes.length);
    new Uint8Array(library.memory.buffer).set(bytes, at);
    new DataView(library.memory.buffer).setUint32(size, bytes.length, true);
    return at;
  },
};
library = new WebAssembly.Instance(module, imports).exports;
library._initialize?.();
const view = () => new DataView(library.memory.buffer);
const error = library.malloc(504), place = library.malloc(176);

function call(status) {
  const bytes = new Uint8Array(library.memory.buffer);
  if (status) throw new Error(new TextDecoder().decode(bytes.subarray(error + 4, bytes.indexOf(0, error + 4))));
}

/** A step of a variable at a level of detail, as float64 with one kind of NaN. */
function read(file, number, step, lod, shape) {
  const count = shape.slice(1).reduce((product, n) => product * Math.ceil(n / 2 ** lod), 1), at = library.malloc(8 * count);
  call(library.fhash_read(file, number, step, 0, lod, 11, at, error));
  const values = new Float64Array(library.memory.buffer, at, count).map((one) => (Number.isNaN(one) ? NaN : one));
  library.free(at);
  return values;
}

const whole = runs[0] === "--values" && runs.shift();

const found = {};
for (const run of runs) {
  data = readFileSync(run);
  const context = library.fhash_context_create(0n, 1), each = (found[run] = []);
  call(library.fhash_open_page(context, 0, data.length, place, error));
  const file = view().getUint32(place, true);
  for (let number = 0; number < library.fhash_variables(file); number++) {
    view().setUint32(place, 176, true);
    call(library.fhash_variable_get(file, number, place, error));
    const levels = view().getInt32(place + 20, true), shape = [0, 1, 2, 3].map((n) => Number(view().getBigInt64(place + 24 + 8 * n, true)));
    if (whole) for (let step = 0; step < shape[0]; step++) writeSync(1, read(file, number, step, 0, shape));
    else for (const step of new Set([0, shape[0] - 1, (shape[0] - 1) / 2])) {
      for (const lod of new Set([0, Math.min(levels, 1)])) each.push([number, step, lod, createHash("sha256").update(read(file, number, step, lod, shape)).digest("hex")]);
    }
  }
  library.fhash_close(file);
  library.fhash_context_destroy(context);
}
if (!whole) console.log(JSON.stringify(found));
