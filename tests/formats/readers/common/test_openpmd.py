"""Meshes of openPMD: labels, positions, and what is no mesh."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_formats.readers.common import openpmd

MESH = {
    "axisLabels": ["z", "y", "x"],
    "gridSpacing": [0.3, 0.2, 0.1],
    "gridGlobalOffset": [3.0, 0.0, 1.0],
    "gridUnitSI": 1e-6,
}


def test_positions_are_in_metres() -> None:
    columns = openpmd.axes(MESH, {"position": [0.5, 0.0, 0.0]}, (2, 3, 4))
    names = [column.name for column in columns if column is not None]
    assert names == ["z", "y", "x"]
    expected = ([3.15, 3.45], [0, 0.2, 0.4], [1, 1.1, 1.2, 1.3])
    for column, values in zip(columns, expected, strict=True):
        assert column is not None
        assert column.length == len(values)
        np.testing.assert_allclose(column.read(), np.array(values) * 1e-6)
        assert column.attributes == {"units": "m"}


def test_labels_in_the_order_of_fortran_begin_with_the_fastest() -> None:
    mesh = {key: value[::-1] if isinstance(value, list) else value for key, value in MESH.items()}
    c_order, fortran = (
        openpmd.axes({}, given, (2, 3, 4)) for given in (MESH, {**mesh, "dataOrder": "F"})
    )
    for one, other in zip(c_order, fortran, strict=True):
        assert one is not None
        assert other is not None
        assert one.name == other.name
        np.testing.assert_array_equal(one.read(), other.read())


@pytest.mark.parametrize("labels", [None, "zyx", ["z", "y"], ["r", "z", "x"], [1, 2, 3]], ids=str)
def test_what_is_no_mesh_has_no_positions(labels: object) -> None:
    given = {} if labels is None else {**MESH, "axisLabels": labels}
    assert openpmd.axes(given, {}, (2, 3, 4)) == [None, None, None]
