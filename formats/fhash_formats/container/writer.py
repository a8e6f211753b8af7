"""`ContainerWriter`: arrays streamed to a `.fhz` file, which ends up complete or absent."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import product
from math import prod
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import (
    MAX_DIMENSIONS,
    TRANSFORM,
    ArrayMetadata,
    Codec,
    chunk_coder,
    plain_codecs,
    without_mlp,
)
from fhash_formats.container.header import FORMAT, MLP, TABLE, brief
from fhash_formats.container.hierarchy import GROUP, GROUP_KEY, SHARES, VARIABLES
from fhash_formats.container.reader import Container
from fhash_formats.container.record import dumps
from fhash_formats.container.source_entry import AUXILIARY
from fhash_formats.container.zip_file import (
    DOCUMENT,
    FORMAT_VERSION,
    MAX_MEMBER,
    MAX_NAME,
    NAME,
    FileSource,
    Member,
    PreviewSource,
    document_member,
    ending,
    local_header,
)
from fhash_formats.errors import DamagedFileError, InputError, OutputError
from fhash_formats.support.files import replacing
from fhash_formats.support.threads import slab_shape
from fhash_formats.support.values import DTYPES, plain_json
from fhash_formats.transform.stream import TILE_AXES

Coded = npt.NDArray[Any] | bytes
"""A chunk to write: its values, or the bytes that the coder of its first codec made of them."""


def cut(array: npt.NDArray[Any], chunk_shape: Sequence[int]) -> Iterator[npt.NDArray[Any]]:
    """Yield the chunks of an array in memory, in C order; the last along an axis may be shorter."""
    starts = (
        range(0, n, max(1, chunk)) for n, chunk in zip(array.shape, chunk_shape, strict=False)
    )
    for corner in product(*starts):
        yield array[
            tuple(
                slice(start, start + chunk)
                for start, chunk in zip(corner, chunk_shape, strict=False)
            )
        ]


def member_chunks(
    name: str,
    metadata: ArrayMetadata,
    index: tuple[int, ...],
    chunks: Iterator[Coded | tuple[tuple[int, ...], Coded]],
) -> list[bytes]:
    """The chunks of a member, in the order in which they lie in it.

    Args:
        name: the array's, for messages.
        metadata: the array's.
        index: of the member.
        chunks: takes the chunks from here, each alone (then in the order of the file) or with its
            index in the array's grid (then in any order).

    Raises:
        InputError: if a chunk is missing, given twice, or does not fit.
    """
    coded: dict[tuple[int, ...], bytes | None] = dict.fromkeys(metadata.chunks_of(index))
    for place in list(coded):
        item = next(chunks, None)
        if item is None:
            raise InputError(
                f"array {name}: chunk {place} was not given; the grid has {metadata.grid}"
            )
        at, chunk = item if isinstance(item, tuple) else (place, item)
        if coded.get(at, b"") is not None:
            raise InputError(
                f"array {name}: chunk {at} is none of member {index}, or was given twice"
            )
        coded[at] = coded_chunk(name, metadata, at, chunk)
    return [data for data in coded.values() if data is not None]


def coded_chunk(name: str, metadata: ArrayMetadata, index: Sequence[int], chunk: Coded) -> bytes:
    """The bytes of a chunk, from its values or as they are.

    Raises InputError as `full_chunk` does.
    """
    if isinstance(chunk, bytes):
        return chunk
    return metadata.coder.encode(full_chunk(name, metadata, index, chunk))


def full_chunk(
    name: str, metadata: ArrayMetadata, index: Sequence[int], chunk: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """A chunk padded with 0 to the full shape, as Zarr stores those at an end of the array.

    Raises InputError for a chunk of another shape or number type than the array needs at `index`.
    """
    expected = tuple(span.stop - span.start for span in metadata.region(index))
    if chunk.shape != expected or chunk.dtype.newbyteorder("=") != metadata.dtype:
        raise InputError(
            f"array {name}: chunk {tuple(index)} is {chunk.dtype} {chunk.shape}; "
            f"{metadata.dtype} {expected} is needed"
        )
    if expected == metadata.chunk_shape:
        return chunk
    full = np.zeros(metadata.chunk_shape, dtype=metadata.dtype)
    full[tuple(slice(0, n) for n in expected)] = chunk
    return full


USUAL_CHUNK_BYTES = 2 << 20
"""Bytes of a decoded chunk that `add_whole` aims at."""
BESIDE_CHUNK_BYTES = 32 << 20
"""The same for arrays beside the data, which readers take whole."""


def coded_beside(
    array: npt.NDArray[Any], chunk_shape: Sequence[int]
) -> tuple[list[Codec], list[bytes]]:
    """The codecs of an array beside the data, of at most four axes, and its chunks, coded by them.

    They are those of ordinary arrays, or differences of neighbours, whichever takes fewer bytes.
    """
    found = []
    differences: list[Codec] = [{"name": TRANSFORM, "configuration": {}}]
    for codecs in (plain_codecs(array.dtype), differences):
        coder, coded = chunk_coder(codecs, array.dtype, tuple(chunk_shape)), []
        for chunk in cut(array, chunk_shape):
            room = zip(chunk_shape, chunk.shape, strict=True)
            coded.append(coder.encode(np.pad(chunk, [(0, whole - n) for whole, n in room])))
        found.append((codecs, coded))
    return min(found, key=lambda each: sum(map(len, each[1])))


class _Abandoned(Exception):
    """A block left without `commit`: no error, but it tells `replacing` to keep nothing."""


@dataclass(kw_only=True)
class _Variable:
    """The variable that is being written.

    Attributes:
        name: among several; None for the only one.
        number: in the file, from 0.
        begun: bytes of the file with the variables before.
        shares: number of a variable, and the array's name there if it has another, by name of an
            array that lies there.
        mark: of the file before its first array; None for the only variable.
        written: paths of its arrays by name.
        mlp: of its tiles, None or JSON values, by the header's key; empty for none yet.
    """

    name: str | None
    number: int
    begun: int = 0
    shares: dict[str, Any] = field(default_factory=dict)
    mark: Mark | None = None
    written: dict[str, str] = field(default_factory=dict)
    mlp: dict[str, Any] = field(default_factory=dict)


CODED = ("shape", "data_type", "chunk_grid", "codecs", "attributes")
"""Keys of an array's document that say how its numbers are coded."""


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
    written once, in this order: the chunks of each array, then the documents of arrays and groups,
    which one read finds together, then the root. Identical calls give identical bytes. Entering
    raises OutputExistsError or OutputError.

    Arrays have the names of FORMAT.md; the writer finds their paths. Several variables are written
    one after the other, from `begin` to `finish`. Coordinates, arrays beside the data and whole
    tables that several of them have are there once.

    Attributes:
        path: name that the file takes.
        attributes: of the root beside the header, JSON values; they may be set until `commit`.
        one_of_several: whether the file takes several variables.
    """

    def __init__(
        self, path: str | Path, *, force: bool = False, variables: Sequence[str] = ()
    ) -> None:
        """Prepare a writer.

        Args:
            path: name that the file takes.
            force: allow it to replace an existing file.
            variables: names of several variables; none for a file of one.

        Raises InputError for an empty name, and one that is there twice.
        """
        if not all(variables) or len(set(variables)) < len(variables):
            raise InputError(f"variables {', '.join(variables)[:80]!a}: different names are needed")
        self.path = Path(path)
        self._force = force
        self._stack = ExitStack()
        self._members: list[Member] = []
        self._arrays: dict[str, dict[str, Any]] = {}
        self._position = 0
        self.attributes: Mapping[str, Any] = {}
        self.one_of_several = bool(variables)
        self._variable: _Variable | None = None
        self._names = list(variables)
        self._headers: list[dict[str, Any]] = []
        self._auxiliary: dict[tuple[Any, ...], tuple[int, str]] = {}
        self._finished: dict[bytes, tuple[int, dict[tuple[str, str], Member]]] = {}

    def begin(self) -> None:
        """Begin a variable; several have the names that were given for them, in that order."""
        if not self.one_of_several:
            self._variable = _Variable(name=None, number=0)
            return
        number = len(self._headers)
        self._variable = _Variable(
            name=self._names[number],
            number=number,
            begun=self._position + len(self._tail()) if self._headers else 0,
            mark=self.mark(),
        )

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
        chunks: Iterable[Coded | tuple[tuple[int, ...], Coded]],
        together: Sequence[int] | None = None,
        dimension_names: Sequence[str | None] | None = None,
        attributes: Mapping[str, Any] | None = None,
        codecs: Sequence[Codec] | None = None,
    ) -> None:
        """Write an array; never more than the coded bytes of one member are held.

        Args:
            name: of the array (FORMAT.md, Arrays).
            shape: length of each axis.
            dtype: number type of the array and of each chunk.
            chunk_shape: shape of a full chunk.
            chunks: the chunks, member by member in C order, those of a member in C order; those at
                an end of the array reach as far as the array does. A chunk may also be the bytes
                that the coder of its first codec made of the full chunk. Tiles may come as (index,
                chunk) with their index in the grid: then those of a member come in any order.
            together: tiles of a member along each axis; one by default.
            dimension_names: names of the axes, of an array of numbers.
            attributes: JSON values.
            codecs: of the chunks, a list as in Zarr's metadata; by default `bytes`, `zstd`,
                `crc32c`.

        Raises:
            InputError: for anything that does not fit together.
        """
        number_type = np.dtype(dtype).newbyteorder("=")
        coding = plain_codecs(number_type) if codecs is None else codecs
        tiled = coding[0]["name"] == TRANSFORM
        metadata = ArrayMetadata(
            shape=tuple(int(n) for n in shape),
            dtype=number_type,
            chunk_shape=tuple(int(n) for n in chunk_shape),
            codecs=tuple(coding),
            together=tuple(together or (1,) * len(shape)) if tiled else None,
            dimension_names=None if dimension_names is None else tuple(dimension_names),
            attributes=dict(attributes or {}),
        )
        self._check(name, metadata)
        remaining = iter(chunks)
        for index in product(*(range(n) for n in metadata.members)):
            self._add_member(name, metadata, index, member_chunks(name, metadata, index, remaining))
        if next(remaining, None) is not None:
            grid = metadata.grid
            raise InputError(
                f"array {name}: more chunks were given than the {prod(grid)} of the grid {grid}"
            )
        self._describe(name, metadata)

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

        An array beside the data is written only where no other variable has it, and coded as
        differences of neighbours where that takes fewer bytes.
        """
        chunks: Iterable[Coded] | None = None
        if name.startswith(AUXILIARY):
            variable = self._current()
            content = (array.dtype.str, array.shape, sha256(array.tobytes()).digest())
            owner = self._auxiliary.setdefault(content, (variable.number, name))
            if owner[0] != variable.number:
                variable.shares[name] = owner[0] if owner[1] == name else list(owner)
                return
            if codecs is None and chunk_shape is None and array.ndim <= len(TILE_AXES):
                chunk_shape = slab_shape(array.shape, array.dtype.itemsize, BESIDE_CHUNK_BYTES)
                codecs, chunks = coded_beside(array, chunk_shape)
        if chunk_shape is None:
            chunk_shape = slab_shape(array.shape, array.dtype.itemsize, USUAL_CHUNK_BYTES)
        self.add_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunk_shape=chunk_shape,
            chunks=cut(array, chunk_shape) if chunks is None else chunks,
            dimension_names=dimension_names,
            attributes=attributes,
            codecs=codecs,
        )

    def _check(self, name: str, metadata: ArrayMetadata) -> None:
        """Raise InputError for an array that cannot be stored, or is there already."""
        shape, chunk, dtype = metadata.shape, metadata.chunk_shape, metadata.dtype
        fits = len(shape) == len(chunk) and 1 <= len(shape) <= MAX_DIMENSIONS
        if not fits or min(*shape, *chunk) < 1 or dtype.name not in DTYPES:
            raise InputError(
                f"array {name} cannot be stored: {dtype} of shape {list(shape)} in chunks of"
                f" {list(chunk)}"
            )
        path = self._path(name)
        if not NAME.fullmatch(path) or len(path) > MAX_NAME // 2:
            raise InputError(
                f"array name {path[:80]!a} is not allowed; "
                f"allowed: paths of A-Z a-z 0-9 . _ - up to {MAX_NAME // 2} letters"
            )
        if path in self._arrays:
            raise InputError(f"array {path} is there already")

    def _describe(self, name: str, metadata: ArrayMetadata) -> None:
        """Take the metadata of an array, whose document is written with those of all."""
        if name == TABLE and metadata.together is not None:
            codec, self._current().mlp[MLP] = without_mlp(metadata.codecs[0])
            metadata = replace(metadata, codecs=[codec])
        values = metadata.to_dict()
        dumps(values, f"the metadata of array {name}")
        self._arrays[self._path(name)] = values
        self._current().written[name] = self._path(name)

    def _current(self) -> _Variable:
        """The variable that is being written."""
        if self._variable is None:
            if self.one_of_several:
                raise InputError(f"{self.path}: no variable has begun")
            self.begin()
        assert self._variable is not None
        return self._variable

    def preview(self, header: Mapping[str, Any]) -> Container:
        """The variable as written so far, as if the file were committed with this header.

        The caller reads and closes it. `quality` and `history` may be left out of the header,
        because a preview is there to measure them.
        """
        container = self._open(self._tail({"quality": {}, "history": {}, **header}))
        if not container.variables:
            return container
        return list(container.variables.values())[-1].closing_file()

    def finish(self, header: Mapping[str, Any]) -> None:
        """Take the header of a variable, which is then complete.

        If an earlier variable has all of its arrays bit by bit, they are there once.
        """
        variable = self._current()
        if variable.mark is not None:
            self._share(variable, variable.mark)
        self._headers.append(self._entry(header))
        self._variable = None

    def _share(self, variable: _Variable, mark: Mark) -> None:
        """Drop the arrays of a variable if an earlier one has all of them, coded in the same way.

        Sizes and checksums find the earlier one, and the bytes are read back to be compared.
        """
        names = {path: name for name, path in variable.written.items() if path in self._arrays}
        tables = {p: n for p, n in names.items() if not n.startswith(AUXILIARY)}
        contents = {
            (name, member.name.removeprefix(path)): member
            for path, name in tables.items()
            for member in self._members[mark.members :]
            if member.name.startswith(f"{path}/")
        }
        coded = [[name, *map(self._arrays[path].get, CODED)] for path, name in tables.items()]
        coded.append([variable.mlp])
        sizes = [(place, member.size, member.crc) for place, member in contents.items()]
        look = sha256(repr((coded, sizes)).encode()).digest()
        number, others = self._finished.setdefault(look, (variable.number, contents))
        if number == variable.number or len(tables) < len(names):
            return
        self._file.flush()
        with self._temporary.open("rb") as file:

            def data(member: Member) -> bytes:
                file.seek(member.end - member.size)
                return file.read(member.size)

            if any(data(member) != data(others[place]) for place, member in contents.items()):
                return
        self.rewind(mark)
        variable.shares |= dict.fromkeys(tables.values(), number)

    def commit(self, header: Mapping[str, Any] | None = None) -> int:
        """Write the documents, the root with the headers and the directory; name the file.

        `format` and `format_version` are added. Figures that JSON cannot hold become null.

        Args:
            header: of the only variable; None after `finish`.

        Returns:
            Number of bytes of the file.

        Raises:
            InputError: for a header that does not fit the arrays.
            OutputError: for a full disk.
        """
        if self.one_of_several and header is not None:
            raise InputError(f"{self.path} holds several variables; finish each and commit them")
        tail = self._tail(header)
        # A file that fhash's reader would refuse is not written.
        self._open(tail).close()
        self._file.write(tail)
        self._position += len(tail)
        self._stack.close()
        return self._position

    def size(self, header: Mapping[str, Any]) -> int:
        """Number of bytes by which the file grows by the variable, with this header."""
        begun = 0 if self._variable is None else self._variable.begun
        return self._position + len(self._tail(header)) - begun

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

    def _entry(self, header: Mapping[str, Any]) -> dict[str, Any]:
        """The header of the variable as the root has it, and features that it requires."""
        variable = self._current()
        entry: dict[str, Any] = plain_json(header)
        if variable.name not in (None, entry.get("variable", {}).get("name")):
            entry["name"] = variable.name
        if self.one_of_several:
            entry[GROUP_KEY] = f"v{variable.number}"
        entry |= variable.mlp
        if variable.shares:
            entry[SHARES] = variable.shares
        if variable.number:
            entry["coordinates"] = self._once(entry.get("coordinates", {}))
        return entry

    def _once(self, coordinates: Mapping[str, Any]) -> dict[str, Any]:
        """Coordinates, with the number of an earlier variable in place of what it has as well."""
        known = [header.get("coordinates", {}) for header in self._headers]
        return {
            axis: next((n for n, one in enumerate(known) if one.get(axis) == described), described)
            for axis, described in coordinates.items()
        }

    def _root(self, entries: Sequence[Mapping[str, Any]]) -> bytes:
        """The document of the root."""
        features = [name for entry in entries for name in entry.get("required_features", ())]
        of_root = {
            "format": FORMAT,
            "format_version": list(FORMAT_VERSION),
            "required_features": list(dict.fromkeys(features)),
        }
        variables = [
            brief({key: value for key, value in entry.items() if key not in of_root})
            for entry in entries
        ]
        attributes = {**plain_json(self.attributes), "fhash": {**of_root, VARIABLES: variables}}
        return dumps({**GROUP, "attributes": attributes}, "the header")

    def _tail(self, header: Mapping[str, Any] | None = None) -> bytes:
        """The bytes after the chunks: documents, the root last, and directory.

        header: of the variable that is being written; None where all are finished.
        """
        if self._file.closed:
            raise OutputError(f"{self.path}: the container is written already")
        entries = [*self._headers, *([] if header is None else [self._entry(header)])]
        groups = {
            "/".join(folders[:depth])
            for folders in (name.split("/")[:-1] for name in self._arrays)
            for depth in range(1, len(folders) + 1)
        }
        nodes = self._arrays | dict.fromkeys(sorted(groups), GROUP)
        documents = {f"{path}/{DOCUMENT}": dumps(node, path) for path, node in nodes.items()}
        documents[DOCUMENT] = self._root(entries)
        members, tail, position = list(self._members), [], self._position
        for name, data in documents.items():
            member, packed = document_member(name, position, data)
            members.append(member)
            tail += [local_header(member), packed]
            position = member.end
        return b"".join([*tail, ending(members)])

    def _path(self, name: str) -> str:
        """The path of an array in the hierarchy."""
        number = self._current().number
        return f"v{number}/{name}" if self.one_of_several else name

    def _add_member(
        self, name: str, metadata: ArrayMetadata, index: tuple[int, ...], chunks: Sequence[bytes]
    ) -> None:
        """Write a member of an array, and the chunk of the index that says what lies in it."""
        self._add(f"{self._path(name)}/{metadata.member_name(index)}", chunks)
        if metadata.indexed:
            sizes = metadata.index_chunk(index, [len(chunk) for chunk in chunks])
            place = "/".join(str(i) for i in index)
            self._add(f"{self._path(name)}/c/{place}", [sizes])

    def _add(self, member: str, parts: Sequence[bytes]) -> None:
        """Write a member whose data are `parts`, one after the other."""
        size, crc = sum(len(part) for part in parts), 0
        if size > MAX_MEMBER:
            raise InputError(
                f"{member} takes {size} bytes; the limit is {MAX_MEMBER}; take smaller chunks"
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
