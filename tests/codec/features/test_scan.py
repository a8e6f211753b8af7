"""Fill values that nobody declared: which series are refused, and which real data are not."""

from __future__ import annotations

import itertools
import pickle
from math import prod

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.features import scan as scanning
from fhash_codec.features.bricks import brick_shape, build_coreset, parse_brick
from fhash_codec.features.features import (
    Everything,
    FeatureChoice,
    Interval,
    Isosurface,
    Segmentation,
    dilate,
)
from fhash_codec.features.key_frames import KeyTimes, select_key_frames
from fhash_codec.features.occupancy import morton_index, pack, packed_bytes, unpack
from fhash_codec.features.scan import (
    ABSURD,
    HUGE,
    MOST,
    SEVERAL,
    Extremes,
    SpanScan,
    finite_masks,
    scan,
)
from fhash_codec.measure.value_range import Ranks, pieces
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning, InputError, RegionError
from fhash_formats.readers.registry import open_series
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
    assert finite_masks(seen.missing, range(3), (4, 5, 6)) is None


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
    np.testing.assert_array_equal(finite, finite_masks(seen.missing, range(5), (3, 4, 5)))


@pytest.mark.parametrize("block", [1, 150, 1 << 18])
def test_a_small_series_of_a_file_stays_in_memory(tmp_path, monkeypatch, block) -> None:
    monkeypatch.setattr("fhash_formats.series.BLOCK", block)
    values = np.random.default_rng(5).normal(size=(6, 3, 4, 5)).astype(np.float32)
    np.save(tmp_path / "a.npy", values)
    with open_series(tmp_path / "a.npy") as series:
        whole = scan(series, silent)
        assert series.held.tobytes() == values.tobytes()
        assert whole == scan(ArraySeries(values), silent)
    monkeypatch.setattr(scanning, "HELD_BYTES", values.nbytes - 1)
    with open_series(tmp_path / "a.npy") as series:
        assert scan(series, silent) == whole
        assert series.held is None


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


UNEVEN = np.array([0.0, 1.0, 1.5, 4.0, 4.25, 9.0, 9.5, 10.0])


def series_of(steps, seed=0, shape=(2, 3, 4)):
    rng = np.random.default_rng(seed)
    return ArraySeries(rng.random((steps, *shape)).cumsum(axis=0))


def pick(spec, series, times=None):
    return select_key_frames(
        spec, series, np.arange(series.shape[0], dtype=float) if times is None else times, silent
    )


def interpolation_error(array, times, keys):
    """Summed squared error of all frames, straight from the definition."""
    flat = array.reshape(len(array), -1)
    sign = -1 if times[-1] < times[0] else 1
    rebuilt = np.stack(
        [
            np.interp(sign * times, sign * times[list(keys)], column[list(keys)])
            for column in flat.T
        ],
        axis=1,
    )
    return ((rebuilt - flat) ** 2).sum()


@pytest.mark.parametrize(
    ("spec", "steps", "expected"),
    [
        ("all", 4, (0, 1, 2, 3)),
        ("every:1", 3, (0, 1, 2)),
        ("every:3", 7, (0, 3, 6)),
        ("every:3", 8, (0, 3, 6, 7)),
        ("every:99", 5, (0, 4)),
        ("every:2", 1, (0,)),
        ("0,4,9", 10, (0, 4, 9)),
        (" 1, 3 ", 5, (1, 3)),
        ("2", 5, (2,)),
        ("auto:1", 1, (0,)),
        ("auto:9", 4, (0, 1, 2, 3)),
        ("auto:2", 6, (0, 5)),
    ],
)
def test_what_a_spec_names(spec, steps, expected) -> None:
    assert pick(spec, series_of(steps)) == expected


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("", "allowed: all, every:K, auto:N or a list such as 0,4,9"),
        ("some", "allowed: all"),
        ("0,,1", "allowed: all"),
        ("-1,2", "allowed: all"),
        ("every:0", "write every:K with K >= 1"),
        ("every", "write every:K"),
        ("every:x", "write every:K"),
        ("auto:0", "write auto:N with N >= 2"),
        ("auto:2.5", "write auto:N"),
        ("auto:1", "at least 2"),
        ("0,5", r"ascend without repeats within 0\.\.4"),
        ("2,1", "ascend without repeats"),
        ("1,1", "ascend without repeats"),
    ],
)
def test_what_a_spec_may_not_be(spec, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        pick(spec, series_of(5))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [2, 3, 4, 6, 7])
@pytest.mark.parametrize(
    "times", [np.arange(8.0), UNEVEN, -UNEVEN, UNEVEN * 1e-300, UNEVEN * 1e300, 1e9 + UNEVEN]
)
def test_auto_is_the_best_of_all_subsets(count, times) -> None:
    series = series_of(8, seed=count)
    chosen = pick(f"auto:{count}", series, times)
    subsets = [(0, *inner, 7) for inner in itertools.combinations(range(1, 7), count - 2)]
    best = min(interpolation_error(series.values, times, subset) for subset in subsets)
    assert len(chosen) == count
    assert interpolation_error(series.values, times, chosen) == pytest.approx(best, rel=1e-9)


def test_auto_needs_times_that_go_one_way() -> None:
    with pytest.raises(InputError, match="step numbers"):
        pick("auto:2", series_of(4), np.array([0.0, 1, 1, 2]))


@pytest.mark.parametrize(
    "times",
    [UNEVEN, -UNEVEN, UNEVEN[::-1].copy(), 1e9 + UNEVEN],
    ids=["up", "down", "back", "late"],
)
@pytest.mark.parametrize("key_frames", [(0, 7), (0, 2, 3, 7), (1, 4, 5), tuple(range(8)), (3,)])
def test_key_index_is_whole_at_key_frames_and_linear_in_time_between(times, key_frames) -> None:
    keys = KeyTimes(times=times, key_frames=key_frames)
    assert [keys.key_index(step) for step in key_frames] == list(range(len(key_frames)))
    steps = np.linspace(0, 7, 141)
    indices = keys.key_indices(steps)
    assert (np.diff(indices) >= 0).all()
    assert (indices[0], indices[-1]) == (0, len(key_frames) - 1)
    for a, b in itertools.pairwise(key_frames):
        for step in np.linspace(a, b, 7):
            time = np.interp(step, range(8), times)
            inside = (time - times[a]) / (times[b] - times[a])
            assert keys.key_index(step) - key_frames.index(a) == pytest.approx(
                inside, abs=1e-6 if times[0] > 1e6 else 1e-12
            )


@pytest.mark.parametrize("times", [UNEVEN, UNEVEN[::-1].copy(), -UNEVEN])
def test_step_of_time_inverts_the_times(times) -> None:
    keys = KeyTimes(times=times, key_frames=(0, 7))
    assert [keys.step_of_time(time) for time in times] == list(range(8))
    assert keys.step_of_time((times[2] + times[3]) / 2) == pytest.approx(2.5)
    np.testing.assert_allclose(keys.steps_of_times(times.reshape(2, 4)), np.arange(8).reshape(2, 4))


def test_what_lies_outside_is_refused() -> None:
    keys = KeyTimes(times=UNEVEN[::-1].copy(), key_frames=(0, 7))
    for time in (-0.1, 10.5, np.nan, np.inf):
        with pytest.raises(RegionError, match=r"outside 0\.\.10"):
            keys.step_of_time(time)
    for step in (-0.5, 7.01, np.nan):
        with pytest.raises(RegionError, match=r"outside 0\.\.7"):
            keys.key_index(step)
    with pytest.raises(InputError, match="step numbers"):
        KeyTimes(times=np.array([0.0, 0.0]), key_frames=(0,))
