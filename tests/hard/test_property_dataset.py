"""Variables of one file are what files of their own are; so are parts, and files that grow.

`make test` does not run these: each example encodes several tiny series.
"""

from __future__ import annotations

import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from hypothesis import given
from hypothesis import strategies as st
from properties import Draw, looking, same

import fhash_codec
from fhash_codec import Dataset, EncodeConfig, FhashError, Volume, Writer
from fhash_codec.appending.parts import Part, encode_part
from fhash_formats.series import ArraySeries, Coordinate, SourceMetadata, SourceVariable

Shape = tuple[int, int, int, int]
NAMES = (
    "u",
    "v",
    "U",
    "time",
    "x",
    "parts",
    "wind speed (m/s)",
    "a.b",
    "__u",
    "g/u",
    "ü",
    "coords",
)
DTYPES = ("float32", "float64", "float16", "int8", "uint16", "int32", "uint8")


def field(chance: np.random.Generator, shape: Shape, dtype: str) -> np.ndarray:
    """Return a wave with noise that fills a part of the range of its type."""
    places = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    wave = np.sin(sum(chance.normal(0, 4) * place for place in places))
    wave += 0.1 * chance.normal(0, 1, shape)
    kind = np.dtype(dtype)
    return wave.astype(kind) if kind.kind == "f" else np.rint(40 + 20 * wave).astype(kind)


@st.composite
def series(draw: Draw, grids: list[dict[str, Coordinate]]) -> ArraySeries:
    """Draw a small series on one of some grids, with gaps and an array beside it."""
    coords = draw(st.sampled_from(grids))
    shape: Shape = tuple(coords[axis].values.size for axis in "tzyx")
    chance = np.random.default_rng(draw(st.integers(0, 1 << 20)))
    values = field(chance, shape, draw(st.sampled_from(DTYPES)))
    if values.dtype.kind == "f" and draw(st.booleans()):
        values[chance.random(shape) < 0.1] = np.nan
    found = ArraySeries(values, name=draw(st.sampled_from(("u", "v", "lat"))), coords=coords)
    if draw(st.booleans()):
        latitudes = chance.integers(0, 2) + np.arange(shape[2] * shape[3] * 1.0) ** 1.5
        found.metadata = SourceMetadata(
            dimensions={coords[axis].name: axis for axis in "tzyx"},
            variable_attributes={"coordinates": "lats", "valid_range": np.array([0, 1], "f4")},
            variables=(
                SourceVariable(
                    name="lats",
                    dimensions=(coords["y"].name, coords["x"].name),
                    values=latitudes.reshape(shape[2:]),
                    is_coordinate=True,
                ),
            ),
            attributes={"title": draw(st.sampled_from(("a", "b")))},
        )
    return found


@st.composite
def grids(draw: Draw) -> dict[str, Coordinate]:
    """Draw positions along each axis."""
    return {
        axis: Coordinate(
            name=draw(st.sampled_from((name, f"{name}_s"))),
            values=np.arange(draw(st.integers(1, most))) + draw(st.sampled_from((0.0, 0.5))),
            attributes=draw(st.sampled_from(({}, {"units": "m"}))),
        )
        for axis, name, most in zip("tzyx", ("time", "z", "y", "x"), (4, 4, 7, 9), strict=True)
    }


@st.composite
def datasets(draw: Draw) -> tuple[dict[str, ArraySeries], dict[str, EncodeConfig]]:
    """Draw up to four variables, each with a promise of its own."""
    names = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=4, unique=True))
    known = [draw(grids()) for _ in range(2)]
    sources = {name: draw(series(known)) for name in names}
    configs = {}
    for name in names:
        exact = sources[name].values.dtype.kind in "iu" and draw(st.booleans())
        feature = draw(st.sampled_from((("all",), ("interval:0:45",))))
        bound = 0.0 if exact else draw(st.sampled_from((0.5, 0.05)))
        config = EncodeConfig(max_error=bound, effort=1, timings=False, features=feature)
        configs[name] = replace(config, psnr=45.0, max_error=None) if bound == 0.05 else config
    return sources, configs


@looking(15, 120)
@given(datasets())
def test_variables_of_one_file_are_those_of_files_of_their_own(
    drawn: tuple[dict[str, ArraySeries], dict[str, EncodeConfig]],
) -> None:
    sources, configs = drawn
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, alone = Path(folder) / "all.fhz", Path(folder) / "alone.fhz"
        wrong = {}
        for name, source in sources.items():
            try:
                fhash_codec.encode(source, alone, configs[name], force=True)
            except FhashError as error:
                wrong[name] = error
        if wrong:
            with pytest.raises(FhashError):
                fhash_codec.encode_dataset(sources, path, configs)
            return
        fhash_codec.encode_dataset(sources, path, configs)
        with fhash_codec.open(path) as dataset:
            assert isinstance(dataset, Dataset)
            assert list(dataset) == list(sources)
            dataset.verify()
            for name, source in sources.items():
                fhash_codec.encode(source, alone, configs[name], force=True)
                with fhash_codec.open(alone) as volume:
                    assert isinstance(volume, Volume)
                    check_same(dataset[name], volume)
            check_shown(path, dataset)


def check_same(one: Volume, other: Volume) -> None:
    """Assert that a variable of a file is what a file of its own holds."""
    assert same(one[...], other[...])
    for axis in "tzyx":
        assert same(one.coords[axis].values, other.coords[axis].values)
        assert one.coords[axis].attributes == other.coords[axis].attributes
        assert one.coords[axis].name == other.coords[axis].name
    for key in ("psnr", "rmse", "max_abs_error"):
        assert one.info["quality"][key] == other.info["quality"][key]
    assert one.info["config"] == other.info["config"]
    assert (one.metadata is None) == (other.metadata is None)
    if one.metadata is not None and other.metadata is not None:
        found = {each.name: each for each in one.metadata.variables}
        assert list(found) == [each.name for each in other.metadata.variables]
        for each in other.metadata.variables:
            assert same(found[each.name].values, each.values)


def check_shown(path: Path, dataset: Dataset) -> None:
    """Assert that xarray and the Zarr view show every variable of a file with its values."""
    with xarray.open_dataset(path, engine="fhash", decode_cf=False) as shown:
        sources = [volume.name for volume in dataset.values()]
        for name, volume in dataset.items():
            array = shown[volume.name if len(set(sources)) == len(sources) else name]
            assert array.size == volume.size
            assert same(array.values.reshape(volume.shape), volume[...])
    store = fhash_codec.zarr_store(path)
    for name, volume in dataset.items():
        values = xarray.open_zarr(store, mask_and_scale=False)[store.view.names[name]].values
        assert np.array_equal(values.reshape(volume.shape), volume[...], equal_nan=True)
    store.close()


@looking(10, 60)
@given(st.data())
def test_parts_merge_to_the_file_of_the_whole(data: st.DataObject) -> None:
    steps = data.draw(st.integers(2, 9))
    length = data.draw(st.integers(1, 3))
    layers = -(-steps // length)
    count = data.draw(st.integers(1, min(4, layers)))
    coords = data.draw(grids())
    times = np.cumsum(data.draw(st.lists(st.integers(1, 9), min_size=steps, max_size=steps)))
    coords["t"] = Coordinate(name="time", values=times.astype(float))
    source = data.draw(series([coords]))
    z, y, x = (min(4, n) for n in source.values.shape[1:])
    config = EncodeConfig(
        max_error=data.draw(st.sampled_from((0.02, 0.5))),
        effort=1,
        tile=f"{length}x{z}x{y}x{x}",
        features=data.draw(st.sampled_from((("all",), ("interval:0:45",)))),
        timings=False,
    )
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(name)
        try:
            fhash_codec.encode(source, folder / "whole.fhz", config)
        except FhashError:
            return
        paths = [folder / f"{number}.fhz" for number in range(1, count + 1)]
        for number, path in enumerate(paths, start=1):
            encode_part(source, path, config, Part(number=number, of=count))
        fhash_codec.merge(data.draw(st.permutations(paths)), folder / "merged.fhz")
        assert (folder / "merged.fhz").read_bytes() == (folder / "whole.fhz").read_bytes()


@looking(10, 60)
@given(st.data())
def test_a_file_that_grows_keeps_its_bound(data: st.DataObject) -> None:
    length = data.draw(st.integers(1, 3))
    shape = tuple(data.draw(st.integers(1, most)) for most in (4, 7, 9))
    steps = data.draw(st.integers(1, 10))
    chance = np.random.default_rng(data.draw(st.integers(0, 1 << 20)))
    values = field(chance, (steps, *shape), data.draw(st.sampled_from(DTYPES)))
    values = (values * data.draw(st.sampled_from((1, 1, 0)))).astype(values.dtype)
    if data.draw(st.booleans()):  # the last step leaves the range of the first ones
        values[-1] = values[-1] * 2
    bound = data.draw(st.sampled_from((0.0, 0.02, 1.0)))
    config = EncodeConfig(effort=1, tile=f"{length}x4x7x9", timings=False)
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, done = Path(name) / "run.fhz", 0
        while done < steps:
            if done == 0:
                writer = Writer(path, shape=shape, max_error=bound, config=config)
            else:
                writer = Writer.resume(path)
            more = data.draw(st.integers(1, steps - done))
            if done + more < steps:  # only whole layers are resumed
                more = max(length, more - more % length)
            more = min(more, steps - done)
            with writer:
                for frame in values[done : done + more]:
                    writer.append(frame)
            done += more
            if done % length and done < steps:
                break
        with fhash_codec.open(path) as volume:
            assert volume.shape == (done, *shape)
            error = np.abs(volume[...].astype(float) - values[:done].astype(float))
            assert error.max() <= bound
            assert volume.info["quality"]["max_abs_error"] >= error.max() * (1 - 1e-9)
            assert volume.coords["t"].values.tolist() == list(range(done))
            volume.verify()
