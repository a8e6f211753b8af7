"""One tile: bounds, what is missing, what does not count, reduced resolution, damage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.axes.basis import Basis
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.entropy.coder import encode_integers
from fhash_formats.transform.entropy.table import single_band
from fhash_formats.transform.tile import decoding
from fhash_formats.transform.tile.encoding import decode_tile, encode_tile, exact_tile, within
from fhash_formats.transform.tile.sections import assembled, parts_of, section
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (2, 3, 7, 10)
SPEC = TransformSpec(
    axes=(
        AxisTransform(kind="haar", depth=1),
        AxisTransform(kind="none"),
        AxisTransform(kind="9/7", depth=2),
        AxisTransform(kind="9/7", depth=2),
    )
)
SETTINGS = TileSettings(
    transform=SPEC, step=0.1, center=0.5, low=-2.0, high=3.0, quantum=0.08 * (1 - 1e-6)
)


def wave(shape: tuple[int, ...] = SHAPE, dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    return (np.sin(0.3 * t + 0.5 * y) + np.cos(0.4 * x - 0.2 * z) + 0.3).astype(dtype)


def same(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"weight": 0.09},
        {"error": 0.04},
        {"weight": 0.09, "error": 0.04, "passes": 2, "rounds": 1},
    ],
)
@pytest.mark.parametrize("own", [False, True])
def test_the_encoder_knows_what_is_decoded(dtype: Any, options: dict[str, Any], own: bool) -> None:
    values = wave(dtype=dtype)
    coded = encode_tile(values, SETTINGS, own=own, **options)
    assert same(decode_tile(coded.data, SHAPE, dtype, None if own else SETTINGS), coded.decoded)
    assert np.abs(coded.decoded.astype(float) - values.astype(float)).max() <= options.get(
        "error", 0.4
    )


def test_values_that_are_not_finite_come_back_as_they_were() -> None:
    values = wave()
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    values[1, 0] = np.nan
    decoded = decode_tile(
        encode_tile(values, SETTINGS, error=0.04).data, SHAPE, np.float32, SETTINGS
    )
    finite = np.isfinite(values)
    assert same(decoded[~finite], values[~finite])
    assert np.abs(decoded[finite] - values[finite]).max() <= 0.04


def test_what_does_not_count_costs_little_and_leaves_the_bound() -> None:
    values, care = wave((1, 4, 16, 16)), np.zeros((1, 4, 16, 16), bool)
    care[:, :, :, :8] = True
    noisy = np.where(
        care, values, np.random.default_rng(0).normal(0, 50, values.shape).astype(np.float32)
    )
    coded = encode_tile(noisy, SETTINGS, care=care, error=0.04)
    assert np.abs(coded.decoded - noisy)[care].max() <= 0.04
    assert 2 * len(coded.data) < len(encode_tile(noisy, SETTINGS, error=0.04).data)


def test_nothing_counts() -> None:
    values = np.full(SHAPE, np.nan, np.float32)
    values[0, 0, 0, 0] = -np.inf
    assert same(
        decode_tile(encode_tile(values, SETTINGS).data, SHAPE, np.float32, SETTINGS), values
    )
    dropped = encode_tile(values, SETTINGS, keep_missing=False)
    assert len(dropped.data) == 1
    assert (decode_tile(dropped.data, SHAPE, np.float32, SETTINGS) == np.float32(0.5)).all()


def test_reduced_resolution_is_the_low_band() -> None:
    coded = encode_tile(np.full(SHAPE, 2.25, np.float32), SETTINGS)
    coarse = decode_tile(coded.data, SHAPE, np.float32, SETTINGS, lod=1)
    assert coarse.shape == (2, 2, 4, 5)
    assert np.abs(coarse - 2.25).max() < 0.1


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i1", "u2", "i4", "u8"])
def test_an_exact_tile_is_exact_and_writeable(dtype: str) -> None:
    values = (wave() * 40 + 100).astype(dtype)
    values.flat[0] = 0
    decoded = decode_tile(exact_tile(values).data, SHAPE, dtype)
    assert same(decoded, values)
    decoded[:] = 0


def test_a_bound_too_fine_for_the_quantum_is_kept_by_an_exact_tile() -> None:
    values = wave(dtype=np.float64)
    coded = encode_tile(values, replace(SETTINGS, quantum=1e-12), error=1e-17)
    assert same(coded.decoded, values)


def test_within_is_strict_to_the_last_bit() -> None:
    one = np.array([2**63 - 1, 0, -(2**63)])
    assert within(one, np.array([-(2**63), 0, -(2**63)]), float(2**64))
    assert not within(one, np.array([-(2**63), 0, -(2**63)]), float(2**63))
    assert within(np.array([5]), np.array([8]), 3.0)
    assert not within(np.array([5]), np.array([8]), 2.999)
    assert not within(np.array([1.0]), np.array([np.nan]), 1e300)
    assert not within(np.array([0.1]), np.array([0.4]), 0.3)


def streams() -> dict[str, tuple[npt.NDArray[Any], bytes]]:
    values = wave((1, 3, 4, 5))
    holes = values.copy()
    holes[0, 1, 2, 1:4] = [np.nan, np.inf, -np.inf]
    coarse = replace(SETTINGS, quantum=0.0)
    return {
        "plain": (values, encode_tile(values, coarse, own=True).data),
        "residual": (
            values,
            encode_tile(values, replace(SETTINGS, quantum=0.002), error=0.001, own=True).data,
        ),
        "missing": (holes, encode_tile(holes, SETTINGS, error=0.04, own=True).data),
        "empty": (
            holes,
            encode_tile(holes, coarse, care=np.zeros(holes.shape, bool), own=True).data,
        ),
        "exact": (holes, exact_tile(holes).data),
        "whole numbers": (
            (values * 50).astype("i2"),
            encode_tile((values * 50).astype("i2"), replace(SETTINGS, high=99.0), own=True).data,
        ),
    }


@pytest.mark.parametrize("name", list(streams()))
def test_damage_is_found(name: str) -> None:
    values, data = streams()[name]
    sound = decode_tile(data, values.shape, values.dtype)
    damaged = [data[:n] for n in range(len(data))] + [data + b"\0", data + b"\x01a"]
    damaged += [
        data[:n] + bytes([data[n] ^ 1 << bit]) + data[n + 1 :]
        for n in range(len(data))
        for bit in range(8)
    ]
    refused = 0
    for other in damaged:
        try:
            assert same(decode_tile(other, values.shape, values.dtype), sound)
        except DamagedFileError:
            refused += 1
    assert refused > 0.95 * len(damaged)


@pytest.mark.parametrize("name", list(streams()))
def test_other_sections_than_the_flags_say_are_damage_before_anything_is_decoded(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values, data = streams()[name]
    parts = parts_of(data)
    head = data[:5] if parts.coded else data[:1]
    assert head + b"".join(map(section, parts.sections())) == data

    def decoded(*_: object) -> None:
        pytest.fail("decoded")

    for function in ("decode_integers", "decode_predicted", "exact_values"):
        monkeypatch.setattr(decoding, function, decoded)
    for sections in ([*parts.sections(), b""], parts.sections()[:-1]):
        with pytest.raises(DamagedFileError, match="sections; its flags say"):
            decode_tile(head + b"".join(map(section, sections)), values.shape, values.dtype)


@pytest.mark.parametrize(
    "change",
    [
        {"step": 10**400},
        {"step": 1e300},
        {"step": "1"},
        {"range": 3},
        {"transform": []},
        {"center": None},
    ],
)
def test_hostile_settings_are_damage(
    change: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {**SETTINGS.to_dict(), **change}
    monkeypatch.setattr(TileSettings, "to_dict", lambda self: values)
    data = encode_tile(wave(), SETTINGS, own=True).data
    with pytest.raises(DamagedFileError, match="settings"):
        decode_tile(data, SHAPE, np.float32)


def test_shared_settings_are_needed() -> None:
    with pytest.raises(FhashError, match="no settings"):
        decode_tile(encode_tile(wave(), SETTINGS).data, SHAPE, np.float32)


PLAIN = TransformSpec(axes=(AxisTransform(kind="none"),) * 4)
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


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("case", BEYOND)
def test_numbers_that_end_in_infinities_are_damage(
    case: str, native: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Infinities of the source have marks of their own: what else decodes to one was made to."""
    changes, dtype = BEYOND[case]
    monkeypatch.setenv("FHASH_NATIVE", native)
    settings = TileSettings(
        **{
            "transform": PLAIN,
            "step": 1.0,
            "center": 0.0,
            "low": -9.0,
            "high": 9.0,
            "quantum": 0.1,
            **changes,
        }
    )
    integers = np.full(SHAPE, 100, np.int32)
    coded = encode_integers(integers, single_band(SHAPE)).data
    for residual in (None, integers) if "residual" not in case else (integers,):
        data = assembled(None, b"", coded, integers, residual, None)
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(data, SHAPE, dtype, settings)
    if "residual" not in case:
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(assembled(None, b"", b"", None, None, None), SHAPE, dtype, settings)


@pytest.mark.parametrize("native", ["0", "1"])
def test_a_transform_that_overflows_gives_no_warning(
    native: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FHASH_NATIVE", native)
    settings = replace(SETTINGS, step=3e38, quantum=0.0)
    integers = np.full(SHAPE, 1000, np.int32)
    data = assembled(
        None, b"", encode_integers(integers, band_table(SPEC, SHAPE)).data, integers, None, None
    )
    assert not np.isinf(decode_tile(data, SHAPE, np.float32, settings)).any()


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("native", ["0", "1"])
def test_a_basis_longer_than_the_tile_is_damage_before_anything_is_decoded(
    axis: int, native: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its bands would lie beyond the tile: the decoder wrote behind the end of its array."""
    monkeypatch.setenv("FHASH_NATIVE", native)
    n = SHAPE[axis] + 3
    basis = Basis(integers=np.eye(n, dtype=np.int32), exponents=(0,) * n)
    axes = [AxisTransform(kind="none")] * 4
    axes[axis] = AxisTransform(kind="klt", basis=basis)
    settings = replace(
        SETTINGS, transform=TransformSpec(axes=(axes[0], axes[1], axes[2], axes[3])), quantum=0.0
    )
    integers = np.zeros(SHAPE, np.int32)
    for coded in (b"", bytes(range(40))):
        with pytest.raises(DamagedFileError, match="do not fit its shape"):
            decode_tile(
                assembled(None, b"", coded, integers, None, None), SHAPE, np.float32, settings
            )
    with pytest.raises(InputError, match="basis along"):
        band_table(settings.transform, SHAPE)
