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
    low, high, sigma = map(f4, (*head["range"], head["sigma"]))
    tile, half = np.clip(tile, low, high), f4(0.5) / sigma

    def squeezed(difference):
        octaves = ((np.abs(difference * half) + f4(1)).view("i4") - 0x3F800000) >> 14
        return np.copysign(np.minimum(octaves, 4095), difference)

    unit = f4(1024) / (high - low) if high > low else f4(0)
    inputs = [squeezed(shifted(tile, o) - tile) for o in NEAR + FAR + EDGES]
    inputs.append(np.floor(np.minimum((tile - low) * unit + f4(0.5), 1024)) - 512)
    inputs.append(squeezed(tile - low))
    for number, (weight, bias, scale) in enumerate(layers):
        sums = np.tensordot(weight, np.array(inputs, "f8"), 1).astype("f4")
        last, unit_in = number == len(layers) - 1, 128 if number else 512
        unit_out = sigma if last else f4(128)
        out = sums * (f4(scale / unit_in) * unit_out) + (bias * unit_out)[:, None, None, None, None]
        inputs = np.rint(np.clip(np.where(out > 0, out, out / 8), -4095, 4095))
    return np.clip(tile + out[0], low, high)


def layers_of(mlp):
    """Whole weights, biases and the scale of the weights of each layer of an MLP in a header."""
    alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+"
    weights = np.array([alphabet.index(letter) - 31 for letter in mlp["weights"]], "f8")
    biases, scales = np.array(mlp["biases"], "f4"), np.array(mlp["scales"], "f2").astype("f4")
    inputs, at, place, layers = 28, 0, 0, []
    for number, width in enumerate([*mlp["widths"], 1]):
        matrix = weights[at : at + width * inputs].reshape(width, inputs)
        shift = biases[place : place + width] * scales[2 * number + 1]
        layers.append((matrix, shift, float(scales[2 * number])))
        at, place, inputs = at + width * inputs, place + width, width
    return layers


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
    (header,) = root.attrs["fhash"]["variables"]
    model, (low, high), mlp = header["model"], header["value_range"], header.get("mlp")
    lengths, layers = model["levels"][0], layers_of(mlp) if mlp else []
    tables = [root[f"table_{n + 1}"] for n in range(len(model["levels"]))]
    if model["profile"] == "paper":
        at = [[key], *map(np.arange, lengths[1:])]
        inputs = np.concatenate([interpolated(table, lengths, at) for table in tables])
        for number in range(1, model["hidden_layers"] + 2):
            weight, bias = (root[f"mlp/{kind}_{number}"][...] for kind in ("weight", "bias"))
            out = np.tensordot(weight, inputs, 1) + bias[:, None, None, None]
            inputs = np.maximum(out, 0)
        frame = np.clip(low + out[0] * (high - low), low, high)
    else:
        frame, tile = np.empty(lengths[1:]), model["tile"]
        for start in np.ndindex(*(-(-n // s) for n, s in zip(lengths[1:], tile[1:], strict=True))):
            corner = zip((key // tile[0], *start), tile, strict=True)
            t, *space = at = tuple(slice(i * s, (i + 1) * s) for i, s in corner)
            base = tables[0][(*at, 0)]
            base = corrected(base, layers, mlp) if layers else base
            base = base if np.dtype(model["values"]).kind == "f" else np.rint(base)
            more = root["corrections"][at] if "corrections" in root else 0 * base
            frame[tuple(space)] = (base + more)[key - t.start]
    bits = np.bitwise_or.reduce(root["occupancy"][:, key])
    root.store.close()
    return np.where(occupied(bits, lengths[1:]), frame, np.nan)
