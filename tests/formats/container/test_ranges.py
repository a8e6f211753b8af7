"""Ranges that are asked for together: each once, whole, and none far from the others."""

from __future__ import annotations

import random

from fhash_formats.container.source import merged


def places(requests) -> list[tuple[int, int]]:
    return [(request.start, request.stop) for request in requests]


def test_neighbours_are_one_request() -> None:
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=5, most=100)) == [(0, 25)]
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=4, most=100)) == [(0, 15), (20, 25)]


def test_a_request_of_several_ranges_has_a_limit() -> None:
    assert places(merged([(0, 6), (6, 6), (12, 6)], gap=0, most=12)) == [(0, 12), (12, 18)]
    assert places(merged([(0, 60), (60, 6)], gap=0, most=12)) == [(0, 60), (60, 66)]


def test_a_range_within_another() -> None:
    (request,) = merged([(0, 50), (10, 5), (10, 5)], gap=0, most=100)
    assert (request.place, request.size, request.ranges) == ((0, 50), 50, ((0, 50), (10, 5)))


def test_nothing() -> None:
    assert merged([], gap=5, most=5) == []


def test_every_range_lies_in_one_request() -> None:
    for seed in range(200):
        draw = random.Random(seed)
        ranges = [(draw.randrange(300), draw.randrange(1, 40)) for _ in range(draw.randrange(1, 9))]
        gap, most = draw.randrange(20), draw.randrange(1, 120)
        requests = merged(ranges, gap, most)
        assert sorted(place for request in requests for place in request.ranges) == sorted(
            set(ranges)
        )
        for request in requests:
            covered = set()
            for offset, size in request.ranges:
                assert request.start <= offset
                assert offset + size <= request.stop
                covered.update(range(offset, offset + size))
            assert request.size - len(covered) <= gap * (len(request.ranges) - 1)
            assert len(request.ranges) == 1 or request.size <= most
