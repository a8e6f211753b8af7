"""Fields of streamed samples: frames by hand, the network, and uneven axes."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from frame_field import FrameField

import fhash_codec
from fhash_codec import Volume
from fhash_codec.paper.engines.fused import engine as start
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.rendering.bricks import Palette
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import NUMPY, Arrays, Frame, Table, Task, Units
from fhash_codec.rendering.stream_fields import (
    Field,
    HostInference,
    NetworkField,
    WarpedField,
    central_slopes,
    inference_in,
)
from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate

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


Floats = npt.NDArray[np.float64]

SIZE = (17, 9, 5)
LEVELS = ((3, 17, 9, 5), (2, 9, 5, 3), (1, 5, 3, 2))
"""Resolutions whose vertices lie 1, 2 and 4 vertices of the box apart."""


def network_of(
    draw: Callable[[tuple[int, ...]], Floats], box: tuple[int, int, int] = SIZE
) -> Network:
    """A network over three key frames with two hidden layers, its numbers drawn by shape."""
    levels = tuple(
        (time, *(min(length, size) for length, size in zip(space, box, strict=True)))
        for time, *space in LEVELS
    )
    widths = (2 * len(levels), 16, 16, 1)
    return Network(
        levels=levels,
        embedding_size=2,
        tables=[ArrayTable(draw((*level, 2)).astype(np.float32)) for level in levels],
        layers=tuple(
            (draw((outputs, inputs)).astype(np.float32), draw((outputs,)).astype(np.float32))
            for inputs, outputs in itertools.pairwise(widths)
        ),
        box_size=box,
        key_frames=3,
    )


@pytest.fixture(scope="module")
def network() -> Network:
    """A network of numbers that no sum is exact for."""
    random = np.random.default_rng(2)
    return network_of(lambda shape: random.normal(0, 0.3, shape))


def places_in(box: tuple[int, int, int], *, parts: int = 2**20) -> Floats:
    """Places (n, 3), x, y, z, in a box: 500 at random and the two ends, in parts of a vertex."""
    last = np.array(box[::-1]) - 1
    random = np.random.default_rng(3).integers(0, last * parts + 1, (500, 3)) / parts
    return np.concatenate([random, [0 * last, last]])


def test_on_the_host_a_sample_has_the_same_bits_in_any_pass(network: Network) -> None:
    inference, places = HostInference(network, 0.6, NUMPY), places_in(SIZE)
    values, slopes = inference.values(places), inference.slopes(places)
    random = np.random.default_rng(4)
    for count in (1, 2, 17, 64, 300):
        chosen = random.permutation(len(places))[:count]
        np.testing.assert_array_equal(inference.values(places[chosen]), values[chosen])
        np.testing.assert_array_equal(inference.slopes(places[chosen]), slopes[chosen])


def test_fused_kernels_are_taken_where_they_can_be_had(
    network: Network, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, fused = [], object()

    def started(*given: object) -> object:
        asked.append(given)
        return fused if len(asked) == 1 else None

    monkeypatch.setattr(start, "start_points", started)
    assert inference_in(tensors, network, 0.6) is fused
    assert isinstance(inference_in(tensors, network, 0.6), HostInference)
    assert isinstance(inference_in(NUMPY, network, 0.6), HostInference)
    assert asked == 2 * [(network, 0.6, tensors.device)]


X = np.array([0, 1, 2, 4, 8, 16, 17, 18, 19, 20.0])
COORDS = {
    axis: Coordinate(name=axis, values=values)
    for axis, values in (("x", X), ("y", np.arange(9.0)), ("z", np.arange(7.0)))
}


def fields(arrays: Arrays = NUMPY) -> tuple[FrameField, WarpedField, Grid]:
    grid = Grid.of(COORDS)
    assert grid.warp is not None
    values = np.random.default_rng(0).random((7, 9, 10)).astype(np.float32)
    values[:, :, 5] = np.nan
    own = Grid(counts=(10, 9, 7), origin=np.zeros(3), spacing=np.ones(3))
    frame = Frame(values=values, first=(0, 0, 0))
    inner = FrameField(frame, own, arrays)
    return inner, WarpedField(inner, grid.warp), grid


def test_values_and_slopes_are_those_of_the_series() -> None:
    inner, field, grid = fields()
    random = np.random.default_rng(1)
    physical = random.uniform([0, 0, 0], [20, 8, 6], (200, 3))
    drawn = physical / grid.spacing
    own = physical.copy()
    own[:, 0] = np.interp(physical[:, 0], X, np.arange(10))
    found, expected = field.values(drawn), inner.values(own)
    assert np.isnan(expected).any()
    np.testing.assert_allclose(found, expected, atol=1e-9)
    ahead = drawn + np.array([1e-5, 0, 0])
    slopes = field.slopes(drawn)
    rising = (field.values(ahead) - found) / 1e-5
    inside = np.isfinite(rising) & (np.floor(drawn[:, 0]) == np.floor(ahead[:, 0]))
    np.testing.assert_allclose(slopes[inside, 0], rising[inside], atol=1e-4)
    np.testing.assert_allclose(np.asarray(field.bounds), grid.bounds)


def test_cells_and_bricks_hide_nothing() -> None:
    _, field, grid = fields()
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.ones((101, 3), dtype=np.float32),
        extinctions=(np.arange(101) > 88) * 1.0,
    )
    cells = np.asarray(field.visible(Palette.of(table)))
    assert cells.shape == tuple(count - 1 for count in grid.counts[::-1])
    assert not cells.all()
    places = np.random.default_rng(2).uniform(0, np.array(grid.counts) - 1.001, (4000, 3))
    values = field.values(places)
    assert np.nanmax(values) > 0.88
    x, y, z = places.astype(int).T
    assert cells[z, y, x][np.nan_to_num(values) > 0.88].all()
    low, high = (part[z // 4, y // 4, x // 4] for part in (field.bricks.low, field.bricks.high))
    known = np.isfinite(values)
    assert np.all((low[known] <= values[known] + 1e-6) & (values[known] <= high[known] + 1e-6))


def test_tensors_give_the_same(tensors: Arrays) -> None:
    pytest.importorskip("torch")
    places = np.random.default_rng(3).uniform(0, 6, (50, 3))
    _, numpy_field, _ = fields()
    _, torch_field, _ = fields(tensors)
    moved = tensors.array(places)
    np.testing.assert_allclose(
        tensors.host(torch_field.values(moved)), numpy_field.values(places), atol=1e-12
    )
    np.testing.assert_allclose(
        tensors.host(torch_field.slopes(moved)), numpy_field.slopes(places), atol=1e-12
    )
