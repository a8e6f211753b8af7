"""Zarr stores: in a folder, in a ZIP, coded by ourselves, and those that cannot be opened."""

from __future__ import annotations

import json
import os
import shutil
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
import zarr
from stored_series import VALUES, assert_frames, create_zarr, frames, zipped
from zarr.codecs import Crc32cCodec, GzipCodec, TransposeCodec

from fhash_formats.errors import DamagedFileError, FhashWarning, InputError
from fhash_formats.readers.file_series import Request
from fhash_formats.readers.registry import list_variables, open_series
from fhash_formats.readers.zarr_coded import coded_names, open_coded
from fhash_formats.transform.tile import decode_chunk
from fhash_formats.transform.zarr_codec import TransformCodec


def dataset() -> xr.Dataset:
    values = np.linspace(0, 9, 60).reshape(3, 4, 5)
    values[0, 1, 2] = np.nan
    return xr.Dataset(
        {
            "u": (("time", "lat", "lon"), values, {"units": "K", "grid_mapping": "crs"}),
            "crs": ((), np.int32(0), {"grid_mapping_name": "latitude_longitude"}),
            "lat_bnds": (("lat", "bnds"), np.arange(8, dtype="f4").reshape(4, 2)),
        },
        {
            "time": ("time", np.array([0, 2, 3]), {"units": "days since 2000-01-01"}),
            "lat": ("lat", np.arange(4, dtype="f4"), {"bounds": "lat_bnds", "levels": [1, 2]}),
            "lon": ("lon", np.arange(5, dtype="i2")),
            "slope": (("lat", "lon"), np.full((4, 5), np.nan, dtype="f4")),
            "label": ("time", np.array(["a", "bb", "ö"], dtype=object)),
        },
        {"title": "a store"},
    )


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("group", [None, "inner"])
def test_a_store_gives_what_was_written(tmp_path: Path, zarr_format: int, group: str) -> None:
    path = tmp_path / "a.zarr"
    packing = {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -9}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of texts that are not yet in the specification
        dataset().to_zarr(
            path,
            group=group,
            zarr_format=zarr_format,
            encoding={"u": packing, "slope": {"_FillValue": np.float32(-1)}},
        )
    with open_series(path, var="u" if group is None else f"{group}/u") as series:
        metadata = series.metadata
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    assert (metadata.stored, metadata.file, metadata.digest) == ("int16", "a.zarr", None)
    assert metadata.attributes == {"title": "a store"}
    assert metadata.variable_attributes["_FillValue"] == -9
    assert metadata.variable_attributes["grid_mapping"] == "crs"
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"time", "lat", "lon", "slope", "label", "crs", "lat_bnds"}
    for name, one in found.items():
        wanted = dataset()[name]
        assert one.dimensions == wanted.dims
        assert one.values.dtype == wanted.dtype
        if name != "slope":
            np.testing.assert_array_equal(one.values, wanted.values)
    assert found["slope"].attributes["_FillValue"] == np.float32(-1)
    assert (found["slope"].values == -1).all()
    others = {key: value for key, value in found["lat"].attributes.items() if key != "_FillValue"}
    assert others == {"bounds": "lat_bnds", "levels": [1, 2]}


def test_an_array_without_names_has_no_source(tmp_path: Path) -> None:
    root = zarr.open_group(tmp_path / "a.zarr", mode="w")
    root.create_array("u", data=np.ones((2, 3, 4, 5)))
    with open_series(tmp_path / "a.zarr") as series:
        assert series.metadata is None


DIMS = ["time", "z", "y", "x"]


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", "f2", "u1", ">i2", "i8"])
def test_an_array_of_every_type(tmp_path: Path, zarr_format: int, dtype: str) -> None:
    values = (VALUES * 50).astype(dtype)
    create_zarr(tmp_path / "a.zarr", values, zarr_format=zarr_format, chunks=(2, 3, 2, 4))
    np.testing.assert_array_equal(frames(tmp_path / "a.zarr"), values)
    np.testing.assert_array_equal(frames(zipped(tmp_path / "a.zarr", tmp_path / "a.zip")), values)


def test_shards(tmp_path: Path) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, chunks=(1, 3, 5, 6), shards=(4, 3, 5, 6))
    np.testing.assert_array_equal(frames(tmp_path / "a.zarr"), VALUES)


def test_an_array_of_unequal_chunks_bars_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    for name in ("u", "v"):
        create_zarr(path, VALUES, name=name, chunks=(2, 3, 5, 6))
    document = path / "u" / "zarr.json"
    unequal = {"kind": "inline", "chunk_shapes": [[1, 3], [3], [5], [6]]}
    told = json.loads(document.read_text())
    told["chunk_grid"] = {"name": "rectilinear", "configuration": unequal}
    document.write_text(json.dumps(told))
    with zarr.config.set({"array.rectilinear_chunks": True}):  # newer versions ask for it
        np.testing.assert_array_equal(frames(path, var="v"), VALUES)
        with pytest.raises(InputError, match=r"cannot be opened: .*(?i:chunk.grid)"):
            frames(path, var="u")


@pytest.mark.parametrize("inside", ["", "run.zarr/"])
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_a_zipped_group(tmp_path: Path, inside: str, zarr_format: int) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, name="v", zarr_format=zarr_format)
    np.testing.assert_array_equal(
        frames(zipped(tmp_path / "a.zarr", tmp_path / "a.zarr.zip", inside=inside)), VALUES
    )


def test_groups_and_choices(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="gas/density")
    create_zarr(path, VALUES * 2, name="pressure")
    create_zarr(path, np.ones((3, 4)), name="flat")
    create_zarr(path, np.ones(3), name="line")
    with pytest.raises(
        InputError, match=r"holds 2 variables: gas/density \(4, 3, 5, 6\), pressure .*--var"
    ):
        open_series(path)
    np.testing.assert_array_equal(frames(path, var="pressure"), VALUES * 2)
    np.testing.assert_array_equal(frames(path, var="density"), VALUES)
    np.testing.assert_array_equal(frames(path / "pressure"), VALUES * 2)
    with pytest.raises(InputError, match="no variable 'pressures'; it holds pressure"):
        open_series(path, var="pressures")
    assert frames(path, var="flat").shape == (1, 1, 3, 4)
    with pytest.raises(InputError, match="variable line has 1 dimensions"):
        open_series(path, var="line")


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_dimension_names_give_axes_and_coordinates(tmp_path: Path, zarr_format: int) -> None:
    path = tmp_path / "a.zarr"
    stored = VALUES.transpose(3, 2, 1, 0)
    named = (
        {"dimension_names": DIMS[::-1]}
        if zarr_format == 3
        else {"attributes": {"_ARRAY_DIMENSIONS": DIMS[::-1]}}
    )
    create_zarr(path, stored, name="v", zarr_format=zarr_format, **named)
    times = np.array([2.0, 3.0, 30.0, 347921.1666])
    create_zarr(path, times, name="time", zarr_format=zarr_format, attributes={"units": "hours"})
    create_zarr(path, np.arange(6.0) * 3, name="x", zarr_format=zarr_format)
    with open_series(path) as series:
        assert series.shape == VALUES.shape
        np.testing.assert_array_equal(series.coords["t"].values, times)
        assert series.coords["t"].attributes == {"units": "hours"}
        np.testing.assert_array_equal(series.coords["x"].values, np.arange(6) * 3)
    with open_series(path / "v") as series:
        np.testing.assert_array_equal(series.coords["t"].values, times)
    np.testing.assert_array_equal(frames(path), VALUES)


def test_coordinates_by_cf_and_along_a_dimension_of_another_name(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="v", dimension_names=["a", "b", "c", "d"])
    create_zarr(path, np.arange(6.0), name="d", dimension_names=["d"], attributes={"axis": "T"})
    create_zarr(
        path,
        np.arange(4.0),
        name="a",
        dimension_names=["a"],
        attributes={"standard_name": "longitude"},
    )
    create_zarr(path, np.arange(3.0), name="b", dimension_names=["b"], attributes={"axis": "Y"})
    create_zarr(path, np.arange(5.0) * 100, name="height", dimension_names=["c"])
    with open_series(path) as series:
        assert series.shape == (6, 5, 3, 4)
        np.testing.assert_array_equal(series.coords["z"].values, np.arange(5) * 100)
        np.testing.assert_array_equal(series.read(4), VALUES[..., 4].transpose(2, 1, 0))


ENCODINGS: list[dict[str, Any]] = [
    {},
    {"_FillValue": -99.0},
    {"dtype": "i2", "_FillValue": -99, "scale_factor": 0.01, "add_offset": 1.0},
    {"dtype": "i2", "_FillValue": -99, "scale_factor": 0.01},
    {"dtype": "u1", "_FillValue": 255, "scale_factor": 0.02, "add_offset": -2.0},
    {"dtype": "i4", "_FillValue": -99},
    {"dtype": "i2", "_FillValue": -99},
    {"dtype": "f8", "_FillValue": 1e20},
]


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_what_xarray_writes_is_read_as_xarray_reads_it(
    tmp_path: Path, zarr_format: int, encoding: dict[str, Any]
) -> None:
    import xarray as xr

    values = np.round(np.clip(VALUES, -1.9, 2), 2)
    values[1, 2, 3, 4] = np.nan
    dates = np.array(["2020-01-01T00", "2020-01-01T06", "2020-01-02T00", "2020-02-01T00"], "M8[ns]")
    dataset = xr.Dataset(
        {"q": (DIMS, values, {"units": "kg"})}, coords={"time": dates, "z": [1.5, 2.5, 7.0]}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of consolidated metadata in format 3
        dataset.to_zarr(tmp_path / "a.zarr", zarr_format=zarr_format, encoding={"q": encoding})
        expected = xr.open_zarr(tmp_path / "a.zarr", chunks=None)["q"].to_numpy()
    got = frames(tmp_path / "a.zarr")
    assert got.dtype == expected.dtype
    np.testing.assert_array_equal(got, expected)
    assert np.isnan(got).sum() == 1
    stored = zarr.open_group(tmp_path / "a.zarr", mode="r")["q"]
    np.testing.assert_array_equal(frames(tmp_path / "a.zarr", raw_values=True), stored[...])
    with open_series(tmp_path / "a.zarr") as series:
        assert (series.name, series.units, series.attributes) == ("q", "kg", {"units": "kg"})
        np.testing.assert_array_equal(series.coords["t"].values, [0, 6, 24, 31 * 24])
        assert series.coords["t"].attributes["units"] == "hours since 2020-01-01 00:00:00"
        np.testing.assert_array_equal(series.coords["z"].values, [1.5, 2.5, 7.0])


def test_empty_and_broken_hierarchies(tmp_path: Path) -> None:
    zarr.open_group(tmp_path / "a.zarr", mode="w")
    with pytest.raises(InputError, match="holds no array at all"):
        open_series(tmp_path / "a.zarr")
    (tmp_path / "b.zarr").mkdir()
    with pytest.raises(InputError, match="folder without zarr metadata"):
        open_series(tmp_path / "b.zarr")
    create_zarr(tmp_path / "c.zarr", VALUES)
    (tmp_path / "c.zarr" / "zarr.json").write_text('{"zarr_format": 3, "node_')
    with pytest.raises(InputError, match="cannot be read as zarr") as caught:
        open_series(tmp_path / "c.zarr")
    assert "\n" not in str(caught.value)
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as file:
        file.writestr("notes.txt", "nothing")
    with pytest.raises(InputError, match="a ZIP that holds no zarr hierarchy"):
        open_series(tmp_path / "d.zip")
    zipped(tmp_path / "a.zarr", tmp_path / "e.zip")
    os.truncate(tmp_path / "e.zip", 40)
    with pytest.raises(InputError, match="cannot be read as a ZIP"):
        open_series(tmp_path / "e.zip")


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_neighbours_that_cannot_be_opened_bar_nothing(tmp_path: Path, zarr_format: int) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="v", zarr_format=zarr_format)
    create_zarr(path, VALUES, name="odd", zarr_format=zarr_format)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # text has no specification yet
        zarr.open_group(path, mode="a").create_array("names", shape=(3,), dtype=str)
    (path / "notes.txt").write_text("stray")
    metadata = path / "odd" / ("zarr.json" if zarr_format == 3 else ".zarray")
    content = json.loads(metadata.read_text())
    content |= (
        {"codecs": [{"name": "mycodec"}]} if zarr_format == 3 else {"compressor": {"id": "mycodec"}}
    )
    metadata.write_text(json.dumps(content))
    np.testing.assert_array_equal(frames(path), VALUES)
    with pytest.raises(InputError, match=r"odd has what cannot be opened.*mycodec"):
        open_series(path, var="odd")
    with pytest.raises(InputError, match=r"cannot be read as zarr.*mycodec"):
        open_series(path / "odd")


def test_a_packed_coordinate_is_unpacked_and_says_no_more_of_it(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="v", dimension_names=DIMS)
    packed = {"scale_factor": 0.5, "add_offset": 1.0, "_FillValue": -9, "units": "m"}
    create_zarr(
        path, np.array([0, 2, 4], np.int16), name="z", dimension_names=["z"], attributes=packed
    )
    with open_series(path) as series:
        np.testing.assert_array_equal(series.coords["z"].values, [1, 2, 3])
        assert series.coords["z"].attributes == {"units": "m"}


def test_the_folder_of_an_array_by_a_dot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, name="v", dimension_names=DIMS)
    create_zarr(tmp_path / "a.zarr", np.arange(4.0) * 5, name="time", dimension_names=["time"])
    monkeypatch.chdir(tmp_path / "a.zarr" / "v")
    for path in (".", "../v"):
        with open_series(path) as series:
            assert series.name == "v"
            np.testing.assert_array_equal(series.coords["t"].values, [0, 5, 10, 15])


def test_a_damaged_chunk_names_the_step(tmp_path: Path) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, chunks=(1, 3, 5, 6))
    (tmp_path / "a.zarr" / "c" / "2" / "0" / "0" / "0").write_bytes(b"nonsense")
    with open_series(tmp_path / "a.zarr") as series:
        np.testing.assert_array_equal(series.read(1), VALUES[1])
        with pytest.raises(InputError, match="step 2 of a cannot be read") as caught:
            series.read(2)
        assert "\n" not in str(caught.value)


def test_a_hierarchy_that_changes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="v", chunks=(1, 3, 5, 6))
    with open_series(path) as series:
        series.read(0)
        zarr.open_group(path, mode="a")["v"].resize((9, 3, 5, 6))
        with pytest.raises(InputError, match="changed while it was being read"):
            series.read(1)
    with pytest.warns(FhashWarning, match=r"55\.6 % of the values of 'v' .*\(steps 4 to 8\)"):
        series = open_series(path)
    with series:
        shutil.rmtree(path)
        with pytest.raises(InputError, match="was removed while it was being read"):
            series.read(0)


@pytest.mark.parametrize("change", ["write", "touch", "delete", "add", "gone"])
def test_chunks_that_change_are_noticed_by_the_check_of_the_whole(
    tmp_path: Path, change: str
) -> None:
    path = tmp_path / "a.zarr"
    create_zarr(path, VALUES, name="v", chunks=(1, 3, 5, 6))
    with open_series(path, steps=slice(1, None)) as series:
        series.check()
        series.read(0)
        series.check()
        chunk = path / "v" / "c" / "2" / "0" / "0" / "0"
        if change == "write":
            zarr.open_group(path, mode="a")["v"][2] = VALUES[1]
        elif change == "touch":
            os.utime(chunk, ns=(1, 1))
        elif change == "delete":
            chunk.unlink()
        elif change == "add":
            (chunk.parent / "1").write_bytes(b"x")
        else:
            shutil.rmtree(path)
        with pytest.raises(
            InputError, match=r"(changed|was removed) while it was being read"
        ) as caught:
            series.check()
        assert "\n" not in str(caught.value)


def test_stale_consolidated_metadata_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    array = create_zarr(path, VALUES, name="v", zarr_format=2, chunks=(1, 3, 5, 6))
    zarr.consolidate_metadata(path)
    array.resize((5, 3, 5, 6))
    array[4] = 7
    got = frames(path)
    assert got.shape == (5, 3, 5, 6)
    assert (got[4] == 7).all()


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_an_array_of_zarrs_own_is_read_as_xarray_reads_it(tmp_path: Path, zarr_format: int) -> None:
    # a fill value of zarr's own marks missing values for xarray in format 2, not in format 3
    values = np.rint(VALUES * 10).astype("i2")
    names = ["time", "lev", "lat", "lon"]
    rest: dict[str, Any] = (
        {"attributes": {"_ARRAY_DIMENSIONS": names}}
        if zarr_format == 2
        else {"dimension_names": names}
    )
    path = tmp_path / "a.zarr"
    create_zarr(path, values, name="v", zarr_format=zarr_format, fill_value=3, **rest)
    with xr.open_zarr(path, consolidated=False, chunks=None) as opened:
        expected = opened["v"].to_numpy()
    assert np.isnan(expected).any() == (zarr_format == 2)
    np.testing.assert_array_equal(frames(path), expected)


def test_units_never_stand_beside_packed_counts(tmp_path: Path) -> None:
    attributes = {"scale_factor": 0.5, "units": "K", "long_name": "warmth"}
    create_zarr(tmp_path / "a.zarr", np.ones((3, 4, 5), "i2"), attributes=attributes)
    with open_series(tmp_path / "a.zarr") as series:
        assert (series.units, series.dtype) == ("K", np.float64)
    with open_series(tmp_path / "a.zarr", raw_values=True) as series:
        assert (series.units, series.attributes) == ("", {"long_name": "warmth"})


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_groups_of_steps_and_members_are_read(tmp_path: Path, zarr_format: int) -> None:
    path = tmp_path / "a.zarr"
    root = zarr.open_group(path, mode="w", zarr_format=zarr_format)
    for step in range(4):
        group = root.create_group(f"data/{10 * step}")
        group.attrs["time"] = 0.5 * step
        array = group.create_array("rho", shape=(2, *VALUES.shape[1:]), dtype="f4")
        array[...] = np.stack([VALUES[step], VALUES[step] * 2])
    (entry,) = list_variables(path)
    assert entry.name == "data/*/rho"
    assert entry.options == (("--select", "dim1=0"),)
    for source in (path, zipped(path, tmp_path / "b.zip")):
        assert_frames(source, VALUES * 2, select={"dim1": 1})
        with open_series(source, select={"dim1": 0}) as series:
            assert series.coords["t"].values.tolist() == [0, 0.5, 1, 1.5]
    with open_series(path, select={"dim1": 0}) as series:
        series.read(0)
        root["data/20/rho"][0, 0] = 7
        with pytest.raises(InputError, match="changed while it was being read"):
            series.check()


@pytest.mark.filterwarnings("ignore::zarr.errors.UnstableSpecificationWarning")
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_fields_of_structured_arrays(tmp_path: Path, zarr_format: int) -> None:
    state = np.zeros((4, 5, 6), [("rho", "f4"), ("n", "i2")])
    state["rho"], state["n"] = np.arange(120).reshape(4, 5, 6), 7
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=zarr_format)
    group.create_array("state", shape=state.shape, dtype=state.dtype)[...] = state
    assert_frames(tmp_path / "a.zarr", state["rho"][None], var="state.rho")
    assert_frames(tmp_path / "a.zarr", state["n"][None], var="state.n")
    with pytest.raises(InputError, match=r"holds 2 variables: state\.rho .*state\.n"):
        open_series(tmp_path / "a.zarr")


def test_members_are_selected_by_label(tmp_path: Path) -> None:
    dims = ("member", "time", "lev", "lat", "lon")
    dataset = xr.Dataset(
        {"v": (dims, np.stack([VALUES, VALUES * 2]))}, coords={"lev": [1000.0, 850.0, 500.0]}
    )
    path = tmp_path / "a.zarr"
    dataset.to_zarr(path, zarr_format=3, consolidated=False)
    create_zarr(path, np.array([3, 7]), name="member", dimension_names=["member"])
    with pytest.raises(InputError, match=r"--select member=0 \(member has 2\)"):
        open_series(path)
    assert_frames(path, VALUES * 2, select={"member": "7.0"})
    with pytest.raises(InputError, match=r"outside the indices 0..1; member=7.0 is the position"):
        open_series(path, select={"member": 7})
    with pytest.raises(InputError, match=r"outside the indices 0..1$"):
        open_series(path, select={"member": 8})
    with open_series(path, select={"member": 1, "lev": "850."}) as series:
        assert series.coords["z"].values.tolist() == [850]
        np.testing.assert_array_equal(series.read(2)[0], VALUES[2, 1] * 2)


def test_arrays_beside_one_whose_dimensions_have_no_names_are_kept(tmp_path: Path) -> None:
    group = zarr.open_group(tmp_path / "run.zarr", mode="w")
    group.create_array("rho", data=np.ones((5, 8, 10, 12), "f4"))
    group.create_array("time", data=np.arange(1.0, 6.0))
    with open_series(tmp_path / "run.zarr", var="rho") as series:
        assert series.metadata is None
    group.create_array("gamma", data=np.array(1.4))
    group.create_array("edges", data=np.arange(1.0, 14.0))
    group.create_array("large", data=np.ones(9000))
    with (
        open_series(tmp_path / "run.zarr", var="rho") as series,
        pytest.warns(FhashWarning, match="beside rho is kept: large"),
    ):
        metadata = series.metadata
    assert metadata is not None
    found = {each.name: each.dimensions for each in metadata.variables}
    assert found == {"time": ("time",), "gamma": (), "edges": ("edges_dim_0",)}
    assert list(metadata.dimensions) == ["time", "z", "y", "x"]


CODEC = TransformCodec(max_error=0.01)
DIMENSIONS = ("time", "level", "lat", "lon")
SHAPE = (5, 6, 9, 10)


def field(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
    grid = np.meshgrid(*(np.linspace(0, 3, n) for n in shape), indexing="ij")
    return (20 * np.sin(sum((i + 1) * x for i, x in enumerate(grid)))).astype(dtype)


def write(
    folder: Path,
    values: npt.NDArray[Any],
    chunks: tuple[int, ...],
    dimensions: tuple[str, ...] = DIMENSIONS,
    **options: Any,
) -> Path:
    """A store of one variable "u"."""
    path = folder / "run.zarr"
    group = zarr.open_group(path, mode="w")
    usual: dict[str, Any] = {"serializer": CODEC, "compressors": None, "fill_value": np.nan}
    if values.dtype.kind != "f":
        usual["fill_value"] = 0
    array = group.create_array(
        "u",
        shape=values.shape,
        chunks=chunks,
        dtype=values.dtype,
        dimension_names=list(dimensions),
        **{**usual, **options},
    )
    array[...] = values
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compressors": [Crc32cCodec()]},
        {"compressors": [GzipCodec(), Crc32cCodec()]},
        {"shards": (4, 6, 8, 8)},
        {"shards": (4, 6, 8, 8), "compressors": [GzipCodec()]},
        {"shards": {"shape": (4, 6, 8, 8), "index_location": "start"}},
        {"filters": [TransposeCodec(order=(0, 2, 1, 3))]},
    ],
    ids=str,
)
def test_streams_decode_to_what_zarr_reads(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), **options)
    with open_coded(path, Request()) as (series, array):
        assert (series.shape, array.tile, array.grid) == (SHAPE, (2, 3, 4, 4), (3, 2, 3, 3))
        assert array.quality == {"max_error": 0.01}
        for index in ((0, 0, 0, 0), (1, 1, 2, 0), (2, 1, 2, 2)):
            stream = array.stream(index)
            assert stream is not None
            if "filters" not in options:
                inside = tuple(slice(0, n) for n in array.values(index).shape)
                decoded = decode_chunk(stream, array.tile, np.float32)[inside]
                assert np.array_equal(decoded, array.values(index))


@pytest.mark.parametrize(
    ("dimensions", "chunks", "axes"),
    [
        (("time", "level", "lat", "lon"), (2, 3, 4, 4), None),
        (("time", "lat", "lon"), (1, 4, 4), None),
        (("time", "lat", "lon"), (2, 4, 4), ["z", "t", "y", "x"]),
        (("lon", "lat", "time"), (4, 4, 2), ["x", "t", "y", "z"]),
        (("time", "lat", "lon", "level"), (2, 4, 4, 3), ["t", "x", "z", "y"]),
        (("member", "time", "level", "lat", "lon"), (1, 2, 3, 4, 4), None),
    ],
)
def test_axes_of_tiles_follow_from_the_dimensions(
    tmp_path: Path, dimensions: tuple[str, ...], chunks: tuple[int, ...], axes: list[str] | None
) -> None:
    lengths = dict(zip(DIMENSIONS, SHAPE, strict=True)) | {"member": 3}
    values = field(tuple(lengths[name] for name in dimensions))
    path = write(tmp_path, values, chunks, dimensions)
    select = (("member", "2"),) if "member" in dimensions else ()
    with open_coded(path, Request(select=select)) as (series, array):
        assert array.configuration.get("axes") == axes
        assert array.shape == series.shape
        part = array.values((0, 0, 0, 0))
        assert np.array_equal(part[0], series.read(0)[tuple(slice(0, n) for n in part.shape[1:])])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"serializer": "auto", "compressors": "auto"}, "coded by bytes, zstd, not by fhash"),
        ({"attributes": {"scale_factor": 0.5}}, "is packed"),
        ({"attributes": {"add_offset": 3.0}}, "is packed"),
    ],
)
def test_other_arrays_are_refused_with_the_command_that_takes_them(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), **options)
    with (
        pytest.raises(InputError, match=f"{message}.*fhash encode .* --var u"),
        open_coded(path, Request()),
    ):
        pass


def test_a_selection_within_a_chunk_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, field((3, 4, 9, 10)), (3, 2, 4, 4), ("member", *DIMENSIONS[::2], "lon"))
    with (
        pytest.raises(InputError, match="chunks of 3 along member"),
        open_coded(path, Request(select=(("member", "0"),))),
    ):
        pass


def test_axes_that_the_codec_took_as_one_are_refused(tmp_path: Path) -> None:
    dimensions = ("time", "a", "level", "lat", "lon")
    path = write(tmp_path, field((4, 1, 3, 5, 6)), (2, 2, 3, 5, 6), dimensions)
    with pytest.raises(InputError, match="chunks of 2 along a"), open_coded(path, Request()):
        pass


def test_format_2_is_refused(tmp_path: Path) -> None:
    array = zarr.create_array(
        tmp_path / "a.zarr", shape=SHAPE, chunks=(2, 3, 4, 4), dtype="f4", zarr_format=2
    )
    array[...] = 1
    with (
        pytest.raises(InputError, match="Zarr format 2"),
        open_coded(tmp_path / "a.zarr", Request()),
    ):
        pass
    assert coded_names(tmp_path / "a.zarr")[1] == {"a": False}


def test_chunks_that_the_store_lacks_are_none(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4))
    (path / "u" / "c" / "0" / "1" / "2" / "0").unlink()
    with open_coded(path, Request()) as (_, array):
        assert array.stream((0, 1, 2, 0)) is None
        assert np.isnan(array.fill)
    values = field(SHAPE)
    values[:2] = np.nan
    path = write(tmp_path, values, (2, 3, 4, 4), shards=(4, 6, 8, 8))
    with open_coded(path, Request()) as (_, array):
        assert array.stream((0, 0, 0, 0)) is None
        assert array.stream((1, 0, 0, 0)) is not None


def test_damage_is_told_by_the_checksum(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), compressors=[Crc32cCodec()])
    file = path / "u" / "c" / "0" / "1" / "2" / "0"
    data = bytearray(file.read_bytes())
    data[20] ^= 1
    file.write_bytes(data)
    with open_coded(path, Request()) as (_, array):
        with pytest.raises(DamagedFileError, match=r"\(0, 1, 2, 0\) of u is damaged"):
            array.stream((0, 1, 2, 0))
        assert array.stream((0, 0, 0, 0)) is not None


def test_a_damaged_index_of_a_shard_is_told(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), shards=(4, 6, 8, 8))
    file = path / "u" / "c" / "0" / "0" / "0" / "0"
    data = bytearray(file.read_bytes())
    data[-9] ^= 1
    file.write_bytes(data)
    with (
        open_coded(path, Request()) as (_, array),
        pytest.raises(DamagedFileError, match="index of shard"),
    ):
        array.stream((0, 0, 0, 0))


def test_names_say_what_is_coded(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4))
    group = zarr.open_group(path)
    group.create_array("v", data=field(SHAPE))
    assert coded_names(path) == (path, {"u": True, "v": False})
    assert coded_names(path / "u") == (path, {"u": True})
