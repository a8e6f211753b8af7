"""VTK's XML grids, as VTK, ParaView and TTK write them: .vti (ImageData), .vtr (RectilinearGrid).

Parallel programs write .pvti and .pvtr, which list the files of their pieces; these are one grid.

Point data lie at the grid's points, cell data at the centres of its cells. A vector gives one
variable for each component, such as `velocity.x`. The field array `TimeValue` is the time. numpy
reads all encodings and compressors of VTK (`common/vtk_arrays.py`), bit for bit as VTK does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.common.failures import Stamp, naming
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.grid import (
    axis_steps,
    component_by_number,
    component_variables,
    lattice,
)
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes
from fhash_formats.readers.common.variables import Variable, choose
from fhash_formats.readers.common.vtk_arrays import VtkArrays
from fhash_formats.readers.common.vtk_document import Element, parse
from fhash_formats.series import AXIS_NAMES, Coordinate

SUFFIXES = (".vti", ".vtr", ".pvti", ".pvtr")
SPACE = ("z", "y", "x")
KINDS = ("ImageData", "RectilinearGrid")
PARALLEL_KINDS = ("PImageData", "PRectilinearGrid")
"""Kinds of files that list the files of their pieces."""
PLACES = ("PointData", "CellData")
GHOSTS = ("vtkGhostType", "vtkValidPointMask")
"""Arrays that say which values count, and are none themselves."""

Extent = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""First and last point (z, y, x)."""


def matches(head: bytes, path: Path) -> bool:
    """Whether this is a grid in VTK's XML, by its first element or its suffix."""
    return path.suffix.lower() in SUFFIXES or any(
        b'<VTKFile type="' + kind.encode() in head for kind in (*KINDS, *PARALLEL_KINDS)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Array:
    """One array of the grid.

    Attributes:
        place: "PointData" or "CellData".
        number: its place among the arrays there, the same in every piece.
        name: in the file, "" without one.
        components: values at one place.
    """

    place: str
    number: int
    name: str
    components: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Piece:
    """A part of the grid: its extent, its element, and what reads the arrays of its file."""

    extent: Extent
    element: Element
    arrays: VtkArrays


@dataclass(frozen=True, kw_only=True, eq=False)
class _Grid:
    """A grid: the element that describes it, its whole extent, and its pieces.

    Attributes:
        holders: elements that may hold field data, such as the time, each with what reads them.
        files: files of the pieces, where the grid's own file only lists them.
    """

    element: Element
    extent: Extent
    pieces: tuple[_Piece, ...]
    holders: tuple[tuple[Element, VtkArrays], ...]
    files: tuple[Path, ...] = ()


def open_vtk(path: Path, request: Request) -> FileSeries:
    """Open the one step of a grid: its only array or component, or the one named.

    Raises MissingInputError for a file of a piece that is not there; InputError for other kinds of
    VTK data, turned grids, and files that are cut or damaged.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        grid = _grid(path, request)
        variables = list(_variables(grid))
        var = component_by_number(request.var, variables)
        variable = choose(source, variables, var, booleans=request.booleans)
        axes = assign_axes(source, variable.shape, list(SPACE), list(SPACE), request.axes)
        array, component = variable.handle
        elements = [_element(piece.element, array) for piece in grid.pieces]
        for piece, element in zip(grid.pieces, elements, strict=True):
            count = prod(_shape(piece.extent, array.place)) * array.components
            piece.arrays.check(element, count)
        there = sum(prod(_shape(piece.extent, array.place)) for piece in grid.pieces)
        if there < prod(variable.shape):
            raise InputError(
                f"its pieces leave at least {prod(variable.shape) - there} values of the grid open"
            )
        coords = _positions(grid, array.place)

    def fetch(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        with naming(source):
            return _frame(grid, array, component)

    return FileSeries(
        source=source,
        name=variable.name.rpartition("/")[2],
        shape=variable.shape,
        dtype=variable.dtype,
        axes=axes,
        fetch=fetch,
        stamp=stamp,
        coords=coords if axes == SPACE else {},
        attributes=_units(elements[0]),
        beside=grid.files,
    )


def _grid(
    path: Path, request: Request, kinds: tuple[str, ...] = (*KINDS, *PARALLEL_KINDS)
) -> _Grid:
    """The grid of a file, which must be of one of some kinds."""
    document = parse(path)
    root = document.root
    kind = root.attributes.get("type", root.name)
    element = root.first(kind) if root.name == "VTKFile" and kind in kinds else None
    if element is None:
        raise InputError(
            f"it holds VTK data of the kind {kind}; {' and '.join(kinds)} can be read"
            " (in ParaView, the filter ResampleToImage makes them of other data)"
        )
    extent = _extent(element.attributes.get("WholeExtent", ""))
    arrays = VtkArrays(path, document)
    holders, files, pieces = [(element, arrays), (root, arrays)], [], []
    for piece in element.all("Piece"):
        own = _extent(piece.attributes.get("Extent", element.attributes["WholeExtent"]))
        if any(last < first for first, last in own):
            continue
        if kind in KINDS:
            pieces.append(_Piece(extent=own, element=piece, arrays=arrays))
            continue
        files.append(_file(path, piece))
        if files[-1] in files[:-1]:
            raise InputError(f"it lists {files[-1].name} twice")
        request.require_inside(path, files[-1])
        with naming(str(files[-1])):
            listed = _grid(files[-1], request, (kind[1:],))
        pieces += listed.pieces
        holders += listed.holders
    for part in pieces:
        inside = zip(part.extent, extent, strict=True)
        if not all(low <= first and last <= high for (first, last), (low, high) in inside):
            raise InputError(
                f"a piece with the extent {part.extent} lies outside the grid {extent}"
            )
    if not pieces or any(last < first for first, last in extent):
        raise InputError("it holds an empty grid")
    return _Grid(
        element=element,
        extent=extent,
        pieces=tuple(pieces),
        holders=tuple(holders),
        files=tuple(dict.fromkeys(files)),
    )


def _file(path: Path, piece: Element) -> Path:
    """The file of a piece that a parallel file lists."""
    source = piece.attributes.get("Source", "")
    if not source:
        raise InputError("a piece names no file")
    file = path.parent / source
    if not file.is_file():
        raise MissingInputError(f"{path} lists {file}, which is not there")
    return file


def _extent(text: str) -> Extent:
    """The extent of VTK's text x0 x1 y0 y1 z0 z1."""
    try:
        x0, x1, y0, y1, z0, z1 = map(int, text.split())
    except ValueError as error:
        raise InputError(f"the extent is {text!r}, not six whole numbers") from error
    return (z0, z1), (y0, y1), (x0, x1)


def _shape(extent: Extent, place: str) -> tuple[int, int, int]:
    """Values (z, y, x) of an extent; an axis of one point has one layer of cells."""
    z, y, x = (
        last - first + 1 if place == "PointData" else max(last - first, 1) for first, last in extent
    )
    return z, y, x


def _variables(grid: _Grid) -> Iterator[Variable]:
    """The arrays of all places; their place precedes a name that two places have."""
    first = grid.pieces[0]
    found = [
        (place, number, element)
        for place in PLACES
        for holder in first.element.all(place)
        for number, element in enumerate(holder.all("DataArray"))
    ]
    names = [element.attributes.get("Name", "values") for _, _, element in found]
    for (place, number, element), name in zip(found, names, strict=True):
        components = element.attributes.get("NumberOfComponents", "1")
        if not (components.isascii() and components.isdigit() and 0 < int(components) < 1000):
            raise InputError(f"the array {name} has {components!r} components")
        parts = [element.attributes.get(f"ComponentName{i}") for i in range(int(components))]
        yield from component_variables(
            name if names.count(name) == 1 else f"{place}/{name}",
            int(components),
            _shape(grid.extent, place),
            first.arrays.dtype(element),
            _Array(
                place=place,
                number=number,
                name=element.attributes.get("Name", ""),
                components=int(components),
            ),
            given=parts,
            auxiliary=name in GHOSTS,
        )


def _element(piece: Element, array: _Array) -> Element:
    """The element of an array in a piece."""
    holder = piece.first(array.place)
    elements = [] if holder is None else list(holder.all("DataArray"))
    if array.number >= len(elements):
        raise InputError(f"a piece has {len(elements)} arrays of {array.place}, another has more")
    element = elements[array.number]
    own = element.attributes.get("Name", "")
    components = element.attributes.get("NumberOfComponents", "1")
    if (own, components) != (array.name, str(array.components)):
        raise InputError(
            f"a piece has the array {own!r} of {components} components where another has"
            f" {array.name!r} of {array.components}"
        )
    return element


def _frame(grid: _Grid, array: _Array, component: int) -> npt.NDArray[Any]:
    """One component of an array over the whole grid, (z, y, x)."""
    shape = _shape(grid.extent, array.place)
    parts = []
    for piece in grid.pieces:
        own = _shape(piece.extent, array.place)
        element = _element(piece.element, array)
        values = piece.arrays.read(element, prod(own) * array.components)
        parts.append((piece.extent, values.reshape(*own, array.components)[..., component]))
    if len(parts) == 1 and parts[0][1].shape == shape:
        return parts[0][1]
    whole = np.empty(shape, parts[0][1].dtype)
    filled = np.zeros(shape, bool)
    for extent, part in parts:
        if part.dtype != whole.dtype:
            raise InputError(f"its pieces hold values of the types {whole.dtype} and {part.dtype}")
        place = tuple(
            slice(first - low, first - low + length)
            for (first, _), (low, _), length in zip(extent, grid.extent, part.shape, strict=True)
        )
        whole[place], filled[place] = part, True
    if not filled.all():
        raise InputError(f"its pieces leave {int((~filled).sum())} values of the grid open")
    return whole


def _positions(grid: _Grid, place: str) -> dict[str, Coordinate]:
    """Coordinates of the points or of the centres of cells, and the time where the file has it."""
    shape = dict(zip(SPACE, _shape(grid.extent, place), strict=True))
    if grid.element.name.endswith("ImageData"):
        coords = _even(grid, shape, cells=place == "CellData")
    else:
        coords = _listed(grid, cells=place == "CellData")
    time = _time(grid)
    return coords if time is None else {**coords, "t": time}


def _even(grid: _Grid, shape: dict[str, int], *, cells: bool) -> dict[str, Coordinate]:
    # A parallel file may leave out what its pieces say, such as the direction.
    own = grid.holders[-2][0].attributes
    attributes = {**own, **grid.element.attributes}
    origin, spacing = (
        _numbers(attributes.get(name, default), 3)
        for name, default in (("Origin", "0 0 0"), ("Spacing", "1 1 1"))
    )
    direction = _numbers(attributes.get("Direction", "1 0 0 0 1 0 0 0 1"), 9)
    spacing = spacing * axis_steps(direction.reshape(3, 3))
    coords = {}
    for axis, (first, last) in zip(SPACE, grid.extent, strict=True):
        number = "xyz".index(axis)
        start = first + (0.5 if cells and last > first else 0.0)
        coords[axis] = lattice(axis, origin[number], spacing[number], shape[axis], first=start)
    return coords


def _listed(grid: _Grid, *, cells: bool) -> dict[str, Coordinate]:
    """Coordinates of a rectilinear grid, put together from its pieces."""
    coords = {}
    for axis, (low, high) in zip(SPACE, grid.extent, strict=True):
        values = np.full(high - low + 1, np.nan)
        for piece in grid.pieces:
            first, last = piece.extent[SPACE.index(axis)]
            holder = piece.element.first("Coordinates")
            elements = [] if holder is None else list(holder.all("DataArray"))
            if len(elements) != 3:
                raise InputError(f"it has {len(elements)} arrays of coordinates, not 3")
            element = elements["xyz".index(axis)]
            if piece.arrays.dtype(element).kind not in "iuf":
                raise InputError(f"its coordinates along {axis} are no numbers")
            values[first - low : last - low + 1] = piece.arrays.read(element, last - first + 1)
        if cells and high > low:
            values = (values[:-1] + values[1:]) / 2
        coords[axis] = Coordinate(name=AXIS_NAMES[axis], values=values)
    return coords


def _time(grid: _Grid) -> Coordinate | None:
    """The field array TimeValue as the coordinate of the one step; None without it."""
    fields = (
        (element, arrays)
        for parent, arrays in grid.holders
        for holder in parent.all("FieldData")
        for element in holder.all("DataArray")
    )
    for element, arrays in fields:
        if (
            element.attributes.get("Name") == "TimeValue"
            and element.attributes.get("NumberOfTuples", "1") == "1"
            and arrays.dtype(element).kind in "iuf"
        ):
            values = arrays.read(element, 1).astype(np.float64)
            return Coordinate(name=AXIS_NAMES["t"], values=values, attributes=_units(element))
    return None


def _units(element: Element) -> dict[str, Any]:
    """The units of an array, which VTK keeps as an information key."""
    for key in element.all("InformationKey"):
        if key.attributes.get("name") == "UNITS_LABEL" and key.note.strip():
            return {"units": key.note.strip()}
    return {}


def _numbers(text: str, count: int) -> npt.NDArray[np.float64]:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (count,):
        raise InputError(f"{text!r} stands where {count} numbers are needed")
    return numbers
