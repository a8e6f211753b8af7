"""Choice of the head: it stays only where the file gets smaller by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.choices.head import (
    EFFORTS,
    GAIN_BY_WIDTHS,
    Budget,
    Effort,
    _best_widths,
)


def fronts() -> npt.NDArray[np.float32]:
    """Return two plateaus with a travelling, slanted and curved border.

    A wavelet smears it, and a head sharpens it.
    """
    t, z, y, x = np.meshgrid(
        np.arange(6), np.arange(16), np.arange(40), np.arange(40), indexing="ij"
    )
    distance = x + 0.6 * y - 2 * t + 4 * np.sin(z / 5 + t / 4) - 26
    return (1 / (1 + np.exp(-2 * distance))).astype(np.float32)


def test_under_a_bound_a_head_makes_files_smaller_and_the_bound_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Prediction would be smaller still.
    monkeypatch.setattr(
        "fhash_codec.compact.choices.predictor.best_predictor", lambda *_, **__: None
    )
    budget = Budget(updates=300, samples=60_000)
    monkeypatch.setitem(EFFORTS, 5, Effort(candidates=4, budget=budget))
    source, sizes = fronts(), {}
    for effort in (4, 5):
        config = EncodeConfig(effort=effort, max_error=0.01)
        figures = fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert np.abs(volume[...].astype(np.float64) - source).max() <= 0.01
            assert (volume.info["model"]["head"] is not None) == (effort == 5)
        sizes[effort] = figures["bytes"]
    assert sizes[5] < 0.97 * sizes[4]


def test_a_small_file_gets_no_head_and_a_large_one_a_large_head() -> None:
    def widths(size: float, effort: int = 9) -> Any:
        return _best_widths(size, 0.5, 4.5, effort)

    assert widths(1_000) is None
    chosen = [widths(size) for size in (3e3, 1e4, 1e5, 1e8)]
    found = [list(GAIN_BY_WIDTHS).index(each) for each in chosen if each is not None]
    assert found == sorted(found)
    assert chosen[-1] == (14, 24)
    assert widths(1e8, effort=5) == (12, 12)
