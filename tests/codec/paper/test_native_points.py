"""Points by every path of the native library, and the parts of tables that it reads."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from fhash_codec.native import network as native
from fhash_codec.native.network import best_path
from fhash_codec.paper import points
from fhash_codec.paper.network import Network
from fhash_codec.paper.points import PointSampler, PointTables, corners_before, sample_points

SHAPES = [
    # Box (z, y, x), key frames, fold, embedding size, hidden layers, width.
    ((1, 1, 1), 1, 2, 1, 1, 16),
    ((1, 1, 2), 2, 2, 2, 0, 16),
    ((9, 12, 1), 3, 2, 2, 1, 64),
    ((1, 7, 1), 1, 2, 3, 1, 1),
    ((13, 17, 37), 4, 3, 2, 2, 64),
    ((11, 33, 35), 12, 2, 1, 0, 16),
    ((9, 23, 30), 2, 2, 4, 2, 128),
    ((8, 9, 40), 6, 2, 5, 3, 33),
    ((60, 70, 80), 3, 2, 2, 1, 32),
]


@pytest.fixture
def library() -> ctypes.CDLL:
    return native.library()


@pytest.fixture(params=SHAPES, ids=str)
def network(request: pytest.FixtureRequest, networks) -> Network:
    *shape, width = request.param
    return networks.random(*shape, width=width)


def paths(library: ctypes.CDLL) -> list[int]:
    return [bit for bit in (1, 2, 4) if library.fhash_network_paths() & bit]


def faces_and_inside(networks, network: Network) -> list[np.ndarray]:
    """Random points, and every corner of the box at both ends of time."""
    ends = [(0.0, size - 1.0) for size in (network.key_frames, *network.box_size)]
    corners = np.array(list(product(*ends))).T
    inside = networks.points(network, 171)
    on_faces = [p.copy() for p in networks.points(network, 60, seed=4)]
    for number in range(60):
        axis = number % 4
        on_faces[axis][number] = ends[axis][number // 4 % 2]
    return [np.concatenate(c) for c in zip(corners, inside, on_faces, strict=True)]


def test_every_path_gives_the_values_of_the_formula(library, networks, network) -> None:
    places = faces_and_inside(networks, network)
    tables = PointTables.read(network, [c.min() for c in places], [c.max() for c in places])
    expected = networks.reference(network, places)
    for path in paths(library):
        values = np.empty(len(expected), np.float32)
        slopes = np.empty((len(expected), 4), np.float32)
        sampler = PointSampler(tables, path=path)
        sampler.evaluate(places, values, slopes)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
        alone = np.empty_like(values)
        sampler.evaluate(places, alone)
        np.testing.assert_array_equal(alone, values)


def test_tables_at_one_time_give_the_same_bits(library, networks, network) -> None:
    key_index = 0.37 * (network.key_frames - 1)
    places = [np.array([key_index]), *networks.points(network, 200)[1:]]
    tables = PointTables.of_box(network, key_index)
    for path in paths(library):
        values, once = np.empty(200, np.float32), np.empty(200, np.float32)
        PointSampler(tables, path=path).evaluate(places, values)
        PointSampler(tables, key_index, path).evaluate([np.zeros(1), *places[1:]], once)
        np.testing.assert_array_equal(once, values)


def test_few_points_of_one_time_have_the_bits_of_many(networks, library, monkeypatch) -> None:
    network = networks.random((20, 21, 22), 5, 2, 2, 1)
    places = [np.array([2.3]), *networks.points(network, 2000)[1:]]
    values = sample_points(network, *places)
    once = []
    at = PointTables.at
    monkeypatch.setattr(
        PointTables, "at", lambda self, key, path: once.append(key) or at(self, key, path)
    )
    np.testing.assert_array_equal(sample_points(network, *places), values)
    few = [places[0], *(p[:5] for p in places[1:])]
    monkeypatch.setattr(points, "READ_PER_POINT", 0)
    np.testing.assert_array_equal(sample_points(network, *few), values[:5])
    assert once == [2.3]


def test_points_beside_borders_are_read_where_they_are_evaluated(networks, library) -> None:
    """One point a call: a cell that was not read would show at once."""
    network = networks.random((7, 50, 125), 3, 2, 2, 1)
    for level in network.levels[1:4]:
        border = [
            k * (s - 1) / max(r - 1, 1)
            for k, s, r in zip((1, 2, 11, 29), (3, 7, 50, 125), level, strict=True)
        ]
        border = [min(b, s - 1.0) for b, s in zip(border, (3, 7, 50, 125), strict=True)]
        for end in (0.0, 1e9):
            place = [
                min(float(np.nextafter(b, end)), s - 1.0)
                for b, s in zip(border, (3, 7, 50, 125), strict=True)
            ]
            np.testing.assert_allclose(
                sample_points(network, *place),
                networks.reference(network, [np.array([p]) for p in place]),
                rtol=1e-5,
                atol=1e-5,
            )


def test_strided_places_and_several_threads_change_nothing(networks, library) -> None:
    network = networks.random((20, 21, 22), 5, 2, 2, 1)
    rows = np.stack(networks.points(network, 100_000), axis=1)
    apart = sample_points(network, *np.ascontiguousarray(rows.T), threads=1)
    np.testing.assert_array_equal(sample_points(network, *rows.T, threads=4), apart)


def test_a_path_that_is_not_there_is_refused(networks, library) -> None:
    network = networks.random((2, 3, 4), 1, 2, 2, 1)
    sampler = PointSampler(PointTables.of_box(network, 0), path=3)
    with pytest.raises(MemoryError):
        sampler.evaluate([np.zeros(1)] * 4, np.empty(1, np.float32))
    assert best_path(library) == max(paths(library))


def test_layers_that_overflow_stay_so(networks, library) -> None:
    network = networks.random((2, 3, 4), 2, 2, 2, 2)
    huge = tuple((np.full_like(weight, 3e38), bias) for weight, bias in network.layers)
    assert not np.isfinite(sample_points(replace(network, layers=huge), 0.5, 1, 1, 1)).any()


def test_a_part_holds_the_corners_of_all_points(networks, network) -> None:
    recording = networks.recording(network)
    points = np.array(networks.points(network, 7))
    tables = PointTables.read(recording, points.min(axis=1).tolist(), points.max(axis=1).tolist())
    for level, patch in zip(network.levels, tables.patches, strict=True):
        before = np.array([corners_before(tables.sizes, level, point) for point in points.T])
        last = np.minimum(before + 1, np.array(level) - 1)
        assert (before.min(axis=0) == patch.first).all()
        assert (last.max(axis=0) < np.add(patch.first, patch.values.shape[:4])).all()
    assert all(len(table.regions) == 1 for table in recording.tables)


def test_tables_at_one_time_are_those_between_its_nodes(networks) -> None:
    network = networks.random((4, 5, 6), 5, 2, 2, 1, dtype=np.float16)
    tables = PointTables.of_box(network, 1.7)
    still = tables.at(1.7)
    assert (still.still, tables.still) == (True, False)
    assert still.at(0.0) is still
    for level, patch, table in zip(network.levels, still.patches, network.tables, strict=True):
        position = 1.7 * (level[0] - 1) / 4
        node = int(position)
        low, high = table.values[node].astype(float), table.values[node + 1].astype(float)
        expected = low + (position - node) * (high - low)
        np.testing.assert_allclose(patch.values[0], expected, rtol=1e-6, atol=1e-6)
        assert patch.values.dtype == np.float32


@pytest.mark.parametrize(
    ("size", "resolution"), [(125, 63), (80, 41), (7, 3), (997, 499), (50, 2), (1, 1), (64, 64)]
)
def test_points_beside_a_border_lie_in_the_exact_cell(size: int, resolution: int) -> None:
    """The native library finds cells without a quotient: it must find the same, which were read."""
    borders = np.arange(1, resolution - 1) * (size - 1) / max(resolution - 1, 1)
    places = np.concatenate([borders, *(np.nextafter(borders, end) for end in (0, size))])
    places = np.append(places, [0.0, size - 1.0])
    before = [corners_before((size,) * 4, (resolution,) * 4, [at] * 4)[0] for at in places]
    scaled = [Fraction(float(place * (resolution - 1))) for place in places]
    exact = [min(at // max(size - 1, 1), max(resolution - 2, 0)) for at in scaled]
    assert before == exact
