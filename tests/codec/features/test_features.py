"""The extent of the coreset: its masks, its box, and what is left outside."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.boxes import Box
from fhash_codec.features.features import (
    Everything,
    Extent,
    Feature,
    Interval,
    Isosurface,
    Mask,
    Segmentation,
    dilate,
    find_extent,
    otsu_threshold,
    packed_masks,
    parse_feature,
    resolve_features,
)
from fhash_codec.features.scan import scan
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

VALUES = np.random.default_rng(0).random((4, 5, 6, 7))


def extent_of(values: np.ndarray, features: tuple[Feature, ...], dilation: int = 0) -> Extent:
    series = ArraySeries(values)
    return find_extent(series, scan(series, silent), (0, 1, 3), features, dilation, silent)


def test_masks_are_the_selected_vertices_in_the_box_of_all_key_frames() -> None:
    values = VALUES.copy()
    values[:, :, 0], values[:, 4], values[0, 2, 3, 4] = 0, 0, np.nan
    extent = extent_of(values, (Interval(0.9, 1.0), Interval(0.5, 0.52)))
    selected = (values >= 0.9) | ((values >= 0.5) & (values <= 0.52))
    masks = np.stack([extent.mask(key) for key in range(3)])
    np.testing.assert_array_equal(masks, selected[[0, 1, 3]][:, *extent.box.slices()])
    assert extent.samples == masks.sum() == selected[[0, 1, 3]].sum()
    assert extent.fraction == pytest.approx(selected[[0, 1, 3]].mean())
    outside = values[[0, 1, 3]][~selected[[0, 1, 3]]]
    assert extent.background == pytest.approx(np.nanmean(outside), rel=1e-12)


def test_all_vertices_are_selected_the_same_way_without_a_look_at_them() -> None:
    everything = extent_of(VALUES, (Everything(),))
    wide = extent_of(VALUES, (Interval(-1.0, 2.0),))
    assert everything.box == wide.box == Box.of_shape((5, 6, 7))
    assert everything.samples == wide.samples == 3 * 5 * 6 * 7
    for key in range(3):
        np.testing.assert_array_equal(everything.mask(key), wide.mask(key))


def test_two_masks_of_one_name_are_both_selected() -> None:
    """A mask in memory is called `array`, and so may be a file."""
    ends = [np.zeros((5, 6, 7), bool) for _ in range(2)]
    ends[0][0], ends[1][4] = True, True
    features = tuple(Mask("array", read=lambda step, end=end: end) for end in ends)
    extent = extent_of(VALUES, features)
    np.testing.assert_array_equal(extent.mask(0), ends[0] | ends[1])


def test_the_fringe_is_what_only_a_neighbouring_key_frame_has() -> None:
    extent = extent_of(VALUES, (Interval(0.7, 1.0),))
    masks = [extent.mask(key) for key in range(3)]
    grown = [extent.with_fringe(key) for key in range(3)]
    np.testing.assert_array_equal(grown[0], masks[0] | masks[1])
    np.testing.assert_array_equal(grown[1], masks[0] | masks[1] | masks[2])
    np.testing.assert_array_equal(grown[2], masks[1] | masks[2])
    assert extent.samples_with_fringe() == sum(mask.sum() for mask in grown)


def test_features_are_kept_apart_where_asked_and_make_up_the_whole() -> None:
    values = VALUES.copy()
    values[0, 2, 3, 4] = np.nan
    features = (Interval(0.9, 1.0), Everything(), Interval(0.0, 0.1))
    series = ArraySeries(values)
    extent = find_extent(series, scan(series, silent), (0, 1, 3), features, 1, silent, apart=True)
    for key in range(3):
        masks = [extent.mask_of(number, key) for number in range(3)]
        np.testing.assert_array_equal(np.logical_or.reduce(masks), extent.mask(key))
        assert masks[0].sum() < masks[1].sum()
    assert extent_of(values, features).apart == ()


@pytest.mark.parametrize("features", [(Interval(0.6, 1.0),), (Everything(),)])
def test_masks_of_some_steps_are_those_of_the_whole(features) -> None:
    values = VALUES.copy()
    values[1, 2, 3, 4] = np.nan
    series = ArraySeries(values)
    seen = scan(series, silent)
    whole = find_extent(series, seen, range(4), features, 1, silent)
    some = packed_masks(series, seen.missing, range(1, 3), features, 1)
    assert list(some) == [1, 2]
    for step, packed in some.items():
        np.testing.assert_array_equal(packed, whole.packed[step])


SHAPES = [(1, 1, 1), (1, 5, 6), (4, 1, 5), (3, 4, 1), (5, 6, 7)]


def random_frame(shape, dtype=np.float32, seed=0):
    return (np.random.default_rng(seed).random(shape) * 10).astype(dtype)


@pytest.mark.parametrize(
    ("text", "feature"),
    [
        ("all", Everything()),
        ("interval:0.25:1", Interval(0.25, 1.0)),
        ("interval:-1e-30:1e+30", Interval(-1e-30, 1e30)),
        ("interval:-inf:-5", Interval(-np.inf, -5.0)),
        ("interval:2:2", Interval(2.0, 2.0)),
        ("isosurface:-3.5", Isosurface(-3.5)),
        ("segmentation", Segmentation()),
        ("segmentation:7", Segmentation(7.0)),
        ("mask:a:b/c.h5", Mask("a:b/c.h5")),
    ],
)
def test_text_and_feature_name_each_other(text, feature) -> None:
    assert parse_feature(text) == feature
    assert str(feature) == text
    assert parse_feature(str(feature)) == feature


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("intervall:1:2", "not known; allowed: interval:LO:HI, isosurface:V, segmentation"),
        ("", "not known"),
        ("all:1", "not known"),
        ("mask:", "not known"),
        ("mask", "not known"),
        ("interval", "malformed; write interval:LO:HI with LO <= HI"),
        ("interval:1", "malformed"),
        ("interval:1:2:3", "malformed"),
        ("interval:a:b", "malformed"),
        ("interval:nan:1", "malformed"),
        ("interval:2:1", "write interval:LO:HI with LO <= HI"),
        ("isosurface:", "malformed; write isosurface:V"),
        ("isosurface:inf", "malformed"),
        ("isosurface:1:2", "malformed"),
        ("segmentation:", "malformed; write segmentation or segmentation:T"),
        ("segmentation:x", "malformed"),
    ],
)
def test_malformed_text_is_refused_in_one_line(text, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_feature(text)
    assert "\n" not in str(caught.value)


def brute_force_isosurface(frame, value):
    selected = frame == value
    for vertex in np.ndindex(frame.shape):
        for axis in range(3):
            other = tuple(v + (a == axis) for a, v in enumerate(vertex))
            if other[axis] < frame.shape[axis]:
                ends = sorted([frame[vertex], frame[other]])
                if np.isfinite(ends).all() and ends[0] < value < ends[1]:
                    selected[vertex] = selected[other] = True
    return selected


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16, np.uint8])
@pytest.mark.parametrize("value", [5.0, 3.3, -1.0])
def test_isosurface_takes_both_ends_of_every_crossed_edge(shape, dtype, value) -> None:
    frame = random_frame(shape, dtype)
    np.testing.assert_array_equal(
        Isosurface(value).select(frame, 0), brute_force_isosurface(frame, value)
    )


def test_isosurface_does_not_cross_to_a_missing_neighbour() -> None:
    frame = np.array([[[0, np.inf, 0, np.nan, 0, 2]]])
    np.testing.assert_array_equal(
        Isosurface(1.0).select(frame, 0)[0, 0], [False, False, False, False, True, True]
    )


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize(
    "feature",
    [
        Everything(),
        Interval(-np.inf, np.inf),
        Isosurface(1.0),
        Segmentation(-5.0),
        Mask("m", lambda step: np.ones((1, 1, 4), bool)),
    ],
    ids=str,
)
def test_missing_vertices_are_never_selected(feature, dtype) -> None:
    frame = np.array([[[np.nan, np.inf, -np.inf, 1.0]]], dtype=dtype)
    np.testing.assert_array_equal(feature.select(frame, 0)[0, 0], [False, False, False, True])


def test_the_ends_of_an_interval_belong_to_it_and_a_threshold_does_not() -> None:
    frame = np.array([[[0.1, 0.2, 0.3, 0.4]]], dtype=np.float32)
    np.testing.assert_array_equal(
        Interval(0.2, 0.3).select(frame, 0)[0, 0], [False, True, True, False]
    )
    np.testing.assert_array_equal(
        Segmentation(0.2).select(frame, 0)[0, 0], [False, False, True, True]
    )
    np.testing.assert_array_equal(Interval(-1e300, 1e300).select(frame, 0), True)
    np.testing.assert_array_equal(
        Interval(0.5, 1.5).select(np.array([[[0, 1, 2]]], np.uint8), 0)[0, 0], [False, True, False]
    )
    np.testing.assert_array_equal(
        Interval(-1.0, 300.0).select(np.array([[[0, 255]]], np.uint8), 0), True
    )


def test_selecting_leaves_the_frame_and_the_mask_alone() -> None:
    frame, mask = random_frame((3, 3, 3)), np.zeros((3, 3, 3), bool)
    before = frame.copy()
    for feature in (Mask("m", lambda step: mask), Everything()):
        feature.select(frame, 0)[:] = True
    np.testing.assert_array_equal(frame, before)
    assert not mask.any()


def test_features_that_are_not_ready_say_so() -> None:
    frame = np.zeros((1, 1, 1))
    for feature in (Segmentation(), Mask("m")):
        with pytest.raises(InputError, match="resolve_features"):
            feature.select(frame, 0)
    with pytest.raises(InputError, match=r"shape \(1, 2, 1\)"):
        Mask("m", lambda step: np.ones((1, 2, 1), bool)).select(frame, 0)


def brute_force_dilation(mask, vertices):
    grown = np.zeros_like(mask)
    for vertex in np.argwhere(mask):
        grown[tuple(slice(max(v - vertices, 0), v + vertices + 1) for v in vertex)] = True
    return grown


@pytest.mark.parametrize("shape", [*SHAPES, (9, 2, 20)])
@pytest.mark.parametrize("vertices", [0, 1, 2, 3, 5, 64])
@pytest.mark.parametrize("density", [0.0, 0.02, 0.3])
def test_dilation_is_the_26_neighbourhood_without_wrap_around(shape, vertices, density) -> None:
    mask = np.random.default_rng(vertices).random(shape) < density
    before = mask.copy()
    np.testing.assert_array_equal(dilate(mask, vertices), brute_force_dilation(mask, vertices))
    np.testing.assert_array_equal(mask, before)


def test_dilation_is_extensive_monotone_additive_and_idempotent_on_the_whole() -> None:
    rng = np.random.default_rng(3)
    a = rng.random((6, 7, 8)) < 0.03
    b = a | (rng.random((6, 7, 8)) < 0.03)
    for n in (1, 2, 3):
        assert (dilate(a, n) >= a).all()
        assert (dilate(b, n) >= dilate(a, n)).all()
        np.testing.assert_array_equal(dilate(dilate(a, n), 2), dilate(a, n + 2))
        np.testing.assert_array_equal(dilate(a | b, n), dilate(a, n) | dilate(b, n))
    assert dilate(np.ones((3, 4, 5), bool), 1).all()
    assert not dilate(np.zeros((3, 4, 5), bool), 9).any()


def brute_force_otsu(counts, edges):
    """The variance of every split of the repeated bin numbers; the middle of the best ones."""
    numbers = np.repeat(np.arange(len(counts)), counts)
    scores = []
    for split in range(1, len(counts)):
        low, high = numbers[numbers < split], numbers[numbers >= split]
        scores.append(
            low.size * high.size * (low.mean() - high.mean()) ** 2
            if low.size and high.size
            else 0.0
        )
    best = np.flatnonzero(np.isclose(scores, max(scores), rtol=1e-12))
    return edges[best[best.size // 2] + 1]


@pytest.mark.parametrize("seed", range(8))
def test_otsu_against_every_split(seed) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, size=12) * (rng.random(12) < 0.7)
    edges = np.linspace(-3, 5, 13)
    assert otsu_threshold(counts, edges) == pytest.approx(brute_force_otsu(counts, edges))


def test_otsu_splits_two_values_in_the_middle_of_the_gap() -> None:
    counts = np.zeros(1024)
    counts[0], counts[-1] = 900, 100
    assert otsu_threshold(counts, np.linspace(0, 1, 1025)) == pytest.approx(0.5, abs=2e-3)


class CountedSeries(ArraySeries):
    reads = 0

    def read(self, step):
        self.reads += 1
        return super().read(step)


def test_resolving_reads_the_key_frames_once_and_only_for_otsu() -> None:
    array = np.zeros((4, 3, 4, 5), np.float32)
    array[..., 2:] = 100.0
    array[0, 0, 0, 0] = np.nan
    array[1] = -1e3  # not a key frame, must not count
    series = CountedSeries(array)
    texts = ["segmentation", "segmentation:3", "all", "segmentation"]
    features = resolve_features(texts, series, (0, 2, 3), ValueRange(-1e3, 100.0), silent)
    assert series.reads == 3
    assert features[0] == features[3]
    assert 0 < features[0].threshold < 100
    assert features[1:3] == (Segmentation(3.0), Everything())
    resolve_features(["all", "isosurface:3"], series, (0, 2, 3), ValueRange(0.0, 1.0), silent)
    assert series.reads == 3


def test_masks_are_opened_with_the_shape_of_the_series() -> None:
    asked = []

    def open_mask(path, shape):
        asked.append((path, shape))
        return lambda step: np.full(shape[1:], step == 1)

    series = ArraySeries(np.ones((2, 3, 4, 5)))
    (feature,) = resolve_features(
        ["mask:m.npy"], series, (0, 1), ValueRange(0.0, 1.0), silent, open_mask
    )
    assert asked == [("m.npy", (2, 3, 4, 5))]
    assert [feature.select(series.read(step), step).all() for step in (0, 1)] == [False, True]


def happening(text: str, values: np.ndarray, key_frames: tuple[int, ...]) -> np.ndarray:
    """Masks (key frames, z, y, x) of a feature in time."""
    series = ArraySeries(values)
    (feature,) = resolve_features([text], series, key_frames, ValueRange(0.0, 1.0), silent)
    assert str(feature) == str(parse_feature(text))
    return np.stack([feature.select(series.read(step), step) for step in key_frames])


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int64])
def test_a_change_is_at_both_its_ends_and_above_the_threshold(dtype) -> None:
    values = np.full((5, 1, 1, 3), 100, dtype)
    values[2:, 0, 0, 1], values[3:, 0, 0, 2] = 90, 89  # by 10, and by 11
    masks = happening("change:10", values, (0, 1, 2, 3, 4))
    assert not masks[..., :2].any()
    np.testing.assert_array_equal(masks[:, 0, 0, 2], [False, False, True, True, False])


def test_an_onset_is_a_rise_above_a_value_and_no_fall() -> None:
    values = np.zeros((5, 1, 1, 4), np.float32)
    values[2:, 0, 0, 1], values[2:, 0, 0, 2], values[:2, 0, 0, 3] = 0.5, 0.6, 1.0
    masks = happening("onset:0.5", values, (0, 1, 2, 3, 4))
    np.testing.assert_array_equal(masks.any(axis=0)[0, 0], [False, False, True, False])
    np.testing.assert_array_equal(masks[:, 0, 0, 2], [False, True, True, False, False])


def test_what_happens_between_key_frames_is_in_both_of_them() -> None:
    values = np.zeros((9, 1, 1, 3), np.float32)
    values[4, 0, 0, 1] = 1.0  # a flash that no key frame sees
    values[8, 0, 0, 2] = 1.0
    masks = happening("change:0.5", values, (1, 3, 6))
    np.testing.assert_array_equal(masks[:, 0, 0, 1], [False, True, True])
    np.testing.assert_array_equal(masks[:, 0, 0, 2], [False, False, True])


def test_missing_values_neither_change_nor_rise() -> None:
    values = np.zeros((3, 1, 1, 3), np.float32)
    values[1, 0, 0, :2] = np.nan, np.inf
    values[2, 0, 0, 2] = 1.0
    for text in ("change:0.1", "onset:0.1"):
        masks = happening(text, values, (0, 1, 2))
        np.testing.assert_array_equal(masks.any(axis=0)[0, 0], [False, False, True])


@pytest.mark.parametrize("text", ["change", "change:-1", "change:nan", "onset", "onset:inf"])
def test_malformed_features_in_time_are_refused(text) -> None:
    with pytest.raises(InputError, match="is malformed"):
        parse_feature(text)
    with pytest.raises(InputError, match="looks at other steps"):
        parse_feature("onset:1").select(np.zeros((1, 1, 1)), 0)
