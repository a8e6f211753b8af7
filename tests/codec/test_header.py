"""Names of containers: those of data files are refused."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import cftime
import numpy as np
import pytest
import xarray as xr
from cf_files import KINDS, Kind, smooth

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec import header as step_figures
from fhash_codec.header import (
    brief_quality,
    check_name,
    full_header,
    read_steps,
    steps_together,
    write_steps,
)
from fhash_codec.times import number_text, time_of, time_range, time_text, times_of
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import RegionError
from fhash_formats.readers.registry import open_series
from fhash_formats.series import Coordinate


@pytest.mark.parametrize("name", ["run.h5", "RUN.NC", "a.b.vti", "run.zarr"])
def test_names_of_data_are_refused(name) -> None:
    with pytest.raises(InputError, match=r"give it a name that ends in \.fhz"):
        check_name(Path(name))


WRITER = ContainerWriter("unused.fhz")
"""A writer that gets nothing: few steps have their figures in the header."""


def header(quality: dict[str, Any], value_range: tuple[float, float] = (-1.0, 1.0)) -> Any:
    """A header of one step."""
    return {
        "value_range": list(value_range),
        "domain": {"shape": [1, 2, 3, 4]},
        "model": {"gains": [["start", 9, 0.5], ["end", 7, 1.0], 5]},
        "history": {"epoch": [3]},
        "quality": quality,
    }


def test_what_follows_from_the_rest_is_left_out_and_comes_back() -> None:
    step = {"step": 0, "psnr": 39.9999999, "rmse": 0.0200000001, "max_abs_error": 0.25}
    window = {"window": 11, "sigma": 1.5, "data_range": 2.0, "steps": [0]}
    brief = brief_quality(WRITER, {"per_step": [step], "ssim_window": window}, 2.0, (1, 2, 3, 4))
    assert brief["ssim_window"] == {"window": 11, "sigma": 1.5}
    assert brief.keys() == {"steps", "ssim_window"}
    full = full_header(header(brief), {})
    assert full["quality"]["ssim_window"] == window
    (entry,) = full["quality"]["per_step"]
    assert 39.98 <= entry["psnr"] <= step["psnr"]
    assert step["rmse"] <= entry["rmse"] <= 1.00125 * step["rmse"]
    assert full["history"] == [{"seconds": None, "psnr": None, "epoch": 3}]
    assert full["model"]["gains"] == [
        {"what": "start", "bytes": 9, "seconds": 0.5},
        {"what": "end", "bytes": 7, "seconds": 1.0},
    ]
    other = {**window, "steps": [3], "data_range": 1.9}
    brief = brief_quality(WRITER, {"per_step": [], "ssim_window": other}, 2.0, (1, 2, 3, 4))
    assert brief["ssim_window"] == other


QUICK = EncodeConfig(effort=1, psnr=45, without=("ssim",), timings=False)
PAPER = EncodeConfig(preset="published", tables="float16", epochs=1, width=8, timings=False)


def plain_file(path: Path) -> Path:
    """A variable with plain coordinates and a usual global attribute."""
    xr.Dataset(
        {"theta": (("time", "level", "lat", "lon"), smooth(4, 5, 12, 16).astype("f4"))},
        {
            "time": ("time", np.arange(4.0), {"units": "hours since 2001-01-01"}),
            "level": ("level", np.arange(5, dtype="i4"), {"units": "1"}),
            "lat": ("lat", np.linspace(40, 51, 12, dtype="f4"), {"units": "degrees_north"}),
            "lon": ("lon", np.linspace(0, 15, 16, dtype="f4"), {"units": "degrees_east"}),
        },
        {"Conventions": "CF-1.8"},
    ).to_netcdf(path, engine="h5netcdf")
    return path


def test_plain_coordinates_cost_at_most_300_bytes(tmp_path) -> None:
    source = plain_file(tmp_path / "simulation_output.nc")
    with open_series(source) as series:
        fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(effort=1, psnr=45))
        series.metadata = lambda: None
        fhash_codec.encode(series, tmp_path / "b.fhz", EncodeConfig(effort=1, psnr=45))
    sizes = [(tmp_path / name).stat().st_size for name in ("a.fhz", "b.fhz")]
    assert 0 < sizes[0] - sizes[1] <= 300


@pytest.mark.parametrize("config", [QUICK, PAPER], ids=["compact", "paper"])
def test_both_models_and_plain_files_keep_everything(tmp_path, config) -> None:
    kind = KINDS["rotated"]()
    # too many numbers for the header
    long = np.arange(400.0)
    kind.dataset["tas"].attrs["ancillary_variables"] = "long"
    kind = Kind(kind.dataset.assign(long=(("n",), long)), "tas")
    source = kind.write(tmp_path / "source.nc")
    with open_series(source, var="tas") as series:
        fhash_codec.encode(series, tmp_path / "run.fhz", config)
        wanted = series.metadata
    fhash_codec.export_plain(tmp_path / "run.fhz", tmp_path / "plain.fhz")
    for name in ("run.fhz", "plain.fhz"):
        with fhash_codec.open(tmp_path / name) as volume:
            found = volume.metadata
            assert "auxiliary/long" in volume.container.arrays
            volume.verify()
        assert found.dimensions == {"time": "t", "rlat": "y", "rlon": "x"}
        assert [each.name for each in found.variables] == [each.name for each in wanted.variables]
        for one, other in zip(found.variables, wanted.variables, strict=True):
            assert one.values.dtype == other.values.dtype
            assert one.values.tobytes() == other.values.tobytes()
        np.testing.assert_equal(dict(found.variable_attributes), wanted.variable_attributes)


def test_history_has_the_date_where_times_are_kept(tmp_path) -> None:
    source = plain_file(tmp_path / "a.nc")
    config = EncodeConfig(
        effort=1, max_error=0.5, features=("interval:270:280", "interval:281:300"), timings=True
    )
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        line = volume.metadata.attributes["history"]
    date, _, rest = line.partition(" ")
    assert dt.datetime.fromisoformat(date).tzinfo is not None
    assert rest.startswith(f"fhash {fhash_codec.__version__}: fhash encode a.nc")
    for words in ("--feature interval:270:280", "--effort 1", "--max-error 0.5"):
        assert f" {words}" in line


RMSE = [0.001, 0.0, None, 0.00123456, 0.5]
LARGEST = [0.004, 0.0, None, 0.0041999, 1.9]


class Arrays:
    """Takes arrays as a writer does, and gives them as a container does."""

    def __init__(self) -> None:
        self.stored: dict[str, Any] = {}

    def add_whole(self, name: str, array: np.ndarray, attributes: dict[str, Any]) -> None:
        self.stored[name] = self
        self.values, self.attributes = array, attributes

    def read(self) -> np.ndarray:
        return self.values


def back(
    rmse: list[float | None],
    largest: list[float | None],
    ends: tuple[float, float],
    together: int = 1,
) -> tuple[list[dict[str, float | None]], Arrays]:
    """The figures as they are read again, and the arrays that were written."""
    writer: Any = Arrays()
    figures = {"rmse": rmse, "max_abs_error": largest}
    steps = write_steps(writer, figures, ends[1] - ends[0], together)
    known = [value for value in largest if value is not None]
    quality = {"max_abs_error": max(known), **({"steps": steps} if steps else {})}
    header = {"value_range": ends, "quality": quality, "domain": {"shape": [len(rmse), 1, 1, 1]}}
    return read_steps(header, writer.stored), writer


@pytest.mark.parametrize("most", [512, 2])
def test_figures_are_never_better_than_they_are(most: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(step_figures, "MAX_LISTED", most)
    steps, writer = back(RMSE, LARGEST, (-1.0, 3.0))
    assert bool(writer.stored) == (most == 2)
    for name, figures in (("rmse", RMSE), ("max_abs_error", LARGEST)):
        for step, old in zip(steps, figures, strict=True):
            new = step[name]
            assert new == old if not old else old * (1 - 1e-12) <= new <= old * 1.00125
    assert steps[4]["max_abs_error"] == 1.9


@pytest.mark.parametrize("most", [512, 2])
def test_neighbouring_steps_have_one_figure_together(most: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(step_figures, "MAX_LISTED", most)
    rmse = [3e-3, 4e-3, None, 0.0, 1e-3, None, None, None]
    largest = [5e-3, 7e-3, None, 0.0, 2e-3, None, None, None]
    steps, _ = back(rmse, largest, (0.0, 1.0), together=2)
    assert [step["step"] for step in steps] == list(range(8))
    assert [step["rmse"] for step in steps[::2]] == [step["rmse"] for step in steps[1::2]]
    assert steps[0]["rmse"] == pytest.approx(12.5**0.5 * 1e-3, rel=2e-3)
    assert steps[0]["max_abs_error"] == 7e-3
    assert steps[2]["rmse"] == steps[2]["max_abs_error"] == 0.0
    assert steps[4]["rmse"] == pytest.approx(1e-3, rel=2e-3)
    assert steps[6]["rmse"] is None


@pytest.mark.parametrize(
    ("shape", "together"),
    [
        ((8, 1, 1, 1), 1),
        ((127, 1, 1, 1), 1),
        ((128, 1, 1, 1), 2),
        ((23741, 2, 2, 2), 370),
        ((9000, 16, 16, 16), 1),
        ((9000, 8, 16, 16), 2),
    ],
)
def test_small_frames_have_figures_together(shape: tuple[int, ...], together: int) -> None:
    assert steps_together(shape) == together


def test_measured_steps_that_are_even_are_counted() -> None:
    window = {"window": 11, "sigma": 1.5, "data_range": 2.0, "steps": [0, 3, 5, 8]}
    figures = dict.fromkeys(("psnr", "rmse", "max_abs_error"))
    per_step = [{"step": step, **figures} for step in range(9)]
    quality = {"per_step": per_step, "ssim_window": window}
    brief = brief_quality(WRITER, quality, 2.0, (9, 2, 3, 4))
    assert brief["ssim_window"]["steps"] == 4
    whole = header(brief) | {"domain": {"shape": [9, 2, 3, 4]}}
    assert full_header(whole, {})["quality"]["ssim_window"] == window


def test_levels_beyond_float64_have_no_figure() -> None:
    steps = {"rmse": [-(10**6), 0, 10**6], "max_abs_error": [10**6, 0, 5]}
    header = {"value_range": [0, 1], "quality": {"steps": steps}, "domain": {"shape": [2]}}
    assert read_steps(header, {})[0] == dict.fromkeys(("psnr", "rmse", "max_abs_error")) | {
        "step": 0
    }
    assert read_steps({"value_range": [0, 1], "quality": {}}, {}) == []


def times(values: list[float], units: str = "days since 2001-02-10", **more: str) -> Coordinate:
    return Coordinate(name="time", values=np.array(values), attributes={"units": units, **more})


HALF_DAYS = times([0, 0.5, 1, 1.5, 2])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.75", 0.75),
        (1.5, 1.5),
        ("2001-02-11", 1),
        ("2001-02-11T12:00", 1.5),
        ("2001-02-11 06:00", 1.25),
        ("2001-02-11T18", 1.75),
    ],
)
def test_numbers_and_dates(text: str | float, expected: float) -> None:
    assert time_of(HALF_DAYS, text, "run.fhz") == expected


def test_a_day_with_one_step_is_that_step() -> None:
    noon = times([0.5, 1.5, 2.5])
    assert time_of(noon, "2001-02-11", "run.fhz") == 1.5
    assert time_of(noon, "2001-02-10", "run.fhz") == 0.5
    assert time_of(noon, "2001-02-11T00:00", "run.fhz") == 1
    two = times([0.25, 1.25, 1.75, 2.25])
    assert time_of(two, "2001-02-11", "run.fhz") == 1
    assert time_of(times([4.5, 34.5]), "2001-03", "run.fhz") == 34.5


def test_a_date_within_the_rounding_of_a_step_is_the_step() -> None:
    thirds = times([1 / 3 + 1e-13, 2 / 3, 1 - 1e-13])
    assert time_of(thirds, "2001-02-10T08:00", "run.fhz") == 1 / 3 + 1e-13
    assert time_of(thirds, "2001-02-11", "run.fhz") == 1 - 1e-13


def test_calendars_of_models() -> None:
    march = times([58, 59], "days since 2000-01-01", calendar="noleap")
    assert time_of(march, "2000-03-01", "run.fhz") == 59
    with pytest.raises(InputError, match="'2000-02-29' is no date of the calendar noleap"):
        time_of(march, "2000-02-29", "run.fhz")


def test_texts_tell_steps_apart() -> None:
    assert time_text(HALF_DAYS, 0.5) == "2001-02-10T12:00"
    assert time_text(HALF_DAYS, 1) == "2001-02-11"
    assert time_text(times([0, 1], "s"), 0.25) == "0.25 s"
    assert time_text(times([0, 1], "1"), 0.25) == "0.25"
    late = times([347921.001, 347921.002], "s")
    assert number_text(late, late.values[0]) == "347921.001"
    assert number_text(times([5], "s"), 5) == "5"
    assert number_text(times([1e-300, 1e300], "s"), 1e300) == "1e+300"
    assert number_text(times([0, 1e-300, 1e300], "s"), 1e-300) == "1e-300"
    assert time_text(times([0, float("nan")]), float("nan")) == "nan days since 2001-02-10"


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (dt.datetime(2001, 2, 11, 6), 1.25),
        (dt.datetime(2001, 2, 11, 6, tzinfo=dt.timezone(dt.timedelta(hours=6))), 1),
        (dt.date(2001, 2, 12), 2),
        (np.datetime64("2001-02-11T12"), 1.5),
        (np.datetime64("2001-02-11T06:00:00.000000000"), 1.25),
        (cftime.datetime(2001, 2, 11, 12, calendar="standard"), 1.5),
        (cftime.datetime(2001, 2, 11, 12, calendar="gregorian"), 1.5),
        (np.float32(0.5), 0.5),
        (b"2001-02-11", 1),
    ],
    ids=str,
)
def test_dates_of_python_numpy_and_cftime(time: Any, expected: float) -> None:
    assert time_of(HALF_DAYS, time, "run.fhz") == expected


@pytest.mark.parametrize("calendar", ["noleap", "360_day", "all_leap", "julian"])
def test_dates_of_cftime_are_of_the_calendar_of_the_series(calendar: str) -> None:
    dates = [cftime.datetime(2001, month, 28, 6, calendar=calendar) for month in (2, 3, 12)]
    units = "hours since 2000-02-01"
    counted = [float(cftime.date2num(date, units, calendar=calendar)) for date in dates]
    coordinate = times(counted, units, calendar=calendar)
    assert [time_of(coordinate, date, "run.fhz") for date in dates] == counted
    other = cftime.datetime(2001, 3, 1, calendar="standard")
    with pytest.raises(InputError, match=f"is of the calendar standard, the series of {calendar}"):
        time_of(coordinate, other, "run.fhz")


@pytest.mark.filterwarnings("ignore:this date/calendar/year zero convention")
def test_years_before_the_first_are_those_of_cftime() -> None:
    date = cftime.datetime(-1, 3, 1, calendar="standard", has_year_zero=False)
    units = "days since 0001-01-01"
    counted = float(cftime.date2num(date, units, calendar="standard"))
    assert time_of(times([counted, 0], units), date, "run.fhz") == counted


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (np.datetime64("NaT", "s"), "'NaT' is no date"),
        (None, "None is no time; give a number or a date"),
        ([1, 2], r"\[1, 2\] is no time"),
    ],
    ids=str,
)
def test_what_is_no_time_is_refused(time: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        time_of(HALF_DAYS, time, "run.fhz")


def test_arrays_of_times_keep_their_shape() -> None:
    dates = np.array([["2001-02-10", "2001-02-11T12"]], "datetime64[s]")
    for given in (dates, dates.astype(object), dates.astype(str), [[0, 1.5]]):
        np.testing.assert_array_equal(times_of(HALF_DAYS, given, "run.fhz"), [[0, 1.5]])
    assert times_of(HALF_DAYS, [], "run.fhz").shape == (0,)
    with pytest.raises(InputError, match="is no type of times"):
        times_of(HALF_DAYS, np.timedelta64(3, "h"), "run.fhz")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:2", (0, 2, None)),
        (":1.5", (0, 1.5, None)),
        ("1::0.25", (1, 2, 0.25)),
        ("2:0:0.5", (2, 0, 0.5)),
        ("2001-02-10:2001-02-12", (0, 2, None)),
        ("2001-02-10:2001-02-12:0.5", (0, 2, 0.5)),
        ("2001-02-10T06:00:2001-02-11T12:00", (0.25, 1.5, None)),
        ("2001-02-10T06:00:2001-02-11T12:00:24", (0.25, 1.5, 24)),
        ("2001-02-10T06:00:00:2001-02-11T12:00:00", (0.25, 1.5, None)),
        ("2001-02-10T06:00:00:2001-02-11T12:00:00:2", (0.25, 1.5, 2)),
        ("2001-02-10:2001-02-11T12:00", (0, 1.5, None)),
        ("2001-02-10T12:2001-02-11T12", (0.5, 1.5, None)),
        ("2001-02-10T12:00:", (0.5, 2, None)),
        ("0.5:2001-02-11T12:00", (0.5, 1.5, None)),
    ],
)
def test_colons_of_dates_are_told_from_those_of_ranges(
    text: str, expected: tuple[float, float, float | None]
) -> None:
    assert time_range(HALF_DAYS, text, "run.fhz") == expected


@pytest.mark.parametrize("text", ["1", "a:b", "0:1:0", "0:1:-1", "0:1:2:3", "0:1:x"])
def test_what_is_no_range_of_times(text: str) -> None:
    with pytest.raises(ValueError, match="^" + text):
        time_range(HALF_DAYS, text, "run.fhz")


def test_ends_of_a_range_are_checked_as_times_are() -> None:
    with pytest.raises(RegionError, match="outside the series, 2001-02-10 to 2001-02-12"):
        time_range(HALF_DAYS, "2001-02-10:2001-03-01", "run.fhz")
    with pytest.raises(InputError, match="the times are no dates"):
        time_range(times([0, 1], units="s"), "2001-02-10:2001-02-11", "run.fhz")
