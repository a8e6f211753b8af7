"""Files of several variables: names of their arrays, and those that are refused."""

from __future__ import annotations

import json

import pytest
from hostile_files import ROOT, edited, read_everything, refused
from several_files import write_several

from fhash_formats.container.variables import free_node, part_place
from fhash_formats.errors import UnsupportedFileError


@pytest.mark.parametrize(
    ("wish", "taken", "node"),
    [
        ("u", (), "u"),
        ("u", ("u",), "u_2"),
        ("u", ("u", "u_2"), "u_3"),
        ("group/u", (), "group_u"),
        ("wind speed (m/s)", (), "wind_speed_m_s_"),
        ("velocity.x", (), "velocity_x"),
        ("__u", (), "_u"),
        ("\u00fc", (), "_"),
        ("parts", (), "parts_2"),
        ("u" * 300, (), "u" * 80),
    ],
)
def test_names_at_the_root(wish, taken, node) -> None:
    assert free_node(wish, taken) == node


def test_places_of_parts_are_told_apart() -> None:
    assert part_place("u", "mlp/parameters") == "parts/u.mlp.parameters"
    places = [part_place("u", name) for name in ("a/b.c", "a.b/c", "a/b/c", "a.b.c")]
    assert places == ["parts/u.a.b..c", "parts/u.a..b.c", "parts/u.a.b.c", "parts/u.a..b..c"]


def change_first(key, value):
    def change(root) -> None:
        first = root["attributes"]["fhash"]["variables"][0]
        if value is ...:
            del first[key]
        else:
            first[key] = value

    return change


def change_root(key, value):
    return lambda root: root["attributes"]["fhash"].update({key: value})


FEATURES = ["variables", "transform", "mask", "apart"]
ROOTS = {
    "no list": (change_root("variables", {}), "variables is {}"),
    "an empty list": (change_root("variables", []), "at least one variable"),
    "a list of numbers": (change_root("variables", [1]), "a list of objects"),
    "no name": (change_first("name", ...), "variables.0.name is missing"),
    "an empty name": (change_first("name", ""), "a text that no other has"),
    "a name twice": (change_first("name", "w"), "a text that no other has"),
    "no array": (change_first("array", ...), "variable 'u': .*array is missing"),
    "an array in a group": (change_first("array", "a/b"), "a name of A-Z"),
    "an array with a dot": (change_first("array", "a.b"), "a name of A-Z"),
    "the group of parts": (change_first("array", "parts"), "a name of A-Z"),
    "an array twice": (change_first("array", "w"), "variable 'w': .*array is 'w'"),
    "an array that is not there": (change_first("array", "q"), "parts/u.mlp.parameters belongs to"),
    "three dimensions": (change_first("dimensions", ["time", "z", "y"]), "four different"),
    "a dimension twice": (change_first("dimensions", ["time", "z", "y", "y"]), "four different"),
    "a dimension in a group": (
        change_first("dimensions", ["time", "z", "y", "parts/u"]),
        "four different",
    ),
    "a dimension that is a variable": (
        change_first("dimensions", ["time", "z", "y", "w"]),
        "dimensions has the array of a variable",
    ),
    "a dimension that is not there": (
        change_first("dimensions", ["time", "z", "y", "q"]),
        "array q is missing",
    ),
    "a dimension of another length": (
        change_first("dimensions", ["z", "time", "y", "lon_deg_"]),
        "variable 'u': array coords/time is",
    ),
    "a feature that the root lacks": (change_root("required_features", ["variables"]), "'transf"),
    "a wrong header": (change_first("dilation", -1), "variable 'u': header key dilation"),
    "a header of another box": (
        change_first("feature_bounding_box", [[0, 3], [0, 5], [0, 6]]),
        "variable 'u': .*levels",
    ),
    "shares that are a list": (change_first("shares", ["auxiliary/lat"]), "an object"),
    "a shared table": (change_first("shares", {"tables/level_1": "w"}), "auxiliary/..."),
    "shares of no variable": (change_first("shares", {"auxiliary/a": "q"}), "array of a variable"),
    "shares of no text": (change_first("shares", {"auxiliary/a": ["w"]}), "array of a variable"),
    "shares that are not there": (
        change_first("shares", {"auxiliary/a": "w"}),
        "array parts/w.auxiliary.a is missing",
    ),
    "other documents at the root": (
        lambda root: root["consolidated_metadata"]["metadata"]["u"].update(fill_value=1),
        "consolidated_metadata has other documents",
    ),
    "a document less at the root": (
        lambda root: root["consolidated_metadata"]["metadata"].pop("parts"),
        "consolidated_metadata has other documents",
    ),
}


@pytest.mark.parametrize("case", ROOTS)
def test_headers_that_are_refused(tmp_path, samples, case) -> None:
    path = write_several(tmp_path / "a.fhz", samples, paper=False)
    change, message = ROOTS[case]
    refused(path, edited(path, samples, ROOT, change), message)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("parts/q.a", "belongs to no variable"),
        ("parts/u", "belongs to no variable"),
        ("parts/u.", "belongs to no variable"),
        ("parts/w.coords.x", "a coordinate, which lies at the root"),
        ("parts/u.tables.level_1", "is already"),
        ("parts/w.mlp.parameters", "names None as the place of its head"),
    ],
)
def test_arrays_that_belong_to_no_variable(tmp_path, samples, name, message) -> None:
    path = write_several(tmp_path / "a.fhz", samples, paper=False)
    parts = samples.unpack(path.read_bytes())
    source = "parts/u.mlp.parameters" if "mlp" in name else "time"
    copies = [(n.replace(f"{source}/", f"{name}/"), d) for n, d in parts if f"{source}/" in n]
    root = json.loads(parts[-1][1])
    document = next(data for member, data in copies if member.endswith("zarr.json"))
    root["consolidated_metadata"]["metadata"][name] = json.loads(document)
    data = samples.pack([*copies, *parts[:-1], (ROOT, json.dumps(root).encode())])
    refused(path, data, message)


def test_an_array_of_another_name_is_ignored(tmp_path, samples) -> None:
    path = write_several(tmp_path / "a.fhz", samples, paper=False)
    parts = samples.unpack(path.read_bytes())
    copies = [(n.replace("time/", "extra/"), data) for n, data in parts if n.startswith("time/")]
    root = json.loads(parts[-1][1])
    del root["consolidated_metadata"]
    path.write_bytes(samples.pack([*copies, *parts[:-1], (ROOT, json.dumps(root).encode())]))
    assert "extra" in read_everything(path)[1]


def test_a_missing_chunk_of_any_variable_is_refused(tmp_path, samples) -> None:
    path = write_several(tmp_path / "a.fhz", samples)
    parts = samples.unpack(path.read_bytes())
    for missing in ("w/c/0/0/0/0", "parts/u.mlp.parameters/c/0", "parts/paper.key_frames/c/0"):
        data = samples.pack([part for part in parts if part[0] != missing])
        refused(path, data, "chunks|is missing")


def test_an_unknown_feature_of_one_variable_is_told(tmp_path, samples) -> None:
    path = write_several(tmp_path / "a.fhz", samples, paper=False)

    def newer(root) -> None:
        header = root["attributes"]["fhash"]
        header["required_features"].append("teleport")
        header["variables"][1]["required_features"].append("teleport")

    refused(path, edited(path, samples, ROOT, newer), "teleport", UnsupportedFileError)
