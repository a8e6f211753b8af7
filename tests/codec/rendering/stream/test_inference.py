"""A network's values at scattered places: the same in any pass, and alike on host and device."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.paper.engines.fused import start
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.rendering.stream.inference import DenseInference, PatchInference, inference_in
from fhash_codec.rendering.task.arrays import NUMPY, Arrays

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
    inference, places = PatchInference(network, 0.6), places_in(SIZE)
    values, slopes = inference.values(places), inference.slopes(places)
    random = np.random.default_rng(4)
    for count in (1, 2, 17, 64, 300):
        chosen = random.permutation(len(places))[:count]
        np.testing.assert_array_equal(inference.values(places[chosen]), values[chosen])
        np.testing.assert_array_equal(inference.slopes(places[chosen]), slopes[chosen])


def test_on_a_device_the_pass_of_a_sample_changes_its_rounding_alone(
    network: Network, tensors: Arrays
) -> None:
    inference, places = DenseInference(network, 0.6, tensors), places_in(SIZE)
    values = tensors.host(inference.values(tensors.array(places))).astype(np.float64)
    bound = 2 * rounding_of_values(network)
    assert bound < 1e-3
    random = np.random.default_rng(5)
    for count in (1, 2, 17, 64, 300):
        chosen = random.permutation(len(places))[:count]
        alone = tensors.host(inference.values(tensors.array(places[chosen])))
        assert np.abs(alone - values[chosen]).max() <= bound


def test_fused_kernels_are_taken_where_they_can_be_had(
    network: Network, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, fused = [], object()

    def started(*given: object) -> object:
        asked.append(given)
        return fused if len(asked) == 1 else None

    monkeypatch.setattr(start, "start_points", started)
    assert inference_in(tensors, network, 0.6) is fused
    assert isinstance(inference_in(tensors, network, 0.6), DenseInference)
    assert isinstance(inference_in(NUMPY, network, 0.6), PatchInference)
    assert asked == 2 * [(network, 0.6, tensors.device)]


def rounding_of_values(network: Network) -> float:
    """The largest distance of a float32 value from the exact one, for sums in any order.

    A sum of k products is off by at most k u / (1 - k u) times the sum of their magnitudes, where u
    is 2**-24 (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1). Each layer also
    hands on the error of the layer before it.
    """
    # Interpolation leaves the range of a table by its own rounding at most.
    magnitude = np.full(network.layers[0][0].shape[1], 1.001 * max(map(largest, network.tables)))
    error = np.zeros_like(magnitude)
    for weight, bias in network.layers:
        size, terms = np.abs(weight).astype(np.float64), weight.shape[1] + 1
        unit = terms * 2.0**-24 / (1 - terms * 2.0**-24)
        error = size @ error + unit * (size @ (magnitude + error) + np.abs(bias))
        magnitude = size @ magnitude + np.abs(bias)
    return float(error[0])


def largest(table: ArrayTable) -> float:
    return float(np.abs(table.values).max())


@pytest.mark.parametrize("box", [SIZE, (17, 1, 5), (1, 1, 1)])
@pytest.mark.parametrize("key", [0.0, 0.25, 1.5, 2.0])
def test_whole_tables_give_the_values_and_slopes_of_patches(
    tensors: Arrays, key: float, box: tuple[int, int, int]
) -> None:
    # Small whole numbers, at quarters of a vertex: float32 holds every sum of them exactly.
    random = np.random.default_rng(6)
    network = network_of(lambda shape: random.integers(-1, 2, shape).astype(np.float64), box)
    places = places_in(box, parts=4)
    patches = PatchInference(network, key)
    for arrays in (NUMPY, tensors):
        dense, at = DenseInference(network, key, arrays), arrays.array(places)
        np.testing.assert_array_equal(arrays.host(dense.values(at)), patches.values(places))
        np.testing.assert_array_equal(arrays.host(dense.slopes(at)), patches.slopes(places))
    assert len(np.unique(patches.values(places))) > (1 if box != (1, 1, 1) else 0)
