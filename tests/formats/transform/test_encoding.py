"""The search for the integers of the trellis: valid paths."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from reference.elementwise import LARGEST
from reference.kernels import encode_integers, single_band
from reference.sections import build_stream
from reference.transforms import band_table
from specs import spec_of
from tiles import (
    SETTINGS,
    SHAPE,
    SPEC,
    WHOLE,
    damaged_copies,
    resealed,
    same,
    streams,
    wave,
    with_head,
)

from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.transform.spec import AxisTransform, Basis, MaskLevels, TransformSpec
from fhash_formats.transform.tile import (
    DENSITIES,
    CodedTile,
    Coding,
    corrected_region,
    decode_tile,
    decode_tile_mask,
    encode_tile,
    exact_tile,
    filled,
    uncorrected,
)
from fhash_formats.transform.tile_format import EMPTY, KIND, MASKED, TRANSFORMED, TileSettings

TRELLIS = replace(SETTINGS, trellis=True, offsets=(17, -10, -5, -3, -2, -1))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize(
    "coding",
    [
        Coding(),
        Coding(weight=0.09),
        Coding(error=0.04),
        Coding(weight=0.09, error=0.04, passes=2, rounds=1),
    ],
    ids=["plain", "weight", "error", "all"],
)
@pytest.mark.parametrize("own_settings", [False, True])
@pytest.mark.parametrize("settings", [SETTINGS, TRELLIS], ids=["plain", "trellis"])
def test_the_encoder_knows_what_is_decoded(
    dtype: Any, coding: Coding, own_settings: bool, settings: TileSettings
) -> None:
    values = wave(dtype=dtype)
    coded = encode_tile(values, settings, replace(coding, own_settings=own_settings))
    known = None if own_settings else settings
    assert same(decode_tile(coded.data, SHAPE, dtype, known), coded.decoded)
    difference = np.abs(coded.decoded.astype(float) - values.astype(float)).max()
    assert difference <= (0.4 if coding.error is None else coding.error)


def test_values_outside_the_coreset_cost_little_and_leave_the_bound() -> None:
    values, in_coreset = wave((1, 4, 16, 16)), np.zeros((1, 4, 16, 16), bool)
    in_coreset[:, :, :, :8] = True
    noise = np.random.default_rng(0).normal(0, 50, values.shape).astype(np.float32)
    noisy = np.where(in_coreset, values, noise)
    coded = encode_tile(noisy, SETTINGS, Coding(error=0.04), in_coreset=in_coreset)
    assert np.abs(coded.decoded - noisy)[in_coreset].max() <= 0.04
    assert 2 * len(coded.data) < len(encode_tile(noisy, SETTINGS, Coding(error=0.04)).data)


def test_a_tile_of_missing_values_only() -> None:
    values = np.full(SHAPE, np.nan, np.float32)
    values[0, 0, 0, 0] = -np.inf
    data = encode_tile(values, SETTINGS).data
    assert same(decode_tile(data, SHAPE, np.float32, SETTINGS), values)
    dropped = encode_tile(values, SETTINGS, Coding(keep_missing=False))
    assert len(dropped.data) == 5
    assert (decode_tile(dropped.data, SHAPE, np.float32, SETTINGS) == np.float32(0.5)).all()


def test_rounds_make_the_ends_of_the_range_cheaper() -> None:
    """A value at an end of the range may decode to any value beyond it: the decoder clips."""
    values = np.clip(3 * wave((2, 4, 16, 16)), -1.0, 1.5)
    settings = replace(SETTINGS, low=-1.0, high=1.5)
    plain, projected = (
        encode_tile(values, settings, Coding(weight=0.09, rounds=rounds)) for rounds in (0, 3)
    )
    assert len(projected.data) < len(plain.data)
    assert np.abs(projected.decoded - values).max() <= 0.4


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i1", "u2", "i4", "u8"])
def test_an_exact_tile_is_exact_and_writeable(dtype: str) -> None:
    values = (wave() * 40 + 100).astype(dtype)
    values.flat[0] = 0
    decoded = decode_tile(exact_tile(values).data, SHAPE, dtype)
    assert same(decoded, values)
    decoded[:] = 0


def test_a_bound_too_fine_for_the_quantum_is_kept_by_an_exact_tile() -> None:
    values = wave(dtype=np.float64)
    coded = encode_tile(values, replace(SETTINGS, quantum=1e-12), Coding(error=1e-17))
    assert same(coded.decoded, values)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i2", "u1"])
def test_neither_residual_nor_rounding_leaves_the_range(dtype: str) -> None:
    values = np.maximum(wave(dtype="f8"), 0.1)
    values = (values * (1 if dtype[0] == "f" else 20)).astype(dtype)
    low, high = float(values.min()), float(values.max())
    error = (high - low) * 0.2
    quantum = 1.99 * (error - (0 if dtype[0] == "f" else 0.5))
    beyond = replace(SETTINGS, low=low, high=high, step=5 * error, quantum=quantum)
    settings = replace(beyond, clip=True)
    coding = Coding(weight=0.09, error=error)
    free, kept = encode_tile(values, beyond, coding), encode_tile(values, settings, coding)
    assert free.data == kept.data
    assert free.decoded.min() < low or free.decoded.max() > high
    assert low <= kept.decoded.min() <= kept.decoded.max() <= high
    errors = [np.abs(coded.decoded.astype(float) - values) for coded in (free, kept)]
    assert (errors[1] <= errors[0]).all()
    for wanted, coded in ((beyond, free), (settings, kept)):
        assert same(decode_tile(coded.data, SHAPE, dtype, wanted), coded.decoded)
    coarse = decode_tile(kept.data, SHAPE, dtype, settings, lod=1)
    assert low <= coarse.min() <= coarse.max() <= high


def test_ends_that_float32_rounds_outwards_are_kept_in_float64() -> None:
    values = np.where(wave(dtype="f8") > 0.3, 0.7, 0.1)
    assert float(np.float32(0.7)) < 0.7
    assert float(np.float32(0.1)) > 0.1
    values = -values
    settings = replace(SETTINGS, low=-0.7, high=-0.1, quantum=0.0, clip=True)
    decoded = encode_tile(values, settings, Coding()).decoded
    assert decoded.dtype == np.float64
    assert -0.7 <= decoded.min() <= decoded.max() <= -0.1


MAX_CHOSEN = 1 << 22
"""Magnitude from which on an integer is the nearest one (native/choose.cpp)."""
PLAIN = replace(
    SETTINGS,
    transform=spec_of(("none",) * 4, (0,) * 4, SHAPE),
    step=2.0**-4,
    center=0.0,
    double=True,
    quantum=0.0,
)


ON_TRELLIS = replace(PLAIN, trellis=True, offsets=(0,) * 6)


def edge(shape: tuple[int, ...], peak: float) -> np.ndarray:
    """Values whose one coefficient, in a transform that does nothing, is `peak` steps of PLAIN."""
    values = np.zeros(shape)
    values[0, 1, 2, 3] = peak * PLAIN.step
    return values


@pytest.mark.parametrize(("peak", "exact"), [(LARGEST - 1, False), (LARGEST, True)])
@pytest.mark.parametrize("trellis", [False, True])
def test_a_tile_is_exact_where_an_integer_does_not_fit(
    peak: float, exact: bool, trellis: bool
) -> None:
    values = edge(SHAPE, peak)
    values[0, 0, 0, 0] += PLAIN.step / 3  # which is lost unless the tile is exact
    ends = {"low": float(values.min()), "high": float(values.max())}
    settings = replace(ON_TRELLIS if trellis else PLAIN, **ends)
    coded = encode_tile(values, settings, Coding())
    assert np.array_equal(coded.decoded, values) == exact
    assert np.abs(coded.decoded - values).max() <= settings.step
    assert same(decode_tile(coded.data, SHAPE, np.float64, settings), coded.decoded)


@pytest.mark.parametrize("peak", [MAX_CHOSEN - 0.7, MAX_CHOSEN + 0.3, MAX_CHOSEN * 16 + 0.7])
@pytest.mark.parametrize("weight", [0.0, 0.09])
def test_large_integers_are_the_nearest_ones(peak: float, weight: float) -> None:
    values = edge(SHAPE, peak)
    settings = replace(PLAIN, low=float(values.min()), high=float(values.max()))
    coded = encode_tile(values, settings, Coding(weight=weight))
    error = abs(coded.decoded[0, 1, 2, 3] - values[0, 1, 2, 3]) / settings.step
    assert error <= (0.5 if weight else 0.7) + 1e-6
    assert same(decode_tile(coded.data, SHAPE, np.float64, settings), coded.decoded)


FIELD_SHAPE = (1, 4, 32, 40)
FIELD_SPEC = spec_of(("none", "9/7", "9/7", "9/7"), (0, 1, 3, 3), FIELD_SHAPE)
FIELD_SETTINGS = TileSettings(transform=FIELD_SPEC, step=0.1, center=0.0, low=-100.0, high=100.0)

Values = npt.NDArray[np.float32]


def field(outside: str) -> tuple[Values, npt.NDArray[np.bool_]]:
    """A smooth field and the ball in which it counted; outside the ball are other values."""
    _, z, y, x = np.indices(FIELD_SHAPE)
    values = (np.sin(0.2 * y + 0.1 * z) + np.cos(0.15 * x)).astype(np.float32)
    counted = (y - 16) ** 2 + (x - 20) ** 2 + 4 * z**2 < 150
    noise = np.random.default_rng(0).normal(0, 20, FIELD_SHAPE).astype(np.float32)
    around = {
        "the same": values,
        "noise": noise,
        "far away": np.full(FIELD_SHAPE, -99, np.float32),
        "rough": values + noise / 50,
    }[outside]
    return np.where(counted, values, around), counted


@pytest.mark.parametrize("outside", ["the same", "noise", "far away", "rough"])
@pytest.mark.parametrize("density", DENSITIES)
def test_counted_values_stay_and_the_others_cost_less(outside: str, density: int) -> None:
    values, counted = field(outside)
    result = filled(
        values,
        counted,
        np.ones(FIELD_SHAPE, bool),
        FIELD_SETTINGS,
        density,
    )
    np.testing.assert_array_equal(result[counted], values[counted])
    before, after = (len(encode_tile(target, FIELD_SETTINGS).data) for target in (values, result))
    if outside == "the same":
        assert after <= before
    else:
        assert after < before / 1.5


def test_more_thresholds_find_a_better_filling() -> None:
    values, counted = field("rough")
    sizes = [
        len(encode_tile(values, FIELD_SETTINGS, Coding(density=density), in_coreset=counted).data)
        for density in DENSITIES
    ]
    assert sizes[-1] < sizes[0]


def test_missing_values_are_filled_as_well() -> None:
    values, counted = field("noise")
    holes = np.where(counted, values, np.nan)
    coded = encode_tile(holes, replace(FIELD_SETTINGS, step=0.05), Coding(keep_missing=False))
    assert np.abs(coded.decoded - values)[counted].max() < 0.1
    assert np.isfinite(coded.decoded).all()


def test_a_level_of_detail_is_the_same_function_of_the_integers() -> None:
    values = wave((2, 4, 16, 16))
    data = encode_tile(values, replace(TRELLIS, quantum=0.0), Coding(weight=0.27)).data
    half = decode_tile(data, values.shape, np.float32, replace(TRELLIS, quantum=0.0), lod=1)
    assert half.shape == (2, 2, 8, 8)
    assert np.abs(half - values[:, ::2, ::2, ::2]).max() < 1.0


def test_a_path_errs_less_than_any_of_the_two_quantisers() -> None:
    random = np.random.default_rng(7)
    values = random.laplace(size=SHAPE) * 50 * np.exp(random.normal(size=SHAPE))
    values[:, :, : SHAPE[2] // 2] *= 0.05  # rows of zeros
    settings = replace(ON_TRELLIS, step=1.0, low=-1e9, high=1e9)
    found = encode_tile(values, settings).decoded
    # A trellis of eight states gains 1.0 dB of granular error at most; 1.53 dB is the limit.
    plain = 2 * np.rint(values / 2)
    assert np.square(found - values).mean() < 0.85 * np.square(plain - values).mean()
    assert not encode_tile(np.zeros((1, 1, 1, 3000)), settings, Coding(weight=0.3)).nonzero


def test_large_integers_of_the_trellis_are_near() -> None:
    values = np.random.default_rng(3).uniform(-9e8, 9e8, SHAPE)
    settings = replace(ON_TRELLIS, step=1.0, low=-1e9, high=1e9)
    found = encode_tile(values, settings, Coding(weight=0.27))
    assert found.data[4] & KIND == TRANSFORMED
    assert np.abs(found.decoded - values).max() <= 2


@pytest.mark.parametrize("name", list(streams()))
def test_damage_is_an_error(name: str) -> None:
    values, data = streams()[name]
    decode_tile(data, values.shape, values.dtype)
    for other in damaged_copies(data):
        with pytest.raises(DamagedFileError):
            decode_tile(other, values.shape, values.dtype)


@pytest.mark.parametrize("name", list(streams()))
def test_changes_under_the_right_checksum_are_damage_or_give_some_values(name: str) -> None:
    values, data = streams()[name]
    for other in damaged_copies(data):
        if len(other) > 4:
            try:
                found = decode_tile(resealed(other), values.shape, values.dtype)
            except DamagedFileError:
                continue
            assert found.shape == values.shape
            assert found.dtype == values.dtype


def test_shared_settings_are_needed() -> None:
    with pytest.raises(FhashError, match="no settings"):
        decode_tile(encode_tile(wave(), SETTINGS).data, SHAPE, np.float32)


SOUND = TileSettings(
    transform=spec_of(("none",) * 4, 0, SHAPE),
    step=1.0,
    center=0.0,
    low=-9.0,
    high=9.0,
    quantum=0.1,
)
BEYOND: dict[str, tuple[dict[str, Any], str]] = {
    "range beyond the type": (
        {"step": 1e299, "low": -1e300, "high": 1e300, "double": True},
        "float32",
    ),
    "range beyond the arithmetic": ({"step": 1e38, "low": -1e300, "high": 1e300}, "float64"),
    "centre beyond the type": ({"center": 1e300, "high": 1e301, "double": True}, "float32"),
    "centre beyond the arithmetic": ({"center": 1e300, "high": 1e301}, "float64"),
    "residual beyond the type": ({"quantum": 1e300}, "float32"),
    "residual beyond everything": ({"quantum": 1e308}, "float64"),
    "range beyond half precision": ({"low": -1e5}, "float16"),
}


@pytest.mark.parametrize("case", BEYOND)
def test_numbers_that_end_in_infinities_are_damage(case: str) -> None:
    """Infinities of the source are missing values; only hostile numbers decode to others."""
    changes, dtype = BEYOND[case]
    settings = replace(SOUND, **changes)
    integers = np.full(SHAPE, 100, np.int32)
    coded = encode_integers(integers, single_band(SHAPE)).data
    for residual in (None, integers) if "residual" not in case else (integers,):
        data = build_stream(TRANSFORMED, None, body=coded, residual=residual)
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(data, SHAPE, dtype, settings)
    if "residual" not in case:
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(build_stream(EMPTY, None), SHAPE, dtype, settings)


@pytest.mark.parametrize(("quantum", "dtype"), [(1e300, "float32"), (1e308, "float64")])
def test_clipped_values_end_in_the_range_whatever_their_residual(
    quantum: float, dtype: str
) -> None:
    settings = replace(SOUND, quantum=quantum, clip=True)
    coefficients = np.zeros(SHAPE, np.int32)
    residual = np.full(SHAPE, 100, np.int32)
    residual[0] *= -1
    coded = encode_integers(coefficients, single_band(SHAPE)).data
    data = build_stream(TRANSFORMED, None, body=coded, residual=residual)
    decoded = decode_tile(data, SHAPE, dtype, settings)
    np.testing.assert_array_equal(decoded, np.where(residual < 0, -9.0, 9.0))


def test_a_transform_that_overflows_gives_no_warning() -> None:
    settings = replace(SETTINGS, step=3e38, quantum=0.0)
    integers = np.full(SHAPE, 1000, np.int32)
    coded = encode_integers(integers, band_table(SPEC, SHAPE)).data
    data = build_stream(TRANSFORMED, None, body=coded)
    assert not np.isinf(decode_tile(data, SHAPE, np.float32, settings)).any()


@pytest.mark.parametrize("axis", range(4))
def test_a_basis_longer_than_the_tile_is_damage_before_anything_is_decoded(axis: int) -> None:
    """Its bands would lie beyond the tile, and a decoder would write behind its array."""
    n = SHAPE[axis] + 3
    basis = Basis(integers=np.eye(n, dtype=np.int32), exponents=(0,) * n)
    axes = [AxisTransform(kind="none")] * 4
    axes[axis] = AxisTransform(kind="klt", basis=basis)
    t, z, y, x = axes
    settings = replace(SETTINGS, transform=TransformSpec(axes=(t, z, y, x)), quantum=0.0)
    for coded in (b"", bytes(range(40))):
        data = build_stream(TRANSFORMED, None, body=coded)
        with pytest.raises(DamagedFileError, match="do not fit its shape"):
            decode_tile(data, SHAPE, np.float32, settings)
    with pytest.raises(InputError, match="basis along"):
        band_table(settings.transform, SHAPE)


PARTS = {
    "corner": ((0, 1), (0, 2), (0, 3), (0, 1)),
    "far corner": ((3, 4), (10, 12), (11, 13), (13, 14)),
    "inside": ((1, 3), (4, 6), (5, 7), (6, 7)),
    "edge": ((0, 4), (0, 1), (6, 7), (11, 14)),
}


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16"])
@pytest.mark.parametrize("hidden", [(12, 8), (5,)])
@pytest.mark.parametrize("name", list(PARTS))
def test_a_part_has_the_bits_of_the_whole(name: str, hidden: tuple[int, ...], dtype: str) -> None:
    settings, values = with_head(hidden), wave(WHOLE, dtype)
    data = encode_tile(values, settings).data
    whole = decode_tile(data, WHOLE, dtype, settings)
    part = tuple(slice(*span) for span in PARTS[name])
    table = uncorrected(data, WHOLE, dtype, settings, part)
    assert table is not None
    before = table.copy()
    found = corrected_region(table, part, dtype, settings)
    assert found.dtype == whole.dtype
    assert found.tobytes() == whole[part].tobytes()
    everything = tuple(slice(0, n) for n in WHOLE)
    assert corrected_region(table, everything, dtype, settings).tobytes() == whole.tobytes()
    assert table.tobytes() == before.tobytes()
    assert (table[part] != whole[part]).any() or dtype == "int16"  # otherwise nothing is tested


def test_tiles_with_more_than_a_head_are_decoded_whole() -> None:
    settings, values = with_head(), wave(WHOLE)
    part = tuple(slice(*span) for span in PARTS["corner"])
    holes = values.copy()
    holes[0, 1, 2, 3] = np.nan
    bounded = replace(settings, quantum=0.002)
    whole = {
        "no head": (
            replace(settings, head=None),
            encode_tile(values, replace(settings, head=None)),
        ),
        "own settings": (settings, encode_tile(values, settings, Coding(own_settings=True))),
        "missing": (settings, encode_tile(holes, settings)),
        "residual": (bounded, encode_tile(values, bounded, Coding(error=0.001))),
    }
    for name, (used, coded) in whole.items():
        assert uncorrected(coded.data, WHOLE, "float32", used, part) is None, name


def test_a_large_part_is_decoded_whole() -> None:
    settings = with_head()
    data = encode_tile(wave(WHOLE), settings).data
    frame = (slice(0, 1), *(slice(0, n) for n in WHOLE[1:]))
    assert uncorrected(data, WHOLE, "float32", settings, frame) is None


@pytest.mark.parametrize(
    ("at_byte", "value", "what"),
    [(0, 0, "hidden layers"), (0, 4, "hidden layers"), (1, 0, "widths"), (-1, 32, "weights")],
)
def test_a_head_that_is_wrong_is_damage_in_a_tile(at_byte: int, value: int, what: str) -> None:
    settings = with_head()
    assert settings.head is not None
    data = encode_tile(wave(WHOLE), settings, Coding(own_settings=True)).data
    packed = settings.head.to_bytes()
    at = data.index(packed) + at_byte % len(packed)
    changed = resealed(data[:at] + bytes([value]) + data[at + 1 :])
    with pytest.raises(DamagedFileError, match=f"head: it.* {what}"):
        decode_tile(changed, WHOLE, "float32", settings)


SHAPE_MASKED = (2, 3, 12, 17)
NINE = AxisTransform(kind="9/7", depth=2)
WITH_MASK = TileSettings(
    transform=TransformSpec(
        axes=(AxisTransform(kind="haar", depth=1), AxisTransform(kind="none"), NINE, NINE)
    ),
    step=2.0,
    center=50.0,
    low=0.0,
    high=120.0,
    quantum=1.0 * (1 - 1e-6),
    mask=MaskLevels(edges=(55.0, 60.0, 65.0), scores=(0, 60, 200, 900), reach=1),
)


def tile(dtype: str = "f4") -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    t, z, y, x = np.indices(SHAPE_MASKED)
    values = 50 + 25 * np.sin(0.3 * t + 0.5 * y) + 30 * np.cos(0.4 * x - 0.2 * z)
    return values.astype(dtype), values >= 60


@pytest.mark.parametrize("dtype", ["f4", "f8", "f2", "i2", "u1"])
@pytest.mark.parametrize(
    "options",
    [{}, {"weight": 0.09, "rounds": 2, "density": 2}, {"error": 0.5}, {"error": 1e-9}],
    ids=str,
)
@pytest.mark.parametrize("own", [False, True])
def test_a_tile_says_what_is_occupied(dtype: str, options: dict[str, Any], own: bool) -> None:
    values, care = tile(dtype)
    coded = encode_tile(values, WITH_MASK, Coding(own_settings=own, **options), in_coreset=care)
    settings = None if own else WITH_MASK
    decoded, mask = decode_tile_mask(coded.data, SHAPE_MASKED, dtype, settings)
    np.testing.assert_array_equal(mask, care)
    np.testing.assert_array_equal(decoded, coded.decoded)
    np.testing.assert_array_equal(decode_tile(coded.data, SHAPE_MASKED, dtype, settings), decoded)
    if values.dtype.kind == "f":
        np.testing.assert_array_equal(np.isnan(decoded), ~care)
    else:
        assert (decoded[~care] == decoded[~care][0]).all()
    assert np.abs(decoded.astype(float) - values.astype(float))[care].max() <= options.get(
        "error", 4.0
    )
    assert coded.data[4] & MASKED


def coded_with(occupied: npt.NDArray[np.bool_] | None) -> CodedTile:
    return encode_tile(tile()[0], WITH_MASK, in_coreset=occupied)


def test_all_or_nothing_costs_next_to_nothing() -> None:
    values = tile()[0]
    plain = encode_tile(values, replace(WITH_MASK, mask=None))
    for care in (None, np.ones(SHAPE_MASKED, bool)):
        assert len(coded_with(care).data) <= len(plain.data) + 2
        assert decode_tile_mask(coded_with(care).data, SHAPE_MASKED, "f4", WITH_MASK)[1].all()
    nothing = coded_with(np.zeros(SHAPE_MASKED, bool))
    decoded, mask = decode_tile_mask(nothing.data, SHAPE_MASKED, "f4", WITH_MASK)
    assert len(nothing.data) == 5
    assert not mask.any()
    assert np.isnan(decoded).all()


def test_without_a_mask_all_is_occupied_and_the_stream_is_what_it_was() -> None:
    plain = encode_tile(tile()[0], replace(WITH_MASK, mask=None))
    assert not plain.data[4] & MASKED
    assert decode_tile_mask(plain.data, SHAPE_MASKED, "f4", WITH_MASK)[1].all()


def test_what_is_not_finite_is_not_occupied_and_comes_back() -> None:
    values, care = tile()
    values[0, 0, :3], values[1, 2, 5, 6:9] = np.nan, [np.inf, -np.inf, np.nan]
    for error in (None, 0.5):
        coded = encode_tile(values, WITH_MASK, Coding(error=error), in_coreset=care)
        decoded, mask = decode_tile_mask(coded.data, SHAPE_MASKED, "f4", WITH_MASK)
        np.testing.assert_array_equal(mask, care & np.isfinite(values))
        np.testing.assert_array_equal(decoded[~np.isfinite(values)], values[~np.isfinite(values)])
    coded = encode_tile(values, WITH_MASK, Coding(keep_missing=False), in_coreset=care)
    dropped = decode_tile(coded.data, SHAPE_MASKED, "f4", WITH_MASK)
    np.testing.assert_array_equal(np.isnan(dropped), ~(care & np.isfinite(values)))


def test_less_detail_needs_no_mask() -> None:
    coded = coded_with(tile()[1])
    coarse = decode_tile(coded.data, SHAPE_MASKED, "f4", WITH_MASK, lod=1)
    assert coarse.shape == (2, 2, 6, 9)
    assert np.isfinite(coarse).all()


def test_a_mask_needs_settings_that_know_of_it() -> None:
    with pytest.raises(DamagedFileError, match="no mask levels"):
        decode_tile(coded_with(tile()[1]).data, SHAPE_MASKED, "f4", replace(WITH_MASK, mask=None))
