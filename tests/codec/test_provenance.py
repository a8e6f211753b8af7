"""Containers keep what belongs to a variable, few bytes of it where there is little."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from cf_files import KINDS, Kind, smooth

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.provenance import figure_attributes, history_line, source_attributes
from fhash_formats import open_series
from fhash_formats.series import ArraySeries
from fhash_formats.source_metadata import SourceMetadata

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


def test_the_same_source_gives_the_same_bytes(tmp_path) -> None:
    source = plain_file(tmp_path / "a.nc")
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode(source, tmp_path / name, QUICK)
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


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


def test_an_array_has_no_source(tmp_path) -> None:
    fhash_codec.encode(ArraySeries(smooth(2, 4, 5, 6)), tmp_path / "a.fhz", QUICK)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.metadata is None
        assert "source" not in volume.container.header


def test_a_foreign_header_has_a_line_as_well() -> None:
    header: dict[str, Any] = {
        "encoder": {"version": "9"},
        "model": {"profile": "paper"},
        "source": {"date": 3, "file": None},
        "config": {"profile": "paper", "timings": False, "other": 1, "features": ["all"]},
    }
    assert history_line(header) == "fhash 9: fhash encode --profile paper --no-timings"


def test_a_file_of_copied_tiles_says_that_it_was_packed() -> None:
    header = {
        "encoder": {"version": "0.9", "seed": 0, "command": "pack"},
        "source": {"file": "run.zarr", "date": "2026-01-02T03:04:05Z"},
        "config": {"max_error": 0.5},
        "model": {"profile": "compact"},
    }
    assert history_line(header) == "2026-01-02T03:04:05Z fhash 0.9: fhash pack run.zarr"


def test_attributes_tell_what_the_file_knows() -> None:
    assert figure_attributes({"quality": {}}) == {}
    known = {"quality": {"max_abs_error": 0.5, "psnr": None}}
    assert figure_attributes(known) == {"fhash_max_error": 0.5}
    assert source_attributes(SourceMetadata(dimensions={}, file="a.nc")) == {"fhash_source": "a.nc"}
