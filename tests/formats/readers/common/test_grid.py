"""Even grids and components: positions, turned axes, names."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common.grid import (
    axis_steps,
    component_by_number,
    component_names,
    component_variables,
    lattice,
)

FLOAT = np.dtype("f4")


def test_positions_are_origin_and_multiples_of_the_spacing() -> None:
    assert lattice("x", 0.1, 0.1, 4).values.tolist() == [0.1 + i * 0.1 for i in range(4)]
    assert lattice("t", 1, -2, 3, first=0.5).values.tolist() == [0, -2, -4]
    assert (lattice("t", 0, 1, 1).name, lattice("y", 5, 0, 1).values.tolist()) == ("time", [5])


@pytest.mark.parametrize(
    ("origin", "spacing"), [(0, 0), (np.nan, 1), (0, np.inf), (-np.inf, 1), (0, np.nan)]
)
def test_positions_must_be_finite_and_apart(origin: float, spacing: float) -> None:
    with pytest.raises(InputError, match="both must be finite, and the spacing not 0"):
        lattice("x", origin, spacing, 2)


def test_directions_along_the_axes() -> None:
    assert axis_steps(np.diag([1.0, -2.0, 3.0])).tolist() == [1, -2, 3]
    nearly = np.eye(3)
    nearly[0, 1] = 0.9e-9
    assert axis_steps(nearly).tolist() == [1, 1, 1]
    for matrix in (np.eye(3)[[1, 0, 2]], np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="turned against the axes"):
            axis_steps(matrix)
    nearly[0, 1] = 1.1e-9
    with pytest.raises(InputError, match="turned against the axes"):
        axis_steps(nearly)


def test_names_of_components() -> None:
    assert component_names(3) == ["x", "y", "z"]
    assert component_names(2) == ["0", "1"]
    assert component_names(2, ["u", "v"]) == ["u", "v"]
    assert component_names(2, ["u", None]) == ["0", "1"]
    assert component_names(2, ["u", "u"]) == ["0", "1"]


def test_components_are_found_by_number() -> None:
    found = [
        *component_variables("u", 1, (2, 3, 4), FLOAT, "a"),
        *component_variables("v", 3, (2, 3, 4), FLOAT, "b"),
        *component_variables("CellData/w", 2, (2, 3, 4), FLOAT, "c"),
    ]
    assert [each.name for each in found[:4]] == ["u", "v.x", "v.y", "v.z"]
    assert found[2].handle == ("b", 1)
    assert component_by_number("v.1", found) == "v.y"
    assert component_by_number("v.y", found) == "v.y"
    assert component_by_number("w.1", found) == "w.1"
    assert component_by_number("v.3", found) == "v.3"
    assert component_by_number("u.0", found) == "u.0"
    assert component_by_number(None, found) is None
