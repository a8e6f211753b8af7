// What a scene of fhash (docs: `fhash render --scene`) means for a frame: the numbers that the marcher takes.
import { colourAt, parseColour } from "./colours.js";
import { raysOf, thinnest, toSeries, unit } from "./camera.js";
import { table, transferFunction } from "./transfer.js";

const SHADING = { ambient: 0.2, diffuse: 0.8, specular: 0.2, specular_power: 16, light: null, gradient: "cell" };
const MOST_SURFACES = 8;
const MOST_PLANES = 6;

/** Effects of a scene that this page does not draw. */
export function undrawn(scene) {
  const effects = scene.effects ?? {}, missing = [];
  for (const name of ["shadows", "ambient_occlusion", "average_intensity", "attenuated_maximum_intensity", "jitter"]) {
    if (effects[name]) missing.push(name.replaceAll("_", " "));
  }
  if ((effects.antialiasing ?? 1) > 1) missing.push("antialiasing");
  if (scene.transfer_function?.gradient_opacity?.length) missing.push("gradient opacity");
  if (scene.evolution) missing.push("evolution");
  if (effects.legend?.length) missing.push("legend");
  if ((effects.isosurfaces ?? []).length > MOST_SURFACES) missing.push(`more than ${MOST_SURFACES} isosurfaces`);
  return missing;
}

/** The transfer function of a scene for a variable. counts: histogram; features: those that are shown. */
export function functionOf(scene, grid, about, features, counts) {
  const range = about.low < about.high ? [about.low, about.high] : [about.low, about.low + Math.max(Math.abs(about.low) * 1e-6, 1e-30)];
  return transferFunction(scene.transfer_function ?? {}, { range, features, counts, thin: thinnest(grid), spacing: grid.seriesSpacing });
}

/** Settings of the light of a scene; null where nothing is lit. */
export function shadingOf(scene) {
  const { shading, isosurfaces } = scene.effects ?? {};
  if (!shading && !isosurfaces?.length) return null;
  return { ...SHADING, ...(typeof shading === "object" ? shading : {}) };
}

/** Deviation of the Gaussian that values are smoothed by before they are lit, 0 for none (rendering/light.py). */
export function smoothingOf(scene, grid, about, tf) {
  const bounded = about.bounded && shadingOf(scene);
  const noise = bounded ? (2 * about.maxError * grid.vertexSpacing) / grid.seriesSpacing : 0;
  const span = tf.span[1] - tf.span[0];
  if (!(noise > 1e-3 * span)) return { noise: 0, deviation: 0 };
  const deviation = Math.sqrt(Math.min((0.24 * noise) / span, 1) / 1e-3);
  return { noise, deviation: Math.round(10 * Math.min(Math.max(deviation, 0.8), 2.5)) / 10 };
}

/** The part of the drawn box that a clip leaves, in index space, [[x0, x1], ...]; null for nothing. */
export function clipped(scene, grid) {
  const clip = scene.effects?.clip ?? {};
  const box = grid.bounds.map(([low, high], n) => {
    const ends = clip["xyz"[n]];
    if (!ends || grid.counts[n] === 1) return [low, high];
    const places = ends.map((end) => (end === null || end === false ? null : (end - grid.origin[n] / grid.scale[n]) / (grid.spacing[n] / grid.scale[n])));
    const [first, last] = grid.spacing[n] / grid.scale[n] > 0 ? places : places.reverse();
    return [Math.max(low, first ?? low), Math.min(high, last ?? high)];
  });
  return box.every(([low, high]) => low <= high) ? box : null;
}

/** Place of a vertex of the series among the drawn ones. */
function toDrawn(grid, axis, vertex) {
  const places = grid.places[axis];
  if (!places) return vertex;
  let low = 0, high = places.length - 1;
  while (high - low > 1e-6) {
    const middle = (low + high) / 2;
    if (toSeries(grid, axis, middle) < vertex) low = middle;
    else high = middle;
  }
  return high;
}

function planesOf(scene, grid) {
  const result = new Float32Array(4 * MOST_PLANES), planes = (scene.effects?.clip?.planes ?? []).slice(0, MOST_PLANES);
  planes.forEach(({ normal, point, offset }, n) => {
    const origin = grid.origin.map((one, k) => one / grid.scale[k]);
    const shift = normal.reduce((sum, one, k) => sum + one * ((point?.[k] ?? 0) - origin[k]), 0);
    const along = normal.map((one, k) => (one * grid.spacing[k]) / grid.scale[k]), size = Math.hypot(...along);
    result.set([...along.map((one) => one / size), (point ? shift : offset + shift) / size], 4 * n);
  });
  return { planes: planes.length, plane: result };
}

/** Everything that the marcher needs for a picture: uniforms, the table, and what is visible. */
export function look({ scene, grid, about, tf, frame, size, coarse = 1, entries }) {
  const rays = raysOf(scene.camera ?? {}, grid, size), [low, high] = frame.range, half = (high - low) / 2 || 0.5;
  const shading = shadingOf(scene), effects = scene.effects ?? {}, { noise, deviation } = smoothingOf(scene, grid, about, tf);
  const body = clipped(scene, grid), { box } = about;
  const seen = [0, 1, 2].map((n) => {
    const [from, stop] = [box[4 - 2 * n], box[5 - 2 * n]];
    const ends = grid.series[n] === 1 ? grid.bounds[n] : [toDrawn(grid, n, from), toDrawn(grid, n, stop - 1)];
    return body && [Math.max(ends[0], body[n][0]), Math.min(ends[1], body[n][1])];
  });
  const span = tf.span[1] - tf.span[0] || 1, rounding = (4 * 2 ** -23 * Math.max(Math.abs(low), Math.abs(high))) / span;
  const left = deviation ? (0.24 * (noise / span)) / deviation ** 2 : noise / span;
  const length = (scene.march?.step ?? 0.5) * frame.stride * coarse;
  const surfaces = (effects.isosurfaces ?? []).slice(0, MOST_SURFACES).filter((one) => (one.opacity ?? 1) > 0).sort((a, b) => a.value - b.value);
  const levels = new Float32Array(2 * MOST_SURFACES), colours = new Float32Array(3 * MOST_SURFACES);
  surfaces.forEach((one, n) => {
    levels.set([(one.value - low) / half - 1, one.opacity ?? 1], 2 * n);
    colours.set((one.colour && parseColour(one.colour)) || colourAt(tf.colours, one.value), 3 * n);
  });
  const projection = effects.maximum_intensity ? 1 : effects.minimum_intensity ? 2 : 0;
  const covered = projection ? { ...tf, span: [tf.colours.positions[0], tf.colours.positions.at(-1)] } : tf;
  const ratio = covered.span[1] - covered.span[0] || 1;
  return {
    rays, visible: body !== null, levels: projection ? [] : surfaces.map((one) => one.value), everything: projection > 0,
    table: table(covered, entries, length * grid.vertexSpacing),
    uniforms: {
      size, eye: rays.eye, right: rays.right, up: rays.up, forward: rays.forward, parallel: rays.parallel,
      spacing: grid.spacing.map((one) => one / grid.vertexSpacing),
      low: (body ?? grid.bounds).map((ends) => ends[0]), high: (body ?? grid.bounds).map((ends) => ends[1]),
      seenLow: seen.map((ends) => ends?.[0] ?? 0), seenHigh: seen.map((ends) => ends?.[1] ?? -1),
      first: frame.first, stride: frame.stride, count: [...frame.shape].reverse(), warped: grid.places.map((one) => one?.length ?? 0),
      stepSize: length, tableSize: entries, tableScale: half / ratio, tableOffset: (half + low - covered.span[0]) / ratio,
      gradient: grid.spacing.map((one) => (half * grid.vertexSpacing) / (span * one)), noise: Math.max(1e-6, Math.min(Math.max(rounding, left), 1)),
      threshold: Math.max(scene.march?.threshold ?? 1 / 1024, 1e-6), lamp: shading?.light ? unit(shading.light) : [0, 0, 0],
      phong: shading ? [shading.ambient, shading.diffuse, shading.specular, shading.specular_power] : [1, 0, 0, 1],
      shaded: Boolean(effects.shading) && !grid.counts.includes(1), central: shading?.gradient === "central", bySmoothed: Boolean(frame.smoothed),
      isVolume: !scene.transfer_function?.nothing, surfaces: projection ? 0 : surfaces.length, surface: levels, surfaceColour: colours, projection,
      ...planesOf(scene, grid),
    },
  };
}
