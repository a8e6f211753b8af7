"""Tiles coded by prediction: bound, missing values, levels of detail, masks, hostile bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from specs import spec_of

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.coder import MaskLevels
from fhash_formats.transform.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.predict import Predictor, passes_of
from fhash_formats.transform.tile_format import EXACT, KIND, PREDICTED, TileSettings

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
