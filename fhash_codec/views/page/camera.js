// The drawn grid and the camera, as fhash_codec/rendering/grid.py and cameras.py have them. Vectors are x, y, z.

export const add = (a, b, times = 1) => a.map((one, n) => one + times * b[n]);
export const times = (a, b) => a.map((one, n) => one * (Array.isArray(b) ? b[n] : b));
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const norm = (a) => Math.hypot(...a);
export const unit = (a) => times(a, 1 / (norm(a) || 1));
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

const TOLERANCE = 1e-3;
const MAX_POSITION = 1e100;
const DOWNWARD = new Set(["air_pressure", "atmosphere_hybrid_sigma_pressure_coordinate", "atmosphere_ln_pressure_coordinate",
  "atmosphere_sigma_coordinate", "depth", "depth_below_geoid", "depth_below_sea_surface", "sea_water_pressure"]);
const PRESSURES = new Set(["pa", "hpa", "kpa", "mb", "mbar", "millibar", "millibars", "bar", "dbar", "decibar", "atm"]);

/** Axis of a coordinate: its positions, whether they are even, and why the file's are not drawn. */
function axisOf({ values, attributes }) {
  const n = values.length;
  const unplaced = (problem) => ({ values: values.map((_, k) => k), even: true, problem });
  if (n === 1) return { values: [Math.abs(values[0]) <= MAX_POSITION ? values[0] : 0], even: true, problem: "" };
  if (!values.every((one) => Math.abs(one) <= MAX_POSITION)) return unplaced("are no positions along a line");
  let places = [...values];
  if (String(attributes.units ?? "").toLowerCase().startsWith("degree")) places = unwrapped(places);
  const extent = places[n - 1] - places[0];
  if (Math.abs(extent) < 1 / MAX_POSITION) return unplaced("are no positions along a line");
  const evenly = places.map((_, k) => places[0] + (extent * k) / (n - 1));
  if (places.every((one, k) => Math.abs(one - evenly[k]) <= TOLERANCE * Math.abs(extent))) {
    return { values: evenly, even: true, problem: "" };
  }
  if (places.some((one, k) => k && !((one - places[k - 1]) * extent > 0))) return unplaced("neither ascend nor descend throughout");
  return { values: places, even: false, problem: "" };
}

/** Longitudes without their jump by 360 degrees. */
function unwrapped(degrees) {
  let turns = 0;
  return degrees.map((one, k) => {
    const step = k ? one - degrees[k - 1] : 0;
    if (Math.abs(Math.abs(step) - 360) < 180) turns -= Math.sign(step) * 360;
    return one + turns;
  });
}

const spacingOf = ({ values }) => (values.length === 1 ? NaN : (values.at(-1) - values[0]) / (values.length - 1));

/** Whether the values of a coordinate ascend downwards (CF 1.11, section 4.3). */
function downward({ attributes }) {
  const word = (name) => String(attributes[name] ?? "").trim().toLowerCase();
  if (["up", "down"].includes(word("positive"))) return word("positive") === "down";
  return DOWNWARD.has(word("standard_name")) || PRESSURES.has(word("units"));
}

/** Factors that draw vertices of axes in uncommon units as far apart as the others. */
function proportions(coords, spacing) {
  const units = coords.map(({ attributes }) => {
    const text = String(attributes.units ?? "").trim();
    return text.toLowerCase().startsWith("degree") ? "degrees" : text;
  });
  const extended = spacing.map(Number.isFinite);
  const theirs = units.filter((_, n) => extended[n]);
  const factors = [1, 1, 1];
  if (new Set(theirs).size < 2 || theirs.includes("")) return factors;
  const count = (text) => theirs.filter((one) => one === text).length;
  const usual = theirs.reduce((best, one) => (count(one) > count(best) ? one : best));
  const common = [0, 1, 2].filter((n) => extended[n] && units[n] === usual);
  const across = common.reduce((sum, n) => sum + spacing[n], 0) / common.length;
  const longest = Math.max(...common.map((n) => spacing[n] * (coords[n].values.length - 1)));
  for (const n of [0, 1, 2]) {
    if (extended[n] && units[n] !== usual) {
      factors[n] = Math.max(across, (0.25 * longest) / (coords[n].values.length - 1)) / spacing[n];
    }
  }
  return factors;
}

/** Vertices that each axis is drawn with: an uneven one takes its smallest distance throughout. */
function drawnCounts(axes) {
  const counts = axes.map(({ values }) => values.length);
  const finer = axes.map(({ values, even }, n) => {
    if (even) return 1;
    const smallest = Math.min(...values.slice(1).map((one, k) => Math.abs(one - values[k])));
    return Math.max(Math.min(Math.abs(spacingOf(axes[n])) / smallest, Math.min(16, 512 / counts[n])), 2);
  });
  return axes.map(({ even }, n) => (even ? counts[n] : Math.ceil((counts[n] - 1) * finer[n] - 1e-9) + 1));
}

/** Places of `count` evenly drawn vertices in vertices of the series. */
function placesOf({ values }, count) {
  const sign = values.at(-1) > values[0] ? 1 : -1;
  let k = 0;
  return Float64Array.from({ length: count }, (_, n) => {
    const at = values[0] + ((values.at(-1) - values[0]) * n) / (count - 1);
    while (k < values.length - 2 && sign * values[k + 1] < sign * at) k++;
    return Math.min(Math.max(k + (at - values[k]) / (values[k + 1] - values[k]), 0), values.length - 1);
  });
}

/** The even grid that is drawn. coords: of x, y, z, {name, values, attributes}; scale: of a scene. */
export function gridOf(coords, scale) {
  const axes = coords.map(axisOf);
  const mean = axes.map(spacingOf);
  let factors = scale ?? proportions(coords, mean.map(Math.abs));
  const known = mean.map((one, n) => Math.abs(one * factors[n])).filter(Number.isFinite);
  let thickness = known.length ? known.reduce((sum, one) => sum + one, 0) / known.length : 1;
  if (known.length === 1) {
    thickness = Math.max(thickness, (thickness * (Math.max(...axes.map(({ values }) => values.length)) - 1)) / 32);
  }
  const filled = mean.map((one, n) => (Number.isNaN(one) ? thickness / factors[n] : one));
  factors = factors.map((one, n) => (downward(coords[n]) ? -one : one));
  const counts = drawnCounts(axes), series = axes.map(({ values }) => values.length);
  const finer = counts.map((count, n) => Math.max(count - 1, 1) / Math.max(series[n] - 1, 1));
  const spacing = filled.map((one, n) => (one * factors[n]) / finer[n]);
  const geometric = (a) => Math.exp(a.reduce((sum, one) => sum + Math.log(Math.abs(one)), 0) / 3);
  const origin = axes.map(({ values }, n) => values[0] * factors[n]);
  const bounds = counts.map((count) => (count === 1 ? [-0.5, 0.5] : [0, count - 1]));
  const notes = axes.flatMap(({ problem }, n) => (problem ? [`the coordinates of ${"xyz"[n]} ${problem}; vertices are drawn one unit apart`] : []));
  return {
    counts, series, origin, spacing, scale: factors, bounds, notes,
    places: axes.map((axis, n) => (axis.even ? null : placesOf(axis, counts[n]))),
    positions: axes.map(({ values }) => values),
    vertexSpacing: geometric(spacing),
    seriesSpacing: geometric(spacing.map((one, n) => one * finer[n])),
    lengths: spacing.map((one, n) => Math.abs(one) * (bounds[n][1] - bounds[n][0])),
  };
}

/** Axis of one vertex or much thinner than the others, along which the volume is seen; null for none. */
export function thinAxis(grid) {
  for (const n of [2, 1, 0]) {
    const others = Math.min(...grid.lengths.filter((_, m) => m !== n));
    if (grid.counts[n] === 1 || grid.lengths[n] < others / 16) return n;
  }
  return null;
}

/** Vertices of the axis with the fewest, and its length in mean vertex spacings. */
export function thinnest(grid) {
  const count = Math.min(...grid.series);
  return [count, Math.min(...grid.lengths.filter((_, n) => grid.series[n] === count)) / grid.seriesSpacing];
}

/** A drawn place along an axis in vertices of the series. */
export function toSeries(grid, axis, at) {
  const places = grid.places[axis];
  if (!places) return at;
  const k = Math.min(Math.max(Math.floor(at), 0), places.length - 2);
  return places[k] + Math.min(Math.max(at - k, 0), 1) * (places[k + 1] - places[k]);
}

export const VIEWS = {
  iso: [[1, 1, 1], [0, 0, 1]], xy: [[0, 0, 1], [0, 1, 0]], yx: [[0, 0, -1], [1, 0, 0]], xz: [[0, -1, 0], [0, 0, 1]],
  zx: [[0, 1, 0], [1, 0, 0]], yz: [[1, 0, 0], [0, 0, 1]], zy: [[-1, 0, 0], [0, 1, 0]],
};

/** Name in VIEWS that the view of a camera stands for. */
export function viewOf(name, grid) {
  if (Object.hasOwn(VIEWS, name ?? "auto")) return name;
  const thin = thinAxis(grid);
  return thin === null ? "iso" : ["yz", "xz", "xy"][thin];
}

function turned(given, axis, degrees) {
  const angle = (degrees * Math.PI) / 180;
  const part = add(times(given, Math.cos(angle)), cross(axis, given), Math.sin(angle));
  return add(part, axis, dot(axis, given) * (1 - Math.cos(angle)));
}

/** Rays of a camera in the index space of a grid; size: pixels across and down. */
export function raysOf(camera, grid, size) {
  const view = viewOf(camera.view, grid), { spacing, origin, bounds } = grid;
  const low = bounds.map((ends, n) => origin[n] + ends[0] * spacing[n]);
  const high = bounds.map((ends, n) => origin[n] + ends[1] * spacing[n]);
  const middle = times(add(low, high), 0.5), radius = norm(add(high, low, -1)) / 2;
  const focal = camera.focal_point ?? middle, aspect = size[0] / size[1];
  let half = Math.tan(((camera.view_angle ?? 30) * Math.PI) / 360);
  let distance = radius / Math.sin(Math.atan(half * Math.min(aspect, 1)));
  let parallelHalf = radius / Math.min(aspect, 1);
  if ((camera.view ?? "auto") === "auto" && grid.counts.includes(1)) {
    const [away, up] = VIEWS[view].map((axis) => axis.map(Math.abs));
    const extent = times(grid.lengths, 0.5);
    parallelHalf = Math.max(dot(extent, up), dot(extent, up.map((one, n) => 1 - one - away[n])) / aspect) / 0.98;
    distance = parallelHalf / half + dot(grid.lengths, away) / 2;
  }
  let away = VIEWS[view][0];
  if (camera.position) {
    away = add(camera.position, focal, -1);
    distance = norm(away);
  }
  away = unit(away);
  let turn = unit(camera.view_up ?? VIEWS[view][1]);
  if (norm(cross(turn, away)) < 1e-6) turn = Math.abs(away[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0];
  let right = unit(cross(turn, away));
  [away, right] = [away, right].map((axis) => turned(axis, turn, camera.azimuth ?? 0));
  away = turned(away, times(right, -1), camera.elevation ?? 0);
  const up = cross(away, right), parallel = camera.projection === "parallel";
  if (parallel) half = camera.parallel_scale ?? parallelHalf;
  half /= camera.zoom ?? 1;
  const inverse = spacing.map((one) => 1 / one);
  const start = camera.focal_point ? add(focal, origin, -1) : bounds.map((ends, n) => ((ends[0] + ends[1]) / 2) * spacing[n]);
  return {
    eye: times(add(start, away, distance), inverse), right: times(times(right, half * aspect), inverse),
    up: times(times(up, half), inverse), forward: times(times(away, -1), inverse),
    parallel, size, grid, focal, distance, half, axes: { away, right, up, turn },
  };
}

/** Pixel from the left and the top of a place of index space, and its distance before the camera. */
export function project(rays, point) {
  const { spacing } = rays.grid;
  const from = times(add(point, rays.eye, -1), spacing);
  const [right, up, forward] = [rays.right, rays.up, rays.forward].map((axis) => times(axis, spacing));
  const depth = dot(from, forward), scale = rays.parallel ? 1 : depth > 0 ? depth : 1;
  const u = dot(from, right) / dot(right, right) / scale, w = dot(from, up) / dot(up, up) / scale;
  return [((u + 1) / 2) * rays.size[0], ((1 - w) / 2) * rays.size[1], depth];
}

/** Edges of a box [[x0, x1], ...] of index space: axis, ends in pixels, and faces that look at the camera. */
export function edgesOf(rays, box) {
  const looking = [0, 1].map((side) => [0, 1, 2].map((n) => {
    const sign = side ? 1 : -1;
    return rays.parallel ? sign * rays.forward[n] < 0 : sign * (rays.eye[n] - box[n][side]) > 0;
  }));
  const edges = [];
  for (const axis of [0, 1, 2]) {
    const [one, other] = [0, 1, 2].filter((n) => n !== axis);
    for (const a of [0, 1]) {
      for (const b of [0, 1]) {
        const at = (end) => {
          const point = [0, 0, 0];
          point[axis] = box[axis][end];
          point[one] = box[one][a];
          point[other] = box[other][b];
          return project(rays, point);
        };
        const ends = [at(0), at(1)];
        if (!rays.parallel && ends.some((end) => end[2] <= 1e-4 * rays.distance)) continue;
        edges.push({ axis, ends, fronts: Number(looking[a][one]) + Number(looking[b][other]) });
      }
    }
  }
  return edges;
}

/** The lowest edge of the outline along each axis, at which its scale stands. */
export function outerEdges(rays, box) {
  const outline = edgesOf(rays, box).filter((edge) => edge.fronts === 1);
  const lowest = ({ ends }) => Math.round(Math.max(ends[0][1], ends[1][1]) * 1000);
  const leftmost = ({ ends }) => Math.min(ends[0][0], ends[1][0]);
  return [0, 1, 2].flatMap((axis) => outline.filter((edge) => edge.axis === axis)
    .sort((a, b) => lowest(b) - lowest(a) || leftmost(a) - leftmost(b)).slice(0, 1));
}

/** Round values from low to high with their texts, about `count` of them. */
export function ticks(low, high, count) {
  const extent = high - low;
  if (!(extent > 0) || !Number.isFinite(extent)) return [[low, String(Number(low.toPrecision(6)))]];
  const rough = extent / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((multiple) => multiple * power >= rough * (1 - 1e-9) || multiple === 10);
  const values = [];
  for (let n = Math.ceil(low / step - 1e-9); n <= Math.floor(high / step + 1e-9); n++) values.push(n * step);
  const largest = Math.max(...values.map(Math.abs), step), digits = Math.floor(Math.log10(step) + 1e-9);
  const finer = Math.abs(step / 10 ** digits - 2.5) < 1e-6 ? 1 : 0;
  if (largest >= 1e6 || step < 1e-4) {
    const places = Math.min(Math.max(0, Math.floor(Math.log10(largest)) - digits + finer), 12);
    return values.map((one) => [one, one ? one.toExponential(places) : "0"]);
  }
  return values.map((one) => [one, (one + 0).toFixed(Math.max(0, finer - digits))]);
}

/** A number with about `digits` digits, short. */
export const short = (number, digits = 5) => (Number.isFinite(number) ? String(Number(number.toPrecision(digits))) : "none");
