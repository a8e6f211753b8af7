"""Passes over values, also over difficult ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import dask.array
import numcodecs
import numpy as np
import numpy.typing as npt
import pytest
import xarray
import zarr
from reference.elementwise import (
    clip_shifted,
    clipped,
    corrected,
    dequantise,
    free_values,
    quantise,
    residual_of,
    within,
)
from specs import spec_of
from zarr.codecs import BytesCodec, Crc32cCodec, ShardingCodec
from zarr.codecs.numcodecs import FixedScaleOffset

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.numcodecs_codec import NumcodecsTransform
from fhash_formats.transform.tile import encode_chunk, encode_tile
from fhash_formats.transform.tile_format import TileSettings
from fhash_formats.transform.values import PIECE, all_finite, cast
from fhash_formats.transform.zarr_codec import TransformCodec

Values = npt.NDArray[Any]
SHAPE = (2, 5, 7, 311)  # more than a native piece, and not a multiple of anything
LARGEST = 2**30 - 1
TYPES = ["f2", "f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]


def values(dtype: npt.DTypeLike, seed: int = 0, special: bool = True) -> Values:
    rng, kind = np.random.default_rng(seed), np.dtype(dtype)
    if kind.kind != "f":
        limits = np.iinfo(kind)
        integers = rng.integers(limits.min, limits.max, SHAPE, dtype=kind, endpoint=True)
        integers.flat[:3] = limits.min, limits.max, 0
        return integers
    result = rng.normal(0, 2, SHAPE).astype(kind)
    if special:
        limits_of = np.finfo(kind)
        hard = [
            np.nan,
            np.inf,
            -np.inf,
            0.0,
            -0.0,
            limits_of.max,
            limits_of.min,
            limits_of.tiny,
            0.5,
            1.5,
            2.5,
            -0.5,
        ]
        result.reshape(-1)[100 : 100 + 144] = np.repeat(np.array(hard, kind), 12)
        result.reshape(-1)[300:312] = np.array(hard, kind)
    return result


def mask(seed: int = 3) -> npt.NDArray[np.bool_]:
    return np.random.default_rng(seed).random(SHAPE) < 0.7


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("counted", [None, mask()])
def test_bounds(dtype: str, counted: Any) -> None:
    given = values(dtype, special=False)
    step = np.dtype(dtype).type(0.25)
    other = given + step
    error = float(np.abs(given.astype("f8") - other.astype("f8")).max())
    assert within(given, other, np.nextafter(error, 1), counted)
    assert not within(given, other, 0.24, counted)
    at = (1, 4, 6, 310)
    for bad in (np.nan, np.inf):
        other = given.copy()
        other[at] = bad
        expected = counted is not None and not counted[at]
        assert within(given, other, 1.0, counted) == expected
    special = values(dtype)
    assert not within(special, special, 0.0)  # NaN is near nothing
    plain = np.where(np.isnan(special), 0, special).astype(dtype)
    assert within(plain, plain, 0.0)
    assert within(plain, plain[::-1].copy(), float("inf"))


def test_within_is_strict_to_the_last_bit() -> None:
    values = np.array([2**63 - 1, 0, -(2**63)])
    assert within(values, np.array([-(2**63), 0, -(2**63)]), float(2**64))
    assert not within(values, np.array([-(2**63), 0, -(2**63)]), float(2**63))
    assert within(np.array([5]), np.array([8]), 3.0)
    assert not within(np.array([5]), np.array([8]), 2.999)
    assert not within(np.array([1.0]), np.array([np.nan]), 1e300)
    assert not within(np.array([0.1]), np.array([0.4]), 0.3)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("base", ["f4", "f8"])
@pytest.mark.parametrize("quantum", [0.5, 0.1, 3.0, 1e-3])
@pytest.mark.parametrize("counted", [None, mask()])
def test_residuals(dtype: str, base: str, quantum: float, counted: Any) -> None:
    given, other = values(dtype, 1, special=False), values(base, 2, special=False)
    # Halves are rounded to even, and an error of half a quantum is none.
    given[0, 0, 0, :40] = np.arange(40) * np.dtype(dtype).type(quantum / 2)
    other[0, 0, 0, :40] = 0
    result = residual_of(given, other, counted, quantum, LARGEST)
    assert result is not None
    error = given.astype("f8") - other.astype("f8")
    expected = np.where(np.abs(error) > quantum / 2, np.rint(error / quantum), 0)
    expected = expected if counted is None else np.where(counted, expected, 0)
    np.testing.assert_array_equal(result[0], expected)
    assert result[1] == np.count_nonzero(expected) > 0
    wide = other.astype("f8") + result[0] * quantum
    for out in ("f4", "f8", "f2", "i2"):
        found = corrected(other, result[0], quantum, np.dtype(out))
        assert found.tobytes() == cast(wide, np.dtype(out)).tobytes()
    rest = given.astype("f8") - corrected(other, result[0], quantum, np.dtype("f8"))
    assert np.abs(rest if counted is None else rest[counted]).max() <= quantum / 2 * (1 + 1e-9)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_residuals_beyond_the_largest_integer(dtype: str) -> None:
    given, zeros = values(dtype), np.zeros(SHAPE, dtype)
    assert residual_of(given, zeros, None, 0.5, LARGEST) is None
    counted = np.isfinite(given) & (np.abs(given) < 1e3)
    assert residual_of(given, zeros, counted, 0.5, LARGEST)[1] > 0
    assert residual_of(given, zeros, counted, 0.0, LARGEST) is None
    last = np.zeros(SHAPE, dtype)
    last[-1, -1, -1, -1] = 1000
    assert residual_of(last, zeros, None, 1.0, 999) is None
    assert residual_of(last, zeros, None, 1.0, 1000)[1] == 1


@pytest.mark.parametrize("dtype", TYPES)
def test_every_type_has_residuals_and_bounds(dtype: str) -> None:
    given = values(dtype, special=False)
    base = given.astype("f8") * (1 - 1e-3) + 0.3
    result = residual_of(given, base, None, 2.0 ** (np.dtype(dtype).itemsize * 4), LARGEST)
    assert result is not None
    decoded = corrected(base, result[0], 2.0 ** (np.dtype(dtype).itemsize * 4), np.dtype(dtype))
    assert decoded.dtype == dtype
    assert within(given, decoded, 2.0**64)
    assert within(given, given, 0.0)
    assert not within(given, given[::-1].copy(), 0.0)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize(
    ("low", "high"),
    [(-1.0, 1.0), (0.0, 2.0), (-0.0, 2.0), (-2.0, -0.0), (-0.0, 0.0), (-1e300, 1e300)],
)
@pytest.mark.parametrize("center", [0.0, -0.0, 0.75])
def test_clipping(dtype: str, low: float, high: float, center: float) -> None:
    with np.errstate(over="ignore"):
        clipped = clip_shifted(values(dtype), center, low, high)
        kind = np.dtype(dtype).type
        moved = values(dtype) + kind(center)
        expected = np.where(moved < kind(low), kind(low), moved)
        expected = np.where(expected > kind(high), kind(high), expected)
        assert clipped.tobytes() == expected.astype(dtype).tobytes()
        numbers = clipped[~np.isnan(clipped)]
        assert numbers.min() >= np.dtype(dtype).type(low)
        assert numbers.max() <= np.dtype(dtype).type(high)
    assert np.isnan(clipped).sum() == np.isnan(values(dtype)).sum()


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("counted", [None, mask()])
def test_free_values_are_replaced_and_counted(dtype: str, counted: Any) -> None:
    rebuilt = values(dtype, 5)
    target = values(dtype, 4)
    total = free_values(target, rebuilt, counted, -1.0, 1.5)
    before = values(dtype, 4)
    free = ((before <= -1) & (rebuilt < before)) | ((before >= 1.5) & (rebuilt > before))
    free = free if counted is None else free | ~counted
    assert total == free.sum() > 0
    assert np.array_equal(target, np.where(free, rebuilt, before), equal_nan=True)


def test_empty_arrays() -> None:
    none = np.zeros((0, 1, 2, 3), np.float32)
    assert within(none, none, 0.0)
    assert residual_of(none, none, None, 1.0, LARGEST)[1] == 0
    assert corrected(none, np.zeros(none.shape, np.int32), 1.0, np.dtype("f8")).size == 0
    assert free_values(none.copy(), none, None, 0.0, 1.0) == 0
    assert all_finite(none)


def test_finite() -> None:
    assert all_finite(np.arange(5))
    for bad in (np.nan, np.inf, -np.inf):
        given = np.zeros(3 * PIECE + 5, np.float32)
        assert all_finite(given)
        given[-1] = bad
        assert not all_finite(given)


def test_casts_stay_in_the_type() -> None:
    wide = np.array([np.nan, np.inf, -np.inf, 1e30, -1e30, 2.5, 3.5, -0.5])
    assert cast(wide, np.dtype("i2")).tolist() == [0, 32767, -32768, 32767, -32768, 2, 4, 0]
    assert cast(wide, np.dtype("u8")).tolist()[1] == 2**64 - 2048
    assert cast(wide, np.dtype("f4"))[3] == np.float32(1e30)


def test_arrays_that_are_not_in_order() -> None:
    given = values("f4", special=False)
    turned = np.asfortranarray(given)
    assert within(turned, given, 0.0)
    result = residual_of(turned, given + np.float32(1), None, 0.5, LARGEST)
    assert result is not None
    assert (result[0] == -2).all()


@pytest.mark.parametrize("dtype", TYPES)
def test_values_are_clipped_in_their_own_type(dtype: str) -> None:
    original = values(dtype)
    low, high = (-0.3, 1.1) if original.dtype.kind == "f" else (3.0, 90.0)
    ends = np.array([low, high]).astype(dtype)
    result = clipped(original.copy(), low, high)
    below, above = original < ends[0], original > ends[1]
    assert np.array_equal(result[below], np.full(below.sum(), ends[0]))
    assert np.array_equal(result[above], np.full(above.sum(), ends[1]))
    kept = ~(below | above)
    assert result[kept].tobytes() == original[kept].tobytes()


def test_clipping_keeps_the_signs_of_zeros_and_reaches_every_view() -> None:
    zeros = clipped(np.array([-0.0, 0.0, np.nan, -1.0], "f4"), 0.0, 1.0)
    assert np.signbit(zeros).tolist() == [True, False, False, False]
    assert np.isnan(zeros[2])
    turned = np.arange(-6.0, 6.0).reshape(3, 4).T
    assert clipped(turned, -1.0, 2.0) is turned
    assert (turned.min(), turned.max()) == (-1.0, 2.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_magnitudes_are_rounded_down_after_the_rounding_is_added(dtype: Any) -> None:
    coefficients = np.array([0.0, 0.25, -0.375, 0.5, -1.0, 3e12], dtype)
    integers, scaled = quantise(coefficients, 0.5)
    assert integers.tolist() == [0, 0, -1, 1, -2, 10**9]
    assert scaled.tolist() == [0.0, 0.5, -0.75, 1.0, -2.0, float(np.float32(6e12))]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_six_offsets_tell_odd_from_even(dtype: Any) -> None:
    integers = np.array([0, 1, -2, 3, -4, 5, 6, -7, 1000], np.int32)
    values = dequantise(integers, 1.0, (64, 32, 16, 8, -64, -32), dtype)
    assert values.tolist() == [0.0, 1.5, -2.25, 3.125, -4.0625, 4.5, 5.75, -6.5, 999.75]


WAVES = spec_of(("haar", "9/7", "9/7", "9/7"), 1, (2, 2, 2, 2))
SHARED = TileSettings(transform=WAVES, step=0.05, center=0.0, low=-3.0, high=3.0)


def field(
    shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32, scale: float = 1.0
) -> npt.NDArray[Any]:
    grid = np.meshgrid(*(np.linspace(0, 3, n) for n in shape), indexing="ij")
    return (scale * (1 + np.sin(sum((i + 1) * x for i, x in enumerate(grid))))).astype(dtype)


def create(store: Any, values: npt.NDArray[Any], chunks: tuple[int, ...], **options: Any) -> Any:
    options = {
        "serializer": TransformCodec(max_error=0.01),
        "compressors": None,
        "fill_value": np.nan if values.dtype.kind == "f" else 0,
        **options,
    }
    array = zarr.create_array(
        store, shape=values.shape, chunks=chunks, dtype=values.dtype, **options
    )
    array[...] = values
    return array


@pytest.mark.parametrize("shape", [(50,), (13, 20), (5, 9, 12), (3, 4, 9, 10), (2, 2, 3, 5, 6)])
def test_arrays_come_back_within_the_bound(tmp_path: Path, shape: tuple[int, ...]) -> None:
    values = field(shape)
    values.flat[3] = np.nan
    create(tmp_path / "a.zarr", values, tuple((n + 1) // 2 for n in shape))
    read = zarr.open_array(tmp_path / "a.zarr", mode="r")
    assert (
        json.loads((tmp_path / "a.zarr" / "zarr.json").read_text())["codecs"][0]["name"]
        == "fhash.transform"
    )
    assert np.isnan(read[...].flat[3])
    assert np.nanmax(np.abs(read[...] - values)) <= 0.01
    region = tuple(slice(1, n - 1) for n in shape)
    assert np.array_equal(read[region], read[...][region], equal_nan=True)


def test_all_three_qualities_are_kept_in_the_metadata(tmp_path: Path) -> None:
    for n, codec in enumerate(
        (
            TransformCodec(max_error=0.5),
            TransformCodec(max_error_rel=0.01, effort=1),
            TransformCodec(step=0.1, transform=WAVES),
            TransformCodec(settings=SHARED),
        )
    ):
        create(tmp_path / f"{n}.zarr", field((4, 6, 8)), (4, 6, 8), serializer=codec)
        assert zarr.open_array(tmp_path / f"{n}.zarr", mode="r").serializer == codec
        assert TransformCodec.from_dict(codec.to_dict()) == codec


def test_settings_that_all_chunks_share_in_shards_with_checksums(tmp_path: Path) -> None:
    values = field((4, 4, 8, 8))
    for n, codec in enumerate((TransformCodec(settings=SHARED), TransformCodec(max_error=0.05))):
        shards = ShardingCodec(
            chunk_shape=(2, 4, 4, 8),
            codecs=[codec, Crc32cCodec()],
            index_codecs=[BytesCodec(), Crc32cCodec()],
        )
        create(tmp_path / f"{n}.zarr", values, (4, 4, 8, 8), serializer=shards)
        read = zarr.open_array(tmp_path / f"{n}.zarr", mode="r")
        assert np.abs(read[...] - values).max() <= 0.1
        assert np.array_equal(read[2:, 1, 4:, 3], read[...][2:, 1, 4:, 3])


def test_an_empty_configuration_reads_streams_with_their_own_settings(tmp_path: Path) -> None:
    values = field((2, 3, 8, 8))
    create(tmp_path / "a.zarr", values, values.shape)
    written = zarr.open_array(tmp_path / "a.zarr", mode="r")[...]
    path = tmp_path / "a.zarr" / "zarr.json"
    path.write_text(
        json.dumps(
            {
                **json.loads(path.read_text()),
                "codecs": [{"name": "fhash.transform", "configuration": {}}],
            }
        )
    )
    array = zarr.open_array(tmp_path / "a.zarr", mode="r+")
    assert np.array_equal(array[...], written)
    with pytest.raises(InputError, match="only decodes"):
        array[...] = values


def test_shared_settings_give_the_tile_that_containers_have(tmp_path: Path) -> None:
    values = field((2, 3, 8, 8))
    create(tmp_path / "a.zarr", values, values.shape, serializer=TransformCodec(settings=SHARED))
    stored = (tmp_path / "a.zarr" / "c" / "0" / "0" / "0" / "0").read_bytes()
    assert stored == encode_tile(values, SHARED).data


def test_padding_with_nan_leaves_the_relative_bound(tmp_path: Path) -> None:
    values = field((7, 11)) + 1000
    read = create(
        tmp_path / "a.zarr", values, (5, 8), serializer=TransformCodec(max_error_rel=0.001)
    )[...]
    assert np.abs(read - values).max() <= 0.001 * np.ptp(values)


@pytest.mark.parametrize("dtype", ["i4", "f4", "i8", "u2", "f8"])
@pytest.mark.parametrize("shards", [None, (10, 16)])
@pytest.mark.parametrize("fill", [0, 9])
def test_padding_leaves_the_relative_bound(
    dtype: str, shards: tuple[int, int] | None, fill: float
) -> None:
    base = {"u2": 60_000, "i8": 2**61}.get(dtype, 1_900_000_000)
    values = (base + np.random.default_rng(0).integers(0, 50, (17, 21))).astype(dtype)
    codec = TransformCodec(max_error_rel=0.1)
    options: dict[str, Any] = {"serializer": codec, "fill_value": fill, "shards": shards}
    whole = create(zarr.storage.MemoryStore(), values, (5, 8), **options)
    bound = 0.1 * float(np.ptp(values))
    assert np.abs((whole[...] - values).astype(float)).max() <= bound
    # Chunks that were coded beside fill values are coded once more with the others.
    parts = create(zarr.storage.MemoryStore(), np.full_like(values, fill), (5, 8), **options)
    for part in (np.s_[:7, :9], np.s_[7:, 9:], np.s_[:7, 9:], np.s_[7:, :9]):
        parts[part] = values[part]
    assert np.abs((parts[...] - values).astype(float)).max() <= 4 * bound


@pytest.mark.parametrize("bound", [{"max_error": 0.02}, {"max_error_rel": 0.01}])
@pytest.mark.parametrize(
    ("fill", "missing", "declared"),
    [(0.5, (), 0.5), (0, (), 0), (-999, (), np.nan), (0.5, (0.5,), np.nan), (0.25, (0.5, 0.25), 7)],
)
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_missing_values_come_back_and_weaken_no_bound(
    fill: float,
    missing: tuple[float, ...],
    declared: float,
    bound: dict[str, float],
    zarr_format: Any,
) -> None:
    """The fill value, values far from the others, and those that the caller names; numcodecs does
    not know the fill value."""
    y, x = np.mgrid[0:20, 0:30]
    values = (np.sin(x / 7) * np.cos(y / 5)).astype("f4")
    gone = (np.abs(y - 9) < 4) & (np.abs(x - 12) < 9)
    values[gone] = fill
    options: dict[str, Any] = {"serializer": TransformCodec(**bound, missing=missing)}
    if zarr_format == 2:
        named = (*missing, declared)
        options = {"filters": None, "compressors": NumcodecsTransform(**bound, missing=named)}
    array = zarr.create_array(
        zarr.storage.MemoryStore(),
        shape=values.shape,
        chunks=(12, 30),
        dtype="f4",
        fill_value=declared,
        zarr_format=zarr_format,
        **{"compressors": None, **options},
    )
    array[...] = values
    found = zarr.open_array(array.store)[...]
    assert found[gone].tobytes() == values[gone].tobytes()
    assert np.abs(found - values)[~gone].max() <= 0.02


def test_missing_values_that_are_none_are_refused() -> None:
    for given in (5, "a", [[1]], [None], range(17)):
        with pytest.raises(InputError, match="a list of at most 16 numbers"):
            TransformCodec(max_error=1, missing=given)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="a list of at most 16 numbers"):
            NumcodecsTransform(max_error=1, missing=given)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"has 0\.5, which is no int16"):
        NumcodecsTransform(max_error=1, missing=[0.5]).encode(np.zeros((3, 4), "i2"))


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr")
def test_padding_that_a_filter_changed_leaves_the_relative_bound() -> None:
    values = np.random.default_rng(0).normal(5000, 1, (17, 21))
    array = zarr.create_array(
        zarr.storage.MemoryStore(),
        shape=values.shape,
        chunks=(5, 8),
        dtype="f8",
        fill_value=0.0,
        filters=FixedScaleOffset(offset=-7.0, scale=100.0, dtype="f8", astype="f8"),
        serializer=TransformCodec(max_error_rel=0.1),
        compressors=None,
    )
    array[...] = values
    assert np.abs(array[...] - values).max() <= 0.1 * np.ptp(values) + 0.005


def test_xarray_writes_and_reads_lazily(tmp_path: Path) -> None:
    values = field((3, 4, 8, 10))
    data = xarray.Dataset({"speed": (("t", "z", "y", "x"), values)}, {"t": [0.0, 0.5, 1.0]})
    encoding = {
        "speed": {
            "serializer": TransformCodec(max_error=0.01),
            "compressors": None,
            "chunks": (2, 4, 4, 10),
        }
    }
    data.to_zarr(tmp_path / "a.zarr", zarr_format=3, encoding=encoding, consolidated=False)
    with xarray.open_zarr(tmp_path / "a.zarr", consolidated=False) as read:
        assert isinstance(read["speed"].data, dask.array.Array)
        assert np.abs(read["speed"].isel(t=1).compute().values - values[1]).max() <= 0.01
        assert read["t"].values.tolist() == [0.0, 0.5, 1.0]


def test_a_damaged_chunk_is_an_error(tmp_path: Path) -> None:
    create(tmp_path / "a.zarr", field((8, 8)), (8, 8))
    path = tmp_path / "a.zarr" / "c" / "0" / "0"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DamagedFileError):
        zarr.open_array(tmp_path / "a.zarr", mode="r")[...]


@pytest.mark.parametrize("dtype", ["bool", "complex64"])
def test_unsuitable_types_are_refused_at_creation(dtype: str) -> None:
    with pytest.raises(InputError, match="codes float16"):
        zarr.create_array(
            {},
            shape=(4,),
            chunks=(4,),
            dtype=dtype,
            serializer=TransformCodec(max_error=1),
            compressors=None,
        )


def test_unsuitable_configurations_are_refused() -> None:
    with pytest.raises(InputError, match="one of max_error"):
        TransformCodec()
    with pytest.raises(InputError, match="nothing else"):
        TransformCodec(max_error=1, settings=SHARED)
    with pytest.raises(InputError, match="nothing else"):
        TransformCodec(effort=3, settings=SHARED)
    for configuration, said in (
        ({"max_eror": 1}, "max_eror"),
        ({"max_error": "a"}, "max_error"),
        ({"max_error": 1, "effort": 10}, "effort is 10; a whole number from 1 to 9"),
        ({"center": 1}, "transform|missing"),
    ):
        with pytest.raises(InputError, match=said):
            TransformCodec.from_dict({"name": "fhash.transform", "configuration": configuration})


def test_a_codec_is_shown_in_one_short_line() -> None:
    for codec, shown in (
        (TransformCodec(max_error=0.5), "TransformCodec(max_error=0.5)"),
        (TransformCodec(reading=True), "TransformCodec(reading=True)"),
        (TransformCodec(settings=SHARED), "TransformCodec(step=0.05)"),
    ):
        assert repr(codec) == shown


@pytest.mark.parametrize(
    "codec",
    [
        TransformCodec(max_error=0.01, axes=("t", "y", "x")),
        TransformCodec(settings=SHARED, axes=("t", "y", "x")),
        TransformCodec(reading=True, axes=["t", "y", "x"]),
    ],
    ids=["quality", "settings", "reading"],
)
def test_axes_stand_in_the_metadata(codec: TransformCodec) -> None:
    document = json.loads(json.dumps(codec.to_dict()))
    assert document["configuration"]["axes"] == ["t", "y", "x"]
    assert TransformCodec.from_dict(document).to_dict() == codec.to_dict()


def test_an_array_is_coded_along_the_axes_that_are_named(tmp_path: Path) -> None:
    values = field((6, 9, 12))
    codec = TransformCodec(max_error=0.01, axes=("t", "y", "x"))
    create(tmp_path / "a.zarr", values, (3, 9, 6), serializer=codec)
    assert np.abs(zarr.open_array(tmp_path / "a.zarr", mode="r")[...] - values).max() <= 0.01
    tile = np.ascontiguousarray(values[:3, :, :6])[:, None]
    assert (tmp_path / "a.zarr" / "c" / "0" / "0" / "0").read_bytes() == encode_chunk(
        tile, max_error=0.01
    )


def test_axes_of_another_array_are_refused(tmp_path: Path) -> None:
    codec = TransformCodec(max_error=0.01, axes=("t", "x"))
    with pytest.raises(InputError, match="with 3 axes"):
        create(tmp_path / "a.zarr", field((6, 9, 12)), (3, 9, 6), serializer=codec)


def test_it_is_found_by_its_name_and_configuration() -> None:
    transform = {"t": "none", "z": "none", "y": ["9/7", 1], "x": ["9/7", 1]}
    for config in (
        {"max_error": 0.5},
        {"max_error": 0.5, "effort": 4},
        {"max_error_rel": 0.01},
        {"step": 2.0, "transform": transform},
    ):
        codec = numcodecs.get_codec({"id": "fhash.transform", **config})
        assert isinstance(codec, NumcodecsTransform)
        assert codec.get_config() == {"id": "fhash.transform", **config}
        assert numcodecs.get_codec(codec.get_config()) == codec


@pytest.mark.parametrize(
    "dtype", ["f2", "f4", "f8", ">f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"]
)
@pytest.mark.parametrize("shape", [(), (0, 3), (40,), (6, 8), (2, 3, 4, 5), (2, 1, 3, 4, 5)])
def test_shape_and_type_come_back(dtype: str, shape: tuple[int, ...]) -> None:
    values = (np.arange(np.prod(shape)).reshape(shape) % 120).astype(dtype)
    codec = NumcodecsTransform(max_error=1)
    decoded = codec.decode(codec.encode(values))
    assert decoded.shape == shape
    assert decoded.dtype == np.dtype(dtype).newbyteorder("=")
    assert np.abs(decoded.astype(float) - values.astype(float)).max(initial=0) <= 1
    out = np.empty(shape, decoded.dtype)
    assert codec.decode(codec.encode(values), out) is out
    assert np.array_equal(out, decoded)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("fill", [0, None, 5])
def test_padding_in_zarr_format_2_leaves_the_relative_bound(order: str, fill: int | None) -> None:
    values = (1_900_000_000 + np.random.default_rng(0).integers(0, 50, (17, 21))).astype("i4")
    array = zarr.create_array(
        zarr.storage.MemoryStore(),
        shape=values.shape,
        chunks=(5, 8),
        dtype=values.dtype,
        zarr_format=2,
        filters=None,
        fill_value=fill,
        order=order,
        compressors=NumcodecsTransform(max_error_rel=0.1),
    )
    array[...] = values
    assert np.abs(array[...] - values).max() <= 0.1 * np.ptp(values)


def test_damage_and_bytes_are_refused() -> None:
    codec = NumcodecsTransform(max_error=0.01)
    values = np.sin(np.arange(30.0)).reshape(5, 6)
    data = codec.encode(values)
    sound = codec.decode(data)
    for n in range(len(data)):
        for damaged in (data[:n], data[:n] + bytes([data[n] ^ 0x10]) + data[n + 1 :]):
            try:
                decoded = codec.decode(damaged)
            except DamagedFileError:
                continue
            assert n >= 27
            assert np.array_equal(decoded, sound)
    with pytest.raises(InputError, match="not bytes"):
        codec.encode(b"abcd")
    with pytest.raises(InputError, match="one of max_error"):
        NumcodecsTransform()
