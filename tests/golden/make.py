"""Writes the golden containers of the present format version: `python tests/golden/make.py`.

A golden is made once, when its format version is new, and kept for ever: every later version must
decode it to the values beside it. Tests only read goldens.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_formats.series import ArraySeries, Coordinate

HERE = Path(__file__).parent
TOLERANCE = 1e-5
"""Tolerance of decoded values, as a fraction of the range: float32 sums in another order."""

GOLDENS = {
    "paper-1.0-plain": EncodeConfig(
        profile="paper", hidden_layers=1, width=8, timings=False, tables="float32"
    ),
    "paper-1.0-feature": EncodeConfig(
        profile="paper",
        hidden_layers=1,
        width=8,
        timings=False,
        features=("interval:0.5:2", "isosurface:0"),
        key_frames="0,1,4",
        tables="float16",
    ),
    "paper-1.0-linear-uint8": EncodeConfig(
        profile="paper",
        hidden_layers=0,
        embedding_size=1,
        fold=3,
        timings=False,
        key_frames="every:2",
        tables="uint8",
    ),
    "compact-1.1-psnr": EncodeConfig(psnr=50.0, effort=4, timings=False),
    "compact-1.1-bound": EncodeConfig(
        max_error=0.01, effort=2, tile="3x4x7x5", timings=False, features=("interval:0.5:2",)
    ),
    "compact-1.1-mask": EncodeConfig(
        psnr=50.0, effort=4, timings=False, features=("interval:0.5:2",)
    ),
    "compact-1.1-predictor": EncodeConfig(max_error=2.0, effort=3, timings=False),
    "compact-1.2-clip": EncodeConfig(max_error=0.2, effort=2, timings=False),
    "compact-1.2-labels": EncodeConfig(max_error=0.0, effort=2, timings=False, tile="3x6x24x30"),
    "paper-1.1-transform": EncodeConfig(
        profile="paper",
        hidden_layers=1,
        width=8,
        timings=False,
        features=("interval:0.5:2",),
        tables="transform",
        psnr=60.0,
    ),
}

TIME = Coordinate(
    name="time",
    values=np.array([0.0, 0.5, 2.0, 2.25, 9.0]),
    attributes={"units": "hours since 2000-01-01"},
)


def series() -> ArraySeries:
    """A small moving field with a moving hole, and uneven times."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 6, 7, 9)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    for step in range(5):
        values[step, 2, 3, step : step + 2] = np.nan
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})


def fronts() -> ArraySeries:
    """Noise beside a flat region, with a sharp moving edge and a hole; prediction codes it best."""
    t, z, y, x = np.meshgrid(
        np.arange(6), np.arange(16), np.arange(24), np.arange(24), indexing="ij"
    )
    inside = (x - 12) ** 2 + (y - 12) ** 2 + (z - 8) ** 2 < (4 + t) ** 2
    noise = np.random.default_rng(0).normal(0, 3, t.shape)
    values = np.where(inside, 800 + 40 * np.sin(x / 3) + noise, 20.0).astype(np.float32)
    values[1, 2, 3, 4:6] = np.nan
    times = Coordinate(name="time", values=np.append(TIME.values, 10.0), attributes=TIME.attributes)
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": times})


def basins() -> ArraySeries:
    """Labels of regions that move, with missing ones: int8 whose fill value is -100."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in (5, 6, 24, 30)), indexing="ij")
    points = np.random.default_rng(0).uniform(0, 30, (12, 2))
    distances = [(y - v) ** 2 + (x - u + t) ** 2 for v, u in points]
    labels = (np.argmin(distances, axis=0) * 37 % 41).astype(np.float32)
    labels[(x - 15) ** 2 + (y - 12) ** 2 > (13 - z) ** 2] = np.nan
    labels_of_basins = ArraySeries(labels, name="density", units="kg m-3", coords={"t": TIME})
    labels_of_basins.source_dtype, labels_of_basins.fill = np.dtype(np.int8), -100
    return labels_of_basins


SERIES = {"compact-1.1-predictor": fronts, "compact-1.2-labels": basins}
"""Sources of the goldens that are not made from `series`."""


def main() -> None:
    for name, config in GOLDENS.items():
        path = HERE / f"{name}.fhz"
        if path.exists():  # goldens are never replaced
            continue
        fhash_codec.encode(SERIES.get(name, series)(), path, config)
        with fhash_codec.open(path) as volume:
            between = np.stack([volume.read(t) for t in (0.5, 3.75)])
            np.savez_compressed(
                HERE / f"{name}.npz", whole=volume[...], between=between, tolerance=TOLERANCE
            )


if __name__ == "__main__":
    main()
