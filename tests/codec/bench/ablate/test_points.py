"""Speed of queries at points: only points of the coreset are asked for, whatever its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec.bench.ablate.points import POINTS, points_per_second
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.volume import Volume


def blob(steps: int) -> np.ndarray:
    """Values of which only a block of the first step is above 0.5."""
    values = np.zeros((steps, 6, 8, 10), np.float32)
    values[0, 2:5, 3:7, 4:9] = np.linspace(0.6, 1, 60, dtype=np.float32).reshape(3, 4, 5)
    return values


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("profile", ["compact", "paper"])
def test_points_lie_beside_the_coreset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, profile: str, steps: int
) -> None:
    path = tmp_path / "run.fhz"
    config = EncodeConfig(profile=profile, features=("interval:0.5:2",), dilation=0)
    if profile == "paper":
        config = replace(config, epochs=1, width=8)
    encode(blob(steps), path, config)
    asked: list[dict[str, Any]] = []
    sample = Volume.sample

    def noted(volume: Volume, **places: Any) -> Any:
        asked.append(places)
        return sample(volume, **places)

    monkeypatch.setattr(Volume, "sample", noted)
    assert points_per_second(path) > 0
    (places, *_), last = asked, (5, 7, 9)
    assert 0 <= places["t"] <= steps - 1
    for axis, (first, end), most in zip("zyx", ((2, 5), (3, 7), (4, 9)), last, strict=True):
        assert len(places[axis]) == POINTS
        assert places[axis].min() >= first
        assert places[axis].max() <= min(end, most)
