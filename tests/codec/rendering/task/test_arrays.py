"""The operations of marching: the same by numpy and by torch."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.devices import arrays_on
from fhash_formats.errors import InputError


@pytest.fixture(params=["numpy", "torch"])
def arrays(request: pytest.FixtureRequest) -> Arrays:
    if request.param == "numpy":
        return NUMPY
    import torch

    from fhash_codec.rendering.task.torch_arrays import TorchArrays

    return TorchArrays(torch.device("cpu"))


def test_arrays_come_back_as_they_went(arrays: Arrays) -> None:
    for kind in ("float32", "float64", "int64", "bool"):
        values = np.arange(6).reshape(2, 3).astype(kind)
        back = arrays.host(arrays.array(values))
        np.testing.assert_array_equal(back, values)
        assert back.dtype == values.dtype
    assert arrays.host(arrays.array([1, 2], "float32")).dtype == np.float32
    assert arrays.host(arrays.full(2, 1.5)).tolist() == [1.5, 1.5]
    assert arrays.host(arrays.full((1, 2), 3, "int64")).tolist() == [[3, 3]]
    assert arrays.host(arrays.empty((2, 3), "float32")).shape == (2, 3)
    assert arrays.host(arrays.range(3)).tolist() == [0, 1, 2]


def test_numbers_are_converted_towards_zero(arrays: Arrays) -> None:
    values = arrays.array([-1.7, -0.5, 1.7])
    assert arrays.host(arrays.to_int64(values)).tolist() == [-1, 0, 1]
    assert arrays.host(arrays.to_float32(values)).dtype == np.float32
    assert arrays.host(arrays.to_float64(arrays.range(2))).dtype == np.float64


def test_a_copy_has_memory_of_its_own(arrays: Arrays) -> None:
    first = arrays.array([1.0, 2.0])
    second = arrays.copy(first)
    second[0] = 5.0
    assert arrays.host(first).tolist() == [1.0, 2.0]


def test_elements_are_found_and_picked(arrays: Arrays) -> None:
    array = arrays.array([[0.0, 3.0], [4.0, 0.0]])
    rows, columns = arrays.nonzero(array)
    assert arrays.host(rows).tolist() == [0, 1]
    assert arrays.host(columns).tolist() == [1, 0]
    picked = arrays.take_along(array, arrays.array([[1], [0]]), 1)
    assert arrays.host(picked).tolist() == [[3.0], [4.0]]


def test_rows_that_are_named_twice_are_added_twice(arrays: Arrays) -> None:
    total = arrays.full((3, 2), 1.0)
    values = arrays.array([[1.0, 2.0], [10.0, 20.0], [100.0, 200.0]])
    arrays.add_rows(total, arrays.array([2, 0, 2]), values)
    assert arrays.host(total).tolist() == [[11.0, 21.0], [1.0, 1.0], [102.0, 203.0]]


def test_candidates_are_those_of_the_mask_on_the_host_and_all_on_a_device(arrays: Arrays) -> None:
    mask = arrays.array([False, True, True, False])
    values = arrays.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [4.0, 4.0]])
    some = arrays.candidates(mask)
    assert (
        arrays.host(values[some]).tolist()
        == arrays.host(values[mask] if arrays is NUMPY else values).tolist()
    )
    result = arrays.full((4, 2), 0.0)
    result[some] = arrays.kept(mask[some], values[some], 0.0)
    assert arrays.host(result)[:, 0].tolist() == [0.0, 2.0, 3.0, 0.0]
    other = arrays.array([9.0, 9.0, 9.0, 9.0])
    kept = arrays.kept(mask[some], values[:, 1][some], other[some])
    assert arrays.host(kept)[arrays.host(mask[some])].tolist() == [2.0, 3.0]


def test_counts_come_together_and_positions_by_their_count(arrays: Arrays) -> None:
    mask = arrays.array([False, True, True, False, True])
    count, largest = arrays.counts(arrays.xp.count_nonzero(mask), arrays.range(7).max())
    assert (count, largest) == (3, 6)
    assert arrays.host(arrays.chosen(mask, count)).tolist() == [1, 2, 4]
    assert len(arrays.chosen(mask & False, 0)) == 0


def test_a_device_is_named_and_never_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert arrays_on("cpu") is arrays_on("auto") is NUMPY
    with pytest.raises(InputError, match="no CUDA device"):
        arrays_on("cuda")
    with pytest.raises(InputError, match="'gpu'; allowed: auto, cpu, cuda"):
        arrays_on("gpu")


def test_marching_on_the_processor_loads_no_torch() -> None:
    code = (
        "import sys; from fhash_codec.rendering.task import devices; "
        "import fhash_codec.rendering.stream.stream; devices._driver_exists = lambda: False; "
        "devices.arrays_on('auto'); devices.arrays_on('cpu'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )
