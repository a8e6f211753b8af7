"""The reader that a file gets, what each exports, and masks over a series."""

from __future__ import annotations

import errno
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from stored_series import frames

from fhash_formats.container.zip_file import ending
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InputError,
    MissingInputError,
    RegionError,
)
from fhash_formats.readers.file_series import FileSeries, RawLayout
from fhash_formats.readers.joined import JoinedSeries, natural_order
from fhash_formats.readers.registry import REGISTRY, list_variables, open_mask, open_series
from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_region

MASK = np.random.default_rng(0).random((4, 3, 5, 6)) < 0.4


def save(path: Path, values: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["mask"] = values
    elif path.suffix == ".zarr":
        zarr.create_array(path, shape=values.shape, dtype=values.dtype)[...] = values
    else:
        path = path.with_name(
            f"m_{'x'.join(map(str, reversed(values.shape)))}_{values.dtype.name}.raw"
        )
        path.write_bytes(values.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".npy", ".h5", ".zarr", ".raw"])
@pytest.mark.parametrize("dtype", ["?", "u1", "i2", "f4"])
def test_nonzero_is_true(tmp_path: Path, suffix: str, dtype: str) -> None:
    if (suffix, dtype) == (".raw", "?"):
        dtype = "u1"
    values = (MASK * (-3 if dtype in ("i2", "f4") else 1)).astype(dtype)
    mask = open_mask(save(tmp_path / f"m{suffix}", values), MASK.shape)
    for step, expected in enumerate(MASK):
        frame = mask(step)
        assert frame.dtype == bool
        np.testing.assert_array_equal(frame, expected)
    mask.close()


def test_one_frame_serves_every_step(tmp_path: Path) -> None:
    for values in (MASK[0], MASK[:1]):
        mask = open_mask(save(tmp_path / "m.npy", values), (9, 3, 5, 6))
        np.testing.assert_array_equal(mask(0), MASK[0])
        np.testing.assert_array_equal(mask(8), MASK[0])


def test_nan_is_false(tmp_path: Path) -> None:
    values = np.where(MASK, 1.0, 0.0)
    values[0, 0, 0, :2] = np.nan
    mask = open_mask(str(save(tmp_path / "m.npy", values)), MASK.shape)
    np.testing.assert_array_equal(mask(0), np.nan_to_num(values[0]) != 0)


def test_a_mask_stands_alone_in_its_file(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["a"], file["b"] = MASK, ~MASK
    with pytest.raises(InputError, match="2 variables"):
        open_mask(tmp_path / "m.h5", MASK.shape)


@pytest.mark.parametrize("shape", [(5, 3, 5, 6), (2, 3, 5, 6), (4, 3, 5, 7), (4, 6, 5, 3)])
def test_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"the mask has shape \(4, 3, 5, 6\).*the series \("):
        open_mask(save(tmp_path / "m.npy", MASK), shape)


def test_other_types_and_missing_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="complex"):
        open_mask(save(tmp_path / "m.npy", MASK.astype(complex)), MASK.shape)
    with pytest.raises(MissingInputError):
        open_mask(tmp_path / "none.npy", MASK.shape)


def test_a_mask_is_not_asked_for_its_axes(tmp_path: Path) -> None:
    mask = np.ones((16, 24, 24, 3), bool)
    np.testing.assert_array_equal(open_mask(save(tmp_path / "m.npy", mask), mask.shape)(3), mask[3])


VALUES = np.random.default_rng(0).normal(size=(7, 2, 3, 4)).astype(np.float32)


@pytest.fixture
def path_registry(tmp_path: Path) -> Path:
    np.save(tmp_path / "a.npy", VALUES)
    return tmp_path / "a.npy"


def test_formats_are_told_by_their_first_bytes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.npy", "w") as file:
        file["v"] = VALUES
    np.save(tmp_path / "b.npy", VALUES)
    os.rename(tmp_path / "b.npy", tmp_path / "b.h5")
    for name in ("a.npy", "b.h5"):
        with open_series(str(tmp_path / name)) as series:
            np.testing.assert_array_equal(series.read(3), VALUES[3])


@pytest.mark.parametrize(
    ("name", "words"), [("a.h5", "HDF5"), ("a.nc", "NetCDF"), ("a.npy", r"\.npy"), ("a.zip", "ZIP")]
)
def test_a_suffix_without_the_bytes_is_a_damaged_file(
    tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / name).write_bytes(b"nothing of the kind " * 100)
    with pytest.raises(InputError, match=f"cannot be read as (a )?{words}") as caught:
        open_series(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_an_unknown_format_lists_what_is_known(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="of no format that can be read") as caught:
        open_series(tmp_path / "a.xyz")
    for reader in REGISTRY:
        assert reader.name in str(caught.value)


@pytest.mark.parametrize(("name", "way"), [("a.fits", "astropy"), ("a.VTU", "ResampleToImage")])
def test_other_formats_have_a_way(tmp_path: Path, name: str, way: str) -> None:
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=f"read it by .*{way}.*fhash_codec.encode"):
        open_series(tmp_path / name)


def test_names_and_suffixes_are_unique() -> None:
    suffixes = [suffix for reader in REGISTRY for suffix in reader.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    assert len({reader.name for reader in REGISTRY}) == len(REGISTRY)


def test_inputs_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="does not exist") as caught:
        open_series(tmp_path / "none.h5")
    assert isinstance(caught.value, FileNotFoundError)
    (tmp_path / "link.h5").symlink_to(tmp_path / "nowhere.h5")
    with pytest.raises(MissingInputError):
        open_series(tmp_path / "link.h5")
    with pytest.raises(InputError, match="folder without zarr metadata"):
        open_series(tmp_path)
    (tmp_path / "empty.h5").touch()
    with pytest.raises(InputError, match=r"empty \(0 bytes\)"):
        open_series(tmp_path / "empty.h5")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.raw")
        with pytest.raises(InputError, match="not a regular file"):
            open_series(tmp_path / "pipe.raw")


def test_a_container_is_to_be_decoded(tmp_path: Path) -> None:
    (tmp_path / "a.fhz").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(InputError, match=r"fhash decode a.fhz"):
        open_series(tmp_path / "a.fhz")
    (tmp_path / "renamed.zip").write_bytes(b"PK\x03\x04" + ending([]))
    with pytest.raises(InputError, match=r"encoded already; use: fhash decode renamed\.zip"):
        open_series(tmp_path / "renamed.zip")


def test_a_raw_layout_is_for_files(tmp_path: Path) -> None:
    zarr.create_array(tmp_path / "a.zarr", shape=(2, 2, 2), dtype="f4")
    with pytest.raises(InputError, match="given for raw files only"):
        open_series(tmp_path / "a.zarr", raw=RawLayout(dtype="f4"))


@pytest.mark.parametrize(
    "steps",
    [
        slice(None),
        slice(2, 5),
        slice(None, None, 3),
        slice(None, None, -1),
        slice(-2, None),
        slice(5, 100),
        slice(6, 1, -2),
    ],
)
def test_steps_are_a_slice(path_registry: Path, steps: slice) -> None:
    with open_series(path_registry, steps=steps) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES[steps])
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(7)[steps])


@pytest.mark.parametrize(
    ("steps", "words"),
    [(slice(0, 5, 0), "stride of 0"), (slice(3, 3), "empty"), (slice(10, 20), "empty")],
)
def test_steps_that_select_nothing(path_registry: Path, steps: slice, words: str) -> None:
    with pytest.raises(InputError, match=words):
        open_series(path_registry, steps=steps)


@pytest.mark.parametrize("step", [-1, 7])
def test_a_step_outside_the_series(path_registry: Path, step: int) -> None:
    with open_series(path_registry) as series, pytest.raises(RegionError, match=r"outside 0\.\.6"):
        series.read(step)


@pytest.mark.parametrize("axes", ["z,y,x", "x", "t,y"])
def test_axes_of_another_number(path_registry: Path, axes: str) -> None:
    with pytest.raises(InputError, match="the array has 4 dimensions"):
        open_series(path_registry, axes=axes)


def refusal(path_registry: Path) -> str:
    """The message of the FhashError that reading a whole series raises, "" where it reads.

    Any other error passes.
    """
    try:
        with open_series(path_registry) as series:
            list(series.frames())
    except FhashError as error:
        return str(error)
    return ""


def test_every_refusal_is_of_the_one_tree(tmp_path: Path) -> None:
    chance = np.random.default_rng(0)
    by_suffix = [(b"", "a.nc"), (b"", "a.zip")]
    by_head = [
        (head, name)
        for head in (
            b"",
            b"\x89HDF\r\n\x1a\n",
            b"PK\x03\x04",
            b"\x93NUMPY",
            b"CDF\x01",
            b"CDF\x02",
        )
        for name in ("a", "a_2x2x2_u1.raw")
    ]
    for size in (1, 7, 8, 30, 4096):
        for head, name in (*by_suffix, *by_head):
            (tmp_path / name).write_bytes((head + chance.bytes(size))[: max(size, len(head))])
            message = refusal(tmp_path / name)
            assert "\n" not in message
            assert len(message) < 700


@pytest.mark.parametrize("suffix", [".npy", ".h5", ".nc", ".zip"])
def test_a_raw_layout_is_not_for_files_of_another_format(
    path_registry: Path, tmp_path: Path, suffix: str
) -> None:
    named = tmp_path / f"named{suffix}"
    named.write_bytes(path_registry.read_bytes())
    for layout in (
        RawLayout(dtype="f4"),
        RawLayout({"x": 1, "y": 1, "z": 1}),
        RawLayout(endian="big"),
    ):
        with pytest.raises(
            InputError, match="--shape, --dtype and --endian are for raw files only"
        ):
            open_series(named, raw=layout)


@pytest.mark.parametrize("place", ["exists", "is_dir", "is_file"])
def test_what_may_not_be_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    zarr.create_array(tmp_path / "a.zarr", shape=(2, 2, 2), dtype="f4")

    def denied(*_: Any, **__: Any) -> bool:  # the tests may run as root, whom no mode stops
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "a.zarr"))

    monkeypatch.setattr(Path, place, denied)
    with pytest.raises(InputError, match=r"a.zarr cannot be read: .*Permission denied"):
        open_series(tmp_path / "a.zarr")


@pytest.mark.parametrize(
    "name", ["a\udcff.npy", "a\udcff_6x5x3_float32.raw", "a\udcff_*.npy", "a\udcff.zarr"]
)
def test_names_are_text_whatever_the_file_is_called(tmp_path: Path, name: str) -> None:
    frame = np.ones((3, 5, 6), np.float32)
    for part in (
        [tmp_path / name.replace("*", str(step)) for step in range(2)]
        if "*" in name
        else [tmp_path / name]
    ):
        if name.endswith(".raw"):
            part.write_bytes(frame.tobytes())
        elif name.endswith(".npy"):
            np.save(part, frame)
        else:
            zarr.create_array(tmp_path / "a.zarr", data=frame)
            (tmp_path / "a.zarr").rename(part)
    with open_series(tmp_path / name) as series:
        assert series.name[:2] == "a\u00ff"
        np.testing.assert_array_equal(series.read(0), frame)


def test_every_array_of_a_file_is_listed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.vtkhdf", "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Type"] = np.bytes_(b"ImageData")
        root.attrs["WholeExtent"] = [0, 3, 0, 2, 0, 1]
        root.attrs["Origin"], root.attrs["Spacing"] = [0.0, 0, 0], [1.0, 1, 1]
        root["PointData/u"], root["PointData/n"] = VALUES[0], VALUES[0].astype("i2")
    found = list_variables(tmp_path / "a.vtkhdf", missing=[7])
    assert [(one.name, one.dtype, one.missing) for one in found] == [
        ("n", "int16", ()),
        ("u", "float32", ()),
    ]
    assert found[0].options == (("--var", "n", "--missing", "7"),)
    (one,) = list_variables(tmp_path / "a.vtkhdf", var="u")
    assert one.name == "u"


@pytest.mark.parametrize("suffix", ["raw", "mha", "npy"])
@pytest.mark.parametrize("pattern", [False, True])
def test_wishes_that_a_format_has_no_use_for_are_refused(
    tmp_path: Path, suffix: str, pattern: bool
) -> None:
    name = f"a_4x3x2_float32.{suffix}"
    if suffix == "npy":
        np.save(tmp_path / name, VALUES[0])
    else:
        head = b"ObjectType = Image\nNDims = 3\nDimSize = 4 3 2\nElementType = MET_FLOAT\n"
        head += b"ElementDataFile = LOCAL\n"
        (tmp_path / name).write_bytes((head if suffix == "mha" else b"") + VALUES[0].tobytes())
    path_registry = tmp_path / (f"*.{suffix}" if pattern else name)
    open_series(path_registry).close()
    wishes: list[tuple[dict[str, Any], str]] = [
        ({"select": {"a": 1}}, "--select a=1: .* has no dimension 'a'"),
    ]
    for wish, message in wishes:
        with pytest.raises(InputError, match=message):
            open_series(path_registry, **wish)
        assert not list_variables(path_registry, **wish)[0].options


def test_missing_numbers_that_occur_are_noted(path_registry: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "b.npy", np.array([[[1, 2, 300]]], "i2").repeat(2, axis=0))
    np.save(tmp_path / "c.npy", np.array([[[1, 2, -9]]], "i2").repeat(2, axis=0))
    (tmp_path / "a.npy").unlink()
    with open_series(tmp_path / "*.npy", missing=[300, -9, 5, 1e20], steps=slice(2)) as series:
        assert series.occurring == set()
        list(series.frames())
        assert series.occurring == {300, -9}
    with open_series(tmp_path / "b.npy", missing=[300, -9]) as series:
        series.read(0)
        assert series.occurring == {300}


EVEN = {"t": [3.5, 4.0, 9.0], "z": [2.0, 2.5], "y": [-1.0, 0.0, 1.0, 2.0], "x": [10.0, 10.5, 11.0]}
UNEVEN = {**EVEN, "x": [10.0, 10.5, 13.0], "z": [5.0, 7.5]}
UNITS = "days since 2001-02-03"


def region(axes: dict[str, list[float]], dtype: str) -> Region:
    coords = {
        axis: Coordinate(
            name={"t": "time"}.get(axis, axis),
            values=np.array(values),
            attributes={"units": UNITS} if axis == "t" else {},
        )
        for axis, values in axes.items()
    }
    t, z, y, x = (len(axes[axis]) for axis in "tzyx")
    return Region(
        name="wind", units="m/s", dtype=np.dtype(dtype), shape=(t, z, y, x), coords=coords
    )


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i2"])
@pytest.mark.parametrize(
    "suffix", [".h5", ".nc", ".zarr", ".raw", ".vti", ".vtr", ".pvd", ".vtkhdf"]
)
def test_an_export_comes_back(tmp_path: Path, suffix: str, dtype: str, steps: int) -> None:
    axes = {**(UNEVEN if suffix == ".vtr" else EVEN), "t": EVEN["t"][:steps]}
    described = region(axes, dtype)
    values = np.random.default_rng(0).normal(size=described.shape) * 100
    values = values.astype(dtype)
    written = save_region(tmp_path / f"out{suffix}", described, values)
    with open_series(written[-1]) as series:  # the list of files, or the header, is the last
        assert series.shape == described.shape
        assert series.dtype == described.dtype
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        assert (series.name, series.units) == ("wind", "m/s")
        for axis in "tzyx":
            np.testing.assert_array_equal(series.coords[axis].values, described.coords[axis].values)
        assert series.coords["t"].attributes["units"] == UNITS


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr", ".raw", ".vti", ".pvd", ".vtkhdf"])
def test_no_date_loses_its_calendar(tmp_path: Path, suffix: str) -> None:
    described = region(EVEN, "f4")
    time = described.coords["t"]
    attributes = {**time.attributes, "calendar": "noleap"}
    coords = {**described.coords, "t": replace(time, attributes=attributes)}
    values = np.zeros(described.shape, "f4")
    written = save_region(tmp_path / f"out{suffix}", replace(described, coords=coords), values)
    with open_series(written[-1]) as series:
        found = series.coords["t"].attributes
        assert found.get("calendar") == "noleap" or "units" not in found
        assert ("units" in found) == (suffix not in (".vti", ".pvd"))


@pytest.mark.parametrize("suffix", [".vti", ".vtr", ".pvd", ".vtkhdf"])
def test_descending_axes_come_back_ascending(tmp_path: Path, suffix: str) -> None:
    described = region({**EVEN, "y": EVEN["y"][::-1]}, "f4")
    values = np.random.default_rng(0).normal(size=described.shape).astype("f4")
    written = save_region(tmp_path / f"out{suffix}", described, values)
    with open_series(written[-1]) as series:
        np.testing.assert_array_equal(series.coords["y"].values, EVEN["y"])
        np.testing.assert_array_equal(np.stack(list(series.frames())), values[:, :, ::-1])


@pytest.mark.vtk
def test_vtk_takes_the_time_and_its_units(tmp_path: Path) -> None:
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    described = region({**EVEN, "t": [4.0]}, "f4")
    save_region(tmp_path / "out.vti", described, np.zeros(described.shape, "f4"))
    reader = xml.vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "out.vti"))
    reader.Update()
    array = reader.GetOutput().GetFieldData().GetArray("TimeValue")
    assert array.GetTuple1(0) == 4.0
    assert array.GetInformation().Get(array.UNITS_LABEL()) == UNITS


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


VALUES_JOINED = np.random.default_rng(0).normal(size=(12, 3, 5, 6)).astype(np.float32)


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
    for step, frame in enumerate(VALUES_JOINED):
        if kind == "npy":
            np.save(tmp_path / f"frame_{step}.npy", frame)
        elif kind == "raw":
            (tmp_path / f"frame_{step}_6x5x3_float32.raw").write_bytes(frame.tobytes())
        elif kind == "layout":
            (tmp_path / f"frame_{step}.bin").write_bytes(frame.tobytes())
        else:
            h5(tmp_path / f"frame_{step}.h5", frame)
    layout = RawLayout({"x": 6, "y": 5, "z": 3}, "f4") if kind == "layout" else None
    np.testing.assert_array_equal(frames(tmp_path / "frame_*", raw=layout), VALUES_JOINED)
    with open_series(tmp_path / "frame_*", raw=layout, steps=slice(10, 2, -4)) as series:
        assert series.name == ("v" if kind == "h5" else "frame")
        assert series.source == str(tmp_path / "frame_*")
        np.testing.assert_array_equal(series.coords["t"].values, [10, 6])
        np.testing.assert_array_equal(series.read(1), VALUES_JOINED[6])


def test_several_steps_per_file_and_character_classes(tmp_path: Path) -> None:
    for name, part in (
        ("a1", VALUES_JOINED[:5]),
        ("a2", VALUES_JOINED[5:6]),
        ("a10", VALUES_JOINED[6:]),
        ("b1", VALUES_JOINED),
    ):
        np.save(tmp_path / f"{name}.npy", part)
    np.testing.assert_array_equal(frames(tmp_path / "a*.npy"), VALUES_JOINED)
    np.testing.assert_array_equal(frames(tmp_path / "[a]?.npy"), VALUES_JOINED[:6])


def test_a_name_with_brackets_is_a_file(tmp_path: Path) -> None:
    np.save(tmp_path / "a[1].npy", VALUES_JOINED)
    np.testing.assert_array_equal(frames(tmp_path / "a[1].npy"), VALUES_JOINED)


def test_times_of_the_files(tmp_path: Path) -> None:
    for step in range(3):
        h5(
            tmp_path / f"f{step}.h5",
            VALUES_JOINED[2 * step : 2 * step + 2],
            time=[347921.0 + step, 347921.5 + step],
            x=np.arange(6.0) * 2,
        )
    with open_series(tmp_path / "f*.h5") as series:
        np.testing.assert_array_equal(series.coords["t"].values, 347921 + np.arange(6) / 2)
        np.testing.assert_array_equal(series.coords["x"].values, np.arange(6) * 2)
    h5(tmp_path / "f3.h5", VALUES_JOINED[:2], time=[0.0, 1.0], x=np.arange(6.0) * 2)
    with pytest.raises(
        InputError, match=r"times do not increase.*0 in .*f3.h5 after 347924 in .*f2.h5"
    ):
        open_series(tmp_path / "f*.h5")
    h5(tmp_path / "f3.h5", VALUES_JOINED[:2], x=np.arange(6.0) * 2)
    with pytest.raises(InputError, match=r"f3.h5 has no time, and .*f0.h5 has one"):
        open_series(tmp_path / "f*.h5")
    h5(tmp_path / "f3.h5", VALUES_JOINED[:2], time=[400000.0, 400001.0], x=np.arange(6.0) * 3)
    with pytest.raises(InputError, match=r"f3.h5 has positions along x: 0 to 15, .*f0.h5 0 to 10"):
        open_series(tmp_path / "f*.h5")


@pytest.mark.parametrize(
    ("overlap", "steps", "times"),
    [
        ("first", [0, 1, 2, 5, 7], [0, 1, 2, 3, 4]),
        ("last", [0, 3, 4, 6, 7], [0, 1, 2, 3, 4]),
    ],
)
def test_files_of_a_restart_overlap(
    tmp_path: Path, overlap: str, steps: list[int], times: list[float]
) -> None:
    frames_of = np.arange(8.0)[:, None, None, None] * np.ones((1, 2, 3, 4))
    spans = {"0": [0.0, 1, 2], "1": [24.0, 48, 72], "2": [3.0, 4]}
    units = {"0": "days since 2001-01-01", "1": "hours since 2001-01-01"}
    first = 0
    for name, hours in spans.items():
        xr.Dataset(
            {"v": (("time", "z", "y", "x"), frames_of[first : first + len(hours)])},
            coords={"time": ("time", hours, {"units": units.get(name, units["0"])})},
        ).assign(dt=("time", np.arange(first, first + len(hours)) * 0.5)).to_netcdf(
            tmp_path / f"r{name}.nc"
        )
        first += len(hours)
    pattern = tmp_path / "r*.nc"
    with pytest.raises(InputError, match="--overlap first or last"):
        open_series(pattern, var="v")
    with open_series(pattern, var="v", overlap=overlap) as series:
        assert [frame[0, 0, 0] for frame in series.frames()] == steps
        assert series.coords["t"].values.tolist() == times
        beside = series.metadata.named("dt")
        assert beside.values.tolist() == [0.5 * step for step in steps]


def test_what_cannot_overlap(tmp_path: Path) -> None:
    for name in "01":
        np.save(tmp_path / f"{name}.npy", VALUES_JOINED)
    with pytest.raises(InputError, match="overlap is for files with times"):
        open_series(tmp_path / "*.npy", overlap="last")
    with pytest.raises(InputError, match="overlap is for a pattern"):
        open_series(tmp_path / "0.npy", overlap="last")


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (VALUES_JOINED[:, :2], r"a frame \(z, y, x\) of shape \(2, 5, 6\), .*a_1.npy \(3, 5, 6\)"),
        (VALUES_JOINED.astype("f8"), "values of type float64, .*a_1.npy float32"),
        (VALUES_JOINED > 0, "boolean"),
    ],
)
def test_files_that_differ_are_named(tmp_path: Path, other: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a_1.npy", VALUES_JOINED)
    np.save(tmp_path / "a_2.npy", other)
    with pytest.raises(InputError, match=rf"a_2.npy .*{words}"):
        open_series(tmp_path / "a_*.npy")


def test_no_file_matches(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"no file matches .*none_\*\.raw"):
        open_series(tmp_path / "none_*.raw")


def test_a_file_that_changes_is_refused(tmp_path: Path) -> None:
    for step in range(3):
        np.save(tmp_path / f"f{step}.npy", VALUES_JOINED[step])
    with open_series(tmp_path / "f*.npy") as series:
        series.read(0)
        np.save(tmp_path / "f1.npy", VALUES_JOINED)
        with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
            series.read(1)
        np.testing.assert_array_equal(series.read(2), VALUES_JOINED[2])
        with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
            series.check()


def test_a_file_that_changes_while_it_is_opened_is_refused(tmp_path: Path) -> None:
    for step in range(2):
        np.save(tmp_path / f"f{step}.npy", VALUES_JOINED[step])
    with open_series(tmp_path / "f*.npy") as series:
        assert isinstance(series, JoinedSeries)
        open_part = series._open_part

        def written_meanwhile(path: Path) -> FileSeries:
            np.save(path, VALUES_JOINED[7])
            os.utime(path, ns=(1, 1))
            return open_part(path)

        series._open_part = written_meanwhile
        for _ in range(2):
            with pytest.raises(InputError, match=r"f1.npy changed while it was being read"):
                series.read(1)


def test_one_file_is_open_at_a_time(tmp_path: Path) -> None:
    for step in range(12):
        h5(tmp_path / f"f{step}.h5", VALUES_JOINED[step])
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
        h5(tmp_path / f"f{step}.h5", VALUES_JOINED[step])
        with h5py.File(tmp_path / f"f{step}.h5", "a") as file:
            file["v"].attrs["scale_factor"] = 2.0
    expected = VALUES_JOINED[:4].astype(np.float64) * 2
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
        dated(
            tmp_path / f"f{step}.h5", VALUES_JOINED[step], time, units, "gregorian" if step else ""
        )
    with open_series(tmp_path / "f*.h5") as series:
        coordinate = series.coords["t"]
        assert coordinate.attributes["units"] == "days since 2001-02-26"
        np.testing.assert_array_equal(coordinate.values, [0, 1.25, 2 + 7 / 86400, 9.25])


def test_calendars_that_differ_are_not_joined(tmp_path: Path) -> None:
    dated(tmp_path / "f0.h5", VALUES_JOINED[0], 0, "days since 2001-02-26")
    dated(tmp_path / "f1.h5", VALUES_JOINED[1], 0, "days since 2001-02-27", "noleap")
    message = r"f1.h5 has not the units of the time in .*f0.h5: days since 2001-02-27 noleap and"
    with pytest.raises(InputError, match=message):
        open_series(tmp_path / "f*.h5")
    dated(tmp_path / "f1.h5", VALUES_JOINED[1], 0, "s")
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
        np.save(tmp_path / f"{name}.npy", VALUES_JOINED[step])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with open_series(tmp_path / "*.npy") as series:
            assert series.shape[0] == len(names)
    assert [told in str(each.message) for each in caught] == ([True] if told else [])
