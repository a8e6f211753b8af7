"""Ranges of bytes that are better asked for together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

__all__ = ["Range", "Request", "merged"]

Range = tuple[int, int]
"""Offset and number of bytes, at least 1."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """Bytes that are asked for at once.

    Attributes:
        start, stop: offsets of the first byte and of the one after the last.
        ranges: those that the bytes were asked for, by offset.
    """

    start: int
    stop: int
    ranges: tuple[Range, ...]

    @property
    def place(self) -> Range:
        """The range that all others lie in."""
        return self.start, self.size

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.stop - self.start


def merged(ranges: Iterable[Range], gap: int, most: int) -> list[Request]:
    """Requests for all ranges, by offset; each range lies in one request.

    Args:
        ranges: in any order; they may repeat and overlap.
        gap: bytes between two ranges up to which both are in one request.
        most: bytes of a request of several ranges.
    """
    requests: list[Request] = []
    start = stop = 0
    group: list[Range] = []
    for offset, size in sorted(set(ranges)):
        end = max(stop, offset + size)
        if group and (offset - stop > gap or end - start > most):
            requests.append(Request(start=start, stop=stop, ranges=tuple(group)))
            group = []
        if not group:
            start, end = offset, offset + size
        stop = end
        group.append((offset, size))
    if group:
        requests.append(Request(start=start, stop=stop, ranges=tuple(group)))
    return requests
