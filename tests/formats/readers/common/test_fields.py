"""Fields of compound types: their names, shapes and values."""

from __future__ import annotations

import numpy as np

from fhash_formats.readers.common.fields import expand, leaves, reading
from fhash_formats.readers.common.variables import Variable

NESTED = np.dtype(
    [("rho", "f4"), ("v", [("x", "f8"), ("y", "f8")], (2,)), ("w", "i2", (3,)), ("c", "c8")]
)


def test_leaves_of_nested_types() -> None:
    assert [(".".join(path), dtype.str, shape) for path, dtype, shape in leaves(NESTED)] == [
        ("rho", "<f4", ()),
        ("v.x", "<f8", (2,)),
        ("v.y", "<f8", (2,)),
        ("w", "<i2", (3,)),
        ("c.real", "<f4", ()),
        ("c.imag", "<f4", ()),
    ]


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
    variables = expand([Variable(name="s", shape=state.shape, dtype=NESTED)])
    assert [variable.name for variable in variables] == list(expected)
    for variable in variables:
        read = reading(lambda ranges: state[ranges], variable, state.ndim)
        assert variable.shape == expected[variable.name].shape
        ranges = (slice(1, 2), slice(0, 5), slice(2, 4), *[slice(1, 2)] * (len(variable.shape) - 3))
        got = read(ranges)
        np.testing.assert_array_equal(got, expected[variable.name][ranges])
        assert got.base is None


def test_parts_of_complex_arrays_are_there_by_name_only() -> None:
    whole = Variable(name="psi", shape=(2, 3, 4), dtype=np.dtype("c16"))
    assert [(one.name, one.auxiliary) for one in expand([whole])] == [
        ("psi", False),
        ("psi.real", True),
        ("psi.imag", True),
    ]
