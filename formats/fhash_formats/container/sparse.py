"""Tables of needed vertices alone: what the header and the arrays of such a file must have.

FORMAT.md says in its section "Sparse tables" which vertices these are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.record import Record
from fhash_formats.errors import DamagedFileError

__all__ = [
    "CORESET",
    "COUNTS",
    "FRINGE",
    "SPARSE",
    "SPARSE_FEATURE",
    "check_sparse",
    "sparse_shape",
]

SPARSE = "sparse"
"""Key of the header's `model` that says whose needed vertices the tables have."""
SPARSE_FEATURE = "sparse-tables"
"""Feature of files whose tables have needed vertices alone."""
CORESET = "coreset"
"""Value of the key: the vertices that the coreset needs."""
FRINGE = "fringe"
"""Value of the key: the vertices that the coreset and its fringe need."""
COUNTS = "counts"
"""Attribute of a table: number of its vertices at each time node."""


def check_sparse(model: Record, required_features: Sequence[str], *, allowed: bool) -> None:
    """Check the key of the header's `model`, where it is there.

    Args:
        model: the object in the header.
        required_features: names of the header.
        allowed: whether the tables of the file are plain numbers of the profile paper.
    """
    if not model.has(SPARSE):
        return
    model.choice(SPARSE, (CORESET, FRINGE))
    model.need(allowed, SPARSE, "tables of plain numbers in the profile paper")
    model.need(
        SPARSE_FEATURE in required_features,
        SPARSE,
        f"the feature {SPARSE_FEATURE} in required_features",
    )


def sparse_shape(
    name: str, level: Sequence[int], embedding_size: int, arrays: Mapping[str, ArrayMetadata]
) -> tuple[int, ...]:
    """Return the shape that the array of a sparse table must have, by its counts.

    Args:
        name: of the array.
        level: vertices (t, z, y, x) of the level.
        embedding_size: numbers at each vertex.
        arrays: all arrays of the file.

    Raises DamagedFileError where the counts do not fit the level.
    """
    if name not in arrays:
        raise DamagedFileError(f"array {name} is missing")
    attributes = Record(arrays[name].attributes, f"array {name} attribute ")
    counts = attributes.integers(COUNTS, level[0], 0, prod(level[1:]))
    return sum(counts), embedding_size
