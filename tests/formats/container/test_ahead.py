"""Reading ahead: which chunks are decoded beside those that are asked for."""

from __future__ import annotations

import pytest

from fhash_formats.container.stored import Ahead, chunks_after


def read(ahead: Ahead, *spans: tuple[int, int]) -> int:
    return ahead.layers([range(*span) for span in spans])


def test_reads_that_go_on_along_the_first_axis_look_farther_each_time() -> None:
    ahead = Ahead()
    assert read(ahead, (0, 1), (0, 2)) == 0
    assert read(ahead, (0, 1), (0, 2)) == 0
    assert read(ahead, (1, 2), (0, 2)) == 1
    assert read(ahead, (1, 2), (0, 2)) == 0
    assert read(ahead, (1, 3), (0, 2)) == 2
    assert read(ahead, (3, 4), (0, 2)) == 3


@pytest.mark.parametrize("other", [((4, 5), (0, 2)), ((2, 3), (1, 2)), ((0, 1), (0, 2))], ids=str)
def test_other_reads_begin_anew(other: tuple[tuple[int, int], tuple[int, int]]) -> None:
    ahead = Ahead()
    read(ahead, (0, 1), (0, 2))
    assert read(ahead, (1, 2), (0, 2)) == 1
    assert read(ahead, *other) == 0
    (_, stop), space = other
    assert read(ahead, (stop, stop + 1), space) == 1


@pytest.mark.parametrize(
    ("threads", "missing", "room", "expected"),
    [
        (1, 1, 99, []),
        (2, 1, 99, [(1, 0)]),
        (2, 2, 99, []),
        (3, 1, 99, [(1, 0), (2, 0)]),
        (9, 1, 99, [(1, 0), (2, 0), (2, 1)]),
        (9, 1, 4, [(1, 0)]),
        (9, 1, 1, []),
        (9, 0, 99, []),
    ],
)
def test_each_thread_without_work_gets_a_chunk_that_is_not_cached(
    threads: int,
    missing: int,
    room: int,
    expected: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FHASH_THREADS", str(threads))
    spans, cached = [range(0, 1), range(0, 2)], {(1, 1)}.__contains__
    assert chunks_after(spans, (3, 2), 2, missing, room, cached) == expected


def test_nothing_lies_after_the_last_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "4")
    assert chunks_after([range(2, 3)], (3,), 5, 1, 99, lambda _: False) == []
