"""The header of a compact file describes its table."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt
import pytest

from fhash_codec import EncodeConfig
from fhash_codec.compact.coded_table import model_header
from fhash_codec.compact.tiles_to_promise import code_series
from fhash_codec.coreset.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

Field = Callable[..., npt.NDArray[Any]]


@pytest.mark.parametrize("timings", [False, True])
def test_the_header_describes_the_table(field: Field, timings: bool) -> None:
    series = ArraySeries(field((3, 6, 8, 10)))
    config = EncodeConfig(effort=1, features=("interval:0:400",), timings=timings)
    table = code_series(series, select_features(series, config, silent), config, silent)
    header = model_header(table, config)
    assert header["levels"] == [list(table.plan.blocks.shape)]
    assert header["tables"] == "float32"
    assert header["head"] is None
    assert header["parameters"] == table.outcome.nonzero > 0
    assert all(len(gain) == 2 + timings for gain in header["gains"])
    assert table.parts.settings.mask is not None
