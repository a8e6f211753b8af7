"""The first pass: range, mean and missing values."""

import pickle

import numpy as np
import pytest

from fhash_codec.coreset.scan import SpanScan, scan, scan_steps
from fhash_codec.measure.ranks import Ranks
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


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


def test_a_mask_that_stays_is_kept_once() -> None:
    array = np.zeros((4, 2, 3, 3))
    array[:, 0] = np.nan
    array[3, 1] = np.nan
    array[3, 0] = 1.0
    missing = scan(ArraySeries(array), silent).missing
    assert missing[0] is missing[1] is missing[2]
    assert missing[3] is not missing[2]


@pytest.mark.parametrize(
    ("low", "high"), [(1e8, 1e8 + 1e-3), (-1.7e308, 1.7e308), (5e-324, 1e-322)]
)
def test_extreme_ranges_are_exact(low, high) -> None:
    seen = scan(ArraySeries(np.array([low, high, low, high]).reshape(2, 1, 1, 2)), silent)
    assert (seen.value_range.low, seen.value_range.high) == (low, high)
    assert low <= seen.mean <= high


def test_no_finite_value_at_all_is_refused() -> None:
    with pytest.raises(InputError, match="no finite value"):
        scan(ArraySeries(np.full((2, 2, 2, 2), np.nan)), silent)


def test_progress_counts_the_steps() -> None:
    calls = []
    scan(ArraySeries(np.zeros((3, 1, 1, 1))), lambda *call: calls.append(call))
    assert calls == [("scanning", 1, 3, ""), ("scanning", 2, 3, ""), ("scanning", 3, 3, "")]


def test_masks_of_some_steps_are_those_of_the_whole() -> None:
    array = np.random.default_rng(1).random((5, 3, 4, 5))
    array[1:4, 0], array[3, 1, 1] = np.nan, np.inf
    series = ArraySeries(array)
    whole = scan(series, silent)
    some = scan_steps(series, range(1, 4), whole.value_range, may_miss=True, progress=silent)
    assert list(some) == [1, 2, 3]
    for step, bits in some.items():
        np.testing.assert_array_equal(bits, whole.missing[step])


def test_steps_of_other_data_are_refused() -> None:
    array = np.arange(24.0).reshape(2, 2, 2, 3)
    series = ArraySeries(array)
    for known in (ValueRange(1, 23), ValueRange(0, 22)):
        with pytest.raises(InputError, match="the plan is of data from"):
            scan_steps(series, range(2), known, may_miss=False, progress=silent)
    array[1, 0, 0, 0] = np.nan
    assert scan_steps(series, range(1), ValueRange(0, 23), may_miss=False, progress=silent) == {}
    with pytest.raises(InputError, match="step 1 has missing values, and the plan is of data wit"):
        scan_steps(series, range(2), ValueRange(0, 23), may_miss=False, progress=silent)


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
