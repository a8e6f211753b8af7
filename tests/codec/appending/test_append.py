"""`append`: the steps of a series behind those of a file, all of them or none."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.appending.append import append
from fhash_formats.series import ArraySeries, Coordinate

sys.path.insert(0, str(Path(__file__).parent))

from kill_writer import BOUND, TILE, frame

CONFIG = EncodeConfig(max_error=BOUND, effort=1, tile=TILE, timings=False)


def frames(first: int, end: int) -> np.ndarray:
    return np.stack([frame(step) for step in range(first, end)])


def series(first: int, end: int, times: list[float] | None = None, **options) -> ArraySeries:
    coords = {}
    if times is not None:
        coords["t"] = Coordinate(name="time", values=np.array(times, dtype=float))
    return ArraySeries(frames(first, end), coords=coords, **options)


@pytest.fixture
def run(tmp_path) -> Path:
    path = tmp_path / "run.fhz"
    fhash_codec.encode(series(0, 6), path, CONFIG)
    return path


def test_steps_follow_and_the_older_ones_keep_every_bit(run) -> None:
    with fhash_codec.open(run) as volume:
        before = volume[:]
    report = append(series(6, 13), run)
    assert (report["steps"], report["kept"], report["appended"]) == (13, 6, 7)
    assert report["bytes"] == run.stat().st_size
    assert report["max_abs_error"] <= BOUND
    with fhash_codec.open(run) as volume:
        assert volume.verify()
        after = volume[:]
        np.testing.assert_array_equal(after[:6], before)
        assert np.abs(after - frames(0, 13)).max() <= BOUND
        np.testing.assert_array_equal(volume.coords["t"].values, np.arange(13))
    assert os.listdir(run.parent) == ["run.fhz"]
    found = fhash_codec.diff(frames(0, 13), run)
    assert report["psnr"] == pytest.approx(found["psnr"], abs=0.02)
    assert report["psnr"] <= found["psnr"]
    assert report["rmse"] >= found["rmse"]


def test_steps_that_are_not_kept_are_replaced(run) -> None:
    assert append(series(3, 9), run, keep=3)["steps"] == 9
    with fhash_codec.open(run) as volume:
        assert np.abs(volume[:] - frames(0, 9)).max() <= BOUND


def test_times_follow_those_of_the_file(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    fhash_codec.encode(series(0, 3, [1.0, 2.0, 4.5]), path, CONFIG)
    with pytest.raises(InputError, match=r"begins at time 4.5, and the file ends at 4.5"):
        append(series(3, 6, [4.5, 5.0, 6.0]), path)
    with pytest.raises(InputError, match="must be finite and ascend"):
        append(series(3, 6, [5.0, 7.0, 6.0]), path)
    append(series(3, 6, [5.0, 6.0, 7.0]), path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume.coords["t"].values, [1, 2, 4.5, 5, 6, 7])


def with_gap(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[4, 0, 0, 0] = np.nan
    return values


def test_what_does_not_fit_changes_nothing(run) -> None:
    before = run.read_bytes()
    metres = ArraySeries(frames(0, 3), units="m")
    place = {"x": Coordinate(name="x", values=np.arange(12) + 1.0)}
    hours = {"t": Coordinate(name="t", values=np.arange(3) + 9.0, attributes={"units": "h"})}
    for source, message in (
        (frames(6, 9)[:, :, :9], r"has shape \(z, y, x\)"),
        (frames(6, 9).astype("f8"), "has number type float64"),
        (with_gap(frames(6, 12)), "step 4 has values that are missing"),
        (ArraySeries(frames(6, 9), coords=place), "has positions 1 to 12 along x"),
        (run, "is encoded already"),
    ):
        with pytest.raises(InputError, match=message):
            append(source, run)
        assert run.read_bytes() == before
        assert os.listdir(run.parent) == ["run.fhz"]
    # Units that only one of the two has are no contradiction.
    append(metres, run, keep=3)
    append(ArraySeries(frames(6, 9), coords=hours), run)


def test_a_failure_while_steps_are_coded_changes_nothing(run) -> None:
    before = run.read_bytes()

    class Broken(ArraySeries):
        def read(self, step: int) -> np.ndarray:
            if step == 5:
                raise InputError("the disk is gone")
            return super().read(step)

    with pytest.raises(InputError, match="the disk is gone"):
        append(Broken(frames(6, 12)), run)
    assert run.read_bytes() == before
    assert os.listdir(run.parent) == ["run.fhz"]


def test_a_file_with_a_single_tile(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    fhash_codec.encode(frames(0, 4), path, EncodeConfig(max_error=BOUND, effort=1, tile="whole"))
    append(frames(4, 9), path)
    with fhash_codec.open(path) as volume:
        assert volume.chunks[0] == 4
        assert np.abs(volume[:] - frames(0, 9)).max() <= BOUND
