"""Names of containers: those of data files are refused."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

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
    write_steps,
)
from fhash_formats.container import ContainerWriter
from fhash_formats.readers.registry import open_series


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
        "model": {"gains": [["start", 9, 0.5], ["end", 7], 5]},
        "history": {"epoch": [3]},
        "quality": quality,
    }


def test_what_follows_from_the_rest_is_left_out_and_comes_back() -> None:
    step = {"step": 0, "psnr": 39.9999999, "rmse": 0.0200000001, "max_abs_error": 0.25}
    window = {"window": 11, "sigma": 1.5, "data_range": 2.0, "steps": [0]}
    brief = brief_quality(WRITER, {"per_step": [step], "ssim_window": window}, 2.0, 1)
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
        {"what": "end", "bytes": 7},
    ]
    other = {**window, "steps": [3], "data_range": 1.9}
    brief = brief_quality(WRITER, {"per_step": [], "ssim_window": other}, 2.0, 1)
    assert brief["ssim_window"] == other


QUICK = EncodeConfig(effort=1, psnr=45, without=("ssim",), timings=False)
PAPER = EncodeConfig(profile="paper", epochs=1, width=8, timings=False)


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
def test_both_profiles_and_plain_files_keep_everything(tmp_path, config) -> None:
    if config.profile == "paper":
        pytest.importorskip("torch")
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
        effort=1, max_error=0.5, features=("interval:270:280", "interval:281:300")
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
    rmse: list[float | None], largest: list[float | None], ends: tuple[float, float]
) -> tuple[list[dict[str, float | None]], Arrays]:
    """The figures as they are read again, and the arrays that were written."""
    writer: Any = Arrays()
    figures = {"rmse": rmse, "max_abs_error": largest}
    steps = write_steps(writer, figures, ends[1] - ends[0])
    known = [value for value in largest if value is not None]
    quality = {"max_abs_error": max(known), **({"steps": steps} if steps else {})}
    return read_steps({"value_range": ends, "quality": quality}, writer.stored), writer


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


def test_levels_beyond_float64_have_no_figure() -> None:
    steps = {"rmse": [-(10**6), 0, 10**6], "max_abs_error": [10**6, 0, 5]}
    header = {"value_range": [0, 1], "quality": {"steps": steps}}
    assert read_steps(header, {})[0] == {"rmse": None, "max_abs_error": None}
    assert read_steps({"value_range": [0, 1], "quality": {}}, {}) == []
