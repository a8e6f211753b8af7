"""Values of a plain F-Hash file by zarr and numpy, from its numbers alone (see FORMAT.md)."""

import numpy as np
import zarr

f4, S = np.float32, (-1, 1)
NEAR = [tuple(d * (a == b) for b in range(4)) for a in range(4) for d in S]
FAR = [tuple(2 * d * (a == b) for b in range(4)) for a in (0, 2, 3) for d in S]
EDGES = [np.insert([d, e], a, 0) for a in ([0, 0], [1, 1], [1, 2]) for d in S for e in S]


def occupied(bits, box):
    """The mask (z, y, x) of the bits of a key frame."""
    index, position, place = np.indices(box), np.zeros(box, np.int64), 0
    for bit in range(max(box).bit_length()):
        for axis in (2, 1, 0):
            if (box[axis] - 1) >> bit:
                position |= (index[axis] >> bit & 1) << place
                place += 1
    return (bits[position >> 3] >> (7 - (position & 7)) & 1).astype(bool)


def shifted(values, offset):
    """Values at a neighbour (t, z, y, x) of each vertex, clamped to the tile."""
    if len(values) == 1:  # what is along t is along z
        offset = (0, offset[0] + offset[1], *offset[2:])
    axes = [np.clip(np.arange(n) + d, 0, n - 1) for n, d in zip(values.shape, offset, strict=True)]
    return values[np.ix_(*axes)]


def corrected(tile, layers, head):
    """A tile (t, z, y, x) of the table, corrected by the head; float32."""
    low, high, sigma = (f4(head[key]) for key in ("low", "high", "sigma"))
    tile, half = np.clip(tile, low, high), f4(0.5) / sigma

    def squeezed(difference):
        octaves = ((np.abs(difference * half) + f4(1)).view("i4") - 0x3F800000) >> 14
        return np.copysign(np.minimum(octaves, 4095), difference)

    unit = f4(1024) / (high - low) if high > low else f4(0)
    inputs = [squeezed(shifted(tile, o) - tile) for o in NEAR + FAR + EDGES]
    inputs.append(np.floor(np.minimum((tile - low) * unit + f4(0.5), 1024)) - 512)
    inputs.append(squeezed(tile - low))
    for number, (weight, bias, scale) in enumerate(layers):
        sums = np.tensordot(np.rint(weight / scale), np.array(inputs, "f8"), 1).astype("f4")
        last, unit_in = number == len(layers) - 1, 128 if number else 512
        unit_out = sigma if last else f4(128)
        out = sums * (f4(scale / unit_in) * unit_out) + (bias * unit_out)[:, None, None, None, None]
        inputs = np.rint(np.clip(np.where(out > 0, out, out / 8), -4095, 4095))
    return np.clip(tile + out[0], low, high)


def interpolated(table, lengths, at):
    """The embeddings of a level at positions (t, z, y, x) of the box."""
    grid = table[...] * np.float64(table.attrs.get("scale", 1)) + table.attrs.get("offset", 0)
    for axis, (n, wanted) in enumerate(zip(lengths, at, strict=True)):
        place = np.asarray(wanted) * (grid.shape[axis] - 1) / max(n - 1, 1)
        first = np.minimum(place.astype(int), max(grid.shape[axis] - 2, 0))
        after = np.take(grid, np.minimum(first + 1, grid.shape[axis] - 1), axis)
        weight = (place - first).reshape([-1 if a == axis else 1 for a in range(5)])
        grid = np.take(grid, first, axis) * (1 - weight) + after * weight
    return np.moveaxis(grid[0], -1, 0)


def values(path, key):
    """Values (z, y, x) of the box at a key frame, float64; NaN outside the coreset."""
    root = zarr.open_group(zarr.storage.ZipStore(path, mode="r"), mode="r")
    (header,), parts = root.attrs["fhash"]["variables"], root["parts"]
    model, (low, high) = header["model"], header["value_range"]
    lengths, layers = model["levels"][0], []
    while f"0.mlp.weight_{len(layers) + 1}" in parts:
        weight, bias = (parts[f"0.mlp.{kind}_{len(layers) + 1}"] for kind in ("weight", "bias"))
        layers.append((weight[...].astype("f8"), bias[...], weight.attrs.get("scale")))
    tables = [parts[f"0.tables.level_{n + 1}"] for n in range(len(model["levels"]))]
    if model["profile"] == "paper":
        at = [[key], *map(np.arange, lengths[1:])]
        inputs = np.concatenate([interpolated(table, lengths, at) for table in tables])
        for weight, bias, _ in layers:
            out = np.tensordot(weight, inputs, 1) + bias[:, None, None, None]
            inputs = np.maximum(out, 0)
        frame = np.clip(low + out[0] * (high - low), low, high)
    else:
        frame, tile = np.empty(lengths[1:]), model["tile"]
        for start in np.ndindex(*(-(-n // s) for n, s in zip(lengths[1:], tile[1:], strict=True))):
            corner = zip((key // tile[0], *start), tile, strict=True)
            t, *space = at = tuple(slice(i * s, (i + 1) * s) for i, s in corner)
            base = tables[0][(*at, 0)]
            base = corrected(base, layers, model["head"]) if layers else base
            base = base if np.dtype(model["values"]).kind == "f" else np.rint(base)
            more = parts["0.corrections"][at] if "0.corrections" in parts else 0 * base
            frame[tuple(space)] = (base + more)[key - t.start]
    bits = np.bitwise_or.reduce(parts["0.occupancy.bits"][:, key])
    root.store.close()
    return np.where(occupied(bits, lengths[1:]), frame, np.nan)
