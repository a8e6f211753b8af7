"""All that CF makes belong to a variable is found, bounded, and named where it is left out."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.errors import FhashWarning
from fhash_formats.readers.common import surroundings as module
from fhash_formats.readers.common.layout import Dimension, Layout
from fhash_formats.readers.common.surroundings import (
    Stored,
    Wanted,
    digest_of,
    kept_dimensions,
    surroundings,
)
from fhash_formats.series import SourceMetadata

DIMENSIONS = {"time": "t", "lat": "y", "lon": "x"}


def stored(dimensions: tuple[str, ...], values: Any, **attributes: Any) -> Stored:
    array = np.asarray(values)
    return Stored(
        dimensions=dimensions,
        shape=array.shape,
        dtype=array.dtype,
        attributes=attributes,
        read=lambda places: array[places],
    )


def found(variables: dict[str, Stored], picked: Any = None, **more: Any) -> SourceMetadata:
    dimensions = {key: axis for key, axis in DIMENSIONS.items() if key not in (picked or {})}
    wanted = Wanted(source="a.nc", name="u", dimensions=dimensions, picked=picked or {}, **more)
    return surroundings(wanted, variables, {"coordinates": "month other", "title": "a"})


def some(**attributes: Any) -> dict[str, Stored]:
    """A variable of 2 steps of 3 x 4 vertices, with everything beside it."""
    return {
        "u": stored(("time", "lat", "lon"), np.zeros((2, 3, 4)), **attributes),
        "v": stored(("time", "lat", "lon"), np.zeros((2, 3, 4)), coordinates="height"),
        "time": stored(("time",), [0, 1], units="days since 2000-01-01", bounds="time_bnds"),
        "lat": stored(("lat",), [0.0, 1, 2]),
        "time_bnds": stored(("time", "bnds"), [[0, 1], [1, 2]]),
        "month": stored(("time",), [1, 2]),
        "other": stored(("elsewhere",), [1, 2]),
        "lat2d": stored(("lat", "lon"), np.ones((3, 4)), bounds="corners"),
        "corners": stored(("lat", "lon", "nv"), np.ones((3, 4, 4))),
        "crs": stored((), 0, grid_mapping_name="latitude_longitude"),
        "area": stored(("lat", "lon"), np.ones((3, 4))),
        "flags": stored(("time", "lat", "lon"), np.ones((2, 3, 4), dtype="i1")),
        "height": stored((), 2.0),
    }


def test_all_that_is_named_is_kept() -> None:
    names = {"coordinates": "lat2d", "grid_mapping": "crs: lat2d", "cell_measures": "area: area"}
    metadata = found(some(units="K", **names, _ARRAY_DIMENSIONS=["time"]))
    kept = {each.name: each.is_coordinate for each in metadata.variables}
    coordinates = ["time", "lat", "lat2d", "month", "height"]
    assert kept == {
        **dict.fromkeys(coordinates, True),
        **dict.fromkeys(["crs", "area", "time_bnds", "corners", "other"], False),
    }
    assert metadata.variable_attributes == {"units": "K", **names}
    assert metadata.attributes == {"title": "a"}
    assert metadata.dimensions == DIMENSIONS


def test_what_is_small_or_named_in_other_ways_is_kept() -> None:
    shape = (20, 30, 40)
    variables = {
        "u": stored(("time", "lat", "lon"), np.zeros(shape, "f4"), PS_var="ps", units="Times"),
        "v": stored(("time", "lat", "lon"), np.zeros(shape, "f4")),
        "lev": stored(("lev",), [1.0], A_var="hyam", B_var="hybm"),
        "time": stored(("time",), np.arange(20.0), edges="time_edges"),
        "time_edges": stored(("edge",), np.arange(2000.0)),
        "ps": stored(("time", "lon"), np.zeros((20, 40)), bounds_variable="no such"),
        "hyam": stored(("lev",), [0.5]),
        "hybm": stored(("lev",), [0.5]),
        "Times": stored(("time", "letters"), np.full((20, 19), b"a")),
        "orog": stored(("lat", "lon"), np.zeros((30, 40), "f4")),
        "weights": stored(("many",), np.zeros(5000)),
        "tall": stored(("time", "many", "lon"), np.zeros((20, 3, 40))),
    }
    with pytest.warns(FhashWarning, match=r"kept: orog \(large, .*\), weights \(.*\)$"):
        metadata = found(variables)
    kept = {each.name for each in metadata.variables}
    assert kept == {"time", "time_edges", "ps", "hyam", "hybm", "lev", "Times"}


def test_many_small_arrays_are_bounded(monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_ARRAYS", 40)
    many = {f"n{number}": stored((), number) for number in range(100)}
    with pytest.warns(FhashWarning, match=r"n.. \(more than 40 arrays\).* and 5. more$") as told:
        metadata = found({**some(coordinates="lat2d"), **many})
    assert len(metadata.variables) == 40
    assert len(told) == 1
    assert metadata.named("corners") is not None


def test_a_field_of_its_own_is_named_in_one_warning() -> None:
    variables = some(ancillary_variables="flags", coordinates="flags lat2d", strange=1j)
    with pytest.warns(FhashWarning, match=r"u is kept: .*flags \(a field.*strange") as told:
        metadata = found(variables)
    assert len(told) == 1
    assert metadata.named("flags") is None
    assert metadata.variable_attributes["coordinates"] == "lat2d"


def test_sizes_are_bounded(monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_ONE", 200)
    with pytest.warns(FhashWarning, match=r"corners \(0 MiB; .*\)$"):
        assert found(some(coordinates="lat2d")).named("lat2d") is not None
    monkeypatch.setattr(module, "MAX_ALL", 60)
    with pytest.warns(FhashWarning, match="lat2d .*all together"):
        assert found(some(coordinates="lat2d")).named("lat2d") is None
    monkeypatch.setattr(module, "MAX_ATTRIBUTE", 10)
    with pytest.warns(FhashWarning, match="u:comment"):
        assert "comment" not in found(some(comment="a" * 20)).variable_attributes


@pytest.mark.parametrize(
    "bad",
    [
        stored(("lat", "lat"), np.zeros((3, 3))),
        stored(("lat",), np.zeros(5)),
        stored(("a/b",), np.zeros(3)),
        stored(("nothing",), np.zeros(0)),
        stored(("lat",), np.zeros(3, dtype=complex)),
        stored(("lat",), np.array([1, "a", None], dtype=object)),
        stored(("many",), np.array(["a"] * 20000)),
    ],
)
def test_what_no_container_holds_is_named(bad: Stored) -> None:
    with pytest.warns(FhashWarning, match="bad"):
        metadata = found({**some(coordinates="bad lat2d"), "bad": bad})
    assert metadata.named("bad") is None
    assert metadata.named("lat2d") is not None


def test_a_coordinate_that_cannot_be_read_does_not_bar_the_values() -> None:
    def fail(places: Any) -> Any:
        raise OSError("no such filter")

    lat2d = Stored(dimensions=("lat",), shape=(3,), dtype=np.dtype("f4"), attributes={}, read=fail)
    with pytest.warns(FhashWarning, match="lat2d .cannot be read: .*no such filter"):
        found({**some(coordinates="lat2d"), "lat2d": lat2d})


def test_a_selection_is_made_of_all_that_has_the_dimension() -> None:
    metadata = found(some(coordinates="lat2d"), picked={"time": 1})
    assert metadata.named("time").values == 1
    assert metadata.named("time").dimensions == ()
    assert metadata.named("time").is_coordinate
    assert metadata.named("time_bnds").values.tolist() == [1, 2]


def test_further_wishes_are_met() -> None:
    metadata = found(
        some(units="K", scale_factor=2.0),
        coordinates=["height"],
        used=["other"],
        without=["units"],
        stored="int16",
    )
    assert metadata.named("height").is_coordinate
    assert not metadata.named("other").is_coordinate
    assert metadata.variable_attributes == {"scale_factor": 2.0}
    assert metadata.stored == "int16"


def test_a_dimension_of_length_one_stays_unless_it_is_selected() -> None:
    names = ["member", "time", "y", "x", "one"]
    lengths = [1, 2, 3, 4, 1]
    layout = Layout(
        dimensions=tuple(
            Dimension(name=name, length=n) for name, n in zip(names, lengths, strict=True)
        ),
        picked={0: 0, 4: 0},
        axes=("t", "y", "x"),
    )
    kept, picked = kept_dimensions("a.nc", "u", layout, names, [("member", "0")])
    assert kept == {"time": "t", "y": "y", "x": "x", "one": ""}
    assert picked == {"member": 0}


def test_the_digest_is_that_of_a_small_file(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.nc"
    path.write_bytes(b"bytes")
    assert digest_of(path) == hashlib.sha256(b"bytes").hexdigest()
    assert digest_of(tmp_path) is None
    monkeypatch.setattr(module, "DIGEST_BYTES", 4)
    assert digest_of(path) is None
