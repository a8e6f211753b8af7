"""Metadata are cut along the dimensions of the variable, and say what others name."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_formats.source_metadata import (
    SourceMetadata,
    SourceVariable,
    is_plain_name,
    references,
    renamed,
    with_history,
    without_names,
)

METADATA = SourceMetadata(
    dimensions={"lon": "x", "time": "t", "one": ""},
    variable_attributes={"coordinates": "lat month", "units": "K"},
    variables=(
        SourceVariable(name="lat", dimensions=("lon", "nv"), values=np.arange(8).reshape(4, 2)),
        SourceVariable(name="month", dimensions=("time",), values=np.array(["jan", "feb", "mar"])),
        SourceVariable(name="ps", dimensions=("time", "lon"), values=np.arange(12).reshape(3, 4)),
        SourceVariable(name="crs", dimensions=(), values=np.array(1)),
    ),
)


def test_a_part_has_the_values_of_its_places() -> None:
    cut = METADATA.cut({"t": [2, 0], "x": range(1, 3), "z": [5]})
    assert cut.named("lat").values.tolist() == [[2, 3], [4, 5]]
    assert cut.named("month").values.tolist() == ["mar", "jan"]
    assert cut.named("ps").values.tolist() == [[9, 10], [1, 2]]
    assert cut.named("crs").values == 1
    assert cut.variable_attributes == METADATA.variable_attributes


def test_one_place_takes_the_dimension_away() -> None:
    cut = METADATA.named("ps").cut({"time": 1, "other": 7})
    assert cut.dimensions == ("lon",)
    assert cut.values.tolist() == [4, 5, 6, 7]


def test_between_steps_nothing_along_time_is_known() -> None:
    cut = METADATA.cut({"t": None})
    assert [each.name for each in cut.variables] == ["lat", "crs"]
    assert cut.variable_attributes == {"coordinates": "lat", "units": "K"}


def test_dimensions_are_found_by_axis() -> None:
    assert (METADATA.along("x"), METADATA.along("z")) == ("lon", None)
    assert METADATA.named("other") is None


def test_attributes_name_other_variables() -> None:
    found = references(
        {
            "grid_mapping": "crs: lat lon",
            "formula_terms": "a: hyam ps: ps",
            "coordinates": "lat",
            "bounds": "b",
            "units": "K",
            "cell_measures": 3,
        }
    )
    assert list(found) == [
        ("coordinates", "lat"),
        ("grid_mapping", "crs"),
        ("grid_mapping", "lat"),
        ("grid_mapping", "lon"),
        ("bounds", "b"),
        ("formula_terms", "hyam"),
        ("formula_terms", "ps"),
    ]


def test_names_are_taken_out_of_a_list() -> None:
    assert without_names({"coordinates": "a b"}, {"a"}) == {"coordinates": "b"}
    assert without_names({"coordinates": "a b", "c": 1}, {"a", "b"}) == {"c": 1}


@pytest.mark.parametrize("before", [None, "", "  ", 7])
def test_history_begins_with_its_first_line(before: object) -> None:
    assert with_history({"history": before}, "now") == {"history": "now"}


def test_history_gets_one_line_more() -> None:
    assert with_history({"history": "a\n", "b": 1}, "now") == {"history": "a\nnow", "b": 1}


@pytest.mark.parametrize("name", ["a/b", "", "..", " a", "__a", "a\n", "a\\b", "x" * 300, 3])
def test_other_names_are_not_plain(name: object) -> None:
    assert not is_plain_name(name)
    assert is_plain_name("Größe m-2")


def test_attributes_follow_the_new_names_of_arrays() -> None:
    names = {"lat": "lat_2", "crs": "crs_2", "a": "a_2"}
    attributes = {
        "coordinates": "lat lon",
        "grid_mapping": "crs: lat lon",
        "formula_terms": "a: a b: b",
        "long_name": "lat",
    }
    assert renamed(attributes, names) == {
        "coordinates": "lat_2 lon",
        "grid_mapping": "crs_2: lat_2 lon",
        "formula_terms": "a: a_2 b: b",
        "long_name": "lat",
    }
