"""Names of the source in a file of one variable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import ContainerWriter
from fhash_formats.container.named import ARRAY, DIMENSIONS, Names, paths_of, shows_values
from fhash_formats.errors import DamagedFileError

SHAPE = (4, 3, 5, 6)
COORDINATES = ("time", "height", "lat", "lon")


def names(variable: str = "u", coordinates: tuple[str, ...] = COORDINATES) -> Names:
    return Names.of({"name": variable, "units": "K", "attributes": {}}, coordinates, SHAPE)


@pytest.mark.parametrize(
    ("variable", "coordinates", "table", "dimensions"),
    [
        ("u", COORDINATES, "u", COORDINATES),
        ("surface/rain rate", ("t", "z", "y", "x"), "surface_rain_rate", ("t", "z", "y", "x")),
        ("lat", COORDINATES, "lat", ("time", "height", "lat_2", "lon")),
        ("tables", ("coords", "mlp", "u", "u"), "tables_2", ("coords_2", "mlp_2", "u", "u_2")),
        ("", ("", "", "", ""), "_", ("__2", "__3", "__4", "__5")),
    ],
)
def test_names_are_near_those_of_the_source_and_all_different(
    variable: str, coordinates: tuple[str, ...], table: str, dimensions: tuple[str, ...]
) -> None:
    found = names(variable, coordinates)
    assert (found.table, found.dimensions) == (table, dimensions)
    header = {"required_features": ["named"], **found.header()}
    assert paths_of(header, [table])["tables/level_1"] == table


def test_an_axis_that_is_not_whole_has_another_name_than_its_coordinate() -> None:
    assert names().axes(SHAPE) == COORDINATES
    assert names().axes((4, 3, 2, 6)) == ("time", "height", "lat_box", "lon")


def test_a_table_is_hidden_where_its_codec_lacks_something() -> None:
    codec = {"name": "fhash.transform", "configuration": {"step": 1.0}}
    mask = {"mask": {"scores": [0]}}
    floats, integers = np.dtype("f4"), np.dtype("i2")
    with_mask = {**codec, "configuration": {"step": 1.0, **mask}}
    apart = {**codec, "configuration": {"head": {"array": "mlp/parameters"}}}
    shards = {"name": "sharding_indexed", "configuration": {"codecs": [apart]}}
    assert shows_values(floats, [codec])
    assert shows_values(integers, [codec])
    assert shows_values(floats, [with_mask])
    assert not shows_values(integers, [with_mask])
    assert not shows_values(floats, [apart])
    assert not shows_values(floats, [shards])
    assert not shows_values(floats, [{"name": "bytes"}])
    assert names().hidden().path("tables/level_1") == "tables/level_1"
    assert names().hidden().path("coords/x") == "lon"


def test_arrays_lie_at_their_names_and_are_read_by_those_of_the_format(
    tmp_path: Path, samples: Any
) -> None:
    header = samples.compact_header() if hasattr(samples, "compact_header") else None
    assert header is None or header["model"]["profile"] == "compact"
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.names = names()
        writer.add_whole("coords/time", np.array([0.0, 1.0, 5.0, 6.0]))
        assert writer.names.path("coords/time") == "time"
        assert list(writer._arrays) == ["time"]
        assert writer._arrays["time"]["dimension_names"] == ["time"]


@pytest.mark.parametrize(
    "change",
    [
        {ARRAY: "coords"},
        {ARRAY: "a/b"},
        {ARRAY: "lat"},
        {ARRAY: 3},
        {DIMENSIONS: ["time", "height", "lat"]},
        {DIMENSIONS: ["time", "height", "lat", "lat"]},
        {DIMENSIONS: ["time", "height", "lat", "tables"]},
        {DIMENSIONS: ["time", "height", "lat", "a/b"]},
        {DIMENSIONS: None},
    ],
    ids=str,
)
def test_names_that_are_not_allowed_are_damage(change: dict[str, Any]) -> None:
    header = {"required_features": ["named"], **names().header(), **change}
    with pytest.raises(DamagedFileError, match=r"array|dimensions"):
        paths_of(header, ["u"])


@pytest.mark.parametrize("paths", [["tables/level_1"], ["u", "tables/level_1"], ["coords/x", "u"]])
def test_an_array_that_is_not_at_its_name_is_damage(paths: list[str]) -> None:
    header = {"required_features": ["named"], **names().header()}
    with pytest.raises(DamagedFileError, match="another name"):
        paths_of(header, paths)


def test_files_without_names_are_read_as_before() -> None:
    assert paths_of({"required_features": []}, ["tables/level_1", "u"]) == {
        "tables/level_1": "tables/level_1",
        "u": "u",
    }
