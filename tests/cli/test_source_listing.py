"""Text about data that can be encoded, from its parts; `info` shows the whole."""

from __future__ import annotations

import numpy as np

from fhash_cli.source_listing import MAX_TEXT, details, details_rows, listing, positions
from fhash_formats.series import ArraySeries, Coordinate


def test_details_hold_what_json_can() -> None:
    times = Coordinate(
        name="time", values=np.array([0.0, 1.0]), attributes={"units": "days since 2001-01-01"}
    )
    series = ArraySeries(np.zeros((2, 3, 4, 5), "i2"), name="u", coords={"t": times}, missing=[-9])
    series.attributes = {"note": "word " * 100, "valid": np.array([1, 2]), "odd": object()}
    found = details(series)
    assert (found["shape"], found["dtype"], found["fill"]) == ([2, 3, 4, 5], "int16", -9)
    assert found["coordinates"][0]["dates"] == ["2001-01-01", "2001-01-02"]
    assert found["coordinates"][1]["dates"] == []
    assert found["attributes"]["valid"] == [1, 2]
    rows = dict(details_rows(series))
    assert rows["t, z, y, x"] == "2 x 3 x 4 x 5"
    assert rows["note"].endswith("...")
    assert len(rows["note"]) == MAX_TEXT + 3
    assert "odd" not in rows


def test_positions_of_times_are_dates_where_they_are() -> None:
    time = Coordinate(name="t", values=np.array([0.5, 2.0]), attributes={"units": "s"})
    assert positions(time, "t") == "t 0.5 to 2 s"
    assert positions(time, "x") == "t 0.5 to 2 s"


def test_several_variables_go_into_one_file_unless_one_can_be_read_in_two_ways() -> None:
    dimensions = [{"name": name, "length": 2, "axis": name} for name in "tzyx"]
    variables = [
        {
            "name": name,
            "dtype": "float32",
            "stored": "",
            "units": "",
            "shape": [2, 2, 2, 2],
            "missing": [],
            "problem": "",
            "dimensions": dimensions,
            "commands": [f"fhash encode 'a b.nc' --var {name}"],
        }
        for name in "uv"
    ]
    line = "\nall in one file:\n  fhash encode 'a b.nc' -o 'a b.fhz' --var all"
    assert listing("a b.nc", 1, variables).endswith(line)
    assert "all in one file" not in listing("a b.nc", 1, variables[:1])
    variables[0]["commands"] *= 2
    assert "all in one file" not in listing("a b.nc", 1, variables)
