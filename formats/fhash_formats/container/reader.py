"""Container: a file for reading, and the arrays that its header asks for."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from math import prod
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Annotated, Any, BinaryIO, TypedDict

import numpy as np

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.header import (
    LOWEST,
    MAX_LEVEL,
    MLP,
    POSITIONS,
    STEP_BYTES,
    STEP_FIGURES,
    STEPS,
    TABLE,
    TOGETHER,
    described_coordinate,
)
from fhash_formats.container.hierarchy import SHARES, path_of, read_headers, variable_named
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.container.source_entry import AUXILIARY, check_source
from fhash_formats.container.stored import NativeFile, StoredArray
from fhash_formats.container.zip_file import (
    CountedSource,
    FileSource,
    OpenFileSource,
    Source,
    damage_named,
    is_signed,
)
from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.series import Coordinate, meant
from fhash_formats.support.files import is_url, local_path


def check_beside(header: Mapping[str, Any], arrays: Mapping[str, StoredArray]) -> None:
    """Check what libfhash does not look at when it opens a file.

    These are the key frames, and the figures of single steps. Raises DamagedFileError where they
    do not fit the header.
    """
    if KEY_FRAMES in arrays:
        steps, keys = header["domain"]["shape"][0], arrays[KEY_FRAMES].read()
        if keys[0] < 0 or keys[-1] >= steps or np.any(keys[1:] <= keys[:-1]):
            raise DamagedFileError(f"array {KEY_FRAMES} does not increase within 0..{steps - 1}")
    if STEPS not in arrays:
        return
    array = arrays[STEPS]
    attributes = Record(array.attributes, f"array {STEPS} attribute ")
    attributes.integers(LOWEST, len(STEP_FIGURES), -MAX_LEVEL, MAX_LEVEL)
    together = attributes.integer(TOGETHER, 1, MAX_LENGTH) if attributes.has(TOGETHER) else 1
    shape = (STEP_BYTES, len(STEP_FIGURES), -(-header["domain"]["shape"][0] // together))
    if array.shape != shape or array.dtype != np.uint8:
        raise DamagedFileError(
            f"array {STEPS} is {array.dtype} {array.shape}; the header asks for uint8 {shape}"
        )


KEY_FRAMES = "key_frames"
"""Name of the array of the key frames."""
StorageOptions = Mapping[str, Any] | None
"""Options of a URL's file system in fsspec, by name."""


@dataclass(frozen=True, kw_only=True)
class Location:
    """A container's place, from which it can be opened again, also in another process.

    Attributes:
        place: path, or text of a URL.
        storage_options: options of the URL's file system in fsspec, which may be secret.
        digest: `Container.digest` of the file that is meant; None for any.
    """

    place: Path | str
    storage_options: StorageOptions = field(default=None, repr=False)
    digest: str | None = None


Place = str | os.PathLike[str] | BinaryIO | Location
"""A container to open: path, URL, open binary file, or the location of one that was open."""


def located(
    place: Place, storage_options: StorageOptions
) -> tuple[Location | None, Path | str, Source]:
    """The location of a container, its name in messages, and its bytes.

    The location is None for an open file, which cannot be opened again elsewhere. A `file:` URL
    becomes a path. Raises MissingInputError, MissingDependencyError or InputError.
    """
    if isinstance(place, Location):
        return located(place.place, place.storage_options)
    if not isinstance(place, str | os.PathLike):
        _refuse_options(storage_options, "an open file")
        return _opened(place)
    path = local_path(place)
    if path is None:
        from fhash_formats.container.remote import FsspecFile, RemoteSource

        url = str(place)
        location = Location(place=url, storage_options=storage_options)
        with damage_named(url):
            return location, url, RemoteSource(FsspecFile.open(url, storage_options or {}))
    _refuse_options(storage_options, str(path))
    if is_url(str(path).replace(":/", "://", 1)) and not path.exists():
        raise InputError(f"{path}: a URL is given as text, not as a Path, which changes it")
    return Location(place=path), path, FileSource(path)


def _opened(file: Any) -> tuple[None, str, Source]:
    """Name and bytes of an open file; one of fsspec is read by ranges, not by its large blocks."""
    fs, path = getattr(file, "fs", None), getattr(file, "path", None)
    if hasattr(fs, "cat_file") and isinstance(path, str):
        from fhash_formats.container.remote import FsspecFile, RemoteSource

        if getattr(file, "compression", None) is not None:
            raise InputError(f"{path}: a compressed file; decompress it, ranges of it are needed")
        full_name = str(getattr(file, "full_name", path))
        with damage_named(full_name):
            return None, full_name, RemoteSource(FsspecFile(fs, path, full_name))
    if not (hasattr(file, "read") and hasattr(file, "seek")):
        raise InputError(
            f"{type(file).__name__} is no place of a container; "
            "give a path, a URL, or a file opened with 'rb'"
        )
    name = getattr(file, "name", None)
    shown = name if isinstance(name, str) else f"<{type(file).__name__}>"
    return None, shown, OpenFileSource(file)


def _refuse_options(storage_options: StorageOptions, place: str) -> None:
    if storage_options:
        raise InputError(f"{place}: storage_options are for URLs, such as s3://bucket/run.fhz")


CACHE_BYTES = 256 << 20
"""Bytes of decoded chunks that an open container keeps."""
SPLIT = {
    "field": ("table_", "corrections", "occupancy", "missing"),
    "beside": ("auxiliary/",),
    "model": ("mlp/",),
}
"""Beginnings of the names of arrays, by what `Container.split` calls their bytes."""


class Split(TypedDict):
    """Bytes of a file by what they hold; they add up to its size."""

    field: Annotated[int, "tables, corrections, and which vertices have values"]
    beside: Annotated[int, "arrays that the source has beside the values"]
    model: Annotated[int, "layers in arrays, and documents of tables of tiles: bases and steps"]
    index: Annotated[int, "header, directory, names, and all else"]


def split_bytes(total: int, arrays: Iterable[tuple[str, StoredArray]]) -> dict[str, int]:
    """Bytes by what they hold, as `Container.split` has them, of so many in all."""
    found = dict.fromkeys(SPLIT, 0)
    for name, array in arrays:
        for part, beginnings in SPLIT.items():
            if name.startswith(beginnings):
                found[part] += array.nbytes_stored
                coded = part == "field" and array.settings is not None
                found["model"] += array.document_bytes if coded else 0
    return found | {"index": total - sum(found.values())}


def is_container(path: str | Path) -> bool:
    """Whether a file ends in a container's signature.

    False for a file that cannot be read, and for one that was cut short.
    """
    try:
        source = FileSource(Path(path))
    except FhashError:
        return False
    try:
        return is_signed(source)
    except (FhashError, OSError):
        return False
    finally:
        source.close()


class Container:
    """A container for reading; a context manager, safe for several threads.

    Attributes:
        path: as given; text of a URL; name of an open file.
        location: from which it can be opened again; None for an open file.
        size: bytes of the file.
        digest: SHA-256 of the file's directory, hexadecimal. The directory holds a checksum of
            everything, so that files of different content have different digests.
        header: of the only variable (FORMAT.md), with the root's keys; of several, attribute
            "fhash" of the root.
        attributes: of the root beside the header: those of a whole dataset.
        header_bytes: bytes of the document that holds the header, as it lies in the file.
        arrays: StoredArray by name, in the order of the file; by "/" and the path those outside of
            the variable's group. Of several variables, by path.
        variables: of a file of several, by name in the order of its list; each is a container as
            if it were alone in the file. None in a file of one variable.
        variable: name of the variable where the container is one of those; else None.
    """

    path: Path | str
    location: Location | None = None
    size: int
    digest: str
    header: dict[str, Any]
    attributes: Mapping[str, Any]
    header_bytes: int
    arrays: Mapping[str, StoredArray]
    variables: Mapping[str, VariableContainer] = MappingProxyType({})
    variable: str | None = None
    _documents: int

    def __init__(self, path: Path | str, source: Source, *, cache_bytes: int = CACHE_BYTES) -> None:
        """Read a container from an open source, which `close` closes; `open` is for files.

        Raises DamagedFileError, or UnsupportedFileError for a newer format.
        """
        self.path, self.size, self.location = path, source.size, None
        self.cache_bytes = cache_bytes
        self._source = source = CountedSource(source)
        try:
            with damage_named(path, source):
                self._file = NativeFile(source, cache_bytes)
                self._read_nodes()
        except BaseException:
            source.close()
            raise

    def _read_nodes(self) -> None:
        """Take the header and the arrays of the file."""
        file, self.digest = self._file, self._file.digest
        nodes = file.nodes()
        self._documents = len(nodes)
        root = next(node for node in nodes if not node.path)
        self.header_bytes = root.document_bytes
        attributes = json.loads(root.text)["attributes"]
        of_file = attributes.pop("fhash")
        headers = read_headers(of_file)
        self.attributes = MappingProxyType(attributes)
        mlps = {path_of(header, TABLE): header.get(MLP) for header in headers.values()}
        stored = {
            node.number: StoredArray(
                self.path,
                file,
                node,
                ArrayMetadata.from_dict(json.loads(node.text), mlps.get(node.path)),
                self._source,
            )
            for node in nodes
            if node.number
        }
        order = {number: place for place, number in enumerate(stored)}
        variables = []
        for number, (name, header) in enumerate(headers.items()):
            places = sorted(file.places(number).items(), key=lambda place: order[place[1]])
            arrays = {name: stored[each] for name, each in places}
            with variable_named(name, len(headers)):
                check_beside(header, arrays)
                check_source(header, arrays)
            variables.append((name, header, arrays))
        if len(variables) == 1:
            self._name, self.header, own = variables[0]
            names = {array.number: name for name, array in own.items()}
            self.arrays = MappingProxyType(
                {names.get(n, f"/{array.name}"): array for n, array in stored.items()}
            )
            return
        self.arrays = MappingProxyType({array.name: array for array in stored.values()})
        self.header = of_file
        self.variables = MappingProxyType(
            {
                name: VariableContainer(self, number, header, arrays)
                for number, (name, header, arrays) in enumerate(variables)
            }
        )

    @classmethod
    def open(
        cls,
        place: Place,
        *,
        cache_bytes: int = CACHE_BYTES,
        storage_options: StorageOptions = None,
    ) -> Container:
        """Open a path, a URL, a binary file that is open, or a `Location`.

        Args:
            place: an open file is neither closed here nor may it change.
            cache_bytes: most bytes of decoded chunks that are kept.
            storage_options: options of a URL's file system in fsspec.

        Raises:
            MissingInputError: for no such file.
            MissingDependencyError: for a URL whose package is not installed.
            InputError: for a folder, a file without permission, a server that does not answer, or
                a location whose file is another one now.
            DamagedFileError: for a file that is no container, or a damaged one.
            UnsupportedFileError: for a newer format.
        """
        location, name, source = located(place, storage_options)
        container = cls(name, source, cache_bytes=cache_bytes)
        container.location = location
        if isinstance(place, Location) and place.digest not in (None, container.digest):
            container.close()
            raise InputError(f"{name}: another file is there than was opened before; open it again")
        return container

    def reopening(self) -> Location:
        """The location, digest included, to open this file again, in another process as well.

        Raises InputError for an open file.
        """
        if self.location is None:
            raise InputError(
                f"{self.path}: a volume of an open file cannot be opened again elsewhere;"
                " open it by its path or URL"
            )
        place = self.location.place
        return replace(
            self.location,
            place=place.absolute() if isinstance(place, Path) else place,
            digest=self.digest,
        )

    @property
    def bytes_read(self) -> int:
        """Bytes of the file that were read so far, opening included."""
        return self._source.bytes_read

    def coordinate(self, stored: str) -> Coordinate:
        """The coordinate of the axis `stored`: "time", "z", "y" or "x"."""
        axis = POSITIONS.index(stored)
        described = self.header["coordinates"].get(stored, {})
        return described_coordinate(described, stored, self.header["domain"]["shape"][axis])

    def verify(self, progress: Callable[[int, int], None] | None = None) -> int:
        """Read and decode every chunk; the number of arrays. Metadata were read at opening.

        `progress(done, total)` counts metadata documents, as read already, and chunks. Raises
        DamagedFileError that names the member.
        """
        total = self._documents + sum(prod(array.grid) for array in self.arrays.values())
        done = self._documents

        def count() -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, total)

        with damage_named(self.path, self._source):
            for array in self.arrays.values():
                array.verify(count)
        return len(self.arrays)

    def overhead(self) -> int:
        """Bytes of the file that are no data of chunks: metadata, names, directory."""
        return self.size - sum(array.nbytes_stored for array in self.arrays.values())

    def split(self) -> dict[str, int]:
        """Bytes of the file by what they hold, see `Split`."""
        arrays = {
            array.number: (name, array)
            for each in self.variables.values() or [self]
            for name, array in each.arrays.items()
        }
        return split_bytes(self.size, arrays.values())

    @property
    def names(self) -> list[str]:
        """Names of the variables, in the order of the file."""
        return list(self.variables) or [self._name]

    def select(self, variable: str | None) -> Container:
        """The container of one variable, whose `close` closes the file.

        variable: its name; None for the only one of the file. Raises InputError where the file
        does not hold it, or holds several and none is named.
        """
        names = self.names
        listed = ", ".join(names)[:400]
        if variable is None and len(names) > 1:
            raise InputError(
                f"{self.path} holds several variables, {listed}; choose one, such as"
                f" --var {names[0]} (in Python: variable={names[0]!r})"
            )
        found = names if variable is None else meant(variable, names)
        if variable is not None and len(found) != 1:
            several = f"{len(found)} variables named" if found else "no variable"
            raise InputError(f"{self.path} has {several} {variable[:80]!r}; it holds {listed}")
        return self.variables[found[0]].closing_file() if self.variables else self

    def close(self) -> None:
        """Release the file and the cache."""
        self._file.close()
        self._source.close()

    def __enter__(self) -> Container:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class VariableContainer(Container):
    """One variable of a container of several: what a container of this variable alone would be.

    It reads from the file of the others, and shares their cache.

    Attributes:
        size: bytes of the arrays of this variable alone, with their places in the ZIP.
        digest: of the file and the variable.
        arrays: StoredArray by the name that it has in a file of one variable.
    """

    def __init__(
        self,
        file: Container,
        number: int,
        header: dict[str, Any],
        arrays: Mapping[str, StoredArray],
    ) -> None:
        """Take a variable of an open file.

        Args:
            file: that holds it.
            number: of the variable, from 0.
            header: of the variable.
            arrays: of the variable, by name.
        """
        self.path, self.header = file.path, header
        self.variable = header.get("name", header["variable"]["name"])
        self.header_bytes, self.attributes = file.header_bytes, file.attributes
        self.cache_bytes = file.cache_bytes
        self.arrays = MappingProxyType(dict(arrays))
        self.digest = sha256(f"{file.digest}/{self.variable}".encode()).hexdigest()
        self._container, self._source, self._file = file, file._source, file._file
        self._closes_file = False
        shared = [name for name in header.get(SHARES, ()) if not name.startswith(AUXILIARY)]
        begin = path_of(header, "")
        self._own = [
            name for name, array in arrays.items() if name in shared or array.name.startswith(begin)
        ]
        self.size = sum(arrays[name].place_bytes for name in self._own)
        self._documents = len(self._own)

    def closing_file(self) -> VariableContainer:
        """Itself, from now on with a `close` that closes the file, and so all variables."""
        self._closes_file = True
        return self

    def reopening(self) -> Location:
        """The location of the file that holds the variable, with the digest of the whole."""
        return self._container.reopening()

    def overhead(self) -> int:
        """Bytes of the variable's arrays that are no data of chunks."""
        return self.size - sum(self.arrays[name].nbytes_stored for name in self._own)

    def split(self) -> dict[str, int]:
        """Bytes of the variable's arrays by what they hold, as of a file."""
        return split_bytes(self.size, [(name, self.arrays[name]) for name in self._own])

    def close(self) -> None:
        """Release the file after `closing_file`, else nothing: other variables need it."""
        if self._closes_file:
            self._container.close()
