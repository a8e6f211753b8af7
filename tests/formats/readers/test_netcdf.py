"""NetCDF 3 and 4: groups, packed values, the packing that a variable declares, classic headers."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import numpy as np
import pytest
import xarray as xr
from stored_series import VALUES, assert_frames, frames, save_netcdf

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.netcdf3 import read_header
from fhash_formats.readers.registry import list_variables, open_series

DIMS = ("time", "lev", "lat", "lon")


@pytest.fixture
def grouped(tmp_path: Path) -> Path:
    """A packed variable in a group, whose dimensions and coordinates are at the top."""
    path = tmp_path / "grouped.nc"
    with h5netcdf.File(path, "w") as root:
        root.attrs["title"] = "top"
        root.dimensions = {"time": 3, "lat": 4, "lon": 5, "bnds": 2}
        time = root.create_variable("time", ("time",), "i4", data=np.array([0, 6, 18], "i4"))
        time.attrs["units"] = "hours since 2000-01-01"
        time.attrs["bounds"] = "time_bnds"
        bounds = np.arange(6.0).reshape(3, 2)
        root.create_variable("time_bnds", ("time", "bnds"), "f8", data=bounds)
        lat = np.array([10, 20, 30, 40], "i2")
        packed = root.create_variable("lat", ("lat",), "i2", data=lat)
        packed.attrs["scale_factor"] = 0.5
        group = root.create_group("inner")
        group.attrs["title"] = "inner"
        values = np.arange(60, dtype="i2").reshape(3, 4, 5)
        density = group.create_variable("rho", ("time", "lat", "lon"), "i2", data=values)
        density.attrs["scale_factor"] = np.float32(0.5)
        density.attrs["units"] = "kg"
    return path


def test_a_variable_of_a_group_finds_what_is_around_it(grouped: Path) -> None:
    with open_series(grouped) as series:
        metadata = series.metadata
        assert series.coords["y"].values.tolist() == [5, 10, 15, 20]
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    assert [each.name for each in metadata.variables] == ["time", "lat", "time_bnds"]
    assert metadata.named("lat").values.tolist() == [10, 20, 30, 40]
    assert metadata.named("lat").values.dtype == np.int16
    assert metadata.named("time").attributes["bounds"] == "time_bnds"
    assert metadata.attributes == {"title": "inner"}
    assert metadata.variable_attributes == {"scale_factor": np.float32(0.5), "units": "kg"}
    assert (metadata.stored, metadata.file) == ("int16", "grouped.nc")


def test_steps_are_cut(grouped: Path) -> None:
    with open_series(grouped, steps=slice(2, None, -2)) as series:
        assert series.metadata.named("time").values.tolist() == [18, 0]
        assert series.metadata.named("time_bnds").values.tolist() == [[4, 5], [0, 1]]


def test_numbers_as_stored_have_no_packing(grouped: Path) -> None:
    with open_series(grouped, raw_values=True) as series:
        assert series.metadata.variable_attributes == {}
        assert series.metadata.stored is None


@pytest.mark.parametrize("suffix", [".nc", ".nc4", ".cdf", ".netcdf", ".h5", ".data"])
def test_frames_coordinates_and_attributes(tmp_path: Path, suffix: str) -> None:
    times = np.array([347921.16666667, 347921.33333333, 347921.5, 347922.0])
    dataset = xr.Dataset(
        {
            "theta": (
                DIMS,
                VALUES,
                {
                    "units": "K",
                    "long_name": "temperature",
                    "valid_range": [0.0, 0.1],
                    "level": np.int16(3),
                },
            )
        },
        coords={
            "time": ("time", times, {"units": "hours since 1970-01-01", "calendar": "gregorian"}),
            "lat": ("lat", np.linspace(-1, 1, 5).astype("f4"), {"units": "degrees_north"}),
        },
        attrs={"Conventions": "CF-1.8"},
    )
    path = save_netcdf(tmp_path / f"a{suffix}", dataset)
    with open_series(path) as series:
        assert (series.name, series.units, series.shape, series.dtype) == (
            "theta",
            "K",
            (4, 3, 5, 6),
            np.float32,
        )
        assert series.attributes == {"units": "K", "long_name": "temperature", "level": 3}
        np.testing.assert_array_equal(series.coords["t"].values, times)
        assert series.coords["t"].attributes == {
            "units": "hours since 1970-01-01",
            "calendar": "gregorian",
        }
        np.testing.assert_array_equal(series.coords["y"].values, np.linspace(-1, 1, 5).astype("f4"))
        np.testing.assert_array_equal(series.coords["x"].values, np.arange(6))
    np.testing.assert_array_equal(frames(path), VALUES)  # valid_range hides nothing


@pytest.mark.parametrize("calendar", ["standard", "360_day", "noleap"])
def test_times_stay_numbers_in_any_calendar(tmp_path: Path, calendar: str) -> None:
    numbers = np.array([0.25, 1.5, 400.125, 401.0])
    time = ("time", numbers, {"units": "days since 1850-01-01", "calendar": calendar})
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES)}, coords={"time": time}))
    with open_series(path) as series:
        np.testing.assert_array_equal(series.coords["t"].values, numbers)
        assert series.coords["t"].attributes["calendar"] == calendar


def test_dates_become_the_numbers_that_are_stored(tmp_path: Path) -> None:
    dates = np.array(
        ["2020-01-01T00:00", "2020-01-01T06:00", "2020-01-02T00:00", "2020-02-01T00:00"], "M8[ns]"
    )
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES)}, coords={"time": dates}))
    with open_series(path) as series:
        np.testing.assert_array_equal(series.coords["t"].values, [0, 6, 24, 31 * 24])
        assert series.coords["t"].attributes["units"].startswith("hours since 2020-01-01")


def test_a_variable_of_time_spans_stays_numbers(tmp_path: Path) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"age": (DIMS, VALUES, {"units": "hours"})}))
    np.testing.assert_array_equal(frames(path), VALUES)


def stored_as(path: Path, raw: np.ndarray, attributes: dict[str, object]) -> Path:
    """A NetCDF4 file of numbers as they are stored, with the attributes that say what they mean."""
    with h5py.File(path, "w") as file:
        variable = file.create_dataset("v", data=raw)
        for place, name in enumerate(DIMS):
            file[name] = np.arange(float(raw.shape[place]))
            file[name].make_scale(name)
            variable.dims[place].attach_scale(file[name])
        variable.attrs.update(attributes)
    return path


@pytest.mark.parametrize(
    ("stored", "fill", "packing"),
    [
        ("i8", -(2**63) + 2, {}),
        ("u8", 2**64 - 2, {}),
        ("i8", -2, {"_Unsigned": "true"}),
        ("i8", 2**62, {"scale_factor": 0.5, "add_offset": 1.0}),
    ],
)
def test_neighbours_of_a_fill_value_that_float64_does_not_tell_from_it_are_values(
    tmp_path: Path, stored: str, fill: int, packing: dict[str, object]
) -> None:
    raw = np.zeros(VALUES.shape, stored)
    raw[0, 0, 0, :3] = np.array([fill, fill + 1, 7], stored)
    got = frames(stored_as(tmp_path / "a.nc", raw, {"_FillValue": raw.dtype.type(fill), **packing}))
    numbers = raw.view("u8") if "_Unsigned" in packing else raw
    expected = numbers.astype(np.float64) * packing.get("scale_factor", 1) + packing.get(
        "add_offset", 0
    )
    expected[0, 0, 0, 0] = np.nan
    np.testing.assert_array_equal(got, expected)


def test_auxiliary_and_scalar_coordinates(tmp_path: Path) -> None:
    dataset = xr.Dataset(
        {"v": (("level", "lat", "lon"), VALUES[0])},
        coords={
            "pressure": ("level", [1000.0, 500.0, 100.0], {"units": "hPa", "axis": "Z"}),
            "time": ((), 347921.25, {"units": "hours since 1970-01-01"}),
            "realization": ((), 3),
            "area": (("lat", "lon"), np.ones((5, 6))),
        },
    )
    with open_series(save_netcdf(tmp_path / "a.nc", dataset)) as series:
        assert series.shape == (1, 3, 5, 6)
        assert series.coords["z"].name == "pressure"
        np.testing.assert_array_equal(series.coords["z"].values, [1000, 500, 100])
        np.testing.assert_array_equal(series.coords["t"].values, [347921.25])


def test_bounds_grid_mappings_and_coordinates_are_no_candidates(tmp_path: Path) -> None:
    dataset = xr.Dataset(
        {
            "v": (DIMS, VALUES, {"grid_mapping": "crs", "coordinates": "height3d"}),
            "crs": ((), 0),
            "height3d": (("lev", "lat", "lon"), VALUES[0]),
            "lat_bounds": (("lat", "lon", "four"), np.zeros((5, 6, 4))),
            "lat": ("lat", np.arange(5.0), {"bounds": "lat_bounds"}),
        }
    )
    path = save_netcdf(tmp_path / "a.nc", dataset)
    assert open_series(path).name == "v"
    np.testing.assert_array_equal(frames(path, var="height3d")[0], VALUES[0])


def test_groups(tmp_path: Path) -> None:
    xr.Dataset(coords={"time": ("time", np.arange(4.0) + 7)}).to_netcdf(
        tmp_path / "a.nc", engine="h5netcdf"
    )
    inner = xr.Dataset({"v": (("time", "lev", "lat", "lon"), VALUES)})
    inner.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", group="model/run", mode="a")
    np.testing.assert_array_equal(frames(tmp_path / "a.nc"), VALUES)
    np.testing.assert_array_equal(frames(tmp_path / "a.nc", var="model/run/v"), VALUES)


def test_plain_hdf5_named_nc_keeps_the_order_of_its_axes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["v"] = VALUES[:, :, :, :5]
        file["time"] = np.arange(4.0) * 3
        file["x"] = np.arange(5.0) * 2
    with open_series(tmp_path / "a.nc") as series:
        assert series.shape == (4, 3, 5, 5)
        np.testing.assert_array_equal(series.coords["t"].values, [0, 3, 6, 9])
        np.testing.assert_array_equal(series.coords["x"].values, np.arange(5) * 2)
        np.testing.assert_array_equal(series.coords["y"].values, np.arange(5))
        np.testing.assert_array_equal(series.read(1), VALUES[1, :, :, :5])


def test_classic_netcdf3(tmp_path: Path) -> None:
    dataset = xr.Dataset(
        {"v": (DIMS, VALUES)}, coords={"time": ("time", np.arange(4) / 3 + 347921)}
    )
    dataset.to_netcdf(tmp_path / "a.nc", engine="scipy", format="NETCDF3_64BIT")
    with open_series(tmp_path / "a.nc") as series:
        assert series.dtype.isnative
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4) / 3 + 347921)
    np.testing.assert_array_equal(frames(tmp_path / "a.nc"), VALUES)
    os.truncate(tmp_path / "a.nc", 300)
    with pytest.raises(InputError, match="cannot be read") as caught:
        open_series(tmp_path / "a.nc").read(3)
    assert "\n" not in str(caught.value)


def test_a_broken_install_ends_in_one_line_that_names_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES)}))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"cannot be read as NetCDF.*h5py") as caught:
        open_series(path)
    assert "\n" not in str(caught.value)


def test_a_missing_filter_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_netcdf(
        tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES)}), encoding={"v": {"zlib": True}}
    )
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(
        MissingDependencyError, match=r"v is compressed with the HDF5 filter .*fhash\[formats\]"
    ):
        open_series(path)


def test_ensembles_are_read_by_selection(tmp_path: Path) -> None:
    dims = ("time", "realization", "lev", "lat", "lon")
    coords = {"realization": ["r1", "r2"], "lev": ("lev", [1000.0, 850.0, 500.0])}
    dataset = xr.Dataset({"v": (dims, np.stack([VALUES, VALUES * 2], axis=1))}, coords=coords)
    path = save_netcdf(tmp_path / "a.nc", dataset)
    with pytest.raises(
        InputError,
        match=r"v has 5 dimensions \(time=4, realization=2, lev=3, lat=5, lon=6\), .*"
        r"--select realization=0",
    ):
        open_series(path)
    assert_frames(path, VALUES * 2, select={"realization": 1})
    assert_frames(path, VALUES * 2, select={"realization": "r2"})
    with open_series(path, select={"realization": "r1", "lev": 2}) as series:
        assert series.shape == (4, 1, 5, 6)
        assert series.coords["z"].values.tolist() == [500]
        assert series.attributes["selection"] == "realization=0, lev=2"
    (entry,) = list_variables(path)
    assert entry.options == (("--select", "realization=0"),)
    assert [axis for _, axis in entry.dimensions] == ["t", "select", "z", "y", "x"]


def test_one_group_a_step(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    for step in range(4):
        xr.Dataset({"rho": (DIMS[1:], VALUES[step])}, attrs={"time": 0.5 * step}).to_netcdf(
            path, mode="a" if step else "w", group=f"step_{9 + step}", engine="h5netcdf"
        )
    assert_frames(path, VALUES)
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [0, 0.5, 1, 1.5]


DEFAULT = np.float32(9.969209968386869e36)


@pytest.mark.parametrize("engine", ["scipy", "h5netcdf"])
def test_the_default_fill_value_of_floats_is_missing(tmp_path: Path, engine: str) -> None:
    path = tmp_path / "a.nc"
    values = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)
    values[1, 2] = DEFAULT
    dataset = xr.Dataset({"u": (list("tzyx"), values)})
    dataset.to_netcdf(path, engine=engine, encoding={"u": {"_FillValue": None}})
    with open_series(path) as series:
        assert not series.defaults
        frames = np.stack(list(series.frames()))
        assert series.defaults == {float(DEFAULT)}
        assert series.dtype == np.float32
    assert np.isnan(frames[1, 2]).all()
    np.testing.assert_array_equal(frames[0], values[0])
    for options in ({"keep_extremes": True}, {"raw_values": True}):
        with open_series(path, **options) as series:
            np.testing.assert_array_equal(series.read(1), values[1])
            assert not series.defaults
    with open_series(path, missing=[float(DEFAULT)]) as series:
        assert np.isnan(series.read(1)[2]).all()
        assert (series.occurring, series.defaults) == ({float(DEFAULT)}, set())
    dataset.to_netcdf(path, engine=engine, encoding={"u": {"_FillValue": -1.0}})
    with open_series(path) as series:
        np.testing.assert_array_equal(series.read(1), values[1])


@pytest.mark.parametrize(
    ("dtype", "fill"), [("i1", -127), ("i2", -32767), ("i4", -2147483647), ("u1", 255)]
)
def test_the_default_fill_value_of_integers_is_told(tmp_path: Path, dtype: str, fill: int) -> None:
    path = tmp_path / "a.nc"
    values = np.arange(2 * 3 * 4 * 5).astype(dtype).reshape(2, 3, 4, 5)
    values[1, 2] = fill
    xr.Dataset({"u": (list("tzyx"), values)}).to_netcdf(path, engine="h5netcdf")
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        assert series.defaults == (set() if dtype.endswith("1") else {fill})


def test_packed_default_fill_value_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    values = np.arange(2 * 3 * 4 * 5, dtype="i2").reshape(2, 3, 4, 5)
    values[1, 2] = -32767
    attributes = {"scale_factor": 0.5, "add_offset": 10.0}
    xr.Dataset({"u": (list("tzyx"), values, attributes)}).to_netcdf(path, engine="h5netcdf")
    with open_series(path) as series:
        frames = np.stack(list(series.frames()))
    assert np.isnan(frames[1, 2]).all()
    np.testing.assert_array_equal(frames[0], values[0] * 0.5 + 10)


TYPES = ["i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8"]


def classic(
    path: Path,
    kind: int,
    dimensions: dict[str, int],
    variables: dict[str, tuple[tuple[str, ...], np.ndarray[Any, Any], dict[str, Any]]],
    *,
    streaming: bool = False,
) -> Path:
    """Write a file as the specification says; a length of 0 is that of the unlimited dimension."""
    wide = 8 if kind == 5 else 4

    def count(n: int) -> bytes:
        return n.to_bytes(wide, "big")

    def padded(data: bytes) -> bytes:
        return data + bytes(-len(data) % 4)

    def name(text: str) -> bytes:
        data = text.encode()
        return count(len(data)) + padded(data)

    def listed(tag: int, members: list[bytes]) -> bytes:
        return (tag if members else 0).to_bytes(4, "big") + count(len(members)) + b"".join(members)

    def number(dtype: np.dtype[Any]) -> int:
        return 1 + TYPES.index(dtype.newbyteorder(">").str.replace("|", ""))

    def attribute(key: str, value: Any) -> bytes:
        if isinstance(value, bytes):
            return name(key) + (2).to_bytes(4, "big") + count(len(value)) + padded(value)
        array = np.atleast_1d(value)
        data = array.astype(array.dtype.newbyteorder(">")).tobytes()
        return name(key) + number(array.dtype).to_bytes(4, "big") + count(len(array)) + padded(data)

    keys = list(dimensions)
    records = max(
        (len(v) for d, v, _ in variables.values() if d and not dimensions[d[0]]), default=0
    )
    blocks = {
        key: value.astype(value.dtype.newbyteorder(">")) for key, (_, value, _) in variables.items()
    }
    recorded = [key for key, (d, _, _) in variables.items() if d and not dimensions[d[0]]]

    def one_record(key: str, i: int) -> bytes:
        data = blocks[key][i : i + 1].tobytes()  # a scalar would be native
        return data if len(recorded) == 1 else padded(data)

    fixed = {key: padded(blocks[key].tobytes()) for key in variables if key not in recorded}
    stated = bytes([255]) * wide if streaming else count(records)

    def header(begins: dict[str, int]) -> bytes:
        described = [
            name(key)
            + count(len(dims))
            + b"".join(count(keys.index(each)) for each in dims)
            + listed(12, [attribute(k, v) for k, v in attributes.items()])
            + number(value.dtype).to_bytes(4, "big")
            + count(len(fixed.get(key) or padded(one_record(key, 0))))
            + begins.get(key, 0).to_bytes(4 if kind == 1 else 8, "big")
            for key, (dims, value, attributes) in variables.items()
        ]
        named = [name(key) + count(length) for key, length in dimensions.items()]
        return (
            b"CDF"
            + bytes([kind])
            + stated
            + listed(10, named)
            + listed(12, [])
            + listed(11, described)
        )

    at, begins, tail = len(header({})), {}, b""
    for key, data in fixed.items():
        begins[key] = at + len(tail)
        tail += data
    start = at + len(tail)
    for key in recorded:
        begins[key] = start
        start += len(one_record(key, 0))
    for i in range(records):
        tail += b"".join(one_record(key, i) for key in recorded)
    path.write_bytes(header(begins) + tail)
    return path


def everything(kind: int) -> dict[str, Any]:
    """Variables of all types of a kind, along the unlimited dimension and not."""
    rng = np.random.default_rng(kind)
    made: dict[str, Any] = {}
    for dtype in TYPES if kind == 5 else TYPES[:6]:
        for dims in (("t", "y", "x"), ("y", "x"), ("t",), ()):
            shape = tuple({"t": 3, "y": 2, "x": 5}[d] for d in dims)
            values = np.frombuffer(rng.bytes(64 * 8), np.dtype(dtype).newbyteorder("="))
            values = values[: int(np.prod(shape))].reshape(shape)
            attribute = b"text" if dtype == "S1" else values.reshape(-1)[:3]
            made[f"v{dtype[-2:]}_{''.join(dims)}"] = (dims, values, {"n": attribute})
    return {k: v for k, v in made.items() if "S1" not in k or v[1].ndim}


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("kind", [1, 2, 5])
def test_all_types_of_the_three_kinds(tmp_path: Path, kind: int, streaming: bool) -> None:
    variables = everything(kind)
    lengths = {"x": 5, "t": 0, "y": 2}
    path = classic(tmp_path / "a.nc", kind, lengths, variables, streaming=streaming)
    attributes, listed = read_header(path)
    found = {each.name: each for each in listed}
    assert set(found) == set(variables)
    for key, (dims, values, _) in variables.items():
        assert found[key].dimensions == dims
        assert found[key].whole().astype(values.dtype).tobytes() == values.tobytes(), key
    if kind < 5 and not streaming:  # as a second reader sees it
        arrays = {
            key: (each.dimensions, each.whole(), each.attributes) for key, each in found.items()
        }
        with xr.open_dataset(path, engine="scipy", mmap=False, decode_cf=False) as other:
            xr.testing.assert_identical(other, xr.Dataset(arrays, attrs=attributes))


def test_records_of_one_array_alone_are_not_padded(tmp_path: Path) -> None:
    values = np.arange(3 * 2 * 3 * 5, dtype=np.int8).reshape(3, 2, 3, 5)[:, :, :, :5]
    lengths = {"t": 0, "z": 2, "y": 3, "x": 5}
    path = classic(tmp_path / "a.nc", 1, lengths, {"v": (tuple("tzyx"), values, {})})
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        np.testing.assert_array_equal(series.read(2), values[2])


def test_64_bit_integers_of_cdf5_keep_every_digit_and_their_fill_value(tmp_path: Path) -> None:
    values = 2**60 + np.arange(2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    values[1, 2, 3, 4] = -(2**62) - 1
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    fill = {"_FillValue": np.int64(-(2**62) - 1)}
    path = classic(tmp_path / "a.nc", 5, lengths, {"v": (tuple("tzyx"), values, fill)})
    with open_series(path, raw_values=True) as series:
        np.testing.assert_array_equal(series.read(1), values[1])
    with open_series(path) as series:
        missing = np.isnan(series.read(1).astype(float))
    assert np.argwhere(missing).tolist() == [[2, 3, 4]]


def test_names_are_utf8_and_texts_that_are_not_are_latin_1(tmp_path: Path) -> None:
    values = np.zeros((2, 3, 4, 5), np.float32)
    attributes = {"units": "\u00b0C".encode("latin-1"), "long_name": "t\u00e9mp".encode()}
    lengths = {"t": 2, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", 2, lengths, {"t\u00e9": (tuple("tzyx"), values, attributes)})
    with open_series(path) as series:
        assert series.name == "t\u00e9"
        assert series.attributes == {"units": "\u00b0C", "long_name": "t\u00e9mp"}


@pytest.mark.parametrize("kind", [1, 5])
def test_a_damaged_header_is_one_line_or_another_sound_one(tmp_path: Path, kind: int) -> None:
    values = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", kind, lengths, {"v": (tuple("tzyx"), values, {"a": b"bc"})})
    sound = path.read_bytes()
    begin = len(sound) - values.nbytes  # one array alone is not padded
    messages = []
    for at in range(4, begin):
        damaged = bytearray(sound)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            with open_series(path) as series:
                series.read(0)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > begin // 4
    assert not [message for message in messages if "\n" in message]


@pytest.mark.parametrize("left", [40, 100, 300, -1])
def test_a_file_that_was_cut_off_says_so(tmp_path: Path, left: int) -> None:
    values = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", 2, lengths, {"v": (tuple("tzyx"), values, {})})
    os.truncate(path, left % path.stat().st_size)
    with pytest.raises(InputError, match=f"{path} cannot be read as classic NetCDF: ") as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
