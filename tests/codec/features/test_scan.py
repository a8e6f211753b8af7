"""Fill values that nobody declared: which series are refused, and which real data are not."""

from __future__ import annotations

import pickle

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.features.scan import (
    ABSURD,
    HUGE,
    MOST,
    SEVERAL,
    Extremes,
    SpanScan,
    scan,
)
from fhash_codec.measure.value_range import Ranks, pieces
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, StepsSeries

Values = npt.NDArray[np.generic]
GRID = np.linspace(0, 1, 8 * 9 * 10).reshape(1, 8, 9, 10)
"""A smooth field (t, z, y, x) from 0 to 1."""

MASK = GRID < 0.3
"""Vertices without a value, as over land."""


def suspects(values: Values, step: int = 10**6) -> list[float]:
    """Suspects among the values, given in pieces of `step`."""
    found = Extremes(values.dtype)
    flat = values.reshape(-1)
    for start in range(0, flat.size, step):
        for piece in pieces(flat[start : start + step]):
            finite = piece[np.isfinite(piece)]
            if finite.size:
                found.add(piece, finite.size, float(finite.min()), float(finite.max()))
            else:
                found.add(piece, 0, np.inf, -np.inf)
    return found.suspects()


def masked(values: Values, fill: float, dtype: str = "f4") -> Values:
    return np.where(MASK, fill, values).astype(dtype)


@pytest.mark.parametrize("step", [7, 100, 10**6])
@pytest.mark.parametrize(
    ("fill", "low", "high", "dtype"),
    [
        (1e20, 250, 310, "f4"),
        (1e20, 0, 1e-6, "f8"),
        (9.969209968386869e36, -5, 40, "f4"),
        (-9999, 0, 5000, "f4"),
        (-9999.9, 0, 5000, "f8"),
        (-999, 0, 200, "i2"),
        (-99, 0, 30, "f4"),
        (-32768, 0, 30000, "i2"),
        (-32767, 0, 30000, "f4"),
        (-(2**31), -(10**6), 10**6, "i4"),
        (-(2**63), 0, 10**9, "i8"),
        (65535, 0, 4095, "u2"),
        (9999, 0, 100, "f4"),
        (3.4028234663852886e38, 0, 1, "f4"),
        (-1e34, 0, 1, "f4"),
        (1.2345e10, 0, 100, "f8"),
    ],
)
def test_a_fill_value_is_found(fill: float, low: float, high: float, dtype: str, step: int) -> None:
    values = masked(low + (high - low) * GRID, fill, dtype)
    assert suspects(values, step) == [float(np.array(fill, dtype))]


RANDOM = np.random.default_rng(0).normal(size=GRID.shape)
PEAK = np.exp(-((GRID - 0.5) ** 2) / 1e-5)


def two_phase() -> Values:
    """Water of 1000 in air of 1.2, which alone has noise, without a vertex between."""
    return np.where(MASK, 1000, 1.2 + 0.02 * RANDOM)


def hot_pixels() -> Values:
    values = 12000 + 3000 * RANDOM
    values.flat[::100] = 65535
    return values.clip(0, 65535).astype("u2")


REAL = {
    "a thin peak in zeros": np.where(PEAK > 1e-3, PEAK, 0).astype("f4"),
    "one spike": np.where(np.arange(GRID.size).reshape(GRID.shape) == 5, 1e20, GRID),
    "one -9999": np.where(np.arange(GRID.size).reshape(GRID.shape) == 5, -9999, GRID),
    "a plateau without a shell": np.where(MASK, 100, 0).astype("f4"),
    "a plateau with a shell": np.where(MASK, 1e6, np.where(GRID < 0.31, 5e5, 0.001 * RANDOM)),
    "a plateau above noise": np.where(MASK, 100, 1e-3 * RANDOM).astype("f4"),
    "two phases": two_phase(),
    "mostly zero": np.where(MASK, GRID, 0),
    "values from 250 K and zeros": np.where(MASK, 0, 250 + 60 * GRID).astype("f4"),
    "saturated 8 bits": (300 * GRID).clip(0, 255).astype("u1"),
    "isolated 255": np.where(MASK, 255, 20 * GRID).astype("u1"),
    "labels with 127": np.where(MASK, 127, np.rint(5 * GRID)).astype("i1"),
    "labels with -100": np.where(MASK, -100, np.rint(58 * GRID)).astype("i1"),
    "saturated 16 bits": (90000 * GRID).clip(0, 65535).astype("u2"),
    "hot pixels": hot_pixels(),
    "a 0/1 mask": MASK.astype("i4"),
    "a mask of 0 and 65535": np.where(MASK, 65535, 0).astype("u2"),
    "a sign": np.where(MASK, -1.0, 1.0),
    "labels of 16 bits": np.where(MASK, 2035, np.rint(77 * GRID)).astype("i2"),
    "clipped below": (-20000 + 30000 * GRID - 30000 * (GRID < 0.1)).clip(-32768).astype("i2"),
    "constant": np.full(GRID.shape, 1e20),
    "all of a range": np.array([-1.7e308, 1.7e308, -1.7e308, 1.7e308]).reshape(1, 1, 2, 2),
    "no finite value": np.full(GRID.shape, np.nan),
}


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("step", [7, 10**6])
def test_real_data_are_not_suspected(name: str, step: int) -> None:
    assert suspects(REAL[name], step) == []


@pytest.mark.parametrize(
    ("value", "ratio"), [(-9999, MOST), (9999, SEVERAL), (1e20, HUGE), (12345.0, ABSURD)]
)
def test_each_ratio_on_both_sides(value: float, ratio: float) -> None:
    full = abs(value) / 2
    far = value + (full if value < 0 else -full)
    for shift, found in ((0.999, [value]), (1.001, [])):
        others = far + np.linspace(0, 1, 50) * (value - far) / ratio * shift
        values = np.concatenate([np.full(5, float(value)), others]).reshape(1, 1, 5, 11)
        assert suspects(values) == found


def test_the_scan_stops_with_the_value_its_share_and_the_options() -> None:
    values = masked(250 + 60 * GRID, 1e20)
    share = 100 * MASK.mean()
    with pytest.raises(
        InputError,
        match=rf"array: 'T' has 1e\+20 at {share:.3g} % of its vertices, and only 268\S* to 310"
        r" elsewhere; give ArraySeries\(missing=\[1e\+20\]\) if .*, or keep_extremes=True if it is",
    ):
        scan(ArraySeries(values, name="T"), silent)
    scan(ArraySeries(values, keep_extremes=True), silent)
    scan(StepsSeries(ArraySeries(values, keep_extremes=True), [0]), silent)
    seen = scan(ArraySeries(values, missing=[1e20]), silent)
    assert seen.value_range.high == 310
    assert seen.finite_count == (~MASK).sum()


def test_integers_of_an_array_with_missing_values() -> None:
    series = ArraySeries(masked(1000 * GRID, -32768, "i2"), missing=[-32768])
    assert (series.dtype, series.source_dtype, series.fill) == (np.float32, np.int16, -32768)
    assert np.isnan(series.read(0)[MASK[0]]).all()


@pytest.mark.parametrize(
    "dtype", [np.uint8, np.int32, np.uint64, np.float16, np.float32, np.float64]
)
def test_range_and_mean_are_numpys(dtype) -> None:
    array = (np.random.default_rng(0).random((3, 4, 5, 6)) * 100).astype(dtype)
    seen = scan(ArraySeries(array), silent)
    assert (seen.value_range.low, seen.value_range.high) == (array.min(), array.max())
    assert seen.mean == pytest.approx(array.mean(dtype=np.float64), rel=1e-14)
    assert (seen.finite_count, seen.missing) == (array.size, {})
    assert seen.finite(0, (4, 5, 6)) is None


def test_missing_values_are_left_out_and_known_by_step() -> None:
    array = np.random.default_rng(1).random((5, 3, 4, 5)).astype(np.float32)
    array[1, 0, 0, 0], array[1, 2, 3, 4], array[3, 1, 1] = np.nan, np.inf, -np.inf
    seen = scan(ArraySeries(array), silent)
    finite = np.isfinite(array)
    assert sorted(seen.missing) == [1, 3]
    assert seen.finite_count == finite.sum()
    assert (seen.value_range.low, seen.value_range.high) == (
        array[finite].min(),
        array[finite].max(),
    )
    assert seen.mean == pytest.approx(array[finite].mean(dtype=np.float64))
    for step in range(5):
        mask = seen.finite(step, (3, 4, 5))
        np.testing.assert_array_equal(finite[step], True if mask is None else mask)


def test_no_finite_value_at_all_is_refused() -> None:
    with pytest.raises(InputError, match="no finite value"):
        scan(ArraySeries(np.full((2, 2, 2, 2), np.nan)), silent)


@pytest.mark.parametrize("length", [1, 2, 5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
def test_spans_join_to_the_scan_of_all_steps(dtype, length) -> None:
    array = (100 * np.random.default_rng(0).standard_normal((5, 4, 5, 6))).astype(dtype)
    series, ranks = ArraySeries(array), Ranks()
    whole = scan(series, silent, ranks)
    spans = [SpanScan(series, range(a, min(a + length, 5))) for a in range(0, 5, length)]
    joined = SpanScan.joined(series, pickle.loads(pickle.dumps(spans)))
    assert joined is not None
    assert joined[0] == whole
    assert joined[1].middle(6) == ranks.middle(6)


def test_extremes_of_spans_are_those_of_all_steps() -> None:
    for extremes in ([7e7, 1e20], [-9999, 1e20], [-9999, 3], [5, 5], [1, 1e20]):
        array = np.random.default_rng(0).random((6, 2, 3, 4))
        array[1, 0, 0, 0], array[4, 1, 1, 1] = extremes
        array[5, 0, :2, 0] = extremes
        series = ArraySeries(array)
        spans = [SpanScan(series, range(a, a + 2)) for a in (0, 2, 4)]

        def outcome(work) -> str:
            try:
                return repr(work())
            except InputError as error:
                return str(error)

        alone = outcome(lambda series=series: scan(series, silent))
        assert outcome(lambda s=series, p=spans: SpanScan.joined(s, p)[0]) == alone


def test_missing_values_in_a_span_leave_the_scan_to_another_way() -> None:
    array = np.zeros((4, 2, 2, 2))
    array[2, 0, 0, 0] = np.inf
    series = ArraySeries(array)
    spans = [SpanScan(series, range(a, a + 2)) for a in (0, 2)]
    assert [span.has_missing for span in spans] == [False, True]
    assert SpanScan.joined(series, spans) is None
