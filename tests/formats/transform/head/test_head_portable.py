"""The portable head: the bits of the native one, and the logarithm of its inputs."""

from __future__ import annotations

import numpy as np
import pytest
from heads import HIGH, LOW, Floats, random_head, random_tile

from fhash_formats import native
from fhash_formats.support import threads
from fhash_formats.transform.head import head as head_module
from fhash_formats.transform.head.head import (
    MAX_CROSS_WIDTH,
    MAX_WEIGHT,
    Layer,
    NeighbourHead,
    layer_inputs,
)
from fhash_formats.transform.head.head_portable import compress


def both(
    head: NeighbourHead, tile: Floats, monkeypatch: pytest.MonkeyPatch
) -> tuple[Floats, Floats]:
    """The results of the native and of the portable head."""
    if native.library() is None:
        pytest.skip("the native library is not built")
    fast = head.apply(tile)
    with monkeypatch.context() as context:
        context.setenv("FHASH_NATIVE", "0")
        return fast, head.apply(tile)


def assert_same_bits(first: Floats, second: Floats) -> None:
    np.testing.assert_array_equal(first.view(np.int32), second.view(np.int32))


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize(
    "shape",
    [
        (1, 1, 1, 1),
        (2, 1, 3, 2),
        (1, 2, 1, 65),
        (3, 2, 1, 64),
        (5, 4, 3, 70),
        (1, 9, 9, 130),
        (4, 12, 5, 63),
        (2, 3, 300, 260),
    ],
)
def test_native_and_portable_give_the_same_bits(
    shape: tuple[int, ...], cross: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    tile = random_tile(shape)
    fast, slow = both(random_head(cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)


@pytest.mark.parametrize("lanes", [1, 2, 3, 4, 5])
@pytest.mark.parametrize(
    ("hidden", "cross"),
    [((12, 8), False), ((13, 7), False), ((64, 64, 64), False), ((4, 8), True), ((13, 5), True)],
)
def test_all_lanes_give_the_same_bits(
    hidden: tuple[int, ...], cross: bool, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    head, tile = random_head(hidden, cross=cross), random_tile((3, 4, 5, 85))
    _, slow = both(head, tile, monkeypatch)
    monkeypatch.setattr(head_module, "_WIDEST_LANES", lanes)
    try:
        assert_same_bits(head.apply(tile), slow)
    except MemoryError as error:
        pytest.skip(f"this machine has no such lanes: {error}")


@pytest.mark.parametrize("shape", [(3, 4, 5, 20), (2, 1, 17, 9), (3, 11, 1, 40), (1, 1, 2, 3)])
@pytest.mark.parametrize("cross", [False, True])
def test_parts_and_places_give_the_same_bits(
    cross: bool, shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    head, tile = random_head(cross=cross), random_tile(shape)
    _, slow = both(head, tile, monkeypatch)
    assert_same_bits(head.apply(tile.copy(), in_place=True), slow)
    monkeypatch.setattr(threads, "PART", 1)
    monkeypatch.setenv("FHASH_THREADS", "3")
    assert_same_bits(head.apply(tile, in_place=True), slow)


@pytest.mark.parametrize("hidden", [(1,), (13, 7), (64, 64, 64), (5, 3, 1)])
def test_every_width_gives_the_same_bits(
    hidden: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_same_bits(*both(random_head(hidden, seed=3), random_tile((2, 6, 7, 40)), monkeypatch))


@pytest.mark.parametrize("hidden", [(1, 1), (13, 7), (MAX_CROSS_WIDTH, 64)])
def test_every_width_of_a_cross_gives_the_same_bits(
    hidden: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_same_bits(
        *both(random_head(hidden, seed=3, cross=True), random_tile((4, 6, 7, 70)), monkeypatch)
    )


@pytest.mark.parametrize(
    ("hidden", "cross"), [((64, 64, 64), False), ((MAX_CROSS_WIDTH, 64), True)]
)
def test_the_largest_sums_are_exact(
    hidden: tuple[int, ...], cross: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    layers = []
    for inputs, outputs in zip(layer_inputs(hidden, cross), [*hidden, 1], strict=True):
        weights = np.full((outputs, inputs), MAX_WEIGHT, dtype=np.int8)
        layers.append(
            Layer(
                weights=weights,
                biases=np.full(outputs, 127, np.int8),
                weight_scale=1024.0,
                bias_scale=1024.0,
            )
        )
    head = NeighbourHead(layers=tuple(layers), sigma=2.0**-90, low=LOW, high=HIGH, cross=cross)
    assert_same_bits(*both(head, random_tile((2, 5, 6, 30)), monkeypatch))


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize(
    ("low", "high", "sigma"),
    [(0.0, 0.0, 1.0), (-3e38, 3e38, 1e-20), (0.0, 1e-44, 1e-20), (-1.0, 1.0, 1e30)],
)
def test_extreme_constants_and_values_give_the_same_bits(
    low: float, high: float, sigma: float, cross: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    low, high = float(np.float32(low)), float(np.float32(high))
    tile = random_tile((2, 6, 4, 20))
    tile[0, 0, 0, :6] = np.nan, np.inf, -np.inf, -0.0, 3e38, -3e38
    fast, slow = both(random_head(sigma=sigma, low=low, high=high, cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)
    assert fast.min() >= low
    assert fast.max() <= high


@pytest.mark.parametrize("cross", [False, True])
def test_a_constant_tile_stays_constant_and_costs_no_differences(
    cross: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = random_head(cross=cross)
    tile = np.full((3, 4, 5, 200), 0.5, dtype=np.float32)
    fast, slow = both(head, tile, monkeypatch)
    assert_same_bits(fast, slow)
    assert len(np.unique(fast)) == 1
    assert fast[0, 0, 0, 0] != tile[0, 0, 0, 0]


@pytest.mark.parametrize("cross", [False, True])
def test_a_nearly_constant_tile_is_short_cut_with_the_same_bits(
    cross: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(5)
    tile = (0.5 + 1e-5 * random.normal(size=(3, 6, 7, 150))).astype(np.float32)
    fast, slow = both(random_head(sigma=0.3, cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)


@pytest.mark.parametrize("axis", range(4))
def test_plateaus_that_meet_give_the_same_bits(axis: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole blocks are flat; a cross at their border reaches another plateau or a rough block."""
    shape = (7, 9, 10, 260)
    along = (
        np.arange(shape[axis]).reshape([-1 if number == axis else 1 for number in range(4)])
        / shape[axis]
    )
    tile = np.broadcast_to(np.where(along < 0.5, 0.25, 1.5), shape).astype(np.float32)
    rough = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    fast, slow = both(random_head(cross=True), np.where(along > 0.8, rough, tile), monkeypatch)
    assert_same_bits(fast, slow)


def test_the_logarithm_is_monotone_and_odd() -> None:
    values = np.sort(np.random.default_rng(0).normal(size=4000).astype(np.float32) * 100)
    compressed = compress(values)
    assert (np.diff(compressed) >= 0).all()
    np.testing.assert_array_equal(compress(-values), -compressed)
    np.testing.assert_array_equal(
        compress(np.array([1, 3, 1e30, np.inf], np.float32)), [512, 1024, 4095, 4095]
    )
