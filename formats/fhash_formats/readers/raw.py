"""Readers of plain values: raw files of a given layout, and NPY."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import (
    ENDIANS,
    RawLayout,
    Request,
    Stamp,
    parse_dtype,
    refusing,
)
from fhash_formats.readers.stored_bytes import FlatArray
from fhash_formats.readers.variables import Source, Variable, file_source
from fhash_formats.series import AXES

NAME = re.compile(
    r"(?:^|_)(?P<shape>\d+x\d+x\d+(?:x\d+)?)_(?P<dtype>[a-z]+\d+)(?:_(?P<endian>be|le))?(?=_|$)",
    re.IGNORECASE,
)
FORM = "name_XxYxZ[xT]_TYPE[_be].raw, such as density_64x64x32x10_float32.raw"


def is_raw(head: bytes, path: Path) -> bool:
    """Whether this is raw by its suffix; the first bytes are values and say nothing."""
    return path.suffix.lower() == ".raw"


def layout_of_name(stem: str) -> tuple[str, RawLayout]:
    """Variable name and layout in a file name without its suffix; None for each unknown part."""
    match = NAME.search(stem)
    if match is None:
        return stem, RawLayout()
    lengths = [int(length) for length in match["shape"].lower().split("x")]
    endian = {"be": "big", "le": "little"}.get((match["endian"] or "").lower())
    return stem[: match.start()] or stem, RawLayout(
        dict(zip("xyzt", lengths, strict=False)), match["dtype"], endian
    )


def open_raw(path: Path, request: Request) -> Source:
    """The values of a raw file: x fastest, then y, z, t.

    The request's axes (slowest first) may state another order of the same lengths. Raises
    InputError where the layout is unknown, or where the size of the file differs from it.
    """
    source, stamp = str(path), Stamp.of(path)
    request.refuse_var(source)
    name, named = layout_of_name(path.stem)
    given = request.raw or RawLayout()
    lengths, dtype_name, endian = (
        given.shape or named.shape,
        given.dtype or named.dtype,
        given.endian or named.endian or "little",
    )
    if lengths is None or dtype_name is None:
        missing = " and ".join(
            word for word, value in (("shape", lengths), ("type", dtype_name)) if value is None
        )
        header = path.with_suffix(".nhdr")
        if header.is_file():
            raise InputError(
                f"{source}: the {missing} of the raw values is not known; {header} may say it: give"
                " that file instead, or --shape x=..,y=..,z=.. and --dtype"
            )
        raise InputError(
            f"{source}: the {missing} of the raw values is not known; name the file {FORM}, or"
            " give --shape x=..,y=..,z=.. and --dtype"
        )
    axes = tuple(axis for axis in AXES if axis in lengths)
    if request.axes is not None:
        if set(request.axes) != set(axes):
            raise InputError(
                f"{source}: --axes {','.join(request.axes)} does not name the axes of the raw"
                f" shape, {','.join(axes)}"
            )
        axes = request.axes
    dtype = parse_dtype(dtype_name)
    shape = tuple(lengths[axis] for axis in axes)
    array = FlatArray(path, shape, dtype.newbyteorder(ENDIANS[endian]))
    if array.end != stamp.size:
        layout = "x".join(str(length) for length in shape)
        needed = f"{layout} ({','.join(axes)}) of {dtype.name} need exactly {array.end}"
        raise InputError(
            f"{source} has {stamp.size} bytes; {needed}{_advice(lengths, stamp.size, array.end)}"
        )
    values = Variable(name=name, shape=shape, dtype=array.dtype, dimensions=axes, read=array.read)
    return file_source(path, [values], stamp=stamp)


def _advice(lengths: Mapping[str, int], size: int, needed: int) -> str:
    frames = "t" not in lengths and size % needed == 0
    return f"; with t={size // needed} the size would fit" if frames else ""


MAGIC = b"\x93NUMPY"


def is_npy(head: bytes, path: Path) -> bool:
    """Whether this is .npy, or .npz, which is refused with advice."""
    return head.startswith(MAGIC) or path.suffix.lower() == ".npz"


def open_npy(path: Path, request: Request) -> Source:
    """The array of a .npy file, or one variable for each field of a structured array.

    Its dimensions are (t, z, y, x) or (z, y, x) unless the request names the axes.
    """
    source, stamp = str(path), Stamp.of(path)
    if path.suffix.lower() == ".npz":
        raise InputError(
            f"{source} is a NumPy archive; save its array alone: numpy.save('array.npy',"
            f" numpy.load('{path.name}')[NAME])"
        )
    with refusing(f"{source} cannot be read as .npy"):
        # opened as a map for its header only: type, shape, order and the offset of the values;
        # Python objects are refused by it
        header = np.load(path, mmap_mode="r", allow_pickle=False)
        shape, dtype, offset = header.shape, header.dtype, int(header.offset)
        fortran = header.flags.f_contiguous and not header.flags.c_contiguous
        del header
    # Fortran's order: the same bytes, read as C order with the dimensions reversed
    array = FlatArray(path, shape[::-1] if fortran else shape, dtype, offset=offset)
    if array.end != stamp.size:
        raise InputError(
            f"{source} has {stamp.size} bytes, its header promises"
            f" {array.end}; the file is cut or holds more than one array"
        )
    if dtype.names is None and dtype.kind != "c":
        request.refuse_var(source)
    values = Variable(
        name=path.stem,
        shape=shape,
        dtype=dtype,
        read=(lambda places: array.read(places[::-1]).transpose()) if fortran else array.read,
        # time as the fastest dimension: all steps are read together
        chunks=shape if fortran else None,
    )
    return file_source(path, [values], stamp=stamp)
