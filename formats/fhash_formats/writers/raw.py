"""Writers of plain values: raw files with an NRRD header, and NPY."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

from fhash_formats.errors import InputError
from fhash_formats.series import AXES
from fhash_formats.writers.common import (
    Frame,
    Put,
    Region,
    Writer,
    even_spacing,
    little_endian,
    of_one,
    one_output,
    printable,
    write_frame,
)


@contextmanager
def _open_npy(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    dtype = little_endian(region.dtype, half=True)
    header = {
        "descr": npy_format.dtype_to_descr(dtype),
        "fortran_order": False,
        "shape": region.shape,
    }
    with temporaries[0].open("xb") as handle:
        npy_format.write_array_header_1_0(handle, header)

        def put(step: int, frame: Frame) -> None:
            write_frame(handle, frame, dtype)

        yield put


NPY = Writer(name="NumPy", suffixes=(".npy",), outputs=one_output, open=of_one(_open_npy))


NRRD_TYPES = {"float32": "float", "float64": "double"}  # the integers are called as in numpy


def _outputs(path: Path, region: Region) -> list[Path]:
    from fhash_formats.readers.file_series import parse_dtype
    from fhash_formats.readers.images import layout_of_name

    _, layout = layout_of_name(path.stem)
    if layout.shape is None or layout.dtype is None:
        if not path.name.isprintable():
            raise InputError(
                f"{path}: the file name holds control characters, which a .nhdr header cannot"
                " name; use another name"
            )
        return [path, path.with_suffix(".nhdr")]
    if (
        tuple(layout.shape.get(axis, 1) for axis in AXES) != region.shape
        or parse_dtype(layout.dtype) != region.dtype
    ):
        t, z, y, x = region.shape
        true = f"*_{x}x{y}x{z}x{t}_{region.dtype.name}.raw"
        raise InputError(
            f"{path}: the name says another layout than the values have; use {true} or a name that"
            " says none"
        )
    return [path]


@contextmanager
def _open_raw(
    region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]
) -> Iterator[Put]:
    from fhash_formats.readers.file_series import ENDIANS
    from fhash_formats.readers.images import layout_of_name

    _, layout = layout_of_name(outputs[0].stem)
    dtype = (
        little_endian(region.dtype)
        if layout.dtype is None
        else region.dtype.newbyteorder(ENDIANS[layout.endian or "little"])
    )
    with temporaries[0].open("xb") as handle:

        def put(step: int, frame: Frame) -> None:
            write_frame(handle, frame, dtype)

        yield put
    if len(outputs) == 2:
        temporaries[1].write_text(_header(region, dtype, outputs[0].name), encoding="utf-8")


def _header(region: Region, dtype: np.dtype[Any], data_file: str) -> str:
    """The NRRD header (teem.sourceforge.net/nrrd/format.html): axes fastest first.

    A single step is a plain volume. There are no `labels`: VTK would name the values by the first.
    """
    axes = "xyzt" if region.shape[0] > 1 else "xyz"
    sizes = dict(zip(AXES, region.shape, strict=True))
    lines = [
        "NRRD0005",
        f"content: {printable(region.name, ' ')}",
        f"type: {NRRD_TYPES.get(dtype.name, dtype.name)}",
        f"dimension: {len(axes)}",
        f"sizes: {' '.join(str(sizes[axis]) for axis in axes)}",
        f"kinds: {' '.join('time' if axis == 't' else 'space' for axis in axes)}",
        *_space(region, axes),
        "endian: little",
        "encoding: raw",
        *([f"sample units: {printable(region.units, ' ')}"] if region.units else []),
        f"data file: {data_file}",
    ]
    for axis in AXES:
        coordinate = region.coords[axis]
        lines.append(f"name_{axis}:={printable(coordinate.name, ' ')}")
        for key in ("units", "calendar"):
            if key in coordinate.attributes:
                text = printable(str(coordinate.attributes[key]), " ")
                lines.append(f"{key}_{axis}:={text}")
        lines.append(f"coordinates_{axis}:={' '.join(map(repr, coordinate.values.tolist()))}")
    return "\n".join(lines) + "\n\n"


def _space(region: Region, axes: str) -> list[str]:
    """Lines that place the grid in space; none where an axis is uneven."""
    steps = [even_spacing(region.coords[axis].values) for axis in "xyz"]
    if None in steps:
        return []
    directions = [
        f"({','.join(repr(step) if i == j else '0' for j in range(3))})"
        for i, step in enumerate(steps)
    ]
    origin = ",".join(repr(float(region.coords[axis].values[0])) for axis in "xyz")
    return [
        "space dimension: 3",
        f"space directions: {' '.join(directions + ['none'] * (len(axes) - 3))}",
        f"space origin: ({origin})",
    ]


RAW = Writer(name="raw", suffixes=(".raw",), outputs=_outputs, open=of_one(_open_raw))
