"""Regions to write, their labels and surroundings, and the interface of a writer."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import (
    AXES,
    COORDINATES,
    NO_AXIS,
    Coordinate,
    Series,
    SourceMetadata,
    SourceVariable,
    check_coords,
    check_values,
    plain_form,
    references,
)
from fhash_formats.support.files import signals_held
from fhash_formats.support.threads import slab_shape
from fhash_formats.support.values import PACKING, PLUMBING, REFERENCES, json_attributes


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """A decoded part of a time-varying volume, without its values.

    Attributes:
        name: name of the variable, such as "density".
        units: units of the values, "" where unknown.
        dtype: type of the frames, an integer or float of at most 64 bits; kept in the native byte
            order.
        shape: (t, z, y, x), every length at least 1.
        coords: a Coordinate for each of "t", "z", "y", "x", cut to the region and as long as the
            axis.
        attributes: attributes of the variable, JSON values.
        fill: number of `dtype` that stands where there is no value; None where every vertex has one
            or NaN stands there.
        metadata: what belongs to the variable in its source, cut to the region; None where that is
            unknown. NetCDF and Zarr give it back.

    Raises:
        InputError: one of these does not hold.
    """

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, int, int, int]
    coords: Mapping[str, Coordinate]
    units: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    fill: int | float | None = None
    metadata: SourceMetadata | None = None

    @classmethod
    def of(cls, series: Series) -> Self:
        """The region that is all of a series."""
        return cls(
            name=series.name,
            units=series.units,
            dtype=series.dtype,
            shape=series.shape,
            coords=series.coords,
            attributes=series.attributes,
            metadata=series.metadata,
        )

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("region: the variable has no name; give one, such as 'values'")
        dtype = np.dtype(self.dtype).newbyteorder("=")
        shape = check_values(f"region {self.name!r}", self.shape, dtype)
        object.__setattr__(self, "dtype", dtype)
        object.__setattr__(self, "shape", shape)
        check_coords(f"region {self.name!r}", self.coords, shape)


DROPPED = PACKING | PLUMBING | REFERENCES | {""}
"""Attributes that are left out.

Values are physical, so packing no longer holds; other variables of the source are not in the
output; no format has an attribute without a name.
"""

# HDF5 keeps an attribute of at most 64 KiB in the header; text is not bound by it.
ATTRIBUTE_BYTES = 32 * 2**10


def printable(text: str, instead: str = "_") -> str:
    """The text on one line, with `instead` for each control character."""
    return "".join(char if char.isprintable() else instead for char in text)


def safe_name(name: str, used: set[str] | None = None) -> str:
    """A name that HDF5, NetCDF and Zarr take as one name; see `plain_form`.

    used: names that it must differ from; it is put among them.
    """
    unique = plain_form(name, used or (), default="values")
    if used is not None:
        used.add(unique)
    return unique


def variable_attributes(region: Region) -> dict[str, Any]:
    """Attributes of the values, as JSON values.

    They are the region's own, its units, and its name where that had to be changed.
    """
    return _named(region, json_attributes(region.attributes, without=DROPPED))


def coordinate_attributes(axis: str, coordinate: Coordinate) -> dict[str, Any]:
    """Attributes of a coordinate, as JSON values.

    The CF attribute `axis` ("T", "Z", "Y", "X") is added where it is missing.
    """
    return {"axis": axis.upper(), **json_attributes(coordinate.attributes, without=DROPPED)}


def hdf5_value(value: Any) -> Any:
    """A JSON value as an attribute of HDF5 and NetCDF.

    It is text, a number, a list of one kind of them, or else JSON text.
    """
    if isinstance(value, str):
        return value.replace("\0", "")
    if isinstance(value, bool):
        return np.int8(value)  # NetCDF has no boolean
    if isinstance(value, float) or (isinstance(value, int) and -(2**63) <= value < 2**63):
        return np.array(value)[()]
    if isinstance(value, np.generic | np.ndarray):
        return value if value.dtype.kind in "iufSU" else hdf5_value(value.tolist())
    if isinstance(value, list) and value and len(value) * 8 <= ATTRIBUTE_BYTES:
        kinds = {type(item) for item in value}
        if kinds == {str}:
            return [item.replace("\0", "") for item in value]
        if kinds == {float} or (kinds == {int} and all(-(2**63) <= item < 2**63 for item in value)):
            return np.array(value)
    return json.dumps(value)


# Of the axis's extent. Coordinates are often stored as float32, which is good to 6e-8 of their
# size: that must pass. And on an axis of a thousand vertices the largest deviation that passes is a
# thousandth of a cell, which no picture shows.
TOLERANCE = 1e-6


def even_spacing(values: npt.NDArray[np.float64]) -> float | None:
    """The step of evenly spaced coordinates (n,); None where they are uneven.

    The step is negative for descending coordinates and 1.0 for one vertex. Even means that no value
    is further than 1e-6 of the extent from the straight line between the first and the last.
    """
    if not np.all(np.isfinite(values)):
        return None
    if len(values) == 1:
        return 1.0
    extent = float(values[-1] - values[0])
    line = np.linspace(values[0], values[-1], len(values))
    if extent == 0 or np.max(np.abs(values - line)) > TOLERANCE * abs(extent):
        return None
    return extent / (len(values) - 1)


Frame = npt.NDArray[Any]
Put = Callable[[int, Frame], None]
Puts = Sequence[Put]
Paths = Sequence[Path]
Regions = Sequence[Region]
Opened = AbstractContextManager[Puts]

CHUNK_BYTES = 16 * 2**20


@dataclass(frozen=True, kw_only=True)
class Writer:
    """One format.

    Attributes:
        name: name for messages.
        suffixes: suffixes of its outputs, lower case with the dot.
        open: (regions, outputs, temporaries) -> context manager that gives the functions for the
            frames; the temporaries stand for the outputs one by one. Safe names of regions differ.
        outputs: (path, region) -> every path that will be written, in the order in which they take
            their names; raises InputError where the format cannot hold the region.
        directory: whether the output is a directory.
        several: whether an output holds several variables; `outputs` then depends on none.
    """

    name: str
    suffixes: tuple[str, ...]
    open: Callable[[Regions, Paths, Paths], Opened]
    outputs: Callable[[Path, Region], list[Path]] = lambda path, region: [path]
    directory: bool = False
    several: bool = False


def little_endian(dtype: np.dtype[Any], *, half: bool = False) -> np.dtype[Any]:
    """The type in which values are stored: little-endian.

    float16 becomes float32, exactly, unless the format has half precision (`half`).
    """
    stored = np.dtype(np.float32) if dtype == np.float16 and not half else dtype
    return stored.newbyteorder("<")


def write_frame(handle: BinaryIO, frame: Frame, dtype: np.dtype[Any]) -> None:
    """Write the values of a frame (z, y, x) in `dtype`, x fastest.

    They are converted one z at a time, so that there is no second frame in memory.
    """
    for plane in frame:
        handle.write(np.ascontiguousarray(plane, dtype=dtype).data)


def chunk_shape(region: Region) -> tuple[int, int, int, int]:
    """Shape of chunks (1, z, y, x).

    A chunk is one frame; frames above 16 MiB are cut into equal slabs along z, then y, then x. So
    one access reads one step, and no reader has to hold a huge chunk for a small region.
    """
    z, y, x = slab_shape(region.shape[1:], region.dtype.itemsize, CHUNK_BYTES)
    return 1, z, y, x


class HeldFile(io.FileIO):
    """A new, writable binary file whose writes never fail; `check` raises the first failure."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+")
        self.failure: Exception | None = None

    def write(self, data: Any, /) -> int:
        """Write all of `data`, or nothing once a write has failed."""
        view = memoryview(data).cast("B")
        length = len(view)
        try:
            while self.failure is None and len(view):
                view = view[super().write(view) :]
        except Exception as error:
            self.failure = error
        return length

    def truncate(self, size: int | None = None, /) -> int:
        """Set the length, unless a write has failed."""
        try:
            if self.failure is None:
                return super().truncate(size)
        except Exception as error:
            self.failure = error
        return size or 0

    @contextmanager
    def calling(self) -> Iterator[None]:
        """A block that calls HDF5.

        Signals wait until the block ends; then the first failure of the file is raised.
        """
        with signals_held():
            try:
                yield
            except Exception:
                self.check()  # what HDF5 says after a write that was dropped is only a consequence
                raise
        self.check()

    def check(self) -> None:
        """Raise the first failure."""
        if self.failure is not None:
            raise self.failure


@contextmanager
def held_hdf5(
    path: Path, opening: Callable[[HeldFile], Any], create: Callable[[Any], Puts]
) -> Iterator[Puts]:
    """The functions for the frames of a new file at `path`.

    opening: makes an object of the file (h5py, h5netcdf), which is closed before it in every case.
    create: makes all but the values in that object, and the functions.
    """
    root = None
    with HeldFile(path) as file:

        def held(put: Put, step: int, frame: Frame) -> None:
            with file.calling():
                put(step, frame)

        try:
            with file.calling():
                root = opening(file)
                puts = create(root)
            yield [partial(held, put) for put in puts]
        finally:
            if root is not None:
                with file.calling():
                    root.close()


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An output without its values.

    Attributes:
        name: of the variable.
        dimensions: of the variable in the order of the output, each with its axis or NO_AXIS.
        lengths: of every dimension.
        attributes: of the variable, JSON values or numpy's; no packing.
        variables: the arrays beside it.
        file_attributes: of the file.
        unlimited: those of the dimensions that can grow.
    """

    name: str
    dimensions: Mapping[str, str]
    lengths: Mapping[str, int]
    attributes: Mapping[str, Any]
    variables: tuple[SourceVariable, ...]
    file_attributes: Mapping[str, Any]
    unlimited: Sequence[str] = ()

    @classmethod
    def of(cls, region: Region) -> Outline:
        """The outline of a region, with the dimensions of its source, and all beside it."""
        name, metadata = safe_name(region.name), region.metadata
        if metadata is None:
            used = {name}
            metadata = SourceMetadata(
                dimensions={safe_name(region.coords[a].name or a, used): a for a in AXES},
                variable_attributes=variable_attributes(region),
            )
        by_axis = dict(zip(AXES, region.shape, strict=True))
        lengths = {each: by_axis.get(axis, 1) for each, axis in metadata.dimensions.items()}
        variables = [each for each in metadata.variables if each.name != name]
        for each, axis in metadata.dimensions.items():
            if axis == NO_AXIS or metadata.named(each) is not None:
                continue
            coordinate = region.coords[axis]
            # of a source, positions may tell no more than that there are so many
            numbers = np.arange(coordinate.values.size)
            if region.metadata is None or not np.array_equal(coordinate.values, numbers):
                position = SourceVariable(
                    name=each,
                    dimensions=(each,),
                    values=coordinate.values,
                    attributes=coordinate_attributes(axis, coordinate),
                    is_coordinate=True,
                )
                variables.append(position)
        for variable in variables:
            lengths |= dict(zip(variable.dimensions, variable.values.shape, strict=True))
        return cls(
            name=name,
            dimensions=metadata.dimensions,
            lengths=lengths,
            attributes=_attributes(region, metadata, variables),
            variables=tuple(variables),
            file_attributes=_without(metadata.attributes, PLUMBING),
            unlimited=metadata.unlimited,
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension of the variable."""
        return tuple(self.lengths[name] for name in self.dimensions)

    def ordered(self, by_axis: tuple[int, ...]) -> tuple[int, ...]:
        """Numbers for t, z, y and x, such as a chunk's lengths, in the order of the dimensions."""
        numbers = dict(zip(AXES, by_axis, strict=True))
        return tuple(numbers.get(axis, 1) for axis in self.dimensions.values())

    def slab(self, step: int, frame: npt.NDArray[Any]) -> tuple[Any, npt.NDArray[Any]]:
        """The index of a frame (z, y, x) in the variable, and the values that belong there."""
        present = self.dimensions.values()
        index = tuple({"t": step, NO_AXIS: 0}.get(axis, slice(None)) for axis in present)
        order = [AXES.index(axis) - 1 for axis in present if axis in AXES[1:]]
        made_up = [place for place in range(frame.ndim) if place not in order]
        values = frame.transpose([*made_up, *order])
        return index, values.reshape(values.shape[len(made_up) :])


def together(
    outlines: Sequence[Outline],
) -> tuple[dict[str, int], list[SourceVariable], dict[str, Any]]:
    """The lengths, the arrays beside the variables and the attributes of a file of some outlines.

    outlines: of different names. Raises InputError where two do not agree on a length or an array:
    they cannot share an output.
    """
    lengths: dict[str, int] = {}
    variables: dict[str, SourceVariable] = {}
    attributes: dict[str, Any] = {}
    names = [outline.name for outline in outlines]
    for outline in outlines:
        differs = [
            f"{length} of {name}, another {lengths[name]}"
            for name, length in outline.lengths.items()
            if lengths.setdefault(name, length) != length
        ] + [
            f"another {each.name} than the one before"
            for each in outline.variables
            if each.name not in names and not _same(variables.setdefault(each.name, each), each)
        ]
        if differs:
            raise InputError(
                f"variable {outline.name} has {differs[0]}; write the variables one by one"
            )
        attributes = {**outline.file_attributes, **attributes}
    return lengths, list(variables.values()), attributes


def _same(one: SourceVariable, other: SourceVariable) -> bool:
    """Whether two arrays beside variables have the same dimensions and values."""
    floats = one.values.dtype.kind == other.values.dtype.kind == "f"
    return tuple(one.dimensions) == tuple(other.dimensions) and np.array_equal(
        one.values, other.values, equal_nan=floats
    )


def _attributes(
    region: Region, metadata: SourceMetadata, beside: Sequence[SourceVariable]
) -> dict[str, Any]:
    """Attributes of a variable, which name no array that is not beside it."""
    names = {each.name for each in beside}
    told = list(references(metadata.variable_attributes))
    missing = {key for key, name in told if name not in names}
    kept = _without(metadata.variable_attributes, PLUMBING | PACKING | missing | {COORDINATES})
    listed = [name for key, name in told if key == COORDINATES and name in names] + [
        each.name for each in beside if each.is_coordinate and each.name not in metadata.dimensions
    ]
    if listed:
        kept[COORDINATES] = " ".join(dict.fromkeys(listed))
    return _named(region, kept)


def _named(region: Region, attributes: dict[str, Any]) -> dict[str, Any]:
    """The attributes with the units of a region, and with its name where that had to be changed."""
    if region.units:
        attributes["units"] = region.units
    if safe_name(region.name) != region.name:
        attributes.setdefault("long_name", region.name)
    return attributes


def _without(attributes: Mapping[str, Any], names: AbstractSet[str]) -> dict[str, Any]:
    return {key: value for key, value in attributes.items() if key and key not in names}
