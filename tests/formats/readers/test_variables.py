"""Fields of compound types: their names, shapes and values."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored_series import VALUES, assert_frames, write_hdf5

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers import surroundings as module
from fhash_formats.readers.cf import packing
from fhash_formats.readers.file_series import RawLayout, Request
from fhash_formats.readers.layout import Dimension, Layout
from fhash_formats.readers.listing import Listed, listing
from fhash_formats.readers.registry import open_series
from fhash_formats.readers.surroundings import (
    Wanted,
    digest_of,
    kept_dimensions,
    surroundings,
)
from fhash_formats.readers.variables import (
    Variable,
    expand,
    group_time,
    join,
    times,
)
from fhash_formats.series import SourceMetadata

NESTED = np.dtype(
    [("rho", "f4"), ("v", [("x", "f8"), ("y", "f8")], (2,)), ("w", "i2", (3,)), ("c", "c8")]
)


def test_every_leaf_reads_as_numpy_reads_it() -> None:
    state = np.zeros((4, 5, 6), NESTED)
    state["rho"] = np.arange(120).reshape(4, 5, 6)
    state["v"]["y"] = np.arange(240).reshape(4, 5, 6, 2)
    state["w"] = np.arange(360).reshape(4, 5, 6, 3)
    state["c"] = state["rho"] * (1 + 2j)
    expected = {
        "s.rho": state["rho"],
        "s.v.x": state["v"]["x"],
        "s.v.y": state["v"]["y"],
        "s.w": state["w"],
        "s.c.real": state["c"].real,
        "s.c.imag": state["c"].imag,
    }
    whole = Variable(name="s", shape=state.shape, dtype=NESTED, read=lambda ranges: state[ranges])
    variables = expand([whole])
    assert [variable.name for variable in variables] == list(expected)
    for variable in variables:
        assert variable.shape == expected[variable.name].shape
        ranges = (slice(1, 2), slice(0, 5), slice(2, 4), *[slice(1, 2)] * (len(variable.shape) - 3))
        got = variable.read(ranges)
        np.testing.assert_array_equal(got, expected[variable.name][ranges])
        assert got.base is None


def variable(name: str, *shape: int, dtype: str = "f4", **rest: object) -> Variable:
    return Variable(name=name, shape=shape, dtype=np.dtype(dtype), **rest)  # type: ignore[arg-type]


def unnamed(one: Variable) -> list[Dimension]:
    return [Dimension(name=None, length=length) for length in one.shape]


def listed(*variables: Variable, request: Request | None = None) -> list[Listed]:
    return listing("a.h5", variables, unnamed, request or Request())


def test_raw_values_have_the_stored_type_and_no_unit_of_others() -> None:
    attributes = {"scale_factor": np.float32(0.1), "_FillValue": -9}
    one = variable("a", 4, 12, 13, 14, dtype="i2", attributes={"units": "K"})
    for raw, scaled, dtype, units in (
        (True, True, "int16", ""),
        (True, False, "int16", "K"),
        (False, True, "float32", "K"),
    ):
        said = packing("a.h5", np.dtype("i2"), attributes if scaled else {"_FillValue": -9})
        (found,) = listing(
            "a.h5", [one], unnamed, Request(raw_values=raw), lambda _, said=said: said
        )
        assert (found.dtype, found.units) == (dtype, units)
        assert found.options == ((("--raw-values",) if raw else ()),)
        assert found.missing == (() if raw else (-9,))


def test_auxiliary_variables_are_left_out_and_others_are_named() -> None:
    found = listed(
        variable("a", 4, 12, 13, 14),
        variable("b", 12, 13, 14),
        variable("lat", 12, 13, auxiliary=True),
        variable("line", 12),
    )
    assert [(one.name, one.options) for one in found] == [
        ("a", (("--var", "a"),)),
        ("b", (("--var", "b"),)),
        ("line", ()),
    ]
    assert found[2].problem == "1 dimensions (12,); 2 to 4 can be read"
    # a variable that cannot be read does not make the name of the other necessary
    assert listed(variable("a", 4, 12, 13, 14), variable("line", 12))[0].options == ((),)


def test_selections_and_both_readings() -> None:
    request = Request(select=(("dim0", "2"),))
    for given, prefix in ((Request(), "--select dim0=0"), (request, "--select dim0=2")):
        (one,) = listed(variable("a", 5, 4, 12, 13, 14), request=given)
        assert [" ".join(words) for words in one.options] == [prefix]
        assert [axis for _, axis in one.dimensions] == ["select", "t", "z", "y", "x"]
    (one,) = listed(variable("a", 5, 4, 12, 13, 3), request=request)
    assert [" ".join(words) for words in one.options] == [
        "--select dim0=2 --axes t,z,y,x",
        "--select dim0=2 --select dim4=0",
    ]
    assert one.dimensions[-1] == ("dim4", "?")


def test_a_wish_that_does_not_fit_is_the_problem() -> None:
    (one,) = listed(variable("a", 4, 12, 13, 14), request=Request(select=(("member", "2"),)))
    assert one.options == ()
    assert one.problem.startswith("--select member=2: a has no dimension 'member'")


@pytest.mark.parametrize("path", ["a b.h5", "step_*.h5"])
def test_commands_are_safe_for_a_shell(path: str) -> None:
    (first, _) = listed(variable("Step#*/my rho", 4, 12, 13, 14), variable("b", 4, 12, 13, 14))
    words = shlex.split(first.commands(path)[0])
    assert words == ["fhash", "encode", path, "-o", "myrho.fhz", "--var", "Step#*/my rho"]


def test_every_wish_is_repeated() -> None:
    request = Request(
        raw=RawLayout({"x": 4, "y": 5, "z": 6}, "u2", "big"), raw_values=True, missing=(-9, 1e20)
    )
    (one,) = listed(variable("a", 6, 12, 13, 14), request=request)
    assert " ".join(one.options[0]) == (
        "--shape x=4,y=5,z=6 --dtype u2 --endian big --raw-values --missing -9 --missing 1e+20"
    )


def test_json_of_an_entry() -> None:
    (one,) = listed(variable("a", 4, 12, 13, 14))
    assert one.as_dict("a.h5") == {
        "name": "a",
        "shape": [4, 12, 13, 14],
        "dtype": "float32",
        "stored": "",
        "missing": [],
        "units": "",
        "dimensions": [
            {"name": f"dim{place}", "length": length, "axis": axis}
            for place, (length, axis) in enumerate(zip((4, 12, 13, 14), "tzyx", strict=True))
        ],
        "commands": ["fhash encode a.h5 -o a.fhz"],
        "problem": "",
    }


def test_outputs_of_one_source_differ() -> None:
    found = listed(
        variable("level_0/rho", 12, 13, 14),
        variable("level_1/rho", 12, 13, 14),
        variable("Step#*/T", 4, 12, 13, 14),
    )
    assert [one.output for one in found] == ["level_0_rho.fhz", "level_1_rho.fhz", "T.fhz"]


def variables(*names: str, shape: tuple[int, ...] = (2, 3, 4)) -> list[Variable]:
    return [Variable(name=name, shape=shape, dtype=np.dtype("f4")) for name in names]


def joined(*names: str, **groups: Mapping[str, Any]) -> dict[str, list[str]]:
    found = join(variables(*names), lambda path: groups.get(path.replace("/", "__"), {}))
    return {
        variable.name: [member.name for member in variable.members]
        for variable in found
        if variable.members
    }


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("Step#{}/rho", "Step#*/rho"),
        ("{}/rho", "*/rho"),
        ("data/{}/fields/E/x", "data/*/fields/E/x"),
        ("timestep_{:04}/rho", "timestep_*/rho"),
        ("plt{:05}/level_0/rho", "plt*/level_0/rho"),
        ("run/Iteration {}/rho", "run/Iteration */rho"),
        ("t={}.5/rho", "t=*/rho"),
    ],
)
def test_steps_are_in_the_order_of_their_numbers(form: str, name: str) -> None:
    names = [form.format(number) for number in (10, 9, 100)]
    assert joined(*names) == {name: [names[1], names[0], names[2]]}


@pytest.mark.parametrize(
    "names",
    [
        ("level_0/rho", "level_1/rho"),
        ("member1/rho", "member2/rho"),
        ("run_1/rho", "run_2/rho"),
        ("rho_1", "rho_2"),
        ("step_1/rho", "step_01/rho"),
        ("0/rho",),
    ],
)
def test_other_numbers_are_no_steps(names: tuple[str, ...]) -> None:
    assert joined(*names) == {}


def test_a_single_group_is_a_step_by_its_name_or_its_time() -> None:
    assert joined("step_7/rho") == {"step_*/rho": ["step_7/rho"]}
    assert joined("data/7/rho", data__7={"time": 0.5}) == {"data/*/rho": ["data/7/rho"]}


def test_groups_of_other_shapes_stay_apart() -> None:
    found = join(
        [*variables("step_1/rho"), *variables("step_2/rho", shape=(2, 3, 5))], lambda path: {}
    )
    assert not any(variable.members or variable.auxiliary for variable in found)


def test_members_are_read_only_by_name() -> None:
    found = join(variables("step_1/rho", "step_2/rho", "mask"), lambda path: {})
    assert {variable.name: (variable.shape, variable.auxiliary) for variable in found} == {
        "step_*/rho": ((2, 2, 3, 4), False),
        "step_1/rho": ((2, 3, 4), True),
        "step_2/rho": ((2, 3, 4), True),
        "mask": ((2, 3, 4), False),
    }


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({"time": 2.0}, (2.0, "")),
        ({"Time": np.array([2.0])}, (2.0, "")),
        ({"TimeValue": 3, "time_units": "ms"}, (3.0, "ms")),
        ({"time": 2.0, "timeUnitSI": 1e-15}, (2e-15, "s")),
        ({"time": "noon"}, None),
        ({"timeUnitSI": 1.0}, None),
        ({}, None),
    ],
)
def test_times_of_groups(attributes: Mapping[str, Any], expected: tuple[float, str] | None) -> None:
    assert group_time(attributes) == expected


def test_times_come_from_groups_or_from_numbers_beside() -> None:
    members = variables("data/0/fields/E", "data/5/fields/E")
    given = {"data/0": {"time": 0.0}, "data/5": {"time": 0.25}}
    coordinate = times(members, lambda path: given.get(path, {}), lambda path: None)
    assert (coordinate.name, coordinate.values.tolist()) == ("time", [0, 0.25])
    beside = {"data/0/time": (1.0, "s"), "data/5/fields/time": (2.0, "s")}
    coordinate = times(members, lambda path: {}, beside.get)
    assert (coordinate.values.tolist(), coordinate.attributes) == ([1, 2], {"units": "s"})
    coordinate = times(members, lambda path: {}, {"data/0/time": (1.0, "s")}.get)
    assert (coordinate.name, coordinate.values.tolist()) == ("step", [0, 5])


def test_several_datasets_need_a_choice(tmp_path: Path) -> None:
    path = write_hdf5(
        tmp_path / "a.h5", density=VALUES, gas__pressure=VALUES * 2, time=np.arange(4.0)
    )
    with pytest.raises(
        InputError,
        match=r"holds 2 variables: density \(4, 3, 5, 6\), gas/pressure \(4, 3, 5, 6\);"
        " choose one with --var",
    ):
        open_series(path)
    for name in ("gas/pressure", "/gas/pressure", "pressure"):
        assert_frames(path, VALUES * 2, var=name)
    with pytest.raises(
        InputError, match=r"no variable 'presure'; it holds gas/pressure .*, density"
    ):
        open_series(path, var="presure")
    path = write_hdf5(tmp_path / "b.h5", a__v=VALUES, b__v=VALUES)
    with pytest.raises(InputError, match="means 2 variables"):
        open_series(path, var="v")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros(3), "1 dimensions"),
        (np.float64(1), "0 dimensions"),
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.full((2, 2, 2), b"word"), "text"),
        (np.zeros((2, 2, 2), bool), "boolean.*--feature mask"),
        (np.zeros((2, 0, 2)), "length 0"),
        (np.zeros((2, 2, 2), np.longdouble), "float128|longdouble"),
    ],
)
def test_unsuitable_datasets_are_described(tmp_path: Path, array: Any, words: str) -> None:
    path = write_hdf5(tmp_path / "a.h5", odd=array)
    with pytest.raises(InputError, match=rf"no variable of 2 to 4 dimensions.*odd: .*({words})"):
        open_series(path)
    with pytest.raises(InputError, match=rf"variable odd has .*({words})"):
        open_series(path, var="odd")


def test_a_file_without_datasets(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no array at all"):
        open_series(write_hdf5(tmp_path / "a.h5"))


DIMENSIONS = {"time": "t", "lat": "y", "lon": "x"}


def stored(dimensions: tuple[str, ...], values: Any, **attributes: Any) -> Variable:
    array = np.asarray(values)
    return Variable(
        name="",
        dimensions=dimensions,
        shape=array.shape,
        dtype=array.dtype,
        attributes=attributes,
        read=lambda places: array[places],
    )


def found(variables: dict[str, Variable], picked: Any = None, **more: Any) -> SourceMetadata:
    dimensions = {key: axis for key, axis in DIMENSIONS.items() if key not in (picked or {})}
    wanted = Wanted(source="a.nc", name="u", dimensions=dimensions, picked=picked or {}, **more)
    return surroundings(wanted, variables, {"coordinates": "month other", "title": "a"})


def some(**attributes: Any) -> dict[str, Variable]:
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
        stored(("nothing",), np.zeros(0)),
        stored(("lat",), np.zeros(3, dtype=complex)),
        stored(("lat",), np.array([1, "a", None], dtype=object)),
        stored(("many",), np.array(["a"] * 20000)),
    ],
)
def test_what_no_container_holds_is_named(bad: Variable) -> None:
    with pytest.warns(FhashWarning, match="bad"):
        metadata = found({**some(coordinates="bad lat2d"), "bad": bad})
    assert metadata.named("bad") is None
    assert metadata.named("lat2d") is not None


def test_a_coordinate_that_cannot_be_read_does_not_bar_the_values() -> None:
    def fail(places: Any) -> Any:
        raise OSError("no such filter")

    lat2d = Variable(
        name="lat2d",
        dimensions=("lat",),
        shape=(3,),
        dtype=np.dtype("f4"),
        attributes={},
        read=fail,
    )
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
