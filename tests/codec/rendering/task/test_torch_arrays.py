"""torch's arrays give the numbers that numpy's give, by the same operations."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_formats.errors import InputError

VALUES = np.array([[0.0, -1.75, 2.5], [3.25, 0.0, -0.5]])


def results(arrays: Arrays) -> dict[str, Array]:
    """The result of each operation, on the host."""
    values = arrays.array(VALUES)
    order = arrays.array([[2, 0, 1], [0, 0, 2]], "int64")
    sums = arrays.full((3, 2), 1.0)
    rows = arrays.array([2, 0, 2], "int64")
    arrays.add_rows(sums, rows, arrays.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))
    copy = arrays.copy(values)
    copy[0] = 9.0
    found = {
        "array": values,
        "float32": arrays.to_float32(values),
        "int64": arrays.to_int64(values),
        "float64": arrays.to_float64(arrays.to_int64(values)),
        "range": arrays.range(4),
        "full": arrays.full((2, 2), 7, "int64"),
        "row": arrays.nonzero(values)[0],
        "column": arrays.nonzero(values)[1],
        "taken": arrays.take_along(values, order, 1),
        "sums": sums,
        "copied from": values,
    }
    return {name: arrays.host(array) for name, array in found.items()}


def test_operations_equal_those_of_numpy(tensors: Arrays) -> None:
    expected, result = results(NUMPY), results(tensors)
    for name, array in expected.items():
        assert result[name].dtype == array.dtype, name
        np.testing.assert_array_equal(result[name], array, err_msg=name)


def test_empty_arrays_have_the_type_and_shape_asked_for(tensors: Arrays) -> None:
    for arrays in (NUMPY, tensors):
        empty = arrays.host(arrays.empty((2, 3), "float32"))
        assert (empty.shape, empty.dtype) == ((2, 3), np.dtype("float32"))


def test_a_device_without_memory_is_an_input_error(tensors: Arrays) -> None:
    import torch

    with pytest.raises(InputError, match="smaller"), tensors.guarded():
        raise torch.OutOfMemoryError("too much")
