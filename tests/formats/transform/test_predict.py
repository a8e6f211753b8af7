"""Prediction in place of a transform: integers and whole tiles come back, hostile bytes do not."""

from __future__ import annotations

import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import tiles
from numcodecs.zstd import compress, decompress
from reference.kernels import (
    blank_predicted_state,
    decode_predicted,
    encode_predicted,
)
from reference.sections import (
    labelled_stream,
    pack_missing,
    pack_planes,
    restore_missing,
    unpack_labelled,
    unpack_planes,
)
from specs import spec_of
from tiles import SETTINGS, Four, predictor_of, random_head, resealed, same, streams, wave

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import crc32c
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.predict import (
    MAX_PREDICTED_INTEGER,
    Predictor,
    encode_differences,
    integers_of,
    passes_of,
)
from fhash_formats.transform.spec import MaskLevels
from fhash_formats.transform.tile import Coding, decode_tile, decode_tile_mask, encode_tile
from fhash_formats.transform.tile_format import (
    BLOCKS,
    DIFFERENCES,
    EMPTY,
    EXACT,
    FAST,
    KIND,
    LABELS,
    MASKED,
    MISSING,
    OWN,
    PREDICTED,
    RESIDUAL,
    TRANSFORMED,
    TileSettings,
    has_regions,
    parse_stream,
    read_varint,
    seal,
    varint,
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


def test_integers_that_are_too_large_are_refused() -> None:
    values = np.array([0.0, 1e30, np.nan, np.inf]).reshape(1, 1, 1, 4)
    predictor = predictor_of()
    assert integers_of(values, np.isfinite(values), predictor) is None
    counted = np.array([True, False, False, False]).reshape(1, 1, 1, 4)
    integers = integers_of(values, counted, predictor)
    np.testing.assert_array_equal(integers, np.zeros((1, 1, 1, 4)))


def test_threads_that_decode_for_the_first_time_at_once() -> None:
    predictor, integers = predictor_of(), _smooth((3, 7, 2, 11))
    data, coded = encode_predicted(integers, None, predictor)
    with ThreadPoolExecutor(8) as workers:
        for _ in range(20):
            blank_predicted_state.cache_clear()
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


def test_settings_without_a_predictor_are_refused() -> None:
    values = _values()
    settings = _settings(values, 2.0)
    data = encode_tile(values, settings, Coding(error=2.0)).data
    other = TileSettings(transform=settings.transform, step=1.0, center=0.0, low=0.0, high=1.0)
    with pytest.raises(DamagedFileError, match="prediction"):
        decode_tile(data, SHAPE, "float32", other)


REGIONS_SHAPE = (2, 4, 9, 20)
LABELLED = replace(SETTINGS, labels=True, quantum=0.0)


def regions(dtype: str) -> np.ndarray:
    """Five values in blocks; floats have both zeros and NaN among them."""
    kind = np.dtype(dtype)
    values = [3, 100, 7, 0, 50] if kind.kind != "f" else [np.nan, -0.0, 0.0, 1.5, -7.0]
    number = (
        np.arange(20) // 5 + np.arange(9)[:, None] // 3 + np.arange(2)[:, None, None, None]
    ) % 5
    return np.broadcast_to(np.array(values, kind)[number], REGIONS_SHAPE).copy()


@pytest.mark.parametrize("dtype", ["i1", "u2", "i4", "u8", "f2", "f4", "f8"])
@pytest.mark.parametrize("own", [False, True])
def test_every_type_comes_back_bit_by_bit(dtype: str, own: bool) -> None:
    values = regions(dtype)
    coding = Coding(error=0.0, own_settings=own, keep_missing=False)
    coded = encode_tile(values, LABELLED, coding)
    assert coded.data[4] & KIND == LABELS
    assert coded.decoded.tobytes() == values.tobytes()
    decoded = decode_tile(coded.data, REGIONS_SHAPE, values.dtype, None if own else LABELLED)
    assert decoded.tobytes() == values.tobytes()
    coarse = decode_tile(coded.data, REGIONS_SHAPE, values.dtype, LABELLED, lod=1)
    assert same(coarse, values[:, ::2, ::2, ::2])


@pytest.mark.parametrize("dtype", ["i1", "f4"])
def test_a_mask_is_one_more_label(dtype: str) -> None:
    values, occupied = regions(dtype), np.ones(REGIONS_SHAPE, bool)
    occupied[:, 1, 2:6, 4:11] = False
    if dtype == "f4":
        values[np.isnan(values)] = 9.0
    settings = replace(LABELLED, mask=MaskLevels())
    coded = encode_tile(values, settings, Coding(error=0.0), in_coreset=occupied)
    assert coded.data[4] == LABELS | MASKED
    decoded, mask = decode_tile_mask(coded.data, REGIONS_SHAPE, values.dtype, settings)
    np.testing.assert_array_equal(mask, occupied)
    assert same(decoded, coded.decoded)
    np.testing.assert_array_equal(decoded[occupied], values[occupied])


@pytest.mark.parametrize(("count", "there"), [(256, True), (257, False)])
def test_the_most_labels_are_kept_and_unoccupied_vertices_take_one(count: int, there: bool) -> None:
    values = (np.arange(600).reshape(1, 1, 20, 30) % count).astype("i4")
    data = labelled_stream(values, None, None, 256)
    assert (data is not None) is there
    if data is not None:
        assert same(decode_tile(data, values.shape, "i4"), values)
    assert labelled_stream(values, None, np.ones(values.shape, bool), 256) is None
    occupied = np.ones(values.shape, bool)
    occupied[0, 0, 19] = False
    masked = labelled_stream(values, None, occupied)
    assert masked is not None
    decoded, mask = decode_tile_mask(
        masked, values.shape, "i4", replace(LABELLED, mask=MaskLevels())
    )
    np.testing.assert_array_equal(mask, occupied)
    np.testing.assert_array_equal(decoded[mask], values[mask])


def test_smooth_values_are_not_coded_as_labels() -> None:
    x = np.arange(200.0)
    values = np.rint(100 + 90 * np.sin(x / 30) * np.cos(x[:40, None] / 25)).astype("i2")[None, None]
    settings = replace(LABELLED, low=10.0, high=190.0, center=100.0, quantum=0.99, step=1.0)
    coded = encode_tile(values, settings, Coding(error=0.5))
    assert coded.data[4] & KIND == TRANSFORMED
    np.testing.assert_array_equal(coded.decoded, values)


@pytest.mark.parametrize("dtype", ["u2", "i4", "u8", "f4", "f8"])
def test_many_labels_come_back_bit_by_bit(dtype: str) -> None:
    numbers = np.random.default_rng(0).permutation(3000)[:300].reshape(1, 1, 15, 20)
    values = numbers.repeat(4, 2).repeat(5, 3).astype(dtype)
    if dtype[0] == "f":
        values[0, 0, 0, :4] = [np.nan, -0.0, np.inf, -np.inf]
    coded = encode_tile(values, LABELLED, Coding(error=0.0, keep_missing=False))
    assert coded.data[4] == LABELS
    assert decode_tile(coded.data, values.shape, dtype, LABELLED).tobytes() == values.tobytes()


@pytest.mark.parametrize(("count", "there"), [(65536, True), (65537, False)])
def test_at_most_65536_many_labels(count: int, there: bool) -> None:
    values = (np.arange(65600).reshape(1, 1, 200, 328) % count * 3).astype("i4")
    assert (labelled_stream(values, None, None) is not None) is there


def test_a_palette_of_consecutive_values_takes_few_bytes() -> None:
    values = np.arange(40, 440, dtype="i4").reshape(1, 1, 20, 20).repeat(4, 2).repeat(4, 3)
    data = labelled_stream(values, None, None)
    assert data is not None
    size, rest = read_varint(parse_stream(data).body)
    assert size == 400
    assert read_varint(rest)[0] < 40


@pytest.mark.parametrize(
    ("size", "length", "steps"),
    [(65537, 1, [1]), (0, 1, []), (2, 1 << 30, [1, 1]), (2, None, [1, 0]), (2, None, [1, 65535])],
)
def test_hostile_palettes_are_damage(size: int, length: int | None, steps: list[int]) -> None:
    packed = pack_planes(np.array(steps, np.uint16))
    body = varint(size) + varint(len(packed) if length is None else length) + packed
    with pytest.raises(DamagedFileError):
        unpack_labelled(memoryview(body), (1, 1, 2, 3), np.dtype("u2"), masked=False)


@pytest.mark.parametrize(("equal", "regions"), [(49, False), (50, True)])
def test_regions_are_half_of_the_vertices_with_an_equal_neighbour(equal, regions) -> None:
    row = np.arange(100)
    row[1 : 2 * equal : 2] = row[: 2 * equal : 2]
    assert has_regions(row.reshape(1, 1, 1, 100)) is regions


@pytest.mark.parametrize("name", list(streams()))
def test_flags_that_say_something_else_are_damage(name: str) -> None:
    """The checksum is right, as whoever changes a file on purpose makes it."""
    values, data = streams()[name]
    flags, stream = data[4], parse_stream(data)
    sections = (stream.settings, stream.missing, stream.body, stream.residual, stream.mask)
    assert seal(flags, [bytes(one) for one in sections if one is not None]) == data
    assert data[:4] == crc32c(data[4:]).to_bytes(4, "little")

    for change in (7,) if stream.kind in (TRANSFORMED, BLOCKS) else (7, FAST):
        other = bytes([flags & ~KIND | change if change < 8 else flags | change])
        with pytest.raises(DamagedFileError, match="flags"):
            decode_tile(resealed(data[:4] + other + data[5:]), values.shape, values.dtype)
    cut = resealed(data[:5] + b"\xff" + data[6:])
    if flags & OWN:
        with pytest.raises(DamagedFileError, match=r"cut short|settings"):
            decode_tile(cut, values.shape, values.dtype)


@pytest.mark.parametrize("flags", [EMPTY | RESIDUAL, 2 | MISSING, 3 | RESIDUAL, 1 | RESIDUAL])
def test_flags_that_contradict_each_other_are_damage(flags: int) -> None:
    with pytest.raises(DamagedFileError, match="which no encoder writes"):
        parse_stream(seal(flags, [b"a", b"b"]))


def test_an_empty_stream_ends_after_its_flags() -> None:
    assert len(seal(EMPTY, [])) == 5
    with pytest.raises(DamagedFileError, match="bytes after its end"):
        parse_stream(resealed(seal(EMPTY, []) + b"a"))


@pytest.mark.parametrize(
    ("size", "length"),
    [(0, b"\0"), (127, b"\x7f"), (128, b"\x80\x01"), (20000, b"\xa0\x9c\x01")],
)
def test_a_length_takes_seven_bits_a_byte(size: int, length: bytes) -> None:
    data = seal(RESIDUAL, [bytes(size), b"end"])
    assert data[5:] == length + bytes(size) + b"end"
    stream = parse_stream(data)
    assert (stream.body, stream.residual) == (bytes(size), b"end")


def test_planes_have_the_lowest_bytes_first_and_exactly_their_number() -> None:
    values = np.array([1, 0x0203, 0xFFFF], np.uint16)
    packed = pack_planes(values)
    assert same(unpack_planes(packed, 3, values.dtype), values)
    for damaged in (packed[:-1], packed + b"a", pack_planes(values[:2]), b"", b"abc"):
        with pytest.raises(DamagedFileError):
            unpack_planes(damaged, 3, values.dtype)
    with pytest.raises(DamagedFileError, match="another number"):
        unpack_planes(pack_planes(np.zeros(1 << 20, np.uint16)), 0, values.dtype)


def test_missing_values_come_back() -> None:
    values = wave()
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    missing = pack_missing(values, np.isfinite(values))
    finite = np.where(np.isfinite(values), values, np.float32(0))
    assert same(restore_missing(finite, missing), values)


CHANGES: list[dict[str, Any]] = [
    {},
    {"double": True, "offsets": (-5, -1, 0, 0, 0, 0)},
    {"mask": MaskLevels(), "quantum": 0.0},
    {"mask": MaskLevels(edges=(-1.5, 3.0), scores=(1, 0, 4095), others=(7, 8, 9), reach=64)},
    {"clip": True, "labels": True},
    {"trellis": True, "offsets": (-5, -1, 0, 0, 1, -127)},
    {"head": random_head((3, 4))},
    {"predictor": predictor_of((1, 2, 2, 2), (0, 3, 1, 2), 1, step=0.25)},
    {"transform": spec_of(("klt", "none", "5/3", "klt"), (0, 0, 3, 0), tiles.SHAPE, 0.1)},
    {"origin": -(1 << 63), "low": -(1 << 62), "high": (1 << 62) + 1},
    {"origin": (1 << 64) - 1, "low": 0.0, "high": 5.0},
    {"low": -(1 << 63), "high": (1 << 63) - 1},
]


@pytest.mark.parametrize("changes", CHANGES)
def test_settings_come_back_from_bytes_and_text(changes: dict[str, Any]) -> None:
    settings = replace(SETTINGS, **changes)
    data = settings.to_bytes()
    again = TileSettings.from_bytes(data)
    assert again.to_bytes() == data
    assert TileSettings.from_text(settings.to_text()) is again
    if "head" not in changes:
        assert again == settings
    assert type(again.low) is (int if settings.origin or abs(settings.low) > 1 << 53 else float)


@pytest.mark.parametrize("changes", CHANGES)
def test_cut_and_longer_bytes_are_damage(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    for other in [*(data[:n] for n in range(0, len(data), 1 + len(data) // 97)), data + b"\0"]:
        with pytest.raises(DamagedFileError):
            TileSettings.from_bytes(other)


@pytest.mark.parametrize("changes", CHANGES)
def test_changed_bytes_are_damage_or_other_settings(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    random = np.random.default_rng(0)
    for at in [*range(60), *random.integers(0, len(data), 100).tolist()]:
        other = bytearray(data)
        other[at % len(data)] = int(random.integers(256))
        try:
            TileSettings.from_bytes(bytes(other))
        except DamagedFileError:
            continue


def test_ends_about_an_origin_are_whole() -> None:
    for ends in ({"low": 0.5, "high": 2.0}, {"low": 0, "high": 1 << 63}):
        with pytest.raises(InputError, match="about an origin"):
            replace(SETTINGS, origin=7, **ends).to_bytes()


@pytest.mark.parametrize("text", [None, 3, "%", "QUJD", "\u00e9"])
def test_text_that_holds_no_settings_is_damage(text: Any) -> None:
    with pytest.raises(DamagedFileError, match="settings"):
        TileSettings.from_text(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": 0.0}, "do not fit together"),
        ({"step": 1e-300}, "not for float32"),
        ({"low": 4.0}, "do not fit together"),
        ({"quantum": -1.0}, "do not fit together"),
        ({"center": float("nan")}, "center is nan"),
        ({"step": True}, "step is True"),
        ({"offsets": (0, 0, 0)}, "six whole numbers"),
        ({"offsets": (0, 0, 0, 0, 0, 128)}, "six whole numbers"),
        ({"origin": 1.0}, "origin is 1.0; a 64-bit integer"),
        ({"origin": 1 << 64}, "a 64-bit integer is needed"),
        ({"high": 10**400}, "high is 1000"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(SETTINGS, **changes)


def rotated_pole(rows: int, columns: int, *, corners: bool) -> npt.NDArray[np.float64]:
    """Longitudes of a grid about a rotated pole at 39.25 N, 162 W: centres, or (.., 4) corners."""
    y, x = (np.radians(np.arange(n + 1) * 0.22 - 20) for n in (rows, columns))
    east = np.cos(y)[:, None] * np.sin(x)
    ahead = np.cos(y)[:, None] * np.cos(x)
    pole, north = np.radians(39.25), np.sin(y)[:, None]
    away = np.arctan2(east, np.sin(pole) * ahead - north * np.cos(pole))
    at = (np.degrees(away) - 162 + 180) % 360 - 180
    if not corners:
        return at[:-1, :-1].copy()
    return np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1)


def decode_differences(body: bytes, shape: Shape, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    return decode_tile(seal(DIFFERENCES, [body]), shape, dtype)


def differences(values: npt.NDArray[Any]) -> bytes:
    """The body of differences, after it was decoded to the same bits."""
    shape = (1,) * (4 - values.ndim) + values.shape
    body = encode_differences(values.reshape(shape))
    assert body is not None
    decoded = decode_differences(body, shape, values.dtype)
    assert decoded.dtype == values.dtype
    assert decoded.shape == shape
    assert decoded.tobytes() == values.tobytes()
    return body


@pytest.mark.parametrize("corners", [False, True])
@pytest.mark.parametrize("case", ["as it is", "rounded", "float32", "land"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_differences_of_a_grid_take_a_third_of_its_deflated_bytes(
    dtype: str, case: str, corners: bool
) -> None:
    values = rotated_pole(60, 90, corners=corners)
    if case == "rounded":
        values = np.round(values, 4)
    elif case == "float32":
        values = values.astype(np.float32).astype(np.float64)
    elif case == "land":
        values[20:45, 30:50] = np.nan
    values = values.astype(dtype)
    assert 3 * len(differences(values)) < len(zlib.compress(values.tobytes(), 9))


def test_corners_cost_little_more_than_centres() -> None:
    centres, corners = (rotated_pole(60, 90, corners=each) for each in (False, True))
    assert len(differences(corners)) < 1.6 * len(differences(centres))


@pytest.mark.parametrize("kind", DTYPES)
@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (1, 1, 1, 9), (1, 1, 12, 2), (2, 3, 4, 9)])
def test_differences_keep_every_bit_of_any_values(kind: str, shape: Four) -> None:
    dtype, count = np.dtype(kind), prod(shape)
    values = np.frombuffer(np.random.default_rng(3).bytes(count * dtype.itemsize), dtype)
    differences(values.reshape(shape))
    if dtype.kind == "f":
        odd = np.resize([0.0, -0.0, 1.5, np.inf, np.nan, -np.inf, -3e-5, 7e4], count)
        with np.errstate(over="ignore"):
            differences(odd.astype(dtype).reshape(shape))
        signalling = np.full(shape, np.array(-1).astype(f"i{dtype.itemsize}")).view(dtype)
        mixed = np.where(np.arange(count).reshape(shape) % 2 > 0, signalling, values.dtype.type(2))
        differences(mixed)


def test_what_has_no_differences_is_told() -> None:
    assert encode_differences(np.full((1, 1, 3, 9), np.nan)) is None


WRONG_DIFFERENCES = {
    "a flag that is not known": (0, b"\x08"),
    "holes without bits": (0, b"\x01"),
    "rests that are not there": (0, b"\x02"),
    "float32 that is float64": (0, b"\x04"),
    "a negative scale": (8, b"\xc0"),
    "a scale of NaN": (7, b"\xf8\x7f"),
    "a hole beyond the type": (16, b"\x01"),
    "an order of seven": (17, b"\x70"),
    "an order of seven along rows": (17, b"\x07"),
}


@pytest.mark.parametrize("case", WRONG_DIFFERENCES)
def test_differences_that_no_encoder_writes(case: str) -> None:
    values = np.round(rotated_pole(9, 12, corners=False), 3).astype(np.float32)
    place, wrong = WRONG_DIFFERENCES[case]
    plain = bytearray(decompress(differences(values)))
    assert plain[0] == 0, "neither holes nor rests"
    plain[place : place + len(wrong)] = wrong
    with pytest.raises(DamagedFileError, match="numbers that no encoder writes"):
        decode_differences(compress(bytes(plain), 1), (1, 1, 9, 12), values.dtype)


def test_differences_that_are_cut_or_too_many_are_refused() -> None:
    values = rotated_pole(9, 12, corners=False)
    body, shape = differences(values), (1, 1, 9, 12)
    for cut in (0, 5, 12, len(body) - 1):
        with pytest.raises(DamagedFileError):
            decode_differences(body[:cut], shape, values.dtype)
    with pytest.raises(DamagedFileError, match="zstd declares"):
        decode_differences(body, (1, 1, 9, 4), values.dtype)
    with pytest.raises(DamagedFileError, match="zstd declares"):
        decode_differences(compress(bytes(1 << 20), 1), shape, values.dtype)


def test_a_stream_of_differences_has_details_and_no_flags() -> None:
    values = rotated_pole(9, 12, corners=False)[None, None]
    stream = seal(DIFFERENCES, [differences(values)])
    assert same(decode_tile(stream, values.shape, values.dtype), values)
    assert same(decode_tile(stream, values.shape, values.dtype, lod=1), values[..., ::2, ::2])
    with pytest.raises(DamagedFileError, match="flags"):
        parse_stream(seal(DIFFERENCES | MASKED, [differences(values), b""]))
