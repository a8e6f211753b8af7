// Ray marching of a frame by WebGL2: the sums of fhash_codec/native/march*.hpp, from a 3-D texture.

const SIDE = 8;
const MISSING = -30000;
const VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0, 1); }`;

const FRAGMENT = `precision highp float; precision highp int; precision highp sampler3D; precision highp sampler2D; precision highp usampler3D;
uniform sampler3D volume, smoothed; uniform usampler3D bricks; uniform sampler2D table, warp;
uniform vec3 eye, right, up, forward, spacing, low, high, seenLow, seenHigh, first, count, gradient, lamp, warped;
uniform float stride, stepSize, tableScale, tableOffset, tableSize, noise, threshold;
uniform vec2 size; uniform bool parallel, central; uniform int surfaces, planes;
uniform vec4 phong; uniform vec2 surface[8]; uniform vec3 surfaceColour[8]; uniform vec4 plane[6];
out vec4 colour;
const float NONE = -4.;
#ifdef WARPED
float warpedAt(float x, int a, float places) {
  if (places < 1.) return x;
  x = clamp(x, 0., places - 1.);
  float k = min(floor(x), places - 2.), one = texelFetch(warp, ivec2(int(k), a), 0).r, other = texelFetch(warp, ivec2(int(k) + 1, a), 0).r;
  return one + (x - k) * (other - one);
}
vec3 series(vec3 p) { return (vec3(warpedAt(p.x, 0, warped.x), warpedAt(p.y, 1, warped.y), warpedAt(p.z, 2, warped.z)) - first) / stride; }
#else
vec3 series(vec3 p) { return (p - first) / stride; }
#endif
float fetch(vec3 v) { return texture(volume, (v + .5) / count).r; }
float value(vec3 p) { return fetch(clamp(series(p), vec3(0), count - 1.)); }
vec4 look(float s) { return texelFetch(table, ivec2(int(clamp(s * tableScale + tableOffset, 0., 1.) * (tableSize - 1.) + .5), 0), 0); }
#ifdef LIT
#ifdef SMOOTHED
float fetchLit(vec3 v) { return texture(smoothed, (v + .5) / count).r; }
#else
#define fetchLit fetch
#endif
// Difference of values along an axis: over two vertices, or within the cell where a neighbour is missing.
float difference(vec3 v, vec3 axis, float at, float most, bool wide) {
  if (most < 1.) return 0.;
  float base = min(floor(at), most - 1.), from, to;
  if (wide) {
    from = fetchLit(v + axis * (max(at - 1., 0.) - at)); to = fetchLit(v + axis * (min(at + 1., most) - at));
    if (from > -1.5 && to > -1.5) return .5 * (to - from);
  }
  from = fetch(v + axis * (base - at)); to = fetch(v + axis * (base + 1. - at));
  return from > -1.5 && to > -1.5 ? to - from : 0.;
}
vec3 slope(vec3 p) {
  vec3 v = clamp(series(p), vec3(0), count - 1.);
#ifdef SMOOTHED
  bool wide = true;
#else
  bool wide = central;
#endif
  vec3 g = vec3(difference(v, vec3(1, 0, 0), v.x, count.x - 1., wide), difference(v, vec3(0, 1, 0), v.y, count.y - 1., wide),
    difference(v, vec3(0, 0, 1), v.z, count.z - 1., wide));
#ifdef WARPED
  g *= series(p + .5) - series(p - .5);
#endif
  return g * gradient;
}
vec2 light(vec3 p, vec3 back) {
  vec3 g = slope(p), to = lamp == vec3(0) ? back : lamp, middle = lamp == vec3(0) ? back : normalize(back + lamp + 1e-20);
  float inverse = inversesqrt(dot(g, g) + noise * noise);
  return vec2(phong.x + phong.y * min(abs(dot(g, to)) * inverse, 1.), phong.z * pow(min(abs(dot(g, middle)) * inverse, 1.), phong.w));
}
#endif
vec3 sum = vec3(0); float taken = 0.;
void add(vec3 rgb, float alpha) { float w = (1. - taken) * alpha; taken += w; sum += w * rgb; }
#ifdef SURFACES
void meet(vec3 from, vec3 to, float before, float now, vec3 back) {
  bool rising = now > before;
  for (int i = 0; i < surfaces; i++) {
    int n = rising ? i : surfaces - 1 - i;
    float level = surface[n].x;
    if ((before < level) == (now < level)) continue;
    vec3 a = from, b = to, p = to; float fa = before - level, fb = now - level;
    for (int turn = 0; turn < 5; turn++) {
      p = mix(a, b, clamp(fa / (fa - fb), .02, .98));
      float f = value(p) - level;
      if (f + level < -1.5 || f == 0.) break;
      if ((f < 0.) == (fb < 0.)) { b = p; fb = f; } else { a = p; fa = f; }
    }
    vec2 lit = light(p, back);
    add(surfaceColour[n] * lit.x + lit.y, surface[n].y);
  }
}
#endif
void main() {
  vec2 w = gl_FragCoord.xy / size * 2. - 1.;
  vec3 side = w.x * right + w.y * up, from = parallel ? eye + side : eye, d = parallel ? forward : forward + side;
  d /= length(d * spacing);
  vec3 back = -d * spacing, safe = mix(d, vec3(1e-20), equal(d, vec3(0)));
  vec3 a = (low - from) / safe, b = (high - from) / safe, near = min(a, b), far = max(a, b);
  float enter = max(max(near.x, near.y), max(near.z, 0.)), leave = min(far.x, min(far.y, far.z));
  for (int n = 0; n < planes; n++) {
    float distance = plane[n].w - dot(plane[n].xyz, from), approach = dot(plane[n].xyz, d);
    if (approach > 0.) enter = max(enter, distance / approach);
    else if (approach < 0.) leave = min(leave, distance / approach);
    else if (distance > 0.) leave = -1.;
  }
  colour = vec4(0);
  if (!(leave > enter)) return;
  float steps = (leave - enter) / stepSize;
  int last = int(min(ceil(steps), 16384.)) - 1;
  a = (seenLow - from) / safe; b = (seenHigh - from) / safe; near = min(a, b); far = max(a, b);
  float begin = max(enter, max(near.x, max(near.y, near.z))), end = min(leave, min(far.x, min(far.y, far.z)));
  if (!(end >= begin)) return;
  int k = max(int(ceil((begin - enter) / stepSize - .5)), 0), stop = end >= leave ? last : min(last, int(floor((end - enter) / stepSize - .5 + 1e-4)));
  vec3 top = count - 1., cells = max(count - 2., vec3(0)), dv = d / stride;
  bvec3 onward = greaterThan(dv, vec3(0)), still = lessThan(abs(dv), vec3(1e-12));
  vec3 inverse = 1. / mix(dv, vec3(1), still);
#ifdef PROJECTED
  float best = PROJECTED == 2 ? 9. : NONE;
#endif
#ifdef SURFACES
  vec3 previous = from + begin * d;
  float before = value(clamp(previous, seenLow, seenHigh));
  bool known = before > -1.5;
#endif
  while (k <= stop) {
    // A block of bricks: nothing in it, or samples up to its end.
    vec3 p = clamp(from + (enter + (float(k) + .5) * stepSize) * d, low, high), v = series(p);
    ivec3 brick = ivec3(clamp(v, vec3(0), cells)) / ${SIDE};
    int free = int(texelFetch(bricks, brick, 0).r);
#ifdef WARPED
    int until = k;
#else
    int reach = max(free - 1, 0);
    vec3 ahead = mix((mix(vec3(brick - reach), vec3(brick + reach + 1), onward) * ${SIDE}. - v) * inverse, vec3(1e20), still);
    int until = k + int(clamp(min(ahead.x, min(ahead.y, ahead.z)) / stepSize, 0., 16384.));
#endif
    if (free > 0) {
      k = until + 1;
#ifdef SURFACES
      known = false;
#endif
      continue;
    }
    for (until = min(until, stop); k <= until; k++) {
      p = clamp(from + (enter + (float(k) + .5) * stepSize) * d, low, high);
      float s = fetch(clamp(series(p), vec3(0), top));
#ifdef PROJECTED
      if (s > -1.5) best = PROJECTED == 2 ? min(best, s) : max(best, s);
#else
#ifdef SURFACES
      if (s < -1.5) { known = false; continue; }
      if (!known && k > 0) {
        previous = clamp(from + max(enter + (float(k) - .5) * stepSize, begin) * d, seenLow, seenHigh);
        before = value(previous); known = before > -1.5;
      }
      if (known) meet(previous, p, before, s, back);
      known = true; before = s; previous = p;
#endif
#ifdef VOLUME
      vec4 entry = look(s);
      if (entry.a > 0. && s > -1.5) {
        float alpha = k == last ? 1. - pow(1. - min(entry.a, .9999999), steps - float(last)) : entry.a;
#ifdef SHADED
        vec2 lit = light(p, back);
        entry.rgb = entry.rgb * lit.x + lit.y;
#endif
        add(entry.rgb, alpha);
      }
#endif
#endif
    }
    if (1. - taken < threshold) break;
  }
#ifdef SURFACES
  if (known && k > stop) {
    vec3 p = clamp(from + end * d, seenLow, seenHigh);
    float s = value(p);
    if (s > -1.5) meet(previous, p, before, s, back);
  }
#endif
#ifdef PROJECTED
  if (best > -1.5 && best < 5.) { sum = look(best).rgb; taken = 1.; }
#endif
  colour = vec4(sum, taken);
}`;

const COPY = `#version 300 es
precision highp float; uniform sampler2D picture; uniform vec2 size; out vec4 colour;
void main() { colour = texture(picture, gl_FragCoord.xy / size); }`;

/** Marches frames into a canvas. Throws where the browser has no WebGL2. */
export class Marcher {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { alpha: true, premultipliedAlpha: true, antialias: false, depth: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL2");
    this.gl = gl;
    this.lost = false;
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); this.lost = true; });
    canvas.addEventListener("webglcontextrestored", () => { this.build(); this.lost = false; this.onRestored?.(); });
    this.build();
  }

  build() {
    const { gl } = this;
    this.programs = {};
    this.copy = program(gl, VERTEX, COPY);
    gl.bindVertexArray(gl.createVertexArray());
    this.textures = {};
    this.largest = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    this.entries = Math.min(4096, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.picture = gl.createFramebuffer();
    this.frame = this.fence = null;
    this.marks = "";
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.texture("smoothed", gl.TEXTURE_3D, gl.LINEAR);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, 1, 1, 1, 0, gl.RED, gl.UNSIGNED_BYTE, new Uint8Array(1));
    this.texture("warp", gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, 1, 1, 0, gl.RED, gl.FLOAT, new Float32Array(1));
  }

  /** Bind the texture of a name, which is made where there is none. */
  texture(name, target, filter) {
    const { gl } = this, units = ["volume", "bricks", "table", "warp", "smoothed", "picture"];
    this.textures[name] ??= gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + units.indexOf(name));
    gl.bindTexture(target, this.textures[name]);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(target, side, gl.CLAMP_TO_EDGE);
    for (const kind of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, kind, filter);
  }

  /** Take a frame: values (z, y, x) with NaN, its first vertex, stride, range and bricks. */
  setFrame(frame) {
    const { gl } = this, [nz, ny, nx] = frame.shape;
    if (Math.max(nx, ny, nz) > this.largest) throw new Error(`the volume has ${Math.max(nx, ny, nz)} vertices along a side, and this browser draws ${this.largest}`);
    this.frame = frame;
    this.texture("volume", gl.TEXTURE_3D, gl.LINEAR);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R16F, nx, ny, nz, 0, gl.RED, gl.FLOAT, normalised(frame.values, frame.range));
    if (frame.smoothed) {
      this.texture("smoothed", gl.TEXTURE_3D, gl.LINEAR);
      gl.texImage3D(gl.TEXTURE_3D, 0, gl.R16F, nx, ny, nz, 0, gl.RED, gl.FLOAT, normalised(frame.smoothed, frame.range));
    }
    this.marks = "";
  }

  /** Take where drawn vertices lie among those of the series: for each axis null or places. */
  setPlaces(places) {
    const { gl } = this, width = Math.max(1, ...places.map((one) => one?.length ?? 0));
    const rows = new Float32Array(3 * width);
    places.forEach((one, axis) => one && rows.set(one, axis * width));
    this.texture("warp", gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, width, 3, 0, gl.RED, gl.FLOAT, rows);
  }

  /** Mark the bricks that show something: how many bricks away the nearest one is. */
  mark(tf, levels, everything) {
    const { gl, frame } = this, key = JSON.stringify([tf.points, tf.span, tf.density, levels, everything]);
    if (key === this.marks) return;
    this.marks = key;
    const [nz, ny, nx] = frame.bricks, distance = new Uint8Array(nx * ny * nz);
    const opaque = visibleRanges(tf);
    for (let n = 0; n < distance.length; n++) {
      const low = frame.brickLow[n], high = frame.brickHigh[n];
      const seen = low <= high && (everything || opaque(low, high) || levels.some((one) => low <= one && one <= high));
      distance[n] = seen ? 0 : 255;
    }
    spread(distance, nx, 1, ny * nz, (line) => line * nx);
    spread(distance, ny, nx, nx * nz, (line) => Math.floor(line / nx) * nx * ny + (line % nx));
    spread(distance, nz, nx * ny, nx * ny, (line) => line);
    this.texture("bricks", gl.TEXTURE_3D, gl.NEAREST);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8UI, nx, ny, nz, 0, gl.RED_INTEGER, gl.UNSIGNED_BYTE, distance);
  }

  /** Take the table of a transfer function, float32 RGBA. */
  setTable(entries) {
    const { gl } = this;
    this.texture("table", gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, entries.length / 4, 1, 0, gl.RGBA, gl.FLOAT, entries);
  }

  /** The program for what is drawn; one that is not there is made. */
  program({ shaded, isVolume, surfaces, projection, bySmoothed, warped }) {
    const named = { VOLUME: isVolume, SHADED: shaded, SURFACES: surfaces > 0, LIT: shaded || surfaces > 0, SMOOTHED: bySmoothed, WARPED: warped.some(Boolean) };
    const words = projection ? [`PROJECTED ${projection}`] : [];
    words.push(...Object.keys(named).filter((name) => named[name] && (!projection || name === "WARPED")));
    return (this.programs[words] ??= program(this.gl, VERTEX, `#version 300 es\n${words.map((word) => `#define ${word}\n`).join("")}${FRAGMENT}`));
  }

  /** Make room for a picture of width x height pixels. */
  room(width, height) {
    const { gl } = this;
    if (this.wide === width && this.tall === height && this.textures.picture) return;
    this.wide = width;
    this.tall = height;
    this.texture("picture", gl.TEXTURE_2D, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picture);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.textures.picture, 0);
  }

  /** March rows first..stop, from the bottom, of a picture; its view, uniforms.size, is at the left of it. */
  rows(uniforms, width, height, first, stop) {
    const { gl } = this;
    this.room(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.picture);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, width, stop - first);
    const march = this.program(uniforms);
    gl.useProgram(march.program);
    set(gl, march, { volume: 0, bricks: 1, table: 2, warp: 3, smoothed: 4, ...uniforms });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** Show what was marched. */
  show() {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.useProgram(this.copy.program);
    set(gl, this.copy, { picture: 5, size: [canvas.width, canvas.height] });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Whether the card is still at work since `mind` was called. */
  busy() {
    if (!this.fence) return false;
    if (this.gl.clientWaitSync(this.fence, 0, 0) === this.gl.TIMEOUT_EXPIRED) return true;
    this.gl.deleteSync(this.fence);
    this.fence = null;
    return false;
  }

  mind() {
    if (this.fence) this.gl.deleteSync(this.fence);
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
  }

  /** Show nothing. */
  clear() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }
}

/** Values as -1..1 over a range; MISSING in place of NaN, so that all around it is missing, too. */
function normalised(values, [low, high]) {
  const result = new Float32Array(values.length), scale = 2 / (high - low || 1);
  for (let n = 0; n < values.length; n++) {
    const value = (values[n] - low) * scale - 1;
    result[n] = value > 1.25 ? 1.25 : value < -1.25 ? -1.25 : value === value ? value : MISSING;
  }
  return result;
}

/** Tells whether a range of values has any opacity. */
function visibleRanges(tf) {
  const parts = [], { points } = tf;
  if (!(tf.density > 0)) return () => false;
  points.forEach((point, n) => {
    const next = points[n + 1];
    if (n === 0 && point[1] > 0) parts.push([-Infinity, point[0]]);
    if (next && (point[1] > 0 || next[1] > 0)) parts.push([point[0], next[0]]);
    if (!next && point[1] > 0) parts.push([point[0], Infinity]);
  });
  const slack = (tf.span[1] - tf.span[0]) / 2000;
  return (low, high) => parts.some((part) => low - slack < part[1] && high + slack > part[0]);
}

/** Chebyshev distances along lines of an array, in place: each pass takes the least of neighbours + 1. */
function spread(distance, length, stride, lines, start) {
  if (stride === 1) {
    for (let line = 0; line < lines; line++) sweep(distance, start(line), length);
    return;
  }
  const old = new Uint8Array(length);
  for (let line = 0; line < lines; line++) {
    const at = start(line);
    for (let n = 0; n < length; n++) old[n] = distance[at + n * stride];
    for (let n = 0; n < length; n++) {
      let best = old[n];
      for (let far = 1; far < best; far++) {
        const low = n - far >= 0 ? old[n - far] : 255, high = n + far < length ? old[n + far] : 255;
        best = Math.min(best, Math.max(far, Math.min(low, high)));
        if (n - far < 0 && n + far >= length) break;
      }
      distance[at + n * stride] = best;
    }
  }
}

function sweep(distance, at, length) {
  for (let n = at + 1; n < at + length; n++) distance[n] = Math.min(distance[n], distance[n - 1] + 1);
  for (let n = at + length - 2; n >= at; n--) distance[n] = Math.min(distance[n], distance[n + 1] + 1);
}

function program(gl, ...sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, n) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[n]);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error([gl.getProgramInfoLog(made), ...gl.getAttachedShaders(made).map((one) => gl.getShaderInfoLog(one))].join("\n"));
  }
  const uniforms = {};
  for (let n = 0; n < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); n++) {
    const { name, type } = gl.getActiveUniform(made, n);
    uniforms[name.replace("[0]", "")] = { at: gl.getUniformLocation(made, name), type };
  }
  return { program: made, uniforms };
}

function set(gl, { uniforms }, values) {
  const whole = new Set([gl.INT, gl.BOOL, gl.SAMPLER_2D, gl.SAMPLER_3D, gl.UNSIGNED_INT_SAMPLER_3D]);
  for (const [name, value] of Object.entries(values)) {
    if (!uniforms[name]) continue;
    const { at, type } = uniforms[name];
    if (whole.has(type)) gl.uniform1i(at, value);
    else if (type === gl.FLOAT) gl.uniform1f(at, value);
    else gl[{ [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv", [gl.FLOAT_VEC4]: "uniform4fv" }[type]](at, value);
  }
}

export { SIDE };
