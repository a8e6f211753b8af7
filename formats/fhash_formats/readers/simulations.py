"""Output of simulations: grids in blocks (Athena++, FLASH, AMReX plotfiles), and ADIOS2 BP.

Blocks of one level of refinement make one grid, block by block as it is read. Several levels have
no grid of their own; yt resamples them.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.file_series import MAX_AXIS, Request, Stamp, library, naming
from fhash_formats.readers.layout import Read
from fhash_formats.readers.stored_bytes import (
    MAX_HEADER,
    TYPES,
    FlatArray,
    lattice,
    numbers_of,
)
from fhash_formats.readers.variables import (
    Behind,
    Source,
    Variable,
    by_ranges,
    file_source,
    placed,
    positions,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import decoded_text, text_of

MAX_PLACES = 1 << 22
"""Places between the edges of blocks; those of a level that was cut evenly have one a block."""
MAX_TABLE = 1 << 24
"""Numbers of a table of blocks."""


class Blocks:
    """A grid of blocks, which cover it without gaps and overlaps.

    Args:
        firsts: the first cell of each, (n, axes), the slowest axis first.
        sizes: cells of each, (n, axes).

    Attributes:
        shape: cells along each axis.

    Raises InputError for blocks that leave cells out, or overlap.
    """

    def __init__(self, firsts: npt.NDArray[Any], sizes: npt.NDArray[Any]) -> None:
        _require_small(firsts, sizes)
        self._low = firsts.astype(np.int64) - firsts.min(axis=0)
        self._high = self._low + sizes
        self.shape = tuple(int(n) for n in self._high.max(axis=0))
        edges = [np.unique([self._low[:, n], self._high[:, n]]) for n in range(self._low.shape[1])]
        places = [len(each) - 1 for each in edges]
        if prod(places) > MAX_PLACES:
            raise InputError("its blocks cut a grid in no even way")
        covered = np.zeros(places, np.int32)
        ends = zip(self._low.T, self._high.T, edges, strict=True)
        cuts = [(np.searchsorted(e, low), np.searchsorted(e, high)) for low, high, e in ends]
        filled = np.prod([high - low for low, high in cuts], axis=0, dtype=np.float64).sum()
        for number in range(len(firsts) if filled == prod(places) else 0):
            covered[tuple(slice(low[number], high[number]) for low, high in cuts)] += 1
        if (covered != 1).any():
            raise InputError("its blocks overlap, or leave cells of their grid out")

    def read(self, fetch: Callable[[int, tuple[slice, ...]], Any], dtype: np.dtype[Any]) -> Read:
        """The read of an array whose blocks `fetch` gives by number and ranges."""

        def get(ranges: list[range]) -> npt.NDArray[Any]:
            start = np.array([each.start for each in ranges])
            low = np.maximum(self._low, start)
            high = np.minimum(self._high, [each.stop for each in ranges])
            values = np.empty([len(each) for each in ranges], dtype)
            for number in np.flatnonzero((low < high).all(axis=1)).tolist():
                first, last = low[number], high[number]
                inside = _box(first - self._low[number], last - self._low[number])
                values[_box(first - start, last - start)] = fetch(number, inside)
            return values

        return by_ranges(self.shape, get)

    def line(self, axis: int, values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Positions along an axis from those of each block, (n, cells of a block).

        Raises InputError where blocks differ.
        """
        places = self._low[:, axis, None] + np.arange(values.shape[1])
        line = np.full(self.shape[axis], np.nan)
        line[places] = values
        if not np.array_equal(line[places], values):
            raise InputError(f"its blocks have different positions along {AXES[1:][axis]}")
        return line


def _require_small(firsts: npt.NDArray[Any], sizes: npt.NDArray[Any]) -> None:
    """Raise InputError for no blocks, empty ones, and those that are too large or far away."""
    far = ((firsts <= -MAX_AXIS) | (firsts >= MAX_AXIS)).any()
    if not len(firsts) or far or (sizes < 1).any() or (sizes >= MAX_AXIS).any():
        raise InputError(f"it has {len(firsts)} blocks, or one that is empty or too large")


def _box(first: npt.NDArray[Any], last: npt.NDArray[Any]) -> tuple[slice, ...]:
    """The slices between two corners."""
    return tuple(slice(low, high) for low, high in zip(first.tolist(), last.tolist(), strict=True))


def _require_one_level(count: int) -> None:
    """Raise InputError for another number of levels of refinement than 1."""
    if count != 1:
        raise InputError(
            f"it has {count} levels of refinement, which have no grid of their own; make one by"
            " yt.load(path).covering_grid(level, left_edge, dims), and give its numpy array to"
            " fhash_codec.encode"
        )


def in_place_of(variables: Sequence[Variable], found: Sequence[Variable]) -> list[Variable]:
    """Variables that a file means, and the arrays that they are made of, read only by name."""
    names = {each.name for each in found}
    rest = (each for each in variables if each.name not in names)
    return [*found, *(replace(each, auxiliary=True, computed=True) for each in rest)]


def _grid(
    whole: Variable, name: str, blocks: Blocks, numbers: Sequence[int], *before: int
) -> Variable:
    """An array of blocks as one of z, y and x.

    numbers: of each block in the array, behind the indices `before` it.
    """
    return replace(
        whole,
        name=name,
        shape=blocks.shape,
        dimensions=AXES[1:],
        read=blocks.read(
            lambda block, places: whole.read((*before, numbers[block], *places)), whole.dtype
        ),
        chunks=None,
        scales={},
        behind=Behind,
    )


def _table(known: Mapping[str, Variable], name: str) -> npt.NDArray[Any]:
    """All values of a table; raises InputError for one that is not there, or too long."""
    if name not in known or prod(known[name].shape) > MAX_TABLE:
        raise InputError(f"its table {name!r} is not there, or too long")
    return known[name].whole()


def athena_variables(
    variables: Sequence[Variable], attributes: Mapping[str, Any]
) -> list[Variable]:
    """The variables of an Athena++ file (.athdf) of one level, such as `rho`.

    attributes: of the file. Raises InputError for several levels, and for ghost cells.
    """
    known = {each.name: each for each in variables}
    levels = _table(known, "Levels")
    _require_one_level(len(np.unique(levels)))
    sizes = np.atleast_1d(attributes["MeshBlockSize"])[::-1].astype(np.int64)
    corners = _table(known, "LogicalLocations")[:, ::-1].astype(np.int64)
    _require_small(corners, sizes)
    blocks = Blocks(corners * sizes, np.broadcast_to(sizes, corners.shape))
    for axis, cells in enumerate(np.atleast_1d(attributes["RootGridSize"])[::-1].tolist()):
        fine = cells << int(levels[0]) if cells > 1 and 0 <= levels[0] < 32 else cells
        if sizes[axis] > 1 and fine != blocks.shape[axis]:
            raise InputError(
                f"its blocks have {blocks.shape[axis]} cells along {AXES[1:][axis]}, and its grid"
                f" {fine}; those with ghost cells cannot be read"
            )
    coords = {}
    for axis, letter in enumerate(AXES[1:]):
        centres = _table(known, f"x{3 - axis}v").reshape(len(corners), sizes[axis])
        coords[letter] = positions(letter, blocks.line(axis, centres))
    coords["t"] = positions(AXIS_NAMES["t"], [float(attributes["Time"])])
    names = list(map(text_of, np.atleast_1d(attributes["VariableNames"]).tolist()))
    found = []
    counts = np.atleast_1d(attributes["NumVariables"]).tolist()
    for dataset, count in zip(np.atleast_1d(attributes["DatasetNames"]), counts, strict=True):
        whole = known[text_of(dataset)]
        if whole.shape != (count, len(corners), *sizes.tolist()) or len(names) < count:
            raise InputError(f"{whole} does not hold {count} variables of {len(corners)} blocks")
        for number, name in enumerate(names[:count]):
            found.append(_grid(whole, name, blocks, range(len(corners)), number))
        names = names[count:]
    return in_place_of(variables, placed(found, coords))


def warn_of_system(source: str, system: str) -> None:
    """Warn (FhashWarning) of coordinates that are not Cartesian, such as "spherical_polar"."""
    if system not in ("", "0", "cartesian"):
        warnings.warn(
            f"{source}: its coordinates are {system}; x, y and z are their numbers in the order of"
            " the file, not positions in space",
            FhashWarning,
            stacklevel=2,
        )


LEAF = 1
"""Type of a block of FLASH that no finer ones replace."""


def flash_variables(variables: Sequence[Variable]) -> list[Variable]:
    """The variables of a FLASH file, such as `dens`, on blocks of one level without finer ones.

    Raises InputError for several levels.
    """
    known = {each.name: each for each in variables}
    leaves = np.flatnonzero(_table(known, "node type") == LEAF)
    _require_one_level(len(np.unique(_table(known, "refine level").ravel()[leaves])))
    # four letters, which blanks fill, in the names of the arrays, too
    names = [text_of(each) for each in _table(known, "unknown names").ravel().tolist()]
    boxes = _table(known, "bounding box")[leaves].astype(np.float64)
    low, high = boxes.min(axis=(0, 2)), boxes.max(axis=(0, 2))
    width = (boxes[..., 1] - boxes[..., 0]).mean(axis=0)
    place = (boxes[..., 0] - low) / np.where(width > 0, width, 1)
    # plot files have positions of 32 bits
    if not ((abs(place - np.rint(place)) < 0.01) & (place < MAX_AXIS)).all():
        raise InputError("its blocks lie on no grid")
    corners = np.zeros((len(leaves), 3), np.int64)
    corners[:, 3 - place.shape[1] :] = np.rint(place)[:, ::-1]
    shapes = {known[name].shape for name in names}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 4 or shape[0] <= leaves[-1]:
        raise InputError(f"its variables do not have the shape of {len(leaves)} blocks or more")
    sizes = np.array(shape[1:])
    blocks = Blocks(corners * sizes, np.broadcast_to(sizes, corners.shape))
    coords = {}
    for n in np.flatnonzero(width > 0).tolist():
        count = blocks.shape[2 - n]
        coords["xyz"[n]] = lattice("xyz"[n], low[n], (high[n] - low[n]) / count, count, first=0.5)
    if "real scalars" in known:
        told = {text_of(key).strip(): each for key, each in _table(known, "real scalars").tolist()}
    else:
        table = _table(known, "simulation parameters").reshape(-1)
        told = dict(zip(table.dtype.names or (), table[0].tolist(), strict=True))
    coords["t"] = positions(AXIS_NAMES["t"], [float(told["time"])])
    found = [_grid(known[name], name.strip(), blocks, leaves.tolist()) for name in names]
    return in_place_of(variables, placed(found, coords))


PLOTFILES = (b"HyperCLaw", b"NavierStokes")
"""First words of the headers of AMReX and BoxLib."""
BOX = r"\(\(([-\d,]+)\) \(([-\d,]+)\) \(([-\d,]+)\)\)"
"""A box: its first cell, its last one, and along which axes it is of nodes."""
FAB = re.compile(rf"FAB \(\(\d+, \([\d ]+\)\),\((\d+), \(([\d ]+)\)\)\){BOX} (\d+)\s*")
"""Header of the values of a box: bytes of a number, their order, the box, and components."""


def is_plotfile(head: bytes, path: Path) -> bool:
    """Whether this is the folder of a plotfile of AMReX."""
    if not (path / "Header").is_file():
        return False
    with (path / "Header").open("rb") as file:
        return file.read(64).startswith(PLOTFILES)


def open_plotfile(path: Path, request: Request) -> Source:
    """The components of a plotfile of AMReX of one level.

    Raises InputError for several levels, values at nodes, and files outside of the folder.
    """
    header = path / "Header"
    stamp = Stamp.of(header)
    with naming(str(path)):
        lines = _lines(header)
        count = int(lines[1])
        names, (dim, time, finest) = lines[2 : 2 + count], lines[2 + count : 5 + count]
        _require_one_level(int(finest) + 1)
        axes = "xyz"[: int(dim)]
        rest = lines[5 + count :]
        system = rest[6].strip()
        warn_of_system(str(path), {"1": "cylindrical", "2": "spherical"}.get(system, system))
        low, high = (numbers_of(rest[n], len(axes)) for n in (0, 1))
        boxes = int(rest[8].split()[1])
        cells = _within(path, f"{rest[10 + boxes * len(axes)].strip()}_H")
        domain = _boxes(rest[3])
        fabs, firsts, sizes = _fabs(path, cells, count)
        blocks = Blocks(firsts, sizes)
        corner = tuple(firsts.min(axis=0))
        if [(tuple(first), tuple(size)) for first, size in domain] != [(corner, blocks.shape)]:
            raise InputError(f"its boxes are {blocks.shape} at {corner}, and its domain another")
        coords = {
            axis: lattice(axis, low[n], (high[n] - low[n]) / length, length, first=0.5)
            for n, (axis, length) in enumerate(zip(axes, reversed(blocks.shape), strict=True))
        }
        coords["t"] = positions(AXIS_NAMES["t"], [float(time)])
        found = [
            Variable(
                name=name.strip(),
                shape=blocks.shape,
                dtype=fabs[0][0].dtype,
                dimensions=tuple(reversed(axes)),
                read=blocks.read(partial(_of_fab, fabs, number), fabs[0][0].dtype),
                behind=lambda: Behind(folder=path),
            )
            for number, name in enumerate(names)
        ]
    return file_source(path, placed(found, coords), stamp=stamp, folder=path)


def _lines(path: Path) -> list[str]:
    """The lines of a header."""
    with path.open("rb") as file:
        data = file.read(MAX_HEADER + 1)
    if len(data) > MAX_HEADER:
        raise InputError(f"{path} is longer than {MAX_HEADER} bytes")
    return decoded_text(data).splitlines()


def _within(folder: Path, name: str) -> Path:
    """A file of a folder; raises InputError for one outside of it."""
    if not all(re.fullmatch(r"\w[\w.+-]*", part) for part in name.split("/")):
        raise InputError(f"its header names the file {name[:80]!r}, which may lie elsewhere")
    return folder / name


def _boxes(text: str) -> list[tuple[npt.NDArray[Any], npt.NDArray[Any]]]:
    """The first cell and the size of each box in a text, the slowest axis first."""
    found = []
    for match in re.finditer(BOX, text):
        first, last, kind = (np.array(each.split(",")[::-1], np.int64) for each in match.groups())
        if kind.any():
            raise InputError("its values are at nodes or faces; those of cells can be read")
        if (abs(first) >= MAX_AXIS).any() or (abs(last) >= MAX_AXIS).any():
            raise InputError(f"its box {match[0]} is too large")
        found.append((first, last - first + 1))
    return found


Fab = tuple[FlatArray, list[int]]
"""The values of a box (components, z, y, x), and the ghost cells before the first one."""


def _fabs(
    path: Path, cells: Path, count: int
) -> tuple[list[Fab], npt.NDArray[Any], npt.NDArray[Any]]:
    """The values of each box, its first cell, and its size.

    cells: the header of the level. count: components of each box.
    """
    text = "\n".join(_lines(cells))
    boxes = _boxes(text)
    places = re.findall(r"^FabOnDisk: (\S+) (\d+)\s*$", text, re.MULTILINE)
    if not boxes or len(boxes) != len(places):
        raise InputError(f"{cells} has {len(boxes)} boxes, and places of {len(places)}")
    fabs = []
    for (first, size), (name, offset) in zip(boxes, places, strict=True):
        file = _within(cells.parent, name)
        with file.open("rb") as opened:
            opened.seek(int(offset))
            head = opened.readline(1 << 12)
        match = FAB.fullmatch(head.decode("ascii"))
        if match is None or match[1] not in ("4", "8") or int(match[6]) != count:
            raise InputError(f"{file} has no values of {count} components at byte {offset}")
        ((stored, extent),) = _boxes(match[0])
        if (stored > first).any() or (stored + extent < first + size).any() or (size < 1).any():
            raise InputError(f"{file} has another box at byte {offset}")
        order = "<" if match[2].split()[0] == match[1] else ">"
        dtype, shape = np.dtype(f"{order}f{match[1]}"), (count, *extent.tolist())
        array = FlatArray(file, shape, dtype, offset=int(offset) + len(head))
        if array.end > file.stat().st_size:
            raise InputError(f"{file} is cut: {array.end} bytes are needed")
        fabs.append((array, (first - stored).tolist()))
    if len({array.dtype for array, _ in fabs}) != 1:
        raise InputError("its boxes have numbers of several types")
    return fabs, np.array([first for first, _ in boxes]), np.array([size for _, size in boxes])


def _of_fab(fabs: Sequence[Fab], component: int, box: int, places: tuple[slice, ...]) -> Any:
    array, ghosts = fabs[box]
    inside = zip(places, ghosts, strict=True)
    return array.read((component, *(slice(p.start + n, p.stop + n) for p, n in inside)))


ADIOS_SUFFIXES = (".bp", ".bp4", ".bp5")


def is_adios(head: bytes, path: Path) -> bool:
    """Whether this is ADIOS2 BP: a folder with its index, or a file by its suffix."""
    return (path / "md.idx").is_file() or path.suffix.lower() in ADIOS_SUFFIXES


def open_adios(path: Path, request: Request) -> Source:
    """The global arrays of ADIOS2 BP, and its numbers; what was written in steps is along `step`.

    Raises MissingDependencyError without adios2.
    """
    source = str(path)
    adios2 = library(source, "ADIOS2 BP", "adios2", "fhash[adios]")
    index = path / "md.idx"
    stamp = Stamp.of(index if index.is_file() else path)
    with naming(source), ExitStack() as opened:
        if index.is_file():
            _require_whole(path)
        io = adios2.Adios().declare_io(source)
        # else it waits for the rest of a file that is cut, and leaves a file beside it
        io.set_parameters({"OpenTimeoutSecs": "1", "Profile": "Off"})
        io.add_transport("File", {"Library": "stdio"})
        file = adios2.FileReader(io, source)
        opened.callback(_close, file)
        told = file.available_variables()
        steps = max((int(each["AvailableStepsCount"]) for each in told.values()), default=0)
        attributes: dict[str, dict[str, Any]] = {name: {} for name in told}
        for name in file.available_attributes():
            owner, _, key = name.rpartition("/")
            attributes.setdefault(owner, {})[key] = file.read_attribute(name)
        found = [
            _of_adios(path, file, name, steps, each, attributes[name])
            for name, each in told.items()
            if each["Type"] in TYPES and (each["Shape"] or each["SingleValue"] == "true")
        ]
        close = opened.pop_all().close
    return file_source(
        path,
        found,
        groups={name.strip("/"): each for name, each in attributes.items()},
        close=close,
        stamp=stamp,
        folder=path if path.is_dir() else None,
    )


def _require_whole(folder: Path) -> None:
    """Raise InputError where an index is cut; the library would leave steps out, or crash."""
    index, place, end = (folder / "md.idx").read_bytes(), 64, 0
    if len(index) > 64 and index[37] == 4:
        place, end = len(index), int(np.frombuffer(index, "<u8").reshape(-1, 8)[-1, 5])
    while place < len(index):
        kind, length, first, size = struct.unpack_from("<cQQQ", index, place)
        end = first + size if kind == b"s" else end
        place += 9 + length
    if place != len(index) or end != (folder / "md.0").stat().st_size:
        raise InputError("its index md.idx is cut, or of another file than md.0")


def _close(file: Any) -> None:
    """Close a file of ADIOS2, which tries once more to read what is cut."""
    with suppress(RuntimeError):
        file.close()


def _of_adios(
    path: Path,
    file: Any,
    name: str,
    steps: int,
    told: Mapping[str, str],
    attributes: Mapping[str, Any],
) -> Variable:
    """A variable; steps: of the file."""
    own = tuple(int(length) for length in told["Shape"].split(",") if length.strip())
    count, dtype = int(told["AvailableStepsCount"]), np.dtype(TYPES[told["Type"]])
    shape = (count, *own) if count > 1 else own

    def get(ranges: list[range]) -> npt.NDArray[Any]:
        values = np.empty([len(each) for each in ranges], dtype)
        inner = ranges[count > 1 :]
        box = {"start": [n.start for n in inner], "count": [len(n) for n in inner]} if own else {}
        for n, step in enumerate(ranges[0] if count > 1 else [0]):
            stored = file.inquire_variable(name)
            stored.set_step_selection([step, 1])
            if tuple(stored.shape()) != own:
                raise InputError(f"{name} has another shape at its step {step}: {stored.shape()}")
            one = file.read(stored, step_selection=[step, 1], **box)
            values[n if count > 1 else ...] = np.reshape(one, [len(each) for each in inner])
        return values

    return Variable(
        name=name.strip("/"),
        shape=shape,
        dtype=dtype,
        dimensions=("step" if count == steps else f"step_{count}",) if count > 1 else (),
        attributes=attributes,
        read=by_ranges(shape, get),
        behind=lambda: Behind(folder=path if path.is_dir() else None),
    )
