"""Volumes as numpy sees them: steps that are decoded together give the bits of each alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, RegionError
from fhash_codec.compact.model import CompactModel
from fhash_formats.series import ArraySeries

QUICK = {"timings": False}
REGION = ((1, 4), (0, 3), (2, 7))


def waves(dtype: str) -> np.ndarray:
    """A wave (t, z, y, x) with a hole in it, which integers cannot have."""
    t, z, y, x = np.ogrid[:9, :4, :5, :8]
    values = 100 * np.sin(0.7 * t + 0.4 * z + 0.9 * y * y + 0.3 * x)
    if np.dtype(dtype).kind == "i":
        return values.astype(dtype) + (np.dtype(dtype).itemsize == 8) * 2**60
    values[2:5, 1:3, 2, 3:6] = np.nan
    return values.astype(dtype)


CASES = {
    "floats with holes": ("f4", {}),
    "a feature": ("f4", {"features": ("interval:0:60",)}),
    "64-bit integers": ("i8", {"max_error": 0.4}),
    "small integers of a feature": ("i2", {"features": ("interval:0:60",)}),
    "key frames": ("f4", {"profile": "paper", "key_frames": "every:3", "epochs": 2}),
    "a network": ("f4", {"profile": "paper", "features": ("interval:0:60",), "epochs": 2}),
}


@pytest.fixture(params=CASES, ids=list(CASES))
def volume(request: Any, tmp_path: Path) -> Any:
    dtype, config = CASES[request.param]
    path = tmp_path / "run.fhz"
    fhash_codec.encode(ArraySeries(waves(dtype)), path, EncodeConfig(**{**QUICK, **config}))
    with fhash_codec.open(path) as volume:
        yield volume


@pytest.mark.parametrize("outside", ["nan", "background"])
def test_steps_read_together_are_those_read_alone(volume: Any, outside: str) -> None:
    for region in (None, REGION):
        for steps in (range(9), range(3, 5), range(8, 9)):
            together = volume.read_steps(steps, region, outside=outside)
            alone = [volume.read(step, region, outside=outside) for step in steps]
            np.testing.assert_array_equal(together, np.stack(alone))
            assert together.dtype == volume.float_dtype
            together = volume.values_of_steps(steps, region, outside=outside)
            alone = [volume.values(step, region, outside=outside) for step in steps]
            np.testing.assert_array_equal(together, np.stack(alone))
            assert together.dtype == volume.dtype


def test_any_stride_gives_the_steps_that_it_names(volume: Any) -> None:
    whole = np.stack([volume.values(step) for step in range(9)])
    for index in (np.s_[...], np.s_[::2], np.s_[::-1], np.s_[7:1:-3], np.s_[4], np.s_[2:2]):
        np.testing.assert_array_equal(volume[index], whole[index])


def test_steps_outside_the_series_are_refused(volume: Any) -> None:
    for steps in (range(8, 10), range(-1, 2)):
        with pytest.raises(RegionError, match=r"outside 0\.\.8"):
            volume.read_steps(steps)


def test_many_small_frames_are_decoded_together(tmp_path: Path, monkeypatch: Any) -> None:
    values = np.cumsum(np.ones((3000, 1, 2, 3), "f4"), axis=0)
    fhash_codec.encode(ArraySeries(values), tmp_path / "long.fhz", EncodeConfig(**QUICK))
    reads: list[range] = []
    read_steps = CompactModel.read_steps

    def counted(self: CompactModel, first: int, end: int, region: Any) -> Any:
        reads.append(range(first, end))
        return read_steps(self, first, end, region)

    monkeypatch.setattr(CompactModel, "read_steps", counted)
    with fhash_codec.open(tmp_path / "long.fhz") as volume:
        assert volume[...].shape == values.shape
    assert reads == [range(3000)]
