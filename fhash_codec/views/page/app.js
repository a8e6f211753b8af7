// The page: what is shown, and when it is drawn.
import { parseColour } from "./colours.js";
import { gridOf } from "./camera.js";
import { Container, histogram, structure } from "./data.js";
import { controls } from "./controls.js";
import { clipped, functionOf, look, smoothingOf, undrawn } from "./look.js";
import { Marcher } from "./marcher.js";
import { axisName, drawBefore, drawBehind, inkOn } from "./overlay.js";
import { parseFeature } from "./transfer.js";
import { pointers } from "./pointer.js";
import { readFile, saveBlob, sceneFile, stateOfHash, hashOf, pictureWithScene } from "./files.js";
import { Slices } from "./slices.js";
import { timeText } from "./times.js";

const COARSE = 2 ** 16;
const MOST_VERTICES = 2 ** 26;
const BINS = 512;
const COUNTED = 2 ** 18;
const GLANCE = 2 ** 15;
const MOST_COUNTED = 16 * 2 ** 20; // bytes of files of which more is read than what is shown
const MOST_PIXELS = 2 ** 22;
const BAND_MS = 40;
const EARLY_MS = 400; // after which slices stand for a volume of which there is no picture yet

export const element = (id) => document.getElementById(id);

export const app = {
  container: null, number: 0, step: 0, playing: false, mode: "volume", early: false, drawn: false, scene: {}, frame: null, grid: null, tf: null, counts: null,
  features: [], marcher: null, scale: 0.5, fps: 0, moving: 0, wanted: 0, fixedSize: null,
};

const files = JSON.parse(element("files").textContent);
let compiled = null;
const wasm = () => (compiled ??= (async () => WebAssembly.compile(app.wasm ?? (await (await fetch(new URL("fhash.wasm", import.meta.url))).arrayBuffer())))());

export const variable = () => app.container.variables[app.number];
export const effects = () => (app.scene.effects ??= {});
export const transfer = () => (app.scene.transfer_function ??= {});

/** Show a line to the user; nothing where the text is empty. lasting: until another one comes. */
export function say(text, lasting = false) {
  const box = element("message");
  box.textContent = text;
  box.hidden = !text;
  box.classList.toggle("empty", !app.container);
  clearTimeout(say.timer);
  if (text && !lasting) say.timer = setTimeout(() => say(""), 6000);
}

/** Background of the picture as '#rrggbb'. */
export function background() {
  const given = app.scene.background;
  if (given && given !== "transparent" && parseColour(given)) return given;
  return document.documentElement.classList.contains("dark") ? "#14171c" : "#ffffff";
}

/** Open a container: `{url}` or `{blob}`, with a name; `state` is what a link said. */
export async function open(source, name, state = {}) {
  app.container?.close();
  Object.assign(app, { container: null, frame: null, tf: null, counts: null, early: false, drawn: false, playing: false, step: 0, number: 0, scene: {}, name });
  say("");
  element("busy").hidden = false;
  const made = new Container(source, { wasm, changed: status });
  try {
    await made.open();
    if (!made.variables.length) throw new Error("it holds no variable");
    app.container = made;
    const number = made.variables.findIndex((one) => one.name === state.variable);
    document.title = `${name} - fhash view`;
    element("title").textContent = name;
    await choose(Math.max(number, 0), state.scene ?? {}, state);
  } catch (error) {
    made.close();
    element("busy").hidden = true;
    app.container = null;
    app.marcher?.clear();
    say(`${name}: ${error.message}`, true);
    panel.fill();
  }
}

/** Facts about the header of a variable: its features, and whether a bound was promised. */
function headed(number) {
  const { variables } = app.container.header, each = Array.isArray(variables) ? variables[number] : Object.values(variables ?? {})[number];
  return each ?? {};
}

/** Show a variable, by a scene. */
export async function choose(number, scene, state = {}) {
  const about = await app.container.prepare(number), header = headed(number);
  about.bounded = header.config?.max_error != null || header.config?.max_error_rel != null;
  about.features = (header.features ?? []).filter((text) => parseFeature(text));
  Object.assign(app, { number, frame: null, tf: null, counts: null });
  setScene(scene);
  if (state.mode) setMode(state.mode);
  slices.place = state.place ?? null;
  panel.fill();
  clearTimeout(choose.late);
  if (!state.mode) choose.late = setTimeout(() => setEarly(true), EARLY_MS);
  await show();
  if (scene.step == null && scene.time == null) await fullest();
}

/** Go to the step of most structure of five, as `fhash render` does where none is named. */
async function fullest() {
  const { number, container } = app, about = variable(), { box } = about, last = about.shape[0] - 1;
  if (!last || !app.tf || app.step || app.playing || container.about.size > MOST_COUNTED) return;
  let lod = 0, most = 0, best = 0;
  while (lod < about.levels && ((box[1] - box[0]) * (box[3] - box[2]) * (box[5] - box[4])) / 8 ** lod > GLANCE) lod++;
  for (const step of new Set([0, 1, 2, 3, 4].map((part) => Math.floor((2 * last * part + 4) / 8)))) {
    const found = structure(await container.frame({ number, step, lod, smoothing: 0 }), app.tf, app.scene.effects?.isosurfaces ?? []);
    if (found > most * (1 + 1e-6)) [most, best] = [found, step];
  }
  if (best && container === app.container && number === app.number && !app.step && !app.playing) await go(best);
}

/** Take over a scene of `fhash render`, with its time. */
export function setScene(scene) {
  const about = variable(), last = about.shape[0] - 1;
  app.scene = scene;
  const wanted = (scene.features ?? []).filter((text) => about.features.includes(text));
  app.features = wanted.length ? wanted : [...about.features];
  if (!scene.effects) app.scene.effects = { shading: { ambient: 0.5, diffuse: 0.6 }, box: true, axes: true, colour_bar: true, time_label: last > 0 };
  app.grid = gridOf([3, 2, 1].map((axis) => about.coords[axis]), scene.scale ?? undefined);
  app.marcher?.setPlaces(app.grid.places);
  let step = scene.step ?? 0;
  if (scene.time != null) {
    const { values } = about.coords[0], n = Math.max(values.findIndex((one, k) => one <= scene.time && scene.time <= (values[k + 1] ?? one)), 0);
    step = n + (n < last ? (scene.time - values[n]) / (values[n + 1] - values[n]) : 0);
  }
  app.step = Math.min(Math.max(step, 0), last);
  const missing = undrawn(scene);
  const notes = [...app.grid.notes, ...(missing.length ? [`not drawn here: ${missing.join(", ")}`] : [])];
  if (notes.length) say(notes.join("; "));
}

/** The finest level of detail that this browser draws, and one that is quick to read. */
function levels() {
  const { box, levels: most } = variable(), sides = [1, 3, 5].map((n) => box[n] - box[n - 1]);
  const count = (lod) => sides.reduce((product, side) => product * Math.ceil(side / 2 ** lod), 1);
  let fine = 0;
  const largest = app.marcher?.largest ?? Infinity;
  while (fine < most && (count(fine) > MOST_VERTICES || Math.max(...sides) / 2 ** fine > largest)) fine++;
  let coarse = fine;
  while (coarse < most && count(coarse) > COARSE) coarse++;
  fine = Math.min(Math.max(app.scene.march?.lod ?? fine, fine), Math.max(most, fine));
  return { fine, coarse: Math.max(coarse, fine) };
}

/** Count the values of the first, middle and last step, as `fhash render` does where it chooses the opacity. */
async function count() {
  const { number, container } = app, about = variable(), { box } = about, last = about.shape[0] - 1, { opacity = "auto", range } = app.scene.transfer_function ?? {};
  if (app.counts.whole || (range && !["auto", "feature"].includes(opacity)) || about.features.length || container.about.size > MOST_COUNTED) return;
  app.counts.whole = true;
  let lod = 0;
  while (lod < about.levels && ((box[1] - box[0]) * (box[3] - box[2]) * (box[5] - box[4])) / 8 ** lod > COUNTED) lod++;
  const frames = [];
  for (const step of new Set([0, Math.floor(last / 2), last])) frames.push(await container.frame({ number, step, lod, smoothing: 0 }));
  if (container !== app.container || number !== app.number) return;
  app.counts = Object.assign(histogram(frames, [about.low, about.high], BINS), { lod: 0, whole: true });
  restyle();
}

/** Read what is to be shown, the coarse level first where nothing is there yet, and show it. */
export async function show() {
  const wanted = ++app.wanted, { fine, coarse } = levels(), about = variable();
  const ask = (step, lod) => ({ number: app.number, step, lod, smoothing: smoothing() });
  element("busy").hidden = Boolean(app.container.kept(ask(app.step, fine)));
  try {
    if (!app.frame && coarse > fine) {
      const first = await app.container.frame({ ...ask(app.step, coarse), smoothing: 0 });
      if (wanted !== app.wanted) return;
      take(first);
    }
    let frame = await app.container.frame(ask(app.step, fine));
    if (wanted !== app.wanted) return;
    take(frame);
    if (smoothing() && !frame.smoothed) {
      frame = await app.container.frame(ask(app.step, fine));
      if (wanted === app.wanted) take(frame);
    }
    await count();
    for (let n = 1; n <= 4 && app.playing; n++) app.container.ahead(ask(next(n), fine));
  } catch (error) {
    if (wanted !== app.wanted) return;
    app.playing = false;
    say(`${app.name}: ${error.message}`, true);
  }
  element("busy").hidden = !app.early;
  panel.time();
}

/** The step after `n` pictures of playing. */
function next(n) {
  const last = variable().shape[0] - 1, stride = element("between").checked ? 0.25 : 1;
  const step = app.step + n * stride;
  return step <= last ? step : step - last - (stride === 1 ? 1 : 0) < 0 ? 0 : Math.min(step - last - (stride === 1 ? 1 : 0), last);
}

const smoothing = () => (app.tf && (app.mode === "volume" || app.early) && app.marcher ? smoothingOf(app.scene, app.grid, variable(), app.tf).deviation : 0);

/** Draw a frame from now on. */
function take(frame) {
  const about = variable();
  app.frame = frame;
  if (!app.counts || (app.counts.lod > frame.lod && !app.counts.whole)) {
    app.counts = histogram([frame], [about.low, about.high], BINS);
    app.counts.lod = frame.lod;
  }
  if (app.marcher) app.marcher.setFrame(frame);
  restyle();
}

/** Take over changes of colours and opacities. */
export function restyle() {
  if (!app.frame) return;
  const about = variable();
  app.tf = functionOf(app.scene, app.grid, about, app.features.length < about.features.length || app.features.length ? app.features : [], app.counts);
  panel.restyled();
  draw();
  if (smoothing() && !app.frame.smoothed && !show.queued) {
    show.queued = setTimeout(() => { show.queued = 0; show(); }, 300);
  }
}

/** Draw soon; `moving` says that more pictures follow at once. */
export function draw(moving = false) {
  if (moving) app.moving = performance.now();
  app.dirty = true;
  app.refining = null;
  app.ticking ??= requestAnimationFrame(tick);
}

function tick() {
  app.ticking = null;
  if (!app.frame) return;
  if (app.mode === "slices") {
    if (app.dirty) slices.show({ frame: app.frame, grid: app.grid, coords: spatial(), tf: app.tf, units: variable().units, background: parseColour(background()) });
    status();
    if (!app.early) app.dirty = false;
  }
  if (!app.marcher || app.marcher.lost || (app.mode === "slices" && !app.early)) return;
  const again = () => { app.ticking = requestAnimationFrame(tick); };
  if (app.marcher.busy()) return again(); // one picture at a time, or they would pile up
  app.measured?.(performance.now() - app.submitted);
  app.measured = null;
  const still = performance.now() - app.moving > 150 && !app.playing && !app.early;
  if (app.dirty) {
    surround();
    if (!still) quick();
    app.sharp = app.dirty = false;
  } else if (still && !app.sharp) {
    app.refining ??= refinement();
    if (app.refining.next().done) app.refining = null;
  }
  status();
  if (!app.sharp || app.measured) again();
}

/** Note when work was handed to the graphics card; `measured` is told how long it took. */
function submitted(begin, measured) {
  app.submitted = begin;
  app.measured = measured;
  app.marcher.mind();
}

const spatial = () => [3, 2, 1].map((axis) => variable().coords[axis]);

/** Pixels of the stage. */
function pixels() {
  if (app.fixedSize) return app.fixedSize;
  const stage = element("stage"), dense = Math.min(devicePixelRatio, 2), area = stage.clientWidth * stage.clientHeight * dense ** 2;
  const scale = dense * Math.min(1, Math.sqrt(MOST_PIXELS / Math.max(area, 1)));
  return [stage.clientWidth, stage.clientHeight].map((side) => Math.max(1, Math.round(side * scale)));
}

function sized(canvas, [width, height]) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
}

/** Pixels of the part of a picture that shows the volume: the colour bar stands beside it. */
function viewed([width, height]) {
  const stage = element("stage").clientWidth, bar = effects().colour_bar && !app.fixedSize ? (84 * width) / Math.max(stage, 1) : 0;
  return [Math.max(width - bar, width / 2), height];
}

function looked(whole, coarse) {
  const size = viewed(whole);
  const { camera = {} } = app.scene, narrower = effects().axes && !app.fixedSize ? (size[0] < size[1] ? 0.82 : 0.9) : 1; // room for the scales
  return look({ scene: { ...app.scene, camera: { ...camera, zoom: (camera.zoom ?? 1) * narrower } }, grid: app.grid, about: variable(), tf: app.tf, frame: app.frame, size, coarse, entries: app.marcher.entries });
}

/** Draw box, scales, colour bar and time. */
function surround() {
  const size = pixels(), about = variable(), paper = background();
  for (const id of ["behind", "before"]) sized(element(id), size);
  const { rays } = looked(size, 1), unitPixel = size[0] / Math.max(element("stage").clientWidth, 1);
  const given = {
    rays, box: clipped(app.scene, app.grid), effects: effects(), ink: inkOn(parseColour(paper)), unitPixel, grid: app.grid, coords: spatial(), tf: app.tf,
    background: app.scene.background === "transparent" ? null : paper, quantity: axisName({ name: about.name, attributes: { units: about.units } }),
    time: about.shape[0] > 1 ? timeText(about.coords[0], app.step) : "",
  };
  drawBehind(element("behind").getContext("2d"), given);
  drawBefore(element("before").getContext("2d"), given);
}

/** Prepare the marcher for a picture; false where nothing is left to see. */
function prepare(size, coarse) {
  const given = looked(size, coarse), { marcher } = app;
  marcher.mark(app.tf, given.levels, given.everything);
  marcher.setTable(given.table);
  return given;
}

/** A picture of few pixels and long steps, while things move. */
function quick() {
  const full = pixels(), size = full.map((side) => Math.max(1, Math.round(side * app.scale))), begin = performance.now();
  const given = prepare(size, 2);
  sized(app.marcher.canvas, size);
  app.marcher.rows(given.uniforms, ...size, 0, size[1]);
  app.marcher.show();
  submitted(begin, (ms) => {
    app.fps = 1000 / ms;
    there();
    app.scale = Math.min(Math.max(app.scale * Math.sqrt(Math.min(Math.max(50 / ms, 0.4), 1.3)), 0.25), 1);
  });
}

/** The picture as it should be, in bands of rows, so that the page stays awake. */
function* refinement() {
  const size = pixels(), given = prepare(size, 1);
  app.band ??= Math.max(8, Math.round(size[1] / 16));
  for (let row = 0; row < size[1];) {
    const stop = Math.min(row + app.band, size[1]), rows = stop - row, begin = performance.now();
    app.marcher.rows(given.uniforms, ...size, row, stop);
    submitted(begin, (ms) => { app.band = Math.max(4, Math.round(rows * Math.min(Math.max(BAND_MS / ms, 0.3), 3))); });
    row = stop;
    if (row < size[1]) yield;
  }
  sized(app.marcher.canvas, size);
  app.marcher.show();
  app.sharp = true;
  there();
  document.documentElement.dataset.drawn = Number(document.documentElement.dataset.drawn ?? 0) + 1;
}

/** Tell bytes, requests and level of detail. */
export function status() {
  const { container, frame } = app;
  if (!container) return;
  const parts = [`${bytes(container.loaded)} of ${bytes(container.about.size)} in ${container.requests} requests`];
  if (frame?.lod) parts.push(`every ${2 ** frame.lod}th vertex`);
  if (app.fps && app.mode === "volume") parts.push(`${app.fps.toFixed(0)} pictures/s`);
  element("status").textContent = parts.join(", ");
}

/** A number of bytes as people write it. */
export const bytes = (n) => (n < 1e4 ? `${n} B` : n < 1e7 ? `${(n / 1e3).toFixed(0)} kB` : `${(n / 1e6).toFixed(1)} MB`);

/** Show slices until there is a picture of the volume, or show the volume. */
function setEarly(on) {
  if (on && (app.drawn || !app.marcher || app.mode !== "volume")) return;
  if (on && !app.frame) { // nothing is decoded yet
    choose.late = setTimeout(() => setEarly(true), EARLY_MS);
    return;
  }
  setMode(on ? "slices" : "volume");
  app.early = on;
  if (on && app.container) Object.assign(element("busy"), { textContent: "drawing the volume", hidden: false });
  else Object.assign(element("busy"), { textContent: "decoding", hidden: true });
}

/** There is a picture of the volume. */
function there() {
  app.drawn = true;
  if (app.early) setEarly(false);
}

/** Show the volume or the slices. */
export function setMode(mode) {
  app.early = false;
  app.mode = app.marcher ? mode : "slices";
  for (const id of ["behind", "volume", "before"]) element(id).hidden = app.mode === "slices";
  element("slices").hidden = app.mode !== "slices";
  element("stage").classList.toggle("sliced", app.mode === "slices");
  element("volumeTab").setAttribute("aria-pressed", app.mode === "volume");
  element("slicesTab").setAttribute("aria-pressed", app.mode === "slices");
  element("told").textContent = "";
  draw();
}

/** Go to a step, between two of them too. */
export function go(step) {
  const last = variable().shape[0] - 1;
  app.step = Math.min(Math.max(step, 0), last);
  panel.time();
  return show();
}

/** Begin to play, or end. */
export function play(on = !app.playing) {
  app.playing = on && variable().shape[0] > 1;
  panel.time();
  if (app.playing) playOn();
  else draw();
}

async function playOn() {
  while (app.playing) {
    const begin = performance.now(), pace = 1000 / Number(element("speed").value) * (element("between").checked ? 0.25 : 1);
    await go(next(1));
    await new Promise((resolve) => setTimeout(resolve, Math.max(pace - (performance.now() - begin), 4)));
  }
}

/** What a link or a saved scene holds. */
export function sceneNow() {
  const scene = structuredClone(app.scene);
  delete scene.time;
  scene.step = app.step;
  scene.background ??= background();
  if (app.features.length && app.features.length < variable().features.length) scene.features = app.features;
  else delete scene.features;
  scene.transfer_function = { ...scene.transfer_function, opacity: app.tf ? app.tf.points : scene.transfer_function?.opacity ?? "auto" };
  return scene;
}

const stateNow = () => ({ file: files[app.fileNumber]?.name ?? (app.url || undefined), variable: variable().name, mode: app.mode, place: slices.place, scene: sceneNow() });

/** The picture as a canvas, with everything around it. */
export function picture() {
  const result = document.createElement("canvas"), [width, height] = pixels();
  Object.assign(result, { width, height });
  const context = result.getContext("2d");
  for (const id of ["behind", "volume", "before"]) context.drawImage(element(id), 0, 0, width, height);
  return result;
}

export const commands = {
  open: () => element("opener").showModal(),
  help: () => element("helper").showModal(),
  async shot() {
    if (!app.frame) return;
    if (app.mode === "slices") return say("A picture is of the volume; show it first.");
    surround();
    for (const part of refinement()) void part;
    saveBlob(await pictureWithScene(picture(), { ...sceneNow(), size: pixels() }), app.name.replace(/\.fhz$/, "") + ".png");
  },
  saveScene() {
    if (app.frame) saveBlob(sceneFile({ ...sceneNow(), size: pixels() }), app.name.replace(/\.fhz$/, "") + ".json");
  },
  async link() {
    if (!app.frame) return;
    history.replaceState(null, "", hashOf(stateNow()));
    try {
      await navigator.clipboard.writeText(location.href);
      say("The link is copied.");
    } catch {
      say("The link stands in the address bar.");
    }
  },
  theme() {
    const dark = document.documentElement.classList.toggle("dark");
    try {
      localStorage.setItem("fhash-theme", dark ? "dark" : "light");
    } catch {
      // kept for this page alone
    }
    panel.fill();
    panel.resized();
    draw();
  },
};

/** Open what was dropped or picked: a container, a scene, or a picture that holds one. */
export async function drop(file) {
  try {
    const scene = await readFile(file);
    if (scene === null) return await open({ blob: file }, file.name);
    if (!app.container) throw new Error("a scene needs a container; open that first");
    setScene(scene);
    app.tf = null;
    panel.fill();
    await show();
    restyle();
  } catch (error) {
    say(`${file.name}: ${error.message}`, true);
  }
}

/** Open a URL, or a container of the server by its number. */
export function openUrl(url, state) {
  app.url = url;
  return open({ url: new URL(url, location.href).href }, decodeURIComponent(url.split(/[?#]/)[0].split("/").pop()) || url, state);
}

export function openFile(number, state) {
  app.fileNumber = number;
  element("file").value = number;
  return open({ url: new URL(files[number].url, location.href).href }, files[number].name, state);
}

const panel = controls(files);
const slices = new Slices(element("slices"), { changed: () => {}, told: (text) => { element("told").textContent = text; } });

function theme() {
  let kept = null;
  try {
    kept = localStorage.getItem("fhash-theme");
  } catch {
    // pages without storage follow the system
  }
  const dark = matchMedia("(prefers-color-scheme: dark)");
  document.documentElement.classList.toggle("dark", kept ? kept === "dark" : dark.matches);
  dark.addEventListener("change", () => {
    if (!kept) document.documentElement.classList.toggle("dark", dark.matches);
    panel.resized();
    draw();
  });
}

function start() {
  theme();
  try {
    if (new URLSearchParams(location.search).has("no-webgl")) throw new Error("no WebGL2");
    app.marcher = new Marcher(element("volume"));
    app.marcher.onRestored = () => { app.marcher.setPlaces(app.grid.places); take(app.frame); };
  } catch (error) {
    if (error.message !== "no WebGL2") say(error.message, true);
    element("volumeTab").disabled = true;
    element("volumeTab").title = "This browser has no WebGL2";
    setMode("slices");
  }
  pointers(element("before"));
  new ResizeObserver(() => { panel.resized(); draw(true); }).observe(element("stage"));
  const state = stateOfHash(location.hash), url = state.url ?? new URLSearchParams(location.search).get("url");
  const number = Math.max(files.findIndex((one) => one.name === state.file), 0);
  addEventListener("message", ({ data, source }) => {
    if (source !== parent || !data?.fhash) return;
    const { name, bytes: given, wasm: code, priors, script } = data.fhash;
    app.wasm = code;
    open({ blob: new Blob([given]), priors, script }, name);
  });
  if (url) openUrl(url, state);
  else if (state.file?.includes("/")) openUrl(state.file, state);
  else if (files.length) openFile(number, state);
  else if (parent !== window) parent.postMessage({ fhashReady: true }, "*");
  else say("Drop a container RUN.fhz here, or press Open.", true);
}

window.fhash = { app, picture, prepare, refinement, surround, draw, setScene, show, restyle, sceneNow, go, play, setMode };
start();
