"""Tests of which series belong together."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.belonging import (
    Labels,
    counted_times,
    require_alike,
    require_same_grid,
    same_units,
)
from fhash_formats.readers.registry import open_series
from fhash_formats.series import Coordinate, SourceMetadata, SourceVariable

POSITIONS = {"z": [0.0, 1.0, 2.0], "y": [10.0, 10.25], "x": [359.1, 359.35, 359.6]}
COORDS = {axis: Coordinate(name=axis, values=np.array(at)) for axis, at in POSITIONS.items()}
WIND = Labels(
    source="a.nc",
    name="u",
    units="m s-1",
    attributes={"standard_name": "eastward_wind"},
    shape=(3, 2, 3),
    dtypes=("float32", "float32"),
    coords=COORDS,
)


def moved(axis: str, shift: float = 0.0, **attributes: str) -> Labels:
    known = COORDS[axis]
    other = replace(known, values=known.values + shift, attributes=attributes)
    return replace(WIND, source="b.nc", coords={**COORDS, axis: other})


def other(**changes) -> Labels:
    return replace(WIND, source="b.nc", **changes)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (other(name="v"), "b.nc has the variable 'v', a.nc 'u'"),
        (other(group="dust", name="v"), "the variable 'dust/v', a.nc 'u'"),
        (other(attributes={"standard_name": "northward_wind"}), "standard_name 'northward_wind'"),
        (other(units="km h-1"), "has the unit km h-1, a.nc m s-1"),
        (other(shape=(3, 2, 4)), r"shape \(3, 2, 4\), a.nc \(3, 2, 3\)"),
        (other(dtypes=("float32", "int16")), "values of type int16, a.nc float32"),
        (moved("x", 0.01), "positions along x: 359.11 to 359.61, a.nc 359.1 to 359.6"),
        (moved("x", -360.0), "positions along x: -0.9 to -0.4"),
    ],
)
def test_what_differs_is_named(labels: Labels, message: str) -> None:
    with pytest.raises(InputError, match=message):
        require_alike(labels, WIND)


@pytest.mark.parametrize(
    ("here", "there", "message"),
    [
        ({"units": "km"}, {"units": "m"}, "positions along z in km, a.nc m"),
        ({"positive": "down"}, {"positive": "up"}, "along z the positive down, a.nc up"),
        ({"standard_name": "depth"}, {"standard_name": "height"}, "the standard_name depth"),
    ],
)
def test_axes_that_count_another_thing_are_refused(here: dict, there: dict, message: str) -> None:
    known = replace(moved("z", **there), source="a.nc")
    with pytest.raises(InputError, match=message):
        require_alike(moved("z", **here), known)


ROUNDED = {
    axis: replace(c, values=c.values.astype("f4").astype(float)) for axis, c in COORDS.items()
}


@pytest.mark.parametrize(
    "labels",
    [
        WIND,
        other(coords=ROUNDED),
        other(name="", units="", attributes={}),
        other(units="m/s"),
        replace(moved("x", 7.0), given=("y", "z")),
        other(attributes={"long_name": "another text for the same name"}),
    ],
)
def test_rounding_and_what_is_not_said_are_no_difference(labels: Labels) -> None:
    require_alike(labels, WIND)


def test_names_may_be_numbered_as_their_files_are() -> None:
    first = replace(WIND, name="frame_01", attributes={})
    require_alike(replace(first, name="frame_02", numbers={2}), first)
    tracer = replace(first, name="tracer_2", numbers={7})
    with pytest.raises(InputError, match=r"the variable 'tracer_2', a.nc 'tracer_1'"):
        require_alike(tracer, replace(first, name="tracer_1"))


@pytest.mark.parametrize(
    ("one", "another"),
    [
        ("m s-1", "m/s"),
        ("m s-1", "m s^-1"),
        ("m s-1", "m.s**-1"),
        ("m s-1", "s⁻¹ m"),
        ("m s-1", "metres per second"),
        ("kg m-2 s-1", "kg/m2/s"),
        ("W m-2", "W/m^2"),
        ("K", "kelvin"),
        ("kg kg-1", "1"),
        ("degrees_north", "degree_N"),
        ("a text", " a  text"),
    ],
)
def test_units_that_mean_the_same(one: str, another: str) -> None:
    assert same_units(one, another)


@pytest.mark.parametrize(
    ("one", "another"),
    [
        ("m s-1", "m s-2"),
        ("m s", "ms"),
        ("m/s", "s/m"),
        ("K", "degC"),
        ("Pa", "hPa"),
        ("mS", "ms"),
        ("1000 m", "km"),
        ("%", "1"),
        ("(0 - 1)", "1"),
        ("m2", "2 m"),
    ],
)
def test_units_that_do_not(one: str, another: str) -> None:
    assert not same_units(one, another)


def times(values: list[float], units: str, calendar: str = "standard") -> tuple[Path, Coordinate]:
    attributes = {"units": units, "calendar": calendar}
    return Path(units), Coordinate(name="t", values=np.array(values), attributes=attributes)


def test_times_are_counted_as_in_the_first() -> None:
    first = times([0, 1, 2], "days since 2000-01-01")
    for own in (
        times([0, 1], "days since 2000-01-04"),
        times([72, 96], "hours since 2000-01-01"),
        times([3, 4], "days since 2000-01-01", "proleptic_gregorian"),
    ):
        assert counted_times("*", [first, own])[1].tolist() == [3, 4]
    assert counted_times("*", [times([0, 1], "s"), times([2000], "ms")])[1].tolist() == [2]
    for own in (
        times([3, 4], "days since 2000-01-01", "noleap"),
        times([3, 4], "days"),
        times([3, 4], "K"),
    ):
        with pytest.raises(InputError, match="convert one of them, or encode it as a file"):
            counted_times("*", [first, own])
    old = (
        times([0, 1], "days since 1500-01-01"),
        times([3], "days since 1500-01-01", "proleptic_gregorian"),
    )
    with pytest.raises(InputError, match="1500-01-01 proleptic_gregorian"):
        counted_times("*", old)


def source(pole: float, north: float) -> SourceMetadata:
    mapping = {
        "grid_mapping_name": "rotated",
        "grid_north_pole_latitude": pole,
        "crs_wkt": str(north),
    }
    lat = np.array([[50.0, 51.0], [52.0, 53.0]]) + north
    return SourceMetadata(
        dimensions={"y": "y", "x": "x"},
        variable_attributes={"grid_mapping": "crs", "coordinates": "lat"},
        variables=(
            SourceVariable(name="crs", dimensions=(), values=np.array(0), attributes=mapping),
            SourceVariable(name="lat", dimensions=("y", "x"), values=lat, is_coordinate=True),
        ),
    )


def test_grids_that_lie_elsewhere_are_refused() -> None:
    known, sources = source(39.25, 0), ("b.nc", "a.nc")
    require_same_grid(source(39.25, 1e-7), known, sources)
    require_same_grid(None, known, sources)
    with pytest.raises(InputError, match="another grid_north_pole_latitude of the grid mapping"):
        require_same_grid(source(40, 0), known, sources)
    with pytest.raises(InputError, match="another positions lat"):
        require_same_grid(source(39.25, 0.5), known, sources)


@pytest.mark.parametrize(
    ("names", "refused"),
    [
        (("rho", "rho"), ""),
        (("e", "n"), "the variable 'n', .* 'e'"),
        (("gas/rho", "dust/rho"), "the variable 'dust/rho', .*'gas/rho'"),
        (("run_1/rho", "run_2/rho"), ""),
        (("tracer_1", "tracer_7"), "the variable 'tracer_7'"),
        (("data_1", "data_2"), ""),
    ],
)
def test_files_of_a_pattern_hold_one_variable(tmp_path: Path, names: tuple, refused: str) -> None:
    import h5py

    for number, name in enumerate(names, start=1):
        with h5py.File(tmp_path / f"f_{number}.h5", "w") as file:
            file[name] = np.full((1, 2, 3, 4), number, "f4")
    if refused:
        with pytest.raises(InputError, match=re.compile(refused)):
            open_series(tmp_path / "f_*.h5")
        return
    with open_series(tmp_path / "f_*.h5") as series:
        assert series.shape == (2, 2, 3, 4)


def test_the_types_of_the_sources_are_one(tmp_path: Path) -> None:
    """Counts with a fill value and floats are both read as floats, and only one fits integers."""
    import h5py

    for number, kind in enumerate(("i2", "f4"), start=1):
        with h5py.File(tmp_path / f"f_{number}.h5", "w") as file:
            file["v"] = np.full((1, 2, 3, 4), 1.5).astype(kind)
            file["v"].attrs["_FillValue"] = np.array(-9).astype(kind)
    with pytest.raises(InputError, match=r"has values of type float32, .* int16"):
        open_series(tmp_path / "f_*.h5")
    for number in (1, 2):
        with h5py.File(tmp_path / f"f_{number}.h5", "w") as file:
            file["v"] = np.full((1, 2, 3, 4), -9, "i2")
            file["v"].attrs["_FillValue"] = np.array(-10 * number, "i2")
    with open_series(tmp_path / "f_*.h5") as series:
        assert series.fill is None  # what is missing in one file may be a value in another
