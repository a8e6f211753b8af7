"""Decoding regions and points, against the 16-corner formula in float64."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from math import prod

import numpy as np
import pytest

from fhash_codec.paper import points
from fhash_codec.paper import regions as decoder
from fhash_codec.paper.levels import level_resolutions
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.paper.points import sample_points
from fhash_codec.paper.regions import block_shape, decode_region
from fhash_formats.errors import DamagedFileError, InputError, RegionError

# box (z, y, x), key frames, fold, embedding size, hidden layers
SHAPES = [
    ((1, 1, 1), 1, 2, 1, 1),
    ((1, 1, 2), 2, 2, 2, 0),
    ((2, 2, 2), 3, 2, 4, 2),
    ((1, 7, 1), 1, 2, 3, 1),
    ((1, 40, 67), 5, 2, 2, 1),
    ((13, 17, 37), 4, 3, 2, 1),
    ((11, 33, 35), 12, 2, 1, 0),
    ((9, 23, 70), 2, 2, 3, 2),
    ((64, 32, 8), 1, 4, 2, 1),
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)


def random_network(
    box, key_frames, fold, embedding_size, hidden, *, seed=0, width=16, dtype=np.float32
):
    rng = np.random.default_rng(seed)
    levels = level_resolutions(box, key_frames, fold)
    widths = [len(levels) * embedding_size, *[width] * hidden, 1]
    layers = [
        (
            (rng.standard_normal((n, m)) / np.sqrt(m)).astype(np.float32),
            rng.standard_normal(n).astype(np.float32),
        )
        for m, n in pairwise(widths)
    ]
    tables = [
        ArrayTable(rng.standard_normal((*level, embedding_size)).astype(dtype)) for level in levels
    ]
    return Network(
        levels=levels,
        embedding_size=embedding_size,
        tables=tables,
        layers=tuple(layers),
        box_size=box,
        key_frames=key_frames,
    )


def reference(net, positions):
    """Values (n,) at positions (4, n), float64: 16 corners per level, no shortcuts."""
    sizes = (net.key_frames, *net.box_size)
    features = []
    for level, table in zip(net.levels, net.tables, strict=True):
        position = [
            p * (r - 1) / max(s - 1, 1) for p, r, s in zip(positions, level, sizes, strict=True)
        ]
        before = [
            np.minimum(np.floor(p), max(r - 2, 0)).astype(int)
            for p, r in zip(position, level, strict=True)
        ]
        feature = np.zeros((net.embedding_size, len(positions[0])))
        for corner in product((0, 1), repeat=4):
            index = tuple(
                np.minimum(b + c, r - 1) for b, c, r in zip(before, corner, level, strict=True)
            )
            weight = prod(
                np.abs(p - b - 1 + c) for p, b, c in zip(position, before, corner, strict=True)
            )
            feature += weight * table.values[index].astype(np.float64).T
        features.append(feature)
    value = np.concatenate(features)
    for number, (weight, bias) in enumerate(net.layers):
        value = (
            weight.astype(np.float64) @ (np.maximum(value, 0) if number else value) + bias[:, None]
        )
    return value[0]


def lattice(net, key_index):
    grid = np.meshgrid(*(np.arange(n, dtype=float) for n in net.box_size), indexing="ij")
    return [np.full(grid[0].size, key_index), *(g.ravel() for g in grid)]


def whole(net):
    return tuple((0, size) for size in net.box_size)


def key_indices(net):
    last = net.key_frames - 1
    return sorted({0.0, float(last), last / 2, last * 0.37})


def random_points(net, count, seed=1):
    rng = np.random.default_rng(seed)
    return [rng.random(count) * (size - 1) for size in (net.key_frames, *net.box_size)]


@shapes
def test_a_region_holds_the_bits_of_the_whole_whatever_the_threads(shape, monkeypatch):
    monkeypatch.setattr("fhash_formats.support.threads.ITEMS_PER_THREAD", 1)
    monkeypatch.setattr(decoder, "BLOCK_VERTICES", 512)
    net = random_network(*shape)
    rng = np.random.default_rng(5)
    for key_index in key_indices(net):
        frame = decode_region(net, key_index, whole(net), threads=1)
        for number in range(8):
            region = []
            for size in net.box_size:
                start = int(rng.integers(size))
                region.append((start, int(rng.integers(start, size)) + 1))
            part = decode_region(net, key_index, tuple(region), threads=(1, 2, 4)[number % 3])
            assert part.dtype == np.float32
            np.testing.assert_array_equal(part, frame[tuple(slice(*r) for r in region)])


def test_the_law_holds_for_the_default_blocks_and_network():
    net = random_network((25, 40, 75), 3, 2, 2, 1, width=64)
    frame = decode_region(net, 0.4, whole(net), threads=4)
    for region in [
        ((0, 25), (0, 40), (0, 75)),
        ((3, 19), (11, 27), (50, 66)),
        ((24, 25), (39, 40), (74, 75)),
    ]:
        np.testing.assert_array_equal(
            decode_region(net, 0.4, region, threads=2), frame[tuple(slice(*r) for r in region)]
        )


@shapes
def test_regions_and_points_match_the_sixteen_corner_formula(shape):
    net = random_network(*shape)
    for key_index in key_indices(net):
        frame = decode_region(net, key_index, whole(net))
        np.testing.assert_allclose(
            frame.ravel(), reference(net, lattice(net, key_index)), rtol=1e-5, atol=1e-5
        )
        np.testing.assert_allclose(
            sample_points(net, *lattice(net, key_index)), frame.ravel(), rtol=1e-5, atol=1e-5
        )
    scattered = random_points(net, 500)
    np.testing.assert_allclose(
        sample_points(net, *scattered), reference(net, scattered), rtol=1e-5, atol=1e-5
    )


@shapes
def test_gradients_match_central_differences(shape):
    net = random_network(*shape)
    scattered = random_points(net, 400, seed=2)
    values, slopes = sample_points(net, *scattered, gradient=True)
    np.testing.assert_array_equal(values, sample_points(net, *scattered))
    assert slopes.shape == (400, 4)
    step = 1e-5
    for axis, size in enumerate((net.key_frames, *net.box_size)):
        if size == 1:
            assert not slopes[:, axis].any()
            continue
        after, before = [list(scattered) for _ in range(2)]
        after[axis] = np.minimum(scattered[axis] + step, size - 1)
        before[axis] = np.maximum(scattered[axis] - step, 0)
        expected = (reference(net, after) - reference(net, before)) / (after[axis] - before[axis])
        close = np.abs(slopes[:, axis] - expected) <= 1e-4 * (1 + np.abs(expected))
        # A few differences straddle the kink of a ReLU or the border of a cell.
        assert close.mean() > 0.97


@pytest.mark.parametrize(
    "shape", [((5, 9, 17), 6, 2), ((1, 12, 2), 1, 3), ((7, 1, 10), 3, 2)], ids=str
)
def test_a_linear_field_and_its_gradient_are_reproduced(shape):
    box, key_frames, fold = shape
    levels = level_resolutions(box, key_frames, fold)
    sizes, slope = np.array((key_frames, *box)), np.array([0.5, -0.25, 0.125, 0.375])
    tables = []
    for level in levels:
        corners = np.stack(
            np.meshgrid(
                *(np.linspace(0, s - 1, r) for s, r in zip(sizes, level, strict=True)),
                indexing="ij",
            ),
            axis=-1,
        )
        tables.append(ArrayTable((corners @ slope)[..., None].astype(np.float32)))
    readout = (np.full((1, len(levels)), 1 / len(levels), np.float32), np.array([2.0], np.float32))
    net = Network(
        levels=levels,
        embedding_size=1,
        tables=tables,
        layers=(readout,),
        box_size=box,
        key_frames=key_frames,
    )
    scattered = random_points(net, 200)
    # Cell borders and both ends too: the derivative is one-sided there, never missing.
    scattered = [
        np.concatenate([p, [0, s - 1, s // 2]]) for p, s in zip(scattered, sizes, strict=True)
    ]
    values, slopes = sample_points(net, *scattered, gradient=True)
    np.testing.assert_allclose(values, 2 + slope @ np.array(scattered), atol=1e-5)
    np.testing.assert_allclose(
        slopes, np.broadcast_to(np.where(sizes > 1, slope, 0), slopes.shape), atol=1e-5
    )
    frame = decode_region(net, 0.5 * (key_frames - 1), whole(net))
    np.testing.assert_allclose(
        frame.ravel(), 2 + slope @ np.array(lattice(net, 0.5 * (key_frames - 1))), atol=1e-5
    )


def test_the_derivative_on_a_border_is_that_of_the_cell_after_it():
    table = np.array([0, 1, 3, 7], np.float32).reshape(1, 1, 1, 4, 1)
    readout = (np.ones((1, 1), np.float32), np.zeros(1, np.float32))
    net = Network(
        levels=((1, 1, 1, 4),),
        embedding_size=1,
        tables=[ArrayTable(table)],
        layers=(readout,),
        box_size=(1, 1, 4),
        key_frames=1,
    )
    values, slopes = sample_points(net, 0, 0, 0, [0.0, 1.0, 2.0, 3.0], gradient=True)
    assert values.tolist() == [0, 1, 3, 7]
    assert slopes[:, 3].tolist() == [1, 2, 4, 4]


def test_a_vertex_on_a_corner_has_exactly_its_embedding():
    net = random_network((6, 20, 40), 3, 2, 1, 0)
    weight = np.zeros((1, net.inputs), np.float32)
    weight[0, 0] = 1
    net = replace(net, layers=((weight, np.zeros(1, np.float32)),))
    for key in range(3):
        np.testing.assert_array_equal(
            decode_region(net, key, whole(net)), net.tables[0].values[key, ..., 0]
        )


def test_half_precision_tables_decode_as_their_float32_values():
    half = random_network((5, 12, 21), 4, 2, 2, 1, dtype=np.float16)
    full = replace(
        half, tables=[ArrayTable(table.values.astype(np.float32)) for table in half.tables]
    )
    np.testing.assert_array_equal(
        decode_region(half, 1.3, whole(half)), decode_region(full, 1.3, whole(full))
    )
    scattered = random_points(half, 50)
    np.testing.assert_array_equal(sample_points(half, *scattered), sample_points(full, *scattered))


def test_blocks_without_a_wanted_vertex_are_nan_and_the_others_as_ever(monkeypatch):
    monkeypatch.setattr(decoder, "BLOCK_VERTICES", 512)
    net = random_network((16, 32, 64), 1, 2, 2, 1)
    frame = decode_region(net, 0, whole(net))
    region = ((2, 16), (0, 30), (5, 64))
    part = frame[tuple(slice(*r) for r in region)]
    wanted = np.zeros(part.shape, bool)
    wanted[1, 3, 4] = wanted[-1, -1, -1] = True
    decoded = decode_region(net, 0, region, requested=wanted)
    known = np.isfinite(decoded)
    assert known[wanted].all()
    assert 0 < known.mean() < 0.5
    np.testing.assert_array_equal(decoded[known], part[known])
    assert np.isnan(decode_region(net, 0, region, requested=np.zeros(part.shape, bool))).all()


class RecordingTable(ArrayTable):
    """Remembers what is read, and forbids anything but plain slices."""

    def __init__(self, values):
        super().__init__(values)
        self.regions = []

    def read(self, region):
        assert len(region) == 5
        for part, size in zip(region, self.shape, strict=True):
            assert part.step is None
            assert 0 <= part.start < part.stop <= size
        self.regions.append(tuple((part.start, part.stop) for part in region))
        return super().read(region)


def recorded(net):
    return replace(net, tables=[RecordingTable(table.values) for table in net.tables])


def test_a_region_reads_just_its_surroundings_once_per_level():
    net = recorded(random_network((64, 64, 64), 8, 2, 2, 1))
    decode_region(net, 3.0, ((20, 36),) * 3)
    assert [len(table.regions) for table in net.tables] == [1] * len(net.levels)
    assert net.tables[0].regions[0][0] == (3, 4)  # on a key frame one time node is enough
    largest = prod(stop - start for start, stop in net.tables[0].regions[0][1:4])
    assert largest <= (16 + 2 * 32) * (16 + 2 * 16) * (16 + 2 * 16)
    net = recorded(net)
    decode_region(net, 3.2, ((20, 36),) * 3)
    assert net.tables[0].regions[0][0] == (3, 5)
    net = recorded(net)
    decode_region(net, 3.2, ((20, 36),) * 3, requested=np.zeros((16, 16, 16), bool))
    assert not net.tables[0].regions


def test_a_frame_read_in_slabs_has_the_same_bits(monkeypatch):
    net = random_network((23, 20, 30), 4, 2, 2, 1)
    frame = decode_region(net, 1.7, whole(net))
    monkeypatch.setattr(decoder, "READ_NUMBERS", 4 * 20 * 30 * 2)
    slabs = recorded(net)
    np.testing.assert_array_equal(decode_region(slabs, 1.7, whole(net)), frame)
    assert len(slabs.tables[0].regions) == 6


def test_points_far_apart_are_read_apart_and_come_out_alike(monkeypatch):
    net = random_network((40, 40, 40), 6, 2, 2, 1)
    scattered = [
        np.concatenate([p[:5] * 0.1, p[5:] * 0.1 + 0.9 * (s - 1)])
        for p, s in zip(random_points(net, 10), (6, 40, 40, 40), strict=True)
    ]
    together = sample_points(net, *scattered, gradient=True)
    monkeypatch.setattr(points, "SMALL_READ", 2**12)
    apart = recorded(net)
    for one, other in zip(together, sample_points(apart, *scattered, gradient=True), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    assert len(apart.tables[0].regions) > 1
    assert (
        sum(prod(b - a for a, b in region[:4]) for region in apart.tables[0].regions) <= 2 * 2**12
    )
    many = random_points(net, 20_000)
    np.testing.assert_allclose(
        sample_points(net, *many, threads=4), reference(net, many), rtol=1e-5, atol=1e-5
    )


def test_points_may_be_none_or_share_a_coordinate():
    net = random_network((3, 4, 5), 2, 2, 2, 1)
    assert sample_points(net, [], [], [], []).shape == (0,)
    assert sample_points(net, [], [], [], [], gradient=True)[1].shape == (0, 4)
    np.testing.assert_array_equal(
        sample_points(net, 0.5, 1.0, [0, 1.5], 2.0),
        sample_points(net, [0.5] * 2, [1, 1], [0, 1.5], [2, 2]),
    )


@pytest.mark.parametrize(
    "box",
    [
        (1, 1, 1),
        (1, 1, 5000),
        (1, 300, 300),
        (25, 125, 125),
        (8, 16, 32),
        (500, 2, 3),
        (64, 64, 64),
    ],
    ids=str,
)
def test_blocks_are_bounded_and_barely_overhang(box):
    shape = block_shape(box)
    assert all(1 <= length <= size for length, size in zip(shape, box, strict=True))
    assert prod(shape) <= decoder.BLOCK_VERTICES
    assert all(
        -(-size // length) * length - size < -(-size // length)
        for length, size in zip(shape, box, strict=True)
    )


@pytest.mark.parametrize("key_index", [-0.1, 3.1, float("nan"), float("inf")])
def test_a_key_index_outside_is_refused(key_index):
    net = random_network((4, 5, 6), 4, 2, 1, 0)
    with pytest.raises(RegionError, match="key index"):
        decode_region(net, key_index, whole(net))
    with pytest.raises(RegionError, match="key_index"):
        sample_points(net, key_index, 0, 0, 0)


@pytest.mark.parametrize(
    "region",
    [
        ((0, 5), (0, 5), (0, 6)),
        ((-1, 2), (0, 5), (0, 6)),
        ((0, 4), (2, 2), (0, 6)),
        ((0, 4), (3, 2), (0, 6)),
    ],
)
def test_a_region_outside_or_empty_is_refused(region):
    with pytest.raises(RegionError, match="box"):
        decode_region(random_network((4, 5, 6), 1, 2, 1, 0), 0, region)


def test_wrong_arguments_are_refused():
    net = random_network((4, 5, 6), 1, 2, 1, 0)
    with pytest.raises(InputError, match=r"requested .* \(4, 5, 6\)"):
        decode_region(net, 0, whole(net), requested=np.ones((4, 5, 5), bool))
    with pytest.raises(InputError, match="threads"):
        decode_region(net, 0, whole(net), threads=0)
    with pytest.raises(RegionError, match=r"point 1: x 5\.5 is outside 0\.\.5"):
        sample_points(net, 0, 0, 0, [1, 5.5])
    with pytest.raises(RegionError, match="point 0: y nan"):
        sample_points(net, 0, 0, float("nan"), 0)
    with pytest.raises(InputError, match="one length"):
        sample_points(net, [0, 0, 0], 0, 0, [1, 2])
    with pytest.raises(InputError, match="one length"):
        sample_points(net, np.zeros((2, 2)), 0, 0, 0)


def test_a_network_whose_parts_do_not_fit_is_refused():
    net = random_network((4, 5, 6), 2, 2, 2, 1)
    weight, bias = net.layers[0]
    cases = [
        ({"tables": net.tables[:-1]}, "tables for"),
        ({"tables": [net.tables[1], *net.tables[1:]]}, "table of level 1"),
        ({"embedding_size": 3}, "table of level 1"),
        ({"key_frames": 0}, "at least 1"),
        ({"layers": net.layers[:1]}, "one output"),
        ({"layers": ()}, "one output"),
        ({"layers": ((weight[:, 1:], bias), net.layers[1])}, "layer 1"),
        ({"layers": ((weight, bias[1:]), net.layers[1])}, "layer 1"),
        ({"layers": ((weight * np.float32(np.nan), bias), net.layers[1])}, "not finite"),
    ]
    for change, message in cases:
        with pytest.raises(InputError, match=message):
            replace(net, **change)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_table_that_is_not_finite_is_refused_not_decoded(bad):
    net = random_network((4, 5, 6), 2, 2, 2, 1)
    net.tables[1].values[0, 0, 0, 0, 1] = bad
    with pytest.raises(DamagedFileError, match="level 2"):
        decode_region(net, 0, whole(net))
    with pytest.raises(DamagedFileError, match="level 2"):
        sample_points(net, 0, 0, 0, 0)


@pytest.mark.parametrize("gradient", [False, True])
def test_weights_that_overflow_give_no_warning(gradient):
    """Of hostile files; infinities are then clipped to the range of values."""
    net = random_network((2, 3, 4), 2, 2, 2, 2)
    layers = tuple(
        (np.where(weight > 0, np.float32(3e38), np.float32(-3e38)), bias)
        for weight, bias in net.layers
    )
    hostile = replace(net, layers=layers)
    positions = np.full((4, 3), 0.5)
    sample_points(hostile, *positions, gradient=gradient)
    decode_region(hostile, 0.5, ((0, 2), (0, 3), (0, 4)))
