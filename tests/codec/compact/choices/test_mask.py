"""The mask of the vertices that count: it is exact, whatever predicts it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.choices.mask import mask_levels
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.coreset.features import dilate, parse_feature

Field = Callable[..., npt.NDArray[Any]]


def decoded(path: Path) -> npt.NDArray[Any]:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8"])
@pytest.mark.parametrize("promise", [{"psnr": 45.0}, {"max_error": 2.0}], ids=str)
@pytest.mark.parametrize(
    "text", ["interval:105:1000", "interval:90:110", "isosurface:100", "segmentation:120"]
)
def test_the_occupancy_is_exact_at_every_step(
    tmp_path: Path, field: Field, dtype: str, promise: dict[str, float], text: str
) -> None:
    source = (field((3, 7, 10, 13)) / 3 + 100).astype(dtype)
    config = EncodeConfig(effort=1, features=(text,), dilation=1, tile="2x4x5x8", **promise)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    selected = [parse_feature(text).select(frame, step) for step, frame in enumerate(source)]
    requested = np.stack([dilate(frame, 1) for frame in selected])
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["required_features"] == ["transform"]
        assert volume.container.arrays["tables/level_1"].masked
        occupied = np.stack([volume.occupancy(t) for t in range(3)])
        values = volume[...]
        assert volume.verify() == len(volume.info["arrays"])
    np.testing.assert_array_equal(occupied, requested)
    np.testing.assert_array_equal(np.isfinite(values), requested)


@pytest.mark.parametrize(
    "options",
    [{}, {"dilation": 0}, {"features": ("interval:150:400", "isosurface:0")}],
    ids=str,
)
def test_features_that_do_not_follow_from_values_are_exact_as_well(
    tmp_path: Path, field: Field, options: dict[str, Any]
) -> None:
    source = field()
    mask = np.random.default_rng(5).random(source.shape) < 0.02
    config = EncodeConfig(effort=1, **options)
    fhash_codec.encode(source, tmp_path / "a.fhz", config, mask=mask)
    selected = mask.copy()
    for text in options.get("features", ()):
        selected |= np.stack(
            [parse_feature(text).select(frame, step) for step, frame in enumerate(source)]
        )
    requested = np.stack([dilate(frame, config.dilation) for frame in selected])
    np.testing.assert_array_equal(np.isfinite(decoded(tmp_path / "a.fhz")), requested)


def test_huge_values_have_an_exact_occupancy_too(tmp_path: Path, field: Field) -> None:
    source = field(dtype=np.float64) * 1e200
    config = EncodeConfig(effort=1, features=("interval:1e202:1e300",), dilation=0)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isfinite(back), source >= 1e202)
    np.testing.assert_array_equal(back[source >= 1e202], source[source >= 1e202])


def test_scores_of_an_interval_rise_inside_it() -> None:
    levels = mask_levels([parse_feature("interval:0:10")], 1, 0.5, [])
    edges, scores = np.array(levels.edges), np.array(levels.scores)
    assert len(scores) == len(edges) + 1
    inside = scores[np.searchsorted(edges, 5.0, side="right")]
    at_border = scores[np.searchsorted(edges, 0.01, side="right")]
    outside = scores[np.searchsorted(edges, -5.0, side="right")]
    assert outside < at_border < inside


def test_scores_of_a_mask_are_learned_from_tiles() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    levels = mask_levels([], 1, 0.01, [Tile(values, values > 0.5), Tile(values, None)])
    # Small values count in one tile of two, large ones in both.
    assert levels.scores[0] < levels.scores[-1]
    nothing = Tile(np.full((1, 1, 1, 1), np.nan), None)
    assert mask_levels([], 1, 0.01, [nothing]).edges == ()
