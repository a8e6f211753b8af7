"""Boxes: their laws, and the smallest ones around masks and other boxes."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fhash_codec
from fhash_codec import EncodeConfig, RegionError
from fhash_codec.boxes import (
    Box,
    Table,
    bounding_box,
    coarse_vertices,
    expand_index,
    index_ranges,
    overlap,
    slice_of,
)
from fhash_codec.compact.model import CompactModel
from fhash_formats.series import ArraySeries

SHAPE = (3, 4, 5)
LINES = [[(first, end) for end in range(n + 1) for first in range(end)] for n in SHAPE]
BOXES = [Box(*spans) for spans in itertools.product(*LINES)][::17]


def mask_of(box: Box) -> npt.NDArray[np.bool_]:
    """The vertices of a box, True in a grid of SHAPE."""
    mask = np.zeros(SHAPE, bool)
    mask[box.slices()] = True
    return mask


@pytest.mark.parametrize("box", BOXES[::5], ids=str)
def test_slices_cut_out_the_shape_of_a_box(box: Box) -> None:
    grid = np.moveaxis(np.indices(SHAPE), 0, -1)
    assert grid[box.slices()].shape == (*box.shape, 3)
    assert tuple(grid[box.slices()][0, 0, 0]) == box.first
    moved = box.shift(-first for first in box.first)
    assert moved == Box.of_shape(box.shape)
    assert moved.shift(box.first) == box


def test_the_intersection_holds_the_vertices_of_both_boxes() -> None:
    for first, second in itertools.combinations_with_replacement(BOXES, 2):
        common = first.intersect(second)
        assert common == second.intersect(first)
        both = mask_of(first) & mask_of(second)
        assert common == bounding_box(both)
        assert common is None or bool(both[common.slices()].all())


QUICK = {"timings": False}
REGION = ((1, 4), (0, 3), (2, 7))


def waves(dtype: str) -> np.ndarray:
    """A wave (t, z, y, x) with a hole in it, which integers cannot have."""
    t, z, y, x = np.ogrid[:9, :4, :5, :8]
    values = 100 * np.sin(0.7 * t + 0.4 * z + 0.9 * y * y + 0.3 * x)
    if np.dtype(dtype).kind == "i":
        return values.astype(dtype) + (np.dtype(dtype).itemsize == 8) * 2**60
    values[2:5, 1:3, 2, 3:6] = np.nan
    return values.astype(dtype)


NETWORK = {"preset": "published", "tables": "float16", "epochs": 2}
CASES = {
    "floats with holes": ("f4", {}),
    "a feature": ("f4", {"features": ("interval:0:60",)}),
    "64-bit integers": ("i8", {"max_error": 0.4}),
    "small integers of a feature": ("i2", {"features": ("interval:0:60",)}),
    "key frames": ("f4", {**NETWORK, "key_frames": "every:3"}),
    "a network": ("f4", {**NETWORK, "features": ("interval:0:60",)}),
}


@pytest.fixture(params=CASES, ids=list(CASES))
def volume(request: Any, tmp_path: Path) -> Any:
    dtype, config = CASES[request.param]
    path = tmp_path / "run.fhz"
    fhash_codec.encode(ArraySeries(waves(dtype)), path, EncodeConfig(**{**QUICK, **config}))
    with fhash_codec.open(path) as volume:
        yield volume


@pytest.mark.parametrize("outside", ["nan", "background"])
def test_steps_read_together_are_those_read_alone(volume: Any, outside: str) -> None:
    for region in (None, REGION):
        for steps in (range(9), range(3, 5), range(8, 9)):
            together = volume.read_steps(steps, region, outside=outside)
            alone = [volume.read(step, region, outside=outside) for step in steps]
            np.testing.assert_array_equal(together, np.stack(alone))
            assert together.dtype == volume.float_dtype
            together = volume.values_of_steps(steps, region, outside=outside)
            alone = [volume.values(step, region, outside=outside) for step in steps]
            np.testing.assert_array_equal(together, np.stack(alone))
            assert together.dtype == volume.dtype


def test_any_stride_gives_the_steps_that_it_names(volume: Any) -> None:
    whole = np.stack([volume.values(step) for step in range(9)])
    for index in (np.s_[...], np.s_[::2], np.s_[::-1], np.s_[7:1:-3], np.s_[4], np.s_[2:2]):
        np.testing.assert_array_equal(volume[index], whole[index])


def test_steps_outside_the_series_are_refused(volume: Any) -> None:
    for steps in (range(8, 10), range(-1, 2)):
        with pytest.raises(RegionError, match=r"outside 0\.\.8"):
            volume.read_steps(steps)


def test_many_small_frames_are_decoded_together(tmp_path: Path, monkeypatch: Any) -> None:
    values = np.cumsum(np.ones((3000, 1, 2, 3), "f4"), axis=0)
    fhash_codec.encode(ArraySeries(values), tmp_path / "long.fhz", EncodeConfig(**QUICK))
    reads: list[range] = []
    read_steps = CompactModel.read_steps

    def counted(self: CompactModel, first: int, end: int, region: Any) -> Any:
        reads.append(range(first, end))
        return read_steps(self, first, end, region)

    monkeypatch.setattr(CompactModel, "read_steps", counted)
    with fhash_codec.open(tmp_path / "long.fhz") as volume:
        assert volume[...].shape == values.shape
    assert reads == [range(3000)]


SHAPE_INDEXING = (3, 4, 1, 5)
ENDS = st.none() | st.integers(-7, 7)
PARTS = st.tuples(
    *(
        st.integers(-length, length - 1)
        | st.builds(slice, ENDS, ENDS, st.none() | st.sampled_from([1, 2, 3, -1, -2]))
        for length in SHAPE_INDEXING
    )
)


@given(parts=PARTS, count=st.integers(0, 4), ellipsis=st.none() | st.integers(0, 4))
def test_an_index_names_the_positions_that_numpy_takes(
    parts: tuple[Any, ...], count: int, ellipsis: int | None
) -> None:
    index = parts[:count]
    if ellipsis is not None and ellipsis <= count:
        # The parts behind `...` belong to the last axes.
        behind = parts[4 - (count - ellipsis) :]
        index = (*parts[:ellipsis], ..., *behind)
    vertices = np.moveaxis(np.indices(SHAPE_INDEXING), 0, -1)
    expanded = expand_index(index)
    positions = index_ranges(expanded, SHAPE_INDEXING)
    assert len(expanded) == len(positions) == 4
    grid = np.stack(np.meshgrid(*positions, indexing="ij"), axis=-1)
    expected = vertices[(*index, slice(None)) if ... in index else (*index, ...)]
    np.testing.assert_array_equal(grid.reshape(expected.shape), expected)


@given(along=st.builds(slice, ENDS, ENDS, st.none() | st.sampled_from([1, 2, 3, -1, -2])))
def test_a_slice_takes_the_positions_of_a_range_from_an_array_that_begins_later(
    along: slice,
) -> None:
    positions = range(9)[along]
    if positions:
        first = min(positions)
        assert list(range(first, 9)[slice_of(positions, first)]) == list(positions)


@pytest.mark.parametrize("index", [(0,) * 5, (..., ...), None, [0], True, 1.0, "t"], ids=repr)
def test_other_indices_are_refused(index: Any) -> None:
    with pytest.raises(IndexError, match="a volume"):
        expand_index(index)


def test_the_part_that_a_region_shares_with_a_box() -> None:
    box, region = Box.of([(1, 4), (2, 6), (0, 3)]), Box.of([(0, 2), (3, 9), (1, 2)])
    assert overlap(box, region) == (
        Box.of([(1, 2), (0, 3), (0, 1)]),
        Box.of([(0, 1), (1, 4), (1, 2)]),
    )
    assert overlap(box, Box.of([(4, 5), (2, 6), (0, 3)])) is None


@given(low=st.integers(0, 11), length=st.integers(1, 12), lod=st.integers(0, 3))
def test_coarse_vertices_are_those_of_the_box_in_the_region(
    low: int, length: int, lod: int
) -> None:
    box, region = Box.of([(2, 9), (0, 12), (3, 4)]), Box.of([(low, low + length)] * 3)
    expected = [
        [n for n in range(first, end, 1 << lod) if low <= n < low + length] for first, end in box
    ]
    if all(expected):
        assert [list(along) for along in coarse_vertices(box, region, lod, "run")] == expected
    else:
        with pytest.raises(RegionError, match="holds no vertex of level of detail"):
            coarse_vertices(box, region, lod, "run")


VALUES = np.arange(3 * 4 * 5 * 6 * 2, dtype=np.float32).reshape(3, 4, 5, 6, 2)


class Source:
    shape = VALUES.shape

    def __init__(self) -> None:
        self.regions: list[tuple[slice, ...]] = []

    def read(self, region: tuple[slice, ...]) -> Any:
        self.regions.append(region)
        return VALUES[region]


@pytest.mark.parametrize(
    "index",
    [
        (),
        1,
        (..., 1),
        (slice(1, None), 0, slice(None, None, -1)),
        (slice(0, 3, 2), slice(3, 0, -2), -1, slice(2, 5), slice(0, 1)),
        (slice(2, 2),),
        (-1, -1, -1, -1, -1),
        (np.int64(2), ...),
    ],
)
def test_indexing_is_that_of_numpy(index: Any) -> None:
    table = Table(1, Source(), "float32")
    np.testing.assert_array_equal(table[index], VALUES[index])
    assert table[index].dtype == table.dtype


def test_only_the_region_that_is_asked_for_is_read() -> None:
    source = Source()
    Table(1, source, "float32")[1, 2:4, ::2, 5]
    assert source.regions == [(slice(1, 2), slice(2, 4), slice(0, 5), slice(5, 6), slice(0, 2))]
    assert len(Table(2, source, "float32")) == 3
    np.testing.assert_array_equal(np.asarray(Table(2, source, "float32"), dtype=np.float64), VALUES)


@pytest.mark.parametrize("index", [3, (0, -5), [0], True, (0,) * 6, (..., ...), "t"])
def test_other_indices_are_refused_model_parts(index: Any) -> None:
    with pytest.raises(RegionError):
        Table(1, Source(), "float32")[index]


def test_a_table_is_no_view() -> None:
    with pytest.raises(ValueError, match="decoded"):
        np.asarray(Table(1, Source(), "float32"), copy=False)
