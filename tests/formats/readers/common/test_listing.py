"""The listing of a source: what is said of each variable, and commands that work."""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from fhash_formats.readers.common.cf_packing import packing
from fhash_formats.readers.common.layout import Dimension
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.request import RawLayout, Request
from fhash_formats.readers.common.variables import Variable


def variable(name: str, *shape: int, dtype: str = "f4", **rest: object) -> Variable:
    return Variable(name=name, shape=shape, dtype=np.dtype(dtype), **rest)  # type: ignore[arg-type]


def unnamed(one: Variable) -> list[Dimension]:
    return [Dimension(name=None, length=length) for length in one.shape]


def listed(*variables: Variable, request: Request | None = None) -> list[Listed]:
    return listing("a.h5", variables, unnamed, request or Request())


def test_raw_values_have_the_stored_type_and_no_unit_of_others() -> None:
    attributes = {"scale_factor": np.float32(0.1), "_FillValue": -9}
    one = variable("a", 4, 12, 13, 14, dtype="i2", units="K")
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


def test_one_variable_needs_no_option() -> None:
    (only,) = listed(variable("group/rho", 4, 12, 13, 14, units="kg"))
    assert (only.units, only.dtype, only.options) == ("kg", "float32", ((),))
    assert [axis for _, axis in only.dimensions] == ["t", "z", "y", "x"]
    assert only.commands("a.h5") == ["fhash encode a.h5 -o rho.fhz"]


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
    assert found[2].problem == "1 dimensions (12,); 3 or 4 can be read"
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


def test_packed_values_are_listed_by_their_own_type() -> None:
    made = packing("a", np.dtype("i2"), {"scale_factor": 0.5, "_FillValue": -9})
    (one,) = listing("a", [variable("a", 4, 12, 13, 14)], unnamed, Request(), lambda one: made)
    assert (one.dtype, one.stored, one.missing) == ("float64", "int16", (-9,))


def test_outputs_of_one_source_differ() -> None:
    found = listed(
        variable("level_0/rho", 12, 13, 14),
        variable("level_1/rho", 12, 13, 14),
        variable("Step#*/T", 4, 12, 13, 14),
    )
    assert [one.output for one in found] == ["level_0_rho.fhz", "level_1_rho.fhz", "T.fhz"]
