"""Integers coded by prediction: round trips, hostile bytes."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from predictors import Four, predictor_of

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform import predict
from fhash_formats.transform.coder import State, state_arguments
from fhash_formats.transform.predict import (
    MAX_PREDICTED_INTEGER,
    decode_predicted,
    encode_predicted,
    integers_of,
    pass_arrays,
    passes_of,
    values_of,
)

Shape = tuple[int, int, int, int]

SHAPES: list[Shape] = [
    (1, 1, 1, 1),
    (2, 1, 1, 1),
    (1, 1, 1, 2),
    (1, 2, 3, 5),
    (3, 7, 2, 11),
    (5, 4, 9, 8),
    (2, 13, 1, 17),
]


def _smooth(shape: Shape, scale: float = 40.0, seed: int = 0) -> npt.NDArray[np.int32]:
    axes = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    values = sum(np.sin(0.4 * (i + 1) * axis + seed) for i, axis in enumerate(axes)) * scale
    noise = np.random.default_rng(seed).normal(0, 1 + scale / 30, shape)
    return np.rint(values + noise * (axes[3] > 2)).astype(np.int32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("levels", "order", "reach"),
    [((2, 3, 3, 3), (0, 1, 2, 3), 1), ((0, 1, 2, 0), (3, 2, 1, 0), 2), ((0,) * 4, (0, 3, 2, 1), 0)],
)
def test_what_was_coded_comes_back(shape: Shape, levels: Four, order: Four, reach: int) -> None:
    predictor = predictor_of(levels, order, reach)
    integers = _smooth(shape)
    data, coded = encode_predicted(integers, None, predictor)
    np.testing.assert_array_equal(coded, integers)
    np.testing.assert_array_equal(decode_predicted(data, shape, predictor), integers)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e4, 3e7])
def test_from_nothing_to_the_largest(scale: float) -> None:
    integers = np.clip(
        _smooth((3, 5, 6, 21), scale), -MAX_PREDICTED_INTEGER, MAX_PREDICTED_INTEGER
    ).astype(np.int32)
    predictor = predictor_of()
    np.testing.assert_array_equal(
        decode_predicted(encode_predicted(integers, None, predictor)[0], integers.shape, predictor),
        integers,
    )


def test_both_ends_of_the_numbers() -> None:
    integers = np.random.default_rng(1).choice(
        np.array([-MAX_PREDICTED_INTEGER, 0, MAX_PREDICTED_INTEGER], dtype=np.int32), (3, 5, 6, 7)
    )
    predictor = replace(
        predictor_of(),
        weights=tuple(32767 if i % 2 else -32767 for i in range(len(predictor_of().weights))),
    )
    np.testing.assert_array_equal(
        decode_predicted(encode_predicted(integers, None, predictor)[0], integers.shape, predictor),
        integers,
    )


def test_prediction_pays_on_smooth_values() -> None:
    integers = np.rint(_smooth((8, 16, 24, 24), 0.0) + 300 * np.sin(np.arange(24) / 5)).astype(
        np.int32
    )
    noise = np.random.default_rng(0).permutation(integers.ravel()).reshape(integers.shape)
    plain = replace(predictor_of(), weights=(0,) * len(predictor_of().weights))
    assert (
        len(encode_predicted(integers, None, plain)[0])
        < len(encode_predicted(noise, None, plain)[0]) / 2
    )


def test_what_does_not_count_is_cheap_and_free() -> None:
    integers = _smooth((4, 6, 16, 16))
    counted = np.zeros(integers.shape, bool)
    counted[:, :, :8] = True
    predictor = predictor_of()
    data, coded = encode_predicted(integers, counted, predictor)
    np.testing.assert_array_equal(coded[counted], integers[counted])
    np.testing.assert_array_equal(decode_predicted(data, integers.shape, predictor), coded)
    assert len(data) < 0.7 * len(encode_predicted(integers, None, predictor)[0])


def test_hostile_bytes_give_integers_within_bounds_or_an_error() -> None:
    shape, generator, refused = (2, 3, 4, 9), np.random.default_rng(3), set()
    predictor = replace(
        predictor_of(),
        weights=tuple(generator.integers(-32767, 32768, len(predictor_of().weights)).tolist()),
    )
    for number in range(40):
        data = (
            bytes([0 if number % 2 else 255] * (number % 7))
            + generator.integers(0, 256, 60).astype(np.uint8).tobytes()
        )
        try:
            integers = decode_predicted(data, shape, predictor)
            assert np.abs(integers.astype(np.int64)).max() <= MAX_PREDICTED_INTEGER
            refused.add(False)
        except DamagedFileError:
            refused.add(True)
    assert False in refused


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8", "int64"])
def test_the_nearest_integers_keep_the_bound(dtype: str) -> None:
    values = (np.random.default_rng(4).random((3, 4, 5, 6)) * 200).astype(dtype)
    error = 3.0
    step = 2 * error * (1 - 1e-6) if values.dtype.kind == "f" else 2 * int(error) + 1.0
    predictor = predictor_of(step=step, origin=100.0)
    integers = integers_of(values, np.ones(values.shape, bool), predictor)
    assert integers is not None
    decoded = values_of(integers, predictor)
    decoded = decoded.astype(dtype) if values.dtype.kind == "f" else np.rint(decoded)
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= error


def test_integers_that_are_too_large_are_refused() -> None:
    values = np.array([0.0, 1e30, np.nan, np.inf]).reshape(1, 1, 1, 4)
    predictor = predictor_of()
    assert integers_of(values, np.isfinite(values), predictor) is None
    counted = np.array([True, False, False, False]).reshape(1, 1, 1, 4)
    integers = integers_of(values, counted, predictor)
    np.testing.assert_array_equal(integers, np.zeros((1, 1, 1, 4)))


def test_arguments_hold_the_arrays_that_they_point_to() -> None:
    """Threads may build a state at the same time; nothing but the arguments holds all but one."""
    arguments = state_arguments(
        State(
            slots=np.zeros((8, 4), np.uint16),
            weights=np.zeros(8, np.int32),
            simples=np.zeros((8, 2), np.uint16),
        )
    )
    arrays = [argument._arr for argument in arguments if isinstance(argument, ctypes.c_void_p)]
    assert [array.shape[0] for array in arrays] == [8, 8, 8]


def test_threads_that_decode_for_the_first_time_at_once() -> None:
    predictor, integers = predictor_of(), _smooth((3, 7, 2, 11))
    data, coded = encode_predicted(integers, None, predictor)
    with ThreadPoolExecutor(8) as workers:
        for _ in range(20):
            predict.blank_state.cache_clear()
            for decoded in workers.map(
                lambda _: decode_predicted(data, coded.shape, predictor), range(16)
            ):
                np.testing.assert_array_equal(decoded, coded)


@pytest.mark.parametrize(
    "change",
    [
        {"step": 0.0},
        {"step": "1"},
        {"origin": float("nan")},
        {"levels": (1, 2, 3)},
        {"levels": (1, 2, 3, 9)},
        {"levels": (1, 2, 3, True)},
        {"order": (0, 1, 2, 2)},
        {"reach": 3},
        {"reach": 1.0},
        {"weights": (1, 2)},
    ],
)
def test_a_bad_predictor_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(predictor_of(), **change)


def test_taps_are_known_when_they_are_needed() -> None:
    """Within a pass, taps come before the vertex in C order."""
    settings: list[tuple[Four, Four]] = [
        ((2, 2, 2, 2), (0, 1, 2, 3)),
        ((1, 2, 0, 2), (3, 1, 2, 0)),
    ]
    for levels, order in settings:
        for a_pass in passes_of(levels, order, 2):
            assert len(set(a_pass.taps)) == len(a_pass.taps)
            for in_pass, *offset in a_pass.taps:
                assert not in_pass or tuple(offset) < (0, 0, 0, 0)
                assert in_pass or a_pass.axis >= 0


def test_the_arrays_hold_the_taps_of_each_pass() -> None:
    predictor = predictor_of((1, 2, 0, 2), (3, 1, 2, 0), 1)
    rows, taps, weights = pass_arrays(predictor)
    assert len(taps) == len(weights) == len(predictor.weights)
    for (axis, kind, first, count), a_pass in zip(rows, predictor.passes, strict=True):
        assert (axis, kind) == (a_pass.axis, a_pass.kind)
        assert [tuple(tap) for tap in taps[first : first + count].tolist()] == list(a_pass.taps)
