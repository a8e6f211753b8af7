// The panel: what the user sets, and facts about the file.
import { MAPS, colourAt, colourCode, mapKey } from "./colours.js";
import { VIEWS, short } from "./camera.js";
import { app, background, bytes, choose, commands, draw, drop, effects, element, go, openFile, openUrl, play, restyle, setMode, transfer, variable } from "./app.js";
import { Editor } from "./editor.js";
import { view } from "./pointer.js";
import { PRESETS } from "./transfer.js";
import { timeText } from "./times.js";

function make(tag, given, ...children) {
  const made = Object.assign(document.createElement(tag), given);
  made.append(...children);
  return made;
}

/** Connect the panel; returns functions that bring it up to date. */
export function controls(files) {
  const editor = new Editor(element("editor"), (points) => { transfer().opacity = points; restyle(); });
  element("colours").append(...Object.keys(MAPS).map((name) => new Option(name)), new Option("of the scene", ""));
  element("opacity").append(...PRESETS.map((name) => new Option(name)), new Option("points", ""));
  element("file").append(...files.map(({ name }, n) => new Option(name, n)));
  element("file").hidden = files.length < 2;
  element("title").hidden = files.length > 1;
  element("views").append(...Object.keys(VIEWS).map((name) => make("button", { textContent: name, onclick: () => view(name) })),
    make("button", { textContent: "back", onclick: () => view("") }));
  for (const [id, work] of Object.entries({
    ...commands, volumeTab: () => setMode("volume"), slicesTab: () => setMode("slices"), play: () => play(),
    addSurface: () => { const about = variable(); (effects().isosurfaces ??= []).push({ value: (about.low + about.high) / 2 }); fill(); restyle(); },
    resetClip: () => { delete effects().clip; fill(); draw(); },
  })) element(id).onclick = () => (app.frame || commands[id] ? work() : undefined);
  const check = (id, name, defaults = true) => { element(id).onchange = ({ target }) => { effects()[name] = target.checked ? defaults : false; restyle(); }; };
  check("shading", "shading");
  check("maximum", "maximum_intensity");
  check("box", "box");
  check("axes", "axes");
  check("bar", "colour_bar");
  check("timeLabel", "time_label");
  element("noVolume").onchange = ({ target }) => { transfer().nothing = target.checked; restyle(); };
  const colours = () => { if (element("colours").value) transfer().colours = element("colours").value + (element("reversed").checked ? "_r" : ""); restyle(); };
  element("colours").onchange = element("reversed").onchange = colours;
  element("opacity").onchange = ({ target }) => { if (target.value) transfer().opacity = target.value; restyle(); };
  element("from").onchange = element("to").onchange = () => {
    const range = ["from", "to"].map((id) => Number(element(id).value));
    if (range[0] < range[1]) transfer().range = range;
    else delete transfer().range;
    restyle();
  };
  element("density").oninput = ({ target }) => { transfer().density = Number((10 ** target.value).toPrecision(3)); restyle(); };
  element("background").oninput = ({ target }) => { app.scene.background = target.value; draw(); };
  element("parallel").onchange = ({ target }) => { (app.scene.camera ??= {}).projection = target.checked ? "parallel" : "perspective"; draw(); };
  element("time").oninput = ({ target }) => { app.playing = false; go(Number(target.value)); };
  element("between").onchange = ({ target }) => { element("time").step = target.checked ? 0.05 : 1; if (!target.checked) go(Math.round(app.step)); };
  element("variable").onchange = ({ target }) => choose(Number(target.value), { camera: app.scene.camera, background: app.scene.background });
  element("file").onchange = ({ target }) => openFile(Number(target.value), {});
  element("pick").onchange = ({ target }) => { element("opener").close(); if (target.files[0]) drop(target.files[0]); target.value = ""; };
  element("goUrl").onclick = () => { if (element("url").value) openUrl(element("url").value, {}); };

  function surfaces() {
    const about = variable(), list = effects().isosurfaces ?? [];
    element("surfaces").replaceChildren(...list.map((one, n) => make("div", { className: "surface" },
      make("input", { type: "range", min: about.low, max: about.high, step: (about.high - about.low) / 400 || 1, value: one.value,
        oninput: ({ target }) => { one.value = Number(target.value); target.nextSibling.value = short(one.value, 4); draw(true); } }),
      make("output", { value: short(one.value, 4) }),
      make("input", { type: "color", value: colourOf(one), oninput: ({ target }) => { one.colour = target.value; draw(); } }),
      make("input", { type: "range", min: 0, max: 1, step: 0.05, value: one.opacity ?? 1, title: "Opacity", oninput: ({ target }) => { one.opacity = Number(target.value); draw(true); } }),
      make("button", { textContent: "x", title: "Take it away", onclick: () => { list.splice(n, 1); fill(); restyle(); } }))));
    element("surfacesPart").open ||= list.length > 0;
  }

  const colourOf = (one) => (/^#[0-9a-f]{6}$/i.test(one.colour ?? "") ? one.colour : app.tf ? colourCode(colourAt(app.tf.colours, one.value)) : "#888888");

  function clip() {
    element("clip").replaceChildren(...[0, 1, 2].flatMap((n) => {
      const { positions, counts } = app.grid, ends = [positions[n][0], positions[n].at(-1)].sort((a, b) => a - b);
      if (counts[n] === 1) return [];
      const now = effects().clip?.["xyz"[n]] ?? [null, null];
      const sliders = [0, 1].map((end) => make("input", { type: "range", min: 0, max: 1000, value: 1000 * (((now[end] ?? ends[end]) - ends[0]) / (ends[1] - ends[0])), title: ["first", "last"][end],
        oninput() {
          const shares = sliders.map((one) => Number(one.value) / 1000);
          if (shares[0] >= shares[1]) { this.value = 1000 * (end ? shares[0] + 0.001 : shares[1] - 0.001); return; }
          const own = (effects().clip ??= {});
          own["xyz"[n]] = shares.map((share, k) => (share === k ? null : ends[0] + share * (ends[1] - ends[0])));
          if (own["xyz"[n]].every((one) => one === null)) delete own["xyz"[n]];
          if (!Object.keys(own).length) delete effects().clip;
          draw(true);
        } }));
      return [make("label", {}, "xyz"[n], ...sliders)];
    }));
  }

  function features() {
    const { features: all } = variable();
    element("featuresPart").hidden = !all.length;
    element("features").replaceChildren(...all.map((text) => make("label", {}, make("input", { type: "checkbox", checked: app.features.includes(text),
      onchange: ({ target }) => {
        app.features = all.filter((one) => (one === text ? target.checked : app.features.includes(one)));
        transfer().opacity = app.features.length ? "feature" : "auto";
        restyle();
      } }), text)));
  }

  function facts() {
    const about = variable(), { container } = app, type = ["", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64"][about.type];
    const bytesEach = [0, 1, 2, 4, 8, 1, 2, 4, 8, 2, 4, 8][about.type], raw = about.shape.reduce((product, n) => product * n, bytesEach);
    const rows = {
      name: app.name, size: `${bytes(container.about.size)}, ${(raw * container.variables.length / container.about.size).toFixed(1)} times smaller than the values`,
      variable: `${about.name}${about.units ? ` [${about.units}]` : ""}, ${type}`, "t, z, y, x": about.shape.join(", "), range: `${short(about.low)} to ${short(about.high)}`,
      "largest error": Number.isNaN(about.maxError) ? "" : `${short(about.maxError, 4)}${about.units && about.units !== "1" ? ` ${about.units}` : ""}`,
      PSNR: Number.isNaN(about.psnr) ? (about.maxError === 0 ? "values are exact" : "") : `${about.psnr.toFixed(2)} dB`,
      features: about.features.join(", "),
      axes: app.grid.places.some(Boolean) ? `${[..."xyz"].filter((_, n) => app.grid.places[n]).join(", ")} uneven, drawn where the vertices lie` : "",
    };
    element("facts").replaceChildren(...Object.entries(rows).filter(([, text]) => text).map(([name, text]) =>
      make("tr", {}, make("td", { textContent: name }), make("td", { textContent: text }))));
  }

  /** Bring everything up to date. */
  function fill() {
    const there = Boolean(app.container);
    for (const one of document.querySelectorAll("#panel input, #panel select, #panel button, footer input, footer button")) one.disabled = !there;
    if (!there) return;
    const about = variable(), spec = transfer(), own = effects();
    element("variable").replaceChildren(...app.container.variables.map(({ name }, n) => new Option(name, n, false, n === app.number)));
    element("variable").hidden = app.container.variables.length < 2;
    for (const [id, on] of Object.entries({ noVolume: spec.nothing, shading: own.shading, maximum: own.maximum_intensity, box: own.box, axes: own.axes, bar: own.colour_bar,
      timeLabel: own.time_label, parallel: app.scene.camera?.projection === "parallel" })) element(id).checked = Boolean(on);
    element("colours").value = typeof spec.colours === "object" ? "" : mapKey(spec.colours ?? "viridis") ?? "viridis";
    element("reversed").checked = /_r$/i.test(spec.colours ?? "");
    element("density").value = Math.log10(spec.density ?? 1);
    element("background").value = background();
    element("low").textContent = short(about.low);
    element("high").textContent = short(about.high);
    const uneven = about.shape[0] > 1;
    for (const id of ["play", "time", "between", "speed"]) element(id).disabled = !uneven;
    element("time").max = about.shape[0] - 1;
    surfaces();
    clip();
    features();
    facts();
    time();
  }

  /** Bring the colours and opacities up to date. */
  function restyled() {
    const about = variable(), { tf } = app;
    editor.show({ tf, counts: app.counts, range: about.low < about.high ? [about.low, about.high] : tf.span });
    element("opacity").value = Array.isArray(transfer().opacity) ? "" : transfer().opacity ?? "auto";
    element("densityText").value = short(tf.density, 3);
    for (const [id, n] of [["from", 0], ["to", 1]]) if (document.activeElement !== element(id)) element(id).value = short(tf.shown[n]);
  }

  function time() {
    if (!app.container) return;
    element("time").value = app.step;
    element("play").textContent = app.playing ? "Pause" : "Play";
    element("timeText").textContent = timeText(variable().coords[0], app.step);
  }

  return { fill, restyled, time, resized: () => editor.draw() };
}
