"""Ranges and conditions of HTTP requests."""

from __future__ import annotations

import pytest

from fhash_codec.zarr_view.ranges import UNSATISFIABLE, byte_range, names_tag


@pytest.mark.parametrize(
    ("header", "span"),
    [
        (None, None),
        ("bytes=0-9", (0, 10)),
        ("bytes=5-5", (5, 6)),
        ("bytes=90-", (90, 100)),
        ("bytes=90-1000", (90, 100)),
        ("bytes=-7", (93, 100)),
        ("bytes=-1000", (0, 100)),
        ("Bytes = 1-2", (1, 3)),
        ("bytes=100-", UNSATISFIABLE),
        ("bytes=100-200", UNSATISFIABLE),
        ("bytes=-0", UNSATISFIABLE),
        ("bytes=9-3", None),
        ("bytes=0-1,5-6", None),
        ("bytes=-", None),
        ("bytes=a-b", None),
        ("lines=0-1", None),
        ("bytes=" + "9" * 30 + "-", None),
    ],
)
def test_ranges(header: str | None, span: tuple[int, int] | None) -> None:
    assert byte_range(header, 100) == span


def test_nothing_can_be_taken_from_nothing() -> None:
    assert byte_range("bytes=-5", 0) == UNSATISFIABLE
    assert byte_range("bytes=0-", 0) == UNSATISFIABLE


@pytest.mark.parametrize(
    ("header", "named"),
    [
        (None, False),
        ('"a"', True),
        ('W/"a"', True),
        ('"b", "a"', True),
        ("*", True),
        ('"b"', False),
        ("a", False),
        ("", False),
    ],
)
def test_tags(header: str | None, named: bool) -> None:
    assert names_tag(header, '"a"') is named
