// What is drawn around the volume: box, scales of the axes, colour bar and time.
import { colourAt, colourCode } from "./colours.js";
import { edgesOf, outerEdges, project, ticks } from "./camera.js";

const DARK = "#1c1e24";
const LIGHT = "#f0f1f4";

/** Ink that suits a background [r, g, b]. */
export const inkOn = (rgb) => (0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2] > 0.45 ? [DARK, LIGHT] : [LIGHT, DARK]);

/** Name of a coordinate with its units. */
export const axisName = ({ name, attributes: { units } }) => (units && units !== "1" ? `${name} [${units}]` : name);

function letters(context, text, x, y, { ink, size, align = "center" }) {
  context.font = `${size}px system-ui, sans-serif`;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = Math.max(2, size / 4);
  context.strokeStyle = ink[1];
  context.fillStyle = ink[0];
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
  const wide = context.measureText(text).width, left = align === "center" ? x - wide / 2 : align === "right" ? x - wide : x;
  return [left, y - size / 2, left + wide, y + size / 2];
}

function lines(context, edges, ink, width) {
  context.strokeStyle = ink[0];
  context.globalAlpha = 0.7;
  context.lineWidth = width;
  context.beginPath();
  for (const { ends } of edges) {
    context.moveTo(ends[0][0], ends[0][1]);
    context.lineTo(ends[1][0], ends[1][1]);
  }
  context.stroke();
  context.globalAlpha = 1;
}

/** Draw the background and what lies behind the volume. */
export function drawBehind(context, { rays, box, effects, background, ink, unitPixel }) {
  const { width, height } = context.canvas;
  context.clearRect(0, 0, width, height);
  if (background) {
    context.fillStyle = background;
    context.fillRect(0, 0, width, height);
  }
  if (effects.box && box) lines(context, edgesOf(rays, box).filter((edge) => edge.fronts === 0), ink, 1.2 * unitPixel);
}

/** Draw what lies before the volume: edges, scales, colour bar and time. */
export function drawBefore(context, { rays, box, grid, coords, effects, tf, quantity, time, ink, unitPixel }) {
  const { width, height } = context.canvas, size = Math.round((width / unitPixel < 560 ? 11 : 12) * unitPixel);
  context.clearRect(0, 0, width, height);
  const outer = outerEdges(rays, grid.bounds);
  const shown = effects.box && box ? edgesOf(rays, box).filter((edge) => edge.fronts > 0) : [];
  lines(context, effects.axes ? [...shown, ...outer] : shown, ink, 1.2 * unitPixel);
  const taken = [];
  const free = ([left, top, right, bottom]) => taken.every((one) => right < one[0] || left > one[2] || bottom < one[1] || top > one[3]);
  if (effects.axes) {
    for (const edge of outer) scale(context, { edge, rays, grid, coords, ink, size, taken, free });
  }
  if (effects.colour_bar) bar(context, { tf, quantity, ink, size });
  if (effects.time_label && time) letters(context, time, size, 1.5 * size, { ink, size, align: "left" });
}

/** Ticks, numbers and name of an axis, outside its edge. */
function scale(context, { edge, rays, grid, coords, ink, size, taken, free }) {
  const { axis, ends } = edge, along = [ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]], extent = Math.hypot(...along);
  if (extent < 3 * size) return;
  const middle = project(rays, grid.bounds.map(([low, high]) => (low + high) / 2));
  let out = [-along[1] / extent, along[0] / extent];
  if (out[0] * ((ends[0][0] + ends[1][0]) / 2 - middle[0]) + out[1] * ((ends[0][1] + ends[1][1]) / 2 - middle[1]) < 0) out = out.map((one) => -one);
  const positions = grid.positions[axis], low = Math.min(positions[0], positions.at(-1)), high = Math.max(positions[0], positions.at(-1));
  const align = out[0] > 0.5 ? "left" : out[0] < -0.5 ? "right" : "center";
  let widest = 0;
  context.strokeStyle = ink[0];
  context.lineWidth = size / 10;
  for (const [value, text] of ticks(low, high, Math.max(2, Math.min(8, extent / (5 * size))))) {
    const at = grid.counts[axis] === 1 ? 0 : (value * grid.scale[axis] - grid.origin[axis]) / grid.spacing[axis];
    const [first, last] = grid.bounds[axis], share = grid.counts[axis] === 1 ? 0.5 : (at - first) / (last - first);
    const place = perspective(rays, edge, share);
    if (place.some((one) => !Number.isFinite(one)) || place[0] < 0 || place[1] < 0 || place[0] > context.canvas.width || place[1] > context.canvas.height) continue;
    context.beginPath();
    context.moveTo(...place);
    context.lineTo(place[0] + 0.4 * size * out[0], place[1] + 0.4 * size * out[1]);
    context.stroke();
    const [x, y] = [place[0] + 0.9 * size * out[0], place[1] + (align === "center" ? 1.1 : 0.9) * size * out[1]];
    context.font = `${size}px system-ui, sans-serif`;
    const wide = context.measureText(text).width, left = align === "center" ? x - wide / 2 : align === "right" ? x - wide : x;
    const room = [left - 4, y - 0.6 * size, left + wide + 4, y + 0.6 * size];
    if (!free(room)) continue;
    taken.push(room);
    letters(context, text, x, y, { ink, size, align });
    widest = Math.max(widest, wide);
  }
  const far = (align === "center" ? 2.5 * size : widest + 1.8 * size), name = axisName(coords[axis]);
  for (const share of [0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8]) {
    const place = [ends[0][0] + share * along[0] + far * out[0], ends[0][1] + share * along[1] + far * out[1]];
    const wide = context.measureText(name).width, x = Math.min(Math.max(place[0] + (out[0] * wide) / 2 * (align === "center" ? 0.6 : 1), wide / 2 + 4), context.canvas.width - wide / 2 - 4);
    const room = [x - wide / 2, place[1] - 0.6 * size, x + wide / 2, place[1] + 0.6 * size];
    if (!free(room) || place[1] > context.canvas.height - size) continue;
    taken.push(room);
    letters(context, name, x, place[1], { ink, size });
    return;
  }
}

/** Pixel of a share of an edge's length in the coordinates, which a perspective shortens. */
function perspective(rays, { ends }, share) {
  const [[x0, y0, d0], [x1, y1, d1]] = ends;
  const t = rays.parallel ? share : (share * d1) / ((1 - share) * d0 + share * d1);
  return [x0 + t * (x1 - x0), y0 + t * (y1 - y0)];
}

function bar(context, { tf, quantity, ink, size }) {
  const { width, height } = context.canvas, [low, high] = [tf.colours.positions[0], tf.colours.positions.at(-1)];
  const tall = Math.round(0.45 * height), thick = size, top = Math.round((height - tall) / 2), marks = ticks(low, high, Math.max(2, tall / (4 * size)));
  context.font = `${size}px system-ui, sans-serif`;
  const left = Math.round(width - thick - 1.6 * size - Math.max(...marks.map(([, text]) => context.measureText(text).width)));
  context.fillStyle = ink[0];
  context.fillRect(left - 1, top - 1, thick + 2, tall + 2);
  for (let row = 0; row < tall; row++) {
    context.fillStyle = colourCode(colourAt(tf.colours, high - ((row + 0.5) / tall) * (high - low)));
    context.fillRect(left, top + row, thick, 1);
  }
  for (const [there, tip, value] of [[tf.all[1] > high, top - 1, high], [tf.all[0] < low, top + tall + 1, low]]) {
    if (!there) continue; // values beyond the colours
    context.beginPath();
    context.moveTo(left - 1, tip);
    context.lineTo(left + thick + 1, tip);
    context.lineTo(left + thick / 2, tip + (value === high ? -thick / 2 : thick / 2));
    context.closePath();
    context.fillStyle = colourCode(colourAt(tf.colours, value));
    context.strokeStyle = ink[0];
    context.fill();
    context.stroke();
  }
  for (const [value, text] of marks) {
    const y = top + tall * (1 - (value - low) / (high - low || 1));
    context.fillStyle = ink[0];
    context.fillRect(left + thick, y - 0.5, size / 3, 1);
    letters(context, text, left + thick + 0.6 * size, y, { ink, size, align: "left" });
  }
  letters(context, quantity, width - 0.8 * size, top - 1.4 * size, { ink, size, align: "right" });
}

/** Value and positions under a place, as text. */
export function described(coords, grid, place, value, units) {
  const names = [0, 1, 2].map((n) => `${coords[n].name} ${Number(grid.positions[n][Math.round(place[n])].toPrecision(6))}`);
  const number = Number.isNaN(value) ? "no value" : `${Number(value.toPrecision(6))}${units && units !== "1" ? ` ${units}` : ""}`;
  return `${number} at ${names.join(", ")}`;
}
