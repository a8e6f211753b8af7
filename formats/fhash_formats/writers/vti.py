"""Writer of VTK's XML grids: .vti (even spacing), .vtr (any ascending coordinates), .pvd (steps).

One step goes to the name given. Several go to NAME_0000.vti, NAME_0001.vti, ... and NAME.pvd, which
lists them with their physical times and takes its name last. A name .pvd takes .vti files where the
grid is even, else .vtr files. Values are appended raw, little-endian with 64-bit sizes, as point
data. VTK has no descending axis: such an axis is reversed, values and coordinates. It has no
float16 either, which is stored as float32, exactly. Format: "VTK XML formats", docs.vtk.org.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate
from fhash_formats.support.dates import DAY, FIRST_GREGORIAN, clock
from fhash_formats.writers.common.labels import printable
from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.spacing import even_spacing
from fhash_formats.writers.common.writer import (
    Frame,
    Put,
    Writer,
    little_endian,
    of_one,
    write_frame,
)

SPACE = ("z", "y", "x")


def _outputs(path: Path, region: Region) -> list[Path]:
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
    if not np.all(np.isfinite(region.coords["t"].values)):
        raise InputError(
            f"{path}: the times are not all finite, and VTK's files need them; use .nc, .h5 or .npy"
        )
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


@contextmanager
def _open(region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]) -> Iterator[Put]:
    ascending = {
        axis: values[:: direction(values)]
        for axis in SPACE
        for values in [region.coords[axis].values]
    }
    turn = tuple(slice(None, None, direction(region.coords[axis].values)) for axis in SPACE)
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


def direction(values: npt.NDArray[np.float64]) -> int:
    """1 for ascending coordinates, -1 for descending ones."""
    return -1 if values[-1] < values[0] else 1


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
    name = quoteattr(printable(region.name))
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


VTK = Writer(name="VTK", suffixes=(".vti", ".vtr", ".pvd"), outputs=_outputs, open=of_one(_open))
