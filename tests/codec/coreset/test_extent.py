"""The extent of the coreset: its masks, its box, and what is left outside."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.extent import Extent, find_extent, packed_masks
from fhash_codec.coreset.features import Everything, Feature, Interval, Mask
from fhash_codec.coreset.scan import scan
from fhash_codec.progress import silent
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
