"""The neighbourhood head: the stated arithmetic, its packed bytes, and what is refused."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import asdict
from math import log2
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tiles import HIGH, LOW, random_head, random_tile

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.head import (
    INPUTS,
    MAX_WEIGHT,
    Layer,
    NeighbourHead,
    best_spread,
    decode_weights,
    encode_weights,
)


def test_a_strided_tile_gives_the_same_as_its_copy() -> None:
    tile = random_tile((2, 6, 8, 40))[:, ::2, :, ::3]
    assert random_head().apply(tile).tobytes() == random_head().apply(tile.copy()).tobytes()


@pytest.mark.parametrize("tile", [np.zeros((2, 2, 2), np.float32), np.zeros((1, 2, 2, 2))])
def test_other_tiles_are_refused(tile: npt.NDArray[Any]) -> None:
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
def test_bytes_there_and_back(hidden: tuple[int, ...], cross: bool) -> None:
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


def test_the_default_head_is_small() -> None:
    assert len(random_head(spread=12.0).to_bytes()) <= 530


@pytest.mark.parametrize("head", [random_head(), random_head((3, 4), cross=True)])
def test_damaged_bytes_are_refused_or_are_another_sound_head(head: NeighbourHead) -> None:
    data = head.to_bytes()
    for position in range(len(data)):
        for bit in (0, 7):
            damaged = bytearray(data)
            damaged[position] ^= 1 << bit
            with suppress(DamagedFileError):
                NeighbourHead.from_bytes(bytes(damaged))
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
def test_other_layers_under_a_cross_are_refused(start: bytes) -> None:
    rest = random_head((4, 4), cross=True).to_bytes()[3:]
    with pytest.raises(DamagedFileError, match=r"hidden layers|widths"):
        NeighbourHead.from_bytes(start + rest if len(start) > 2 else start)


@pytest.mark.parametrize(
    ("hidden", "message"),
    [((8,), "2 hidden layers"), ((8, 8, 8), "2 hidden layers"), ((15, 8), "15 outputs")],
)
def test_a_cross_needs_two_hidden_layers_and_exact_sums(
    hidden: tuple[int, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        random_head(hidden, cross=True)


@pytest.mark.parametrize("tail", [b"\0", b"\1", b"\xff" * 5000])
def test_longer_bytes_are_refused(tail: bytes) -> None:
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
def test_bad_heads_are_refused(change: dict[str, Any], message: str) -> None:
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
        {"weights": np.full((12, INPUTS), 32, np.int8)},
        {"weights": np.zeros((12, 27), np.int8)},
        {"weight_scale": 0.1},
        {"bias_scale": 0.0},
    ],
)
def test_bad_layers_are_refused(change: dict[str, Any]) -> None:
    head = random_head()
    fields = {**asdict(head.layers[0]), **change}
    with pytest.raises(InputError):
        NeighbourHead(
            layers=(Layer(**fields), *head.layers[1:]), sigma=head.sigma, low=LOW, high=HIGH
        )


def weights_of(spread: float, count: int = 300) -> list[int]:
    drawn = np.random.default_rng(4).normal(0, spread, count)
    return [int(weight) for weight in np.clip(np.rint(drawn), -MAX_WEIGHT, MAX_WEIGHT)]


@pytest.mark.parametrize("spread", [1, 8, 255])
def test_weights_pop_in_order_and_leave_the_state_before_them(spread: int) -> None:
    weights, before = weights_of(6.0), 12345
    state = encode_weights(before, weights, spread)
    assert decode_weights(state, 100, spread)[1] == weights[:100]
    assert decode_weights(state, len(weights), spread) == (before, weights)


@pytest.mark.parametrize("spread", [0.0, 0.4, 1.0, 3.0, 9.0, 31.0, 100.0])
@pytest.mark.parametrize("count", [0, 1, 7, 336])
def test_the_best_spread_is_the_first_of_the_fewest_bits(spread: float, count: int) -> None:
    weights = weights_of(spread, count)

    def frequency(spread: int, weight: int) -> int:
        return 1 + (spread**4 << 16) // (spread**2 + weight**2) ** 2

    def bits(spread: int) -> float:
        total = sum(frequency(spread, weight) for weight in range(-MAX_WEIGHT, MAX_WEIGHT + 1))
        counts = sorted(Counter(weights).items())
        return sum(count * log2(total / frequency(spread, weight)) for weight, count in counts)

    assert best_spread(weights) == min(range(1, 256), key=bits)


def test_a_spread_of_0_is_refused() -> None:
    with pytest.raises(ValueError, match="spread"):
        decode_weights(1, 1, 0)
