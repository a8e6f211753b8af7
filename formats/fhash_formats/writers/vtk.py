"""Writers for VTK: image data, VTKHDF and meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
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
    Put,
    Region,
    Writer,
    chunk_shape,
    even_spacing,
    hdf5_value,
    held_hdf5,
    little_endian,
    of_one,
    printable,
    safe_name,
    write_frame,
)
from fhash_formats.writers.labelled import COMPRESSION

SPACE = ("z", "y", "x")


def _vti_outputs(path: Path, region: Region) -> list[Path]:
    suffix = path.suffix.lower()
    _check_grid(path, region, suffix)
    if suffix == ".pvd":
        suffix = ".vti" if _is_even(region) else ".vtr"
    elif region.shape[0] == 1:
        return [path]
    if not path.name.isprintable():
        raise InputError(
            f"{path}: the file name holds control characters, which a .pvd cannot list; use"
            " another name"
        )
    digits = max(4, len(str(region.shape[0] - 1)))
    steps = [
        path.with_name(f"{path.stem}_{step:0{digits}d}{suffix}") for step in range(region.shape[0])
    ]
    return [*steps, path.with_suffix(".pvd")]


def _is_even(region: Region) -> bool:
    return all(even_spacing(region.coords[axis].values) is not None for axis in SPACE)


def _check_grid(path: Path, region: Region, suffix: str) -> None:
    """Raise InputError where the coordinates do not fit the format."""
    _check_times(path, region)
    for axis in SPACE:
        values = region.coords[axis].values
        if suffix == ".vti" and even_spacing(values) is None:
            raise InputError(
                f"{path}: the coordinate {region.coords[axis].name!r} of {axis} is not evenly"
                " spaced, as .vti needs; use .vtr"
            )
        steps = np.diff(values)
        if not np.all(np.isfinite(values)) or not (np.all(steps > 0) or np.all(steps < 0)):
            raise InputError(
                f"{path}: the coordinate {region.coords[axis].name!r} of {axis} neither ascends"
                " nor descends; use .nc, .h5 or .npy"
            )


def _check_times(path: Path, region: Region) -> None:
    """Raise InputError for times that are not all finite."""
    if not np.all(np.isfinite(region.coords["t"].values)):
        raise InputError(
            f"{path}: the times are not all finite, and VTK's files need them; use .nc, .h5 or .npy"
        )


@contextmanager
def _open_vti(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    ascending, turn = _turned(region)
    image = outputs[0].suffix.lower() == ".vti"

    def put(step: int, frame: Frame) -> None:
        _write_grid(
            temporaries[step],
            region,
            _time_field(region.coords["t"], step),
            ascending,
            frame[turn],
            image=image,
        )

    yield put
    if len(outputs) > region.shape[0]:
        temporaries[-1].write_text(_collection(region, outputs[:-1]), encoding="utf-8")


def _turned(
    region: Region,
) -> tuple[dict[str, npt.NDArray[np.float64]], tuple[slice, ...]]:
    """Positions of each axis of space, ascending, and the slices that turn a frame likewise."""
    given = {axis: region.coords[axis].values for axis in SPACE}
    turn = {
        axis: slice(None, None, -1 if values[-1] < values[0] else 1)
        for axis, values in given.items()
    }
    return {axis: given[axis][turn[axis]] for axis in SPACE}, tuple(turn.values())


def _write_grid(
    path: Path,
    region: Region,
    time: str,
    coords: dict[str, npt.NDArray[np.float64]],
    frame: Frame,
    *,
    image: bool,
) -> None:
    """Write one step: `frame` (z, y, x) on ascending `coords`, as ImageData or RectilinearGrid.

    time: the field array of its time.
    """
    dtype = little_endian(region.dtype)
    extent = " ".join(f"0 {length - 1}" for length in reversed(frame.shape))
    kind, place = "RectilinearGrid", ""
    if image:
        origin = " ".join(repr(float(coords[axis][0])) for axis in "xyz")
        spacing = " ".join(repr(even_spacing(coords[axis])) for axis in "xyz")
        kind, place = "ImageData", f' Origin="{origin}" Spacing="{spacing}"'
    name = f'"{escape(printable(region.name))}"'
    units = _units(region.units)
    sizes = (
        [frame.size * dtype.itemsize]
        if image
        else [frame.size * dtype.itemsize, *(coords[axis].nbytes for axis in "xyz")]
    )
    # Each array follows its 64-bit size.
    offsets = [sum(sizes[:i]) + 8 * i for i in range(len(sizes))]
    grid = ""
    if not image:
        axes = zip("xyz", offsets[1:], strict=True)
        grid = f"<Coordinates>{''.join(_axis(axis, offset) for axis, offset in axes)}</Coordinates>"
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<{kind} WholeExtent="{extent}"{place}>
<FieldData>{time}</FieldData>
<Piece Extent="{extent}">
<PointData Scalars={name}>
<DataArray type="{_vtk_type(dtype)}" Name={name} format="appended" offset="0">{units}</DataArray>
</PointData>
<CellData></CellData>
{grid}
</Piece>
</{kind}>
<AppendedData encoding="raw">
_"""
    with path.open("xb") as handle:
        handle.write(text.encode())
        handle.write(sizes[0].to_bytes(8, "little"))
        write_frame(handle, frame, dtype)
        for axis, size in zip("xyz", sizes[1:], strict=False):
            handle.write(size.to_bytes(8, "little"))
            handle.write(coords[axis].astype("<f8").tobytes())
        handle.write(b"\n</AppendedData>\n</VTKFile>\n")


def _time_field(coordinate: Coordinate, step: int) -> str:
    """The field array TimeValue, by which VTK's programs know the time of a file."""
    value = 'type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii"'
    time = float(coordinate.values[step])
    # Information keys stand behind data that are written as text.
    return f"<DataArray {value}>{time!r}{_units(_time_units(coordinate))}</DataArray>"


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


def _axis(axis: str, offset: int) -> str:
    return f'<DataArray type="Float64" Name="{axis}" format="appended" offset="{offset}"/>'


def _vtk_type(dtype: np.dtype[Any]) -> str:
    """VTK's name of a type: Float32, UInt8 and so on."""
    return dtype.name.replace("uint", "UInt").replace("int", "Int").replace("float", "Float")


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


VTK = Writer(
    name="VTK", suffixes=(".vti", ".vtr", ".pvd"), outputs=_vti_outputs, open=of_one(_open_vti)
)


SINGLE_VERSION = (1, 0)
"""Version of a file of one step."""

SERIES_VERSION = (2, 0)
"""Version of a file of several steps; it is the first with a group Steps."""

SERIES_NEEDS = "ParaView 5.12 or newer, as every .vtkhdf of several steps"
"""Programs that read a file of several steps, for messages."""


def needed_by(paths: Sequence[str], steps: int) -> list[str]:
    """Programs that open outputs of so many steps: at most one text, for a .vtkhdf series."""
    series = steps > 1 and any(path.lower().endswith(".vtkhdf") for path in paths)
    return [SERIES_NEEDS] if series else []


def _vtkhdf_outputs(path: Path, region: Region) -> list[Path]:
    _check_times(path, region)
    for axis in SPACE:
        if not even_spacing(region.coords[axis].values):
            raise InputError(
                f"{path}: the coordinate {region.coords[axis].name!r} of {axis} is not evenly"
                " spaced, as .vtkhdf needs; use .vtr or .pvd"
            )
    return [path]


@contextmanager
def _open_vtkhdf(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    import h5py

    steps = region.shape[0]
    turn = _turned(region)[1]
    # Links in the order of their creation, as the reader of VTK demands for composite files and
    # takes for all.
    with held_hdf5(temporaries[0], lambda file: h5py.File(file, "w", track_order=True)) as (
        file,
        root,
    ):
        with file.calling():
            values = _create(root, region)

        def put(step: int, frame: Frame) -> None:
            with file.calling():
                values[step if steps > 1 else ...] = frame[turn]

        yield put


def _create(root: Any, region: Region) -> Any:
    """Create the empty dataset in `root`, with everything that describes it."""
    ascending = _turned(region)[0]
    steps, *size = region.shape
    group = root.create_group("VTKHDF", track_order=True)
    group.attrs["Version"] = np.array(SERIES_VERSION if steps > 1 else SINGLE_VERSION, dtype="<i8")
    group.attrs["Type"] = np.bytes_("ImageData")
    group.attrs["WholeExtent"] = np.array(
        [bound for length in reversed(size) for bound in (0, length - 1)], dtype="<i8"
    )
    group.attrs["Origin"] = np.array([ascending[axis][0] for axis in "xyz"], dtype="<f8")
    group.attrs["Spacing"] = np.array(
        [even_spacing(ascending[axis]) for axis in "xyz"], dtype="<f8"
    )
    group.attrs["Direction"] = np.eye(3, dtype="<f8").ravel()
    name = safe_name(region.name)
    points = group.create_group("PointData", track_order=True)
    points.attrs["Scalars"] = np.bytes_(name.encode())
    values = points.create_dataset(
        name,
        shape=region.shape if steps > 1 else region.shape[1:],
        dtype=little_endian(region.dtype),
        chunks=chunk_shape(region) if steps > 1 else chunk_shape(region)[1:],
        **COMPRESSION,
    )
    if region.units:
        values.attrs["units"] = region.units.replace("\0", "")
    times = region.coords["t"].values.astype("<f8")
    if steps == 1:
        holder = group.create_group("FieldData", track_order=True)
        _describe(holder.create_dataset("TimeValue", data=times), region)
        return values
    series = group.create_group("Steps", track_order=True)
    series.attrs["NSteps"] = np.int64(steps)
    _describe(series.create_dataset("Values", data=times), region)
    offsets = series.create_group("PointDataOffsets", track_order=True)
    offsets.create_dataset(name, data=np.arange(steps, dtype="<i8"))
    return values


def _describe(times: Any, region: Region) -> None:
    """Give a dataset of times the units and the calendar of the region's."""
    for key in ("units", "calendar"):
        if key in region.coords["t"].attributes:
            times.attrs[key] = hdf5_value(str(region.coords["t"].attributes[key]))


VTKHDF = Writer(
    name="VTKHDF", suffixes=(".vtkhdf",), outputs=_vtkhdf_outputs, open=of_one(_open_vtkhdf)
)


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
