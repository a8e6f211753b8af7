"""Fields of streamed samples: a decoded frame, or the model itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_field import FrameField

import fhash_codec
from fhash_codec import Volume
from fhash_codec.rendering.stream.fields import Field, NetworkField, central_slopes
from fhash_codec.rendering.task.arrays import Arrays
from fhash_codec.rendering.task.task import Task
from fhash_codec.rendering.task.units import Units
from fhash_formats.errors import InputError

FrameTask = Callable[..., tuple[FrameField, Task]]
Planned = Callable[[Volume, dict[str, Any], Arrays], tuple[Field, Task]]


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_a_field_of_a_network_has_the_values_and_slopes_of_its_volume(
    files: dict[str, Path], step: float
) -> None:
    x, y, z = np.array([8.7, 19.0]), np.array([10.1, 14.0]), np.array([9.3, 12.0])
    places = np.stack([x, y, z], axis=-1)
    with fhash_codec.open(files["paper"]) as network:
        values, slopes = network.sample(t=step, z=z, y=y, x=x, gradient=True)
        field = NetworkField(network, step, Units())
        np.testing.assert_allclose(field.values(places), values, rtol=1e-5)
        np.testing.assert_allclose(field.slopes(places), slopes[:, :0:-1], rtol=1e-4, atol=1e-5)


def test_only_vertices_of_weight_need_a_value(frame_task: FrameTask) -> None:
    values = np.arange(27.0).reshape(3, 3, 3)
    values[:, :, 1] = np.nan
    field, _ = frame_task(values)
    places = np.array([[0, 1, 1], [2, 1, 1], [2, 0.5, 1.5], [0.5, 0, 0], [1.5, 1, 1]], dtype=float)
    np.testing.assert_array_equal(field.values(places), [12, 14, 17, np.nan, np.nan])


def test_central_differences_reach_one_vertex_to_both_sides(frame_task: FrameTask) -> None:
    z, y, x = np.meshgrid(*map(np.arange, (9.0, 7.0, 8.0)), indexing="ij")
    values = 0.3 * x**2 - 2 * y + x * z
    values[4, 3, 7] = np.nan
    field, _ = frame_task(values)
    values = values.astype(np.float32)
    inner = field.arrays.array([[3.0, 2.0, 5.0]])
    np.testing.assert_allclose(central_slopes(field, inner), [[0.3 * 6 + 5, -2, 3]], rtol=1e-6)
    # At an end the place beyond it is the end itself.
    end = central_slopes(field, np.array([[0.0, 6.0, 2.0]]))
    np.testing.assert_allclose(end, [[(0.3 + 2) / 2, -1, 0]], rtol=1e-6, atol=1e-9)
    # Beside a missing vertex, along x, the slope within the cell.
    np.testing.assert_allclose(field.values(np.array([[6.25, 3.0, 4.0]])), np.nan)
    found = central_slopes(field, np.array([[5.25, 3.0, 4.0]]))
    np.testing.assert_allclose(found[0, 0], values[4, 3, 6] - values[4, 3, 5], rtol=1e-6)
    np.testing.assert_allclose(found[0, 1:], [-2, 5.25], rtol=1e-6)


def test_a_field_that_does_not_fit_says_so(
    files: dict[str, Path],
    volume: Volume,
    planned: Planned,
    tensors: Arrays,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import torch

    array = tensors.array

    def full(values: Any, kind: str | None = None) -> Any:
        if np.size(values) > 100:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return array(values, kind)

    monkeypatch.setattr(tensors, "array", full)
    with pytest.raises(InputError, match="memory of the device"):
        planned(volume, {}, tensors)
    with (
        fhash_codec.open(files["paper"]) as network,
        pytest.raises(InputError, match="memory of the device"),
    ):
        planned(network, {}, tensors)
