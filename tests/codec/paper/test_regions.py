"""Decoding regions: the law of equal bits, and the 16-corner formula in float64."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.paper import model as points
from fhash_codec.paper.model import decode_region, sample_points
from fhash_formats.errors import InputError, RegionError


def test_a_region_holds_the_bits_of_the_whole_whatever_the_threads(
    networks, network, monkeypatch
) -> None:
    monkeypatch.setattr("fhash_formats.support.threads.ITEMS_PER_THREAD", 1)
    monkeypatch.setattr(points, "SLAB_POINTS", 64)
    rng = np.random.default_rng(5)
    for key_index in networks.key_indices(network):
        frame = decode_region(network, key_index, networks.box(network), threads=1)
        for number in range(8):
            region = []
            for size in network.box_size:
                start = int(rng.integers(size))
                region.append((start, int(rng.integers(start, size)) + 1))
            threads = (1, 2, 4)[number % 3]
            cut = decode_region(network, key_index, tuple(region), threads=threads)
            assert cut.dtype == np.float32
            np.testing.assert_array_equal(cut, frame[tuple(slice(*r) for r in region)])


def test_regions_match_the_sixteen_corner_formula(networks, network) -> None:
    for key_index in networks.key_indices(network):
        frame = decode_region(network, key_index, networks.box(network))
        expected = networks.reference(network, networks.vertices(network, key_index))
        np.testing.assert_allclose(frame.ravel(), expected, rtol=1e-5, atol=1e-5)


def test_vertices_are_points_and_those_that_nobody_requested_are_nan(networks) -> None:
    """A ball, a plate, a column and random vertices, on a key frame and between two."""
    net = networks.random((25, 40, 64), 3, 2, 2, 2, width=64)
    z, y, x = np.ogrid[:25, :40, :64]
    shapes = [
        (z - 12) ** 2 + (y - 15) ** 2 + (x - 30) ** 2 < 90,
        np.broadcast_to(np.abs(x - 20) < 5, net.box_size),
        np.broadcast_to((y == 7) & (x > 60), net.box_size),
        np.random.default_rng(0).random(net.box_size) < 0.02,
    ]
    for key_index in (1.0, 0.4):
        frame = decode_region(net, key_index, networks.box(net))
        for requested in shapes:
            found = decode_region(
                net, key_index, networks.box(net), requested=np.ascontiguousarray(requested)
            )
            np.testing.assert_array_equal(found[requested], frame[requested])
            assert np.isnan(found[~requested]).all()
            places = np.argwhere(requested).T
            np.testing.assert_array_equal(
                sample_points(net, key_index, *places.astype(float)), found[requested]
            )
    region = ((2, 16), (0, 30), (5, 64))
    nothing = np.zeros([stop - start for start, stop in region], bool)
    assert np.isnan(decode_region(net, 0, region, requested=nothing)).all()


def test_a_region_reads_just_its_surroundings_once_per_level(networks) -> None:
    net = networks.recording(networks.random((64, 64, 64), 8, 2, 2, 1))
    decode_region(net, 3.0, ((20, 36),) * 3)
    assert [len(table.regions) for table in net.tables] == [1] * len(net.levels)
    assert net.tables[0].regions[0][0] == (3, 4)  # on a key frame one time node is enough
    largest = prod(stop - start for start, stop in net.tables[0].regions[0][1:4])
    assert largest <= (16 + 2) ** 3
    net = networks.recording(net)
    decode_region(net, 3.2, ((20, 36),) * 3)
    assert net.tables[0].regions[0][0] == (3, 5)
    net = networks.recording(net)
    decode_region(net, 3.2, ((20, 36),) * 3, requested=np.zeros((16, 16, 16), bool))
    assert not net.tables[0].regions


@pytest.mark.parametrize("key_index", [-0.1, 3.1, float("nan"), float("inf")])
def test_a_key_index_outside_is_refused(networks, key_index) -> None:
    net = networks.random((4, 5, 6), 4, 2, 1, 0)
    with pytest.raises(RegionError, match="key index"):
        decode_region(net, key_index, networks.box(net))


@pytest.mark.parametrize(
    "region",
    [
        ((0, 5), (0, 5), (0, 6)),
        ((-1, 2), (0, 5), (0, 6)),
        ((0, 4), (2, 2), (0, 6)),
        ((0, 4), (3, 2), (0, 6)),
    ],
)
def test_a_region_outside_or_empty_is_refused(networks, region) -> None:
    with pytest.raises(RegionError, match="box"):
        decode_region(networks.random((4, 5, 6), 1, 2, 1, 0), 0, region)


def test_wrong_arguments_are_refused(networks) -> None:
    net = networks.random((4, 5, 6), 1, 2, 1, 0)
    with pytest.raises(InputError, match=r"requested .* \(4, 5, 6\)"):
        decode_region(net, 0, networks.box(net), requested=np.ones((4, 5, 5), bool))
    with pytest.raises(InputError, match="threads"):
        decode_region(net, 0, networks.box(net), threads=0)
