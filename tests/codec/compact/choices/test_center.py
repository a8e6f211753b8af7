"""The centre of a series: its plateau, or the mean without one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.choices.center import PLATEAU, mean_center, plateau_center
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.measure.value_range import ValueRange

RANGE = ValueRange(low=0.0, high=8.0)


def sample_of(*tiles: tuple[Any, Any, int]) -> Any:
    """A sample of tiles: values, which count, and the number of tiles that each stands for."""
    return SimpleNamespace(
        tiles=[Tile(np.asarray(values, np.float32), counted) for values, counted, _ in tiles],
        weights=[weight for _, _, weight in tiles],
    )


def with_plateau(share: float) -> np.ndarray:
    """Values that are spread over the range, but a share of them, which is 1.5."""
    values = np.linspace(0, 8, 10_000, dtype=np.float32)
    values[: round(share * values.size)] = 1.5
    return values.reshape(1, 1, 100, 100)


def test_a_plateau_is_the_centre_from_its_share_on() -> None:
    assert plateau_center(sample_of((with_plateau(PLATEAU + 0.01), None, 1)), RANGE) == 1.5
    assert plateau_center(sample_of((with_plateau(PLATEAU - 0.01), None, 1)), RANGE) is None


def test_tiles_count_by_what_they_stand_for_and_by_their_vertices() -> None:
    none, half = with_plateau(0.0), with_plateau(0.5)
    assert plateau_center(sample_of((none, None, 99), (half, None, 1)), RANGE) is None
    assert plateau_center(sample_of((none, None, 1), (half, None, 1)), RANGE) == 1.5
    assert plateau_center(sample_of((half, half != 1.5, 1)), RANGE) is None
    assert mean_center(sample_of((half, half == 1.5, 1)), RANGE) == 1.5


@pytest.mark.filterwarnings("ignore:Mean of empty slice:RuntimeWarning")
def test_missing_values_and_constants_have_no_plateau() -> None:
    missing = np.full((1, 1, 2, 2), np.nan)
    assert plateau_center(sample_of((missing, None, 1)), RANGE) is None
    assert mean_center(sample_of((missing, None, 1)), RANGE) == 4.0
    same = ValueRange(low=3.0, high=3.0)
    assert plateau_center(sample_of((np.full((1, 1, 2, 2), 3.0), None, 1)), same) is None
    with_gap = with_plateau(0.5)
    with_gap[..., -1] = np.nan
    assert plateau_center(sample_of((with_gap, None, 1)), RANGE) == 1.5


@pytest.mark.parametrize("effort", [1, 2])
def test_a_file_has_the_plateau_as_its_centre(tmp_path, effort: int) -> None:
    t, z, y, x = np.indices((6, 12, 24, 24))
    pulse = 9 * np.exp(-((z - 6) ** 2 + (y - 12) ** 2 + (x - 4 - 3 * t) ** 2) / 6)
    values = (0.777 + np.where(pulse > 0.01, pulse, 0)).astype(np.float32)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(values, path, EncodeConfig(psnr=45.0, effort=effort, timings=False))
    with fhash_codec.open(path) as volume:
        settings = volume.container.arrays["tables/level_1"].settings
    assert settings.center == float(np.float32(0.777))
