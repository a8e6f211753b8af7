"""MetaImage (.mha, .mhd): a text header of ITK, and values behind it or in other files.

Source: itk.org/Wiki/ITK/MetaIO/Documentation. Values are raw, zlib or text, in either byte order,
in one file, a list of files, or a pattern of numbered files. A fourth dimension is time.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import Stamp, naming
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.grid import (
    axis_steps,
    component_by_number,
    component_variables,
    lattice,
)
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes
from fhash_formats.readers.common.stored_bytes import (
    CompressedFile,
    NumbersInText,
    PlainFile,
    StoredArray,
    StoredBytes,
    in_files,
    numbered_files,
)
from fhash_formats.readers.common.variables import choose
from fhash_formats.series import Coordinate
from fhash_formats.support.plain_json import decoded_text

SUFFIXES = (".mha", ".mhd")

TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
"""Number types by their names in the header; MetaIO's long has four bytes on every machine."""

MAX_HEADER = 2**20
"""Bytes of the longest header."""

Fields = Mapping[str, str]


def matches(head: bytes, path: Path) -> bool:
    """Whether this is a MetaImage: by its suffix, or by the first keys of its header."""
    if path.suffix.lower() in SUFFIXES:
        return True
    return re.match(rb"\s*(ObjectType\s*=\s*Image|NDims\s*=\s*\d)", head) is not None


def open_metaimage(path: Path, request: Request) -> FileSeries:
    """Open the series in a MetaImage, or behind its header.

    Raises InputError for turned grids, other types than numbers, and files that are cut;
    MissingInputError for a file of values that is not there.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        fields, lines, end = _header(path)
        sizes = _sizes(fields)
        channels = _whole(fields, "ElementNumberOfChannels", 1)
        dtype = _dtype(fields)
        shape = tuple(reversed(sizes))
        if len(sizes) == 2:
            shape = (1, *shape)
        values = component_variables(fields.get("Name", "") or path.stem, channels, shape, dtype, 0)
        var = component_by_number(request.var, values)
        variable = choose(source, values, var, booleans=request.booleans)
        _, component = variable.handle
        hints = ["t", "z", "y", "x"][-len(shape) :]
        axes = assign_axes(source, shape, hints, hints, request.axes)
        stored, files = _stored(path, fields, lines, end, sizes, channels, dtype, request)
        coords = _coordinates(fields, sizes) if request.axes is None else {}
    array = StoredArray(path, (*shape, channels), dtype, stored)

    def fetch(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        return array.read((*ranges, slice(0, channels)))[..., component]

    return FileSeries(
        source=source,
        name=variable.name,
        shape=shape,
        dtype=dtype,
        axes=axes,
        fetch=fetch,
        stamp=stamp,
        coords=coords,
        close=stored.close,
        beside=files,
    )


def _header(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Fields, the file names that follow a LIST, and the first byte behind the header."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while line := file.readline(MAX_HEADER):
            text = decoded_text(line).strip()
            if file.tell() > MAX_HEADER:
                raise InputError(f"its header is longer than {MAX_HEADER} bytes")
            if not text:
                continue
            key, equals, value = text.partition("=")
            if not equals:
                raise InputError(f"its header has the line {text[:60]!r}")
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                names = []
                if value.split()[:1] == ["LIST"]:
                    rest = decoded_text(file.read(MAX_HEADER))
                    names = [name.strip() for name in rest.splitlines() if name.strip()]
                return fields, names, file.tell()
    raise InputError("its header has no ElementDataFile; the file is cut or no MetaImage")


def _sizes(fields: Fields) -> tuple[int, ...]:
    """Lengths, x first."""
    if fields.get("ObjectType", "Image") != "Image":
        raise InputError(f"its ObjectType is {fields['ObjectType']!r}; Image can be read")
    words = fields.get("DimSize", "").split()
    if not all(re.fullmatch("0{0,9}[1-9][0-9]{0,17}", word) for word in words):
        raise InputError(f"its DimSize is {fields['DimSize']!r}; whole numbers above 0 are needed")
    if len(words) not in (2, 3, 4) or fields.get("NDims") != str(len(words)):
        raise InputError(
            f"it has NDims = {fields.get('NDims')} and DimSize = {fields.get('DimSize')};"
            " 2, 3 or 4 dimensions can be read"
        )
    return tuple(map(int, words))


def _whole(fields: Fields, name: str, default: int) -> int:
    text = fields.get(name, str(default))
    if not re.fullmatch(r"-?[0-9]{1,18}", text) or (name != "HeaderSize" and int(text) < 1):
        raise InputError(f"its {name} is {text!r}")
    return int(text)


def _flag(fields: Fields, *names: str) -> bool:
    text = next((fields[name] for name in names if name in fields), "False")
    return text.lower() in ("true", "1", "yes")


def _dtype(fields: Fields) -> np.dtype[Any]:
    kind = TYPES.get(fields.get("ElementType", "").removesuffix("_ARRAY"))
    if kind is None:
        raise InputError(f"its ElementType is {fields.get('ElementType')!r}; numbers can be read")
    big = _flag(fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    return np.dtype((">" if big else "<") + kind)


def _stored(
    path: Path,
    fields: Fields,
    listed: Sequence[str],
    end: int,
    sizes: Sequence[int],
    channels: int,
    dtype: np.dtype[Any],
    request: Request,
) -> tuple[StoredBytes, list[Path]]:
    """The bytes of the values, and the other files that hold them."""
    size = prod(sizes) * channels * dtype.itemsize
    data = fields["ElementDataFile"]
    if data.upper() == "LOCAL":
        return _one_file(path, fields, end, size, dtype), []
    words = data.split()
    if words[:1] == ["LIST"] and not listed:
        raise InputError("its list of files is empty")
    if len(words) >= 4 and "%" in words[0]:
        files = numbered_files(path.parent, words[0], words[1:4], prod(sizes))
    else:
        files = [path.parent / name for name in (listed if words[:1] == ["LIST"] else [data])]
    request.require_inside(path, *files)
    stored = in_files(files, size, lambda file, part: _one_file(file, fields, 0, part, dtype))
    return stored, list(dict.fromkeys(files))


def _one_file(
    path: Path, fields: Fields, start: int, size: int, dtype: np.dtype[Any]
) -> StoredBytes:
    """The bytes of one file, from `start` or what HeaderSize says."""
    skip = _whole(fields, "HeaderSize", 0)
    start = path.stat().st_size - size if skip == -1 else start + skip
    if _flag(fields, "CompressedData"):
        if skip == -1:
            raise InputError("a HeaderSize of -1 belongs to values that are not compressed")
        return CompressedFile(path, "deflate", start=start, size=size)
    if not _flag({"BinaryData": "True", **fields}, "BinaryData"):
        return NumbersInText(path, dtype, start=start, size=size)
    return PlainFile(path, start=start, size=size)


def _coordinates(fields: Fields, sizes: Sequence[int]) -> dict[str, Coordinate]:
    """Positions of the vertices; those of a plane's z are left to their index."""
    count = len(sizes)
    spacing = _numbers(fields, ("ElementSpacing", "ElementSize"), [1.0] * count)
    origin = _numbers(fields, ("Offset", "Position", "Origin"), [0.0] * count)
    identity = np.eye(count).ravel().tolist()
    matrix = _numbers(fields, ("TransformMatrix", "Rotation", "Orientation"), identity)
    steps = spacing * axis_steps(matrix.reshape(count, count))
    return {
        axis: lattice(axis, float(start), float(step), length)
        for axis, start, step, length in zip("xyzt", origin, steps, sizes, strict=False)
    }


def _numbers(
    fields: Fields, names: Sequence[str], default: Sequence[float]
) -> npt.NDArray[np.float64]:
    """Numbers of the first field that is there, as many as by default."""
    text = next((fields[name] for name in names if name in fields), None)
    try:
        numbers = np.array(default if text is None else [float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (len(default),):
        raise InputError(f"its {names[0]} is {text!r}; {len(default)} numbers are needed")
    return numbers
