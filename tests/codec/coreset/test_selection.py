"""Sources as series, and what the settings select of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import open_source, select_features
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import ArraySeries, Coordinate

VALUES = np.random.default_rng(0).random((3, 4, 5, 6))


def test_files_series_and_arrays_are_sources(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    series = ArraySeries(VALUES)
    for source in (tmp_path / "a.npy", str(tmp_path / "a.npy"), series, VALUES, VALUES.tolist()):
        with open_source(source) as opened:
            assert opened.shape == VALUES.shape
            np.testing.assert_array_equal(opened.read(2), VALUES[2])
    with open_source(series) as opened:
        assert opened is series


def test_a_mask_replaces_all_and_joins_named_features() -> None:
    mask = VALUES[0] > 0.8
    series = ArraySeries(VALUES)
    alone = select_features(series, EncodeConfig(dilation=0), silent, mask)
    assert [str(feature) for feature in alone.features] == ["mask:array"]
    assert alone.extent.samples == 3 * mask.sum()
    config = EncodeConfig(dilation=0, features=("interval:0:0.1",))
    joined = select_features(series, config, silent, mask)
    assert [str(feature) for feature in joined.features] == ["mask:array", "interval:0:0.1"]
    assert joined.extent.samples == (mask | (VALUES <= 0.1)).sum()
    with pytest.raises(InputError, match="mask has shape"):
        select_features(series, EncodeConfig(), silent, mask[1:])


def test_times_that_are_no_axis_are_warned_of() -> None:
    times = Coordinate(name="time", values=np.array([0.0, 2.0, 2.0]))
    series = ArraySeries(VALUES, coords={"t": times})
    with pytest.warns(FhashWarning, match="step numbers stand for them"):
        selection = select_features(series, EncodeConfig(), silent)
    assert selection.extent.key_frames == (0, 1, 2)
    assert selection.scanned.finite_count == VALUES.size
