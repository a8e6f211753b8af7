"""The neighbourhood head: equal bits native and portable, the stated arithmetic, and its bytes."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.head.head import (
    MAX_CROSS_WIDTH,
    MAX_WEIGHT,
    Layer,
    NeighbourHead,
    layer_inputs,
)
from fhash_formats.transform.head.head_portable import compress
from fhash_formats.transform.head.inputs import CROSS, FEATURES, STEPS

LOW, HIGH = float(np.float32(-1.25)), float(np.float32(2.7))


def random_head(hidden=(12, 8), seed=0, sigma=0.1, low=LOW, high=HIGH, spread=8.0, cross=False):
    random = np.random.default_rng(seed)
    layers = []
    for inputs, outputs in zip(layer_inputs(hidden, cross), [*hidden, 1], strict=True):
        weights = np.rint(
            np.clip(random.normal(size=(outputs, inputs)) * spread, -MAX_WEIGHT, MAX_WEIGHT)
        ).astype(np.int8)
        biases = random.integers(-127, 128, outputs).astype(np.int8)
        layers.append(
            Layer(
                weights=weights,
                biases=biases,
                weight_scale=float(np.float16(0.02)),
                bias_scale=float(np.float16(0.003)),
            )
        )
    return NeighbourHead(
        layers=tuple(layers), sigma=float(np.float32(sigma)), low=low, high=high, cross=cross
    )


def random_tile(shape, seed=1):
    """Noise with plateaus at both ends of the clip range and constant stretches inside it."""
    tile = np.random.default_rng(seed).normal(size=shape).astype(np.float32) * 2
    if shape[1] > 4:
        tile[:, : shape[1] // 2] = np.float32(0.3)
        tile[0, -2:] = 0.0
    return tile


def both(head, tile, monkeypatch):
    if native.library() is None:
        pytest.skip("the native library is not built")
    fast = head.apply(tile)
    with monkeypatch.context() as context:
        context.setenv("FHASH_NATIVE", "0")
        return fast, head.apply(tile)


def assert_same_bits(first, second):
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
def test_native_and_portable_give_the_same_bits(shape, cross, monkeypatch):
    tile = random_tile(shape)
    fast, slow = both(random_head(cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)


@pytest.mark.parametrize("hidden", [(1,), (13, 7), (64, 64, 64), (5, 3, 1)])
def test_every_width_gives_the_same_bits(hidden, monkeypatch):
    assert_same_bits(*both(random_head(hidden, seed=3), random_tile((2, 6, 7, 40)), monkeypatch))


@pytest.mark.parametrize("hidden", [(1, 1), (13, 7), (MAX_CROSS_WIDTH, 64)])
def test_every_width_of_a_cross_gives_the_same_bits(hidden, monkeypatch):
    assert_same_bits(
        *both(random_head(hidden, seed=3, cross=True), random_tile((4, 6, 7, 70)), monkeypatch)
    )


@pytest.mark.parametrize(
    ("hidden", "cross"), [((64, 64, 64), False), ((MAX_CROSS_WIDTH, 64), True)]
)
def test_the_largest_sums_are_exact(hidden, cross, monkeypatch):
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
def test_extreme_constants_and_values_give_the_same_bits(low, high, sigma, cross, monkeypatch):
    low, high = float(np.float32(low)), float(np.float32(high))
    tile = random_tile((2, 6, 4, 20))
    tile[0, 0, 0, :6] = np.nan, np.inf, -np.inf, -0.0, 3e38, -3e38
    fast, slow = both(random_head(sigma=sigma, low=low, high=high, cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)
    assert fast.min() >= low
    assert fast.max() <= high


@pytest.mark.parametrize("cross", [False, True])
def test_a_constant_tile_stays_constant_and_costs_no_differences(cross, monkeypatch):
    head = random_head(cross=cross)
    tile = np.full((3, 4, 5, 200), 0.5, dtype=np.float32)
    fast, slow = both(head, tile, monkeypatch)
    assert_same_bits(fast, slow)
    assert len(np.unique(fast)) == 1
    assert fast[0, 0, 0, 0] != tile[0, 0, 0, 0]


@pytest.mark.parametrize("cross", [False, True])
def test_a_nearly_constant_tile_takes_the_short_way_with_the_same_bits(cross, monkeypatch):
    random = np.random.default_rng(5)
    tile = (0.5 + 1e-5 * random.normal(size=(3, 6, 7, 150))).astype(np.float32)
    fast, slow = both(random_head(sigma=0.3, cross=cross), tile, monkeypatch)
    assert_same_bits(fast, slow)


@pytest.mark.parametrize("axis", range(4))
def test_plateaus_that_meet_give_the_same_bits(axis, monkeypatch):
    """Whole blocks are flat, and a cross at their border reaches into another plateau or a rough block."""
    shape = (7, 9, 10, 260)
    along = (
        np.arange(shape[axis]).reshape([-1 if number == axis else 1 for number in range(4)])
        / shape[axis]
    )
    tile = np.broadcast_to(np.where(along < 0.5, 0.25, 1.5), shape).astype(np.float32)
    rough = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    fast, slow = both(random_head(cross=True), np.where(along > 0.8, rough, tile), monkeypatch)
    assert_same_bits(fast, slow)


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("environment", ["0", "1"])
def test_the_arithmetic_is_the_stated_one(environment, cross, monkeypatch):
    """Voxel by voxel in float64, from the definition: equal up to the rounding of features and activations."""
    monkeypatch.setenv("FHASH_NATIVE", environment)
    head = random_head(seed=7, spread=8.0 if cross else 16.0, cross=cross)
    tile = np.random.default_rng(2).uniform(-1, 2.5, (3, 4, 5, 9)).astype(np.float32)
    hidden, expected = np.empty((*tile.shape, head.hidden[0])), np.empty(tile.shape)

    def moved(at, step):
        return tuple(
            min(max(i + s, 0), size - 1) for i, s, size in zip(at, step, tile.shape, strict=True)
        )

    def outputs(layer, inputs, leaky=True):
        values = (
            layer.weight_scale * (layer.weights.astype(float) @ inputs)
            + layer.bias_scale * layer.biases
        )
        return np.where(values > 0, values, values / 8) if leaky else values

    def logarithm(d):
        exponent = np.floor(np.log2(1 + abs(d)))
        return np.copysign(exponent + (1 + abs(d)) / 2**exponent - 1, d)

    for at in np.ndindex(tile.shape):
        centre = float(tile[at])
        inputs = [
            logarithm((float(tile[moved(at, step)]) - centre) / (2 * head.sigma)) for step in STEPS
        ]
        inputs += [
            2 * (centre - LOW) / (HIGH - LOW) - 1,
            logarithm((centre - LOW) / (2 * head.sigma)),
        ]
        hidden[at] = outputs(head.layers[0], np.array(inputs))
    for at in np.ndindex(tile.shape):
        seen = np.array([hidden[moved(at, step)] for step in (CROSS if cross else CROSS[:1])])
        correction = outputs(head.layers[2], outputs(head.layers[1], seen.T.ravel()), leaky=False)[
            0
        ]
        expected[at] = np.clip(tile[at] + head.sigma * correction, LOW, HIGH)
    np.testing.assert_allclose(head.apply(tile), expected, atol=0.02 * head.sigma)
    assert np.abs(expected - tile).max() > head.sigma  # the comparison is about something


def test_the_logarithm_is_monotone_and_odd():
    values = np.sort(np.random.default_rng(0).normal(size=4000).astype(np.float32) * 100)
    compressed = compress(values)
    assert (np.diff(compressed) >= 0).all()
    np.testing.assert_array_equal(compress(-values), -compressed)
    np.testing.assert_array_equal(
        compress(np.array([1, 3, 1e30, np.inf], np.float32)), [512, 1024, 4095, 4095]
    )


def test_neighbours_are_26_and_lie_in_opposite_pairs():
    assert len(STEPS) == len(set(STEPS)) == 26
    assert {tuple(-s for s in step) for step in STEPS} == set(STEPS)


def test_the_cross_is_the_voxel_and_one_step_either_way_along_each_axis():
    axes = [
        tuple(sign * (number == axis) for number in range(4))
        for axis in range(4)
        for sign in (-1, 1)
    ]
    assert ((0, 0, 0, 0), *axes) == CROSS


def test_a_strided_tile_gives_the_same_as_its_copy():
    tile = random_tile((2, 6, 8, 40))[:, ::2, :, ::3]
    assert_same_bits(random_head().apply(tile), random_head().apply(tile.copy()))


@pytest.mark.parametrize("tile", [np.zeros((2, 2, 2), np.float32), np.zeros((1, 2, 2, 2))])
def test_other_tiles_are_refused(tile):
    with pytest.raises(InputError, match="float32 tile"):
        random_head().apply(tile)


@pytest.mark.parametrize(
    ("hidden", "cross"),
    [
        ((12, 8), False),
        ((1,), False),
        ((24, 12), False),
        ((64, 64, 64), False),
        ((8, 8), True),
        ((14, 64), True),
    ],
)
def test_bytes_there_and_back(hidden, cross):
    head = random_head(hidden, cross=cross)
    assert head.to_bytes()[0] == (0x82 if cross else len(hidden))
    again = NeighbourHead.from_bytes(head.to_bytes())
    assert again.cross == cross
    assert (again.hidden, again.sigma, again.low, again.high) == (
        head.hidden,
        head.sigma,
        head.low,
        head.high,
    )
    for first, second in zip(head.layers, again.layers, strict=True):
        np.testing.assert_array_equal(first.weights, second.weights)
        np.testing.assert_array_equal(first.biases, second.biases)
        assert (first.weight_scale, first.bias_scale) == (second.weight_scale, second.bias_scale)


def test_the_default_head_is_small():
    assert len(random_head(spread=12.0).to_bytes()) <= 530


@pytest.mark.parametrize("head", [random_head(), random_head((3, 4), cross=True)])
def test_damaged_bytes_are_refused_or_are_another_sound_head(head):
    data = head.to_bytes()
    for position in range(len(data)):
        for bit in (0, 7):
            damaged = bytearray(data)
            damaged[position] ^= 1 << bit
            try:
                head = NeighbourHead.from_bytes(bytes(damaged))
            except DamagedFileError:
                continue
            assert head.to_bytes() == bytes(damaged)
    for length in range(len(data)):
        with pytest.raises(DamagedFileError):
            NeighbourHead.from_bytes(data[:length])


@pytest.mark.parametrize(
    "start",
    [
        b"\x80",
        b"\x81",
        b"\x83\x04\x04\x04",
        b"\x82\x04",
        b"\x82\x0f\x04",
        b"\x82\x04\x41",
        b"\x82\x00\x04",
    ],
)
def test_other_layers_under_a_cross_are_refused(start):
    rest = random_head((4, 4), cross=True).to_bytes()[3:]
    with pytest.raises(DamagedFileError, match=r"hidden layers|widths"):
        NeighbourHead.from_bytes(start + rest if len(start) > 2 else start)


@pytest.mark.parametrize(
    ("hidden", "message"),
    [((8,), "2 hidden layers"), ((8, 8, 8), "2 hidden layers"), ((15, 8), "15 outputs")],
)
def test_a_cross_needs_two_hidden_layers_and_exact_sums(hidden, message):
    with pytest.raises(InputError, match=message):
        random_head(hidden, cross=True)


@pytest.mark.parametrize("tail", [b"\0", b"\1", b"\xff" * 5000])
def test_longer_bytes_are_refused(tail):
    with pytest.raises(DamagedFileError):
        NeighbourHead.from_bytes(random_head().to_bytes() + tail)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": 0.0}, "sigma"),
        ({"sigma": float("nan")}, "finite"),
        ({"sigma": 0.1}, "float32"),
        ({"low": 3.0}, "low <= high"),
        ({"high": float("inf")}, "finite"),
        ({"layers": ()}, "hidden layers"),
    ],
)
def test_bad_heads_are_refused(change, message):
    head = random_head()
    with pytest.raises(InputError, match=message):
        NeighbourHead(
            **{
                "layers": head.layers,
                "sigma": head.sigma,
                "low": head.low,
                "high": head.high,
                **change,
            }
        )


@pytest.mark.parametrize(
    "change",
    [
        {"weights": np.full((12, FEATURES), 32, np.int8)},
        {"weights": np.zeros((12, 27), np.int8)},
        {"weight_scale": 0.1},
        {"bias_scale": 0.0},
    ],
)
def test_bad_layers_are_refused(change):
    head = random_head()
    fields = {**asdict(head.layers[0]), **change}
    with pytest.raises(InputError):
        NeighbourHead(
            layers=(Layer(**fields), *head.layers[1:]), sigma=head.sigma, low=LOW, high=HIGH
        )
