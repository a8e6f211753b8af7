"""`append`: the steps of a series behind those of a file, all of them or none."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import dask.array
import numpy as np
import pytest
import xarray as xr
from kill_writer import BOUND as BOUND_WRITER
from kill_writer import SHAPE as SHAPE_WRITER
from kill_writer import TILE, frame

import fhash_codec
from fhash_codec import (
    DamagedFileError,
    EncodeConfig,
    InputError,
    Writer,
)
from fhash_codec.appending import growing
from fhash_codec.appending.growing import Figures, GrowingFile, bound_of_file, continued
from fhash_codec.appending.writer import append, plan_layers
from fhash_codec.header import full_header
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.array import transform_codecs
from fhash_formats.errors import FhashWarning, OutputError
from fhash_formats.series import ArraySeries, Coordinate, index_coordinate

CONFIG = EncodeConfig(max_error=BOUND_WRITER, effort=1, tile=TILE, timings=False)


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
    assert report["max_abs_error"] <= BOUND_WRITER
    with fhash_codec.open(run) as volume:
        assert volume.verify()
        after = volume[:]
        np.testing.assert_array_equal(after[:6], before)
        assert np.abs(after - frames(0, 13)).max() <= BOUND_WRITER
        np.testing.assert_array_equal(volume.coords["t"].values, np.arange(13))
    assert os.listdir(run.parent) == ["run.fhz"]
    found = fhash_codec.diff(frames(0, 13), run)
    assert report["psnr"] == pytest.approx(found["psnr"], abs=0.02)
    assert report["psnr"] <= found["psnr"]
    assert report["rmse"] >= found["rmse"]


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


def dated(first: int, end: int, start: int = 0, **options) -> xr.DataArray:
    """Frames a day apart as xarray has them, labelled as a wind. start: day of the first step."""
    days = np.datetime64("2000-01-01", "ns") + np.timedelta64(1, "D") * (
        np.arange(first, end) + start
    )
    attributes = {"units": "m s-1", "standard_name": "eastward_wind", **options.pop("attrs", {})}
    coords = {"time": days, "x": np.arange(12.0) / 4, **options.pop("coords", {})}
    dims = ("time", "z", "y", "x")
    return xr.DataArray(
        frames(first, end), coords, dims, name=options.pop("name", "u"), attrs=attributes
    )


def of_calendar(array: xr.DataArray, units: str, calendar: str = "standard") -> xr.DataArray:
    array.time.encoding.update(units=units, calendar=calendar)
    return array


@pytest.fixture
def wind(tmp_path) -> Path:
    path = tmp_path / "wind.fhz"
    fhash_codec.encode(of_calendar(dated(0, 3), "days since 2000-01-01"), path, CONFIG)
    return path


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (dated(3, 6, name="v"), "has the variable 'v'"),
        (dated(3, 6, attrs={"standard_name": "northward_wind"}), "the standard_name 'northward_"),
        (dated(3, 6, attrs={"units": "km h-1"}), "has the unit km h-1"),
        (dated(3, 6, coords={"x": np.arange(12.0)}), "has positions along x: 0 to 11"),
        (dated(3, 6).astype("f8"), "has values of type float64"),
        (dated(3, 6, start=-1), "begins at time 2, and the file ends at 2"),
        (dated(3, 6).isel(x=slice(None, None, -1)), "has positions along x: 2.75 to 0"),
        (dated(3, 6).isel(time=slice(None, None, -1)), "times must be finite and ascend"),
        (dated(3, 6).convert_calendar("noleap"), "has not the units of the time in"),
    ],
)
def test_another_series_is_not_appended(wind, more: xr.DataArray, message: str) -> None:
    before = wind.read_bytes()
    with pytest.raises(InputError, match=message):
        append(more, wind)
    assert wind.read_bytes() == before


@pytest.mark.parametrize(
    ("units", "calendar"),
    [("hours since 2000-01-04", "standard"), ("days since 1999-12-31", "proleptic_gregorian")],
)
def test_dates_are_counted_as_in_the_file(wind, units: str, calendar: str) -> None:
    more = of_calendar(dated(3, 6, attrs={"units": "m/s"}), units, calendar)
    append(more, wind)
    with fhash_codec.open(wind) as volume:
        assert volume.coords["t"].values.tolist() == [0, 1, 2, 3, 4, 5]
        assert volume.coords["t"].attributes["units"] == "days since 2000-01-01"
        assert np.abs(volume[:] - frames(0, 6)).max() <= BOUND_WRITER


def test_steps_without_times_go_on_evenly_and_it_is_said(wind) -> None:
    with pytest.warns(FhashWarning, match="no times: its steps go on from 3 to 5, .*days since"):
        append(frames(3, 6), wind)
    with fhash_codec.open(wind) as volume:
        assert volume.coords["t"].values.tolist() == [0, 1, 2, 3, 4, 5]
        assert volume.units == "m s-1"


def test_times_that_have_no_distance_are_not_guessed(tmp_path) -> None:
    fhash_codec.encode(series(0, 3, [1.0, 2.0, 4.5]), tmp_path / "a.fhz", CONFIG)
    with pytest.raises(InputError, match="has no times, and those of the file"):
        append(series(3, 6), tmp_path / "a.fhz")
    fhash_codec.encode(series(0, 3, [3.0, 2.0, 1.0]), tmp_path / "b.fhz", CONFIG)
    with pytest.raises(InputError, match="its times do not ascend"):
        append(series(3, 6, [4.0, 5.0, 6.0]), tmp_path / "b.fhz")


def test_counts_with_a_fill_value_go_on_as_counts(tmp_path) -> None:
    """They are read as floats, and no value is missing."""
    counts, path = np.rint(frames(0, 6) * 1000).astype("i2"), tmp_path / "a.fhz"
    fhash_codec.encode(counts[:3], path, replace(CONFIG, max_error=0))
    append(ArraySeries(counts[3:], missing=[-9999]), path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[:], counts)
        assert volume.dtype == np.int16
    wide = np.full((3, 1, 2, 3), 2**60 + 1)
    fhash_codec.encode(wide, tmp_path / "b.fhz", EncodeConfig(max_error=0, tile="3x1x2x3"))
    with pytest.raises(InputError, match=r"integers beyond 2\^53"):
        append(ArraySeries(wide, missing=[-1]), tmp_path / "b.fhz")


def test_fill_values_that_nobody_declared_are_refused_as_by_encode(run) -> None:
    values = frames(6, 12)
    values[:, 0, :2] = -9999
    for refused in (append, lambda source, _: fhash_codec.encode(source, "a.fhz", CONFIG)):
        with pytest.raises(InputError, match=r"has -9999 at .* of its vertices"):
            refused(values, run)
    append(ArraySeries(values, keep_extremes=True), run)


HIDDEN = np.ma.masked_greater(frame(0), 0.5)


@pytest.mark.parametrize(
    "given",
    [
        HIDDEN,
        list(HIDDEN),
        dask.array.from_array(HIDDEN),
        dask.array.from_array(frame(0)).map_blocks(np.ma.masked_greater, 0.5),
        xr.DataArray(HIDDEN, dims=("z", "y", "x")),
    ],
)
def test_what_a_mask_hides_is_never_written(run, given) -> None:
    hidden = int(HIDDEN.mask.sum())
    with (
        Writer(run.with_name("w.fhz"), shape=SHAPE_WRITER, config=CONFIG) as writer,
        pytest.raises(InputError, match=f"step 0: {hidden} of its values are missing"),
    ):
        writer.append(given)
    if not isinstance(given, xr.DataArray):
        given = [given] if isinstance(given, list) else given[None]
    with pytest.raises(InputError, match="step 0 has values that are missing"):
        append(given, run)
    fhash_codec.encode(given, run, CONFIG, force=True)
    with fhash_codec.open(run) as volume:
        assert np.isnan(volume[:]).sum() == hidden
    assert fhash_codec.diff(given, run)["max_abs_error"] <= BOUND_WRITER


def test_hidden_integers_are_refused(tmp_path) -> None:
    counts = np.ma.masked_greater(np.rint(frame(0) * 1000).astype("i2"), 500)
    with Writer(tmp_path / "w.fhz", shape=SHAPE_WRITER, config=CONFIG) as writer:
        for given in (counts, list(counts)):
            with pytest.raises(InputError, match="step 0: masked values of type int16"):
                writer.append(given)
        writer.append(np.ma.array(counts.data))
        writer.append(counts.data.astype(">i2")[:, ::-1])


def test_labelled_frames_belong_to_the_file_and_bring_their_times(tmp_path) -> None:
    path = tmp_path / "w.fhz"
    options = {"name": "u", "units": "m/s", "time_units": "hours since 2000-01-01"}
    options["coords"] = {"x": np.arange(12.0, dtype="f4") / 4}
    more = dated(0, 6)
    with Writer(path, shape=SHAPE_WRITER, config=CONFIG, **options) as writer:
        for step in range(3):
            writer.append(more[step])
        for wrong, message in (
            (dated(3, 4, name="v"), "step 3: the frame has the variable 'v'"),
            (dated(3, 4, attrs={"units": "K"}), "step 3: the frame has the unit K"),
            (dated(3, 4).assign_coords(x=np.arange(12)), "step 3: the frame has positions along x"),
            (more, "has 6 steps; append one at a time"),
        ):
            with pytest.raises(InputError, match=message):
                writer.append(wrong)
    with Writer.resume(path) as writer:
        with pytest.raises(InputError, match="has the variable 'v'"):
            writer.append(dated(3, 4, name="v"))
        writer.append(more[3])
    with fhash_codec.open(path) as volume:
        assert volume.coords["t"].values.tolist() == [0, 24, 48, 72]
    with (
        Writer(tmp_path / "n.fhz", shape=SHAPE_WRITER, config=CONFIG) as writer,
        pytest.raises(InputError, match=r"has times in .*since.*give it times in such units"),
    ):
        writer.append(more[0].drop_vars("x"))


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
        (frames(6, 9)[:, :, :9], r"has a frame \(z, y, x\) of shape \(4, 9, 12\)"),
        (frames(6, 9).astype("f8"), "has values of type float64"),
        (with_gap(frames(6, 12)), "step 4 has values that are missing"),
        (ArraySeries(frames(6, 9), coords=place), "has positions along x: 1 to 12, .* 0 to 11"),
        (run, "is encoded already"),
    ):
        with pytest.raises(InputError, match=message):
            append(source, run)
        assert run.read_bytes() == before
        assert os.listdir(run.parent) == ["run.fhz"]
    # Units that only one of the two has are no contradiction, but hours are no numbers of steps.
    with pytest.raises(InputError, match=r"has times in 'h', and .* has none but the numbers"):
        append(ArraySeries(frames(6, 9), coords=hours), run)
    append(metres, run, keep=3)


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


LAYER = 3


def written(path: Path, steps: int, **options) -> Path:
    with Writer(path, shape=SHAPE_WRITER, config=CONFIG, **options) as writer:
        for step in range(steps):
            writer.append(frame(step))
    return path


def test_the_file_is_readable_after_every_layer(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    with Writer(path, shape=SHAPE_WRITER, config=CONFIG) as writer:
        for step in range(10):
            writer.append(frame(step))
            assert (writer.steps, writer.steps_written) == (step + 1, (step + 1) // LAYER * LAYER)
            if writer.steps_written:
                with fhash_codec.open(path) as volume:
                    assert volume.shape == (writer.steps_written, *SHAPE_WRITER)
            else:
                assert not path.exists()
    assert (writer.steps, writer.steps_written) == (10, 10)
    assert os.listdir(tmp_path) == ["run.fhz"]
    with fhash_codec.open(path) as volume:
        assert volume.verify()
        assert np.abs(volume[:] - frames(0, 10)).max() <= BOUND_WRITER
        assert volume.chunks == (LAYER, *SHAPE_WRITER)
        np.testing.assert_array_equal(volume.coords["t"].values, np.arange(10))


def test_its_figures_are_those_of_a_comparison(tmp_path) -> None:
    path = written(tmp_path / "run.fhz", 7)
    with fhash_codec.open(path) as volume:
        told = volume.info
    found = fhash_codec.diff(frames(0, 7), path)
    quality = told["quality"]
    assert quality["psnr"] == pytest.approx(found["psnr"], rel=1e-5)
    assert quality["psnr"] <= found["psnr"]
    for name in ("rmse", "max_abs_error"):
        assert quality[name] == pytest.approx(found[name], rel=1e-5)
        assert quality[name] >= found[name]
    for step, other in zip(quality["per_step"], found["quality"]["per_step"], strict=True):
        assert step["rmse"] == pytest.approx(other["rmse"], rel=2e-3)
        assert step["rmse"] >= other["rmse"]
    values = frames(0, 7)
    assert told["value_range"] == [values.min(), values.max()]
    assert told["config"]["max_error"] == BOUND_WRITER
    assert quality["max_abs_error"] <= BOUND_WRITER


def test_resumed_it_goes_on_as_if_it_had_not_stopped(tmp_path) -> None:
    path = written(tmp_path / "run.fhz", 6)
    with Writer.resume(path) as writer:
        assert writer.steps == 6
        for step in range(6, 11):
            writer.append(frame(step))
    assert os.listdir(tmp_path) == ["run.fhz"]
    with fhash_codec.open(written(tmp_path / "whole.fhz", 11)) as whole:
        expected = whole[:]
        with fhash_codec.open(path) as volume:
            assert volume.verify()
            np.testing.assert_array_equal(volume[:], expected)
            assert volume.info["model"]["parameters"] == whole.info["model"]["parameters"]
            np.testing.assert_array_equal(volume.coords["t"].values, np.arange(11))


def test_a_short_last_layer_is_not_extended_but_may_be_dropped(tmp_path) -> None:
    path = written(tmp_path / "run.fhz", 7)
    with pytest.raises(InputError, match=r"within a layer of 3 steps.*keep 6 steps"):
        Writer.resume(path)
    with pytest.raises(InputError, match="8 steps are to be kept; it has 7"):
        Writer.resume(path, steps=8)
    with Writer.resume(path, steps=3) as writer:
        for step in range(3, 9):
            writer.append(frame(step))
    with fhash_codec.open(path) as volume:
        assert np.abs(volume[:] - frames(0, 9)).max() <= BOUND_WRITER
        assert len(volume.info["quality"]["per_step"]) == 9


def test_files_of_encode_go_on_where_they_promise_a_bound(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    fhash_codec.encode(
        frames(0, 6), path, EncodeConfig(max_error=BOUND_WRITER, effort=5, tile=TILE)
    )
    with Writer.resume(path) as writer:
        for step in range(6, 9):
            writer.append(frame(step))
    with fhash_codec.open(path) as volume:
        assert volume.verify()
        assert np.abs(volume[:] - frames(0, 9)).max() <= BOUND_WRITER
    fhash_codec.encode(
        frames(0, 6), tmp_path / "psnr.fhz", EncodeConfig(psnr=40, effort=1, tile=TILE)
    )
    with pytest.raises(InputError, match="does not promise a bound"):
        Writer.resume(tmp_path / "psnr.fhz")
    feature = EncodeConfig(
        max_error=BOUND_WRITER, effort=1, tile=TILE, features=("interval:0.5:1",)
    )
    fhash_codec.encode(frames(0, 6), tmp_path / "feature.fhz", feature)
    with pytest.raises(InputError, match="keeps features"):
        Writer.resume(tmp_path / "feature.fhz")


def test_coordinates_and_labels(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    coords = {"z": Coordinate(name="lev", values=np.array([1.0, 2, 4, 8])), "x": np.arange(12) / 3}
    options = {"coords": coords, "name": "u", "units": "m s-1", "time_units": "hours"}
    with Writer(path, shape=SHAPE_WRITER, config=CONFIG, attributes={"a": 1}, **options) as writer:
        for step, now in enumerate((0.0, 0.1, 0.7, 2.0)):
            writer.append(frame(step), time=now)
    with fhash_codec.open(path) as volume:
        assert (volume.name, volume.units, dict(volume.attrs)) == ("u", "m s-1", {"a": 1})
        np.testing.assert_array_equal(volume.coords["t"].values, [0.0, 0.1, 0.7, 2.0])
        assert volume.coords["t"].attributes == {"units": "hours"}
        assert volume.coords["z"].name == "lev"
        np.testing.assert_array_equal(volume.coords["z"].values, [1, 2, 4, 8])
        np.testing.assert_array_equal(volume.coords["x"].values, np.arange(12) / 3)
    with pytest.raises(InputError, match="the coordinate of x has shape"):
        Writer(tmp_path / "b.fhz", shape=SHAPE_WRITER, config=CONFIG, coords={"x": np.arange(3)})
    with pytest.raises(InputError, match="coords names 'w'"):
        Writer(tmp_path / "b.fhz", shape=SHAPE_WRITER, config=CONFIG, coords={"w": np.arange(3)})


def test_frames_that_do_not_fit_are_left_out_and_nothing_is_lost(tmp_path) -> None:
    path, good = tmp_path / "run.fhz", frame(0)
    bad = good.copy()
    bad[0, 0, :2] = np.nan
    with Writer(path, shape=SHAPE_WRITER, config=CONFIG) as writer:
        writer.append(good)
        for wrong, time_of_step, message in (
            (good[:, :-1], None, r"step 1: the frame has shape \(4, 9, 12\)"),
            (bad, None, "step 1: 2 of its values are missing or infinite"),
            (good.astype("f8"), None, "step 1: the frame is float64, those before are float32"),
            (good.astype(complex), None, "complex128 cannot be encoded"),
            (good, 0.0, "step 1: its time is 0, the one before has 0.0; times must"),
            (good, np.nan, "step 1: its time is nan"),
            (good, "noon", "step 1: its time is 'noon'"),
        ):
            with pytest.raises(InputError, match=message):
                writer.append(wrong, time=time_of_step)
            assert writer.steps == 1
        for step in range(1, 4):
            writer.append(frame(step))
    with pytest.raises(InputError, match="the writer is closed"):
        writer.append(good)
    with fhash_codec.open(path) as volume:
        assert np.abs(volume[:] - frames(0, 4)).max() <= BOUND_WRITER


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "promises a bound"),
        ({"config": EncodeConfig(psnr=40)}, "a PSNR or a ratio depends"),
        ({"max_error_rel": 0.01}, "give value_range"),
        ({"config": EncodeConfig(max_error=1, features=("interval:0:1",))}, "keeps everything"),
        ({"config": EncodeConfig(preset="published", tables="float16")}, "preset 'published'"),
        ({"max_error": 1, "shape": (4, 10)}, "three lengths"),
        ({"max_error": 1, "path": "run.nc"}, "a container is not a .nc file"),
    ],
)
def test_settings_that_cannot_be_kept_are_refused_at_once(tmp_path, options, message) -> None:
    path = tmp_path / options.pop("path", "run.fhz")
    with pytest.raises(InputError, match=message):
        Writer(path, **{"shape": SHAPE_WRITER, **options})
    assert os.listdir(tmp_path) == []


def test_a_bound_relative_to_the_expected_range(tmp_path) -> None:
    path = tmp_path / "run.fhz"
    with Writer(path, shape=SHAPE_WRITER, max_error_rel=0.001, value_range=(-2, 2)) as writer:
        for step in range(4):
            writer.append(frame(step))
    with fhash_codec.open(path) as volume:
        assert volume.info["config"]["max_error"] == 0.004
        assert np.abs(volume[:] - frames(0, 4)).max() <= 0.004


def test_a_layer_that_cannot_be_written_ends_it_with_the_layers_before(
    tmp_path, monkeypatch
) -> None:
    path = tmp_path / "run.fhz"
    writer = Writer(path, shape=SHAPE_WRITER, config=CONFIG)
    for step in range(LAYER):
        writer.append(frame(step))

    def fail(*arguments):
        raise OutputError("no space left")

    monkeypatch.setattr(GrowingFile, "publish", fail)
    writer.append(frame(3))
    writer.append(frame(4))
    with pytest.raises(OutputError, match="no space left"):
        writer.append(frame(5))
    writer.close()
    assert os.listdir(tmp_path) == ["run.fhz"]
    with fhash_codec.open(path) as volume:
        assert volume.shape[0] == LAYER


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_killed_it_loses_no_layer_that_was_written(tmp_path) -> None:
    path, chance = tmp_path / "run.fhz", random.Random(1)
    before = 0
    for kill in range(3):
        process = subprocess.Popen(
            [
                sys.executable,
                str(Path(__file__).with_name("kill_writer.py")),
                str(path),
                *(["resume"] if kill else []),
            ],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert process.stdout is not None
        told = before
        while told < before + 4 * LAYER:
            told = int(process.stdout.readline())
        time.sleep(chance.random() / 20)
        process.send_signal(signal.SIGKILL)
        told = max([told, *map(int, process.stdout.read().split())])
        process.stdout.close()
        process.wait()
        with fhash_codec.open(path) as volume:
            assert volume.verify()
            steps = volume.shape[0]
            assert np.abs(volume[:] - frames(0, steps)).max() <= BOUND_WRITER
        assert told <= steps <= told + LAYER
        before = steps
    with Writer.resume(path):
        pass
    assert os.listdir(tmp_path) == ["run.fhz"]


@pytest.mark.parametrize("bound", [0, 3])
def test_integers_far_from_zero_and_from_each_other(tmp_path, bound) -> None:
    near = np.rint(300 * np.sin(np.arange(4 * 60) / 9)).astype(np.int64).reshape(4, 3, 4, 5)
    steps = [near[0] + 2**61, near[1] + 2**61, near[2] - 2**62, near[3] + (2**63 - 400)]
    with Writer(
        tmp_path / "a.fhz",
        shape=near.shape[1:],
        max_error=bound,
        config=EncodeConfig(tile="1x3x4x5", effort=1),
    ) as writer:
        for step in steps:
            writer.append(step)
    values = np.stack(steps).astype(object)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        errors = abs(volume[...].astype(object) - values)
        assert errors.max() <= bound
        assert volume.info["quality"]["max_abs_error"] == errors.max()
        assert volume.info["value_range"] == [values.min(), values.max()]


WRITER = ContainerWriter("unused.fhz")
"""A writer that gets nothing: few steps have their figures in the header."""


def measured(count: int = 3) -> tuple[Figures, np.ndarray]:
    errors = np.random.default_rng(0).normal(0, 0.01, (count, 2, 3, 4))
    figures = Figures(Figures.scale_of(ValueRange(0.0, 5.0)))
    for error in errors:
        figures.steps.append(figures.measure(np.zeros(error.shape), error))
    return figures, errors


def test_what_a_header_tells_is_taken_up_again() -> None:
    figures, _ = measured()
    told = figures.header(WRITER, 5.0, (3, 2, 3, 4))
    header = {
        "domain": {"shape": [3, 2, 3, 4]},
        "value_range": [0.0, 5.0],
        "model": {},
        "history": {},
        "quality": told,
    }
    full = full_header(header, {})
    again = Figures.of_header(full, figures.scale).header(WRITER, 5.0, (3, 2, 3, 4))
    # Figures of steps are rounded to hundredths of a dB.
    assert again["rmse"] == pytest.approx(told["rmse"], rel=2e-3)
    assert again["rmse"] >= told["rmse"]
    assert again["max_abs_error"] == told["max_abs_error"]
    steps = full["quality"]["per_step"]
    for wrong in (steps[:2], [*steps[:2], {"rmse": None, "max_abs_error": 1.0}]):
        with pytest.raises(InputError, match="does not tell the errors of step 2"):
            Figures.of_header({**header, "quality": {"per_step": wrong}}, 1.0)


SHAPE = (3, 4, 5)


@pytest.fixture
def begun(tmp_path):
    """A file without steps, and its frames."""
    frames = np.random.default_rng(0).random((6, *SHAPE)).astype(np.float32)
    frames[3:] += 2
    config = EncodeConfig(max_error=0.05, effort=1, tile="2x3x4x5")
    coder, header = plan_layers(list(frames[:2]), config, 0.05, None)
    variable = {"name": "u", "units": "", "dtype": "float32", "attributes": {}}
    lengths = zip(("t", "z", "y", "x"), (1, *SHAPE), strict=True)
    coords = {axis: index_coordinate(axis, n) for axis, n in lengths}
    header |= {"variable": variable}
    return GrowingFile(tmp_path / "a.fhz", coder, header, coords, Figures(1.0)), frames


def add(file: GrowingFile, frames: np.ndarray, first: int, **options) -> None:
    with ThreadPoolExecutor(1) as workers:
        layer = file.coder.code(list(frames[first : first + 2]), file.figures, workers)
    file.add(layer, [float(first), first + 1.0], **options)


def test_there_is_a_limit_of_steps(begun, monkeypatch) -> None:
    file, frames = begun
    monkeypatch.setattr(growing, "MAX_STEPS", 3)
    with file:
        add(file, frames, 0)
        with pytest.raises(InputError, match="at most 3: begin another"):
            add(file, frames, 2)
    with fhash_codec.open(file.path) as volume:
        assert volume.shape[0] == 2


def test_a_tile_that_decodes_otherwise_is_told(begun, monkeypatch) -> None:
    file, frames = begun
    monkeypatch.setattr("fhash_codec.appending.growing.decode_tile", lambda *_: frames[0])
    with file, pytest.raises(RuntimeError, match="decodes to other values"):
        add(file, frames, 0)


BOUND_RESUMING = 0.02
CONFIG_GROWING = EncodeConfig(max_error=BOUND_RESUMING, effort=1, tile="2x4x6x4")


@pytest.fixture
def run_growing(tmp_path, field):
    path = tmp_path / "run.fhz"
    fhash_codec.encode(field((4, 4, 6, 8)), path, CONFIG_GROWING)
    return path


def with_array(run_growing, path, name, values, dimension_names):
    """A copy of a file with another array."""
    with Container.open(run_growing) as container, ContainerWriter(path) as writer:
        table = container.arrays["table_1"]
        writer.add_array(
            "table_1",
            shape=table.shape,
            dtype=table.dtype,
            chunk_shape=table.chunk_shape,
            together=table.together,
            chunks=(bytes(table.coded(index)) for index in np.ndindex(*table.grid)),
            codecs=transform_codecs(table.settings),
        )
        writer.add_whole(name, values, dimension_names=dimension_names, attributes={"a": 1})
        header = dict(container.header)
        writer.commit({**header, "more": {"key": 1}})
    return path


def test_arrays_and_keys_that_do_not_depend_on_time_are_carried(run_growing, tmp_path) -> None:
    path = with_array(run_growing, tmp_path / "a.fhz", "auxiliary/area", np.arange(6.0), ["y"])
    with continued(path) as growing:
        growing.publish()
    with Container.open(path) as container:
        area = container.arrays["auxiliary/area"]
        np.testing.assert_array_equal(area.read(), np.arange(6.0))
        assert area.attributes == {"a": 1}
        assert container.header["more"] == {"key": 1}
    for names in (["time"], None):
        other = tmp_path / f"{names}.fhz"
        path = with_array(run_growing, other, "auxiliary/pressure", np.arange(4.0), names)
        with pytest.raises(InputError, match="has a value for each step"), continued(path):
            pass


def test_a_damaged_tile_is_found_before_anything_is_written(run_growing) -> None:
    data = bytearray(run_growing.read_bytes())
    data[data.index(b"/c/0/0/0/0") + 40] ^= 1
    run_growing.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"run\.fhz"), continued(run_growing):
        pass
    assert run_growing.read_bytes() == data


def test_the_bound_of_a_file() -> None:
    header = {"value_range": [1.0, 3.0]}
    assert bound_of_file({**header, "config": {"max_error": 2}}) == 2
    assert bound_of_file({**header, "config": {"max_error_rel": 0.1}}) == pytest.approx(0.2)
    assert bound_of_file({**header, "config": {"psnr": 40, "max_error": None}}) is None
