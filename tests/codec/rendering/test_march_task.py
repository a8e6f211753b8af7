"""The task of a marcher: arrays, units, frames of uneven axes."""

from __future__ import annotations

import math
import subprocess
import sys
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering.grid import Grid, Warp
from fhash_codec.rendering.march_task import (
    DENSEST,
    NUMPY,
    Array,
    Arrays,
    Frame,
    Units,
    extinctions_in,
    warped,
)
from fhash_codec.rendering.plan import arrays_on
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError


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
        "import sys; from fhash_codec.rendering import plan as devices; "
        "import fhash_codec.rendering.stream_march; devices._driver_exists = lambda: False; "
        "devices.arrays_on('auto'); devices.arrays_on('cpu'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


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


def test_a_device_without_memory_is_an_input_error(tensors: Arrays) -> None:
    import torch

    with pytest.raises(InputError, match="smaller"), tensors.guarded():
        raise torch.OutOfMemoryError("too much")


GRID = Grid(counts=(11, 9, 1), origin=np.zeros(3), spacing=np.ones(3))


@pytest.mark.parametrize(
    ("first", "shape", "stride", "bounds"),
    [
        ((0, 0, 0), (1, 9, 11), 1, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 2, 3), (1, 4, 5), 1, [[3, 7], [2, 5], [-0.5, 0.5]]),
        # No further vertex would fit: the last values stand up to the end.
        ((0, 0, 0), (1, 3, 4), 3, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 0, 0), (1, 2, 3), 3, [[0, 6], [0, 3], [-0.5, 0.5]]),
    ],
)
def test_the_bounds_of_a_frame_reach_to_where_it_has_values(
    first: tuple[int, int, int], shape: tuple[int, ...], stride: int, bounds: list[list[float]]
) -> None:
    frame = Frame(values=np.zeros(shape, dtype=np.float32), first=first, stride=stride)
    np.testing.assert_array_equal(frame.bounds(GRID), bounds)


def test_extinctions_in_another_length_stay_finite() -> None:
    extinctions = np.array([0.0, 2.0, 1e300])
    np.testing.assert_array_equal(extinctions_in(extinctions, 1e20), [0.0, 2e20, DENSEST])


def volume(low: float, high: float, dtype: str) -> Volume:
    fields = SimpleNamespace(value_range=ValueRange(low, high), float_dtype=np.dtype(dtype))
    return cast(Volume, fields)


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (1e6, 1e6 + 1), (-1e-300, 1e-300), (-1e300, 1e300), (5.0, 5.0)]
)
def test_converted_values_have_a_size_near_one(low: float, high: float) -> None:
    units = Units.of(volume(low, high, "float64"))
    assert math.frexp(units.factor)[0] == 0.5, "a power of two"
    ends = units.to([low, high])
    assert np.isfinite(ends).all()
    assert np.abs(ends).max() <= 1


def test_integers_that_are_one_float_cannot_be_drawn() -> None:
    top = 2**64 - 1
    with pytest.raises(InputError, match=f"cannot tell values from {top - 998} to {top} apart"):
        Units.of(volume(top - 998, top, "float64"))
    assert Units.of(volume(2**60, 2**60 + 998, "float64")).factor == 2.0**-10
    assert Units.of(volume(top, top, "float64")).factor > 0


PLACES = np.array([0, 0.25, 0.5, 1, 1.5, 2, 3, 4.0])
WARP = Warp(counts=(5, 2, 3), places=(PLACES, None, None))


def frame(values: np.ndarray, first: tuple[int, int, int] = (0, 0, 0), stride: int = 1) -> Frame:
    return Frame(values=values.astype(np.float32), first=first, stride=stride)


def test_a_vertex_without_a_value_takes_those_beside_it_along() -> None:
    values = np.arange(5.0)
    values[2] = np.nan
    line = warped(frame(np.broadcast_to(values, (3, 2, 5)).copy()), WARP).values[0, 0]
    np.testing.assert_array_equal(line, [0, 0.25, 0.5, 1, np.nan, np.nan, 3, 4])
    np.testing.assert_array_equal(values, [0, 1, np.nan, 3, 4])


def test_a_region_keeps_its_place() -> None:
    drawn = warped(frame(np.arange(1.0, 4.0)[None, None].repeat(2, axis=1), (1, 0, 1)), WARP)
    assert drawn.first == (1, 0, 3)
    np.testing.assert_allclose(drawn.values[0, 0], [1, 1.5, 2, 3])
    nothing = warped(frame(np.ones((1, 1, 1)), (0, 0, 4)), WARP)
    assert nothing.values.shape == (1, 1, 1)
    assert nothing.first == (0, 0, 7)


def test_a_coarse_frame_reaches_to_the_end() -> None:
    warp = Warp(counts=(6, 1, 1), places=(np.linspace(0, 5, 11), None, None))
    drawn = warped(frame(np.array([0.0, 2, 4])[None, None], stride=2), warp)
    assert drawn.stride == 2
    np.testing.assert_allclose(drawn.values[0, 0], [0, 1, 2, 3, 4, 4])
