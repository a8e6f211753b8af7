"""Many files give what they have in common, and what they have along time one after the other."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from fhash_formats.errors import FhashWarning, InputError, MissingInputError
from fhash_formats.readers.common.file_series import FileSeries, RawLayout
from fhash_formats.readers.joined import JoinedSeries, natural_order
from fhash_formats.readers.registry import open_series


def part(number: int, *, units: str = "days since 2000-01-01", **more: object) -> xr.Dataset:
    days = np.array([2 * number, 2 * number + 1], dtype="i4")
    return xr.Dataset(
        {
            "u": (("time", "lat", "lon"), np.full((2, 3, 4), float(number))),
            "time_bnds": (("time", "bnds"), np.stack([days, days + 1], axis=1)),
        },
        {
            "time": ("time", days, {"units": units, "bounds": "time_bnds"}),
            "month": ("time", np.array(["a", f"b{number}"], dtype=object)),
            "lat": ("lat", np.arange(3, dtype="f4")),
            "height": ((), 2.0),
            "run": ((), number),
        },
        {"title": "parts", "tracking_id": f"id {number}", "history": f"made {number}", **more},
    )


def written(folder: Path, *parts: xr.Dataset) -> str:
    for number, dataset in enumerate(parts):
        dataset.to_netcdf(folder / f"part_{number}.nc", engine="h5netcdf")
    return str(folder / "part_*.nc")


def test_parts_are_joined_along_time(tmp_path: Path) -> None:
    pattern = written(tmp_path, part(0), part(1), part(2))
    with open_series(pattern, var="u") as series:
        with pytest.warns(FhashWarning, match=r":tracking_id .*run .*$"):
            metadata = series.metadata
        assert series.read(5)[0, 0, 0] == 2
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"time", "time_bnds", "month", "lat", "height"}
    assert found["time"].values.tolist() == [0, 1, 2, 3, 4, 5]
    assert found["time"].values.dtype == np.int32
    assert found["time_bnds"].values[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert found["month"].values.tolist() == ["a", "b0", "a", "b1", "a", "b2"]
    assert metadata.attributes == {"title": "parts", "history": "made 0"}
    assert (metadata.file, metadata.digest) == ("part_*.nc", None)


def test_bounds_of_other_units_are_left_out(tmp_path: Path) -> None:
    pattern = written(tmp_path, part(0), part(0, units="days since 2000-01-03"))
    with open_series(pattern, var="u") as series, pytest.warns(FhashWarning, match="time_bnds"):
        metadata = series.metadata
    assert metadata.named("time_bnds") is None
    assert metadata.named("time").values.tolist() == [0, 1, 2, 3]


def test_files_without_a_time_get_one(tmp_path: Path) -> None:
    parts = [part(0).isel(time=0, drop=True).drop_vars("time_bnds").expand_dims(lev=2)] * 3
    with open_series(written(tmp_path, *parts), var="u") as series:
        metadata = series.metadata
    assert metadata.dimensions == {"time": "t", "lev": "z", "lat": "y", "lon": "x"}
    assert metadata.named("time").values.tolist() == [0, 1, 2]
    assert metadata.named("run").values == 0


VALUES = np.random.default_rng(0).normal(size=(12, 3, 5, 6)).astype(np.float32)


def stacked(pattern: Path, **options: Any) -> np.ndarray:
    with open_series(pattern, **options) as series:
        assert series.shape[0] == len(series.coords["t"].values)
        return np.stack(list(series.frames()))


def h5(path: Path, values: np.ndarray, **beside: Any) -> None:
    with h5py.File(path, "w") as file:
        file["v"] = values
        for name, array in beside.items():
            file[name] = array


def test_natural_order() -> None:
    names = ["f_10", "f_9", "f_09b", "f_1", "g_0", "f_", "f_1_2", "f_1_10"]
    assert sorted(names, key=natural_order) == [
        "f_",
        "f_1",
        "f_1_2",
        "f_1_10",
        "f_9",
        "f_09b",
        "f_10",
        "g_0",
    ]


@pytest.mark.parametrize("kind", ["npy", "raw", "layout", "h5"])
def test_one_step_per_file_in_the_order_of_numbers(tmp_path: Path, kind: str) -> None:
    for step, frame in enumerate(VALUES):
        if kind == "npy":
            np.save(tmp_path / f"frame_{step}.npy", frame)
        elif kind == "raw":
            (tmp_path / f"frame_{step}_6x5x3_float32.raw").write_bytes(frame.tobytes())
        elif kind == "layout":
            (tmp_path / f"frame_{step}.bin").write_bytes(frame.tobytes())
        else:
            h5(tmp_path / f"frame_{step}.h5", frame)
    layout = RawLayout({"x": 6, "y": 5, "z": 3}, "f4") if kind == "layout" else None
    np.testing.assert_array_equal(stacked(tmp_path / "frame_*", raw=layout), VALUES)
    with open_series(tmp_path / "frame_*", raw=layout, steps=slice(10, 2, -4)) as series:
        assert series.name == ("v" if kind == "h5" else "frame")
        assert series.source == str(tmp_path / "frame_*")
        np.testing.assert_array_equal(series.coords["t"].values, [10, 6])
        np.testing.assert_array_equal(series.read(1), VALUES[6])


def test_several_steps_per_file_and_character_classes(tmp_path: Path) -> None:
    for name, part in (
        ("a1", VALUES[:5]),
        ("a2", VALUES[5:6]),
        ("a10", VALUES[6:]),
        ("b1", VALUES),
    ):
        np.save(tmp_path / f"{name}.npy", part)
    np.testing.assert_array_equal(stacked(tmp_path / "a*.npy"), VALUES)
    np.testing.assert_array_equal(stacked(tmp_path / "[a]?.npy"), VALUES[:6])


def test_a_name_with_brackets_is_a_file(tmp_path: Path) -> None:
    np.save(tmp_path / "a[1].npy", VALUES)
    np.testing.assert_array_equal(stacked(tmp_path / "a[1].npy"), VALUES)


def test_times_of_the_files(tmp_path: Path) -> None:
    for step in range(3):
        h5(
            tmp_path / f"f{step}.h5",
            VALUES[2 * step : 2 * step + 2],
            time=[347921.0 + step, 347921.5 + step],
            x=np.arange(6.0) * 2,
        )
    with open_series(tmp_path / "f*.h5") as series:
        np.testing.assert_array_equal(series.coords["t"].values, 347921 + np.arange(6) / 2)
        np.testing.assert_array_equal(series.coords["x"].values, np.arange(6) * 2)
    h5(tmp_path / "f3.h5", VALUES[:2], time=[0.0, 1.0], x=np.arange(6.0) * 2)
    with pytest.raises(
        InputError, match=r"times do not increase.*0 in .*f3.h5 after 347924 in .*f2.h5"
    ):
        open_series(tmp_path / "f*.h5")
    h5(tmp_path / "f3.h5", VALUES[:2], x=np.arange(6.0) * 2)
    with pytest.raises(InputError, match=r"f3.h5 has no time, and .*f0.h5 has one"):
        open_series(tmp_path / "f*.h5")
    h5(tmp_path / "f3.h5", VALUES[:2], time=[400000.0, 400001.0], x=np.arange(6.0) * 3)
    with pytest.raises(InputError, match=r"f3.h5 has other coordinates along x than .*f0.h5"):
        open_series(tmp_path / "f*.h5")


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (VALUES[:, :2], r"a frame \(z, y, x\) of shape \(2, 5, 6\), .*a_1.npy \(3, 5, 6\)"),
        (VALUES.astype("f8"), "values of type float64, .*a_1.npy float32"),
        (VALUES > 0, "boolean"),
    ],
)
def test_files_that_differ_are_named(tmp_path: Path, other: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a_1.npy", VALUES)
    np.save(tmp_path / "a_2.npy", other)
    with pytest.raises(InputError, match=rf"a_2.npy .*{words}"):
        open_series(tmp_path / "a_*.npy")


def test_no_file_matches(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"no file matches .*none_\*\.raw"):
        open_series(tmp_path / "none_*.raw")


def test_a_file_that_changes_is_refused(tmp_path: Path) -> None:
    for step in range(3):
        np.save(tmp_path / f"f{step}.npy", VALUES[step])
    with open_series(tmp_path / "f*.npy") as series:
        series.read(0)
        np.save(tmp_path / "f1.npy", VALUES)
        with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
            series.read(1)
        np.testing.assert_array_equal(series.read(2), VALUES[2])
        with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
            series.check()


def test_a_file_that_changes_while_it_is_opened_is_refused(tmp_path: Path) -> None:
    for step in range(2):
        np.save(tmp_path / f"f{step}.npy", VALUES[step])
    with open_series(tmp_path / "f*.npy") as series:
        assert isinstance(series, JoinedSeries)
        open_part = series._open_part

        def written_meanwhile(path: Path) -> FileSeries:
            np.save(path, VALUES[7])
            os.utime(path, ns=(1, 1))
            return open_part(path)

        series._open_part = written_meanwhile
        for _ in range(2):
            with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
                series.read(1)


def test_one_file_is_open_at_a_time(tmp_path: Path) -> None:
    for step in range(12):
        h5(tmp_path / f"f{step}.h5", VALUES[step])
    folder = "/proc/self/fd"
    if not os.path.isdir(folder):
        pytest.skip("needs /proc to count open files")

    def opened() -> int:
        links = [os.path.join(folder, name) for name in os.listdir(folder)]
        return sum(str(tmp_path) in os.readlink(link) for link in links if os.path.islink(link))

    with open_series(tmp_path / "f*.h5") as series:
        assert opened() == 0
        for step in (0, 5, 11, 3):
            series.read(step)
            assert opened() == 1
    assert opened() == 0


def test_packing_and_missing_values_of_many_files(tmp_path: Path) -> None:
    for step in range(4):
        h5(tmp_path / f"f{step}.h5", VALUES[step])
        with h5py.File(tmp_path / f"f{step}.h5", "a") as file:
            file["v"].attrs["scale_factor"] = 2.0
    expected = VALUES[:4].astype(np.float64) * 2
    missing = float(expected[1, 2, 3, 4])
    expected[1, 2, 3, 4] = np.nan
    with open_series(tmp_path / "f*.h5", missing=[missing], keep_extremes=True) as series:
        assert (series.fill, series.keep_extremes) == (missing, True)
        np.testing.assert_array_equal(np.stack(list(series.frames())), expected)


def dated(path: Path, values: np.ndarray, time: float, units: str, calendar: str = "") -> None:
    """One step with a time that counts since a date."""
    h5(path, values, time=[time])
    with h5py.File(path, "a") as file:
        file["time"].attrs["units"] = units
        if calendar:
            file["time"].attrs["calendar"] = calendar


def test_times_since_different_dates_are_counted_as_in_the_first(tmp_path: Path) -> None:
    for step in range(4):
        units = ("days", "hours", "seconds", "days")[step] + f" since 2001-02-{26 + step}"
        units = units.replace("-29", "-26")
        time = (0.0, 6.0, 7.0, 9.25)[step]
        dated(tmp_path / f"f{step}.h5", VALUES[step], time, units, "gregorian" if step else "")
    with open_series(tmp_path / "f*.h5") as series:
        coordinate = series.coords["t"]
        assert coordinate.attributes["units"] == "days since 2001-02-26"
        np.testing.assert_array_equal(coordinate.values, [0, 1.25, 2 + 7 / 86400, 9.25])


def test_calendars_that_differ_are_not_joined(tmp_path: Path) -> None:
    dated(tmp_path / "f0.h5", VALUES[0], 0, "days since 2001-02-26")
    dated(tmp_path / "f1.h5", VALUES[1], 0, "days since 2001-02-27", "noleap")
    message = r"f1.h5 has not the units of the time in .*f0.h5: days since 2001-02-27 noleap and"
    with pytest.raises(InputError, match=message):
        open_series(tmp_path / "f*.h5")
    dated(tmp_path / "f1.h5", VALUES[1], 0, "s")
    with pytest.raises(InputError, match=r"f1.h5 has not the units of .*: s and days since"):
        open_series(tmp_path / "f*.h5")


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["a1", "a2", "a4", "a5"], "1 numbers are left out, the first between a2.npy and a4.npy"),
        (["a00", "a10", "a20", "a50"], "2 numbers are left out"),
        (["a1", "a2", "a3"], ""),
        (["a1", "a4"], ""),
        (["a1", "a10", "a25", "a37"], ""),
        (["a20200130", "a20200131", "a20200201"], ""),
        (["a202011", "a202012", "a202101"], ""),
        (["a", "b", "d"], ""),
        (["a1_1", "a2_2", "a4_3"], ""),
    ],
)
def test_numbers_that_names_leave_out_are_told(tmp_path: Path, names: list[str], told: str) -> None:
    for step, name in enumerate(names):
        np.save(tmp_path / f"{name}.npy", VALUES[step])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with open_series(tmp_path / "*.npy") as series:
            assert series.shape[0] == len(names)
    assert [told in str(each.message) for each in caught] == ([True] if told else [])
