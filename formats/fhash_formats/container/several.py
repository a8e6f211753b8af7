"""`SeveralWriter`: several variables, one after the other, in the container of one writer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.apart import TABLE
from fhash_formats.container.chunks import Coded
from fhash_formats.container.coding import Codec
from fhash_formats.container.header import POSITIONS
from fhash_formats.container.named import SHOWN_ATTRIBUTES, shows_values
from fhash_formats.container.reader import Container
from fhash_formats.container.variables import (
    AUXILIARY,
    FEATURE,
    SHARES,
    free_node,
    part_place,
)
from fhash_formats.container.writer import ContainerWriter, Mark
from fhash_formats.errors import InputError
from fhash_formats.support.plain_json import plain_json

__all__ = ["SeveralWriter", "VariableWriter"]

_COORDINATES = "coords/"


class SeveralWriter:
    """The variables of a container that is being written, which are written one after the other.

    Each is written by its `VariableWriter` as a file of its own would be. Coordinates and arrays
    beside the data that several variables have are there once.
    """

    def __init__(self, writer: ContainerWriter, names: Sequence[str]) -> None:
        """Take all names first, so that no coordinate takes the place of a variable's values.

        Raises InputError for no name, an empty name, and one that is there twice.
        """
        if not names or not all(names) or len(set(names)) < len(names):
            raise InputError(f"variables {', '.join(names)[:80]!a}: one or more different names")
        self.file = writer
        self.nodes: dict[str, str] = {}
        for name in names:
            self.nodes[name] = free_node(name, self.nodes.values())
        self.taken = set(self.nodes.values())
        self.coordinates: dict[str, tuple[str, bytes, dict[str, Any]]] = {}
        self.auxiliary: dict[tuple[Any, ...], str] = {}
        self._headers: list[dict[str, Any]] = []

    def variable(self, name: str, attributes: Mapping[str, Any] | None = None) -> VariableWriter:
        """The writer of the next variable, which ends with its `finish`.

        attributes: of the variable; its array gets those of SHOWN_ATTRIBUTES.
        """
        return VariableWriter(self, name, attributes or {})

    def root(self, *more: Mapping[str, Any]) -> dict[str, Any]:
        """The header of the root: of the finished variables, and of more."""
        headers = [*self._headers, *more]
        features = [
            feature for header in headers for feature in header.get("required_features", ())
        ]
        return {FEATURE: headers, "required_features": [FEATURE, *dict.fromkeys(features)]}

    def size(self, *more: Mapping[str, Any]) -> int:
        """Number of bytes of the file if it were committed with these variables; 0 without any."""
        root = self.root(*more)
        return self.file.size(root) if root[FEATURE] else 0

    def finish(self, header: Mapping[str, Any]) -> None:
        """Take the complete header of a variable that is written."""
        self._headers.append(dict(header))

    def commit(self) -> int:
        """Give the file its name; the number of its bytes. See `ContainerWriter.commit`."""
        return self.file.commit(self.root())


class VariableWriter(ContainerWriter):
    """The writer of one variable among several; arrays have the names of a file of their own."""

    one_of_several = True

    def __init__(self, several: SeveralWriter, name: str, attributes: Mapping[str, Any]) -> None:
        """Prepare a writer; `SeveralWriter.variable` makes them."""
        super().__init__(several.file.path)
        self.name = name
        self._several, self._array_file = several, several.file
        self._node = several.nodes[name]
        self._attributes = {key: attributes[key] for key in SHOWN_ATTRIBUTES if key in attributes}
        self._dimensions: dict[str, str] = {}
        self._lengths: dict[str, int] = {}
        self._parts_of: dict[str, str] = {}
        self._shares: dict[str, str] = {}
        self._begun = several.size()

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

        A coordinate, or an array beside the data, is written only where no other variable has it.
        """
        if name.startswith(_COORDINATES):
            self._share(name.removeprefix(_COORDINATES), array, attributes or {})
            return
        if name.startswith(AUXILIARY):
            content = (name, array.dtype.str, array.shape, sha256(array.tobytes()).digest())
            owner = self._several.auxiliary.setdefault(content, self._node)
            if owner != self._node:
                self._shares[name] = owner
                return
        super().add_whole(
            name,
            array,
            chunk_shape=chunk_shape,
            dimension_names=dimension_names,
            attributes=attributes,
            codecs=codecs,
        )

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
        """Write an array chunk by chunk; see `ContainerWriter.add_array`."""
        place, names, shown = self._placed(name, shape, dtype, codecs, dimension_names, attributes)
        self._array_file.add_array(
            place,
            shape=shape,
            dtype=dtype,
            chunk_shape=chunk_shape,
            chunks=chunks,
            dimension_names=names,
            attributes=shown,
            codecs=codecs,
        )

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
        """Write an array of shards; see `ContainerWriter.add_sharded`."""
        place, names, shown = self._placed(name, shape, dtype, codecs, dimension_names, attributes)
        self._array_file.add_sharded(
            place,
            shape=shape,
            dtype=dtype,
            chunk_shape=chunk_shape,
            shard_shape=shard_shape,
            chunks=chunks,
            dimension_names=names,
            attributes=shown,
            codecs=codecs,
        )

    def preview(self, header: Mapping[str, Any]) -> Container:
        """The variable as written so far, whose `close` closes the file.

        See `ContainerWriter.preview`.
        """
        complete = self._complete({"quality": {}, "history": [], **header})
        container = self._array_file.preview(self._several.root(complete))
        return container.variables[self.name].closing_file()

    def size(self, header: Mapping[str, Any]) -> int:
        """Number of bytes by which the file grows by this variable, with this header."""
        return self._several.size(self._complete(header)) - self._begun

    def finish(self, header: Mapping[str, Any]) -> None:
        """Take the header of the variable, which is then complete."""
        self._several.finish(self._complete(header))

    def commit(self, header: Mapping[str, Any]) -> int:
        """Raise InputError: `SeveralWriter.commit` gives the file its name."""
        raise InputError(f"variable {self.name} is one of several; commit them together")

    def mark(self) -> Mark:
        """The arrays written so far, for `rewind`."""
        return self._array_file.mark()

    def rewind(self, mark: Mark) -> None:
        """Drop the arrays that were written after a mark; coordinates must lie before it."""
        self._array_file.rewind(mark)

    def _complete(self, header: Mapping[str, Any]) -> dict[str, Any]:
        """The header of the variable with what a file of several needs beside it."""
        dimensions = [self._dimensions.get(axis, axis) for axis in POSITIONS]
        placed: dict[str, Any] = {"name": self.name, "array": self._node, "dimensions": dimensions}
        if self._shares:
            placed[SHARES] = self._shares
        return {"required_features": [], **plain_json(header), **placed}

    def _share(self, axis: str, values: npt.NDArray[Any], attributes: Mapping[str, Any]) -> None:
        """Take the coordinate of an axis from the root, where it is written if it is not there."""
        several, wish = self._several, str(attributes.get("name", axis))
        shown = {key: value for key, value in attributes.items() if key != "name"}
        content = (wish, values.tobytes(), shown)
        used = set(self._dimensions.values())
        node = next(
            (n for n, other in several.coordinates.items() if other == content and n not in used),
            None,
        )
        if node is None:
            node = free_node(wish, ())
            if node in several.taken:
                node = free_node(f"{node}_of_{self._node}", several.taken)
            named = {} if node == wish else {"name": wish}
            self._array_file.add_whole(
                node, values, dimension_names=[node], attributes={**shown, **named}
            )
            several.taken.add(node)
            several.coordinates[node] = content
        self._dimensions[axis], self._lengths[axis] = node, len(values)

    def _placed(
        self,
        name: str,
        shape: Sequence[int],
        dtype: npt.DTypeLike,
        codecs: Sequence[Codec] | None,
        dimension_names: Sequence[str | None] | None,
        attributes: Mapping[str, Any] | None,
    ) -> tuple[str, Sequence[str | None] | None, dict[str, Any]]:
        """Path, names of the axes and attributes of an array of this variable.

        The table is shown at the root where its numbers are the values; others lie with the parts.
        """
        if name != TABLE or codecs is None or not shows_values(np.dtype(dtype), codecs):
            return part_place(self._node, name), dimension_names, dict(attributes or {})
        names = [
            self._dimension(axis, length) for axis, length in zip(POSITIONS, shape, strict=True)
        ]
        return self._node, names, {**self._attributes, **(attributes or {})}

    def _dimension(self, axis: str, length: int) -> str:
        """The name of the table's axis: that of the coordinate only where it has every position."""
        name = self._dimensions.get(axis, axis)
        if self._lengths.get(axis) == length:
            return name
        if axis not in self._parts_of:
            taken = self._several.taken
            self._parts_of[axis] = free_node(f"{name}_box_{self._node}", taken)
            taken.add(self._parts_of[axis])
        return self._parts_of[axis]
