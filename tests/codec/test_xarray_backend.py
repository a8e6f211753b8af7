"""Containers as xarray shows them: the values, names and attributes of their source."""

from __future__ import annotations

import io
import pickle
import tomllib
import warnings
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from cf_files import KINDS, Kind, smooth
from rarely import rarely
from xarray.core import indexing

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.xarray_backend import FhashArray, FhashBackend, Form, SideBySide
from fhash_formats.errors import FhashWarning, InputError, UnsupportedFileError
from fhash_formats.readers.labelled import labelled_series
from fhash_formats.readers.registry import open_series
from fhash_formats.series import ArraySeries, Coordinate, SourceMetadata, SourceVariable

SHAPE = (5, 4, 12, 10)


VALUES = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5) + 1
NAMES = {
    "zeta ": "zeta",
    " ": "unnamed",
    "": "unnamed",
    "/": "unnamed",
    "a/b": "a_b",
    "..": "unnamed",
    "a\nb": "a_b",
    "a\0b": "a_b",
    "__x": "_x",
    "zarr.json": "zarr_json",
    ".zarray": "_zarray",
    "y" * 300: "y" * 240,
    "\u03be": "\u03be",
    "tables": "tables",
    "a b": "a b",
    "\ud800": "?",
}
CONFIG = EncodeConfig(max_error=0.01, effort=1)


def zarr_2(folder: Path, names: list[str]) -> Path:
    group = zarr.open_group(folder / "a.zarr", mode="w", zarr_format=2)
    made = group.create_array("u", shape=VALUES.shape, dtype="f4", chunks=VALUES.shape)
    made[...] = VALUES
    made.attrs["_ARRAY_DIMENSIONS"] = names
    return folder / "a.zarr"


def labelled(folder: Path, names: list[str]) -> xr.Dataset:
    return xr.Dataset({"u": (names, VALUES)}, {names[1]: [3.0, 5.0, 7.0]})


@pytest.mark.parametrize(("name", "plain"), NAMES.items(), ids=map(ascii, NAMES))
@pytest.mark.parametrize("make", [zarr_2, labelled])
def test_a_dimension_of_any_name_comes_back(
    tmp_path: Path, make: Any, name: str, plain: str
) -> None:
    names = ["time", name, "lat", "lon"]
    path = tmp_path / "a.fhz"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fhash_codec.encode(make(tmp_path, names), path, CONFIG)
    told = [str(each.message) for each in caught if each.category is FhashWarning]
    assert any("were changed" in text for text in told) == (plain != name)
    with xr.open_dataset(path, engine="fhash") as dataset:
        assert dataset["u"].dims == ("time", plain, "lat", "lon")
        np.testing.assert_allclose(dataset["u"], VALUES, atol=0.01)
        if make is labelled:
            assert dataset[plain].values.tolist() == [3, 5, 7]


DIMENSIONS = {"lon": "x", "one": "", "time": "t", "lat": "y"}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A container of one level, and its values as (x, 1, t, y)."""
    path = tmp_path_factory.mktemp("lazy") / "run.fhz"
    config = EncodeConfig(effort=1, psnr=30, without=("ssim",), tile="2x1x4x4")
    fhash_codec.encode(smooth(4, 1, 9, 7), path, config)
    with fhash_codec.open(path) as volume:
        return path, volume[:, 0].transpose(2, 0, 1)[:, None]


def array(path: Path, **form: Any) -> FhashArray:
    options = {"dimensions": DIMENSIONS, "lod": None, "outside": "nan", **form}
    return FhashArray(str(path), "values", Form(**options), None)


@pytest.mark.parametrize(
    "key",
    [
        (slice(None),) * 4,
        (3, 0, -1, 2),
        (slice(6, 1, -2), 0, slice(1, 3), slice(None)),
        (slice(2, 5), slice(None), 1, slice(8, None)),
        (slice(0, 0), slice(0, 0), 0, slice(None)),
        (5, slice(None, None, -1), slice(3, None, -3), 0),
    ],
)
def test_keys_are_those_of_numpy(run, key: tuple[Any, ...]) -> None:
    path, whole = run
    lazy = array(path)
    assert (lazy.shape, lazy.dtype) == (whole.shape, whole.dtype)
    np.testing.assert_array_equal(lazy[indexing.BasicIndexer(key)], whole[key])


def test_arrays_of_indices_are_taken(run) -> None:
    path, whole = run
    variable = xr.Variable(tuple(DIMENSIONS), indexing.LazilyIndexedArray(array(path)))
    found = variable[[6, 0, 3], 0, :, [1, 1]].values
    np.testing.assert_array_equal(found, whole[[6, 0, 3], 0][:, :, [1, 1]])


def test_chunks_are_the_tiles_of_the_dimensions(run) -> None:
    path, _ = run
    with fhash_codec.open(path) as volume:
        form = Form(dimensions=DIMENSIONS, lod=None, outside="nan")
        t, _, y, x = volume.chunks
        assert form.chunks(volume) == {"lon": x, "one": 1, "time": t, "lat": y}
        coarse = Form(dimensions=DIMENSIONS, lod=1, outside="nan")
        assert coarse.sizes(volume) == {"lon": 4, "one": 1, "time": 4, "lat": 5}
        assert coarse.chunks(volume)["lon"] == x // 2


BOUND = EncodeConfig(max_error=0.01, effort=1, timings=False)
FLAT = (3, 1, 5, 6)


def noise(seed: int, shape: tuple[int, ...] = FLAT) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def opened(sources: dict[str, Any], path: Path) -> xr.Dataset:
    fhash_codec.encode_dataset(sources, path, BOUND)
    return xr.open_dataset(path, engine="fhash")


def along(**sizes: int) -> xr.Variable:
    return xr.Variable(tuple(sizes), np.zeros(tuple(sizes.values())))


def test_variables_of_one_name_in_their_sources_are_all_there(tmp_path: Path) -> None:
    sources = {f"{group}/u": ArraySeries(noise(n), name="u") for n, group in enumerate("gh")}
    with opened(sources, tmp_path / "a.fhz") as dataset:
        for number, name in enumerate(sources):
            np.testing.assert_allclose(dataset[name], noise(number), atol=0.01)


def test_a_staggered_grid_has_positions_of_its_own(tmp_path: Path) -> None:
    half = {"x": Coordinate(name="x", values=np.arange(6) + 0.5)}
    sources = {
        "u": ArraySeries(noise(0), name="u"),
        "v": ArraySeries(noise(1), name="v", coords=half),
        "w": ArraySeries(noise(2, (3, 1, 5, 7)), name="w"),
        "p": ArraySeries(noise(3), name="p", coords=half),
    }
    with opened(sources, tmp_path / "a.fhz") as dataset:
        dimensions = {name: dataset[name].dims[-1] for name in sources}
        assert dimensions == {"u": "x", "v": "x_2", "w": "x_3", "p": "x_2"}
        assert dataset["v"].dims[:3] == dataset["u"].dims[:3]
        assert dataset["x_2"].values.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]
        assert dataset.sizes["x_3"] == 7


def test_the_values_of_a_variable_are_not_there_again_beside_another() -> None:
    joined = SideBySide({"u": ("t", "x"), "mask": ("t", "x"), "height": ("t", "x")})
    found = joined.add("u", along(t=2, x=3), {"mask": along(x=3, t=2), "height": along()})
    assert found == {"mask": "mask", "height": "height_2"}
    assert set(joined.variables) == {"u", "height_2"}


def test_a_dimension_without_positions_is_shared() -> None:
    joined = SideBySide({"u": "x", "v": "x", "w": "x"})
    joined.add("u", along(x=3), {})
    joined.add("v", along(x=3), {"x": along(x=3)})
    joined.add("w", along(x=3), {"x": along(x=3) + 1})
    assert joined.variables["v"].dims == ("x",)
    assert joined.variables["w"].dims == ("x_2",)


def vector_file(path: Path, kind: str) -> dict[str, np.ndarray]:
    """A vector whose components have the names of the axes; their values."""
    arrays = {name: noise(number, (2, 4, 5, 6)) for number, name in enumerate("xyz")}
    with h5py.File(path, "w") as file:
        for step, (name, array) in product((0, 1), arrays.items()):
            place = f"data/{step}/meshes/B/{name}" if kind == "openpmd" else f"velocity/{name}"
            if kind == "openpmd":
                file.require_group(f"data/{step}").attrs["time"] = float(step)
                file.require_group(f"data/{step}/meshes/B").attrs["axisLabels"] = list("xyz")
                file[place] = array[step]
            elif not step:
                file[place] = array
    return arrays


@pytest.mark.parametrize("kind", ["openpmd", "groups", "arrays"])
def test_components_called_as_axes_share_one_grid(tmp_path: Path, kind: str) -> None:
    source, path = tmp_path / "run.h5", tmp_path / "run.fhz"
    arrays = vector_file(source, kind)
    word = {"openpmd": "B", "groups": "velocity", "arrays": "values"}[kind]
    fhash_codec.encode_dataset(arrays if kind == "arrays" else source, path, BOUND)
    with xr.open_dataset(path, engine="fhash") as found:
        assert set(found.data_vars) == {f"{word}_{name}" for name in "xyz"}
        assert sum(each**2 for each in found.data_vars.values()).dims == ("time", "z", "y", "x")
        assert found.sizes.keys() == {"time", "z", "y", "x"}
    with fhash_codec.open(path) as dataset:
        assert dataset["y"].name == f"{word}_y"
        assert "y" in dataset
        assert "w" not in dataset
        with pytest.raises(KeyError, match="no variable 'w'"):
            dataset["w"]
    with fhash_codec.open(path, variable="z") as volume:
        assert volume.name == f"{word}_z"


def test_a_last_part_of_several_names_is_refused(tmp_path: Path) -> None:
    arrays = {name: noise(0, (2, 4, 4, 4)) for name in ("E/x", "B/x", "B/rho")}
    fhash_codec.encode_dataset(arrays, tmp_path / "run.fhz", BOUND)
    with fhash_codec.open(tmp_path / "run.fhz") as dataset:
        assert [dataset[name].name for name in ("E/x", "B_x", "rho")] == ["E_x", "B_x", "B/rho"]
        with pytest.raises(KeyError, match="2 variables named 'x'"):
            dataset["x"]
    with pytest.raises(InputError, match="2 variables named 'x'"):
        fhash_codec.open(tmp_path / "run.fhz", variable="x")


QUICK = EncodeConfig(effort=1, psnr=45, without=("ssim",), timings=False)
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module", params=KINDS)
def made(request, tmp_path_factory) -> tuple[Kind, Path, Path]:
    """A kind of file, the file, and the container of its variable."""
    kind, folder = KINDS[request.param](), tmp_path_factory.mktemp(request.param)
    source = kind.write(folder / "source.nc")
    # A packing is handed on where rounding to its counts keeps the error: here within ten of them.
    config = replace(QUICK, psnr=None, max_error=0.1) if request.param == "packed" else QUICK
    with open_series(source, var=kind.variable, select=kind.select) as series:
        fhash_codec.encode(series, folder / "run.fhz", config)
    return kind, source, folder / "run.fhz"


@pytest.fixture(scope="module")
def plain_run(tmp_path_factory) -> Path:
    """The container of a feature of an array, of several tiles; x is cut by the feature."""
    path = tmp_path_factory.mktemp("plain") / "run.fhz"
    values = smooth(5, 12, 20, 24).astype(np.float32)
    mask = np.zeros(values.shape[1:], dtype=bool)
    mask[2:11, 3:19, 1:20] = True
    fhash_codec.encode(values, path, EncodeConfig(effort=1, tile="2x6x8x8"), mask=mask)
    return path


def opened_alone(path: Path, **options: Any) -> xr.Dataset:
    return xr.open_dataset(path, engine=FhashBackend, **options)


def without_own(dataset: xr.Dataset) -> xr.Dataset:
    """A copy without the attributes that are the container's own."""
    copy = dataset.copy()
    for place in (copy, *copy.data_vars.values()):
        for key in list(place.attrs):
            # the names of coordinates of no variable are not kept as such, but the coordinates are
            own = key.startswith("fhash_") or key in ("history", "selection")
            if own or (key == "coordinates" and place is copy):
                del place.attrs[key]
    return copy


@pytest.mark.parametrize("coords", [True, "all", False])
def test_a_container_opens_as_its_source_does(made, coords: bool | str) -> None:
    kind, source, container = made
    name = kind.variable
    with (
        xr.open_dataset(source, decode_coords=coords) as whole,
        opened_alone(container, decode_coords=coords) as stored,
    ):
        wanted, found = whole.isel(kind.select), stored
        if not coords:
            wanted = wanted.reset_coords(list(kind.select))
        error = np.abs(wanted[name].values - found[name].values)
        assert np.nanmax(error) <= stored[name].attrs["fhash_max_error"] * (1 + 1e-6)
        np.testing.assert_array_equal(np.isnan(wanted[name]), np.isnan(found[name]))
        exact = stored[name].attrs["fhash_max_error"] == 0
        assert exact or stored[name].attrs["fhash_psnr"] >= 45
        same = found.assign({name: found[name].copy(data=wanted[name].values)})
        xr.testing.assert_identical(without_own(wanted), without_own(same))
        for each in wanted.variables:
            # xarray makes one text of an array of one object
            if same[each].dtype != object:
                assert wanted[each].dtype == same[each].dtype
        packing = ("scale_factor", "add_offset", "_FillValue")
        for key in packing:
            assert found[name].encoding.get(key) == pytest.approx(
                whole[name].encoding.get(key), nan_ok=True
            )


def test_values_are_read_when_they_are_asked_for(plain_run, monkeypatch) -> None:
    read = []
    original = fhash_codec.Volume.values_of_steps
    monkeypatch.setattr(
        fhash_codec.Volume,
        "values_of_steps",
        lambda self, steps, *args, **kw: (
            read.extend(steps),
            original(self, steps, *args, **kw),
        )[1],
    )
    with opened_alone(plain_run) as stored:
        part = stored["values"].isel(time=slice(3, None, -2), z=4)
        assert read == []
        assert part.shape == (2, 20, 24)
        part.load()
    assert sorted(read) == [1, 3]


@pytest.mark.parametrize(
    "key",
    [
        (slice(None, None, -1), 3, slice(18, 2, -3), slice(0, 0)),
        (np.array([4, 0, 0]), slice(1, 9), np.array([-1, 5]), 7),
        (2, slice(None), slice(4, None, 5), np.array([True, False] * 12)),
        (-1, -2, -3, -4),
    ],
)
def test_indices_are_those_of_numpy(plain_run, key: tuple[Any, ...]) -> None:
    with (
        fhash_codec.open(plain_run) as volume,
        opened_alone(plain_run) as stored,
    ):
        whole = xr.Variable(volume.dims, volume[...])
        np.testing.assert_array_equal(stored["values"][key].values, whole[key].values)


@pytest.mark.parametrize("scheduler", ["synchronous", "threads", *rarely("processes")])
def test_dask_reads_tiles_with_the_same_bits(plain_run, scheduler: str) -> None:
    with fhash_codec.open(plain_run) as volume:
        whole = volume[...]
        tile = volume.chunks
    with opened_alone(plain_run, chunks={}) as stored:
        lazy = stored["values"]
        assert tuple(along[0] for along in lazy.chunks) == tile
        workers = 1 if scheduler == "processes" else 2  # each takes seconds to begin
        found = lazy.compute(scheduler=scheduler, num_workers=workers).values
        assert found.tobytes() == whole.tobytes()


def test_another_file_of_the_same_name_is_refused(plain_run, tmp_path) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(plain_run.read_bytes())
    with opened_alone(path) as stored:
        data = pickle.dumps(stored)
    path.unlink()
    fhash_codec.encode(smooth(5, 12, 20, 24), path, QUICK)
    with pytest.raises(InputError, match="another file"):
        pickle.loads(data)["values"].values  # noqa: B018 - reads them


def test_levels_of_detail_have_every_other_vertex(plain_run) -> None:
    with (
        fhash_codec.open(plain_run) as volume,
        opened_alone(plain_run, lod=1) as stored,
    ):
        z, y, x = volume.lod_vertices(1)
        assert stored["values"].shape == (5, len(z), len(y), len(x))
        np.testing.assert_array_equal(stored["x"], list(x))
        np.testing.assert_array_equal(stored["values"][3], volume.read_lod(3, 1))
        assert "fhash_max_error" not in stored["values"].attrs
        part = stored["values"][3, 1:4, ::-2, 5].values
        np.testing.assert_array_equal(part, volume.read_lod(3, 1)[1:4, ::-2, 5])


@pytest.mark.parametrize(
    "options", [{"outside": "zero"}, {"lod": 1, "outside": "background"}, {"variable": "u"}]
)
def test_other_options_are_refused(plain_run, options: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        opened_alone(plain_run, **options)


def test_a_container_is_known_by_its_end(plain_run, tmp_path) -> None:
    (tmp_path / "run").write_bytes(plain_run.read_bytes())
    (tmp_path / "other").write_bytes(b"nothing")
    backend = FhashBackend()
    assert backend.guess_can_open("s3://bucket/run.fhz")
    assert backend.guess_can_open(tmp_path / "run")
    assert not backend.guess_can_open(tmp_path / "other")
    assert not backend.guess_can_open(b"nothing")


def test_the_entry_point_is_the_engine() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, name = project["entry-points"]["xarray.backends"]["fhash"].partition(":")
    assert getattr(import_module(module), name) is FhashBackend


def test_a_dataset_is_encoded_by_its_accessor(tmp_path) -> None:
    kind = KINDS["rotated"]()
    source = xr.decode_cf(kind.dataset, decode_coords="all")
    source.fhash.encode(tmp_path / "run.fhz", effort=1, psnr=45.0)
    with opened_alone(tmp_path / "run.fhz", decode_coords="all") as stored:
        same = stored.assign(tas=stored["tas"].copy(data=source["tas"].values))
        xr.testing.assert_identical(without_own(source), without_own(same))
    with pytest.raises(InputError, match="unknown setting"):
        source["tas"].fhash.encode(tmp_path / "other.fhz", psnrr=45)
    source["tas"].fhash.encode(tmp_path / "other.fhz", config=QUICK)
    with pytest.raises(InputError, match="not both"):
        source["tas"].fhash.encode(tmp_path / "more.fhz", config=QUICK, psnr=40)


def test_several_variables_of_a_file_open_as_their_source_does(tmp_path) -> None:
    kind = KINDS["rotated"]()
    data = kind.dataset
    data["pr"] = 2 * data["tas"] + 1
    data["pr"].attrs = {"units": "mm", "grid_mapping": "rotated_pole"}
    encoding = kind.encoding | {"pr": {"_FillValue": None}}
    data.to_netcdf(tmp_path / "two.nc", engine="h5netcdf", encoding=encoding)
    fhash_codec.encode_dataset(tmp_path / "two.nc", tmp_path / "run.fhz", QUICK)
    with (
        xr.open_dataset(tmp_path / "two.nc") as whole,
        opened_alone(tmp_path / "run.fhz") as found,
    ):
        same = found
        for name in ("tas", "pr"):
            error = np.abs(whole[name].values - found[name].values).max()
            assert 0 < error <= found[name].attrs["fhash_max_error"] * (1 + 1e-6)
            same = same.assign({name: found[name].copy(data=whole[name].values)})
        xr.testing.assert_identical(without_own(whole), without_own(same))


def packed_part(number: int, **encoding: Any) -> xr.Dataset:
    """Two steps of counts of 16 bits whose scale and offset fit these steps alone."""
    values = smooth(2, 4, 5, 6) + 40 * number
    step, middle = (values.max() - values.min()) / 65000, (values.max() + values.min()) / 2
    days = ("time", 2.0 * number + np.arange(2), {"units": "days since 2000-01-01"})
    data = xr.Dataset(
        {"t2m": (("time", "z", "y", "x"), values, {"units": "K", "valid_min": np.int16(-32600)})},
        {"time": days},
    )
    packing = {"dtype": "int16", "scale_factor": step, "add_offset": middle, "_FillValue": -32767}
    data["t2m"].encoding = {**packing, **encoding}
    return data


def test_variables_that_no_dataset_holds_are_refused(tmp_path: Path) -> None:
    series = ArraySeries(smooth(2, 4, 5, 6))
    scalar = SourceVariable(name="time", dimensions=(), values=np.array(3.0))
    axes = {"time": "t", "z": "z", "y": "y", "x": "x"}
    series.metadata = SourceMetadata(dimensions=axes, variables=(scalar,))
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0.01))
    with pytest.raises(UnsupportedFileError, match="'time' already exists as a scalar variable"):
        xr.open_dataset(tmp_path / "a.fhz", engine="fhash")


def test_a_missing_value_that_is_a_text_is_no_packing(tmp_path: Path) -> None:
    values = smooth(2, 4, 5, 6)
    labelled = xr.DataArray(values, dims=tuple("tzyx"), name="u", attrs={"missing_value": "none"})
    fhash_codec.encode(labelled, tmp_path / "a.fhz", EncodeConfig(max_error=0.01))
    with xr.open_dataset(tmp_path / "a.fhz", engine="fhash") as found:
        assert np.abs(found["u"].values - values).max() <= 0.01


@pytest.mark.parametrize("way", ["files", "labelled", "fill"])
def test_a_packing_that_the_values_do_not_fit_is_not_handed_on(tmp_path, way: str) -> None:
    # a fill value between the values: one that is coded as it would be missing later
    parts = [packed_part(0, **({"_FillValue": 5} if way == "fill" else {}))]
    parts += [] if way == "fill" else [packed_part(1)]
    for number, part in enumerate(parts):
        part.to_netcdf(tmp_path / f"part_{number}.nc", engine="h5netcdf")
    source: Any = str(tmp_path / "part_*.nc")
    read = [xr.load_dataset(path) for path in sorted(tmp_path.glob("part_*.nc"))]
    whole = xr.concat(read, "time", data_vars="all")
    if way == "labelled":
        source = whole.copy()
        source["t2m"].encoding = read[0]["t2m"].encoding
        fhash_codec.encode(source, tmp_path / "run.fhz", QUICK)
    elif way == "files":
        with pytest.warns(
            FhashWarning, match=r"add_offset \(differs .*, scale_factor \(of a packing"
        ):
            fhash_codec.encode(source, tmp_path / "run.fhz", QUICK)
    else:
        fhash_codec.encode(source, tmp_path / "run.fhz", QUICK)
    with opened_alone(tmp_path / "run.fhz") as stored:
        error = stored["t2m"].attrs["fhash_max_error"]
        assert "valid_min" not in stored["t2m"].attrs
        stored.to_netcdf(tmp_path / "again.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "again.nc") as again:
        np.testing.assert_allclose(again["t2m"].values, whole["t2m"].values, atol=error)


@pytest.mark.parametrize("kind", [name for name in KINDS if name != "ensemble"])
@pytest.mark.parametrize("form", ["nc", *rarely("zarr")])
def test_a_file_and_its_dataset_give_the_same_bytes(tmp_path, kind: str, form: str) -> None:
    made = KINDS[kind]()
    source = made.write(tmp_path / "source.nc")
    read = partial(xr.open_dataset, source)
    if form == "zarr":
        with read(decode_times=False) as data:
            source = tmp_path / "source.zarr"
            data.to_zarr(source, consolidated=False)
        read = partial(xr.open_zarr, source, consolidated=False)
    with open_series(source, var=made.variable) as series:
        fhash_codec.encode(series, tmp_path / "path.fhz", QUICK)
    numbers = {"decode_times": False}
    for name, options in (
        ("plain", numbers),
        ("all", {"decode_coords": "all"}),
        ("dates", {}),
    ):
        with read(**options) as data:
            series = labelled_series(data, made.variable)
            fhash_codec.encode(series, tmp_path / f"{name}.fhz", QUICK)
        same = (tmp_path / f"{name}.fhz").read_bytes() == (tmp_path / "path.fhz").read_bytes()
        assert same, name


def test_a_file_and_its_dataset_of_two_variables_give_the_same_bytes(tmp_path) -> None:
    times = ("time", [0.0, 1.0], {"units": "s", "bounds": "time_bnds"})
    made = xr.Dataset(
        {
            "u": (("time", "y", "x"), np.random.default_rng(0).normal(size=(2, 8, 9))),
            "v": (("time", "y", "x"), np.random.default_rng(1).normal(size=(2, 8, 9))),
            "time_bnds": (("time", "ends"), [[0.0, 1.0], [1.0, 2.0]]),
            "area": (("y", "x"), np.ones((8, 9)), {"units": "m2"}),
        },
        coords={"time": times},
        attrs={"title": "two"},
    )
    made.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    fhash_codec.encode_dataset(tmp_path / "a.nc", tmp_path / "path.fhz", QUICK)
    with xr.open_dataset(tmp_path / "a.nc", decode_times=False) as data:
        fhash_codec.encode_dataset(data, tmp_path / "data.fhz", QUICK)
    assert (tmp_path / "path.fhz").read_bytes() == (tmp_path / "data.fhz").read_bytes()


def test_many_files_need_few_descriptors_and_open_files_are_read(tmp_path, monkeypatch) -> None:
    values = np.random.default_rng(0).random((2, 3, 4, 5), dtype="f4")
    config = EncodeConfig(max_error=0.01, effort=1)
    paths = [tmp_path / f"{number}.fhz" for number in range(6)]
    for path in paths:
        fhash_codec.encode(values, path, config)
    monkeypatch.setattr("fhash_codec.dataset.KEPT", 2)
    opened = [xr.open_dataset(path, engine="fhash") for path in paths]
    from fhash_codec import dataset

    here = [key for key in dataset._open if str(key[0]).startswith(str(tmp_path))]
    assert len(here) <= 2
    for each in (*opened, *opened):
        (name,) = each.data_vars
        assert np.abs(each[name].values - values).max() < 0.011
    for file in (io.BytesIO(paths[0].read_bytes()), paths[0].open("rb")):
        with file, xr.open_dataset(file, engine="fhash") as found:
            (name,) = found.data_vars
            np.testing.assert_array_equal(found[name], opened[0][name])


def test_packing_and_record_dimensions_are_handed_on_within_the_bound(tmp_path) -> None:
    counts = np.rint(1000 * np.sin(np.arange(2 * 3 * 4 * 5) / 9)).astype("f8").reshape(2, 3, 4, 5)
    source = xr.Dataset({"v": (("time", "z", "y", "x"), counts / 1000)})
    packing = {"dtype": "int16", "scale_factor": 0.001, "_FillValue": -32768}
    source.to_netcdf(
        tmp_path / "a.nc", engine="h5netcdf", encoding={"v": packing}, unlimited_dims=["time"]
    )
    for bound, packed in ((0.0004, True), (0.0007, False), (0.003, None)):
        config = EncodeConfig(max_error=bound, effort=1)
        fhash_codec.encode(tmp_path / "a.nc", tmp_path / "o.fhz", config, force=True)
        with xr.open_dataset(tmp_path / "o.fhz") as found:
            assert found.encoding["unlimited_dims"] == {"time"}
            assert packed is None or ("scale_factor" in found["v"].encoding) == packed
            found.to_netcdf(tmp_path / "r.nc", engine="h5netcdf")
        with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as again:
            error = np.abs(again["v"].values - counts / 1000).max()
            assert error <= bound * (1 + 1e-6)
            assert error <= again["v"].attrs["fhash_max_error"] * (1 + 1e-6)
            assert again.encoding["unlimited_dims"] == {"time"}
