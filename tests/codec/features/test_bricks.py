"""The coreset against a direct crop of the data, and packed occupancy."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.features.bricks import brick_shape, build_coreset, parse_brick
from fhash_codec.features.features import (
    Everything,
    FeatureChoice,
    Interval,
    Isosurface,
    Segmentation,
    dilate,
)
from fhash_codec.features.occupancy import morton_index, pack, packed_bytes, unpack
from fhash_codec.features.scan import scan
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import ArraySeries

SHAPES = [
    (1, 1, 1), (1, 1, 2), (2, 1, 1), (1, 2, 1), (1, 1, 3), (1, 1, 9), (9, 1, 1), (1, 9, 1),
    (2, 2, 2), (1, 2, 5), (3, 1, 2), (2, 3, 5), (7, 11, 13), (1, 17, 4), (17, 1, 3), (5, 64, 2),
    (8, 8, 16), (1, 1, 100), (31, 2, 1), (4, 33, 16),
]  # fmt: skip


def brute_force_index(z, y, x, shape):
    """Take bits from x, y, z in turn while the axis has any."""
    axes = [
        [x, (shape[2] - 1).bit_length()],
        [y, (shape[1] - 1).bit_length()],
        [z, (shape[0] - 1).bit_length()],
    ]
    index = place = 0
    while any(left for _, left in axes):
        for axis in axes:
            if axis[1]:
                index |= (axis[0] & 1) << place
                axis[0] >>= 1
                axis[1] -= 1
                place += 1
    return index


def random_mask(shape, seed=0):
    return np.random.default_rng(seed).random(shape) < 0.4


@pytest.mark.parametrize("shape", SHAPES)
def test_bits_lie_where_the_definition_says(shape) -> None:
    mask, vertices = random_mask(shape), np.indices(shape)
    index = morton_index(*vertices, shape)
    assert index.ravel().tolist() == [
        brute_force_index(*(int(v) for v in vertex), shape) for vertex in vertices.reshape(3, -1).T
    ]
    expected = np.zeros(8 * packed_bytes(shape), dtype=bool)
    expected[index] = mask
    np.testing.assert_array_equal(pack(mask), np.packbits(expected))


@pytest.mark.parametrize("shape", [*SHAPES, (25, 125, 125)])
def test_unpack_inverts_pack_and_the_index_is_injective(shape) -> None:
    mask = random_mask(shape, 1)
    bits = pack(mask)
    assert (bits.dtype, bits.shape) == (np.uint8, (packed_bytes(shape),))
    np.testing.assert_array_equal(unpack(bits, shape), mask)
    assert np.unique(morton_index(*np.indices(shape), shape)).size == mask.size
    assert np.unpackbits(bits).sum() == mask.sum()


EVERYTHING = (Everything(),)
SHAPES_BRICKS = [(1, 1, 1), (1, 20, 33), (9, 1, 40), (17, 18, 1), (11, 13, 19), (2, 70, 5)]


def unpack_frame(coreset, key):
    """The samples of a key frame, put back into the box: float32 (z, y, x), NaN elsewhere."""
    shape, grid = coreset.brick_shape, coreset.brick_grid
    first, last = np.searchsorted(coreset.bricks[:, 0], [key, key + 1])
    mask = np.unpackbits(coreset.mask_bits[first:last], axis=1, count=prod(shape)).view(np.bool_)
    held = np.full(mask.shape, np.nan, dtype=np.float32)
    held[mask] = coreset.values[coreset.offsets[first] : coreset.offsets[last]]
    tiles = np.full((*grid, *shape), np.nan, dtype=np.float32)
    _, z, y, x = coreset.bricks[first:last].T
    tiles[z, y, x] = held.reshape(-1, *shape)
    frame = tiles.transpose(0, 3, 1, 4, 2, 5).reshape(
        [count * step for count, step in zip(grid, shape, strict=True)]
    )
    z_size, y_size, x_size = coreset.box.shape
    return frame[:z_size, :y_size, :x_size]


def smooth(steps, shape, dtype=np.float32, low=0.0, span=1.0):
    """Blobs that drift with the steps."""
    axes = np.meshgrid(*((np.arange(size) + 0.5) / size * 2 - 1 for size in shape), indexing="ij")
    frames = [
        np.exp(-6 * sum((axis - 0.3 * np.sin(step + k)) ** 2 for k, axis in enumerate(axes)))
        for step in range(steps)
    ]
    return (low + span * np.stack(frames)).astype(dtype)


def build(array, features=EVERYTHING, keys=None, dilation=1, **kwargs):
    series = ArraySeries(array)
    seen = scan(series, silent)
    keys = tuple(range(series.shape[0])) if keys is None else keys
    choice = FeatureChoice(keys, features, dilation)
    return build_coreset(series, seen, choice, silent, **kwargs), seen


def check_against_direct_crop(array, features, keys, dilation, **kwargs) -> None:
    coreset, seen = build(array, features, keys, dilation, **kwargs)
    selected = [
        np.any([feature.select(array[step], step) for feature in features], axis=0) for step in keys
    ]
    masks = [
        dilate(mask, dilation) & np.isfinite(array[step])
        for mask, step in zip(selected, keys, strict=True)
    ]
    everywhere = np.argwhere(np.any(masks, axis=0))
    assert coreset.box == tuple(
        zip(everywhere.min(axis=0), everywhere.max(axis=0) + 1, strict=True)
    )
    for key, (step, mask) in enumerate(zip(keys, masks, strict=True)):
        expected = np.where(mask, seen.value_range.to_unit(array[step]), np.float32(np.nan))
        np.testing.assert_array_equal(unpack_frame(coreset, key), expected[coreset.box.slices()])
        np.testing.assert_array_equal(
            unpack(coreset.occupancy[key], coreset.box.shape), mask[coreset.box.slices()]
        )
    assert coreset.fraction == pytest.approx(np.mean(masks))
    left = [
        array[step][~mask & np.isfinite(array[step])]
        for step, mask in zip(keys, masks, strict=True)
    ]
    left = np.concatenate(left).astype(np.float64)
    assert coreset.background / 2 == pytest.approx(
        (left / 2 / left.size).sum() if left.size else seen.mean / 2, rel=1e-12
    )
    check_structure(coreset)
    return coreset


def check_structure(coreset) -> None:
    vertices = prod(coreset.brick_shape)
    counts = np.unpackbits(coreset.mask_bits, axis=1)[:, :vertices].sum(axis=1)
    assert (counts > 0).all()
    assert (np.diff(coreset.offsets) == counts).all()
    assert (coreset.offsets[0], coreset.offsets[-1]) == (0, coreset.values.size)
    assert coreset.mask_bits.shape == (len(coreset.bricks), -(-vertices // 8))
    assert [
        array.dtype
        for array in (coreset.bricks, coreset.mask_bits, coreset.values, coreset.offsets)
    ] == ["i4", "u1", "f4", "i8"]
    assert ((coreset.values >= 0) & (coreset.values <= 1)).all()
    assert (coreset.bricks.max(axis=0) < (len(coreset.key_frames), *coreset.brick_grid)).all()
    order = np.ravel_multi_index(coreset.bricks.T, (len(coreset.key_frames), *coreset.brick_grid))
    assert (np.diff(order) > 0).all()
    grid = tuple(
        -(-size // step) for size, step in zip(coreset.box.shape, coreset.brick_shape, strict=True)
    )
    assert coreset.brick_grid == grid


@pytest.mark.filterwarnings("ignore:feature .* selects nothing")
@pytest.mark.parametrize("shape", SHAPES_BRICKS)
@pytest.mark.parametrize(
    "features",
    [(Everything(),), (Interval(0.3, 0.9),), (Isosurface(0.4), Segmentation(0.44))],
    ids=["all", "interval", "two"],
)
@pytest.mark.parametrize("dilation", [0, 1, 2])
def test_bricks_hold_the_direct_crop(shape, features, dilation) -> None:
    array = smooth(4, shape)
    check_against_direct_crop(array, features, (0, 2, 3), dilation)


def test_missing_values_are_neither_samples_nor_background() -> None:
    array = smooth(4, (5, 9, 20))
    array[:, :, :3], array[1, 2, 4, 10], array[2] = np.nan, np.inf, np.nan
    coreset = check_against_direct_crop(array, (Interval(0.2, 2.0),), (0, 1, 2, 3), 1)
    assert np.isnan(unpack_frame(coreset, 2)).all()
    assert 2 not in coreset.bricks[:, 0]
    assert np.isfinite(coreset.background)


def test_a_key_frame_without_the_feature_is_fine_and_none_at_all_is_not() -> None:
    array = np.zeros((3, 4, 5, 6))
    array[1, 2, 2, 2] = 1.0
    coreset = check_against_direct_crop(array, (Interval(0.5, 1.0),), (0, 1, 2), 1)
    assert coreset.box == ((1, 4), (1, 4), (1, 4))
    assert len(coreset.occupancy) == 3
    with pytest.raises(
        InputError,
        match=r"feature interval:2:3, isosurface:9 selects nothing; values range from 0 to 1",
    ):
        build(array, (Interval(2.0, 3.0), Isosurface(9.0)))


def test_default_bricks_have_at_most_1024_vertices_and_few_beyond_the_box() -> None:
    for size in np.random.default_rng(0).integers(1, 60, size=(300, 3)).tolist():
        brick = brick_shape(size)
        counts = [-(-length // edge) for edge, length in zip(brick, size, strict=True)]
        assert prod(brick) <= 1024
        assert all(
            count * edge - length < count
            for edge, length, count in zip(brick, size, counts, strict=True)
        )
        assert prod(brick) >= 200 or prod(counts) < 40


def test_a_feature_that_selects_nothing_beside_others_is_warned_of() -> None:
    with pytest.warns(FhashWarning, match="feature isosurface:99 selects nothing; the others do"):
        build(smooth(2, (5, 6, 7)), (Interval(0.2, 2.0), Isosurface(99.0)), (0, 1), 1)


def test_the_fringe_is_sampled_and_no_part_of_the_coreset() -> None:
    values = np.random.default_rng(1).random((3, 5, 6, 7)).astype(np.float32)
    plain, seen = build(values, [Interval(0.8, 1.0)], dilation=0)
    fringed, _ = build(values, [Interval(0.8, 1.0)], dilation=0, fringe=True)
    masks = [unpack(bits, plain.box.shape) for bits in plain.occupancy]
    for key, grown in enumerate(
        (masks[0] | masks[1], masks[0] | masks[1] | masks[2], masks[1] | masks[2])
    ):
        unit = seen.value_range.to_unit(values[key])[plain.box.slices()]
        np.testing.assert_array_equal(
            unpack_frame(fringed, key), np.where(grown, unit, np.float32(np.nan))
        )
        np.testing.assert_array_equal(fringed.occupancy[key], plain.occupancy[key])
    assert (fringed.fraction, fringed.background) == (plain.fraction, plain.background)


def test_a_fringe_without_a_value_has_that_of_the_neighbour() -> None:
    values = np.zeros((3, 2, 3, 4), np.float32)
    values[0, 0], values[2, 1] = 0.75, 0.5
    values[1] = np.nan
    values[1, 0, 0, 0] = 1.0
    coreset, seen = build(values, [Interval(0.25, 1.0)], dilation=0, fringe=True)
    middle = unpack_frame(coreset, 1)
    expected = np.stack([np.full((3, 4), 0.75), np.full((3, 4), 0.5)]).astype(np.float32)
    expected[0, 0, 0] = 1.0
    np.testing.assert_array_equal(middle, seen.value_range.to_unit(expected))


def test_bricks_are_named_by_their_shape():
    assert parse_brick("auto") is None
    assert parse_brick("4x2x16") == (4, 2, 16)
    for text in ("4x2", "4x0x2", "axbxc", "64x64x64"):
        with pytest.raises(InputError, match=f"brick is '{text}'; allowed"):
            parse_brick(text)
