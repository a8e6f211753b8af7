"""`ContainerWriter`: arrays streamed to a `.fhz` file, which ends up complete or absent."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.container import strict_json
from fhash_formats.container.apart import TABLE
from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.chunks import Coded, coded_chunk, cut, expect_end, shard_parts
from fhash_formats.container.coding import Codec, plain_codecs
from fhash_formats.container.header import FORMAT, FORMAT_VERSION
from fhash_formats.container.hierarchy import GROUP
from fhash_formats.container.layout import Member, document_member, ending, local_header
from fhash_formats.container.named import FEATURE as NAMED
from fhash_formats.container.named import Names, shows_values
from fhash_formats.container.reader import Container
from fhash_formats.container.sharding import sharding_codecs
from fhash_formats.container.source import FileSource, PreviewSource
from fhash_formats.container.variables import CONSOLIDATED, consolidated, is_several
from fhash_formats.container.zip_checked import DOCUMENT, MAX_MEMBER, MAX_NAME, NAME
from fhash_formats.errors import DamagedFileError, InputError, OutputError
from fhash_formats.support.atomic import replacing
from fhash_formats.support.plain_json import plain_json
from fhash_formats.support.slabs import slab_shape

USUAL_CHUNK_BYTES = 2 << 20
"""Bytes of a decoded chunk that `add_whole` aims at."""


class _Abandoned(Exception):
    """A block left without `commit`: no error, but it tells `replacing` to keep nothing."""


class Mark(NamedTuple):
    """A state of a `ContainerWriter`: its position, and the number of members and the arrays."""

    position: int
    members: int
    arrays: frozenset[str]


PREVIEW_CACHE_BYTES = 128 << 20
"""Bytes of decoded chunks that a preview keeps: it is read once, beside what was coded."""


class ContainerWriter:
    """A container for writing; a context manager.

    The file takes its name in `commit`; without `commit` nothing is left behind. Members are
    written once, in this order: for each array its metadata and its chunks, then the groups, then
    the root. Identical calls give identical bytes. Entering raises OutputExistsError or
    OutputError.

    Attributes:
        path: name that the file takes.
        attributes: of the root beside the header, JSON values; they may be set until `commit`.
        one_of_several: whether the arrays are those of one variable among several in the file.
        names: of the table and the coordinates in the source, where they are to be paths in the
            hierarchy; they may be set until the first of these arrays is written.
    """

    one_of_several = False

    def __init__(self, path: str | Path, *, force: bool = False) -> None:
        """Prepare a writer; `force` allows it to replace an existing file."""
        self.path = Path(path)
        self._force = force
        self._stack = ExitStack()
        self._members: list[Member] = []
        self._arrays: dict[str, dict[str, Any]] = {}
        self._position = 0
        self.attributes: Mapping[str, Any] = {}
        self.names: Names | None = None

    def __enter__(self) -> ContainerWriter:
        with ExitStack() as stack:
            self._temporary = stack.enter_context(replacing(self.path, force=self._force))
            self._file = stack.enter_context(self._temporary.open("wb"))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # After `commit` the stack is empty and this does nothing.
        failure = error if error is not None else _Abandoned()
        self._stack.__exit__(type(failure), failure, trace)

    def add_array(
        self,
        name: str,
        *,
        shape: Sequence[int],
        dtype: npt.DTypeLike,
        chunk_shape: Sequence[int],
        chunks: Iterable[Coded],
        dimension_names: Sequence[str | None] | None = None,
        attributes: Mapping[str, Any] | None = None,
        codecs: Sequence[Codec] | None = None,
    ) -> None:
        """Write an array chunk by chunk; never more than one chunk is held.

        Args:
            name: path in the hierarchy, unless `names` has another one for it.
            shape: length of each axis.
            dtype: number type of the array and of each chunk.
            chunk_shape: shape of a full chunk.
            chunks: the chunks in C order of their grid; those at an end of the array reach as far
                as the array does. A chunk may also be the bytes that the coder of its first codec
                made of the full chunk, without CRC-32C.
            dimension_names: names of the axes.
            attributes: JSON values.
            codecs: a list as in Zarr's metadata; by default `bytes`, `zstd`, `crc32c`.

        Raises:
            InputError: for anything that does not fit together.
        """
        number_type = np.dtype(dtype).newbyteorder("=")
        coding = plain_codecs(number_type) if codecs is None else codecs
        metadata = self._begin(
            name, shape, number_type, chunk_shape, coding, dimension_names, attributes
        )
        remaining = iter(chunks)
        for index in product(*(range(n) for n in metadata.grid)):
            chunk = next(remaining, None)
            if chunk is None:
                raise InputError(
                    f"array {name}: chunk {index} was not given; the grid has {metadata.grid}"
                )
            coded = coded_chunk(name, metadata, index, chunk)
            self._add(name, metadata.chunk_key(index), [coded])
        expect_end(name, metadata, remaining)

    def add_sharded(
        self,
        name: str,
        *,
        shape: Sequence[int],
        dtype: npt.DTypeLike,
        chunk_shape: Sequence[int],
        shard_shape: Sequence[int],
        chunks: Iterable[Coded | tuple[tuple[int, ...], Coded]],
        dimension_names: Sequence[str | None] | None = None,
        attributes: Mapping[str, Any] | None = None,
        codecs: Sequence[Codec] | None = None,
    ) -> None:
        """Write an array of shards; the coded bytes of one shard are held at a time.

        Args:
            name: path in the hierarchy.
            shape: length of each axis.
            dtype: number type of the array.
            chunk_shape: shape of a full chunk within a shard.
            shard_shape: shape of a shard, a multiple of `chunk_shape`.
            chunks: the chunks in the order of `shard_order`. Each may instead come as (index,
                chunk) with its index in the grid of chunks: then shards come in C order, and the
                chunks of a shard in any order. A chunk is an array as in `add_array`, or the bytes
                that the coder of its first codec made of the full chunk, without CRC-32C.
            dimension_names: names of the axes.
            attributes: JSON values.
            codecs: of the chunks, as in `add_array`.

        Raises:
            InputError: for anything that does not fit together.
        """
        number_type = np.dtype(dtype).newbyteorder("=")
        coding = sharding_codecs(
            [int(n) for n in chunk_shape], plain_codecs(number_type) if codecs is None else codecs
        )
        metadata = self._begin(
            name, shape, number_type, shard_shape, coding, dimension_names, attributes
        )
        assert metadata.sharding is not None
        remaining = iter(chunks)
        for shard in product(*(range(n) for n in metadata.grid)):
            parts = shard_parts(name, metadata, metadata.sharding, shard, remaining)
            self._add(name, metadata.chunk_key(shard), parts)
        expect_end(name, metadata, remaining)

    def add_whole(
        self,
        name: str,
        array: npt.NDArray[Any],
        *,
        chunk_shape: Sequence[int] | None = None,
        dimension_names: Sequence[str | None] | None = None,
        attributes: Mapping[str, Any] | None = None,
        codecs: Sequence[Codec] | None = None,
    ) -> None:
        """Write an array that is in memory.

        By default an array of up to USUAL_CHUNK_BYTES is one chunk, and a larger one is cut into
        slabs along its leading axes. Arguments and errors are those of `add_array`.
        """
        if chunk_shape is None:
            chunk_shape = slab_shape(array.shape, array.dtype.itemsize, USUAL_CHUNK_BYTES)
        self.add_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunk_shape=chunk_shape,
            chunks=cut(array, chunk_shape),
            dimension_names=dimension_names,
            attributes=attributes,
            codecs=codecs,
        )

    def _begin(
        self,
        name: str,
        shape: Sequence[int],
        dtype: np.dtype[Any],
        chunk_shape: Sequence[int],
        codecs: Sequence[Codec],
        dimension_names: Sequence[str | None] | None,
        attributes: Mapping[str, Any] | None,
    ) -> ArrayMetadata:
        """Write the metadata of an array."""
        if name == TABLE and self.names is not None:
            if not shows_values(dtype, codecs):
                self.names = self.names.hidden()
            dimension_names, attributes = self.names.axes(shape), self.names.attributes
        elif name.startswith("coords/") and self.names is not None:
            dimension_names = [self.names.path(name)]
        elif name == "key_frames" and self.names is not None:
            dimension_names = [name]
        try:
            metadata = ArrayMetadata(
                shape=tuple(int(n) for n in shape),
                dtype=dtype,
                chunk_shape=tuple(int(n) for n in chunk_shape),
                codecs=tuple(codecs),
                dimension_names=None if dimension_names is None else tuple(dimension_names),
                attributes=dict(attributes or {}),
            )
            # The reader's checks are the writer's, so that a reader accepts what is written.
            document = strict_json.dumps(metadata.to_dict(), f"the metadata of array {name}")
            ArrayMetadata.from_dict(strict_json.loads(document))
        except DamagedFileError as error:
            raise InputError(f"array {name} cannot be stored: {error}") from error
        path = self._path(name)
        self._check_name(path)
        self._arrays[path] = metadata.to_dict()
        member, data = document_member(f"{path}/{DOCUMENT}", self._position, document)
        self._write(member, [data])
        return metadata

    def preview(self, header: Mapping[str, Any]) -> Container:
        """The container written so far, as if it were committed with this header.

        The caller reads and closes it. `quality` and `history` may be left out of the header,
        because a preview is there to measure them.
        """
        return self._open(self._tail({"quality": {}, "history": [], **header}))

    def commit(self, header: Mapping[str, Any]) -> int:
        """Write the groups, the root with its header and the directory; give the file its name.

        `format`, `format_version` and, unless given, `required_features` are added to the header.
        Figures that JSON cannot hold become null.

        Returns:
            Number of bytes of the file.

        Raises:
            InputError: for a header that does not fit the arrays.
            OutputError: for a full disk.
        """
        tail = self._tail(header)
        # A file that fhash's reader would refuse is not written.
        self._open(tail).close()
        self._file.write(tail)
        self._position += len(tail)
        self._stack.close()
        return self._position

    def size(self, header: Mapping[str, Any]) -> int:
        """Number of bytes of the file if it were committed with this header."""
        return self._position + len(self._tail(header))

    def mark(self) -> Mark:
        """The arrays written so far, for `rewind`."""
        return Mark(self._position, len(self._members), frozenset(self._arrays))

    def rewind(self, mark: Mark) -> None:
        """Drop the arrays that were written after a mark, so that others take their place."""
        self._file.seek(mark.position)
        self._file.truncate()
        del self._members[mark.members :]
        self._arrays = {name: self._arrays[name] for name in self._arrays if name in mark.arrays}
        self._position = mark.position

    def divert(self, path: Path) -> None:
        """Let the container take another name in the same folder, which must be free.

        What the former name belongs to is left alone. Raises OutputExistsError or OutputError.
        """
        with ExitStack() as stack:
            temporary = stack.enter_context(replacing(path, force=False))
            self._file.close()
            os.replace(self._temporary, temporary)
            file = stack.enter_context(temporary.open("ab"))
            former, self._stack = self._stack, stack.pop_all()
        self.path, self._temporary, self._file = path, temporary, file
        abandoned = _Abandoned()
        former.__exit__(type(abandoned), abandoned, None)

    def _open(self, tail: bytes) -> Container:
        self._file.flush()
        try:
            source = PreviewSource(FileSource(self._temporary), self._position, tail)
            return Container(self.path, source, cache_bytes=PREVIEW_CACHE_BYTES)
        except DamagedFileError as error:
            raise InputError(f"the container would not be readable: {error}") from error

    def _tail(self, header: Mapping[str, Any]) -> bytes:
        """The bytes after the arrays: groups, root and directory."""
        if self._file.closed:
            raise OutputError(f"{self.path}: the container is written already")
        groups = {
            "/".join(folders[:depth])
            for folders in (name.split("/")[:-1] for name in self._arrays)
            for depth in range(1, len(folders) + 1)
        }
        documents = {
            f"{group}/{DOCUMENT}": strict_json.dumps(GROUP, "a group") for group in sorted(groups)
        }
        complete = {
            "required_features": [],
            **plain_json(header),
            "format": FORMAT,
            "format_version": list(FORMAT_VERSION),
        }
        if self.names is not None:
            complete["required_features"] = [*complete["required_features"], NAMED]
            complete.update(self.names.header())
        attributes = {**plain_json(self.attributes), "fhash": complete}
        root: dict[str, Any] = {**GROUP, "attributes": attributes}
        if is_several(complete):
            others = {**dict.fromkeys(groups, GROUP), **self._arrays}
            root[CONSOLIDATED] = consolidated(others)
        documents[DOCUMENT] = strict_json.dumps(root, "the header")
        members, tail, position = list(self._members), [], self._position
        for name, data in documents.items():
            member, packed = document_member(name, position, data)
            members.append(member)
            tail += [local_header(member), packed]
            position = member.end
        return b"".join([*tail, ending(members)])

    def _check_name(self, name: str) -> None:
        if (
            not NAME.fullmatch(name)
            or len(name) > MAX_NAME // 2
            or name.rpartition("/")[2] == DOCUMENT
        ):
            raise InputError(
                f"array name {name[:80]!a} is not allowed; "
                f"allowed: paths of A-Z a-z 0-9 . _ - up to {MAX_NAME // 2} letters"
            )
        if name in self._arrays:
            raise InputError(f"array {name} is there already")

    def _path(self, name: str) -> str:
        """The path of an array in the hierarchy."""
        return name if self.names is None else self.names.path(name)

    def _add(self, name: str, key: str, parts: Sequence[bytes]) -> None:
        """Write the member of a chunk of an array, whose data are `parts`, one after the other."""
        size, crc = sum(len(part) for part in parts), 0
        member = f"{self._path(name)}/{key}"
        if size > MAX_MEMBER:
            raise InputError(
                f"{member} takes {size} bytes; the limit is {MAX_MEMBER}; "
                "take smaller chunks or shards"
            )
        for part in parts:
            crc = zlib.crc32(part, crc)
        self._write(Member(name=member, offset=self._position, size=size, crc=crc), parts)

    def _write(self, member: Member, parts: Sequence[bytes]) -> None:
        if self._file.closed:
            raise OutputError(f"{self.path}: the container is written already")
        self._file.write(local_header(member))
        for part in parts:
            self._file.write(part)
        self._members.append(member)
        self._position = member.end
