"""Features of the format that a reader of a stream must know."""

from __future__ import annotations

from fhash_formats.transform.tile.sections import MANY, parse_stream, unpack_settings
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["stream_features"]

LABELS = "labels"
"""Feature of streams that are coded as labels."""
MANY_LABELS = "many-labels"
"""Feature of such streams with more than 256 labels."""


def stream_features(data: bytes | memoryview, shared: TileSettings | None) -> frozenset[str]:
    """Names that a container with this stream requires besides that of its codec.

    shared: settings of the codec, which hold where the stream has none of its own. Raises
    DamagedFileError for bytes that no encoder writes.
    """
    stream = parse_stream(data)
    settings = shared if stream.settings is None else unpack_settings(stream.settings)
    found = set(() if settings is None else settings.features)
    if stream.labelled:
        found.add(LABELS)
        if stream.flags & MANY:
            found.add(MANY_LABELS)
    return frozenset(found)
