"""A series as a peer codes it, whether as a filter of HDF5 or as a program."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TypeAlias

from fhash_codec.bench.rate.filters import read_region, touched_bytes
from fhash_codec.bench.rate.layouts import Values
from fhash_codec.bench.rate.peers import Variant, opened_file, read_all, stored, stored_bytes
from fhash_codec.bench.rate.programs.program import Coded, ProgramVariant, folder_of
from fhash_codec.boxes import Box

__all__ = ["AnyVariant", "PeerFiles", "there_and_back"]

AnyVariant: TypeAlias = Variant | ProgramVariant
"""A mode and layout of a peer."""


def there_and_back(
    values: Values, variant: AnyVariant, data_range: float, level: float, folder: Path
) -> tuple[Values, int]:
    """Values (t, z, y, x) as they are decoded, and the bytes they took; raises InputError.

    folder: place of temporary files.
    """
    if isinstance(variant, ProgramVariant):
        with folder_of(folder) as own:
            coded = variant.encode(values, data_range, level, own)
            return variant.decode(coded), coded.bytes
    with stored(values, variant, data_range, level) as file:
        return read_all(file, variant, values.shape), stored_bytes(file)


class PeerFiles:
    """Files of a peer in a folder, written and read again and again to be timed."""

    def __init__(
        self, values: Values, variant: AnyVariant, data_range: float, level: float, folder: Path
    ) -> None:
        """Prepare files of values (t, z, y, x) at a level. folder: removed by the caller."""
        self._values, self._variant = values, variant
        self._range, self._level, self._folder = data_range, level, folder
        self._path = folder / "peer.h5"
        self._coded: Coded | None = None

    def encode(self) -> None:
        """Write the files; raises InputError."""
        if isinstance(self._variant, ProgramVariant):
            self._coded = self._variant.encode(self._values, self._range, self._level, self._folder)
            return
        with stored(self._values, self._variant, self._range, self._level, self._path):
            pass

    def decode(self) -> None:
        """Read every value back; raises InputError."""
        if isinstance(self._variant, ProgramVariant):
            assert self._coded is not None
            self._variant.decode(self._coded)
            return
        with opened_file(self._path) as file:
            read_all(file, self._variant, self._values.shape)

    def read_region(self, step: int, region: Box) -> tuple[int, float]:
        """Bytes that a region of one step takes, and seconds; a program must decode everything."""
        begun = time.perf_counter()
        if isinstance(self._variant, ProgramVariant):
            assert self._coded is not None
            self._variant.decode(self._coded)
            return self._coded.bytes, time.perf_counter() - begun
        shape = self._values.shape
        with opened_file(self._path) as file:
            read_region(file, self._variant, shape, step, region)
        spent = time.perf_counter() - begun
        with opened_file(self._path) as file:
            return touched_bytes(file, self._variant, shape, step, region), spent
