"""Dates on the command line: `--time DATE`, the rows of `info` and `decode`, and their errors."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from click.testing import Result

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.times import time_of, time_text
from fhash_formats.errors import FhashWarning

Fhash = Callable[..., Result]


@pytest.fixture(scope="module")
def dated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of four steps of six hours, made of four files that count from their own day."""
    from fhash_formats.readers.registry import open_series

    folder = tmp_path_factory.mktemp("dated")
    for step in range(4):
        with h5py.File(folder / f"s{step}.h5", "w") as file:
            file["u"] = np.full((3, 4, 5), step, "f4") + np.arange(5, dtype="f4")
            file["time"] = [0.25 * step - (0 if step < 2 else 0.5)]
            start = "2001-02-10" if step < 2 else "2001-02-10 12:00"
            file["time"].attrs["units"] = f"days since {start}"
    with open_series(folder / "s*.h5") as series:
        fhash_codec.encode(series, folder / "run.fhz", fhash_codec.EncodeConfig(effort=1))
    return folder / "run.fhz"


@pytest.mark.parametrize(
    ("time", "step"), [("2001-02-10T06:00", 1), ("2001-02-10 09:00", 1.5), ("2001-02-10", 0)]
)
def test_decode_takes_dates(fhash: Fhash, dated: Path, time: str, step: float) -> None:
    text = fhash("decode", dated, "--time", time).stdout
    rows = dict(line.split(None, 1) for line in text.splitlines())
    assert rows["steps"] == f"{step:g}"
    assert rows["dates"] == f"2001-02-10T{6 * step:02.0f}:00".replace("T00:00", "")


HOURLY = {"units": "hours since 2010-02-01"}
LETTERS = np.array([list(f"2010-02-01_{hour:02}:00:00") for hour in range(4)], "S1")
ODD: dict[str, tuple[xr.Variable, dict[str, Any], list[float], str | None]] = {
    # the variable of the times, its encoding, the times told, and the date of step 1
    "missing": (
        xr.Variable("time", [0.0, 1, 2, np.nan], HOURLY),
        {"_FillValue": -999.0},
        [0, 1, 2, 3],
        None,
    ),
    "months": (
        xr.Variable("time", [0.5, 1.5, 2.5, 3.5], {"units": "months since 1960-01-01"}),
        {},
        [15.5, 45.5, 75.5, 106],
        "1960-02-15T12:00",
    ),
    "alias": (
        xr.Variable("time", [0, 1, 2, 3], {"units": "days since 1960-02-28", "calendar": "360"}),
        {},
        [0, 1, 2, 3],
        "1960-02-29",
    ),
    "weeks": (
        xr.Variable("time", [0, 1, 2, 3], {"units": "weeks since 1960-02-28"}),
        {},
        [0, 7, 14, 21],
        "1960-03-06",
    ),
    "unknown": (
        xr.Variable("time", [0, 1, 2, 3.5], {"units": "days since the start"}),
        {},
        [0, 1, 2, 3.5],
        None,
    ),
    "texts": (
        xr.Variable("time", np.array(["20100201", "20100203", "20100204", "20100207"], object)),
        {},
        [0, 2, 3, 6],
        "2010-02-03",
    ),
    "names": (xr.Variable("time", np.array(list("abcd"), object)), {}, [0, 1, 2, 3], None),
    "letters": (xr.Variable(("time", "length"), LETTERS), {}, [0, 1, 2, 3], "2010-02-01T01:00"),
}


KEPT = {"letters": "Times", "unknown": "time"}
"""Names under which the times of the source are kept, others than the usual one."""


def odd_series(kind: str, form: str, folder: Path) -> Any:
    """A source whose times are odd, as a file, many files, a store or a dataset."""
    variable, encoding, _, _ = ODD[kind]
    name = "Times" if kind == "letters" else "time"
    values = np.arange(4.0 * 3 * 4 * 5, dtype="f4").reshape(4, 3, 4, 5)
    data = xr.Dataset({"rho": (("time", "z", "y", "x"), values), name: variable})
    data[name].encoding = encoding
    if form == "files":
        for number in range(4):
            part = data.isel(time=slice(number, number + 1))
            part.to_netcdf(folder / f"run_{number}.nc", engine="h5netcdf")
        return folder / "run_*.nc"
    data.to_netcdf(folder / "run.nc", engine="h5netcdf")
    if form == "file":
        return folder / "run.nc"
    with xr.open_dataset(folder / "run.nc", decode_times=False) as read:
        loaded = read.load()
    if form == "store":
        loaded.to_zarr(folder / "run.zarr", consolidated=False, zarr_format=2)
        return folder / "run.zarr"
    return loaded


@pytest.mark.filterwarnings("ignore:.*Zarr V3 specification")  # of texts
@pytest.mark.parametrize("form", ["file", "files", "store", "dataset"])
@pytest.mark.parametrize("kind", ODD)
def test_odd_times_have_one_answer_everywhere(
    fhash: Fhash, tmp_path: Path, kind: str, form: str
) -> None:
    _, _, expected, date = ODD[kind]
    if (kind, form) == ("texts", "files"):
        expected = [24 * each for each in expected]  # of one step each: counted in hours
    if kind == "alias" and form == "store":
        pytest.skip("xarray cannot write it")
    path = tmp_path / "run.fhz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)  # what stands for the times, and what differs
        fhash_codec.encode(odd_series(kind, form, tmp_path), path, EncodeConfig(effort=1, psnr=40))

    exports = {suffix: tmp_path / f"out.{suffix}" for suffix in ("nc", "zarr")}
    for output in exports.values():
        assert fhash("decode", path, "-o", output).exit_code == 0
    with fhash_codec.open(path) as volume:
        times = volume.coords["t"]
        assert np.isfinite(times.values).all()
        label = time_text(times, times.values[1])
        assert "nan" not in label
        if date is None:
            assert times.values.tolist() == expected
            assert "units" not in times.attributes
            assert label == "1"
        else:
            assert label == date
            assert time_of(times, date, "run.fhz") == times.values[1]
            assert times.values.tolist() == expected
        for options in ({}, {"decode_times": False}):
            opened = [xr.open_dataset(path, engine="fhash", **options)]
            opened += [xr.open_dataset(exports["nc"], **options)]
            opened += [xr.open_zarr(exports["zarr"], **options)]
            for dataset in opened:
                with dataset:
                    found = dataset["time"]
                    if date is None or options:
                        assert found.values.tolist() == times.values.tolist()
                    else:
                        assert found[1].dt.strftime("%Y-%m-%d").item() == date[:10]
                    if (kind, form) != ("missing", "files"):  # where the files differ
                        assert KEPT.get(kind, "time_in_source") in dataset.variables
