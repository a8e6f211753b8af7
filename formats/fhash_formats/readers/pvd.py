"""Collections of VTK files: .pvd and .series, which list one grid for each time.

ParaView writes .pvd for all its formats and .vti.series beside numbered files. The times are those
of the list, and steps are in the order of their times, as in ParaView.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers import vtk_xml
from fhash_formats.readers.common.failures import Stamp, naming
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.vtk_document import parse
from fhash_formats.readers.joined import JoinedSeries
from fhash_formats.series import AXIS_NAMES, Coordinate

SUFFIXES = (".pvd", ".series")

MAX_LIST = 64 * 2**20
"""Bytes of the longest list in JSON that is read."""

Entry = tuple[float, Path]


def matches(head: bytes, path: Path) -> bool:
    """Whether this is a collection, by its first element or its suffix."""
    return path.suffix.lower() in SUFFIXES or b'<VTKFile type="Collection"' in head


class CollectionSeries(JoinedSeries):
    """The steps that a list of files names, one file a step."""

    def __init__(self, path: Path, stamp: Stamp, entries: list[Entry], request: Request) -> None:
        def open_part(file: Path) -> FileSeries:
            part = vtk_xml.open_vtk(file, request).as_asked(request)
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
                if not vtk_xml.matches(opened.read(4096), file):
                    *most, last = vtk_xml.SUFFIXES
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
        entries.append((_time(row.attributes.get("timestep", str(number))), path.parent / file))
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
        (_time(str(row.get("time", number))), path.parent / row["name"])
        for number, row in enumerate(rows)
    ]


def _time(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"the time {text!r} is no number") from error
