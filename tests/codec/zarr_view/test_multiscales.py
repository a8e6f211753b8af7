"""Multiscale metadata: scales and translations that lead from vertices to positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec.zarr_view.levels import Level
from fhash_codec.zarr_view.multiscales import multiscale
from fhash_formats.series import Coordinate

NAMES = {"t": "time", "z": "height", "y": "lat", "x": "lon"}


def test_vertices_lead_to_positions_where_these_are_even(feature: Path) -> None:
    with fhash_codec.open(feature) as volume:
        levels = {f"{lod}/density": Level(volume, lod) for lod in range(3)}
        entry = multiscale("density", volume.coords, NAMES, levels)
        assert entry["name"] == "density"
        assert entry["axes"] == [
            {"name": "time", "type": "time", "unit": "hour"},
            {"name": "height", "type": "space", "unit": "meter"},
            {"name": "lat", "type": "space"},
            {"name": "lon", "type": "space"},
        ]
        assert [dataset["path"] for dataset in entry["datasets"]] == list(levels)
        for dataset, level in zip(entry["datasets"], levels.values(), strict=True):
            scale, translation = dataset["coordinateTransformations"]
            assert (scale["type"], translation["type"]) == ("scale", "translation")
            for axis, letter in ((1, "z"), (3, "x")):
                positions = volume.coords[letter].values[level.vertices(axis - 1)]
                got = translation["translation"][axis] + scale["scale"][axis] * np.arange(
                    positions.size
                )
                np.testing.assert_allclose(got, positions, rtol=1e-12)
            assert scale["scale"][0] == 6.0
            # latitudes descend: a scale must be positive, so that it counts vertices
            assert scale["scale"][2] == level.stride
            assert translation["translation"][2] == level.first[1]


@pytest.mark.parametrize(
    ("values", "units", "scale", "unit"),
    [
        ([0.0, 1.0, 3.0], "m", 1.0, None),
        ([0.0, 2.0, 4.0], "km", 2.0, "kilometer"),
        ([0.0, 2.0, 4.0], "Meters", 2.0, "meter"),
        ([0.0, 2.0, 4.0], "s", 2.0, None),
        ([3.0, 2.0, 1.0], "m", 1.0, None),
        ([1.0, 1.0, 1.0], "m", 1.0, None),
        ([0.0, np.inf, 1.0], "m", 1.0, None),
        ([-1e308, 0.0, 1e308], "m", 1.0, None),
        (np.float32([0.1, 0.2, 0.3]).tolist(), "m", 0.1, "meter"),
    ],
)
def test_uneven_positions_count_vertices(
    whole: Path, values: list[float], units: str, scale: float, unit: str | None
) -> None:
    with fhash_codec.open(whole) as volume:
        coordinate = Coordinate(name="x", values=np.array(values), attributes={"units": units})
        entry = multiscale("a", {**volume.coords, "x": coordinate}, NAMES, {"a": Level(volume, 0)})
        assert entry["axes"][3].get("unit") == unit
        (given, _) = entry["datasets"][0]["coordinateTransformations"]
        assert given["scale"][3] == pytest.approx(scale)
        assert all(0 < number < np.inf for number in given["scale"])
