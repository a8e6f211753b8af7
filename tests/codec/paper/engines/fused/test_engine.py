"""The kernels, emulated on the processor, train and evaluate what the naive engine does."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from pretended_cuda import CUDA, pretended_cuda
from readable_paper import FHash

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.devices import same_bits
from fhash_codec.paper.engines.fused import program as driver
from fhash_codec.paper.engines.fused.engine import (
    STATE,
    FusedEngine,
    FusedPoints,
    PointKernels,
    PointSizes,
    architecture_of,
    point_sizes,
    start_points,
)
from fhash_codec.paper.engines.parameters import LIBRARIES, needed_bytes
from fhash_codec.paper.model import PointSampler, PointTables
from fhash_codec.paper.network import ArrayTable
from fhash_formats.errors import FhashWarning, InputError

ORDERS = (0, 1, 5)
"""Orders of the threads: upwards, downwards, shuffled."""
CASES = [
    pytest.param((3, 7, 9, 20), {"hidden_layers": 1}, id="one hidden layer"),
    pytest.param((2, 9, 9, 13), {"hidden_layers": 2, "width": 20}, id="two, of an odd width"),
    pytest.param(
        (1, 9, 16, 16),
        {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
        id="one key frame, linear readout",
    ),
    pytest.param((3, 1, 33, 2), {"embedding_size": 3, "hidden_layers": 2}, id="thin axes"),
    pytest.param((2, 5, 1, 1), {"hidden_layers": 1}, id="a column"),
    pytest.param((2, 1, 1, 1), {"hidden_layers": 1}, id="one voxel, no coarse level"),
    pytest.param(
        (3, 20, 24, 40), {"hidden_layers": 1, "low": 0.9998}, id="a few vertices far apart"
    ),
    pytest.param(
        (6, 7, 9, 17), {"hidden_layers": 1, "keys": (0, 3, 5)}, id="steps between key frames"
    ),
    pytest.param(
        (4, 20, 24, 40),
        {"embedding_size": 3, "keys": (0, 3), "low": 0.9998},
        id="few vertices between key frames, two hidden layers",
    ),
    pytest.param(
        (7, 5, 9, 4),
        {"embedding_size": 1, "fold": 3, "keys": (0, 2, 6), "times": (3, 5, 1)},
        id="levels of more times than there are key frames, and of one",
    ),
    pytest.param(
        (3, 9, 9, 5),
        {"hidden_layers": 0, "keys": (0, 2), "times": (2,)},
        id="one step between key frames, one level",
    ),
]


def assert_close(ours, theirs, scale: float) -> None:
    """Median and count, not maximum: near a ReLU's kink float32 may take the other side."""
    for a, b in zip(ours, theirs, strict=True):
        if not a.size:
            continue
        # What no sample moved is 0 in ours and still at its start in the oracle's.
        apart = np.abs(a - b)[a != 0]
        assert np.median(apart) < 1e-3 * scale
        assert (apart > 0.1 * scale).mean() < 0.01


def parts(parameters):
    return parameters.fine, parameters.coarse, parameters.network


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_kernels_train_and_evaluate_as_the_oracle_does(engines_of, shape, settings) -> None:
    coreset, fused, native, oracle = engines_of(shape, settings, order=3)
    every = np.arange(len(coreset.bricks))
    np.testing.assert_allclose(fused.infer(every), oracle.infer(every), atol=2e-7)
    random = np.random.default_rng(1)
    for _ in range(15):
        chosen = random.permutation(len(every))[: max(1, len(every) // 3)]
        errors = [float(engine.train(chosen)) for engine in (fused, native, oracle)]
        assert errors[:2] == pytest.approx(errors[2:] * 2, rel=1e-3, abs=1e-6)
    unsettled = fused.infer(every[::-1].copy())
    assert_close([unsettled], [oracle.infer(every[::-1].copy())], 0.01)
    for other in (native, oracle):
        assert_close(parts(fused.parameters()), parts(other.parameters()), 0.01)
    settled = fused.infer(every[::-1].copy())
    np.testing.assert_allclose(settled, unsettled, atol=1e-6)


def trained(fused, coreset, steps: int = 3) -> list[np.ndarray]:
    """Errors, state and values after steps with bricks that have to catch up over many steps.

    All numbers are random, so that no neuron is idle everywhere.
    """
    every, random = np.arange(len(coreset.bricks)), torch.Generator().manual_seed(1)
    fused.restore(fused.state() | {"step": np.array(30), "visited": np.arange(len(every)) % 7})
    for numbers in (fused.fine, fused.flat, fused.fine_mean):
        numbers.normal_(generator=random)
    fused.fine_square.uniform_(generator=random)
    errors = [float(fused.train(every[step % 2 :])) for step in range(steps)]
    values = fused.infer(every)
    fused.settle()
    assert (fused.visited == fused._arrays["visited"].numpy()).all()
    return [np.array(errors), values, *(getattr(fused, name).numpy() for name in STATE)]


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize(("shape", "keys"), [((2, 9, 9, 13), ()), ((4, 9, 9, 13), (0, 3))])
def test_the_order_of_the_threads_changes_nothing(engines_of, shape, keys, deterministic) -> None:
    results = []
    with same_bits("cuda", deterministic):
        for order in ORDERS:
            coreset, fused, _, _ = engines_of(
                shape, {"hidden_layers": 2, "keys": keys}, order=order
            )
            results.append(trained(fused, coreset))
    assert ("sum_entries" in fused._program.launched) == deterministic
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


BETWEEN = (6, 7, 9, 17), {"hidden_layers": 1, "keys": (0, 3, 5)}
"""Shape and settings of a training with steps between key frames."""


@pytest.mark.parametrize(("shape", "settings"), [((3, 9, 10, 20), {"hidden_layers": 1}), BETWEEN])
def test_each_engine_goes_on_with_the_other_ones_state(engines_of, shape, settings) -> None:
    coreset, fused, native, _ = engines_of(shape, settings)
    _, straight, _, _ = engines_of(shape, settings)
    batches = np.random.default_rng(0).integers(0, len(coreset.bricks), (18, 1))
    for number, batch in enumerate(batches):
        straight.train(batch)
        engine, other = (native, fused) if number // 6 % 2 else (fused, native)
        engine.train(batch)
        if number % 6 == 5:
            other.restore({name: np.array(array) for name, array in engine.state().items()})
    ours, theirs = engine.state(), straight.state()
    for name, array in theirs.items():
        np.testing.assert_allclose(ours[name], array, atol=1e-4, err_msg=name)


def test_a_further_round_catches_up_at_its_own_rates(engines_of) -> None:
    coreset, fused, _, oracle = engines_of((3, 9, 10, 20), {"hidden_layers": 1}, steps=4)
    every = np.arange(len(coreset.bricks))
    for engine in (fused, oracle):
        for _ in range(4):
            engine.train(every)
        engine.rates = np.append(engine.rates, np.full(6, 0.1))
        for _ in range(6):
            engine.train(every[:1])
    fine = fused.parameters().fine, oracle.parameters().fine
    np.testing.assert_allclose(*fine, atol=1e-4)


@pytest.mark.parametrize(
    ("shape", "settings", "old", "new"),
    [
        ((3, 9, 10, 20), {"hidden_layers": 1}, "", ""),
        ((3, 9, 10, 20), {"hidden_layers": 1}, "0.999f", "0.9f"),
        (*BETWEEN, "", ""),
        (*BETWEEN, "weight * model.flat[second]", "model.flat[second]"),
    ],
    ids=["as they are", "a wrong step", "between key frames", "a wrong weight there"],
)
def test_new_kernels_are_tried_first(engines_of, shape, settings, old, new) -> None:
    if old:
        with pytest.raises(Unavailable, match="other results than native"):
            engines_of(shape, settings, new=True, change=lambda t: t.replace(old, new))
        return
    coreset, fused, native, _ = engines_of(shape, settings, new=True)
    assert fused._program.launched
    assert fused._program.kept
    begun = native.state()
    for name, array in fused.state().items():
        np.testing.assert_array_equal(array, begun[name], err_msg=name)
    every = np.arange(len(coreset.bricks))
    assert float(fused.train(every)) == pytest.approx(float(native.train(every)), rel=1e-3)


CPU = torch.device("cpu")
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


def assert_close_points(ours, theirs) -> None:
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
    assert_close_points(results[0][1], slopes)
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


@pytest.mark.parametrize("held", ["dense", "sparse"])
def test_tables_of_a_film_stay_on_the_device_while_their_time_nodes_do(
    emulated, networks, held
) -> None:
    network = networks.random((5, 13, 18), 4, 2, 2, 2)
    network = sparse(network)[0] if held == "sparse" else replace(network)
    places, key = torch.from_numpy(places_in(network)), KEY * 3
    with pretended_cuda() as pretended:
        kernels = PointKernels(emulated())
        copies, first = [], FusedPoints(network, key, device=CUDA, kernels=kernels)
        for at in (key, key + 0.05, key + 1.5, key):
            pretended.forget()
            points = FusedPoints(network, at, device=CUDA, kernels=kernels)
            copies.append(pretended.counts["copies"])
            alone = FusedPoints(network, at, device=CUDA, kernels=PointKernels(emulated()))
            there = places.to(CUDA)
            assert torch.equal(points.values(there), alone.values(there))
        # The records of the levels and the layers alone.
        assert copies[:2] == [2, 2]
        assert min(copies[2:]) > 2
        # A picture that is still drawn keeps what it needs.
        assert torch.equal(first.values(there), points.values(there))
        del network, points, alone, first
        assert kernels._tables is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("line[0] + after[0] * by[0]", "line[0]"),
        ("level.scale[a] * places.inverse[a]) * by[a]", "level.scale[a]) * by[a]"),
    ],
    ids=["values", "slopes"],
)
def test_new_kernels_are_tried_first_points(points_of, networks, old, new) -> None:
    network = networks.random((5, 13, 18), 4, 2, 2, 1)
    points = points_of(network, new=True)
    assert points._program.launched == ["values_at", "slopes_at"]
    assert points._program.kept
    assert not points._program.new

    def change(text):
        assert old in text
        return text.replace(old, new)

    with pytest.raises(Unavailable, match=r"other (values|slopes) than the host"):
        points_of(network, new=True, change=change)


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


@pytest.fixture
def encoded_on_cuda(tmp_path, monkeypatch, emulated):
    """A function: the figures of a series whose training asks for CUDA.

    An emulated device stands in for it, and torch's device is the CPU all the same.
    """
    original = FusedEngine.__init__

    def on_cpu(self, *arguments, device, **settings):
        original(self, *arguments, device=torch.device("cpu"), **settings)

    def encode(make=lambda device: emulated(), **changes):
        monkeypatch.setattr(torch.version, "cuda", "13.0")
        monkeypatch.setattr("fhash_codec.devices.has_device", lambda: True)
        monkeypatch.setattr(FusedEngine, "__init__", on_cpu)
        monkeypatch.setattr(driver, "CudaDevice", make)
        values = np.add.outer(
            np.sin(np.linspace(0, 3, 3)), np.random.default_rng(0).random((6, 7, 17))
        ).astype(np.float32)
        usual = {"epochs": 3, "width": 8, "device": "cuda", "tables": "float16"}
        config = EncodeConfig(preset="published", **usual | changes)
        with pretended_cuda():
            figures = fhash_codec.encode(values, tmp_path / "a.fhz", config)
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert np.isfinite(volume[:]).any()
            return figures | volume.info["training"]

    return encode


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"key_frames": "0,2"},
        {"tables": "transform"},
        {"tables": "auto", "psnr": 12.5, "epochs": 0},
    ],
    ids=str,
)
def test_a_series_is_encoded_on_the_device(encoded_on_cuda, monkeypatch, changes) -> None:
    for module in ("train", "fit"):
        monkeypatch.setattr(f"fhash_codec.paper.{module}.usual_epochs", lambda _: 3)
    figures = encoded_on_cuda(**changes)
    assert (figures["device"], figures["engine"]) == ("cuda", "fused")
    # A promise takes further rounds.
    assert (figures["epochs"] > 3) == ("psnr" in changes)


def without_nvrtc(device):
    """Stand in for a device where kernels cannot be compiled."""
    raise Unavailable("no NVRTC was found here\nand so on")


@pytest.mark.parametrize(
    ("changes", "limits", "reason"),
    [
        ({"embedding_size": 16, "fold": 2}, {}, r"has 80 inputs, and kernels .* do 64 at most"),
        ({"brick": "6x7x9"}, {"shared_per_block": 1 << 12}, "a brick of 6 x 7 x 9 .* more shared"),
        ({}, None, "no NVRTC was found here"),
    ],
)
def test_what_cuda_cannot_do_is_refused_or_left_to_the_cpu(
    encoded_on_cuda, emulated, monkeypatch, changes, limits, reason
) -> None:
    def make(device):
        return without_nvrtc(device) if limits is None else emulated(**limits)

    monkeypatch.setattr("fhash_codec.devices.CUDA_PAYS", 0.0)
    with pytest.raises(InputError, match=rf"{reason}.*; use --device cpu$") as error:
        encoded_on_cuda(make, **changes)
    assert "\n" not in str(error.value)
    figures = encoded_on_cuda(make, device="auto", **changes)
    assert (figures["device"], figures["engine"]) == ("cpu", "native")
    (why,) = [stage["why"] for stage in figures["stages"] if stage["stage"] == "engine"]
    assert re.search(f"on the CPU, as .*{reason}", why)


@pytest.mark.parametrize(
    ("shape", "settings"), [((3, 20, 24, 40), {}), ((4, 20, 24, 40), {"keys": (0, 3)})]
)
def test_a_training_needs_what_is_said(engines_of, shape, settings) -> None:
    coreset, fused, _, _ = engines_of(shape, settings)
    every = [each for each in vars(fused).values() if isinstance(each, torch.Tensor)]
    every += [each for each in fused._arrays.values() if each is not None]
    held = sum(each.nbytes for each in every)
    assert held < needed_bytes(fused.architecture, coreset) < LIBRARIES + 2 * held


class Cuda:
    """A device that claims to be CUDA; tensors are made on the CPU."""

    type = "cuda"


def test_points_that_the_kernels_cannot_do_are_left_to_torch_with_one_warning(
    networks, monkeypatch, emulated
) -> None:
    network, device = networks.random((5, 6, 7), 2, 2, 2, 3), Cuda()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", lambda device: emulated())
    with pytest.warns(
        FhashWarning, match="evaluated on the CPU, since .*: the network has 3 hidden"
    ):
        assert start_points(network, 0.5, device) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert start_points(network, 0.5, device) is None
