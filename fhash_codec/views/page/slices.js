// Three slices of a frame on 2-D canvases; they need no WebGL.
import { colourAt } from "./colours.js";
import { toSeries } from "./camera.js";
import { axisName, described, inkOn } from "./overlay.js";
import { valueAt } from "./data.js";

const PLANES = [[2, 0, 1], [1, 0, 2], [0, 1, 2]]; // axis across the slice, then those to the right and upwards
const ENTRIES = 1024;

/** Slices in an element. `changed` is told a new place [x, y, z], `told` a text about what is under the pointer. */
export class Slices {
  constructor(root, { changed, told }) {
    this.place = null;
    this.changed = changed;
    this.panes = PLANES.map((plane) => {
      const pane = document.createElement("figure"), label = document.createElement("label"), name = document.createElement("span");
      const canvas = document.createElement("canvas"), range = document.createElement("input");
      range.type = "range";
      label.append(name, range);
      pane.append(canvas, label);
      root.append(pane);
      range.oninput = () => this.move(plane[0], Number(range.value));
      const under = (event) => this.under(canvas, plane, event);
      canvas.onpointermove = (event) => {
        const at = under(event);
        told(at ? described(this.coords, this.grid, at, valueAt(this.frame, at), this.units) : "");
        if (at && event.buttons & 1) this.go(at);
      };
      canvas.onpointerdown = (event) => under(event) && this.go(under(event));
      canvas.onpointerleave = () => told("");
      canvas.onwheel = (event) => {
        event.preventDefault();
        this.move(plane[0], this.place[plane[0]] + Math.sign(event.deltaY));
      };
      return { plane, canvas, name, range };
    });
  }

  move(axis, vertex) {
    const place = [...this.place];
    place[axis] = vertex;
    this.go(place);
  }

  go(place) {
    this.place = place.map((one, n) => Math.min(Math.max(Math.round(one), 0), this.grid.series[n] - 1));
    this.changed(this.place);
    this.draw();
  }

  /** Vertex [x, y, z] of the series under the pointer; null beside the slice. */
  under(canvas, [axis, right, up], event) {
    if (!this.grid) return null;
    const box = canvas.getBoundingClientRect(), place = [...this.place];
    const shares = [(event.clientX - box.left) / box.width, 1 - (event.clientY - box.top) / box.height];
    if (shares.some((one) => one < 0 || one >= 1)) return null;
    [right, up].forEach((each, n) => { place[each] = Math.round(this.vertex(each, shares[n])); });
    return place;
  }

  /** Place among the vertices of the series of a share of an axis, from the lowest position up. */
  vertex(axis, share) {
    const { grid } = this, [low, high] = grid.bounds[axis];
    const ascending = grid.spacing[axis] > 0 ? share : 1 - share;
    return grid.counts[axis] === 1 ? 0 : toSeries(grid, axis, low + ascending * (high - low));
  }

  show({ frame, grid, coords, tf, units, background }) {
    Object.assign(this, { frame, grid, coords, tf, units, background });
    this.place ??= grid.series.map((n) => Math.floor(n / 2));
    this.place = this.place.map((one, n) => Math.min(one, grid.series[n] - 1));
    this.draw();
  }

  draw() {
    const { frame, grid, tf } = this, low = tf.slices.positions[0], high = tf.slices.positions.at(-1);
    const lookUp = new Uint8ClampedArray(4 * ENTRIES);
    for (let n = 0; n < ENTRIES; n++) {
      lookUp.set([...colourAt(tf.slices, low + ((high - low) * n) / (ENTRIES - 1)).map((one) => 255 * one), 255], 4 * n);
    }
    const packed = new Uint32Array(lookUp.buffer);
    for (const { plane, canvas, name, range } of this.panes) {
      const [axis, right, up] = plane, figure = canvas.parentElement, flows = innerWidth <= 800;
      const room = [figure.clientWidth, flows ? Math.min(figure.clientWidth, 420) : figure.clientHeight - 40];
      const scale = Math.min(room[0] / grid.lengths[right], room[1] / grid.lengths[up]);
      const css = [right, up].map((each) => Math.max(grid.lengths[each] * scale, 24)), dense = Math.min(devicePixelRatio, 2);
      canvas.style.width = `${css[0]}px`;
      canvas.style.height = `${css[1]}px`;
      const [width, height] = css.map((one) => Math.max(1, Math.round(one * dense)));
      canvas.width = width;
      canvas.height = height;
      this.paint(canvas, plane, packed, [low, high]);
      range.min = 0;
      range.max = grid.series[axis] - 1;
      range.value = this.place[axis];
      name.textContent = `${axisName(this.coords[axis])} = ${Number(grid.positions[axis][this.place[axis]].toPrecision(6))}`;
    }
  }

  paint(canvas, [axis, right, up], packed, [low, high]) {
    const { width, height } = canvas, context = canvas.getContext("2d"), picture = context.createImageData(width, height);
    const pixels = new Uint32Array(picture.data.buffer), { frame } = this, [nz, ny, nx] = frame.shape, strides = [1, nx, nx * ny], counts = [nx, ny, nz];
    const nearest = (each, share) => {
      const n = Math.round((this.vertex(each, share) - frame.first[each]) / frame.stride);
      const apart = (this.vertex(each, share) - frame.first[each]) / frame.stride;
      return apart < -0.5 || apart > counts[each] - 0.5 + (frame.stride > 1) ? -1 : Math.min(Math.max(n, 0), counts[each] - 1);
    };
    const through = Math.round((this.place[axis] - frame.first[axis]) / frame.stride);
    const columns = Array.from({ length: width }, (_, n) => nearest(right, (n + 0.5) / width));
    if (through >= 0 && through < counts[axis] + (frame.stride > 1)) {
      const base = Math.min(through, counts[axis] - 1) * strides[axis], factor = (ENTRIES - 1) / (high - low || 1);
      for (let j = 0, at = 0; j < height; j++) {
        const row = nearest(up, 1 - (j + 0.5) / height);
        for (let i = 0; i < width; i++, at++) {
          if (row < 0 || columns[i] < 0) continue;
          const value = frame.values[base + row * strides[up] + columns[i] * strides[right]];
          if (value === value) pixels[at] = packed[Math.min(Math.max(Math.round((value - low) * factor), 0), ENTRIES - 1)];
        }
      }
    }
    context.putImageData(picture, 0, 0);
    context.globalAlpha = 0.6;
    context.fillStyle = inkOn(this.background)[0];
    const at = (each) => {
      if (this.grid.counts[each] === 1) return 0.5;
      let a = 0, b = 1;
      while (b - a > 1e-4) {
        const middle = (a + b) / 2;
        if ((this.vertex(each, middle) < this.place[each]) === this.grid.spacing[each] > 0) a = middle;
        else b = middle;
      }
      return b;
    };
    context.fillRect(Math.round(at(right) * width), 0, 1, height);
    context.fillRect(0, Math.round((1 - at(up)) * height), width, 1);
    context.globalAlpha = 1;
  }
}
