"""Any arrays and any header that a container can hold come back, and the same content gives the
same file."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from properties import Draw, arrays, chunks, looking, one_line, same

from fhash_formats.container import (
    Container,
    ContainerWriter,
    describe_coordinates,
    shard_order,
)
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate

SHAPE = (4, 3, 5, 6)
TABLE = {"name": "fhash.transform"}


def header(**changes: Any) -> dict[str, Any]:
    """Return the header of a small compact container; `changes` replace its keys."""
    return {
        "encoder": {"version": "0.1.0", "seed": 7},
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
            "head": None,
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
        writer.add_whole(
            "tables/level_1", table(), chunk_shape=SHAPE, codecs=codecs, dimension_names=AXES
        )
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
def test_any_shards_come_back(values: np.ndarray, data: Draw) -> None:
    inner = data.draw(chunks(values.shape))
    shard = tuple(n * data.draw(st.integers(1, 3)) for n in inner)
    order = list(shard_order(values.shape, inner, shard))
    pieces = [
        values[tuple(slice(i * n, (i + 1) * n) for i, n in zip(index, inner, strict=True))]
        for index in order
    ]

    def extra(writer: ContainerWriter) -> None:
        writer.add_sharded(
            "extra/v",
            shape=values.shape,
            dtype=values.dtype,
            chunk_shape=inner,
            shard_shape=shard,
            chunks=iter(pieces),
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
    values=st.tuples(
        *(
            st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=n, max_size=n)
            for n in SHAPE
        )
    ),
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
            positions = np.nan_to_num(positions)
        coords[axis] = Coordinate(
            name=AXIS_NAMES[axis], values=positions, attributes={"units": "m"}
        )
    described = describe_coordinates(coords)

    def extra(writer: ContainerWriter) -> None:
        for axis, stored in AXIS_NAMES.items():
            if stored not in described:
                writer.add_whole(
                    f"coords/{stored}",
                    coords[axis].values,
                    attributes={"name": stored, "units": "m"},
                )

    with places() as (path, _):
        write(path, extra, coordinates=described, required_features=["transform"])
        with Container.open(path) as container:
            for axis, stored in AXIS_NAMES.items():
                assert same(container.coordinate(stored).values, coords[axis].values)
