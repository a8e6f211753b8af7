"""Reads of a series that does not stay in memory: each pass has a purpose of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import encode as tiles_to_promise
from fhash_codec.compact import tiles as blocks
from fhash_codec.features.selection import select_features
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries, StepsSeries

SHAPE = (6, 10, 12, 14)


class CountedSeries(StepsSeries):
    """A series that is read by frames, as a file is, and counts how often."""

    reads = 0

    def __init__(self, values: np.ndarray) -> None:
        super().__init__(ArraySeries(values), range(len(values)))

    def read(self, step: int) -> np.ndarray:
        self.reads += 1
        return super().read(step)


def field(*, gaps: bool) -> np.ndarray:
    t, z, y, x = np.mgrid[tuple(slice(0, n) for n in SHAPE)].astype(np.float32)
    values = np.sin(t / 4 + z / 5) * np.cos(y / 6) + x / 20
    values[values > 1.4] *= 4
    if gaps:
        values[:, 2:4, :3] = np.nan
    return values


class PlannedError(Exception):
    """The bulk is known: nothing was coded yet."""


def bulk_and_passes(
    monkeypatch: pytest.MonkeyPatch, values: np.ndarray, features: tuple[str, ...]
) -> tuple[ValueRange, float]:
    """The bulk that an encoding finds, and how often the series was read until then."""
    series, config = CountedSeries(values), EncodeConfig(effort=1, features=features)
    found: list[ValueRange] = []

    def goal_of(*arguments: object, **_: object) -> object:
        found.append(arguments[4])
        raise PlannedError

    monkeypatch.setattr(tiles_to_promise, "goal_of", goal_of)
    selection = select_features(series, config, silent, ranked=not blocks.fits_memory(series))
    with pytest.raises(PlannedError):
        tiles_to_promise.code_series(series, selection, config, silent)
    return found[0], series.reads / SHAPE[0]


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("features", [("all",), ("interval:0.2:9",)])
def test_the_bulk_takes_no_pass_of_its_own(
    monkeypatch: pytest.MonkeyPatch, features: tuple[str, ...], gaps: bool
) -> None:
    """One pass scans, and one looks for features or gaps; in memory, one more is what is coded."""
    values = field(gaps=gaps)
    expected, passes = bulk_and_passes(monkeypatch, values, features)
    scans = 2 if gaps or features != ("all",) else 1
    assert passes == scans + 1
    monkeypatch.setattr(blocks, "MAX_BYTES_IN_MEMORY", 0)
    bulk, passes = bulk_and_passes(monkeypatch, values, features)
    assert passes == scans
    width = expected.high - expected.low
    assert bulk.low == pytest.approx(expected.low, abs=0.003 * width)
    assert bulk.high == pytest.approx(expected.high, abs=0.003 * width)


def test_a_long_series_is_encoded_with_its_bulk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scan, the coding of its only layer of tiles, a trial of the sample, and the measuring."""
    monkeypatch.setattr(blocks, "MAX_BYTES_IN_MEMORY", 0)
    series = CountedSeries(field(gaps=False))
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=0.01))
    assert series.reads == 4 * SHAPE[0]
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["quality"]["bulk"]["psnr"] > 30
