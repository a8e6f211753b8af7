"""Regions and their labels in every format that names dimensions; a failed write does no damage."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from regions import COORDS, DATA, SHAPE, labelled_region

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate, SourceMetadata, SourceVariable, index_coordinate
from fhash_formats.writers.common import (
    CHUNK_BYTES,
    HeldFile,
    Outline,
    Region,
    chunk_shape,
    coordinate_attributes,
    even_spacing,
    hdf5_value,
    safe_name,
    variable_attributes,
)
from fhash_formats.writers.registry import save_region


@pytest.mark.parametrize("suffix", [".h5", ".nc"])
def test_ctrl_c_inside_hdf5_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    # h5py swallows what is raised while it releases an object; without the delay the file that
    # remained had a hole.
    write, calls = HeldFile.write, []

    def interrupted(self: HeldFile, data: Any, /) -> int:
        calls.append(len(data))
        if len(calls) == 5:
            signal.raise_signal(signal.SIGINT)
        return write(self, data)

    def frames() -> Iterator[np.ndarray]:
        yield from DATA

    monkeypatch.setattr(HeldFile, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_region(tmp_path / f"out{suffix}", labelled_region(), frames())
    assert len(calls) >= 5
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_is_raised_once_it_is_safe(tmp_path: Path) -> None:
    with HeldFile(tmp_path / "a") as file:
        assert file.write(b"12345") == 5
        file.truncate("no length")  # type: ignore[arg-type]
        assert isinstance(file.failure, TypeError)
        assert file.write(b"678") == 3  # dropped, and said to be written
        with pytest.raises(TypeError), file.calling():
            pass
    assert (tmp_path / "a").read_bytes() == b"12345"


def test_the_first_failure_stands_for_its_consequences(tmp_path: Path) -> None:
    with HeldFile(tmp_path / "a") as file:
        file.failure = OSError("the disk is full")
        with pytest.raises(OSError, match="the disk is full"), file.calling():
            raise RuntimeError("a consequence")


def region(
    shape: tuple[int, int, int, int] = (1, 1, 1, 1),
    dtype: str = "f4",
    names: str = "tzyx",
    **changes: Any,
) -> Region:
    coords = {
        axis: Coordinate(name=name, values=np.zeros(n))
        for axis, name, n in zip("tzyx", names, shape, strict=True)
    }
    return Region(
        **{"name": "wind", "dtype": np.dtype(dtype), "shape": shape, "coords": coords, **changes}
    )


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("wind", "wind"),
        ("air temperature", "air temperature"),
        ("Größe", "Größe"),
        ("group/wind", "group_wind"),
        ("/", "values"),
        ("..", "values"),
        (" . ", "values"),
        ("__wind", "_wind"),
        ("a\nb\0c\\d", "a_b_c_d"),
        ("zarr.json", "zarr_json"),
    ],
)
def test_safe_names(name: str, safe: str) -> None:
    assert safe_name(name) == safe
    assert safe_name(safe) == safe


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("tzyx", "t z y x"),
        ("aaaa", "a a_2 a_3 a_4"),
        (["x", "wind", "wind", "x"], "x wind_2 wind_3 x_2"),
        (["", "/", "b", "b_2"], "t values b b_2"),
    ],
)
def test_all_names_of_a_file_differ(names: Any, expected: str) -> None:
    outline = Outline.of(region(names=names))
    assert outline.name == "wind"
    assert outline.dimensions == dict(zip(expected.split(), "tzyx", strict=True))


def test_no_attribute_that_changes_the_values_is_kept() -> None:
    packing = "scale_factor add_offset _FillValue missing_value valid_range valid_min valid_max"
    references = "coordinates grid_mapping bounds DIMENSION_LIST _Netcdf4Dimid CLASS"
    dropped = {**dict.fromkeys(packing.split(), 1), **dict.fromkeys(references.split(), "x")}
    told = {"standard_name": "wind_speed", "units": "knots", "": 1}
    made = region(name="group/wind", units="m s-1", attributes=dropped | told)
    assert variable_attributes(made) == {
        "standard_name": "wind_speed",
        "units": "m s-1",
        "long_name": "group/wind",
    }
    dated = {"units": "hours since 1970-01-01", "calendar": "gregorian"}
    upright = {"axis": "z", "positive": "up"}
    for axis, attributes, kept in (
        ("t", {**dated, "bounds": "time_bnds"}, {"axis": "T", **dated}),
        ("z", upright, upright),
    ):
        coordinate = Coordinate(name=axis, values=np.zeros(1), attributes=attributes)
        assert coordinate_attributes(axis, coordinate) == kept


def test_attributes_are_json_and_what_cannot_be_is_left_out() -> None:
    odd = {
        "a": np.float32(1.5),
        "b": np.arange(3),
        "c": (1, "x"),
        "d": float("nan"),
        "e2": "\udcff",
        "e": b"raw",
        "f": {"g": None},
        "h": Path("p"),
        "i": True,
    }
    kept = variable_attributes(region(attributes=odd))
    assert kept == {
        "a": 1.5,
        "b": [0, 1, 2],
        "c": [1, "x"],
        "d": "NaN",
        "e": "raw",
        "e2": "\u00ff",
        "f": {"g": None},
        "i": True,
    }
    assert json.loads(json.dumps(kept, allow_nan=False)) == kept


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("text", "text"),
        ("nul\0", "nul"),
        (True, 1),
        (3, 3),
        (2**63, "9223372036854775808"),
        (0.5, 0.5),
        ([1, 2], [1, 2]),
        ([0.5, 1.5], [0.5, 1.5]),
        (["a", "b"], ["a", "b"]),
        ([1, "a"], '[1, "a"]'),
        ([2**70], "[1180591620717411303424]"),
        ([], "[]"),
        (None, "null"),
        ({"a": 1}, '{"a": 1}'),
    ],
)
def test_attributes_of_hdf5(tmp_path: Path, value: Any, expected: Any) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["a"] = hdf5_value(value)
        read = file.attrs["a"]
        assert (read.tolist() if isinstance(read, np.ndarray) else read) == expected


def test_a_long_list_fits_into_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["a"] = hdf5_value(list(range(20000)))
        assert json.loads(file.attrs["a"]) == list(range(20000))


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_names_that_a_file_cannot_hold(tmp_path: Path, suffix: str) -> None:
    coords = {
        axis: Coordinate(name="gas/density", values=coordinate.values)
        for axis, coordinate in COORDS.items()
    }
    (path,) = save_region(
        tmp_path / f"out{suffix}",
        labelled_region(name="gas/density", coords=coords, attributes={}),
        DATA,
    )
    if suffix == ".h5":
        with h5py.File(path) as file:
            assert sorted(file) == ["gas_density", *(f"gas_density_{n}" for n in (2, 3, 4, 5))]
            np.testing.assert_array_equal(file["gas_density"], DATA)
            assert file["gas_density"].attrs["long_name"] == "gas/density"
        return
    with xr.open_dataset(path, engine="zarr" if suffix == ".zarr" else "h5netcdf") as data:
        assert data["gas_density"].dims == tuple(f"gas_density_{n}" for n in (2, 3, 4, 5))
        np.testing.assert_array_equal(data["gas_density"].values, DATA)
        assert data["gas_density"].attrs == {"units": "K", "long_name": "gas/density"}


OUTLINE_SHAPE = (2, 1, 3, 4)


def variable(name: str, dimensions: str, values: Any, **changes: Any) -> SourceVariable:
    found = np.asarray(values)
    return SourceVariable(
        **{"name": name, "dimensions": tuple(dimensions.split()), "values": found, **changes}
    )


def position(name: str, dimension: str, values: Any, **attributes: Any) -> SourceVariable:
    return variable(name, dimension, values, attributes=attributes, is_coordinate=True)


METADATA = SourceMetadata(
    dimensions={"lon": "x", "one": "", "time": "t", "y": "y"},
    variable_attributes={
        "coordinates": "gone name",
        "grid_mapping": "crs",
        "ancillary_variables": "gone",
        "scale_factor": 0.5,
        "valid_range": np.array([1, 2], "i2"),
        "level": np.int16(4),
        "tags": ["a", "b"],
    },
    variables=(
        position("lon", "lon", np.arange(4, dtype="f4"), units="degrees_east"),
        position("time", "time", [5, 7], units="days since 2000-01-01", bounds="time_bnds"),
        variable("time_bnds", "time bnds", np.eye(2)),
        position("name", "time", np.array(["a", "ä"], dtype=object)),
        position(
            "depth",
            "y",
            np.array([1, -99, 3], "i2"),
            _FillValue=np.int16(-99),
            scale_factor=0.5,
        ),
        position("slope", "y", np.array([1, -9, 3], "f4"), _FillValue=np.float32(-9)),
        variable("crs", "", np.int32(0), attributes={"a": 1.5}),
    ),
    attributes={"Conventions": "CF-1.11", "history": "one\ntwo", "NAME": "plumbing"},
)


def region_outline(metadata: SourceMetadata | None = METADATA, **coords: Any) -> Region:
    usual = {axis: index_coordinate(axis, n) for axis, n in zip("tzyx", OUTLINE_SHAPE, strict=True)}
    return Region(
        name="u",
        units="K",
        dtype=np.dtype("f4"),
        shape=OUTLINE_SHAPE,
        coords={**usual, **coords},
        attributes={"long_name": "wind"},
        metadata=metadata,
    )


VALUES = np.arange(24, dtype="f4").reshape(OUTLINE_SHAPE)


def test_frames_go_where_the_dimensions_say() -> None:
    outline = Outline.of(region_outline())
    assert outline.shape == (4, 1, 2, 3)
    assert outline.ordered((1, 5, 6, 7)) == (7, 1, 1, 6)
    values = np.zeros(outline.shape)
    for step, frame in enumerate(VALUES):
        place, ordered = outline.slab(step, frame)
        values[place] = ordered
    np.testing.assert_array_equal(values[:, 0], VALUES[:, 0].transpose(2, 0, 1))


def test_names_of_what_is_not_there_are_left_out() -> None:
    attributes = dict(Outline.of(region_outline()).attributes)
    assert attributes.pop("tags") == ["a", "b"]
    assert attributes == {
        "coordinates": "name depth slope",
        "grid_mapping": "crs",
        "level": np.int16(4),
        "units": "K",
    }


def test_positions_that_the_source_has_not_are_told_where_they_tell_something() -> None:
    assert "y" not in [each.name for each in Outline.of(region_outline()).variables]
    cut = Coordinate(name="y", values=np.array([3.0, 4, 5]))
    found = {each.name: each for each in Outline.of(region_outline(y=cut)).variables}
    assert found["y"].values.tolist() == [3, 4, 5]


def test_a_region_without_a_source_has_four_axes() -> None:
    outline = Outline.of(region_outline(None))
    assert list(outline.dimensions.values()) == list("tzyx")
    assert outline.shape == OUTLINE_SHAPE
    assert outline.attributes == {"long_name": "wind", "units": "K"}
    assert len(outline.variables) == 4


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
def test_files_give_everything_back(tmp_path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    save_region(path, region_outline(), iter(VALUES))
    engine = "zarr" if suffix == "zarr" else "h5netcdf"
    with xr.open_dataset(path, decode_coords="all", engine=engine) as found:
        assert found["u"].dims == ("lon", "one", "time", "y")
        np.testing.assert_array_equal(found["u"][:, 0], VALUES[:, 0].transpose(2, 0, 1))
        assert set(found.coords) == {each.name for each in METADATA.variables}
        assert found["lon"].dtype == np.float32
        assert found["name"].values.tolist() == ["a", "ä"]
        np.testing.assert_array_equal(found["depth"], [0.5, np.nan, 1.5])
        np.testing.assert_array_equal(found["slope"], [1, np.nan, 3])
        assert found["crs"].attrs == {"a": 1.5}
        assert found["u"].attrs["level"] == 4
        assert list(found["u"].attrs["tags"]) == ["a", "b"]
        assert found.attrs == {"Conventions": "CF-1.11", "history": "one\ntwo"}
        assert str(found["time"].values[1]).startswith("2000-01-08")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "has no name"),
        ({"dtype": np.dtype("c8")}, "values of type complex64"),
        ({"dtype": np.dtype(np.longdouble)}, "integers and floats up to 64 bits"),
        ({"dtype": np.dtype(bool)}, "values of type bool"),
        ({"shape": (4, 5, 6)}, "3 dimensions"),
        ({"shape": (3, 0, 5, 6)}, "an axis is empty"),
        ({"shape": (2, 4, 5, 6)}, r"coordinate of t is float64 \(3,\); float64 \(2,\) is needed"),
        ({"coords": {}}, r"coordinates of \[\]; exactly those of t, z, y and x"),
        (
            {"coords": {**COORDS, "x": Coordinate(name="x", values=np.arange(6, dtype="f4"))}},
            "coordinate of x is float32",
        ),
        ({"coords": {**COORDS, "w": COORDS["x"]}}, r"\['t', 'w', 'x', 'y', 'z'\]"),
    ],
)
def test_a_region_that_is_none(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        labelled_region(**changes)


def test_a_region_keeps_the_native_byte_order() -> None:
    assert labelled_region(dtype=np.dtype(">f8")).dtype.isnative


@pytest.mark.parametrize(
    ("values", "step"),
    [
        ([3.0], 1.0),
        ([0, 0.5, 1], 0.5),
        ([1, 0.5, 0], -0.5),
        (np.linspace(-7.3, 11.1, 1001), 18.4 / 1000),
        (np.linspace(50, 60, 101).astype("f4"), 0.1),  # as a file that keeps float32 would give it
        ([0, 1, 3], None),
        ([0, 1, 2.00001], None),
        ([0, 1, 1.0000001 * 2], 1.0000001),
        ([2, 2], None),
        ([0, 1, 0], None),
        ([0, np.nan, 2], None),
        ([0, np.inf], None),
        ([np.nan], None),
    ],
)
def test_even_spacing(values: Any, step: float | None) -> None:
    found = even_spacing(np.asarray(values, dtype=np.float64))
    assert found == (None if step is None else pytest.approx(step, rel=1e-6))


@pytest.mark.parametrize("dtype", ["u1", "f4", "f8"])
@pytest.mark.parametrize(
    "shape",
    [
        (1, 1, 1, 1),
        (100, 64, 64, 64),
        (3, 256, 256, 256),
        (2, 3, 5000, 5000),
        (1, 1, 1, 10**8),
        (1, 7, 1, 3 * 10**7),
    ],
)
def test_chunks_are_bounded_and_never_span_steps(
    shape: tuple[int, int, int, int], dtype: str
) -> None:
    made = labelled_region(dtype=np.dtype(dtype))
    object.__setattr__(made, "shape", shape)
    chunk = chunk_shape(made)
    assert chunk[0] == 1
    assert all(1 <= length <= limit for length, limit in zip(chunk, (1, *shape[1:]), strict=True))
    size = int(np.prod(chunk)) * made.dtype.itemsize
    assert size <= CHUNK_BYTES
    frame = int(np.prod(shape[1:])) * made.dtype.itemsize
    assert size == frame if frame <= CHUNK_BYTES else size > CHUNK_BYTES / 4


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_a_frame_above_the_bound_is_several_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    import zarr

    monkeypatch.setattr("fhash_formats.writers.common.CHUNK_BYTES", 250)
    (path,) = save_region(tmp_path / f"out{suffix}", labelled_region(), DATA)
    if suffix == ".zarr":
        theta = zarr.open_group(path, mode="r")["theta"]
        assert isinstance(theta, zarr.Array)
        assert theta.chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(theta[:], DATA)
        return
    with h5py.File(path) as file:
        assert file["theta"].chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(file["theta"], DATA)


def test_hdf5_has_scales_and_attributes(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.h5", labelled_region(), DATA)
    with h5py.File(path) as file:
        theta = file["theta"]
        assert sorted(file) == ["height", "lat", "lon", "theta", "time"]
        assert theta.chunks == (1, 4, 5, 6)
        assert dict(theta.attrs)["units"] == "K"
        assert theta.attrs["standard_name"] == "air_temperature"
        assert theta.attrs["flags"].tolist() == [1, 2]
        assert not {"scale_factor", "add_offset", "_FillValue", "valid_range", "coordinates"} & set(
            theta.attrs
        )
        for dimension, (axis, coordinate) in enumerate(COORDS.items()):
            scale = theta.dims[dimension][0]
            assert theta.dims[dimension].label == coordinate.name
            assert scale.name == f"/{coordinate.name}"
            assert scale.dtype == np.float64
            np.testing.assert_array_equal(scale, coordinate.values)
            assert scale.attrs["axis"] == axis.upper()
        assert file["time"].attrs["calendar"] == "gregorian"


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_xarray_sees_labelled_values(tmp_path: Path, suffix: str) -> None:
    (path,) = save_region(tmp_path / f"out{suffix}", labelled_region(), DATA)
    opened = xr.open_zarr if suffix == ".zarr" else xr.open_dataset
    with opened(path, decode_times=False) as data:
        theta = data["theta"]
        assert theta.dims == ("time", "height", "lat", "lon")
        assert set(data.variables) == {"theta", "time", "height", "lat", "lon"}
        assert theta.dtype == np.float32
        np.testing.assert_array_equal(theta.values, DATA)
        assert theta.attrs["units"] == "K"
        assert theta.attrs["standard_name"] == "air_temperature"
        dropped = {"scale_factor", "add_offset", "missing_value", "valid_range", "grid_mapping"}
        assert not dropped & set(theta.attrs)
        for axis, coordinate in COORDS.items():
            found = data[coordinate.name]
            assert found.dtype == np.float64
            np.testing.assert_array_equal(found.values, coordinate.values)
            kept = {
                key: value
                for key, value in coordinate.attributes.items()
                if key not in ("bounds", "scale_factor")
            }
            assert found.attrs == {"axis": axis.upper(), **kept}
    with opened(path) as data:
        assert str(data["time"].values[0]).startswith("2009-09-09T17:00:00.99")
        assert (
            float(data["theta"].sel(lat=-1.0, lon=0.1, height=5.0).isel(time=0))
            == DATA[0, 0, -1, 0]
        )


def test_netcdf_declares_its_fill_value_for_floats_only(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.nc", labelled_region(), DATA)
    with h5py.File(path) as file:
        assert file.attrs["Conventions"] == "CF-1.8"
        assert np.isnan(file["theta"].attrs["_FillValue"]).all()
        assert all(
            "_FillValue" not in file[coordinate.name].attrs for coordinate in COORDS.values()
        )
    (path,) = save_region(
        tmp_path / "int.nc", labelled_region(dtype=np.dtype("i2")), np.zeros(SHAPE, "i2")
    )
    with h5py.File(path) as file:
        assert "_FillValue" not in file["theta"].attrs


def test_zarr_is_one_chunk_a_step_and_none_is_missing(tmp_path: Path) -> None:
    import zarr

    nothing = np.zeros(SHAPE, "i4")
    nothing[1] = 7
    (path,) = save_region(tmp_path / "out.zarr", labelled_region(dtype=np.dtype("i4")), nothing)
    theta = zarr.open_group(path, mode="r")["theta"]
    assert isinstance(theta, zarr.Array)
    assert (theta.metadata.zarr_format, theta.chunks, theta.nchunks_initialized) == (
        3,
        (1, 4, 5, 6),
        3,
    )
    assert sum(file.is_file() for file in (path / "theta" / "c").rglob("*")) == 3
    np.testing.assert_array_equal(theta[:], nothing)
