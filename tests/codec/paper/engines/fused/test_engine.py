"""The kernels, emulated on the processor, train and evaluate what the naive engine does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from engine_checks import assert_gradient_of_autograd

from fhash_codec.paper.engines.fused.source import Unavailable
from fhash_codec.paper.engines.slab import STATE

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
]
WIDE = [
    pytest.param({"width": 128, "hidden_layers": 1}, {"threads": 128, "columns": (64,)}, id="128"),
    pytest.param({"width": 64, "hidden_layers": 2}, {"threads": 256, "columns": (128,)}, id="64x2"),
    pytest.param(
        {"width": 128, "hidden_layers": 2},
        {"threads": 256, "columns": (32,), "shared_per_block": 120 << 10},
        id="128x2, sums in the device's memory",
    ),
    pytest.param({"width": 1, "hidden_layers": 2}, {}, id="one neuron"),
]
"""Models, and devices for them."""


def assert_close(ours, theirs, scale: float) -> None:
    """Median and count, not maximum: near a ReLU's kink float32 may take the other side."""
    for a, b in zip(ours, theirs, strict=True):
        if not a.numel():
            continue
        # What no sample moved is 0 in ours and still at its start in the oracle's.
        apart = (a - b)[a != 0].abs()
        assert float(apart.median()) < 1e-3 * scale
        assert float((apart > 0.1 * scale).double().mean()) < 0.01


def parts(parameters):
    return parameters.fine, parameters.coarse, parameters.network


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_kernels_train_and_evaluate_as_the_oracle_does(engines_of, shape, settings) -> None:
    coreset, fused, _, oracle = engines_of(shape, settings, order=3)
    every = np.arange(len(coreset.bricks))
    np.testing.assert_allclose(fused.infer(every).numpy(), oracle.infer(every).numpy(), atol=2e-7)
    random = np.random.default_rng(1)
    for _ in range(15):
        chosen = random.permutation(len(every))[: max(1, len(every) // 3)]
        error = float(fused.train(chosen))
        assert error == pytest.approx(float(oracle.train(chosen)), rel=1e-3, abs=1e-6)
    unsettled = fused.infer(every[::-1].copy()).numpy()
    assert_close([torch.from_numpy(unsettled)], [oracle.infer(every[::-1].copy())], 0.01)
    assert_close(parts(fused.parameters()), parts(oracle.parameters()), 0.01)
    settled = fused.infer(every[::-1].copy()).numpy()
    np.testing.assert_allclose(settled, unsettled, atol=1e-6)


@pytest.mark.parametrize(("settings", "sizes"), WIDE)
def test_gradients_equal_those_of_autograd_in_float64(engines_of, settings, sizes) -> None:
    coreset, fused, _, oracle = engines_of((2, 9, 9, 13), settings, **sizes)
    bricks = np.arange(len(coreset.bricks))
    fused.train(bricks)
    oracle.train(bricks)
    # The mean of the gradients after the first step is a tenth of the first one.
    assert_gradient_of_autograd(10 * fused.flat_mean, fused.upsampling.used, oracle)
    assert not fused.gradient.any()


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
    assert (fused.visited == fused._visited.numpy()).all()
    return [np.array(errors), values.numpy(), *(getattr(fused, name).numpy() for name in STATE)]


def test_the_order_of_the_threads_changes_nothing(engines_of) -> None:
    results = []
    for order in (0, 1, 5):
        coreset, fused, _, _ = engines_of((2, 9, 9, 13), {"hidden_layers": 2}, order=order)
        results.append(trained(fused, coreset))
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def within_the_rows(text: str) -> str:
    """The kernels with places of finest embeddings that stay in their rows.

    A missing barrier makes them wrong, and wrong ones would destroy other memory.
    """
    place = "e * model.fine_row + brick.offset + samples_before(model, brick, samples, vertex)"
    within = place.replace("brick.offset + ", "(brick.offset + (unsigned)") + ") % model.fine_row"
    assert place in text
    return text.replace(place, within)


def test_every_barrier_is_needed_and_its_absence_is_found(engines_of) -> None:
    """Without a barrier, some order of the threads gives other numbers, or none at all."""

    def run(order, barrier):
        coreset, fused, _, _ = engines_of(
            (2, 9, 9, 13), {"hidden_layers": 2}, order=order, change=within_the_rows
        )
        fused._program.library.skip_barrier(barrier)
        try:
            return fused._sizes.text(), trained(fused, coreset)
        except Unavailable:
            return "", None
        finally:
            fused._program.library.skip_barrier(0)

    def differs(numbers):
        return numbers is None or any(
            not np.allclose(ours, theirs, rtol=1e-4, atol=1e-4 * np.abs(theirs).max())
            for ours, theirs in zip(numbers, usual, strict=True)
        )

    text, usual = run(0, 0)
    barriers = [
        number
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip().startswith("__syncthreads()")
    ]
    assert len(barriers) > 20
    unseen = [b for b in barriers if not any(differs(run(order, b)[1]) for order in (0, 1, 5))]
    assert not unseen, [text.splitlines()[number - 2] for number in unseen]


def test_coarse_gradients_are_the_same_in_a_fixed_order(engines_of) -> None:
    states, launched = [], []
    for deterministic in (False, True):
        coreset, fused, _, _ = engines_of((3, 9, 20, 35), {"hidden_layers": 1})
        torch.use_deterministic_algorithms(deterministic)
        try:
            fused.train(np.arange(len(coreset.bricks)))
        finally:
            torch.use_deterministic_algorithms(False)
        states.append(fused.flat_mean.clone())
        launched.append(fused._program.launched)
    assert launched[0] == ["train_bricks", "move_flat"]
    assert launched[1] == ["train_bricks", "sum_entries", "move_flat"]
    assert states[0][: fused.coarse].abs().max() > 0
    np.testing.assert_allclose(states[0], states[1], atol=1e-6 * float(states[0].abs().max()))


def test_each_engine_goes_on_with_the_other_ones_state(engines_of) -> None:
    coreset, fused, slab, _ = engines_of((3, 9, 10, 20), {"hidden_layers": 1})
    _, straight, _, _ = engines_of((3, 9, 10, 20), {"hidden_layers": 1})
    batches = np.random.default_rng(0).integers(0, len(coreset.bricks), (18, 1))
    for number, batch in enumerate(batches):
        straight.train(batch)
        engine, other = (slab, fused) if number // 6 % 2 else (fused, slab)
        engine.train(batch)
        if number % 6 == 5:
            other.restore({name: np.array(array) for name, array in engine.state().items()})
    ours, theirs = engine.state(), straight.state()
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        np.testing.assert_allclose(array, theirs[name], atol=1e-4, err_msg=name)


@pytest.mark.parametrize("faulty", [False, True])
def test_new_kernels_are_tried_first(engines_of, faulty) -> None:
    shape, settings = (3, 9, 10, 20), {"hidden_layers": 1}
    if faulty:
        with pytest.raises(Unavailable, match="other results than slab"):
            engines_of(shape, settings, new=True, change=lambda t: t.replace("0.999f", "0.9f"))
        return
    coreset, fused, slab, _ = engines_of(shape, settings, new=True)
    assert fused._program.launched
    assert not fused._program.forgotten
    for name, array in fused.state().items():
        np.testing.assert_array_equal(array, slab.state()[name], err_msg=name)
    every = np.arange(len(coreset.bricks))
    assert float(fused.train(every)) == pytest.approx(float(slab.train(every)), rel=1e-6)


def test_tiles_without_samples_are_passed_over(engines_of) -> None:
    coreset, fused, slab, _ = engines_of((2, 8, 8, 16), {"hidden_layers": 1, "low": 0.99})
    rows = fused._sizes.tile_rows * coreset.brick_shape[2]
    masks = np.unpackbits(coreset.mask_bits, axis=1)[:, : fused.vertices]
    starts = np.arange(0, fused.vertices, rows)
    full = np.add.reduceat(masks.astype(int), starts, axis=1) > 0
    assert 0 < full.sum() < full.size
    every = np.arange(len(coreset.bricks))
    for engine in (fused, slab):
        engine.fine_mean.fill_(0.1)
        engine.fine_square.fill_(0.01)
        engine.train(every)
    np.testing.assert_allclose(fused.fine, slab.fine, atol=1e-7)
