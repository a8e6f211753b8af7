"""Integers stay integers: the types that values decode to, and fill values."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.coreset.boxes import Box
from fhash_codec.value_type import decoded_type, holds, placed, rounded
from fhash_formats.series import ArraySeries

QUICK = {"effort": 1, "timings": False}


def labels(dtype: str = "i2") -> np.ndarray:
    """Four labels in blocks that move along x."""
    x = (np.arange(12) + np.arange(3)[:, None, None, None]) // 3
    return np.broadcast_to(x * 7 + np.arange(5)[:, None] // 2, (3, 4, 5, 12)).astype(dtype)


class Holed(ArraySeries):
    """Integers with missing values, as a reader gives them: floats, NaN where the fill was."""

    def __init__(self, values: np.ndarray, fill: int | None) -> None:
        holes = np.zeros(values.shape, bool)
        holes[:, 1, 2:4, 3:6] = True
        super().__init__(np.where(holes, np.nan, values).astype(decoded_type(values.dtype)))
        self.source_dtype, self.fill = values.dtype, fill
        self.stored = np.where(holes, -1 if fill is None else fill, values).astype(values.dtype)


@pytest.mark.parametrize("dtype", ["i1", "u2", "i4", "i8", "u8"])
@pytest.mark.parametrize("promise", [{"max_error": 0.0}, {"max_error": 0.49}, {"max_error": 0.9}])
def test_a_bound_below_one_keeps_integers_exactly(tmp_path, dtype, promise) -> None:
    values = labels(dtype)
    if values.dtype.itemsize == 8:
        values += np.array(2**60 + 1, dtype)
    figures = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(**promise, **QUICK))
    assert figures["max_abs_error"] == 0
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert (volume.dtype, volume.fill) == (values.dtype, 0)
        np.testing.assert_array_equal(volume[...], values)
        np.testing.assert_array_equal(volume[1, :, ::-2, 3], values[1, :, ::-2, 3])
        assert volume[...].dtype == np.asarray(volume).dtype == values.dtype
        assert volume.read(1).dtype == volume.read_lod(1, 1).dtype == decoded_type(values.dtype)
        assert volume.values(0.5).dtype == decoded_type(values.dtype)


@pytest.mark.parametrize("promise", [{"psnr": 40.0}, {"max_error": 2.5}, {"psnr": 15.0}])
def test_other_promises_keep_the_type_as_well(tmp_path, promise) -> None:
    fhash_codec.encode(labels(), tmp_path / "a.fhz", EncodeConfig(**promise, **QUICK))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume[0].dtype == np.int16
        np.testing.assert_array_equal(volume[...], [volume.read(t) for t in range(3)])
        if "max_error" in promise:
            assert np.abs(volume[...] - labels()).max() <= 2


def test_vertices_without_a_value_need_a_fill_value(tmp_path) -> None:
    config = EncodeConfig(max_error=0.0, features=("interval:7:15",), dilation=0, **QUICK)
    fhash_codec.encode(labels(), tmp_path / "a.fhz", config)
    inside = (labels() >= 7) & (labels() <= 15)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert (volume.dtype, volume.fill) == (np.float32, None)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), np.nan))
    with fhash_codec.open(tmp_path / "a.fhz", fill=-5) as volume:
        assert (volume.dtype, volume.fill) == (np.int16, -5)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), -5))
        background = volume.values(0, outside="background")
        assert set(background[~inside[0]].tolist()) == {round(volume.background)}
    with fhash_codec.open(tmp_path / "a.fhz", fill=0.5) as volume:
        assert (volume.dtype, volume.fill) == (np.float32, 0.5)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), 0.5))


@pytest.mark.parametrize("promise", [{"max_error": 0.0}, {"max_error": 3.0}, {"psnr": 30.0}])
@pytest.mark.parametrize("fill", [-100, None])
def test_missing_integers_come_back_as_the_fill_value_of_the_source(
    tmp_path, promise, fill
) -> None:
    series = Holed(labels("i1"), fill)
    figures = fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(**promise, **QUICK))
    assert figures["raw_bytes"] == labels("i1").nbytes
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert "missing/bits" not in volume.container.arrays
        assert volume.dtype == (np.float32 if fill is None else np.int8)
        gaps = np.isnan(volume.read(0))
        np.testing.assert_array_equal(gaps, np.isnan(series.read(0)))
        np.testing.assert_array_equal(np.isnan(volume.read(0, outside="background")), gaps)
        if fill is not None:
            assert (volume[0][gaps] == fill).all()
        if promise == {"max_error": 0.0} and fill is not None:
            np.testing.assert_array_equal(volume[...], series.stored)


def test_floats_have_nan_unless_a_fill_value_is_asked_for(tmp_path) -> None:
    series = ArraySeries(np.where(labels() == 7, np.nan, labels()).astype("f4"))
    series.fill = 1e20
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0.5, **QUICK))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["variable"]["fill"] == 1e20
        assert np.isnan(volume[...]).any()
        assert volume.fill is None
    with fhash_codec.open(tmp_path / "a.fhz", fill=-1) as volume:
        np.testing.assert_array_equal(volume[...] == -1, np.isnan(series.values))
        assert volume[...].dtype == np.float32
        assert (volume.values(0.5) == -1).sum() >= (volume[0] == -1).sum()


def test_values_between_those_of_a_network_stay_floats(tmp_path) -> None:
    config = EncodeConfig(profile="paper", epochs=1, width=4, timings=False)
    fhash_codec.encode(labels(), tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume[...].dtype == np.float32


@pytest.mark.parametrize(
    ("dtype", "number", "held"),
    [
        ("i1", 127, True),
        ("i1", 128, False),
        ("u1", -1, False),
        ("i2", 1.5, False),
        ("i2", 2.0, True),
        ("i4", float("nan"), False),
        ("f4", float("nan"), True),
        ("f4", 1e39, False),
        ("u8", 2**64 - 1, True),
    ],
)
def test_numbers_that_a_type_holds(dtype, number, held) -> None:
    assert holds(np.dtype(dtype), number) is held


@pytest.mark.parametrize("dtype", ["i1", "u1", "i4", "i8", "u8"])
def test_rounding_stays_within_the_type(dtype) -> None:
    limits = np.iinfo(dtype)
    ends = np.array([float(limits.min), float(limits.max), np.nan, 2.4, 1e300, -1e300])
    whole = rounded(ends, np.dtype(dtype))
    assert whole.dtype == np.dtype(dtype)
    assert whole[0] == whole[5] == limits.min
    assert int(whole[1]) == int(whole[4]) >= limits.max - 2 ** max(limits.bits - 53, 0)
    assert whole[2:4].tolist() == [0, 2]


def test_values_are_placed_where_the_mask_says_and_nan_elsewhere() -> None:
    values = np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    mask = values != 3
    box = Box.of(((1, 3), (0, 2), (2, 4)))
    result = placed(values, mask, box, (3, 2, 5))
    assert result.dtype == np.float32
    assert result.shape == (3, 2, 5)
    assert np.isnan(result).sum() == 30 - 7
    np.testing.assert_array_equal(result[1:, :, 2:4][mask], values[mask])
    whole = Box.of_shape((2, 2, 2))
    assert placed(values, np.ones_like(mask), whole, (2, 2, 2)) is values
    assert np.isnan(placed(values, mask, whole, (2, 2, 2))[0, 1, 1])
