"""Writers for VTK: image data, VTKHDF and meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from html import escape
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate
from fhash_formats.support.dates import DAY, FIRST_GREGORIAN, clock
from fhash_formats.support.files import check_output, replacing
from fhash_formats.writers.common import (
    Frame,
    Opened,
    Paths,
    Puts,
    Region,
    Regions,
    Writer,
    chunk_shape,
    even_spacing,
    hdf5_value,
    held_hdf5,
    little_endian,
    printable,
    safe_name,
    write_frame,
)
from fhash_formats.writers.labelled import COMPRESSION

SPACE = ("z", "y", "x")
DOUBLE = np.dtype("<f8")
Appended = tuple[npt.NDArray[Any], np.dtype[Any]]


def _vti_outputs(path: Path, region: Region) -> list[Path]:
    suffix = path.suffix.lower()
    _check_grid(path, region, suffix)
    if suffix == ".pvd":
        even = all(even_spacing(region.coords[axis].values) is not None for axis in SPACE)
        suffix = ".vti" if even else ".vtr"
    elif region.shape[0] == 1:
        return [path]
    if not path.name.isprintable():
        raise InputError(
            f"{path}: the file name holds control characters, which a .pvd cannot list; use"
            " another name"
        )
    digits = max(4, len(str(region.shape[0] - 1)))
    names = [f"{path.stem}_{step:0{digits}d}{suffix}" for step in range(region.shape[0])]
    return [*map(path.with_name, names), path.with_suffix(".pvd")]


def _check_grid(path: Path, region: Region, suffix: str) -> None:
    """Raise InputError where the coordinates do not fit the format."""
    if not np.all(np.isfinite(region.coords["t"].values)):
        raise InputError(
            f"{path}: the times are not all finite, and VTK's files need them; use .nc, .h5 or .npy"
        )
    for axis in SPACE:
        values = region.coords[axis].values
        steps, why = np.diff(values), ""
        if suffix in (".vti", ".vtkhdf") and even_spacing(values) is None:
            why = f"is not evenly spaced, as {suffix} needs; use .vtr or .pvd"
        elif not np.all(np.isfinite(values)) or not (np.all(steps > 0) or np.all(steps < 0)):
            why = "neither ascends nor descends; use .nc, .h5 or .npy"
        if why:
            raise InputError(f"{path}: the coordinate {region.coords[axis].name!r} of {axis} {why}")


@contextmanager
def _open_vti(regions: Regions, outputs: Paths, temporaries: Paths) -> Iterator[Puts]:
    (region,) = regions
    ascending, turn = _turned(region)
    image = outputs[0].suffix.lower() == ".vti"
    time = region.coords["t"]

    def put(step: int, frame: Frame) -> None:
        told = _time_field(float(time.values[step]), _time_units(time))
        with temporaries[step].open("xb") as handle:
            _write_grid(handle, region, told, ascending, frame[turn], image=image)

    yield [put]
    if len(outputs) > region.shape[0]:
        temporaries[-1].write_text(_collection(region, outputs[:-1]), encoding="utf-8")


def _turned(region: Region) -> tuple[dict[str, npt.NDArray[np.float64]], tuple[slice, ...]]:
    """Positions of each axis of space, ascending, and the slices that turn a frame likewise."""
    given = {axis: region.coords[axis].values for axis in SPACE}
    turn = {
        axis: slice(None, None, -1 if values[-1] < values[0] else 1)
        for axis, values in given.items()
    }
    return {axis: given[axis][turn[axis]] for axis in SPACE}, tuple(turn.values())


def _write_grid(
    handle: BinaryIO,
    region: Region,
    time: str,
    coords: Mapping[str, npt.NDArray[np.float64]],
    frame: Frame,
    *,
    image: bool,
) -> None:
    """Write one step: `frame` (z, y, x) on ascending `coords`, as ImageData or RectilinearGrid.

    time: the field array of its time.
    """
    dtype = little_endian(region.dtype)
    extent = " ".join(f"0 {length - 1}" for length in reversed(frame.shape))
    arrays = [(frame, dtype), *((coords[axis][None], DOUBLE) for axis in "xyz" if not image)]
    offsets = _offsets(arrays)
    kind, place = "RectilinearGrid", ""
    grid = "".join(
        f'<DataArray type="Float64" Name="{axis}" format="appended" offset="{offset}"/>'
        for axis, offset in zip("xyz", offsets[1:], strict=False)
    )
    if image:
        origin = " ".join(repr(float(coords[axis][0])) for axis in "xyz")
        spacing = " ".join(repr(even_spacing(coords[axis])) for axis in "xyz")
        kind, place = "ImageData", f' Origin="{origin}" Spacing="{spacing}"'
    name = f'"{escape(printable(region.name))}"'
    number = dtype.name.replace("uint", "UInt").replace("int", "Int").replace("float", "Float")
    values = f'type="{number}" Name={name} format="appended" offset="0"'
    body = f"""<{kind} WholeExtent="{extent}"{place}>
<FieldData>{time}</FieldData>
<Piece Extent="{extent}">
<PointData Scalars={name}>
<DataArray {values}>{_units(region.units)}</DataArray>
</PointData>
<CellData></CellData>
{f"<Coordinates>{grid}</Coordinates>" if grid else ""}
</Piece>
</{kind}>"""
    _write_document(handle, kind, body, arrays)


def _offsets(arrays: Sequence[Appended]) -> list[int]:
    """Places of arrays that follow a document, each behind its 64-bit size."""
    sizes = (8 + values.size * dtype.itemsize for values, dtype in arrays)
    return list(accumulate(sizes, initial=0))[:-1]


def _write_document(handle: BinaryIO, kind: str, body: str, arrays: Sequence[Appended]) -> None:
    """Write a document of VTK, and the arrays that follow it."""
    head = f"""<?xml version="1.0" encoding="UTF-8"?>
<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64">
{body}
<AppendedData encoding="raw">
_"""
    handle.write(head.encode())
    for values, dtype in arrays:
        handle.write((values.size * dtype.itemsize).to_bytes(8, "little"))
        write_frame(handle, values, dtype)
    handle.write(b"\n</AppendedData>\n</VTKFile>\n")


def _time_field(time: float, units: str = "") -> str:
    """The field array TimeValue, by which VTK's programs know the time of a file."""
    value = 'type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii"'
    # Information keys stand behind data that are written as text.
    return f"<DataArray {value}>{time!r}{_units(units)}</DataArray>"


def _time_units(coordinate: Coordinate) -> str:
    """Units of the times, "" where they are unknown, or mean nothing without their calendar."""
    units = str(coordinate.attributes.get("units", ""))
    counted = clock(coordinate.attributes)
    if counted is None:
        return "" if " since " in units else units
    instants = (counted.epoch, counted.instant(float(coordinate.values.min())))
    changed = FIRST_GREGORIAN * DAY  # the calendars are the same from here on
    modern = counted.calendar == "proleptic_gregorian" and all(at >= changed for at in instants)
    return units if modern or counted.calendar == "standard" else ""


def _units(text: str) -> str:
    """The information key that holds units; "" without them."""
    key = '<InformationKey name="UNITS_LABEL" location="vtkDataArray">'
    return f"{key}{escape(printable(text))}</InformationKey>" if text else ""


def _collection(region: Region, files: Sequence[Path]) -> str:
    # Here, because it imports urllib.request, which takes 30 ms of the start of every command.
    from xml.sax.saxutils import quoteattr

    times = region.coords["t"].values.tolist()
    rows = [
        f'<DataSet timestep="{time!r}" group="" part="0" file={quoteattr(file.name)}/>\n'
        for time, file in zip(times, files, strict=True)
    ]
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n<Collection>\n'
    )
    return head + "".join(rows) + "</Collection>\n</VTKFile>\n"


VTK = Writer(name="VTK", suffixes=(".vti", ".vtr", ".pvd"), open=_open_vti, outputs=_vti_outputs)


def needed_by(paths: Sequence[str], steps: int) -> list[str]:
    """Programs that open outputs of so many steps: at most one text, for a .vtkhdf series."""
    series = steps > 1 and any(path.lower().endswith(".vtkhdf") for path in paths)
    return ["ParaView 5.12 or newer, as every .vtkhdf of several steps"] if series else []


def _vtkhdf_outputs(path: Path, region: Region) -> list[Path]:
    _check_grid(path, region, ".vtkhdf")
    return [path]


def _open_vtkhdf(regions: Regions, outputs: Paths, temporaries: Paths) -> Opened:
    import h5py

    def opening(file: Any) -> Any:
        # Links in the order of their creation, as the reader of VTK demands for composite files
        # and takes for all.
        return h5py.File(file, "w", track_order=True)

    return held_hdf5(temporaries[0], opening, partial(_create, *regions))


def _create(region: Region, root: Any) -> Puts:
    """Create the empty dataset in `root`, with everything that describes it."""
    ascending, turn = _turned(region)
    steps, *size = region.shape
    several = steps > 1
    group = root.create_group("VTKHDF", track_order=True)
    # 2.0 is the first version with a group Steps
    group.attrs["Version"] = np.array((2 if several else 1, 0), dtype="<i8")
    group.attrs["Type"] = np.bytes_("ImageData")
    extent = [bound for length in reversed(size) for bound in (0, length - 1)]
    group.attrs["WholeExtent"] = np.array(extent, dtype="<i8")
    positions = [ascending[axis] for axis in "xyz"]
    group.attrs["Origin"] = np.array([each[0] for each in positions])
    group.attrs["Spacing"] = np.array([even_spacing(each) for each in positions], dtype="<f8")
    group.attrs["Direction"] = np.eye(3, dtype="<f8").ravel()
    name = safe_name(region.name)
    points = group.create_group("PointData", track_order=True)
    points.attrs["Scalars"] = np.bytes_(name.encode())
    values = points.create_dataset(
        name,
        shape=region.shape if several else region.shape[1:],
        dtype=little_endian(region.dtype),
        chunks=chunk_shape(region) if several else chunk_shape(region)[1:],
        **COMPRESSION,
    )
    if region.units:
        values.attrs["units"] = region.units.replace("\0", "")
    time = region.coords["t"]
    holder = group.create_group("Steps" if several else "FieldData", track_order=True)
    if several:
        holder.attrs["NSteps"] = np.int64(steps)
    times = holder.create_dataset("Values" if several else "TimeValue", data=time.values)
    for key in ("units", "calendar"):
        if key in time.attributes:
            times.attrs[key] = hdf5_value(str(time.attributes[key]))
    if several:
        offsets = holder.create_group("PointDataOffsets", track_order=True)
        offsets.create_dataset(name, data=np.arange(steps, dtype="<i8"))
    return [lambda step, frame: values.__setitem__(step if several else ..., frame[turn])]


VTKHDF = Writer(name="VTKHDF", suffixes=(".vtkhdf",), open=_open_vtkhdf, outputs=_vtkhdf_outputs)


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
    name = f'"{escape(printable(mesh.name))}"'
    ends = np.arange(3, 3 * len(mesh.triangles) + 1, 3)
    arrays = [
        (np.full((1, len(mesh.vertices)), mesh.value), DOUBLE),
        (mesh.vertices[None], DOUBLE),
        (mesh.triangles[None], np.dtype("<i8")),
        (ends[None], np.dtype("<i8")),
    ]
    offsets = _offsets(arrays)
    counts = (
        f'NumberOfPoints="{len(mesh.vertices)}" NumberOfVerts="0" NumberOfLines="0"'
        f' NumberOfStrips="0" NumberOfPolys="{len(mesh.triangles)}"'
    )
    values = f'type="Float64" Name={name} format="appended" offset="{offsets[0]}"'
    points = (
        'type="Float64" Name="Points" NumberOfComponents="3"'
        f' format="appended" offset="{offsets[1]}"'
    )
    body = f"""<PolyData>
<FieldData>{_time_field(mesh.time)}</FieldData>
<Piece {counts}>
<PointData Scalars={name}><DataArray {values}/></PointData>
<Points><DataArray {points}/></Points>
<Polys>
<DataArray type="Int64" Name="connectivity" format="appended" offset="{offsets[2]}"/>
<DataArray type="Int64" Name="offsets" format="appended" offset="{offsets[3]}"/>
</Polys>
</Piece>
</PolyData>"""
    _write_document(handle, "PolyData", body, arrays)


MESH_SUFFIXES: dict[str, Callable[[BinaryIO, Mesh], None]] = {
    ".vtp": _write_vtp,
    ".ply": _write_ply,
}
