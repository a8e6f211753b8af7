"""A network's values at scattered places: the same in any pass, and for tensors of a device."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.paper.engines.fused import start
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.rendering.stream.inference import HostInference, inference_in
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


def test_tensors_get_the_bits_of_arrays(network: Network, tensors: Arrays) -> None:
    places = places_in(SIZE)
    here, there = (HostInference(network, 0.6, arrays) for arrays in (NUMPY, tensors))
    at = tensors.array(places)
    np.testing.assert_array_equal(tensors.host(there.values(at)), here.values(places))
    np.testing.assert_array_equal(tensors.host(there.slopes(at)), here.slopes(places))
