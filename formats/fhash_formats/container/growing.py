"""GrowingContainer: a file that is complete after each layer; a table put together from parts."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import (
    ArrayMetadata,
    Codec,
    tiles_together,
    transform_codecs,
)
from fhash_formats.container.header import TABLE
from fhash_formats.container.writer import ContainerWriter, Mark
from fhash_formats.container.zip_file import Member
from fhash_formats.errors import FhashError, OutputError
from fhash_formats.support.files import (
    PARTIAL,
    check_output,
    clear_leftovers,
    explained,
    new_stem,
    remove,
    replacing,
    signals_held,
    sync_folder,
)
from fhash_formats.transform.tile_format import TileSettings


@dataclass(frozen=True, kw_only=True)
class TableParts:
    """The tiles of a table, coded.

    Attributes:
        shape: lengths of the axes (t, z, y, x).
        dtype: type of the values.
        tile: shape of a tile.
        settings: settings that all tiles share.
        streams: stream of each tile, in C order of their grid, masks included.
        sizes: bytes of each stream, where they are known without reading it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    tile: tuple[int, ...]
    settings: TileSettings
    streams: Sequence[bytes]
    sizes: npt.NDArray[np.int64] | None = None

    def write(
        self,
        writer: ContainerWriter,
        name: str = TABLE,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Write the table."""
        grid = [-(-n // length) for n, length in zip(self.shape, self.tile, strict=True)]
        sizes = self.sizes
        if sizes is None:
            sizes = np.fromiter(map(len, self.streams), np.int64, len(self.streams))
        writer.add_array(
            name,
            shape=self.shape,
            dtype=self.dtype,
            chunk_shape=self.tile,
            together=tiles_together(grid, sizes),
            chunks=iter(self.streams),
            attributes=attributes,
            codecs=transform_codecs(self.settings),
        )


PIECE = 8 << 20
"""Bytes that are copied from one file into the other at a time."""


@dataclass(frozen=True, kw_only=True)
class GrowingArray:
    """An array (t, z, y, x) of tiles that grows along its first axis by layers of tiles.

    Attributes:
        name: path in the hierarchy.
        frame: lengths (z, y, x) of the other axes.
        dtype: number type of the array.
        tile: shape (t, z, y, x) of a tile.
        codecs: of the tiles.
    """

    name: str
    frame: tuple[int, ...]
    dtype: np.dtype[Any]
    tile: tuple[int, ...]
    codecs: Sequence[Codec]

    @property
    def layer_grid(self) -> tuple[int, ...]:
        """Tiles of a layer along (z, y, x)."""
        return tuple(-(-n // length) for n, length in zip(self.frame, self.tile[1:], strict=True))


class GrowingContainer(ContainerWriter):
    """A container that is complete after each `publish`; a context manager.

    Members are added as to a `ContainerWriter`. `publish` writes what follows them and gives the
    file its name; leaving the block leaves the last published state. Entering raises
    OutputExistsError or OutputError.
    """

    def __init__(
        self, path: str | Path, *, force: bool = False, continues: os.stat_result | None = None
    ) -> None:
        """Prepare a container; `force` allows it to replace an existing file when it publishes.

        continues: state of the file that this one goes on from and replaces; no other one is.
        """
        super().__init__(path, force=force or continues is not None)
        self._continues = continues
        self._target = Path(os.path.realpath(self.path))
        self._awake = self._opening = False
        # The file that has the name, and how many bytes from its beginning are lasting members.
        self._ours: tuple[int, int] | None = None
        self._lasting = 0
        # The file that had the name before, and how many of its bytes are those of the other.
        self._spare: Path | None = None
        self._common = 0

    def __enter__(self) -> GrowingContainer:
        clear_leftovers([self._target])
        check_output(self.path, self._force)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the hidden file; what was published stays."""
        with signals_held():
            if self._awake or self._opening:
                with suppress(OSError, AttributeError):  # a full disk must not hide the first error
                    self._file.close()
                remove(self._temporary)
            if self._spare is not None:
                remove(self._spare)
            self._awake = self._opening = False
            self._spare = None

    def add_layer(self, array: GrowingArray, number: int, streams: Sequence[bytes]) -> None:
        """Write a layer of an array.

        number: of the layer, from 0. streams: the bytes that the coder made of the tiles, in C
        order. Raises InputError for a layer that takes too many bytes.
        """
        assert len(streams) == prod(array.layer_grid)
        metadata = self._layers(array, (number + 1) * array.tile[0])
        self._add_member(array.name, metadata, (number, 0, 0, 0), streams)

    def describe(self, array: GrowingArray, steps: int) -> None:
        """Take the metadata of an array of so many steps, whose layers were added before."""
        self._describe(array.name, self._layers(array, steps))

    def _layers(self, array: GrowingArray, steps: int) -> ArrayMetadata:
        """The metadata of an array of so many steps, a layer of tiles in each member."""
        metadata = ArrayMetadata(
            shape=(steps, *array.frame),
            dtype=array.dtype,
            chunk_shape=array.tile,
            codecs=array.codecs,
            together=(1, *array.layer_grid),
        )
        self._check(array.name, metadata)
        return metadata

    def publish(self, header: Mapping[str, Any], mark: Mark) -> int:
        """Write the documents and the directory, and let the file take its name.

        mark: the arrays behind it are of this state alone; the next state has others in their
        place.

        Returns the number of bytes of the file. Raises InputError for a header that does not fit
        the arrays, and OutputError for a full disk or if another process took the name; the state
        that was published last then stays.
        """
        tail = self._tail(header)
        size = self._position + len(tail)
        try:
            # A file that fhash's reader would refuse is not written.
            self._open(tail).close()
            self._file.write(tail)
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            if self._ours is None:
                self._take_name()
            else:
                self._swap()
        except OSError as error:
            raise self._explained(error) from error
        self._common, self._lasting = self._lasting, mark.position
        self._ours, self._awake = self._identity(), False
        self.rewind(mark)
        return size

    def rewind(self, mark: Mark) -> None:
        """Drop the members that were written after a mark, so that others take their place."""
        if self._awake:
            super().rewind(mark)
            return
        del self._members[mark.members :]
        self._arrays = {name: self._arrays[name] for name in self._arrays if name in mark.arrays}
        self._position = mark.position

    def _write(self, member: Member, parts: Sequence[bytes]) -> None:
        self._wake()
        try:
            super()._write(member, parts)
        except OSError as error:
            raise self._explained(error) from error

    def _tail(self, header: Mapping[str, Any] | None = None) -> bytes:
        self._wake()
        return super()._tail(header)

    def _wake(self) -> None:
        """Open the hidden file, with all lasting members in it."""
        if self._awake:
            return
        fresh = self._target.with_name(new_stem(self._target.name) + PARTIAL)
        hidden = self._spare or fresh
        common = 0 if self._spare is None else self._common
        # A signal may come between any two lines: `close` removes the file from here on.
        self._temporary, self._opening = hidden, True
        try:
            self._file = hidden.open("xb" if self._spare is None else "r+b")  # type: ignore[assignment]
            file = self._file
            try:
                file.truncate(common)
                file.seek(common)
                if self._ours is not None:
                    self._copy(file, common)
            except BaseException:
                file.close()
                if self._spare is None:
                    remove(hidden)
                raise
        except OSError as error:
            raise self._explained(error) from error
        self._spare, self._awake, self._opening = None, True, False

    def _copy(self, file: Any, start: int) -> None:
        """Copy lasting members from the file that has the name, from a position on."""
        if self._identity() != self._ours:
            raise self._taken()
        with self._target.open("rb") as source:
            source.seek(start)
            left = self._lasting - start
            while left > 0:
                piece = source.read(min(PIECE, left))
                if not piece:
                    raise self._taken()
                file.write(piece)
                left -= len(piece)

    def _take_name(self) -> None:
        """Give the first state the name of the container."""
        before = self._continues
        if before is not None and self._identity() != (before.st_dev, before.st_ino):
            raise self._taken()
        with replacing(self.path, force=self._force) as temporary:
            os.replace(self._temporary, temporary)

    def _swap(self) -> None:
        """Let the hidden file take the name, and hide the one that had it."""
        with suppress(OSError):  # file systems such as exFAT have no permissions
            shutil.copymode(self._target, self._temporary)
        spare = self._target.with_name(new_stem(self._target.name) + PARTIAL)
        with signals_held():
            if self._identity() != self._ours:
                raise self._taken()
            try:
                os.link(self._target, spare)
            except OSError:  # without hard links the next layer copies the whole file
                spare = None  # type: ignore[assignment]
            try:
                os.replace(self._temporary, self._target)
            except BaseException:
                if spare is not None:
                    remove(spare)
                raise
            self._spare = spare
        sync_folder(self._target.parent)

    def _identity(self) -> tuple[int, int] | None:
        """Device and number of the file that has the name; None where there is none."""
        try:
            state = os.stat(self._target)
        except FileNotFoundError:
            return None
        return state.st_dev, state.st_ino

    def _taken(self) -> OutputError:
        return OutputError(
            f"{self.path}: another process moved, replaced or changed the file while it grew; "
            "nothing more is written to it: append to one file from one process"
        )

    def _explained(self, error: OSError) -> OSError:
        """The error that says in one line why the file could not grow."""
        if isinstance(error, FhashError):
            return error
        explanation = explained(self.path, error)
        if self._ours is None:
            return explanation
        return OutputError(f"{explanation}; the layers before are in the file")
