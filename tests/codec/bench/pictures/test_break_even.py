"""ARM beside the cache: figures of each size, and up to how many pictures ARM is faster."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, Scene
from fhash_codec.bench.pictures import break_even as module
from fhash_codec.bench.pictures.break_even import break_even
from fhash_codec.bench.pictures.results import BreakEven
from fhash_codec.progress import silent


def figures(first: float, kept: float, arm: float) -> BreakEven:
    return BreakEven(size=8, first_ms=first, kept_ms=kept, arm_ms=arm, evaluations=1, auto="cache")


@pytest.mark.parametrize(
    ("first", "kept", "arm", "pictures"),
    [(100, 10, 40, 3), (100, 10, 101, 0), (100, 10, 100, 1), (100, 10, 10, None), (9, 10, 11, 0)],
)
def test_the_cache_wins_from_some_number_of_pictures_on(first, kept, arm, pictures) -> None:
    pair = figures(first, kept, arm)
    assert pair.pictures == pictures
    assert pair.ratio == arm / first
    if pictures:
        assert pictures * arm <= first + (pictures - 1) * kept
        assert (pictures + 1) * arm > first + pictures * kept


@pytest.mark.parametrize(("lost", "count"), [(np.inf, 3), (0.0, 1)])
def test_sizes_are_measured_until_arm_has_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: float, count: int
) -> None:
    monkeypatch.setattr(module, "LOST", lost)
    path = tmp_path / "a.fhz"
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    fhash_codec.encode(field, path, EncodeConfig(profile="paper", epochs=1, width=4))
    with fhash_codec.open(path) as volume:
        pairs = break_even(volume, Scene(), 1, 16, silent)
    assert [pair.size for pair in pairs] == [4, 8, 16][:count]
    for pair in pairs:
        assert min(pair.first_ms, pair.kept_ms, pair.arm_ms) > 0
        assert pair.auto in ("cache", "arm")
    assert pairs[-1].evaluations > 0
