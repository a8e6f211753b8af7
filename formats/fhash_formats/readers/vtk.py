"""Readers of VTK: XML image data and rectilinear grids, VTKHDF, lists of files (PVD, .series)."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import (
    FileSeries,
    Request,
    Stamp,
    naming,
    refusing,
    require_length,
)
from fhash_formats.readers.hdf5 import is_hdf5, open_hdf5
from fhash_formats.readers.joined import JoinedSeries
from fhash_formats.readers.select import open_selected
from fhash_formats.readers.stored_bytes import (
    MAX_LINE,
    axis_steps,
    lattice,
    numbers_of,
)
from fhash_formats.readers.stored_parts import hdf5_file
from fhash_formats.readers.variables import (
    HEADER,
    Behind,
    Source,
    Variable,
    components,
    file_source,
    placed,
    plain_name,
    positions,
)
from fhash_formats.readers.vtk_document import Document, Element, VtkArrays
from fhash_formats.series import AXIS_NAMES, Coordinate
from fhash_formats.support.values import Values, is_number

XML_SUFFIXES = (".vti", ".vtr", ".pvti", ".pvtr")
SPACE = ("z", "y", "x")
KINDS = ("ImageData", "RectilinearGrid")
PARALLEL_KINDS = ("PImageData", "PRectilinearGrid")
"""Kinds of files that list the files of their pieces."""
PLACES = ("PointData", "CellData")
GHOSTS = {
    "vtkGhostType": {"PointData": 2, "CellData": 32},
    "avtGhostNodes": {"PointData": 2},
    "avtGhostZones": {"CellData": 16 | 32},
    "vtkGhostLevels": {},
    "vtkValidPointMask": {"PointData": 0},
}
"""Arrays that say which values count, and are none themselves, with the bits of values to ignore.

Sources: HIDDENPOINT and HIDDENCELL (vtkDataSetAttributes.h); NODE_NOT_APPLICABLE_TO_PROBLEM, and
ZONE_EXTERIOR_TO_PROBLEM and ZONE_NOT_APPLICABLE_TO_PROBLEM (VisIt's avtGhostData.h). Other bits and
levels are those of duplicates, which are sound. 0: the number 0 hides a value.
"""

EVEN = ("0 0 0", "1 1 1", "1 0 0 0 1 0 0 0 1")
"""Origin, spacing and direction where a file does not say them."""

MAX_PIECES = 1 << 12
"""Files of the pieces of a grid."""

Extent = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""First and last point (z, y, x)."""


def is_vtk_xml(head: bytes, path: Path) -> bool:
    """Whether this is a grid in VTK's XML, by its first element or its suffix."""
    return path.suffix.lower() in XML_SUFFIXES or any(
        b'<VTKFile type="' + kind.encode() in head for kind in (*KINDS, *PARALLEL_KINDS)
    )


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
    pieces: Sequence[_Piece]
    holders: Sequence[tuple[Element, VtkArrays]]
    files: Sequence[Path]


def open_vtk(path: Path, request: Request) -> Source:
    """The arrays and components of the one step of a grid.

    Raises MissingInputError for a file of a piece that is not there; InputError for other kinds of
    VTK data, turned grids, and files that are cut or damaged.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        grid = _grid(path, request)
        found = [
            each
            for where in PLACES
            for each in placed(
                _arrays(source, grid, where), _positions(grid, where), f"{HEADER}/{where}"
            )
        ]
    return file_source(path, found, stamp=stamp, files=grid.files)


def _grid(
    path: Path, request: Request, kinds: tuple[str, ...] = (*KINDS, *PARALLEL_KINDS)
) -> _Grid:
    """The grid of a file, which must be of one of some kinds."""
    document = Document(path)
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
    files: list[Path] = []
    holders, pieces = [(element, arrays), (root, arrays)], []
    for piece in element.all("Piece"):
        own = _extent(piece.attributes.get("Extent", element.attributes["WholeExtent"]))
        if any(last < first for first, last in own):
            continue
        if kind in KINDS:
            pieces.append(_Piece(extent=own, element=piece, arrays=arrays))
            continue
        if not piece.attributes.get("Source"):
            raise InputError("a piece names no file")
        if len(files) == MAX_PIECES:
            raise InputError(f"it lists more than {MAX_PIECES} pieces")
        files.append(request.beside(path, path.parent / piece.attributes["Source"]))
        if len({*files}) < len(files):
            raise InputError(f"it lists {files[-1].name} twice")
        with naming(str(files[-1])):
            listed = _grid(files[-1], request, (kind[1:],))
        pieces += listed.pieces
        holders += listed.holders
    for part in pieces:
        for (first, last), (low, high) in zip(part.extent, extent, strict=True):
            if first < low or last > high:
                told = f"a piece with the extent {part.extent} lies outside the grid {extent}"
                raise InputError(told)
    if not pieces or any(last < first for first, last in extent):
        raise InputError("it holds an empty grid")
    return _Grid(element=element, extent=extent, pieces=pieces, holders=holders, files=files)


def _extent(text: str) -> Extent:
    """The extent of VTK's text x0 x1 y0 y1 z0 z1."""
    try:
        x0, x1, y0, y1, z0, z1 = map(int, text[:MAX_LINE].split())
    except ValueError as error:
        raise InputError(f"the extent is {text[:80]!r}, not six whole numbers") from error
    return (z0, z1), (y0, y1), (x0, x1)


def _shape(extent: Extent, place: str) -> tuple[int, int, int]:
    """Values (z, y, x) of an extent; an axis of one point has one layer of cells."""
    z, y, x = (
        last - first + 1 if place == "PointData" else max(last - first, 1) for first, last in extent
    )
    return z, y, x


def _arrays(source: str, grid: _Grid, place: str) -> list[Variable]:
    """The arrays of points or of cells; their place precedes a name that both have."""
    first = grid.pieces[0]
    names = Counter(_named(each) for where in PLACES for each in first.element.arrays(where))
    found: list[Variable] = []
    for number, element in enumerate(first.element.arrays(place)):
        name, text = _named(element), element.attributes.get("NumberOfComponents", "1")
        if not re.fullmatch("0*[1-9][0-9]{0,2}", text):
            raise InputError(f"the array {name} has {text!r} components")
        whole = Variable(
            name=name if names[name] == 1 else f"{place}/{name}",
            shape=(*_shape(grid.extent, place), int(text)),
            dtype=first.arrays.dtype(element),
            dimensions=SPACE,
            attributes=_units(element),
            read=partial(_read, source, grid, place, number),
            require=partial(_check, source, grid, place, number),
        )
        parts = [element.attributes.get(f"ComponentName{i}") for i in range(int(text))]
        found += components(whole, len(SPACE), parts)
    return without_hidden(found, place)


def without_hidden(arrays: Sequence[Variable], place: str) -> list[Variable]:
    """The arrays of points or of cells, those of GHOSTS auxiliary, and what these hide hidden.

    place: "PointData" or "CellData".
    """
    ghosts = [each for each in arrays if plain_name(each.name) in GHOSTS]
    marks = [
        (each, GHOSTS[plain_name(each.name)][place])
        for each in ghosts
        if place in GHOSTS[plain_name(each.name)]
    ]

    def hidden(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        found = []
        for each, bits in marks:
            marked = np.asarray(each.read(places)).astype(np.int64)
            found.append((marked & bits) != 0 if bits else marked == 0)
        values: npt.NDArray[np.bool_] = np.any(found, axis=0)
        return values

    return [
        replace(each, auxiliary=True)
        if each in ghosts
        else replace(each, hidden=hidden if marks else None)
        for each in arrays
    ]


def _named(element: Element) -> str:
    return element.attributes.get("Name", "values")


def _parts(
    grid: _Grid, place: str, number: int
) -> Iterator[tuple[_Piece, Element, tuple[int, ...]]]:
    """Each piece with its element of an array, and the shape of that (z, y, x, components).

    place: "PointData" or "CellData". number: of the array there, the same in every piece.
    """
    first = grid.pieces[0].element.arrays(place)[number]
    count = first.attributes.get("NumberOfComponents", "1")
    for piece in grid.pieces:
        held = piece.element.arrays(place)
        if number >= len(held):
            raise InputError(f"a piece has {len(held)} arrays of {place}, another has more")
        own = held[number].attributes.get("NumberOfComponents", "1")
        if (_named(held[number]), own) != (_named(first), count):
            raise InputError(
                f"a piece has the array {_named(held[number])!r} of {own} components where another"
                f" has {_named(first)!r} of {count}"
            )
        yield piece, held[number], (*_shape(piece.extent, place), int(count))


def _check(source: str, grid: _Grid, place: str, number: int) -> None:
    """Raise InputError unless the pieces hold the values of an array, as their sizes tell."""
    with naming(source):
        open_values = prod(_shape(grid.extent, place))
        for piece, element, shape in _parts(grid, place, number):
            piece.arrays.check(element, prod(shape))
            open_values -= prod(shape[:3])
        if open_values > 0:
            raise InputError(f"its pieces leave at least {open_values} values of the grid open")


def _read(
    source: str, grid: _Grid, place: str, number: int, places: tuple[slice | int, ...]
) -> npt.NDArray[Any]:
    """Values of an array over the whole grid, (z, y, x, components)."""
    with naming(source):
        parts = [
            (piece.extent, piece.arrays.read(element, prod(shape)).reshape(shape))
            for piece, element, shape in _parts(grid, place, number)
        ]
        whole = parts[0][1]
        shape = (*_shape(grid.extent, place), whole.shape[-1])
        if len(parts) > 1 or whole.shape != shape:
            whole = np.empty(shape, whole.dtype)
            filled = np.zeros(shape[:3], bool)
            for extent, part in parts:
                if part.dtype != whole.dtype:
                    told = f"the types {whole.dtype} and {part.dtype}"
                    raise InputError(f"its pieces hold values of {told}")
                corner = [own[0] - low for own, (low, _) in zip(extent, grid.extent, strict=True)]
                z, y, x = (slice(n, n + m) for n, m in zip(corner, part.shape, strict=False))
                whole[z, y, x], filled[z, y, x] = part, True
            if not filled.all():
                missing = int((~filled).sum())
                raise InputError(f"its pieces leave {missing} values of the grid open")
        return whole[places]


def _positions(grid: _Grid, place: str) -> dict[str, Variable]:
    """Coordinates of the points or of the centres of cells, and the time where the file has it."""
    if grid.element.name.endswith("ImageData"):
        # A parallel file may leave out what its pieces say, such as the direction.
        attributes = {**grid.holders[-2][0].attributes, **grid.element.attributes}
        told = zip(("Origin", "Spacing", "Direction"), EVEN, strict=True)
        given = [numbers_of(attributes.get(k, d), len(d.split())) for k, d in told]
        coords = _even(grid.extent, place, *given)
    else:
        coords = _listed(grid, cells=place == "CellData")
    for parent, arrays in grid.holders:
        for element in parent.arrays("FieldData"):
            if (
                element.attributes.get("Name") == "TimeValue"
                and element.attributes.get("NumberOfTuples", "1") == "1"
                and arrays.dtype(element).kind in "iuf"
            ):
                values = arrays.read(element, 1).astype(np.float64)
                return {**coords, "t": positions(AXIS_NAMES["t"], values, _units(element))}
    return coords


def _even(
    extent: Extent, place: str, origin: Values, spacing: Values, direction: Values
) -> dict[str, Variable]:
    """Coordinates of an even grid: of its points, or of the centres of its cells.

    origin, spacing: along x, y and z. direction: a matrix (3, 3), row by row.
    """
    spacing = spacing * axis_steps(direction.reshape(3, 3))
    coords = {}
    for n, axis in enumerate("xyz"):
        first, last = extent[2 - n]
        start = first + (0.5 if place == "CellData" and last > first else 0.0)
        length = _shape(extent, place)[2 - n]
        coords[axis] = lattice(axis, origin[n], spacing[n], length, first=start)
    return coords


def _listed(grid: _Grid, *, cells: bool) -> dict[str, Variable]:
    """Coordinates of a rectilinear grid, put together from its pieces."""
    coords = {}
    for axis, (low, high) in zip(SPACE, grid.extent, strict=True):
        require_length(axis, high - low + 1)
        values = np.full(high - low + 1, np.nan)
        for piece in grid.pieces:
            first, last = piece.extent[SPACE.index(axis)]
            elements = piece.element.arrays("Coordinates")
            if len(elements) != 3:
                raise InputError(f"it has {len(elements)} arrays of coordinates, not 3")
            element = elements["xyz".index(axis)]
            if piece.arrays.dtype(element).kind not in "iuf":
                raise InputError(f"its coordinates along {axis} are no numbers")
            values[first - low : last - low + 1] = piece.arrays.read(element, last - first + 1)
        if cells and high > low:
            values = (values[:-1] + values[1:]) / 2
        coords[axis] = positions(AXIS_NAMES[axis], values)
    return coords


def _units(element: Element) -> dict[str, Any]:
    """The units of an array, which VTK keeps as an information key."""
    for key in element.all("InformationKey"):
        if key.attributes.get("name") == "UNITS_LABEL" and key.note.strip():
            return {"units": key.note.strip()}
    return {}


VTKHDF_SUFFIXES = (".vtkhdf",)


def is_vtkhdf(head: bytes, path: Path) -> bool:
    """Whether this is an HDF5 file with a group VTKHDF, whatever its suffix."""
    if not is_hdf5(head):
        return False
    if path.suffix.lower() in VTKHDF_SUFFIXES:
        return True
    try:
        with hdf5_file(path) as file:
            return "VTKHDF" in file
    except (ImportError, InputError, OSError, RuntimeError, KeyError):
        return False  # the reader of HDF5 says what is wrong


def open_vtkhdf(path: Path, request: Request) -> Source:
    """The arrays and components in a VTKHDF file of the type ImageData.

    Raises InputError for other types, turned grids, and sizes that do not fit together.
    """
    opened = open_hdf5(path, replace(request, var=None))
    with naming(str(path)), ExitStack() as stack:
        stack.callback(opened.close)
        found = _datasets_of(opened)
        stack.pop_all()
    return replace(opened, variables=found, groups={}, spread=False)


def _datasets_of(opened: Source) -> list[Variable]:
    inside = [each for each in opened.variables if each.name.startswith("VTKHDF/")]
    known = {each.name.removeprefix("VTKHDF/"): each for each in inside}
    told = opened.groups.get("VTKHDF", {})
    kind = told.get("Type", "none")
    if kind != "ImageData":
        raise InputError(f"it holds VTKHDF data of the type {kind or '?'}; ImageData can be read")
    extent = _extent(" ".join(f"{end:.0f}" for end in _row(told, "WholeExtent", 6)))
    given = [_row(told, "Origin", 3), _row(told, "Spacing", 3)]
    given.append(_row(told, "Direction", 9) if "Direction" in told else np.eye(3).ravel())
    steps, times, time = opened.groups.get("VTKHDF/Steps"), None, known.get("FieldData/TimeValue")
    if steps is not None:
        time = times = known["Steps/Values"]
        length = prod(times.shape)
        count = int(np.asarray(steps.get("NSteps", length)).ravel()[0])
        if times.shape != (count,) or count < 1:
            raise InputError(f"it promises {count} steps and has the times of {length}")
    along = {}
    if time is not None and (times is not None or prod(time.shape) == 1):
        extra = {
            key: time.attributes[key] for key in ("units", "calendar") if key in time.attributes
        }
        values = time.whole().astype(np.float64).ravel()
        along = {"t": positions(AXIS_NAMES["t"], values, extra)}
    return [
        each
        for place in PLACES
        for each in placed(
            _hdf_arrays(known, place, _shape(extent, place), times),
            {**_even(extent, place, *given), **along},
            f"{HEADER}/{place}",
        )
    ]


def _hdf_arrays(
    known: Mapping[str, Variable], place: str, space: tuple[int, ...], times: Variable | None
) -> list[Variable]:
    """Arrays of points or of cells; the place precedes a name that both have."""
    names = Counter(plain_name(each) for each in known if each.rpartition("/")[0] in PLACES)
    found: list[Variable] = []
    for path, stored in known.items():
        where, _, name = path.rpartition("/")
        if where != place:
            continue
        shape, full = stored.shape, path if names[name] > 1 else name
        inner = shape if times is None else shape[1:]
        if inner[:3] != space or len(inner) not in (3, 4):
            error = f"a shape {shape} that does not fit the grid (z, y, x) = {space}"
            found.append(Variable(name=full, shape=shape, dtype=stored.dtype, error=error))
            continue
        dims = SPACE if times is None else (AXIS_NAMES["t"], *SPACE)
        whole = replace(stored, name=full, dimensions=dims, scales={})
        if times is not None:
            offsets = known.get(f"Steps/{place}Offsets/{name}")
            entries = np.arange(times.shape[0]) if offsets is None else offsets.whole()
            if entries.shape != times.shape or entries.min() < 0 or entries.max() >= shape[0]:
                raise InputError(f"the offsets of {full} do not fit its {shape[0]} entries")
            whole = replace(
                whole,
                shape=(len(entries), *inner),
                read=partial(_hdf_read, stored, entries.astype(np.int64)),
                behind=partial(_hdf_behind, stored, entries),
            )
        vector = len(inner) > len(space)
        found += components(whole, len(dims), interleaved=False) if vector else [whole]
    return without_hidden(found, place)


def _hdf_read(
    stored: Variable, entries: npt.NDArray[np.int64], places: tuple[slice | int, ...]
) -> npt.NDArray[Any]:
    """Values of the entries that belong to some steps."""
    steps = entries[places[0]].tolist()
    if isinstance(steps, int):
        return stored.read((steps, *places[1:]))
    if steps == list(range(steps[0], steps[0] + len(steps))):
        return stored.read((slice(steps[0], steps[0] + len(steps)), *places[1:]))
    return np.stack([stored.read((step, *places[1:])) for step in steps])


def _hdf_behind(stored: Variable, entries: npt.NDArray[np.int64]) -> Behind:
    """Parts that somebody wrote; an entry may serve several steps, and some serve none."""
    behind = stored.behind()
    if (parts := behind.parts) is None:
        return behind
    share = parts.share[np.searchsorted(parts.edges[0], entries, side="right") - 1]
    edges = (np.arange(len(entries) + 1), *parts.edges[1:])
    return replace(behind, parts=replace(parts, edges=edges, share=share))


def _row(told: Mapping[str, Any], name: str, count: int) -> npt.NDArray[np.float64]:
    values = np.asarray(told.get(name, ()), dtype=np.float64).ravel()
    if values.size != count or not np.isfinite(values).all():
        raise InputError(f"the attribute {name} has not {count} numbers")
    return values


COLLECTION_SUFFIXES = (".pvd", ".series")

MAX_LIST = 64 * 2**20
"""Bytes of the longest list in JSON that is read."""

Entry = tuple[float, Path]


def is_collection(head: bytes, path: Path) -> bool:
    """Whether this is a collection, by its first element or its suffix."""
    return path.suffix.lower() in COLLECTION_SUFFIXES or b'<VTKFile type="Collection"' in head


class CollectionSeries(JoinedSeries):
    """The steps that a list of files names, one file a step."""

    def __init__(self, path: Path, stamp: Stamp, entries: list[Entry], request: Request) -> None:
        def open_part(file: Path) -> FileSeries:
            part = open_selected(open_vtk(file, request), request)
            if part.shape[0] != 1:
                raise InputError(f"{file} holds {part.shape[0]} steps; {path} lists one a file")
            if "t" in part.given:
                units.update(part.coords["t"].attributes)
            return part

        units: dict[str, Any] = {}
        values = np.array([time for time, _ in entries])
        times = Coordinate(name=AXIS_NAMES["t"], values=values, attributes=units)
        super().__init__(str(path), [file for _, file in entries], open_part, times=times)
        self._stamp = stamp
        self.files = (path, *self.files)

    def check(self) -> None:
        self._stamp.check()
        super().check()


def open_pvd(path: Path, request: Request) -> CollectionSeries:
    """Open the series that a .pvd or .series file lists.

    Raises InputError for several parts of one time, times that are no numbers, and other files than
    grids; MissingInputError for a file that is not there.
    """
    stamp = Stamp.of(path)
    with naming(str(path)):
        entries = _entries(path)
        if not entries:
            raise InputError("it lists no file")
        times = np.array([time for time, _ in entries])
        if not np.isfinite(times).all():
            raise InputError("it lists a time that is no finite number")
        same = np.flatnonzero(times[1:] == times[:-1])
        if same.size:
            one, other = entries[same[0]], entries[same[0] + 1]
            raise InputError(
                f"it lists {one[1].name} and {other[1].name} for the time {one[0]:g}; series of one"
                " part a step can be read (in ParaView, merge the parts first)"
            )
        for _, file in entries:
            with request.beside(path, file).open("rb") as opened:
                if not is_vtk_xml(opened.read(4096), file):
                    told = ".vti, .vtr, .pvti and .pvtr can be read"
                    raise InputError(f"it lists {file.name}; {told}")
    return CollectionSeries(path, stamp, entries, request)


def _entries(path: Path) -> list[Entry]:
    """Times and files of a .pvd, or of a .series file of ParaView; those without one are numbered.

    The order is that of the times.
    """
    if path.suffix.lower() == ".series":
        if path.stat().st_size > MAX_LIST:
            raise InputError(f"it is larger than {MAX_LIST} bytes")
        with refusing("it is cut, or no JSON"):
            told = json.loads(path.read_text(encoding="utf-8"))
        rows = told.get("files") if isinstance(told, dict) else None
        if not isinstance(rows, list) or not all(
            isinstance(row, dict) and isinstance(row.get("name"), str) for row in rows
        ):
            raise InputError("it is not a list of files as ParaView writes it")
        listed = [(row["name"], row.get("time")) for row in rows]
    else:
        collection = Document(path).root.first("Collection")
        if collection is None:
            raise InputError("it holds no collection")
        found = [each.attributes for each in collection.all("DataSet")]
        listed = [(row.get("file", ""), row.get("timestep")) for row in found]
    entries = []
    for number, (name, time) in enumerate(listed):
        text = str(number if time is None else time)
        if not name:
            raise InputError("an entry names no file")
        if not is_number(text):
            raise InputError(f"the time {text!r} is no number")
        entries.append((float(text), path.parent / name))
    return sorted(entries, key=lambda entry: entry[0])
