"""Each kind of source that users have: what `info` tells, and what comes back from an export."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from source_kinds import KINDS

from fhash_formats.readers.registry import open_series

Fhash = Callable[..., Result]
RELATIVE = 1e-3
"""Promised share of the range."""


@pytest.mark.parametrize("name", KINDS)
def test_a_source_comes_back_from_its_own_format(fhash: Fhash, tmp_path: Path, name: str) -> None:
    """Values within the promise; missing values, coordinates, times and units equal."""
    (tmp_path / "source").mkdir()
    source = KINDS[name](tmp_path / "source")
    promise = ["--max-error", 0] if source.exact else ["--max-error-rel", RELATIVE]
    words = [source.path, *source.options]

    listed = fhash("info", *words, "--json")
    assert listed.exit_code == 0, listed.stderr
    assert any(entry["commands"] for entry in json.loads(listed.stdout)["variables"])

    run = tmp_path / "run.fhz"
    encoded = fhash("encode", *words, *promise, "-o", run, "--effort", "1", "--quiet")
    assert encoded.exit_code == 0, encoded.stderr
    decoded = fhash("decode", run, "-o", tmp_path / f"out{source.suffix}", "--json", "-q")
    assert decoded.exit_code == 0, decoded.stderr
    data_range = np.ptp(source.values[np.isfinite(source.values)])
    bound = 0.0 if source.exact else RELATIVE * data_range
    with open_series(json.loads(decoded.stdout)["paths"][-1]) as series:
        assert (series.source_dtype or series.dtype).name == source.dtype
        assert source.units in (None, series.units)
        values = np.stack(list(series.frames())).astype(np.float64)
        np.testing.assert_array_equal(np.isnan(values), np.isnan(source.values))
        # the source itself may be rounded to float32
        slack = np.spacing(np.nanmax(np.abs(source.values)), dtype=np.float32)
        assert np.nanmax(np.abs(values - source.values)) <= bound + slack
        for axis, positions in source.coords.items():
            np.testing.assert_array_equal(series.coords[axis].values, positions)
        found = series.coords["t"].attributes
        assert {key: found.get(key) for key in source.time} == source.time
