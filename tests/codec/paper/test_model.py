"""The paper profile's model as `Volume` reads it."""

from __future__ import annotations

import ctypes
from itertools import product
from math import prod

import numpy as np
import pytest
import torch
from readable_paper import FHash

from fhash_codec.boxes import Box
from fhash_codec.native import network as native
from fhash_codec.native.network import best_path
from fhash_codec.paper import model as points
from fhash_codec.paper.model import (
    PaperModel,
    PointSampler,
    PointTables,
    sample_points,
)
from fhash_codec.paper.network import Architecture, Network
from fhash_formats.container import Container
from fhash_formats.errors import InputError, RegionError


@pytest.fixture
def model(encoded):
    """The model of the shared container, and the size of its box."""
    with Container.open(encoded[1]) as container:
        model = PaperModel(container)
        yield model, model.network.box_size


def test_points_on_vertices_have_the_values_of_a_region(model) -> None:
    paper, size = model
    box = Box.of_shape(size)
    frame = paper.read(1.5, box, np.ones(size, bool))
    places = [axis.astype(float) for axis in np.nonzero(np.ones(size, bool))]
    keys = np.full(len(places[0]), 1.5)
    values, slopes = paper.sample_with_gradient(keys, places)
    np.testing.assert_array_equal(values, paper.sample(keys, places))
    assert slopes.shape == (len(values), 4)
    # float32 twice, along two ways of interpolation
    np.testing.assert_allclose(values, frame.ravel(), atol=1e-5 * np.ptp(frame))


def test_there_are_no_levels_of_detail(model) -> None:
    with pytest.raises(InputError, match="no levels of detail; decode it whole"):
        model[0].read_lod(0, 1, Box.of_shape((1, 1, 1)))


def test_values_and_gradients_are_those_of_the_papers_model_by_autograd(networks, network) -> None:
    sizes = (network.key_frames, *network.box_size)
    architecture = Architecture(
        levels=network.levels,
        embedding_size=network.embedding_size,
        hidden_layers=len(network.layers) - 1,
        width=16,
        box_size=network.box_size,
        key_frames=network.key_frames,
    )
    tables = [
        torch.from_numpy(table.values.reshape(-1, network.embedding_size)).double()
        for table in network.tables
    ]
    layers = [
        (torch.from_numpy(weight).double(), torch.from_numpy(bias).double())
        for weight, bias in network.layers
    ]
    model = FHash(architecture, tables, layers)
    scattered = networks.points(network, 300)
    leaf = torch.from_numpy(np.stack(scattered, axis=1)).requires_grad_()
    expected = model(leaf)
    (slopes_expected,) = torch.autograd.grad(expected.sum(), leaf)
    values, slopes = sample_points(network, *scattered, gradient=True)
    np.testing.assert_allclose(values, expected.detach().numpy(), rtol=1e-5, atol=1e-5)
    for axis in np.flatnonzero(np.array(sizes) > 1):
        exact = slopes_expected[:, axis].numpy()
        close = np.isclose(slopes[:, axis], exact, rtol=1e-4, atol=1e-4)
        # Near a ReLU's kink float32 may take the other side.
        assert close.mean() > 0.98


def test_points_far_apart_are_read_apart_and_come_out_alike(networks, monkeypatch) -> None:
    net = networks.random((40, 40, 40), 6, 2, 2, 1)
    scattered = [
        np.concatenate([p[:5] * 0.1, p[5:] * 0.1 + 0.9 * (s - 1)])
        for p, s in zip(networks.points(net, 10), (6, 40, 40, 40), strict=True)
    ]
    together = sample_points(net, *scattered, gradient=True)
    monkeypatch.setattr(points, "SMALL_READ", 2**12)
    recording = networks.recording(net)
    apart = sample_points(recording, *scattered, gradient=True)
    for one, other in zip(together, apart, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    regions = recording.tables[0].regions
    assert len(regions) > 1
    assert sum(prod(b - a for a, b in region[:4]) for region in regions) <= 2 * 2**12
    many = networks.points(net, 20_000)
    np.testing.assert_allclose(
        sample_points(net, *many, threads=4), networks.reference(net, many), rtol=1e-5, atol=1e-5
    )


def test_points_may_be_none_or_share_a_coordinate(networks) -> None:
    net = networks.random((3, 4, 5), 2, 2, 2, 1)
    assert sample_points(net, [], [], [], []).shape == (0,)
    assert sample_points(net, [], [], [], [], gradient=True)[1].shape == (0, 4)
    np.testing.assert_array_equal(
        sample_points(net, 0.5, 1.0, [0, 1.5], 2.0),
        sample_points(net, [0.5] * 2, [1, 1], [0, 1.5], [2, 2]),
    )


@pytest.mark.parametrize("key_index", [-0.1, 3.1, float("nan"), float("inf")])
def test_a_key_index_outside_is_refused(networks, key_index) -> None:
    with pytest.raises(RegionError, match="key_index"):
        sample_points(networks.random((4, 5, 6), 4, 2, 1, 0), key_index, 0, 0, 0)


def test_wrong_arguments_are_refused(networks) -> None:
    net = networks.random((4, 5, 6), 1, 2, 1, 0)
    with pytest.raises(RegionError, match=r"point 1: x 5\.5 is outside 0\.\.5"):
        sample_points(net, 0, 0, 0, [1, 5.5])
    with pytest.raises(RegionError, match="point 0: y nan"):
        sample_points(net, 0, 0, float("nan"), 0)
    with pytest.raises(InputError, match="one length"):
        sample_points(net, [0, 0, 0], 0, 0, [1, 2])
    with pytest.raises(InputError, match="one length"):
        sample_points(net, np.zeros((2, 2)), 0, 0, 0)


SHAPES = [
    # Box (z, y, x), key frames, fold, embedding size, hidden layers, width.
    ((1, 1, 1), 1, 2, 1, 1, 16),
    ((1, 1, 2), 2, 2, 2, 0, 16),
    ((9, 12, 1), 3, 2, 2, 1, 64),
    ((1, 7, 1), 1, 2, 3, 1, 1),
    ((13, 17, 37), 4, 3, 2, 2, 64),
    ((11, 33, 35), 12, 2, 1, 0, 16),
    ((9, 23, 30), 2, 2, 4, 2, 128),
    ((8, 9, 40), 6, 2, 5, 3, 33),
    ((60, 70, 80), 3, 2, 2, 1, 32),
]


@pytest.fixture
def library() -> ctypes.CDLL:
    return native.library()


@pytest.fixture(params=SHAPES, ids=str)
def network(request: pytest.FixtureRequest, networks) -> Network:
    *shape, width = request.param
    return networks.random(*shape, width=width)


def paths(library: ctypes.CDLL) -> list[int]:
    return [bit for bit in (1, 2, 4) if library.fhash_network_paths() & bit]


def faces_and_inside(networks, network: Network) -> list[np.ndarray]:
    """Random points, and every corner of the box at both ends of time."""
    ends = [(0.0, size - 1.0) for size in (network.key_frames, *network.box_size)]
    corners = np.array(list(product(*ends))).T
    inside = networks.points(network, 171)
    on_faces = [p.copy() for p in networks.points(network, 60, seed=4)]
    for number in range(60):
        axis = number % 4
        on_faces[axis][number] = ends[axis][number // 4 % 2]
    return [np.concatenate(c) for c in zip(corners, inside, on_faces, strict=True)]


def test_every_path_gives_the_values_of_the_formula(library, networks, network) -> None:
    places = faces_and_inside(networks, network)
    tables = PointTables.read(network, [c.min() for c in places], [c.max() for c in places])
    expected = networks.reference(network, places)
    for path in paths(library):
        values = np.empty(len(expected), np.float32)
        slopes = np.empty((len(expected), 4), np.float32)
        sampler = PointSampler(tables, path=path)
        sampler.evaluate(places, values, slopes)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
        alone = np.empty_like(values)
        sampler.evaluate(places, alone)
        np.testing.assert_array_equal(alone, values)


def test_tables_at_one_time_give_the_same_bits(library, networks, network) -> None:
    key_index = 0.37 * (network.key_frames - 1)
    places = [np.array([key_index]), *networks.points(network, 200)[1:]]
    tables = PointTables.of_box(network, key_index)
    for path in paths(library):
        values, once = np.empty(200, np.float32), np.empty(200, np.float32)
        PointSampler(tables, path=path).evaluate(places, values)
        PointSampler(tables, key_index, path).evaluate([np.zeros(1), *places[1:]], once)
        np.testing.assert_array_equal(once, values)


def test_a_path_that_is_not_there_is_refused(networks, library) -> None:
    network = networks.random((2, 3, 4), 1, 2, 2, 1)
    sampler = PointSampler(PointTables.of_box(network, 0), path=3)
    with pytest.raises(MemoryError):
        sampler.evaluate([np.zeros(1)] * 4, np.empty(1, np.float32))
    assert best_path(library) == max(paths(library))
