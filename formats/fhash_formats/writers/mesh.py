"""Triangle surfaces and their writers: .vtp (VTK's XML) and .ply, both binary, little-endian.

Formats: "VTK XML formats", docs.vtk.org; Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.support.atomic import check_output, replacing
from fhash_formats.writers.common.labels import printable

__all__ = ["MESH_SUFFIXES", "Mesh", "check_mesh_output", "save_mesh"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A surface of triangles.

    Attributes:
        vertices: float64 (n, 3), physical x, y, z.
        triangles: int64 (m, 3), vertex numbers, counterclockwise seen from the side of lower
            values.
        name: name of the variable.
        value: value of the surface, in data units.
        time: physical time.
    """

    vertices: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int64]
    name: str
    value: float
    time: float = 0.0


def check_mesh_output(
    path: str | Path, force: bool = False, sources: Sequence[str | Path] = ()
) -> None:
    """Make the checks of `save_mesh` that need no work.

    Raises InputError, OutputExistsError or OutputError.
    """
    target = Path(path)
    if target.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(
            f"{path}: cannot write a surface with the suffix {target.suffix!r}; use one of"
            f" {', '.join(MESH_SUFFIXES)}"
        )
    check_output(target, force, sources=sources)


def save_mesh(
    path: str | Path, mesh: Mesh, *, force: bool = False, sources: Sequence[str | Path] = ()
) -> Path:
    """Write a surface in the format of the suffix, complete or not at all.

    Raises the errors of `check_mesh_output`.
    """
    target = Path(path)
    check_mesh_output(target, force, sources)
    with replacing(target, force=force) as temporary, temporary.open("xb") as handle:
        MESH_SUFFIXES[target.suffix.lower()](handle, mesh)
    return target


def _write_ply(handle: BinaryIO, mesh: Mesh) -> None:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {printable(mesh.name)} = {mesh.value!r} at time {mesh.time!r}",
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    handle.write(("\n".join(lines) + "\n").encode("ascii", errors="replace"))
    handle.write(mesh.vertices.astype("<f8").tobytes())
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("vertices", "<i4", (3,))])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    handle.write(faces.tobytes())


def _write_vtp(handle: BinaryIO, mesh: Mesh) -> None:
    name = quoteattr(printable(mesh.name))
    arrays = [
        np.full(len(mesh.vertices), mesh.value, dtype="<f8"),
        mesh.vertices.astype("<f8"),
        mesh.triangles.astype("<i8"),
        np.arange(3, 3 * len(mesh.triangles) + 1, 3, dtype="<i8"),
    ]
    offsets = [sum(array.nbytes + 8 for array in arrays[:number]) for number in range(len(arrays))]
    value = 'type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii"'
    time = f"<DataArray {value}>{mesh.time!r}</DataArray>"
    counts = (
        f'NumberOfPoints="{len(mesh.vertices)}" NumberOfVerts="0" NumberOfLines="0"'
        f' NumberOfStrips="0" NumberOfPolys="{len(mesh.triangles)}"'
    )
    values = f'type="Float64" Name={name} format="appended" offset="{offsets[0]}"'
    points = (
        'type="Float64" Name="Points" NumberOfComponents="3"'
        f' format="appended" offset="{offsets[1]}"'
    )
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<PolyData>
<FieldData>{time}</FieldData>
<Piece {counts}>
<PointData Scalars={name}><DataArray {values}/></PointData>
<Points><DataArray {points}/></Points>
<Polys>
<DataArray type="Int64" Name="connectivity" format="appended" offset="{offsets[2]}"/>
<DataArray type="Int64" Name="offsets" format="appended" offset="{offsets[3]}"/>
</Polys>
</Piece>
</PolyData>
<AppendedData encoding="raw">
_"""
    handle.write(text.encode())
    for array in arrays:
        handle.write(array.nbytes.to_bytes(8, "little"))
        handle.write(array.tobytes())
    handle.write(b"\n</AppendedData>\n</VTKFile>\n")


MESH_SUFFIXES: dict[str, Callable[[BinaryIO, Mesh], None]] = {
    ".vtp": _write_vtp,
    ".ply": _write_ply,
}
