"""Positions in the header: every bit of them comes back, or they need an array."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fhash_formats.container import (
    Container,
    ContainerWriter,
    describe_coordinates,
    validate_header,
)
from fhash_formats.container.coordinates import (
    MAX_LISTED,
    MAX_RULED,
    MAX_ULPS,
    describe_positions,
    positions,
)
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import Coordinate, index_coordinate

LARGEST = float(np.finfo(np.float64).max)
UNEVEN = np.cumsum(np.random.default_rng(0).random(MAX_LISTED))

RULED = {
    "plain index": (np.arange(128.0), {}),
    "one": (np.array([5.5]), {"start": 5.5}),
    "descending": (np.arange(90, -90.5, -0.5), {"start": 90, "step": -0.5}),
    "constant": (np.full(7, 2.0), {"start": 2, "step": 0}),
    "product and sum": (np.arange(128) * 0.1 + 5, {"start": 5, "step": 0.1}),
    "large": (1e300 + np.arange(5) * 1e299, {"start": 1e300, "step": 1e299}),
    "two far apart": (np.array([0.0, 3e-320]), {"step": 3e-320}),
    "float32": (
        np.linspace(0.1, 9.9, 128, dtype=np.float32).astype(float),
        {"start": 0.1, "dtype": "float32"},
    ),
    "last": (np.linspace(-3.3, 7.1, 128), {"start": -3.3, "ulps": [1]}),
    "an end that is early": (np.append(np.arange(80) * 0.25, 19.8), {"step": 0.25}),
}
LISTED = {
    "uneven": (UNEVEN, None),
    "uneven float32": (UNEVEN.astype(np.float32).astype(float), "float32"),
    "negative zero": (np.array([-0.0, 1.0, 2.0]), "float32"),
    "repeated": (np.array([0.0, 1.0, 1.0, 1.0]), "float32"),
    "to the end of float64 and back": (np.array([0.0, LARGEST, 0.0]), None),
    "a range beyond float64": (np.array([-1.7e308, 1.7e308]), None),
}
NEARLY = {
    "cell centres": ((np.arange(48) + 0.5) / 48, "float64"),
    "fractions": (np.arange(80) / 80, "float64"),
    "middles around 0": ((np.arange(100) + 0.5) / 100 * 2 - 1, "float64"),
    "means of edges": (
        (lambda edges: 0.5 * (edges[1:] + edges[:-1]))(np.linspace(-9.3, -0.1, 301)),
        "float64",
    ),
}
ARRAYS = {
    "not finite": np.array([0.0, np.nan]),
    "many uneven": np.append(UNEVEN, 1e3),
    "very many": np.arange(MAX_RULED + 1.0),
}


def there_and_back(values):
    """The description of positions, which gives every bit of them, also through JSON."""
    description = describe_positions(values)
    restored = positions(json.loads(json.dumps(description)), values.size)
    assert restored.tobytes() == values.tobytes()
    return description


@pytest.mark.parametrize("case", RULED)
def test_rules(case) -> None:
    values, expected = RULED[case]
    description = there_and_back(values)
    assert "values" not in description
    assert {key: description.get(key) for key in expected} == expected
    assert len(json.dumps(description)) < 100


@pytest.mark.parametrize("case", LISTED)
def test_lists(case) -> None:
    values, dtype = LISTED[case]
    description = there_and_back(values)
    assert len(description["values"]) == values.size
    assert description.get("dtype") == dtype


@pytest.mark.parametrize("case", NEARLY)
def test_rules_that_hold_but_for_a_few_units_in_the_last_place(case) -> None:
    values, dtype = NEARLY[case]
    description = there_and_back(values)
    assert values.size // 2 < len(description["ulps"]) <= values.size
    assert description["ulps"][0] != 0
    assert 0 < max(map(abs, description["ulps"])) <= MAX_ULPS
    assert len(json.dumps(description)) < 5 * values.size + 60
    assert description.get("dtype", "float64") == dtype


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_ulps_lead_over_zero_and_no_farther_than_infinity(dtype) -> None:
    tiny, most = float(np.finfo(dtype).smallest_subnormal), float(np.finfo(dtype).max)
    rule = {"start": 0, "step": 0, "dtype": dtype, "ulps": [0, 1, -2, 3]}
    np.testing.assert_array_equal(positions(rule, 4), [0, tiny, -2 * tiny, 3 * tiny])
    rule = {"start": tiny, "step": -2 * tiny, "dtype": dtype, "ulps": [-1, 1]}
    result = positions(rule, 2)
    np.testing.assert_array_equal(result, [0, 0])
    assert not np.signbit(result).any()
    rule = {"start": -most, "step": 0, "dtype": dtype, "ulps": [-1, -(2**52) + 1, 0]}
    np.testing.assert_array_equal(positions(rule, 3), [-np.inf, -np.inf, -most])


@pytest.mark.parametrize("case", ARRAYS)
def test_what_needs_an_array(case) -> None:
    assert describe_positions(ARRAYS[case]) is None


def test_random_positions_come_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        size = int(rng.integers(1, 100))
        # People write starts of few digits, and steps of more.
        start, step = (
            float(f"{rng.normal() * 10.0 ** rng.integers(-4, 5):.{rng.integers(1, most)}g}")
            for most in (6, 12)
        )
        values = start + step * np.arange(size)
        if rng.random() < 0.5:
            values = values.astype(np.float32).astype(np.float64)
        there_and_back(values)


def test_a_rule_that_leaves_float64_gives_infinities() -> None:
    assert positions({"start": 1e308, "step": 1e308}, 3)[1:].tolist() == [np.inf, np.inf]


def coords():
    return {
        "t": Coordinate(
            name="time", values=np.array([0, 0.5, 2.0, 2.25]), attributes={"units": "h"}
        ),
        "z": index_coordinate("z", 3),
        "y": Coordinate(
            name="lat", values=np.array([1.0, np.nan, 3, 4, 5]), attributes={"units": "deg"}
        ),
        "x": Coordinate(name="lon", values=np.arange(6) * 0.25),
    }


def write(path, header, arrays=()):
    with ContainerWriter(path) as writer:
        writer.add_whole("tables/level_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        for name, array, attributes in arrays:
            writer.add_whole(name, array, attributes=attributes)
        writer.commit(header)


def test_coordinates_of_a_series_come_back(tmp_path, samples) -> None:
    given = coords()
    header = {**samples.compact_header(), "coordinates": describe_coordinates(given)}
    assert sorted(header["coordinates"]) == ["time", "x", "z"]
    assert header["coordinates"]["z"] == {}
    write(
        tmp_path / "a.fhz",
        header,
        [("coords/y", given["y"].values, {**given["y"].attributes, "name": "lat"})],
    )
    with Container.open(tmp_path / "a.fhz") as container:
        for axis, stored in (("t", "time"), ("z", "z"), ("y", "y"), ("x", "x")):
            coordinate = container.coordinate(stored)
            assert (coordinate.name, dict(coordinate.attributes)) == (
                given[axis].name,
                dict(given[axis].attributes),
            )
            np.testing.assert_array_equal(coordinate.values, given[axis].values)


def test_ulps_need_a_rule(tmp_path, samples) -> None:
    header = samples.compact_header()
    header["coordinates"]["y"] = {"ulps": [0, 1, 0, -1, 0]}
    write(tmp_path / "a.fhz", header)
    for wrong in ([], [0] * 6, [0, 0.5, 0, 0, 0], [2**52], None):
        header["coordinates"]["y"] = {"ulps": wrong}
        with pytest.raises(InputError, match="ulps"):
            write(tmp_path / "b.fhz", header)
    header["coordinates"]["y"] = {"values": [0, 1, 2, 3, 4], "ulps": [0] * 5}
    with pytest.raises(InputError, match="a rule, and no values"):
        write(tmp_path / "b.fhz", header)


def test_an_axis_without_positions_is_refused(tmp_path, samples) -> None:
    header = samples.compact_header()
    del header["coordinates"]["y"]
    with pytest.raises(InputError, match="array coords/y is missing"):
        write(tmp_path / "a.fhz", header)


WRONG_ARRAYS = {
    "another length": (np.zeros(1), {}, "coords/time is float64 [(]1,[)]"),
    "another type": (np.zeros(4, np.float32), {}, "coords/time is float32"),
}


@pytest.mark.parametrize("case", WRONG_ARRAYS)
def test_an_array_beside_a_description_is_checked_as_well(tmp_path, samples, case) -> None:
    values, attributes, message = WRONG_ARRAYS[case]
    with pytest.raises(InputError, match=message):
        write(tmp_path / "a.fhz", samples.compact_header(), [("coords/time", values, attributes)])


def test_the_profile_paper_has_positions_in_the_header_too(sample, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.coordinate("x").values, arrays["coords/x"])
    header["coordinates"] = {"x": {"step": 0.5}}
    del arrays["coords/x"]
    samples.write(sample, header, arrays, force=True)
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.coordinate("x").values, np.arange(6) * 0.5)
    header["coordinates"] = {"x": {"step": None}}
    with pytest.raises(InputError, match=r"coordinates\.x\.step"):
        samples.write(sample, header, arrays, force=True)


@pytest.mark.parametrize(
    ("description", "key"),
    [
        ([], "x"),
        ({"values": [0, 1]}, "x.values"),
        ({"values": [0, 1, 2, 3, 4, None]}, "x.values"),
        ({"start": "0"}, "x.start"),
        ({"start": 10**400}, "x.start"),
        ({"step": None}, "x.step"),
        ({"ulps": [True]}, "x.ulps"),
        ({"dtype": "float16"}, "x.dtype"),
        ({"dtype": ["float32"]}, "x.dtype"),
        ({"name": 5}, "x.name"),
        ({"attributes": []}, "x.attributes"),
    ],
)
def test_wrong_description_is_named(samples, description, key) -> None:
    header = {**samples.compact_header(), "format": "fhash", "format_version": [2, 0]}
    validate_header(header)
    header["coordinates"] = {"x": description}
    with pytest.raises(
        DamagedFileError, match=rf"header key coordinates[.]{key.replace('.', '[.]')}\b"
    ):
        validate_header(header)


def test_few_bytes_do_not_ask_for_much_memory(samples) -> None:
    header = {**samples.compact_header(), "format": "fhash", "format_version": [2, 0]}
    header["domain"]["shape"][3] = MAX_RULED + 1
    with pytest.raises(DamagedFileError, match=r"coordinates[.]x .*an array for more than"):
        validate_header(header)
