// Transfer functions as fhash_codec/rendering/transfer_function.py has them: colour and extinction of a value.
import { colourAt, colourMap } from "./colours.js";

export const PRESETS = ["auto", "feature", "linear", "linear_r", "geom", "geom_r", "sigmoid", "foreground", "opaque"];
const FAINTEST = 1 / 255;
const INTERVAL = 0.3;
const SURFACE = 0.6;
const BACKGROUND = 0.25;
const EDGE = 0.1;
const TENT = 0.02;
const THIN = 8;
const OPAQUE = 64;
const VISIBLE = 0.02;
const CUT = 0.05;
const KINDS = 16;

/** Value at `at` of a piecewise linear curve of points [at, value]; beyond the ends that of the end. */
export function interpolate(points, at) {
  if (!(at > points[0][0])) return points[0][1];
  const last = points.length - 1;
  if (at >= points[last][0]) return points[last][1];
  let low = 0, high = last;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (points[middle][0] <= at) low = middle;
    else high = middle;
  }
  const [x, y] = points[low], [u, v] = points[high];
  return y + ((at - x) / (u - x)) * (v - y);
}

/** Kind and numbers of a feature's text, such as interval:0.2:1; null where it tells no values apart. */
export function parseFeature(text) {
  const [kind, ...words] = String(text).split(":");
  const numbers = words.map((word) => (word === "" ? NaN : Number(word)));
  if (kind === "interval") {
    return { kind, low: Number.isNaN(numbers[0]) ? -Infinity : numbers[0], high: Number.isNaN(numbers[1]) ? Infinity : numbers[1] };
  }
  if (kind === "isosurface" && Number.isFinite(numbers[0])) return { kind, value: numbers[0] };
  if (kind === "segmentation" && Number.isFinite(numbers[0])) return { kind, low: numbers[0], high: Infinity };
  return null;
}

function inside(feature, [low, high]) {
  if (feature === null || feature.kind === "isosurface") return null;
  const range = [Math.max(low, feature.low), Math.min(high, feature.high)];
  return range[0] < range[1] ? range : null;
}

/** Values that colours reach over where a scene says none: those of the features, else all. */
export function shownRange(features, range) {
  const ranges = features.map((text) => inside(parseFeature(text), range)).filter(Boolean);
  if (ranges.length && ranges.length === features.length) {
    range = [Math.min(...ranges.map((one) => one[0])), Math.max(...ranges.map((one) => one[1]))];
  }
  return range[0] < range[1] ? range : [range[0], range[0] + Math.max(Math.abs(range[0]) * 1e-6, 1e-30)];
}

/** Values that colours reach over by what is visible (visible_range there). points: null where all count alike. */
export function visibleRange(counts, points, [low, high]) {
  if (counts.filter(Boolean).length <= KINDS) return [low, high];
  const width = (high - low) / counts.length;
  const seen = counts.map((one, n) => one * (points ? interpolate(points, low + (n + 0.5) * width) : 1));
  const weights = seen.some((one) => one > 0) ? seen : counts, total = weights.reduce((sum, one) => sum + one, 0);
  if (!total || !(low < high)) return [low, high];
  const shares = [];
  let sum = 0;
  for (const one of weights) shares.push((sum += one) / total);
  const first = shares.findIndex((one) => one >= VISIBLE), last = shares.findIndex((one) => one >= 1 - VISIBLE);
  const ends = [low + first * width, low + ((last < 0 ? counts.length - 1 : last) + 1) * width];
  return [ends[0] - low > CUT * (high - low) ? ends[0] : low, high - ends[1] > CUT * (high - low) ? ends[1] : high];
}

const tent = (value, range) => {
  const half = TENT * (range[1] - range[0]) || Math.max(Math.abs(range[0]) * 1e-6, 1e-30);
  return [[value - half, 0], [value, SURFACE], [value + half, 0]];
};

function ofFeature(text, range) {
  const feature = parseFeature(text);
  if (feature?.kind === "isosurface") return tent(feature.value, range);
  const within = inside(feature, range);
  if (within === null) return feature?.kind === "interval" && Number.isFinite(feature.low) ? tent(feature.low, range) : null;
  const edge = EDGE * (within[1] - within[0]);
  const rise = feature.low < range[0] ? [[within[0], INTERVAL]] : [[within[0], 0], [within[0] + edge, INTERVAL]];
  if (feature.kind === "segmentation") return [[within[0], 0], [within[0] + edge, INTERVAL]];
  const fall = feature.high > range[1] ? [[within[1], INTERVAL]] : [[within[1] - edge, INTERVAL], [within[1], 0]];
  return [...rise, ...fall];
}

function largest(curves) {
  const values = new Set(curves.flat().map((point) => point[0]));
  const ends = [...values].sort((a, b) => a - b);
  for (let n = 0; n < curves.length; n++) {
    for (let m = n + 1; m < curves.length; m++) {
      for (let e = 0; e + 1 < ends.length; e++) {
        const left = interpolate(curves[n], ends[e]) - interpolate(curves[m], ends[e]);
        const right = interpolate(curves[n], ends[e + 1]) - interpolate(curves[m], ends[e + 1]);
        if (left * right < 0) values.add(ends[e] + (left / (left - right)) * (ends[e + 1] - ends[e]));
      }
    }
  }
  return [...values].sort((a, b) => a - b).map((value) => [value, Math.max(...curves.map((curve) => interpolate(curve, value)))]);
}

function ofFeatures(texts, range) {
  const curves = texts.map((text) => ofFeature(text, range));
  return curves.length && curves.every(Boolean) ? largest(curves) : null;
}

/** The most frequent value transparent, values far from it opaque; histogram: counts over the range. */
function awayFromBackground(counts, [low, high]) {
  const total = counts.reduce((sum, one) => sum + one, 0);
  if (!(low < high) || !total) return low < high ? [[low, 0], [high, BACKGROUND]] : [[low, BACKGROUND]];
  const width = (high - low) / counts.length;
  const middle = (n) => low + (n + 0.5) * width;
  const background = middle(counts.indexOf(Math.max(...counts)));
  const order = [...counts.keys()].sort((a, b) => Math.abs(middle(a) - background) - Math.abs(middle(b) - background));
  let sum = 0, half = null, most = null;
  for (const n of order) {
    sum += counts[n];
    if (half === null && sum >= 0.5 * total) half = Math.abs(middle(n) - background);
    if (most === null && sum >= 0.995 * total) most = Math.abs(middle(n) - background);
  }
  const near = half + width, far = Math.max(most ?? half, near + width);
  const fall = background - near > low ? [[background - far, BACKGROUND], [background - near, 0]] : [];
  const rise = background + near < high ? [[background + near, 0], [background + far, BACKGROUND]] : [];
  return fall.length + rise.length ? [...fall, ...rise] : [[low, BACKGROUND]];
}

function named(name, shown) {
  const over = (share) => shown[0] * (1 - share) + shown[1] * share;
  if (name === "opaque") return [[shown[0], 1]];
  if (name === "foreground") return [[over(0), 0], [over(FAINTEST), 1], [over(1), 1]];
  let opacities = [0, 1];
  const shares = Array.from({ length: 65 }, (_, n) => n / 64);
  if (name.startsWith("geom")) opacities = shares.map((share) => (1e-6 / 255) ** (1 - share));
  if (name === "sigmoid") opacities = shares.map((share) => 1 / (1 + Math.exp(-20 * share + 10)));
  opacities = opacities.map((one) => (one < FAINTEST ? 0 : one));
  if (name.endsWith("_r")) opacities.reverse();
  return opacities.map((one, n) => [over(n / (opacities.length - 1)), one]);
}

/** Points [value, opacity] of a preset. thin: vertices and length of the thinnest axis, in spacings. */
export function opacityPoints(name, { shown, range, features, counts, thin }) {
  if (!["auto", "feature"].includes(name)) return named(name, shown);
  const own = ofFeatures(features, range);
  if (name === "auto" && thin[0] <= THIN) {
    if (thin[0] === 1) return [[range[0], 1]];
    const points = own ?? [[range[0], BACKGROUND], [range[1], BACKGROUND]];
    if (!(thin[1] < THIN)) return points;
    return points.map(([value, one]) => [value, -Math.expm1(Math.log1p(-one) * (THIN / Math.max(thin[1], 1e-30)))]);
  }
  return own ?? awayFromBackground(counts, range);
}

/** Extinction per length of an opacity after `distance`. */
export const extinctionOf = (opacity, distance) => Math.min(-Math.log1p(-opacity), OPAQUE) / distance;

/** The transfer function of a scene: colours, points, and what `table` needs. */
export function transferFunction(spec, about) {
  const thin = spec.unit_distance ? [Infinity, Infinity] : about.thin, opacity = spec.opacity ?? "auto";
  const over = (shown) => (spec.nothing ? [[about.range[0], 0]] : Array.isArray(opacity) ? opacity : opacityPoints(opacity, { ...about, shown, thin }));
  let shown = spec.range ?? shownRange(about.features, about.range), points = over(shown), sliced = shown;
  if (!spec.range && shown[0] === about.range[0] && shown[1] === about.range[1]) {
    shown = visibleRange(about.counts, Array.isArray(opacity) || ["auto", "feature"].includes(opacity) ? points : null, about.range);
    points = over(shown);
    sliced = visibleRange(about.counts, null, about.range);
  }
  const colours = colourMap(spec.colours ?? "viridis", shown);
  let [low, high] = about.range;
  const positive = points.flatMap((point, n) => (point[1] > 0 ? [n] : []));
  if (positive.length) {
    const first = positive[0], last = positive.at(-1), ends = [colours.positions[0], colours.positions.at(-1)];
    low = Math.max(low, first > 0 ? points[first - 1][0] : Math.min(points[0][0], ends[0]));
    high = Math.min(high, last + 1 < points.length ? points[last + 1][0] : Math.max(points.at(-1)[0], ends[1]));
  }
  if (!(low < high)) [low, high] = [Math.min(low, high), Math.min(low, high) + Math.max(Math.abs(low) * 1e-6, 1e-30)];
  return { shown, all: about.range, slices: colourMap(spec.colours ?? "viridis", sliced), colours, points, span: [low, high], density: spec.density ?? 1, distance: spec.unit_distance ?? about.spacing };
}

/** Colours and opacities of one step of `length`, RGBA float32, at n values spread over the span. */
export function table(tf, n, length) {
  const [low, high] = tf.span, result = new Float32Array(4 * n);
  for (let k = 0; k < n; k++) {
    const value = low + ((high - low) * k) / (n - 1);
    result.set(colourAt(tf.colours, value), 4 * k);
    result[4 * k + 3] = -Math.expm1(-tf.density * extinctionOf(interpolate(tf.points, value), tf.distance) * length);
  }
  return result;
}
