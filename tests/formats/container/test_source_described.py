"""All that belongs to a variable comes back from a header and arrays as it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_formats.container import describe_metadata, read_metadata, strict_json
from fhash_formats.container.source_entry import MAX_INLINE
from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate, index_coordinate
from fhash_formats.source_metadata import SourceMetadata, SourceVariable

SHAPE = (3, 1, 4, 5)
COORDS = {
    "t": Coordinate(name="time", values=np.array([0.0, 1.5, 2.0]), attributes={"units": "h"}),
    "z": Coordinate(name="height", values=np.array([2.0])),
    "y": Coordinate(name="lat", values=np.linspace(0, 1, 4, dtype=np.float32).astype(np.float64)),
    "x": index_coordinate("x", 5),
}


class Array:
    """An array of a container."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype
        self.attributes: dict[str, Any] = {}

    def read(self) -> np.ndarray:
        return self.values


def variable(name: str, dimensions: tuple[str, ...], values: Any, **more: Any) -> SourceVariable:
    return SourceVariable(name=name, dimensions=dimensions, values=np.asarray(values), **more)


def through(metadata: SourceMetadata, attributes: dict[str, Any] | None = None) -> Any:
    """The metadata after a file, the header's entry, and the arrays."""
    entry, arrays = describe_metadata(metadata, COORDS, attributes or {})
    header = {
        "format_version": [2, 0],
        "variable": {"name": "u", "attributes": attributes or {}},
        "domain": {"shape": list(SHAPE)},
        "coordinates": {
            axis: {"name": one.name, "attributes": dict(one.attributes)}
            for axis, one in zip(("time", "z", "y", "x"), COORDS.values(), strict=True)
        },
        "source": strict_json.loads(strict_json.dumps(entry, "test")),
    }
    stored = {name: Array(values) for name, values in arrays.items()}
    return read_metadata(header, stored, COORDS), entry, arrays


def test_everything_comes_back() -> None:
    large = np.random.default_rng(0).random((4, 5)).astype("f4")
    metadata = SourceMetadata(
        dimensions={"lat": "y", "x": "x", "record": "t", "one": ""},
        variable_attributes={"units": "K", "missing_value": np.float32(1e20), "coordinates": "h"},
        variables=(
            variable("lat", ("lat",), COORDS["y"].values.astype("f4"), is_coordinate=True),
            variable("time", ("record",), [0, 1.5, 2], attributes={"units": "h", "bounds": "b"}),
            variable("height", (), 2.0, is_coordinate=True, attributes={"positive": "up"}),
            variable("b", ("record", "bnds"), np.arange(6).reshape(3, 2)),
            variable("field", ("lat", "x"), np.tile(large, 1)),
            variable("wide", ("n",), np.arange(MAX_INLINE + 1, dtype="u2")),
            variable("odd name", ("n",), np.random.default_rng(1).random(MAX_INLINE + 1)),
            variable("crs", (), np.int32(0), attributes={"name": "rotated", "a": np.int8(1)}),
            variable("label", ("one",), np.array(["é"], dtype=object), is_coordinate=True),
            variable("nan", (), np.array([0x7FC00001], "u4").view("f4")[0]),
        ),
        attributes={"title": "a", "levels": np.array([1, 2], "i2")},
        stored="int16",
        file="run.nc",
        digest="00",
    )
    back, entry, arrays = through(metadata, {"units": "K", "long_name": "made up"})
    assert back.dimensions == metadata.dimensions
    assert list(back.dimensions) == list(metadata.dimensions)
    assert (back.stored, back.file, back.digest) == ("int16", "run.nc", "00")
    np.testing.assert_equal(back.variable_attributes, metadata.variable_attributes)
    np.testing.assert_equal(back.attributes, metadata.attributes)
    for one, other in zip(metadata.variables, back.variables, strict=True):
        assert (one.name, one.dimensions) == (other.name, other.dimensions)
        assert one.is_coordinate == other.is_coordinate
        assert one.values.dtype == other.values.dtype
        assert one.values.tobytes() == other.values.tobytes() or one.values.dtype == object
        np.testing.assert_equal(dict(other.attributes), dict(one.attributes))
    assert set(arrays) == {
        "auxiliary/wide",
        "auxiliary/variable",
        "auxiliary/nan",
    }  # field is small
    by_reference = [each["axis"] for each in entry["variables"] if "axis" in each]
    assert by_reference == ["y", "t", "z"]


def test_plain_coordinates_take_few_bytes() -> None:
    metadata = SourceMetadata(
        dimensions={one.name: axis for axis, one in COORDS.items()},
        variables=tuple(
            variable(
                one.name, (one.name,), one.values, attributes=one.attributes, is_coordinate=True
            )
            for one in COORDS.values()
        ),
        variable_attributes={"units": "K"},
    )
    _, entry, arrays = through(metadata, {"units": "K"})
    assert entry == {
        "dimensions": ["t", "z", "y", "x"],
        "variables": [{"axis": axis} for axis in "tzyx"],
    }
    assert not arrays


def test_positions_that_differ_in_a_bit_are_stored() -> None:
    values = np.array([-0.0, 1, 2, 3, 4])
    metadata = SourceMetadata(
        dimensions={"time": "t", "lat": "y", "x": "x"}, variables=(variable("x", ("x",), values),)
    )
    back, entry, _ = through(metadata)
    assert "axis" not in entry["variables"][0]
    assert back.variables[0].values.tobytes() == values.tobytes()


@pytest.mark.parametrize(
    "metadata",
    [
        SourceMetadata(dimensions={}, attributes={"a": 1j}),
        SourceMetadata(dimensions={}, variables=(variable("a", (), 1j),)),
    ],
)
def test_what_has_no_form_is_refused(metadata: SourceMetadata) -> None:
    with pytest.raises(InputError):
        describe_metadata(metadata, COORDS, {})
