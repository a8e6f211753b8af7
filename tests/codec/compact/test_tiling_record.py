"""The record of the tiles in a header."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.tiles import access

Field = Callable[..., npt.NDArray[Any]]


@pytest.mark.parametrize(
    ("options", "keys"),
    [
        ({"effort": 2}, {"price", "best", "tried", "region_ms"}),
        ({"effort": 2, "timings": False}, {"price", "best", "tried"}),
        ({"effort": 1}, {"price", "best", "tried"}),
        ({"effort": 2, "tile": "4x8x12x8"}, {"region_ms"}),
        ({"effort": 2, "tile": "whole", "timings": False}, set()),
    ],
)
def test_a_header_says_what_the_tiles_cost(
    options: dict[str, Any],
    keys: set[str],
    tmp_path: Path,
    field: Field,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(access, "FAST_ENOUGH", 1 << 10)
    shape = (4, 8, 12, 16)
    fhash_codec.encode(field(shape), tmp_path / "a.fhz", EncodeConfig(**options))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        record = volume.info["model"].get("tiling", {})
        assert record.keys() == keys
        assert "tiling" not in volume.info["model"] or keys
    if "price" in record:
        assert 1 <= record["price"] <= 1.1
        assert (record["tried"] > 1) == (options["effort"] > 1)
        assert all(1 <= n <= m for n, m in zip(record["best"], shape, strict=True))
    if "region_ms" in record:
        assert record["region_ms"] > 0
