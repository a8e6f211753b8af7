"""The extent of the coreset: its masks, its box, and what is left outside."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.features.features import (
    Everything,
    Extent,
    Feature,
    FeatureChoice,
    Interval,
    Isosurface,
    Mask,
    Segmentation,
    dilate,
    find_extent,
    otsu_threshold,
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
    choice = FeatureChoice((0, 1, 3), features, dilation)
    return find_extent(series, scan(series, silent), choice, silent)


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
    choice = FeatureChoice((0, 1, 3), features, 1)
    extent = find_extent(series, scan(series, silent), choice, silent, apart=True)
    for key in range(3):
        masks = [extent.mask_of(number, key) for number in range(3)]
        np.testing.assert_array_equal(np.logical_or.reduce(masks), extent.mask(key))
        assert masks[0].sum() < masks[1].sum()
    assert extent_of(values, features).apart == ()


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
