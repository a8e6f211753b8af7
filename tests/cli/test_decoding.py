"""Selections of `fhash decode`, and the frames that come of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import fhash_codec
from fhash_cli.decoding import Selection
from fhash_cli.frame_statistics import Statistics
from fhash_codec.progress import silent

WHOLE: dict[str, Any] = {
    "steps": None,
    "times": (),
    "roi": None,
    "box": None,
    "lod": None,
    "outside": "nan",
    "dtype": None,
    "fill": None,
}


def decoded(volume: fhash_codec.Volume, **options: Any) -> tuple[Selection, np.ndarray, Statistics]:
    selection = Selection.of(volume, **{**WHOLE, **options})
    frames = np.stack(list(selection.frames(volume, statistics := Statistics(), silent)))
    return selection, frames, statistics


@pytest.mark.parametrize(
    ("options", "index"),
    [
        ({}, np.s_[:]),
        ({"steps": slice(1, None), "roi": [(1, 3), (None, None), (0, 4)]}, np.s_[1:, 1:3, :, :4]),
        ({"times": ("4", "0")}, np.s_[[2, 0]]),
    ],
)
def test_frames_are_the_part_of_the_volume(run: Path, options: dict[str, Any], index: Any) -> None:
    with fhash_codec.open(run) as volume:
        assert isinstance(volume, fhash_codec.Volume)
        expected = np.asarray(volume)[index]
        selection, frames, statistics = decoded(volume, **options)
    np.testing.assert_array_equal(frames, expected)
    assert selection.shape == frames.shape
    assert selection.kind == frames.dtype
    assert statistics.result()["max"] == np.nanmax(expected)


def test_integers_of_64_bits_come_exactly(tmp_path: Path) -> None:
    values = (1 << 60) + np.arange(4 * 3 * 4 * 5).reshape(4, 3, 4, 5)
    path = tmp_path / "run.fhz"
    fhash_codec.encode(values, path, fhash_codec.EncodeConfig(max_error=0.0, effort=1))
    with fhash_codec.open(path) as volume:
        assert isinstance(volume, fhash_codec.Volume)
        selection, frames, _ = decoded(volume, steps=slice(1, 3))
    assert selection.kind == values.dtype
    np.testing.assert_array_equal(frames, values[1:3])


def test_the_source_s_own_fill_value_counts_where_the_type_has_it(run: Path) -> None:
    with fhash_codec.open(run) as volume:
        assert isinstance(volume, fhash_codec.Volume)
        for own, taken in ((-9, -9), (1e300, None), (0.5, None)):
            types = replace(volume.value_type, fill=own)
            with patch.object(volume, "value_type", types):
                assert Selection.of(volume, **{**WHOLE, "dtype": "int16"}).fill == taken
