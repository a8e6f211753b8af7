"""Readers of plain values: raw and NPY files, and those behind a text, NRRD and MetaImage."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.cf import role_of_name
from fhash_formats.readers.file_series import (
    ENDIANS,
    RawLayout,
    Request,
    Stamp,
    naming,
    parse_dtype,
    refusing,
)
from fhash_formats.readers.stored_bytes import (
    MAX_FILES,
    CompressedFile,
    FlatArray,
    NumbersInText,
    PlainFile,
    StoredArray,
    StoredBytes,
    axis_steps,
    in_files,
    lattice,
    numbered_files,
)
from fhash_formats.readers.variables import (
    Source,
    Variable,
    components,
    file_source,
    placed,
    positions,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import decoded_text

TYPE_NAMES = {
    "i1": "signed char|int8|int8_t",
    "u1": "uchar|unsigned char|uint8|uint8_t",
    "i2": "short|short int|signed short|signed short int|int16|int16_t",
    "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t",
    "i4": "int|signed int|int32|int32_t",
    "u4": "uint|unsigned int|uint32|uint32_t",
    "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t",
    "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t",
    "f4": "float",
    "f8": "double",
}

NRRD_TYPES = {name: short for short, names in TYPE_NAMES.items() for name in names.split("|")}
"""Number types by their names in the header."""

MAX_HEADER = 64 * 2**20
"""Bytes of the longest header; own ones list every coordinate."""

MAX_DIMENSIONS = 16
"""Dimensions of NRRD."""

ALIASES = {
    "datafile": "data file",
    "sampleunits": "sample units",
    "axismins": "axis mins",
    "spacedirections": "space directions",
    "spaceorigin": "space origin",
    "spacedimension": "space dimension",
    "lineskip": "line skip",
    "byteskip": "byte skip",
    "centers": "centerings",
}
"""Names of fields without blanks, and the usual names."""

Fields = Mapping[str, str]

MAGIC = b"NRRD000"


def read_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields, key/value pairs, and the first byte behind the header."""
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    with path.open("rb") as file:
        lines = [file.readline(MAX_HEADER)]
        if not re.fullmatch(rb"NRRD000[1-5]\r?\n", lines[0]):
            raise InputError(f"it begins with {lines[0][:20]!r}; NRRD0001 to NRRD0005 can be read")
        while line := file.readline(MAX_HEADER):
            text = decoded_text(line).rstrip("\r\n")
            if file.tell() > MAX_HEADER:
                raise InputError(f"its header is longer than {MAX_HEADER} bytes")
            if not text:
                break
            if text.startswith("#"):
                continue
            key, separator, value = text.partition(":=")
            if separator and ": " not in key:
                pairs[key] = value
                continue
            key, separator, value = text.partition(":")
            if not separator:
                raise InputError(f"its header has the line {text[:60]!r}")
            key = re.sub(r"[ _-]", "", key.strip().lower())
            key = ALIASES.get(key, key)
            fields[key] = value.strip()
            if key == "data file" and value.split()[:1] == ["LIST"]:
                rest = decoded_text(file.read(MAX_HEADER))
                fields["list"] = rest
                break
        return fields, pairs, file.tell()


def sizes_of(fields: Fields) -> tuple[int, ...]:
    """Lengths of the dimensions, the fastest first."""
    words = fields.get("sizes", "").split()
    dimension = fields.get("dimension", "")
    if not words or not all(re.fullmatch("0{0,9}[1-9][0-9]{0,17}", word) for word in words):
        raise InputError(
            f"its sizes are {fields.get('sizes', '')!r}; whole numbers above 0 are needed"
        )
    if dimension != str(len(words)) or len(words) > MAX_DIMENSIONS:
        raise InputError(f"it has {len(words)} sizes and the dimension {dimension!r}")
    return tuple(map(int, words))


def words_of(fields: Fields, name: str, count: int, default: str) -> list[str]:
    """The words of a field that has one for each dimension; `default` where it is missing."""
    words = fields[name].split() if name in fields else [default] * count
    if len(words) != count:
        raise InputError(f"its {name} are {len(words)}, its dimensions {count}")
    return words


def directions_of(fields: Fields, count: int) -> list[tuple[float, ...] | None] | None:
    """The vector of each dimension in space, None for one that has none; None without the field."""
    if "space directions" not in fields:
        return None
    found = vectors(fields["space directions"])
    if len(found) != count:
        raise InputError(f"its space directions are {len(found)}, its dimensions {count}")
    return found


def vectors(text: str) -> list[tuple[float, ...] | None]:
    """Vectors such as (1,0,0); None for "none", and for one of NaN, as pynrrd writes it."""
    found: list[tuple[float, ...] | None] = []
    for word in re.findall(r"\([^)]*\)|\S+", text):
        if word == "none":
            found.append(None)
            continue
        try:
            found.append(tuple(float(part) for part in word.strip("()").split(",")))
        except ValueError as error:
            raise InputError(f"{word!r} is no vector") from error
    return [None if each is not None and np.isnan(each).all() else each for each in found]


def dtype_of(fields: Fields) -> np.dtype[Any]:
    """The type of the values in the file."""
    kind = NRRD_TYPES.get(" ".join(fields.get("type", "").lower().split()))
    if kind is None:
        raise InputError(f"its values are of the type {fields.get('type')!r}, which has no numbers")
    order = fields.get("endian", "little").lower()
    if order not in ("little", "big"):
        raise InputError(f"its byte order is {order!r}")
    return np.dtype(("<" if order == "little" else ">") + kind)


def whole(fields: Fields, name: str) -> int:
    """A whole number from -1 on, 0 without the field."""
    text = fields.get(name, "0")
    try:
        number = int(text)
    except ValueError as error:
        raise InputError(f"its {name} is {text!r}") from error
    if number < -1:
        raise InputError(f"its {name} is {number}")
    return number


def number_of(text: str) -> float:
    """A number in any notation, NaN too."""
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{text!r} stands where a number is needed") from error


NRRD_SUFFIXES = (".nrrd", ".nhdr")


SPATIAL = ("domain", "space", "none", "???")
"""Kinds of axes that are positions, or say nothing."""

COLOURS = ("RGB-color", "RGBA-color", "HSV-color", "XYZ-color")


def is_nrrd(head: bytes, path: Path) -> bool:
    """Whether this is NRRD."""
    return head.startswith(MAGIC)


def open_nrrd(path: Path, request: Request) -> Source:
    """The array in a NRRD file or behind a NRRD header, or its components.

    Raises InputError for colours, turned grids, more than four dimensions, and files that are cut;
    MissingInputError for a file of values that is not there.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        fields, pairs, end = read_header(path)
        sizes = sizes_of(fields)
        kinds = words_of(fields, "kinds", len(sizes), "domain")
        axes, vector = _axes(fields, pairs, sizes, kinds)
        dtype = dtype_of(fields)
        stored, files = _nrrd_values(path, fields, end, sizes, dtype, request)
        units = fields.get("sample units", "").strip('" ')
        shape = tuple(reversed(sizes))
        whole = Variable(
            name=_content(fields, path),
            shape=shape,
            dtype=dtype,
            dimensions=tuple(AXIS_NAMES.get(axis) for axis in reversed(axes)),
            attributes={"units": units} if units else {},
            read=StoredArray(path, shape, dtype, stored).read,
        )
        arrays = [whole] if vector is None else components(whole, len(sizes) - 1 - vector)
        found = placed(arrays, _nrrd_coordinates(fields, pairs, sizes, axes))
    return file_source(path, found, stamp=stamp, files=files, close=stored.close)


def _axes(
    fields: Fields, pairs: Mapping[str, str], sizes: Sequence[int], kinds: Sequence[str]
) -> tuple[list[str], int | None]:
    """The axis of each dimension (fastest first), "" for components, and where those are.

    The file's kinds, labels and space directions say which dimension is time or components; the
    others are x, y and z in their order.
    """
    directions = directions_of(fields, len(sizes))
    axes = [""] * len(sizes)
    vector = None
    labels = re.findall(r'"((?:[^"\\]|\\.)*)"', fields.get("labels", ""))
    space = fields.get("space", "")
    for place, kind in enumerate(kinds):
        label = labels[place] if len(labels) == len(sizes) else ""
        if kind in COLOURS:
            raise InputError(f"its values are colours ({kind}); one number a vertex can be read")
        named = kind in (*SPATIAL, "list") and role_of_name(label) == "t"
        if kind == "time" or named or (kind == "list" and place == 3 and vector is None):
            axes[place] = "t"
        elif kind not in SPATIAL or (directions is not None and directions[place] is None):
            last_time = place == len(sizes) - 1 and (space.endswith("time") or kind in SPATIAL)
            if last_time and len(sizes) == 4:
                axes[place] = "t"
            elif vector is None:
                vector = place
            else:
                raise InputError(f"two of its dimensions hold components (kinds {' '.join(kinds)})")
    free = [place for place in range(len(sizes)) if not axes[place] and place != vector]
    letters = [axis for axis in ("x", "y", "z", "t") if axis not in axes]
    if len(free) > len(letters) or axes.count("t") > 1:
        raise InputError(
            f"its sizes {' '.join(map(str, sizes))} with the kinds {' '.join(kinds)} are more than"
            " time, z, y and x"
        )
    for place, axis in zip(free, letters, strict=False):
        axes[place] = axis
    return axes, vector


def _content(fields: Fields, path: Path) -> str:
    return fields.get("content", "").strip('" ') or path.stem


def _nrrd_values(
    path: Path,
    fields: Fields,
    end: int,
    sizes: Sequence[int],
    dtype: np.dtype[Any],
    request: Request,
) -> tuple[StoredBytes, list[Path]]:
    """The bytes of the values, and the other files that hold them."""
    size = prod(sizes) * dtype.itemsize
    if "data file" not in fields:
        return _nrrd_file(path, fields, end, size, dtype), []
    files = _data_files(path, fields, sizes)
    request.require_inside(path, *files)
    stored = in_files(files, size, lambda file, part: _nrrd_file(file, fields, 0, part, dtype))
    return stored, list(dict.fromkeys(files))


def _data_files(path: Path, fields: Fields, sizes: Sequence[int]) -> list[Path]:
    """The files of values: one, a list, or a pattern with its first and last number and stride."""
    text = fields["data file"]
    words = text.split() or [""]
    if words[:1] == ["LIST"]:
        listed = fields.get("list", "")
        if listed.count("\n") > MAX_FILES:
            raise InputError(f"its list is longer than {MAX_FILES} files")
        names = [line.strip() for line in listed.splitlines() if line.strip()]
        if not names:
            raise InputError("its list of files is empty")
        return [path.parent / name for name in names]
    if "%" in words[0] and len(words) in (4, 5):
        return numbered_files(path.parent, words[0], words[1:4], prod(sizes))
    return [path.parent / text]


def _nrrd_file(
    path: Path, fields: Fields, start: int, size: int, dtype: np.dtype[Any]
) -> StoredBytes:
    """The bytes of one file, from `start` or what the header skips."""
    encoding = fields.get("encoding", "").lower()
    skip = whole(fields, "byte skip")
    start = _after_lines(path, start, whole(fields, "line skip"))
    if encoding == "raw":
        place = path.stat().st_size - size if skip == -1 else start + skip
        return PlainFile(path, start=place, size=size)
    if skip < 0:
        raise InputError("a byte skip of -1 belongs to the encoding raw")
    if encoding in ("txt", "text", "ascii"):
        return NumbersInText(path, dtype, start=start + skip, size=size)
    kind = {"gz": "deflate", "gzip": "deflate", "bz2": "bzip2", "bzip2": "bzip2"}.get(encoding)
    if kind is None:
        raise InputError(f"its encoding is {encoding!r}; raw, gzip, bzip2 and text can be read")
    if skip:
        raise InputError("it skips decompressed bytes, which is not supported")
    return CompressedFile(path, kind, start=start, size=size)


def _after_lines(path: Path, start: int, lines: int) -> int:
    if lines < 1:
        return start
    with path.open("rb") as file:
        file.seek(start)
        for _ in range(lines):
            if not file.readline(MAX_HEADER):
                raise InputError(f"{path} has fewer than the {lines} lines to skip")
        return file.tell()


def _nrrd_coordinates(
    fields: Fields,
    pairs: Mapping[str, str],
    sizes: Sequence[int],
    axes: Sequence[str],
) -> dict[str, Variable]:
    """Coordinates of the axes that the header places."""
    coords = _even(fields, sizes, axes)
    units = re.findall(r'"([^"]*)"', fields.get("units", ""))
    if not units:  # those of space count no other dimension
        units = re.findall(r'"([^"]*)"', fields.get("spaceunits", ""))
        units += [""] * (len(sizes) - len(units))
    for axis, unit in zip(axes, units, strict=False):
        if axis in coords and unit:
            coords[axis] = replace(coords[axis], attributes={"units": unit})
    for axis in AXES:
        length = sizes[axes.index(axis)] if axis in axes else 1
        if f"coordinates_{axis}" in pairs:
            coords[axis] = _exact(pairs, axis, length)
    return coords


def _exact(pairs: Mapping[str, str], axis: str, length: int) -> Variable:
    """A coordinate that a file of this project lists, with its name and units."""
    try:
        values = np.array([float(word) for word in pairs[f"coordinates_{axis}"].split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (length,):
        raise InputError(f"coordinates_{axis} are not {length} numbers")
    extra = {
        key: pairs[f"{key}_{axis}"] for key in ("units", "calendar") if f"{key}_{axis}" in pairs
    }
    return positions(pairs.get(f"name_{axis}") or AXIS_NAMES[axis], values, extra)


def _even(fields: Fields, sizes: Sequence[int], axes: Sequence[str]) -> dict[str, Variable]:
    """Coordinates from directions and origin, else from spacings and minima."""
    coords: dict[str, Variable] = {}
    directions = directions_of(fields, len(sizes))
    count = len(sizes)
    spacings = [number_of(word) for word in words_of(fields, "spacings", count, "nan")]
    minima = [number_of(word) for word in words_of(fields, "axis mins", count, "nan")]
    centred = [word == "cell" for word in words_of(fields, "centerings", count, "???")]
    for place, axis in enumerate(axes):
        if axis and (np.isfinite(spacings[place]) or np.isfinite(minima[place])):
            step = spacings[place] if np.isfinite(spacings[place]) else 1.0
            origin = minima[place] if np.isfinite(minima[place]) else 0.0
            first = 0.5 if centred[place] and np.isfinite(minima[place]) else 0.0
            coords[axis] = lattice(axis, origin, step, sizes[place], first=first)
    if directions is None:
        return coords
    placed = [(axes[place], each) for place, each in enumerate(directions) if each is not None]
    matrix = np.array([each for _, each in placed if len(each) == len(placed)])
    if matrix.shape != (len(placed), len(placed)):
        raise InputError(f"its space directions {fields['space directions']!r} fit no grid")
    order = sorted(range(len(placed)), key=lambda number: "xyzt".find(placed[number][0]))
    steps = axis_steps(matrix[order])
    origins = (vectors(fields.get("space origin", "")) or [None])[0] or (0.0,) * len(placed)
    if len(origins) != len(placed):
        raise InputError(f"its space origin {fields['space origin']!r} fits no grid")
    for number, step, origin in zip(order, steps, origins, strict=True):
        axis = placed[number][0]
        coords[axis] = lattice(axis, float(origin), float(step), sizes[axes.index(axis)])
    return coords


METAIMAGE_SUFFIXES = (".mha", ".mhd")

METAIMAGE_TYPES = {
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

METAIMAGE_MAX_HEADER = 2**20
"""Bytes of the longest header."""


def is_metaimage(head: bytes, path: Path) -> bool:
    """Whether this is a MetaImage: by its suffix, or by the first keys of its header."""
    if path.suffix.lower() in METAIMAGE_SUFFIXES:
        return True
    return re.match(rb"\s*(ObjectType\s*=\s*Image|NDims\s*=\s*\d)", head) is not None


def open_metaimage(path: Path, request: Request) -> Source:
    """The array in a MetaImage or behind its header, or its channels.

    Raises InputError for turned grids, other types than numbers, and files that are cut;
    MissingInputError for a file of values that is not there.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        fields, lines, end = _header(path)
        sizes = _sizes(fields)
        channels = _whole(fields, "ElementNumberOfChannels", 1)
        dtype = _dtype(fields)
        stored, files = _metaimage_values(
            path, fields, lines, end, (*sizes, channels), dtype, request
        )
        shape = (*reversed(sizes), channels)
        names = [AXIS_NAMES[axis] for axis in AXES[-len(sizes) :]]
        whole = Variable(
            name=fields.get("Name", "") or path.stem,
            shape=shape,
            dtype=dtype,
            dimensions=(*names, None),
            read=StoredArray(path, shape, dtype, stored).read,
        )
        arrays = components(whole, len(sizes))
        found = placed(arrays, _metaimage_coordinates(fields, sizes))
    return file_source(path, found, stamp=stamp, files=files, close=stored.close)


def _header(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Fields, the file names that follow a LIST, and the first byte behind the header."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while line := file.readline(METAIMAGE_MAX_HEADER):
            text = decoded_text(line).strip()
            if file.tell() > METAIMAGE_MAX_HEADER:
                raise InputError(f"its header is longer than {METAIMAGE_MAX_HEADER} bytes")
            if not text:
                continue
            key, equals, value = text.partition("=")
            if not equals:
                raise InputError(f"its header has the line {text[:60]!r}")
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                names = []
                if value.split()[:1] == ["LIST"]:
                    rest = decoded_text(file.read(METAIMAGE_MAX_HEADER))
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
    kind = METAIMAGE_TYPES.get(fields.get("ElementType", "").removesuffix("_ARRAY"))
    if kind is None:
        raise InputError(f"its ElementType is {fields.get('ElementType')!r}; numbers can be read")
    big = _flag(fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    return np.dtype((">" if big else "<") + kind)


def _metaimage_values(
    path: Path,
    fields: Fields,
    listed: Sequence[str],
    end: int,
    lengths: Sequence[int],
    dtype: np.dtype[Any],
    request: Request,
) -> tuple[StoredBytes, list[Path]]:
    """The bytes of the values, and the other files that hold them.

    lengths: of the dimensions, with that of the channels at the end.
    """
    size = prod(lengths) * dtype.itemsize
    data = fields["ElementDataFile"]
    if data.upper() == "LOCAL":
        return _metaimage_file(path, fields, end, size, dtype), []
    words = data.split()
    if words[:1] == ["LIST"] and not listed:
        raise InputError("its list of files is empty")
    if len(words) >= 4 and "%" in words[0]:
        files = numbered_files(path.parent, words[0], words[1:4], prod(lengths[:-1]))
    else:
        files = [path.parent / name for name in (listed if words[:1] == ["LIST"] else [data])]
    request.require_inside(path, *files)
    stored = in_files(files, size, lambda file, part: _metaimage_file(file, fields, 0, part, dtype))
    return stored, list(dict.fromkeys(files))


def _metaimage_file(
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


def _metaimage_coordinates(fields: Fields, sizes: Sequence[int]) -> dict[str, Variable]:
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


RAW_NAME = re.compile(
    r"(?:^|_)(?P<shape>\d+x\d+x\d+(?:x\d+)?)_(?P<dtype>[a-z]+\d+)(?:_(?P<endian>be|le))?(?=_|$)",
    re.IGNORECASE,
)
RAW_FORM = "name_XxYxZ[xT]_TYPE[_be].raw, such as density_64x64x32x10_float32.raw"


def is_raw(head: bytes, path: Path) -> bool:
    """Whether this is raw by its suffix; the first bytes are values and say nothing."""
    return path.suffix.lower() == ".raw"


def layout_of_name(stem: str) -> tuple[str, RawLayout]:
    """Variable name and layout in a file name without its suffix; None for each unknown part."""
    match = RAW_NAME.search(stem)
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
            f"{source}: the {missing} of the raw values is not known; name the file {RAW_FORM}, or"
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


NPY_MAGIC = b"\x93NUMPY"


def is_npy(head: bytes, path: Path) -> bool:
    """Whether this is .npy, or .npz, which is refused with advice."""
    return head.startswith(NPY_MAGIC) or path.suffix.lower() == ".npz"


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
