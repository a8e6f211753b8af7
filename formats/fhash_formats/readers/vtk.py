"""Readers of VTK: XML image data and rectilinear grids, VTKHDF, lists of files (PVD, .series)."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.file_series import FileSeries, Request, Stamp, naming
from fhash_formats.readers.hdf5 import Attributes, is_hdf5, require_filters
from fhash_formats.readers.joined import JoinedSeries
from fhash_formats.readers.select import open_selected
from fhash_formats.readers.stored_bytes import axis_steps, lattice, numbers_of
from fhash_formats.readers.stored_parts import Hdf5Sources
from fhash_formats.readers.variables import (
    HEADER,
    Behind,
    Source,
    Variable,
    components,
    file_source,
    placed,
    positions,
)
from fhash_formats.readers.vtk_document import Element, VtkArrays, parse
from fhash_formats.series import AXIS_NAMES, Coordinate
from fhash_formats.support.arrays import Values
from fhash_formats.support.values import json_attributes, text_of

XML_SUFFIXES = (".vti", ".vtr", ".pvti", ".pvtr")
SPACE = ("z", "y", "x")
KINDS = ("ImageData", "RectilinearGrid")
PARALLEL_KINDS = ("PImageData", "PRectilinearGrid")
"""Kinds of files that list the files of their pieces."""
PLACES = ("PointData", "CellData")
GHOSTS = ("vtkGhostType", "vtkValidPointMask")
"""Arrays that say which values count, and are none themselves."""

Extent = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""First and last point (z, y, x)."""


def is_vtk_xml(head: bytes, path: Path) -> bool:
    """Whether this is a grid in VTK's XML, by its first element or its suffix."""
    return path.suffix.lower() in XML_SUFFIXES or any(
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


def _arrays(source: str, grid: _Grid, place: str) -> list[Variable]:
    """The arrays of points or of cells; their place precedes a name that both have."""
    first = grid.pieces[0]
    held = {
        where: [each for holder in first.element.all(where) for each in holder.all("DataArray")]
        for where in PLACES
    }
    names = [each.attributes.get("Name", "values") for one in held.values() for each in one]
    found: list[Variable] = []
    for number, element in enumerate(held[place]):
        name = element.attributes.get("Name", "values")
        components_text = element.attributes.get("NumberOfComponents", "1")
        if not (components_text.isascii() and components_text.isdigit()) or not (
            0 < int(components_text) < 1000
        ):
            raise InputError(f"the array {name} has {components_text!r} components")
        count = int(components_text)
        array = _Array(
            place=place, number=number, name=element.attributes.get("Name", ""), components=count
        )
        whole = Variable(
            name=name if names.count(name) == 1 else f"{place}/{name}",
            shape=(*_shape(grid.extent, place), count),
            dtype=first.arrays.dtype(element),
            dimensions=SPACE,
            attributes=_units(element),
            auxiliary=name in GHOSTS,
            read=partial(_read, source, grid, array),
            require=partial(_check, source, grid, array),
        )
        parts = [element.attributes.get(f"ComponentName{i}") for i in range(count)]
        found += components(whole, len(SPACE), parts)
    return found


def _read(
    source: str, grid: _Grid, array: _Array, places: tuple[slice | int, ...]
) -> npt.NDArray[Any]:
    with naming(source):
        return _frame(grid, array)[places]


def _check(source: str, grid: _Grid, array: _Array) -> None:
    """Raise InputError unless the pieces hold the values of an array, as their sizes tell."""
    with naming(source):
        there = 0
        for piece in grid.pieces:
            count = prod(_shape(piece.extent, array.place))
            piece.arrays.check(_element(piece.element, array), count * array.components)
            there += count
        needed = prod(_shape(grid.extent, array.place))
        if there < needed:
            raise InputError(f"its pieces leave at least {needed - there} values of the grid open")


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


def _frame(grid: _Grid, array: _Array) -> npt.NDArray[Any]:
    """An array over the whole grid, (z, y, x, components)."""
    shape = (*_shape(grid.extent, array.place), array.components)
    parts = []
    for piece in grid.pieces:
        own = _shape(piece.extent, array.place)
        element = _element(piece.element, array)
        values = piece.arrays.read(element, prod(own) * array.components)
        parts.append((piece.extent, values.reshape(*own, array.components)))
    if len(parts) == 1 and parts[0][1].shape == shape:
        return parts[0][1]
    whole = np.empty(shape, parts[0][1].dtype)
    filled = np.zeros(shape, bool)
    for extent, part in parts:
        if part.dtype != whole.dtype:
            raise InputError(f"its pieces hold values of the types {whole.dtype} and {part.dtype}")
        place = tuple(
            slice(first - low, first - low + length)
            for (first, _), (low, _), length in zip(extent, grid.extent, part.shape, strict=False)
        )
        whole[place], filled[place] = part, True
    if not filled.all():
        missing = int((~filled[..., 0]).sum())
        raise InputError(f"its pieces leave {missing} values of the grid open")
    return whole


def _positions(grid: _Grid, place: str) -> dict[str, Variable]:
    """Coordinates of the points or of the centres of cells, and the time where the file has it."""
    if grid.element.name.endswith("ImageData"):
        # A parallel file may leave out what its pieces say, such as the direction.
        attributes = {**grid.holders[-2][0].attributes, **grid.element.attributes}
        origin, spacing, direction = (
            numbers_of(attributes.get(name, default), len(default.split()))
            for name, default in (
                ("Origin", "0 0 0"),
                ("Spacing", "1 1 1"),
                ("Direction", "1 0 0 0 1 0 0 0 1"),
            )
        )
        coords = _even(grid.extent, place, origin, spacing, direction)
    else:
        coords = _listed(grid, cells=place == "CellData")
    time = _time(grid)
    return coords if time is None else {**coords, "t": time}


def _even(
    extent: Extent, place: str, origin: Values, spacing: Values, direction: Values
) -> dict[str, Variable]:
    """Coordinates of an even grid: of its points, or of the centres of its cells.

    origin, spacing: along x, y and z. direction: a matrix (3, 3), row by row.
    """
    spacing = spacing * axis_steps(direction.reshape(3, 3))
    coords = {}
    lengths = _shape(extent, place)
    for axis, (first, last), length in zip(SPACE, extent, lengths, strict=True):
        number = "xyz".index(axis)
        start = first + (0.5 if place == "CellData" and last > first else 0.0)
        coords[axis] = lattice(axis, origin[number], spacing[number], length, first=start)
    return coords


def _listed(grid: _Grid, *, cells: bool) -> dict[str, Variable]:
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
        coords[axis] = positions(AXIS_NAMES[axis], values)
    return coords


def _time(grid: _Grid) -> Variable | None:
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
            return positions(AXIS_NAMES["t"], values, _units(element))
    return None


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
        import h5py

        with h5py.File(path, "r") as file:
            return "VTKHDF" in file
    except (ImportError, OSError, RuntimeError, KeyError):
        return False  # the reader of HDF5 says what is wrong


def open_vtkhdf(path: Path, request: Request) -> Source:
    """The arrays and components in a VTKHDF file of the type ImageData.

    Raises InputError for other types, turned grids, and sizes that do not fit together.
    """
    import h5py

    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        file = h5py.File(path, "r")
    try:
        with naming(source):
            found = _datasets_of(source, path, file)
    except BaseException:
        file.close()
        raise
    return file_source(path, found, stamp=stamp, close=file.close)


def _datasets_of(source: str, path: Path, file: Any) -> list[Variable]:
    import h5py

    root = file.get("VTKHDF")
    kind = text_of(root.attrs.get("Type", b"")) if isinstance(root, h5py.Group) else "none"
    if kind != "ImageData":
        raise InputError(f"it holds VTKHDF data of the type {kind or '?'}; ImageData can be read")
    extent = _extent(" ".join(f"{end:.0f}" for end in _row(root, "WholeExtent", 6)))
    times = _times(root)
    return [
        each
        for place in PLACES
        for each in placed(
            _hdf_arrays(source, root, place, extent, times),
            _hdf_positions(root, extent, place, times),
            f"{HEADER}/{place}",
        )
    ]


def _times(root: Any) -> npt.NDArray[np.float64] | None:
    """Times of the steps; None for a file without a group of steps."""
    steps = root.get("Steps")
    if steps is None:
        return None
    times = np.asarray(steps["Values"][()], dtype=np.float64)
    count = int(np.asarray(steps.attrs.get("NSteps", times.size)).ravel()[0])
    if times.shape != (count,) or count < 1:
        raise InputError(f"it promises {count} steps and has the times of {times.size}")
    return times


def _hdf_arrays(
    source: str, root: Any, place: str, extent: Extent, times: npt.NDArray[np.float64] | None
) -> list[Variable]:
    """Arrays of points or of cells; the place precedes a name that both have."""
    import h5py

    held = [root[each] for each in PLACES if isinstance(root.get(each), h5py.Group)]
    names = [name for group in held for name in group]
    space, leading = _shape(extent, place), int(times is not None)
    found: list[Variable] = []
    for name in root[place] if isinstance(root.get(place), h5py.Group) else ():
        dataset = root[place][name]
        if not isinstance(dataset, h5py.Dataset):
            continue
        shape: tuple[int, ...] = dataset.shape or ()
        fits = shape[leading : leading + 3] == space and len(shape) - leading in (3, 4)
        full = f"{place}/{name}" if names.count(name) > 1 else name
        if not fits:
            error = f"a shape {shape} that does not fit the grid (z, y, x) = {space}"
            found.append(Variable(name=full, shape=shape, dtype=dataset.dtype, error=error))
            continue
        entries = None if times is None else _entries(root, place, dataset, full, times)
        dims = (*([AXIS_NAMES["t"]] if leading else []), *SPACE)
        vector = len(shape) > len(dims)
        whole = Variable(
            name=full,
            shape=((len(times), *shape[1:]) if times is not None else shape),
            dtype=dataset.dtype,
            dimensions=dims,
            attributes=Attributes(dataset),
            read=partial(_hdf_read, dataset, entries),
            chunks=dataset.chunks,
            auxiliary=name in GHOSTS,
            behind=partial(_hdf_behind, source, full, dataset, entries),
            require=partial(require_filters, source, full, dataset),
        )
        found += components(whole, len(dims), interleaved=False) if vector else [whole]
    return found


def _hdf_read(
    dataset: Any, entries: npt.NDArray[np.int64] | None, places: tuple[slice | int, ...]
) -> npt.NDArray[Any]:
    """Values of the entries that belong to some steps."""
    if entries is None or isinstance(places[0], int):
        return np.asarray(dataset[places if entries is None else (entries[places[0]], *places[1:])])
    steps = entries[places[0]]
    first = int(steps[0])
    if np.array_equal(steps, np.arange(first, first + len(steps))):
        return np.asarray(dataset[(slice(first, first + len(steps)), *places[1:])])
    return np.stack([dataset[(int(step), *places[1:])] for step in steps])


def _hdf_behind(
    source: str, name: str, dataset: Any, entries: npt.NDArray[np.int64] | None
) -> Behind:
    with Hdf5Sources(source) as sources:
        parts = sources.parts(name, dataset)
        files = list(sources.files)
    if parts is not None and entries is not None:
        # an entry may serve several steps, and some serve none
        borders = np.arange(len(entries) + 1)
        share = parts.share[np.searchsorted(parts.edges[0], entries, side="right") - 1]
        parts = replace(parts, edges=(borders, *parts.edges[1:]), share=share)
    return Behind(parts=parts, files=files)


def _entries(
    root: Any, place: str, dataset: Any, name: str, times: npt.NDArray[np.float64]
) -> npt.NDArray[np.int64]:
    """The entry of the dataset that belongs to each step."""
    own = dataset.name.rpartition("/")[2]
    offsets = root["Steps"].get(f"{place}Offsets/{own}")
    entries = np.arange(len(times)) if offsets is None else np.asarray(offsets[()], np.int64)
    if entries.shape != times.shape or entries.min() < 0 or entries.max() >= len(dataset):
        raise InputError(f"the offsets of {name} do not fit its {len(dataset)} entries")
    return entries


def _hdf_positions(
    root: Any, extent: Extent, place: str, times: npt.NDArray[np.float64] | None
) -> dict[str, Variable]:
    origin, spacing = _row(root, "Origin", 3), _row(root, "Spacing", 3)
    direction = _row(root, "Direction", 9) if "Direction" in root.attrs else np.eye(3).ravel()
    coords = _even(extent, place, origin, spacing, direction)
    stored = root["Steps/Values"] if times is not None else root.get("FieldData/TimeValue")
    if times is None and stored is not None and stored.size == 1:
        times = np.asarray(stored[()], dtype=np.float64).ravel()
    if times is not None:
        extra = json_attributes(stored.attrs)
        kept = {key: value for key, value in extra.items() if key in ("units", "calendar")}
        coords["t"] = positions(AXIS_NAMES["t"], times, kept)
    return coords


def _row(root: Any, name: str, count: int) -> npt.NDArray[np.float64]:
    values = np.asarray(root.attrs.get(name, ()), dtype=np.float64).ravel()
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
        entries = _listed_json(path) if path.suffix.lower() == ".series" else _listed_xml(path)
        if not entries:
            raise InputError("it lists no file")
        request.require_inside(path, *(file for _, file in entries))
        entries.sort(key=lambda entry: entry[0])
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
            if not file.is_file():
                raise MissingInputError(f"{path} lists {file}, which is not there")
            with file.open("rb") as opened:
                if not is_vtk_xml(opened.read(4096), file):
                    *most, last = XML_SUFFIXES
                    kinds = f"{', '.join(most)} and {last}"
                    raise InputError(f"it lists {file.name}; {kinds} can be read")
    return CollectionSeries(path, stamp, entries, request)


def _listed_xml(path: Path) -> list[Entry]:
    """Times and files of a .pvd; files without a time are numbered."""
    collection = parse(path).root.first("Collection")
    if collection is None:
        raise InputError("it holds no collection")
    entries = []
    for number, row in enumerate(collection.all("DataSet")):
        file = row.attributes.get("file", "")
        if not file:
            raise InputError("an entry names no file")
        entries.append(
            (_listed_time(row.attributes.get("timestep", str(number))), path.parent / file)
        )
    return entries


def _listed_json(path: Path) -> list[Entry]:
    """Times and files of a .series file of ParaView."""
    if path.stat().st_size > MAX_LIST:
        raise InputError(f"it is larger than {MAX_LIST} bytes")
    rows = json.loads(path.read_text(encoding="utf-8"))
    rows = rows.get("files") if isinstance(rows, dict) else None
    if not isinstance(rows, list) or not all(
        isinstance(row, dict) and isinstance(row.get("name"), str) for row in rows
    ):
        raise InputError("it is not a list of files as ParaView writes it")
    return [
        (_listed_time(str(row.get("time", number))), path.parent / row["name"])
        for number, row in enumerate(rows)
    ]


def _listed_time(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"the time {text!r} is no number") from error
