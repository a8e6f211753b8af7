"""Reading ahead: what a reader who goes along the first axis of an array will want next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice, product

from fhash_formats.support.fork_lock import ForkLock
from fhash_formats.support.threads import usable_threads

__all__ = ["Ahead", "chunks_after"]

Index = tuple[int, ...]


class Ahead:
    """The reads of an array so far, as far as they tell the next one. Safe for several threads."""

    def __init__(self) -> None:
        self._lock = ForkLock()
        self._last: Sequence[range] | None = None
        self._moves = 0

    def layers(self, spans: Sequence[range]) -> int:
        """Number of layers of chunks after those of a read that are worth decoding with them.

        That is the number of times that reads in a row went on along the first axis, without a gap
        and with the same chunks of the other axes; 0 for a read that does not go on.

        spans: chunks of the read along each axis.
        """
        with self._lock:
            last, self._last = self._last, spans
            if last is None or spans[1:] != last[1:]:
                self._moves = 0
            elif spans[0].start <= last[0].stop < spans[0].stop:
                self._moves += 1
                return self._moves
            elif spans[0] != last[0]:
                self._moves = 0
            return 0


def chunks_after(
    spans: Sequence[range],
    grid: Sequence[int],
    layers: int,
    missing: int,
    room: int,
    cached: Callable[[Index], bool],
) -> list[Index]:
    """Chunks to decode beside those of a read, one for each thread that it leaves without work.

    Args:
        spans: chunks of the read along each axis.
        grid: chunks of the array along each axis.
        layers: how many layers after the read they may lie in.
        missing: chunks of the read that are not in the cache. Nothing is decoded beside none.
        room: chunks that the cache holds. Those of the read and these take half of it at most.
        cached: whether a chunk is in the cache.
    """
    if not missing:
        return []
    first = spans[0].stop
    after = product(range(first, min(first + layers, grid[0])), *spans[1:])
    idle = min(usable_threads(), room // 2) - missing
    return list(islice((index for index in after if not cached(index)), max(0, idle)))
