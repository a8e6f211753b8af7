"""Conditions and ranges of HTTP requests (RFC 9110, sections 13 and 14), as far as they are served.

Single ranges of bytes are; several at once are answered by the whole, as the standard allows.
"""

from __future__ import annotations

import re

__all__ = ["UNSATISFIABLE", "byte_range", "names_tag"]

UNSATISFIABLE = (-1, -1)
"""The range of a request for bytes beyond the end."""

_SINGLE = re.compile(r"\s*bytes\s*=\s*([0-9]{0,18})\s*-\s*([0-9]{0,18})\s*", re.IGNORECASE)


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """First byte and end of what a header `Range` asks for; None for the whole.

    header: the header's value; None where there is none. size: bytes of the whole.

    A header that is no single range of bytes does not count. UNSATISFIABLE is returned for a range
    that begins at or beyond the end.
    """
    match = None if header is None else _SINGLE.fullmatch(header)
    if match is None:
        return None
    first, last = match.groups()
    if not first and not last:
        return None
    if not first:
        length = int(last)
        return (max(0, size - length), size) if length and size else UNSATISFIABLE
    if last and int(last) < int(first):
        return None
    if int(first) >= size:
        return UNSATISFIABLE
    return int(first), min(size, int(last) + 1) if last else size


def names_tag(header: str | None, tag: str) -> bool:
    """Whether a header `If-None-Match` names an entity tag, quotes included, or any.

    A weak tag (`W/"..."`) names the strong one of the same text.
    """
    if header is None:
        return False
    names = [name.strip().removeprefix("W/") for name in header.split(",")]
    return tag in names or "*" in names
