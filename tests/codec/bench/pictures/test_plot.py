"""The plot of `fhash bench render`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from fhash_codec.bench.pictures.plot import plot
from fhash_codec.bench.pictures.results import RenderBench
from fhash_formats.errors import InputError


def test_a_result_is_drawn(result: RenderBench, tmp_path: Path) -> None:
    plot(result, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="nothing to draw"):
        plot(dataclasses.replace(result, curves=(), against=()), tmp_path / "b.png")
