"""Points by the native library: every path, against the 16-corner formula and against numpy."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from fhash_codec.native import network as native
from fhash_codec.native.network import best_path
from fhash_codec.paper import points
from fhash_codec.paper.native_points import NativePoints
from fhash_codec.paper.network import Network
from fhash_codec.paper.point_tables import PointTables
from fhash_codec.paper.points import sample_points

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
        NativePoints(library, tables, path).evaluate(places, values, slopes)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
        alone = np.empty_like(values)
        NativePoints(library, tables, path).evaluate(places, alone, None)
        np.testing.assert_array_equal(alone, values)


def test_tables_at_one_time_give_the_same_bits(library, networks, network) -> None:
    key_index = 0.37 * (network.key_frames - 1)
    places = [np.array([key_index]), *networks.points(network, 200)[1:]]
    tables = PointTables.of_box(network, key_index)
    for path in paths(library):
        both = NativePoints(library, tables, path)
        values, once = np.empty(200, np.float32), np.empty(200, np.float32)
        both.evaluate(places, values, None)
        both.at(key_index).evaluate([np.zeros(1), *places[1:]], once, None)
        np.testing.assert_array_equal(once, values)


def test_few_points_of_one_time_have_the_bits_of_many(networks, library, monkeypatch) -> None:
    network = networks.random((20, 21, 22), 5, 2, 2, 1)
    places = [np.array([2.3]), *networks.points(network, 2000)[1:]]
    values = sample_points(network, *places)
    once = []
    at = NativePoints.at
    monkeypatch.setattr(NativePoints, "at", lambda self, key: once.append(key) or at(self, key))
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
    points = NativePoints(library, PointTables.of_box(network, 0), 3)
    with pytest.raises(MemoryError):
        points.evaluate([np.zeros(1)] * 4, np.empty(1, np.float32), None)
    assert best_path(library) == max(paths(library))


def test_layers_that_overflow_stay_so(networks, library) -> None:
    network = networks.random((2, 3, 4), 2, 2, 2, 2)
    huge = tuple((np.full_like(weight, 3e38), bias) for weight, bias in network.layers)
    assert not np.isfinite(sample_points(replace(network, layers=huge), 0.5, 1, 1, 1)).any()
