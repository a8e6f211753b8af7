"""Integers coded by prediction: what comes back, the same bytes without the native library, and hostile bytes."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy import predict
from fhash_formats.transform.entropy.coder import state_arguments
from fhash_formats.transform.entropy.predict import (
    MAX_PREDICTED_INTEGER,
    decode_predicted,
    encode_predicted,
    integers_of,
    values_of,
)
from fhash_formats.transform.entropy.predictor import Predictor, passes_of
from fhash_formats.transform.entropy.prior import State

SHAPES = [
    (1, 1, 1, 1),
    (2, 1, 1, 1),
    (1, 1, 1, 2),
    (1, 2, 3, 5),
    (3, 7, 2, 11),
    (5, 4, 9, 8),
    (2, 13, 1, 17),
]
NATIVE = pytest.mark.skipif(native.library() is None, reason="compares with the native library")


def _predictor(levels=(2, 3, 3, 3), order=(0, 1, 2, 3), reach=1, seed=0, step=1.0, origin=0.0):
    count = sum(len(part.taps) for part in passes_of(levels, order, reach))
    weights = np.random.default_rng(seed).integers(-300, 301, count)
    return Predictor(
        step=step,
        origin=origin,
        levels=levels,
        order=order,
        reach=reach,
        weights=tuple(weights.tolist()),
    )


def _smooth(shape, scale=40.0, seed=0):
    axes = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    values = sum(np.sin(0.4 * (i + 1) * axis + seed) for i, axis in enumerate(axes)) * scale
    noise = np.random.default_rng(seed).normal(0, 1 + scale / 30, shape)
    return np.rint(values + noise * (axes[3] > 2)).astype(np.int32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("levels", "order", "reach"),
    [((2, 3, 3, 3), (0, 1, 2, 3), 1), ((0, 1, 2, 0), (3, 2, 1, 0), 2), ((0,) * 4, (0, 3, 2, 1), 0)],
)
def test_what_was_coded_comes_back(shape, levels, order, reach):
    predictor = _predictor(levels, order, reach)
    integers = _smooth(shape)
    data, coded = encode_predicted(integers, None, predictor)
    np.testing.assert_array_equal(coded, integers)
    np.testing.assert_array_equal(decode_predicted(data, shape, predictor), integers)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e4, 3e7])
def test_from_nothing_to_the_largest(scale):
    integers = np.clip(
        _smooth((3, 5, 6, 21), scale), -MAX_PREDICTED_INTEGER, MAX_PREDICTED_INTEGER
    ).astype(np.int32)
    predictor = _predictor()
    np.testing.assert_array_equal(
        decode_predicted(encode_predicted(integers, None, predictor)[0], integers.shape, predictor),
        integers,
    )


def test_both_ends_of_the_numbers():
    integers = np.random.default_rng(1).choice(
        np.array([-MAX_PREDICTED_INTEGER, 0, MAX_PREDICTED_INTEGER], dtype=np.int32), (3, 5, 6, 7)
    )
    predictor = replace(
        _predictor(),
        weights=tuple(32767 if i % 2 else -32767 for i in range(len(_predictor().weights))),
    )
    np.testing.assert_array_equal(
        decode_predicted(encode_predicted(integers, None, predictor)[0], integers.shape, predictor),
        integers,
    )


def test_a_constant_costs_next_to_nothing():
    integers = np.full((8, 16, 32, 32), 7, dtype=np.int32)
    assert len(encode_predicted(integers, None, _predictor())[0]) < 60


def test_prediction_pays_on_smooth_values():
    integers = np.rint(_smooth((8, 16, 24, 24), 0.0) + 300 * np.sin(np.arange(24) / 5)).astype(
        np.int32
    )
    noise = np.random.default_rng(0).permutation(integers.ravel()).reshape(integers.shape)
    plain = replace(_predictor(), weights=(0,) * len(_predictor().weights))
    assert (
        len(encode_predicted(integers, None, plain)[0])
        < len(encode_predicted(noise, None, plain)[0]) / 2
    )


def test_what_does_not_count_is_cheap_and_free():
    integers = _smooth((4, 6, 16, 16))
    care = np.zeros(integers.shape, bool)
    care[:, :, :8] = True
    predictor = _predictor()
    data, coded = encode_predicted(integers, care, predictor)
    np.testing.assert_array_equal(coded[care], integers[care])
    np.testing.assert_array_equal(decode_predicted(data, integers.shape, predictor), coded)
    assert len(data) < 0.7 * len(encode_predicted(integers, None, predictor)[0])


@NATIVE
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("scale", "reach", "order"),
    [(0.5, 0, (0, 1, 2, 3)), (30.0, 1, (0, 3, 2, 1)), (4000.0, 2, (3, 2, 1, 0))],
)
def test_without_the_native_library_the_bytes_are_the_same(monkeypatch, shape, scale, reach, order):
    integers = _smooth(shape, scale)
    care = np.random.default_rng(2).random(shape) < 0.8
    predictor = _predictor((1, 2, 3, 2), order, reach)
    wanted = [encode_predicted(integers, marks, predictor) for marks in (None, care)]
    monkeypatch.setenv("FHASH_NATIVE", "0")
    for (data, coded), marks in zip(wanted, (None, care), strict=True):
        other, result = encode_predicted(integers, marks, predictor)
        assert other == data
        np.testing.assert_array_equal(result, coded)
        np.testing.assert_array_equal(decode_predicted(data, shape, predictor), coded)


@NATIVE
def test_hostile_bytes_end_the_same_way_everywhere(monkeypatch):
    """Whatever the bytes: integers within bounds or an error, and native and portable agree."""
    shape, generator, found = (2, 3, 4, 9), np.random.default_rng(3), set()
    predictor = replace(
        _predictor(),
        weights=tuple(generator.integers(-32767, 32768, len(_predictor().weights)).tolist()),
    )
    for number in range(40):
        data = (
            bytes([0 if number % 2 else 255] * (number % 7))
            + generator.integers(0, 256, 60).astype(np.uint8).tobytes()
        )
        ends = []
        for setting in ("1", "0"):
            monkeypatch.setenv("FHASH_NATIVE", setting)
            try:
                integers = decode_predicted(data, shape, predictor)
                assert np.abs(integers.astype(np.int64)).max() <= MAX_PREDICTED_INTEGER
                ends.append(integers.tobytes())
            except DamagedFileError:
                ends.append(b"damaged")
        assert ends[0] == ends[1]
        found.add(ends[0] == b"damaged")
    assert False in found


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8", "int64"])
def test_the_nearest_integers_keep_the_bound(dtype):
    values = (np.random.default_rng(4).random((3, 4, 5, 6)) * 200).astype(dtype)
    error = 3.0
    step = 2 * error * (1 - 1e-6) if values.dtype.kind == "f" else 2 * int(error) + 1.0
    predictor = _predictor(step=step, origin=100.0)
    integers = integers_of(values, np.ones(values.shape, bool), predictor)
    assert integers is not None
    decoded = values_of(integers, predictor)
    decoded = decoded.astype(dtype) if values.dtype.kind == "f" else np.rint(decoded)
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= error


def test_integers_that_are_too_large_are_refused():
    values = np.array([0.0, 1e30, np.nan, np.inf]).reshape(1, 1, 1, 4)
    predictor = _predictor()
    assert integers_of(values, np.isfinite(values), predictor) is None
    found = integers_of(
        values, np.array([True, False, False, False]).reshape(1, 1, 1, 4), predictor
    )
    np.testing.assert_array_equal(found, np.zeros((1, 1, 1, 4)))


def test_a_predictor_survives_json():
    predictor = _predictor((0, 3, 2, 1), (3, 0, 2, 1), 2, step=0.25, origin=-3.5)
    assert Predictor.from_dict(predictor.to_dict()) == predictor


@pytest.mark.parametrize(
    "change",
    [
        {"step": 0.0},
        {"step": "1"},
        {"origin": float("nan")},
        {"levels": [1, 2, 3]},
        {"levels": [1, 2, 3, 9]},
        {"levels": [1, 2, 3, True]},
        {"order": [0, 1, 2, 2]},
        {"order": None},
        {"reach": 3},
        {"reach": 1.0},
        {"weights": "@"},
        {"weights": "AAAA"},
        {"weights": 3},
        {"more": 1},
    ],
)
def test_a_bad_predictor_is_refused(change):
    with pytest.raises((InputError, DamagedFileError)):
        Predictor.from_dict({**_predictor().to_dict(), **change})


def test_a_missing_key_is_named():
    values = _predictor().to_dict()
    del values["reach"]
    with pytest.raises(InputError, match="missing key 'reach'"):
        Predictor.from_dict(values)


def test_taps_are_known_when_they_are_needed():
    """Within a pass only what comes before in C order is looked at."""
    for levels, order in (((2, 2, 2, 2), (0, 1, 2, 3)), ((1, 2, 0, 2), (3, 1, 2, 0))):
        for part in passes_of(levels, order, 2):
            assert len(set(part.taps)) == len(part.taps)
            for own, *offset in part.taps:
                assert not own or tuple(offset) < (0, 0, 0, 0)
                assert own or part.axis >= 0


@NATIVE
def test_arguments_hold_the_arrays_that_they_point_to():
    """Of a state that several threads make at once all but one are held by nothing else: what they point to must not go."""
    arguments = state_arguments(
        State(
            slots=np.zeros((8, 4), np.uint16),
            weights=np.zeros(8, np.int32),
            simples=np.zeros((8, 2), np.uint16),
        )
    )
    held = [part._arr for part in arguments if isinstance(part, ctypes.c_void_p)]
    assert [array.shape[0] for array in held] == [8, 8, 8]


@NATIVE
def test_threads_that_decode_for_the_first_time_at_once():
    predictor, integers = _predictor(), _smooth((3, 7, 2, 11))
    data, coded = encode_predicted(integers, None, predictor)
    with ThreadPoolExecutor(8) as workers:
        for _ in range(20):
            predict._blank.cache_clear()
            for found in workers.map(
                lambda _: decode_predicted(data, coded.shape, predictor), range(16)
            ):
                np.testing.assert_array_equal(found, coded)
