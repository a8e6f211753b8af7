// Turn, move and zoom by mouse, touch and keys.
import { add, raysOf, times } from "./camera.js";
import { app, commands, draw, drop, element, go, play, setMode } from "./app.js";

const camera = () => (app.scene.camera ??= {});

/** Turn the camera by degrees around the upward direction, and let it rise. */
export function turn(azimuth, elevation) {
  const own = camera();
  own.azimuth = ((own.azimuth ?? 0) + azimuth) % 360;
  own.elevation = Math.min(Math.max((own.elevation ?? 0) + elevation, -90), 90);
  draw(true);
}

/** Move the picture by shares of its height. */
export function move(right, up) {
  const stage = element("stage"), rays = raysOf(camera(), app.grid, [stage.clientWidth, stage.clientHeight]), own = camera();
  const size = 2 * rays.half * (rays.parallel ? 1 : rays.distance), { axes } = rays;
  const shift = add(times(axes.right, -right * size), axes.up, -up * size);
  own.focal_point = add(rays.focal, shift);
  if (own.position) own.position = add(own.position, shift);
  draw(true);
}

export function zoom(factor) {
  const own = camera();
  own.zoom = Math.min(Math.max((own.zoom ?? 1) * factor, 1e-3), 1e6);
  draw(true);
}

/** Look from a direction by name; the zoom stays. */
export function view(name) {
  app.scene.camera = { ...(name ? { view: name, zoom: camera().zoom ?? 1 } : {}), ...(camera().projection ? { projection: camera().projection } : {}) };
  draw();
}

/** Listen on a canvas, and to the keys of the page. */
export function pointers(canvas) {
  const held = new Map();
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => held.delete(event.pointerId);
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.onpointermove = (event) => {
    const last = held.get(event.pointerId), height = canvas.clientHeight;
    if (!last || !app.frame) return;
    const others = [...held.entries()].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const by = [event.clientX - last[0], event.clientY - last[1]];
    if (others.length) {
      const apart = (at) => Math.hypot(at[0] - others[0][0], at[1] - others[0][1]);
      zoom(Math.max(apart([event.clientX, event.clientY]), 1) / Math.max(apart(last), 1));
      move(by[0] / 2 / height, -by[1] / 2 / height);
    } else if (event.shiftKey || event.buttons & 6) move(by[0] / height, -by[1] / height);
    else turn((-180 * by[0]) / height, (180 * by[1]) / height);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (app.frame) zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
  }, { passive: false });
  addEventListener("keydown", key);
  addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer.files[0]) drop(event.dataTransfer.files[0]);
  });
}

const VIEWS = ["iso", "xy", "yx", "xz", "zx", "yz", "zy"];

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) || document.querySelector("dialog[open]")) return;
  const always = { h: commands.help, "?": commands.help, o: commands.open, d: commands.theme };
  const turned = { ArrowLeft: [5, 0], ArrowRight: [-5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }[event.key];
  const loaded = {
    " ": () => play(), ",": () => go(Math.ceil(app.step) - 1), ".": () => go(Math.floor(app.step) + 1), "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15),
    v: () => setMode(app.mode === "volume" ? "slices" : "volume"), p: commands.shot, s: commands.saveScene, l: commands.link, 0: () => view(""),
  };
  const work = always[event.key] ?? (app.frame && (turned ? () => turn(...turned) : VIEWS[event.key - 1] ? () => view(VIEWS[event.key - 1]) : loaded[event.key]));
  if (!work || (event.key === " " && event.target.tagName === "BUTTON")) return;
  event.preventDefault();
  work();
}
