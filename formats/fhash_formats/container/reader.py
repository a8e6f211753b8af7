"""Container: a file for reading, and the arrays that its header asks for."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import chain, pairwise
from math import prod
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Annotated, Any, BinaryIO, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import TRANSFORM, ArrayMetadata
from fhash_formats.container.header import (
    BITS_ARRAY,
    CODED,
    COMPACT,
    COUNTS,
    LAYERS,
    LOWEST,
    MASK_ARRAY,
    MASK_FEATURES,
    MAX_LEVEL,
    MISSING_ARRAY,
    PAPER,
    PLAIN_FEATURE,
    PLAIN_TABLE_TYPES,
    POSITIONS,
    SPARSE,
    STEP_BYTES,
    STEP_FIGURES,
    STEPS,
    TOGETHER,
    TRANSFORM_FEATURE,
    described_coordinate,
)
from fhash_formats.container.hierarchy import (
    DIMENSIONS,
    VariablePlaces,
    read_hierarchy,
    variable_named,
)
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.container.source_entry import AUXILIARY, check_source
from fhash_formats.container.stored import ChunkCache, StoredArray
from fhash_formats.container.zip_file import (
    DOCUMENT,
    CountedSource,
    FileSource,
    Member,
    OpenFileSource,
    Source,
    check_member,
    damage_named,
    directory_entry,
    find_signature,
    read_members,
)
from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.series import Coordinate, meant
from fhash_formats.support.files import is_url, local_path
from fhash_formats.transform.head import INPUTS

Expected = tuple[str, tuple[int, ...], tuple[str, ...]]
"""Name, shape and allowed number types of an array."""


def check_arrays(header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Check that the arrays are those that a valid header asks for.

    Raises DamagedFileError that names the first array that is missing or does not fit.
    """
    masked = MASK_ARRAY in arrays
    if masked:
        _check_mask(header, arrays)
    for name, shape, dtypes in _required_arrays(header, arrays):
        if name == BITS_ARRAY and masked:
            continue
        if name not in arrays:
            raise DamagedFileError(f"array {name} is missing")
        _check_array(name, arrays[name], shape, dtypes)
        if name.startswith("tables/"):
            _check_table_attributes(name, arrays[name], header["model"])
    if PLAIN_FEATURE in header["required_features"]:
        _check_layers(arrays, header["model"])
    _check_codecs(header["required_features"], arrays)
    for name, shape, dtypes in _optional_arrays(header):
        if name in arrays:
            _check_array(name, arrays[name], shape, dtypes)
    if STEPS in arrays:
        attributes = Record(arrays[STEPS].attributes, f"array {STEPS} attribute ")
        attributes.integers(LOWEST, len(STEP_FIGURES), -MAX_LEVEL, MAX_LEVEL)
        together = attributes.integer(TOGETHER, 1, MAX_LENGTH) if attributes.has(TOGETHER) else 1
        count = -(-header["domain"]["shape"][0] // together)
        _check_array(STEPS, arrays[STEPS], (STEP_BYTES, len(STEP_FIGURES), count), ("uint8",))
    for axis in POSITIONS:
        name = f"coords/{axis}"
        if name in arrays and "name" in arrays[name].attributes:
            Record(arrays[name].attributes, f"array {name} attribute ").text("name")
    check_source(header, arrays)


def _check_mask(header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Check that a file may have its occupancy as a mask."""
    reasons = (
        (header["model"]["profile"] != PAPER, "of the profile compact, which has no such array"),
        (SPARSE in header["model"], f"of sparse tables, which needs {BITS_ARRAY}"),
        (
            len(header["features"]) > MASK_FEATURES,
            f"of {len(header['features'])} features; more than {MASK_FEATURES} need {BITS_ARRAY}",
        ),
        (BITS_ARRAY in arrays, f"that has {BITS_ARRAY}; only one of both may be there"),
    )
    for is_wrong, why in reasons:
        if is_wrong:
            raise DamagedFileError(f"array {MASK_ARRAY} is there in a file {why}")


def check_key_frames(header: Mapping[str, Any], key_frames: npt.NDArray[np.int64]) -> None:
    """Raise DamagedFileError unless the key frames increase within the steps of the domain."""
    steps = header["domain"]["shape"][0]
    if key_frames[0] < 0 or key_frames[-1] >= steps or np.any(key_frames[1:] <= key_frames[:-1]):
        raise DamagedFileError(f"array key_frames does not increase within 0..{steps - 1}")


def occupancy_bytes(box: Sequence[Sequence[int]]) -> int:
    """Bytes of the occupancy of one key frame, in ragged Morton order over the feature box.

    Each axis of the box is filled up to a power of two, and each vertex has one bit.
    """
    return -(-prod(1 << (high - low - 1).bit_length() for low, high in box) // 8)


def layer_shapes(model: Mapping[str, Any]) -> list[tuple[int, int]]:
    """(outputs, inputs) of each layer of the network or the head, from the header's `model`."""
    if model.get("profile") == COMPACT:
        head = model["head"]
        if head is None:
            return []
        widths = [INPUTS, *head["widths"], 1]
    else:
        widths = [
            len(model["levels"]) * model["embedding_size"],
            *[model["width"]] * model["hidden_layers"],
            1,
        ]
    return [(outputs, inputs) for inputs, outputs in pairwise(widths)]


def _required_arrays(
    header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]
) -> Iterator[Expected]:
    """Yield the arrays that a valid header asks for; levels count from 1, as in FORMAT.md.

    arrays: those of the file, whose attributes say the lengths of sparse tables.
    """
    model = header["model"]
    compact = model["profile"] == COMPACT
    described = header.get("coordinates", {})
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        if axis not in described:
            yield f"coords/{axis}", (length,), ("float64",)
    key_frames = model["levels"][0][0]
    if key_frames < header["domain"]["shape"][0]:
        yield "key_frames", (key_frames,), ("int64",)
    if compact and PLAIN_FEATURE not in header["required_features"]:
        yield "tables/level_1", tuple(model["levels"][0]), (model["tables"],)
        return
    for number, level in enumerate(model["levels"], start=1):
        if model["tables"] == CODED:
            for component in range(1, model["embedding_size"] + 1):
                yield f"tables/level_{number}/component_{component}", tuple(level), ("float32",)
            continue
        name, size = f"tables/level_{number}", model["embedding_size"]
        sparse = SPARSE in model
        shape = _sparse_shape(name, level, size, arrays) if sparse else (*level, size)
        yield name, shape, (model["tables"],)
    shapes = layer_shapes(model)
    if LAYERS in arrays and model["tables"] == CODED:
        yield LAYERS, (sum(outputs * (inputs + 1) for outputs, inputs in shapes),), ("float32",)
        shapes = []
    for number, (outputs, inputs) in enumerate(shapes, start=1):
        yield f"mlp/weight_{number}", (outputs, inputs), ("float32",)
        yield f"mlp/bias_{number}", (outputs,), ("float32",)
    # The profile compact merges its features.
    features = 1 if compact else len(header["features"])
    size = occupancy_bytes(header["feature_bounding_box"])
    yield BITS_ARRAY, (features, key_frames, size), ("uint8",)


def _sparse_shape(
    name: str, level: Sequence[int], embedding_size: int, arrays: Mapping[str, ArrayMetadata]
) -> tuple[int, ...]:
    """The shape that the array of a sparse table must have, by its counts.

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


def _optional_arrays(header: Mapping[str, Any]) -> Iterator[Expected]:
    """Yield the arrays that may be left out, and are checked where they are there."""
    model, steps = header["model"], header["domain"]["shape"][0]
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        yield f"coords/{axis}", (length,), ("float64",)
    yield "key_frames", (model["levels"][0][0],), ("int64",)
    if model["profile"] == COMPACT:
        yield "corrections", tuple(model["levels"][0]), PLAIN_TABLE_TYPES
    else:
        yield MASK_ARRAY, tuple(model["levels"][0]), ("uint8",)
    yield MISSING_ARRAY, (steps, -(-prod(header["domain"]["shape"][1:]) // 8)), ("uint8",)


def _check_array(
    name: str, array: ArrayMetadata, shape: tuple[int, ...], dtypes: tuple[str, ...]
) -> None:
    if array.shape != shape or array.dtype.name not in dtypes:
        raise DamagedFileError(
            f"array {name} is {array.dtype.name} {array.shape}; "
            f"the header asks for {' or '.join(dtypes)} {shape}"
        )


def _check_table_attributes(name: str, table: ArrayMetadata, model: Mapping[str, Any]) -> None:
    """Check the attributes without which the numbers of a table mean nothing."""
    attributes = Record(table.attributes, f"array {name} attribute ")
    if table.dtype == np.uint8 and model["profile"] == PAPER:
        attributes.number("offset")
        attributes.need(attributes.number("scale") >= 0, "scale", "at least 0")
    if model["tables"] == CODED:
        attributes.numbers("mixing", model["embedding_size"])


def _check_layers(arrays: Mapping[str, ArrayMetadata], model: Mapping[str, Any]) -> None:
    """Check the units of the weights and biases of a plain head."""
    for number in range(1, len(layer_shapes(model)) + 1):
        for kind in ("weight", "bias"):
            name = f"mlp/{kind}_{number}"
            unit = Record(arrays[name].attributes, f"array {name} attribute ")
            unit.need(unit.number("scale") > 0, "scale", "above 0")


def _check_codecs(required_features: Sequence[str], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Check that the header requires the feature of the codecs of the arrays."""
    if TRANSFORM_FEATURE in required_features:
        return
    for name, array in arrays.items():
        beside = name.startswith(AUXILIARY) and PLAIN_FEATURE not in required_features
        if array.sharding is not None or (array.coding == TRANSFORM and not beside):
            raise DamagedFileError(
                f"array {name} has codecs of the feature {TRANSFORM_FEATURE}, "
                "which the header does not require"
            )


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
    "field": ("tables", "corrections", "occupancy", "missing"),
    "coordinates": ("coords",),
    "beside": ("auxiliary",),
    "model": ("mlp",),
}
"""First parts of the names of arrays, by what `Container.split` calls their bytes."""


class Split(TypedDict):
    """Bytes of a file by what they hold; they add up to its size."""

    field: Annotated[int, "tables, corrections, and which vertices have values"]
    coordinates: Annotated[int, "arrays of positions along an axis"]
    beside: Annotated[int, "arrays that the source has beside the values"]
    model: Annotated[int, "layers, and documents of coded tables: head, bases and steps"]
    index: Annotated[int, "header, directory, names, and all else"]


def split_bytes(total: int, arrays: Iterable[tuple[str, StoredArray]]) -> dict[str, int]:
    """Bytes by what they hold, as `Container.split` has them, of so many in all."""
    found = dict.fromkeys(SPLIT, 0)
    for name, array in arrays:
        for part, beginnings in SPLIT.items():
            if name.split("/")[0] in beginnings:
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
        return find_signature(source) is not None
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
        arrays: StoredArray by name, in the order of the file; "/" and the path for those that the
            format does not know. Of several variables, by path.
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

    def __init__(self, path: Path | str, source: Source, *, cache_bytes: int = CACHE_BYTES) -> None:
        """Read a container from an open source, which `close` closes; `open` is for files.

        Raises DamagedFileError, or UnsupportedFileError for a newer format.
        """
        self.path, self.size, self.location = path, source.size, None
        self._source = source = CountedSource(source)
        self._cache = ChunkCache(cache_bytes)
        try:
            with damage_named(path, source):
                members = read_members(source)
                signature = find_signature(source)
                assert signature is not None
                self.digest = signature[1].rpartition(b"=")[2].decode("ascii")
                self._documents = sum(
                    member.name.endswith("zarr.json") for member in members.values()
                )
                tree = read_hierarchy(source, members)
                for variable in tree.variables:
                    with variable_named(variable.name, len(tree.variables)):
                        own = {name: tree.arrays[path] for name, path in variable.places.items()}
                        check_arrays(variable.header, own)
            self.header_bytes = members[DOCUMENT].size
            self.attributes = MappingProxyType(dict(tree.attributes))
            stored = {
                name: StoredArray(
                    path,
                    name,
                    metadata,
                    tree.chunks[name],
                    source,
                    self._cache,
                    members[f"{name}/{DOCUMENT}"].size,
                )
                for name, metadata in tree.arrays.items()
            }
            if len(tree.variables) == 1:
                only = tree.variables[0]
                names = {place: name for name, place in only.places.items()}
                self.header, self._name = only.header, only.name
                self.arrays = MappingProxyType(
                    {names.get(place, f"/{place}"): array for place, array in stored.items()}
                )
                _check_key_frames(self)
            else:
                self.header, self.arrays = tree.header, MappingProxyType(stored)
                self.variables = MappingProxyType(
                    {each.name: VariableContainer(self, each, members) for each in tree.variables}
                )
        except BaseException:
            source.close()
            raise

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
        """Positions along the axis `stored`: "time", "z", "y" or "x".

        They come from their array or, where there is none, from the header.
        """
        axis = POSITIONS.index(stored)
        if f"coords/{stored}" not in self.arrays:
            return described_coordinate(
                self.header["coordinates"][stored],
                self.header[DIMENSIONS][axis],
                self.header["domain"]["shape"][axis],
            )
        array = self.arrays[f"coords/{stored}"]
        attributes = dict(array.attributes)
        name = attributes.pop("name", array.name)
        return Coordinate(name=name, values=array.read(), attributes=attributes)

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

    @property
    def cache_bytes(self) -> int:
        """Most bytes of decoded chunks that are kept."""
        return self._cache.limit

    def take_decoded(self, name: str, chunks: Mapping[Any, npt.NDArray[Any]]) -> None:
        """Take full chunks of an array into the cache, as whoever coded them knows they decode.

        The array is checked by the checksums of its members, and no chunk is decoded. The chunks
        become read-only. Raises DamagedFileError for a member that is not what was written.
        """
        with damage_named(self.path, self._source):
            for member in self.arrays[name].chunks.values():
                check_member(self._source, member)
        for index, values in chunks.items():
            values.flags.writeable = False
            self._cache.put((self.arrays[name].name, index, 0), values)

    def overhead(self) -> int:
        """Bytes of the file that are no data of chunks: metadata, names, directory."""
        return self.size - sum(array.nbytes_stored for array in self.arrays.values())

    def split(self) -> dict[str, int]:
        """Bytes of the file by what they hold, see `Split`."""
        arrays = {
            array.name: (name, array)
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
        self._source.close()
        self._cache.clear()

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
        arrays: StoredArray by the name that it has in a file of one variable. The shared
            coordinates are among them.
    """

    def __init__(
        self, file: Container, variable: VariablePlaces, members: Mapping[str, Member]
    ) -> None:
        """Take the arrays of a variable from an open file. Raises DamagedFileError."""
        self.path, self.variable, self.header = file.path, variable.name, variable.header
        self.header_bytes, self.attributes = file.header_bytes, file.attributes
        self.arrays = MappingProxyType(
            {name: file.arrays[place] for name, place in variable.places.items()}
        )
        self.digest = sha256(f"{file.digest}/{variable.name}".encode()).hexdigest()
        self._file, self._source, self._cache = file, file._source, file._cache
        self._closes_file = False
        self._own = variable.own
        own = [f"{variable.places[name]}/" for name in variable.own]
        documents = [f"{place}{DOCUMENT}" for place in own]
        chunks = (member for place in own for member in file.arrays[place[:-1]].chunks.values())
        self.size = sum(
            member.end - member.offset + len(directory_entry(member))
            for member in chain(chunks, (members[name] for name in documents))
        )
        self._documents = len(documents)
        with variable_named(variable.name, 2):
            _check_key_frames(self)

    def closing_file(self) -> VariableContainer:
        """Itself, from now on with a `close` that closes the file, and so all variables."""
        self._closes_file = True
        return self

    def reopening(self) -> Location:
        """The location of the file that holds the variable, with the digest of the whole."""
        return self._file.reopening()

    def overhead(self) -> int:
        """Bytes of the variable's arrays that are no data of chunks."""
        return self.size - sum(self.arrays[name].nbytes_stored for name in self._own)

    def split(self) -> dict[str, int]:
        """Bytes of the variable's arrays by what they hold, as of a file."""
        return split_bytes(self.size, [(name, self.arrays[name]) for name in self._own])

    def close(self) -> None:
        """Release the file after `closing_file`, else nothing: other variables need it."""
        if self._closes_file:
            self._file.close()


def _check_key_frames(container: Container) -> None:
    """Raise DamagedFileError for key frames that do not fit the header."""
    if "key_frames" in container.arrays:
        key_frames = container.arrays["key_frames"].read()
        with damage_named(container.path, container._source):
            check_key_frames(container.header, key_frames)
