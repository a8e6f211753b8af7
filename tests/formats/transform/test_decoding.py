"""The decoder of tiles: levels of detail, damage, and hostile settings and numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from specs import spec_of
from tiles import SETTINGS, SPEC, damaged_copies, random_head, resealed, streams, wave
from tiles import SHAPE as SHAPE_DECODING

from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.transform.coder import encode_integers, single_band
from fhash_formats.transform.decoding import corrected_part, decode_tile, uncorrected
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.lifting import band_table
from fhash_formats.transform.spec import AxisTransform, Basis, TransformSpec
from fhash_formats.transform.tile_format import EMPTY, TRANSFORMED, TileSettings, build_stream


def test_reduced_resolution_is_the_low_band() -> None:
    coded = encode_tile(np.full(SHAPE_DECODING, 2.25, np.float32), SETTINGS)
    coarse = decode_tile(coded.data, SHAPE_DECODING, np.float32, SETTINGS, lod=1)
    assert coarse.shape == (2, 2, 4, 5)
    assert np.abs(coarse - 2.25).max() < 0.1


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
        decode_tile(encode_tile(wave(), SETTINGS).data, SHAPE_DECODING, np.float32)


PLAIN = spec_of(("none",) * 4, 0, SHAPE_DECODING)
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
    integers = np.full(SHAPE_DECODING, 100, np.int32)
    coded = encode_integers(integers, single_band(SHAPE_DECODING)).data
    for residual in (None, integers) if "residual" not in case else (integers,):
        data = build_stream(TRANSFORMED, None, body=coded, residual=residual)
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(data, SHAPE_DECODING, dtype, settings)
    if "residual" not in case:
        with pytest.raises(DamagedFileError, match="beyond"):
            decode_tile(build_stream(EMPTY, None), SHAPE_DECODING, dtype, settings)


@pytest.mark.parametrize(("quantum", "dtype"), [(1e300, "float32"), (1e308, "float64")])
def test_clipped_values_end_in_the_range_whatever_their_residual(
    quantum: float, dtype: str
) -> None:
    settings = TileSettings(
        transform=PLAIN, step=1.0, center=0.0, low=-9.0, high=9.0, quantum=quantum, clip=True
    )
    coefficients = np.zeros(SHAPE_DECODING, np.int32)
    residual = np.full(SHAPE_DECODING, 100, np.int32)
    residual[0] *= -1
    coded = encode_integers(coefficients, single_band(SHAPE_DECODING)).data
    data = build_stream(TRANSFORMED, None, body=coded, residual=residual)
    decoded = decode_tile(data, SHAPE_DECODING, dtype, settings)
    np.testing.assert_array_equal(decoded, np.where(residual < 0, -9.0, 9.0))


def test_a_transform_that_overflows_gives_no_warning() -> None:
    settings = replace(SETTINGS, step=3e38, quantum=0.0)
    integers = np.full(SHAPE_DECODING, 1000, np.int32)
    coded = encode_integers(integers, band_table(SPEC, SHAPE_DECODING)).data
    data = build_stream(TRANSFORMED, None, body=coded)
    assert not np.isinf(decode_tile(data, SHAPE_DECODING, np.float32, settings)).any()


@pytest.mark.parametrize("axis", range(4))
def test_a_basis_longer_than_the_tile_is_damage_before_anything_is_decoded(axis: int) -> None:
    """Its bands would lie beyond the tile, and a decoder would write behind its array."""
    n = SHAPE_DECODING[axis] + 3
    basis = Basis(integers=np.eye(n, dtype=np.int32), exponents=(0,) * n)
    axes = [AxisTransform(kind="none")] * 4
    axes[axis] = AxisTransform(kind="klt", basis=basis)
    t, z, y, x = axes
    settings = replace(SETTINGS, transform=TransformSpec(axes=(t, z, y, x)), quantum=0.0)
    for coded in (b"", bytes(range(40))):
        data = build_stream(TRANSFORMED, None, body=coded)
        with pytest.raises(DamagedFileError, match="do not fit its shape"):
            decode_tile(data, SHAPE_DECODING, np.float32, settings)
    with pytest.raises(InputError, match="basis along"):
        band_table(settings.transform, SHAPE_DECODING)


SHAPE = (4, 12, 13, 14)
PARTS = {
    "corner": ((0, 1), (0, 2), (0, 3), (0, 1)),
    "far corner": ((3, 4), (10, 12), (11, 13), (13, 14)),
    "inside": ((1, 3), (4, 6), (5, 7), (6, 7)),
    "edge": ((0, 4), (0, 1), (6, 7), (11, 14)),
}


def settings_of(cross: bool) -> object:
    hidden = (5, 4) if cross else (12, 8)
    spec = spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), SHAPE)
    head = random_head(hidden, cross=cross, spread=16.0)
    return replace(SETTINGS, transform=spec, quantum=0.0, head=head, clip=True)


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16"])
@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("name", list(PARTS))
def test_a_part_has_the_bits_of_the_whole(name: str, cross: bool, dtype: str) -> None:
    settings, values = settings_of(cross), wave(SHAPE, dtype)
    data = encode_tile(values, settings).data
    whole = decode_tile(data, SHAPE, dtype, settings)
    part = tuple(slice(*span) for span in PARTS[name])
    table = uncorrected(data, SHAPE, dtype, settings, part)
    assert table is not None
    before = table.copy()
    found = corrected_part(table, part, dtype, settings)
    assert found.dtype == whole.dtype
    assert found.tobytes() == whole[part].tobytes()
    everything = tuple(slice(0, n) for n in SHAPE)
    assert corrected_part(table, everything, dtype, settings).tobytes() == whole.tobytes()
    assert table.tobytes() == before.tobytes()
    assert (table[part] != whole[part]).any() or dtype == "int16"  # otherwise nothing is tested


def test_tiles_with_more_than_a_head_are_decoded_whole() -> None:
    settings, values = settings_of(cross=False), wave(SHAPE)
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
        assert uncorrected(coded.data, SHAPE, "float32", used, part) is None, name


def test_a_large_part_is_decoded_whole() -> None:
    settings = settings_of(cross=False)
    data = encode_tile(wave(SHAPE), settings).data
    frame = (slice(0, 1), *(slice(0, n) for n in SHAPE[1:]))
    assert uncorrected(data, SHAPE, "float32", settings, frame) is None
