"""Prediction in place of a transform: integers and whole tiles come back, hostile bytes do not."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from specs import spec_of
from tiles import Four, predictor_of

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform import predict
from fhash_formats.transform.coder import MaskLevels, State, state_arguments
from fhash_formats.transform.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.predict import (
    MAX_PREDICTED_INTEGER,
    Predictor,
    decode_predicted,
    encode_predicted,
    integers_of,
    pass_arrays,
    passes_of,
    values_of,
)
from fhash_formats.transform.tile_format import EXACT, KIND, PREDICTED, TileSettings

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


Values = npt.NDArray[Any]

SHAPE = (3, 5, 9, 14)


def _settings(values: Values, error: float, **more: Any) -> TileSettings:
    finite = values[np.isfinite(values)].astype(np.float64)
    integers = values.dtype.kind in "iu"
    rounding = 0.0 if integers else float(np.finfo(values.dtype).eps) / 2 * np.abs(finite).max()
    step = 2.0 * int(error) + 1.0 if integers else 2 * float(error * (1 - 1e-6) - rounding)
    levels, order = (1, 2, 2, 2), (0, 3, 2, 1)
    count = sum(len(step.taps) for step in passes_of(levels, order, 1))
    weights = tuple(np.random.default_rng(0).integers(-200, 200, count).tolist())
    predictor = Predictor(
        step=step,
        origin=float(np.rint(finite.mean())),
        levels=levels,
        order=order,
        reach=1,
        weights=weights,
    )
    return TileSettings(
        transform=spec_of(("none",) * 4, 0, SHAPE),
        step=step,
        center=predictor.origin,
        low=float(finite.min()),
        high=float(finite.max()),
        double=True,
        quantum=step,
        predictor=predictor,
        **more,
    )


def _values(dtype: str = "float32") -> Values:
    axes = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    values = (
        60
        + 25 * np.sin(axes[3] / 3 + axes[0])
        + 20 * np.cos(axes[2] / 4)
        + np.random.default_rng(1).normal(0, 3, SHAPE)
    )
    return np.clip(values, 1, 120).astype(dtype)


@pytest.mark.parametrize(
    "dtype",
    [
        "float16",
        "float32",
        "float64",
        "int8",
        "uint8",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
    ],
)
@pytest.mark.parametrize("error", [0.5, 2.0, 7.3])
def test_the_bound_is_kept_in_every_type(dtype: str, error: float) -> None:
    values = _values(dtype)
    settings = _settings(values, error)
    coded = encode_tile(values, settings, Coding(error=error))
    assert coded.data[4] & KIND == PREDICTED
    decoded = decode_tile(coded.data, SHAPE, dtype, settings)
    assert decoded.dtype == values.dtype
    np.testing.assert_array_equal(decoded, coded.decoded)
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= error
    assert len(coded.data) < values.size


def test_numbers_that_float64_cannot_hold_are_stored_exactly() -> None:
    values = (np.int64(2**62) + np.arange(np.prod(SHAPE)).reshape(SHAPE)).astype(np.int64)
    coded = encode_tile(values, _settings(values, 1.0), Coding(error=1.0))
    assert coded.data[4] & KIND == EXACT
    np.testing.assert_array_equal(
        decode_tile(coded.data, SHAPE, "int64", _settings(values, 1.0)), values
    )


def test_a_constant_tile_takes_few_bytes() -> None:
    values = np.full(SHAPE, 7.25, dtype=np.float32)
    settings = _settings(values, 0.1)
    coded = encode_tile(values, settings, Coding(error=0.1))
    assert len(coded.data) < 30
    assert np.abs(decode_tile(coded.data, SHAPE, "float32", settings) - values).max() <= 0.1


def test_missing_values_come_back() -> None:
    values = _values()
    values[1, 2, 3, 4:9] = np.nan
    values[0, 0, 0, 0], values[2, 1, 0, 3] = np.inf, -np.inf
    settings = _settings(values, 1.0)
    decoded = decode_tile(
        encode_tile(values, settings, Coding(error=1.0)).data, SHAPE, "float32", settings
    )
    finite = np.isfinite(values)
    np.testing.assert_array_equal(decoded[~finite], values[~finite])
    assert np.abs(decoded[finite] - values[finite]).max() <= 1.0


def test_a_stream_with_its_own_settings_and_a_mask() -> None:
    values = _values()
    in_coreset = np.random.default_rng(5).random(SHAPE) < 0.4
    settings = _settings(values, 0.5, mask=MaskLevels())
    coded = encode_tile(
        values, settings, Coding(error=0.5, own_settings=True), in_coreset=in_coreset
    )
    decoded, mask = decode_tile_mask(coded.data, SHAPE, "float32")
    np.testing.assert_array_equal(mask, in_coreset)
    assert np.isnan(decoded[~in_coreset]).all()
    assert np.abs(decoded - values)[in_coreset].max() <= 0.5
    assert TileSettings.from_bytes(settings.to_bytes()) == settings


@pytest.mark.parametrize("lod", [1, 2])
def test_a_level_of_detail_is_every_other_vertex(lod: int) -> None:
    values = _values()
    settings = _settings(values, 0.5)
    data = encode_tile(values, settings, Coding(error=0.5)).data
    every = slice(None, None, 1 << lod)
    np.testing.assert_array_equal(
        decode_tile(data, SHAPE, "float32", settings, lod=lod),
        decode_tile(data, SHAPE, "float32", settings)[:, every, every, every],
    )


def test_every_flipped_or_cut_byte_is_noticed() -> None:
    values = _values()
    settings = _settings(values, 2.0)
    data = encode_tile(values, settings, Coding(error=2.0)).data
    generator = np.random.default_rng(6)
    for at in (*range(8), *generator.integers(8, len(data), 30).tolist()):
        for changed in (
            data[:at],
            data[:at] + bytes([data[at] ^ (1 << int(generator.integers(8)))]) + data[at + 1 :],
        ):
            with pytest.raises(DamagedFileError):
                decode_tile(changed, SHAPE, "float32", settings)


def test_settings_without_a_predictor_are_refused() -> None:
    values = _values()
    settings = _settings(values, 2.0)
    data = encode_tile(values, settings, Coding(error=2.0)).data
    other = TileSettings(transform=settings.transform, step=1.0, center=0.0, low=0.0, high=1.0)
    with pytest.raises(DamagedFileError, match="prediction"):
        decode_tile(data, SHAPE, "float32", other)
