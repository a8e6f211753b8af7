"""Draw the parts of a model at one step of a file: python model.py RUN.fhz MODEL.png [STEP]."""

import sys

import numpy as np
from matplotlib.figure import Figure

import fhash_codec

LEVELS = 4
"""Levels that are drawn."""


def draw(path: str, picture: str, step: int) -> None:
    """Draw tables, MLP and occupancy at one step, in the middle along z."""
    with fhash_codec.open(path) as volume:
        tables, mlp, (z, y, x) = volume.tables[:LEVELS], volume.mlp, volume.box
        decoded, mask = volume[step], volume.occupancy(step)
        figure = Figure(figsize=(3 * LEVELS, 6.2), layout="constrained")
        above, below = figure.subfigures(2, 1)
        above.suptitle("tables: level 1 is stored, coarser levels are decoded from it")
        for axes, table in zip(above.subplots(1, LEVELS, squeeze=False)[0], tables, strict=False):
            middle = table.shape[1] // 2
            axes.imshow(table[step, middle, :, :, 0], origin="lower", cmap="viridis")
            axes.set_title(f"level {table.level}: " + " x ".join(map(str, table.shape[1:4])))
        middle = (z[0] + z[1]) // 2
        values = decoded[middle, y[0] : y[1], x[0] : x[1]].astype(np.float64)
        added = values - tables[0][step, middle - z[0], :, :, 0]
        below.suptitle("MLP and occupancy")
        weights, correction, result, occupied = below.subplots(1, 4)
        if mlp.weights:
            weights.imshow(mlp.weights[0], cmap="coolwarm", aspect="auto")
            sizes = [mlp.weights[0].shape[1], *(len(biases) for biases in mlp.biases)]
            weights.set_title(f"first layer of {' to '.join(map(str, sizes))}")
            weights.set_xlabel("the vertex and its neighbours")
        reach = float(np.nanmax(np.abs(added))) or 1.0
        correction.imshow(added, origin="lower", cmap="coolwarm", vmin=-reach, vmax=reach)
        correction.set_title(f"what the MLP adds, up to {reach:.2g}")
        result.imshow(values, origin="lower", cmap="viridis")
        result.set_title("values: table and MLP")
        occupied.imshow(mask[middle, y[0] : y[1], x[0] : x[1]], origin="lower", cmap="gray_r")
        occupied.set_title("occupancy: vertices that count")
        figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    draw(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 0)
