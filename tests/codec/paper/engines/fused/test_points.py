"""The kernels of points, emulated on the processor, give the values and slopes of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from pretended_cuda import CUDA, pretended_cuda
from readable_paper import FHash

from fhash_codec.paper.engines.fused.points import (
    FILES,
    FusedPoints,
    PointKernels,
    PointSizes,
    architecture_of,
    point_sizes,
)
from fhash_codec.paper.engines.fused.source import KERNELS, Unavailable
from fhash_codec.paper.network import ArrayTable
from fhash_codec.paper.points import PointSampler, PointTables

CPU = torch.device("cpu")
ORDERS = (0, 1, 5)
"""Orders of the threads: upwards, downwards, shuffled."""
KEY = 0.37
"""Share of the time of a series."""
LAYERS = [(16, 0), (16, 1), (16, 2), (64, 1), (64, 2), (128, 1), (128, 2)]
"""Widths and numbers of hidden layers."""


def sparse(network):
    """The same network with a third of its vertices, and one that holds the others as zeros."""
    from emulator import HeldTable

    random = np.random.default_rng(5)
    values = [
        table.values * (random.random((*table.shape[:4], 1)) < 0.3) for table in network.tables
    ]
    return tuple(
        replace(network, tables=[kind(part) for part in values]) for kind in (HeldTable, ArrayTable)
    )


@pytest.fixture
def points_of(emulated):
    """A function of a network and of settings of the device: the network on it."""

    def make(network, **settings):
        key = KEY * (network.key_frames - 1)
        kernels = PointKernels(emulated(**settings))
        return FusedPoints(network, key, device=CPU, kernels=kernels)

    return make


def places_in(network, count: int = 150):
    """Places (n, 3), x, y, z: random ones, vertices, and some on faces and corners of the box."""
    random, last = np.random.default_rng(2), np.array(network.box_size[::-1]) - 1.0
    inside = random.uniform(0, last, (count, 3))
    vertices = random.integers(0, last + 1, (30, 3)).astype(float)
    faces = np.where(
        random.random((30, 3)) < 0.4, random.choice([0, 1], (30, 3)) * last, inside[:30]
    )
    return np.concatenate([inside, vertices, faces, [0 * last, last]])


def evaluated(points, places):
    there = torch.from_numpy(places)
    return points.values(there).numpy(), points.slopes(there).numpy()


def on_host(network, places):
    """Values and slopes of the host."""
    key = KEY * (network.key_frames - 1)
    values, slopes = np.empty(len(places), np.float32), np.empty((len(places), 4), np.float32)
    x, y, z = places.T
    sampler = PointSampler(PointTables.of_box(network, key), key)
    sampler.sample((np.zeros(1), z, y, x), values, slopes, 1)
    return values, slopes[:, :0:-1]


def in_float64(network, places):
    """Values and slopes of the model in torch, in float64, by autograd."""
    model = FHash(
        architecture_of(network),
        [
            torch.from_numpy(table.values).double().reshape(-1, network.embedding_size)
            for table in network.tables
        ],
        [tuple(torch.from_numpy(part).double() for part in layer) for layer in network.layers],
    )
    times = np.full((len(places), 1), KEY * (network.key_frames - 1))
    points = torch.from_numpy(np.hstack([times, places[:, ::-1]])).requires_grad_()
    values = model(points)
    values.sum().backward()
    return values.detach().numpy(), points.grad.numpy()[:, :0:-1]


def assert_close(ours, theirs) -> None:
    """Most numbers, not all: near a ReLU's kink float32 may take the other side."""
    scale = np.abs(theirs).max()
    assert np.median(np.abs(ours - theirs)) <= 1e-6 * scale
    assert np.isclose(ours, theirs, rtol=1e-4, atol=1e-5 * scale).mean() > 0.98


@pytest.mark.parametrize("held", ["dense", "sparse"])
@pytest.mark.parametrize(("width", "layers"), LAYERS)
def test_values_and_slopes_are_the_oracles_in_every_order(
    points_of, networks, width, layers, held
) -> None:
    network = zeros = networks.random((5, 13, 18), 4, 2, 2, layers, width=width)
    if held == "sparse":
        network, zeros = sparse(network)
    # Autograd halves the slopes on the far faces of the box.
    places = places_in(network) * 0.999
    results = [evaluated(points_of(network, order=order), places) for order in ORDERS]
    values, slopes = in_float64(zeros, places)
    assert np.abs(results[0][0] - values).max() < 2e-5 * np.abs(values).max()
    assert_close(results[0][1], slopes)
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_boxes_and_embeddings_of_every_shape_give_the_values_of_the_host(
    points_of, network
) -> None:
    """Faces and vertices too: the slope there is that of the cell after, or the last."""
    for some in (network, sparse(network)[0]):
        places = places_in(some)
        values, slopes = on_host(some, places)
        ours = evaluated(points_of(some, order=3), places)
        np.testing.assert_allclose(ours[0], values, rtol=1e-5, atol=2e-5)
        assert np.isclose(ours[1], slopes, rtol=1e-4, atol=1e-4).mean() > 0.98
        flat = np.array(some.box_size[::-1]) == 1
        assert not ours[1][:, flat].any()


def test_float16_tables_of_one_key_frame_are_taken(points_of, networks) -> None:
    network = networks.random((5, 13, 18), 1, 2, 2, 1, dtype=np.float16)
    places = places_in(network)
    ours, theirs = evaluated(points_of(network), places), on_host(network, places)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-5, atol=1e-5)


def test_a_place_has_the_same_bits_in_any_pass(points_of, networks) -> None:
    network = networks.random((5, 13, 18), 4, 2, 2, 2, width=20)
    points, places = points_of(network), places_in(network)
    values, slopes = evaluated(points, places)
    random = np.random.default_rng(4)
    for count in (0, 1, 2, 31, 32, 33, 100):
        chosen = random.permutation(len(places))[:count]
        ours = evaluated(points, places[chosen])
        np.testing.assert_array_equal(ours[0], values[chosen])
        np.testing.assert_array_equal(ours[1], slopes[chosen])
    strided = np.repeat(places, 2, axis=0)[::2]
    np.testing.assert_array_equal(evaluated(points, strided)[0], values)


def test_a_call_is_one_launch_and_no_wait(emulated, networks) -> None:
    """Places that lie apart take a launch of torch more."""
    network = networks.random((5, 13, 18), 4, 2, 2, 2)
    expected = on_host(network, places_in(network))
    with pretended_cuda() as pretended:
        points = FusedPoints(network, KEY * 3, device=CUDA, kernels=PointKernels(emulated()))
        places = torch.from_numpy(places_in(network)).to(CUDA)
        pretended.forget()
        points._program.launched.clear()
        results = points.values(places), points.slopes(places)
        assert points._program.launched == ["values_at", "slopes_at"]
        assert not pretended.counts
        assert [result.device for result in results] == [CUDA, CUDA]
        points.values(places[::2])
        assert pretended.counts == {"launches": 1}
        ours = [result.cpu().numpy() for result in results]
    np.testing.assert_allclose(ours[0], expected[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("layers", [0, 2])
def test_every_barrier_is_needed_and_its_absence_is_found(points_of, networks, layers) -> None:
    """Without a barrier, some order of the threads gives other numbers, or none at all."""
    network = networks.random((5, 13, 18), 4, 2, 2, layers, width=20)
    places = places_in(network)

    def run(order, barrier):
        points = points_of(network, order=order)
        points._program.library.skip_barrier(barrier)
        try:
            return evaluated(points, places)
        except Unavailable:
            return None
        finally:
            points._program.library.skip_barrier(0)

    usual = run(0, 0)
    lines = points_of(network)._sizes.text().splitlines()
    begin = next(
        i for i, line in enumerate(lines) if line.startswith("__device__ inline void run_")
    )
    barriers = [
        number
        for number, line in enumerate(lines, 1)
        if number > begin and line.strip().startswith("__syncthreads()")
    ]
    kinds = {0: 4, 2: 8}
    seen = [
        barrier
        for barrier in barriers
        if any(
            result is None
            or any(not np.array_equal(a, b) for a, b in zip(result, usual, strict=True))
            for result in (run(order, barrier) for order in ORDERS)
        )
    ]
    # Those between hidden layers are not reached without any.
    assert len(barriers) == kinds[2]
    assert len(seen) == kinds[layers], [lines[number - 2] for number in set(barriers) - set(seen)]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("line[0] + after[0] * by[0]", "line[0]"),
        ("level.scale[a] * places.inverse[a]) * by[a]", "level.scale[a]) * by[a]"),
    ],
    ids=["values", "slopes"],
)
def test_new_kernels_are_tried_first(points_of, networks, old, new) -> None:
    network = networks.random((5, 13, 18), 4, 2, 2, 1)
    points = points_of(network, new=True)
    assert points._program.launched == ["values_at", "slopes_at"]
    assert not points._program.forgotten
    assert not points._program.new

    def change(text):
        assert old in text
        return text.replace(old, new)

    with pytest.raises(Unavailable, match=r"other (values|slopes) than the host"):
        points_of(network, new=True, change=change)


def test_kernels_are_loaded_once_for_networks_of_the_same_layers(emulated, networks) -> None:
    device, loaded = emulated(), []
    load = device.load
    device.load = lambda sizes: loaded.append(sizes) or load(sizes)
    kernels = PointKernels(device)
    for box, key in (((5, 13, 18), 0.0), ((5, 13, 18), 1.5), ((6, 14, 17), 1.5)):
        FusedPoints(networks.random(box, 4, 2, 2, 1), key, device=CPU, kernels=kernels)
    assert len(loaded) == 1
    FusedPoints(networks.random((5, 13, 18), 4, 2, 2, 2), 0.0, device=CPU, kernels=kernels)
    assert len(loaded) == 2


def test_a_kernel_that_cannot_be_launched_is_found_at_the_start(emulated, networks) -> None:
    device = emulated()
    load = device.load

    def broken(sizes):
        program = load(sizes)

        def launch(*_):
            raise Unavailable("a reason of this test")

        program.launch = launch
        return program

    device.load = broken
    with pytest.raises(Unavailable, match="a reason of this test"):
        FusedPoints(
            networks.random((5, 6, 7), 2, 2, 2, 1), 0.5, device=CPU, kernels=PointKernels(device)
        )


def test_layers_that_overflow_stay_so(points_of, networks) -> None:
    network = networks.random((2, 3, 4), 2, 2, 2, 2)
    huge = tuple((np.full_like(weight, 3e38), bias) for weight, bias in network.layers)
    points = points_of(replace(network, layers=huge))
    assert not np.isfinite(evaluated(points, np.array([[1.0, 1.0, 1.0]]))[0]).any()


def test_places_that_are_none_give_no_number(points_of, networks) -> None:
    """A march clips its places to the box; one that it could not clip must not be read beyond."""
    network = networks.random((5, 13, 18), 4, 2, 2, 1)
    places = np.array([[np.nan, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, np.nan, np.nan]])
    values, _ = evaluated(points_of(network), places)
    assert np.isnan(values).tolist() == [True, False, True]


def test_what_the_kernels_cannot_do_is_said(networks, emulated) -> None:
    limits = emulated().limits

    def sizes(network, limits=limits):
        return point_sizes(architecture_of(network), network.sparse, limits)

    network = networks.random((5, 6, 7), 2, 2, 2, 2)
    (first, second, last) = network.layers
    wide = (np.zeros((9, 16), np.float32), np.zeros(9, np.float32))
    uneven = (first, wide, (last[0][:, :9], last[1]))
    with pytest.raises(Unavailable, match="hidden layers of 16, 9"):
        sizes(replace(network, layers=uneven))
    with pytest.raises(Unavailable, match="3 hidden layers of 16"):
        sizes(replace(network, layers=(first, second, second, last)))
    with pytest.raises(Unavailable, match="2 hidden layers of 129"):
        sizes(networks.random((5, 6, 7), 2, 2, 2, 2, width=129))
    with pytest.raises(Unavailable, match="has 90 inputs"):
        sizes(networks.random((5, 6, 7), 2, 2, 30, 1))
    with pytest.raises(Unavailable, match="more shared memory than the 4096 bytes"):
        sizes(network, replace(limits, shared_per_block=4096))
    assert isinstance(sizes(network), PointSizes)


def test_the_text_is_that_of_the_sizes_and_the_files(networks, emulated) -> None:
    network = networks.random((5, 6, 7), 2, 2, 2, 2)
    text = point_sizes(architecture_of(network), True, emulated().limits).text()
    assert "constexpr bool SPARSE = true;" in text
    assert all((KERNELS / name).read_text() in text for name in FILES)
    assert "#include" not in text
