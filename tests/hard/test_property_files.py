"""Laws of containers, of their JSON and of files of several variables, for anything given."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import math
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from hypothesis import given
from hypothesis import strategies as st
from properties import Draw, arrays, chunks, looking, one_line, same

import fhash_codec
from fhash_cli.output import emit
from fhash_codec import Dataset, EncodeConfig, FhashError, FhashWarning, Volume, Writer
from fhash_codec.appending.parts import Part, encode_part
from fhash_codec.header import brief_history, brief_quality, history_points
from fhash_formats.container import Container, ContainerWriter, describe_coordinates
from fhash_formats.container import record as strict_json
from fhash_formats.container.array import ArrayMetadata
from fhash_formats.errors import InputError
from fhash_formats.series import (
    AXES,
    AXIS_NAMES,
    ArraySeries,
    Coordinate,
    SourceMetadata,
    SourceVariable,
)
from fhash_formats.support.values import json_attributes, plain_json

pytestmark = pytest.mark.hard

SHAPE = (4, 3, 5, 6)
TABLE = {"name": "fhash.transform"}


def header(**changes: Any) -> dict[str, Any]:
    """Return the header of a small compact container; `changes` replace its keys."""
    return {
        "encoder": {"version": "0.1.0"},
        "variable": {"name": "density", "units": "kg m-3", "dtype": "float32", "attributes": {}},
        "domain": {"shape": list(SHAPE)},
        "value_range": [-1.5, 2.5],
        "background": 0.125,
        "feature_bounding_box": [[0, 3], [0, 5], [0, 6]],
        "features": ["all"],
        "dilation": 1,
        "coreset_fraction": 1.0,
        "model": {
            "profile": "compact",
            "levels": [list(SHAPE)],
            "embedding_size": 1,
            "tables": "float32",
            "parameters": 1,
        },
        "coordinates": {AXIS_NAMES[axis]: {} for axis in AXES},
        "config": {},
        "training": {"seconds": None, "epochs": 0, "device": "cpu"},
        "quality": {"psnr": 48.5},
        "history": {},
        **changes,
    }


def table() -> np.ndarray:
    return np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)


@contextmanager
def places() -> Iterator[list[Path]]:
    """Two file names in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="fhash-") as folder:
        yield [Path(folder) / name for name in ("a.fhz", "b.fhz")]


def write(path: Path, extra: Any, **changes: Any) -> None:
    """Write a container with additional arrays, which `extra` writes."""
    from fhash_formats.transform.spec import AxisTransform, TransformSpec
    from fhash_formats.transform.tile_format import TileSettings

    spec = TransformSpec(axes=(AxisTransform(kind="none"),) * 4)
    settings = TileSettings(transform=spec, step=0.1, center=0.5, low=0.0, high=400.0)
    codecs = [{**TABLE, "configuration": {"settings": settings.to_text()}}]
    with ContainerWriter(path) as writer:
        writer.add_whole("table_1", table(), chunk_shape=SHAPE, codecs=codecs, dimension_names=AXES)
        extra(writer)
        writer.commit(header(**{"required_features": ["transform"], **changes}))


PARTS = st.text("abcXYZ019._-", min_size=1, max_size=6).filter(
    lambda part: not part.startswith(".") and part != "zarr.json"
)
NAMES = st.lists(PARTS, min_size=1, max_size=3).map(lambda parts: "extra/" + "/".join(parts))
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)
TABLES = st.dictionaries(st.text(min_size=1, max_size=6), JSON, max_size=4)


@looking(20)
@given(
    values=st.dictionaries(NAMES, arrays(dims=(1, 6), side=5), min_size=1, max_size=4),
    attributes=TABLES,
    data=st.data(),
)
def test_any_arrays_come_back_by_any_part(
    values: dict[str, np.ndarray], attributes: dict[str, Any], data: Draw
) -> None:
    names = list(values)
    values = {
        name: values[name]
        for name in names
        if not any(other != name and other.startswith(name + "/") for other in names)
    }
    cut = {name: data.draw(chunks(array.shape)) for name, array in values.items()}

    def extra(writer: ContainerWriter) -> None:
        for name, array in values.items():
            labels = [None if n % 2 else f"axis {n}" for n in range(array.ndim)]
            writer.add_whole(
                name, array, chunk_shape=cut[name], attributes=attributes, dimension_names=labels
            )

    with places() as (path, again):
        write(path, extra)
        write(again, extra)
        assert path.read_bytes() == again.read_bytes()
        with Container.open(path) as container:
            assert container.verify() == len(values) + 1
            for name, array in values.items():
                stored = container.arrays[name]
                assert same(stored.read(), array)
                assert dict(stored.attributes) == attributes
                spans = [
                    sorted(data.draw(st.tuples(st.integers(0, n), st.integers(0, n))))
                    for n in array.shape
                ]
                if all(low < high for low, high in spans):
                    part = tuple(slice(low, high) for low, high in spans)
                    assert same(stored.read(part), np.ascontiguousarray(array[part]))


@looking(15)
@given(values=arrays(dims=(1, 4), side=7), data=st.data())
def test_any_tiles_together_come_back(values: np.ndarray, data: Draw) -> None:
    tile = data.draw(chunks(values.shape))
    together = tuple(data.draw(st.integers(1, 4)) for _ in tile)
    metadata = ArrayMetadata(
        shape=values.shape, dtype=values.dtype, chunk_shape=tile, codecs=(), together=together
    )
    pieces = [
        (index, values[metadata.region(index)])
        for member in np.ndindex(*metadata.members)
        for index in data.draw(st.permutations(list(metadata.chunks_of(member))))
    ]

    def extra(writer: ContainerWriter) -> None:
        writer.add_array(
            "extra/v",
            shape=values.shape,
            dtype=values.dtype,
            chunk_shape=tile,
            together=together,
            chunks=iter(pieces),
            codecs=[{**TABLE, "configuration": {}}],
        )

    with places() as (path, _):
        write(path, extra)
        with Container.open(path) as container:
            assert same(container.arrays["extra/v"].read(), values)
            container.verify()


@looking(30)
@given(
    attributes=TABLES,
    name=st.text(min_size=1, max_size=8),
    units=st.text(max_size=8),
    config=TABLES,
    features=st.lists(st.text(max_size=8), max_size=3),
    unknown=TABLES,
)
def test_any_header_comes_back_or_is_refused_before_it_is_written(
    attributes: dict[str, Any],
    name: str,
    units: str,
    config: dict[str, Any],
    features: list[str],
    unknown: dict[str, Any],
) -> None:
    variable = {"name": name, "units": units, "dtype": "float32", "attributes": attributes}
    changes = {"variable": variable, "config": config, "features": features, "later": unknown}
    given_away = copy.deepcopy(changes)
    with places() as (path, _):
        try:
            write(path, lambda writer: None, **changes)
        except InputError as error:
            one_line(error)
            assert list(path.parent.iterdir()) == []
            return
        assert changes == given_away
        with Container.open(path) as container:
            for key, value in changes.items():
                assert container.header[key] == value


@looking(30)
@given(
    values=st.tuples(*(st.lists(st.floats(), min_size=n, max_size=n) for n in SHAPE)),
    even=st.tuples(*(st.booleans(),) * 4),
    start=st.floats(-1e6, 1e6),
    spacing=st.floats(1e-12, 1e6),
    single=st.booleans(),
)
def test_any_positions_come_back_to_the_last_bit(
    values: tuple[list[float], ...],
    even: tuple[bool, ...],
    start: float,
    spacing: float,
    single: bool,
) -> None:
    coords = {}
    for axis, given_values, ruled in zip(AXES, values, even, strict=True):
        positions = np.array(given_values, dtype=np.float64)
        if ruled:
            positions = start + spacing * np.arange(len(positions))
        if single:
            with np.errstate(over="ignore"):
                positions = positions.astype(np.float32).astype(np.float64)
        coords[axis] = Coordinate(
            name=AXIS_NAMES[axis], values=positions, attributes={"units": "m"}
        )
    described = describe_coordinates(coords)
    with places() as (path, _):
        write(path, lambda writer: None, coordinates=described)
        with Container.open(path) as container:
            for axis, stored in AXIS_NAMES.items():
                assert same(container.coordinate(stored).values, coords[axis].values)


TEXT = st.text(st.characters(codec=None), max_size=8)
"""Text with lone surrogates."""
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.integers(-(10**320), 10**320),
    st.floats(width=32).map(np.float32),
    st.floats().map(np.longdouble),
    st.integers(0, 2**64 - 1).map(np.uint64),
    st.booleans().map(np.bool_),
    st.complex_numbers(),
    st.lists(st.floats(), max_size=3).map(np.array),
    st.lists(st.floats(), max_size=3).map(lambda numbers: np.array(numbers, "g")),
)
SCALARS = st.one_of(
    NUMBERS,
    TEXT,
    TEXT.map(np.str_),
    st.binary(max_size=6),
    st.none(),
    st.booleans(),
    st.just(np.datetime64("NaT", "s")),
    st.just(np.zeros(1, "i4,f4")),
    st.builds(object),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.tuples(inner, inner),
        st.dictionaries(st.one_of(TEXT, st.integers(), st.floats()), inner, max_size=3),
    ),
    max_leaves=8,
)
OBJECTS = st.dictionaries(TEXT, VALUES, max_size=4)
FIGURE = st.one_of(st.none(), st.floats(), st.floats().map(np.float64))


@looking(50)
@given(value=OBJECTS)
def test_anything_becomes_strict_json_and_stays_it(value: dict[str, Any]) -> None:
    for convert in (plain_json, json_attributes):
        converted = convert(value)
        assert strict_json.loads(strict_json.dumps(converted, "it")) == converted
        assert convert(converted) == converted


@looking(50)
@given(
    points=st.lists(
        st.fixed_dictionaries({"seconds": FIGURE, "epoch": st.integers(0, 9), "psnr": FIGURE}),
        max_size=30,
    ),
)
def test_any_history_is_stored_and_read(points: list[dict[str, Any]]) -> None:
    stored = strict_json.dumps({"history": brief_history(points)}, "it")
    read = history_points(strict_json.loads(stored)["history"])
    assert len(read) == min(len(points), 24)
    for point in read:
        assert all(value is None or math.isfinite(value) for value in point.values())


@looking(30)
@given(figures=st.lists(FIGURE, min_size=3, max_size=3), largest=st.floats(0))
def test_any_quality_is_stored_and_printed(figures: list[Any], largest: float) -> None:
    step = {"step": 0, "psnr": figures[0], "rmse": figures[1], "max_abs_error": largest}
    quality = {"psnr": figures[2], "max_abs_error": largest, "per_step": [step], "ssim_window": {}}
    finite = plain_json(quality)
    strict_json.dumps(
        plain_json(brief_quality(ContainerWriter("unused.fhz"), finite, 1.0, (1, 1, 1, 1))), "it"
    )
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        emit({"quality": quality, "data_range": math.inf}, "", as_json=True)
    assert json.loads(printed.getvalue(), parse_constant=lambda name: 1 / 0)["data_range"] is None


@looking(8, 300)
@given(
    attributes=OBJECTS,
    along=OBJECTS,
    name=TEXT,
    units=TEXT,
    bound=st.sampled_from([0.0, 0.3, 0.9, 2.0]),
    dtype=st.sampled_from(["u1", "i2", "f4", "f8"]),
    scale=st.sampled_from([1.0, 1e300]),
)
def test_any_labels_and_any_bound_make_a_file_that_opens(
    attributes: Any, along: Any, name: str, units: str, bound: float, dtype: str, scale: float
) -> None:
    t, x = np.arange(2.0)[:, None, None, None], np.arange(6.0)
    values = np.broadcast_to(np.rint(20 + 10 * np.sin(x + t)), (2, 3, 4, 6)).copy()
    values = (values * scale if dtype == "f8" else values).astype(dtype)
    series = ArraySeries(
        values,
        name=name,
        units=units,
        coords={"x": Coordinate(name=name, values=x, attributes=along)},
    )
    series.attributes = attributes
    with tempfile.TemporaryDirectory(prefix="fhash-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        path = Path(folder) / "a.fhz"
        figures = fhash_codec.encode(
            series, path, EncodeConfig(max_error=bound, effort=1, timings=False)
        )
        with fhash_codec.open(path) as volume:
            assert volume.attrs == json_attributes(attributes, without=frozenset())
            assert volume.coords["x"].attributes == json_attributes(along, without=frozenset())
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            emit(figures, "", as_json=True)
        assert strict_json.loads(printed.getvalue().encode())["raw_bytes"] == values.nbytes


Shape = tuple[int, int, int, int]
DATASET_NAMES = (
    "u",
    "v",
    "U",
    "time",
    "x",
    "v0",
    "wind speed (m/s)",
    "a.b",
    "__u",
    "g/u",
    "ü",
    "tables",
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
    """Draw two to four variables, each with a promise of its own; a file of one is a Volume."""
    names = draw(st.lists(st.sampled_from(DATASET_NAMES), min_size=2, max_size=4, unique=True))
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
