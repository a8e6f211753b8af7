"""Readers of plain values: raw and NPY files, and those behind a text, NRRD and MetaImage."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
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
    KINDS,
    MAX_HEADER,
    MAX_LINE,
    TYPES,
    CompressedFile,
    FlatArray,
    Header,
    ManyFiles,
    NumbersInText,
    PlainFile,
    StoredBytes,
    axis_steps,
    lattice,
    numbers_of,
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
from fhash_formats.support.values import decoded_text, is_number

MAX_DIMENSIONS = 16
"""Dimensions of NRRD."""

MAX_FILES = 1 << 20
"""Files of one array."""

NUMBERED = re.compile(r"([^%\s]*%0?[0-9]{0,2})[du]([^%\s]*)")
"""A pattern of C for the names of files; a wider number would be a name of gigabytes."""

ENCODINGS = {"raw": "raw", "txt": "text", "text": "text", "ascii": "text"}
ENCODINGS |= {"gz": "deflate", "gzip": "deflate", "bz2": "bzip2", "bzip2": "bzip2"}
"""Ways to store values by the names of NRRD: as they are, as text, or by a key of KINDS."""

Fields = Mapping[str, str]


def _opened(
    path: Path, request: Request, header: Callable[[Path], tuple[Fields, Fields, int]]
) -> Source:
    """The array or its components by the fields of NRRD; `header` gives them as `read_header` does.

    Raises InputError where the values cannot be divided among the files, MissingInputError for a
    file that is not there.
    """
    stamp = Stamp.of(path)
    with naming(str(path)):
        fields, pairs, end = header(path)
        sizes, dimension = sizes_of(fields, "sizes"), fields.get("dimension", "")
        if dimension != str(len(sizes)) or len(sizes) > MAX_DIMENSIONS:
            raise InputError(f"it has {len(sizes)} sizes and the dimension {dimension!r}")
        axes, dtype = _axes(fields, pairs, sizes), dtype_of(fields)
        size = prod(sizes) * dtype.itemsize
        files = []
        for name in _names(fields, prod(sizes)):
            files.append(request.beside(path, path.parent / name))
        if files and size % len(files):
            raise InputError(f"its {size} bytes cannot be divided among {len(files)} files")
        parts = [_part(file, fields, dtype, 0, size // len(files)) for file in files]
        if not parts:
            parts = [_part(path, fields, dtype, end, size)]
        stored = ManyFiles(parts) if len(parts) > 1 else parts[0]
        name = fields.get("content", "").strip('" ') or path.stem
        array = FlatArray(path, tuple(reversed(sizes)), dtype, stored=stored)
        whole = array.variable(name, [AXIS_NAMES.get(axis) for axis in reversed(axes)])
        arrays = [replace(whole, attributes=_meaning(str(path), fields, dtype))]
        if "" in axes:
            arrays = components(arrays[0], len(sizes) - 1 - axes.index(""))
        found = placed(arrays, _coordinates(fields, pairs, sizes, axes))
        others = list(dict.fromkeys(files))
    return file_source(path, found, stamp=stamp, files=others, close=stored.close)


def _meaning(source: str, fields: Fields, dtype: np.dtype[Any]) -> dict[str, Any]:
    """Units of the values, and the line that counts of MetaImage stand for.

    Warns (FhashWarning) of NRRD's range before its values were quantised, which is not undone.
    """
    units = fields.get("sample units", "").strip('" ')
    found: dict[str, Any] = {"units": units} if units else {}
    slope, offset = (
        numbers_of(fields.get(name, default), 1)[0]
        for name, default in (("slope", "1"), ("offset", "0"))
    )
    if (slope, offset) != (1, 0):
        if not np.isfinite([slope, offset]).all() or slope == 0:
            raise InputError(f"its values have the slope {slope} and the offset {offset}")
        found |= {"scale_factor": float(slope), "add_offset": float(offset)}
    if dtype.kind in "iu" and {"oldmin", "oldmax"} <= fields.keys():
        ends = f"{fields['oldmin'][:40]} to {fields['oldmax'][:40]}"
        warnings.warn(
            f"{source}: its values were quantised from {ends} (old min, old max); they are read as"
            " the numbers that are stored",
            FhashWarning,
            stacklevel=2,
        )
    return found


def _names(fields: Fields, most: int) -> Iterator[str]:
    """Names of the files of values: of a pattern of C and three numbers, of a list, or of one file.

    There are none where the values are behind the header. most: files that there can be.
    """
    data = fields.get("data file", "")
    form, *words = data.split() or [""]
    if form == "LIST":
        names = [name.strip() for name in fields["list"].splitlines() if name.strip()]
        if not 0 < len(names) <= MAX_FILES:
            raise InputError(f"its list of files is empty, or longer than {MAX_FILES}")
        yield from names
        return
    if "%" not in form or len(words) not in (3, 4):
        yield from [data] if data or "data file" in fields else []
        return
    match, told = NUMBERED.fullmatch(form), f"its pattern of files is {data[:80]!r}"
    if match is None or not all(re.fullmatch(r"-?[0-9]{1,9}", word) for word in words[:3]):
        raise InputError(
            f"{told}; a name with one %d or %03d (two digits at most), the first number, the last"
            " and the stride are needed"
        )
    first, last, stride = map(int, words[:3])
    if stride == 0 or not 0 <= (last - first) // stride < min(most, MAX_FILES):
        raise InputError(f"{told}; 1 to {min(most, MAX_FILES)} numbers are possible here")
    for number in range(first, last + (1 if stride > 0 else -1), stride):
        yield f"{match[1]}d{match[2]}" % number


def _part(path: Path, fields: Fields, dtype: np.dtype[Any], start: int, size: int) -> StoredBytes:
    """The bytes of one file, from `start` or what the header skips."""
    encoding = fields.get("encoding", "").lower()
    if encoding not in ENCODINGS:
        raise InputError(f"its encoding is {encoding!r}; raw, gzip, bzip2 and text can be read")
    kind, skip, lines = ENCODINGS[encoding], whole(fields, "byte skip"), whole(fields, "line skip")
    if lines > 0:
        with Header(path, start) as header:
            if not all(header.line(MAX_HEADER) for _ in range(lines)):
                raise InputError(f"{path} has fewer than the {lines} lines to skip")
            start = header.file.tell()
    if skip < 0 and kind != "raw":
        raise InputError("bytes to skip that are -1 belong to raw values")
    start = path.stat().st_size - size if skip < 0 else start + skip
    if kind in KINDS:
        return CompressedFile(path, kind, start=start, size=size)
    if kind == "text":
        return NumbersInText(path, dtype, start=start, size=size)
    return PlainFile(path, start=start, size=size)


def _lines(header: Header) -> Iterator[str]:
    """The lines of a header; those that list coordinates may be long."""
    while line := header.line(MAX_HEADER):
        text = decoded_text(line).rstrip("\r\n")
        if len(line) > MAX_LINE and ":=" not in text[:MAX_LINE]:
            raise InputError(f"its header has a line of more than {MAX_LINE} bytes")
        yield text


def _parted(line: str, separator: str) -> tuple[str, str]:
    """The key and the value of a line."""
    key, found, value = line.partition(separator)
    if not found:
        raise InputError(f"its header has the line {line[:60]!r}, which is cut or no field")
    return key.strip(), value.strip()


def sizes_of(fields: Fields, name: str) -> tuple[int, ...]:
    """Lengths of the dimensions, the fastest first."""
    words = fields.get(name, "").split()
    if not words or not all(re.fullmatch("0{0,9}[1-9][0-9]{0,17}", word) for word in words):
        raise InputError(
            f"it has the {name} {fields.get(name, '')[:80]!r}; whole numbers above 0 are needed"
        )
    return tuple(map(int, words))


def dtype_of(fields: Fields) -> np.dtype[Any]:
    """The type of the values in the file."""
    kind = TYPES.get(" ".join(fields.get("type", "").lower().split()))
    if kind is None:
        raise InputError(f"its values are of the type {fields.get('type')!r}, which has no numbers")
    is_text = ENCODINGS.get(fields.get("encoding", "").lower()) == "text"
    orderless = is_text or np.dtype(kind).itemsize == 1
    order = fields.get("endian", "little" if orderless else "").lower()
    if order not in ENDIANS:
        raise InputError(f"its byte order is {order!r}; endian: little, or big, is needed")
    return np.dtype(ENDIANS[order] + kind)


def whole(fields: Fields, name: str, default: int = 0, least: int = -1) -> int:
    """A whole number from `least` on; `default` without the field."""
    text = fields.get(name, str(default))
    if not re.fullmatch(r"[-+]?[0-9]{1,18}", text) or int(text) < least:
        raise InputError(f"its {name} is {text[:80]!r}")
    return int(text)


NRRD_SUFFIXES = (".nrrd", ".nhdr")

NAMES = "data file|sample units|axis mins|axis maxs|space directions|space origin|line skip"
NAMES += "|byte skip"
ALIASES = {name.replace(" ", ""): name for name in NAMES.split("|")} | {"centers": "centerings"}
"""Names of fields without blanks, and the usual names."""

SPATIAL = ("domain", "space", "none", "???")
"""Kinds of axes that are positions, or say nothing."""

COLOURS = ("RGB-color", "RGBA-color", "HSV-color", "XYZ-color")


def read_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields, key/value pairs, and the first byte behind the header.

    The field `list` holds the lines of a list of files.
    """
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    with Header(path) as header:
        first = header.line()
        if not re.fullmatch(rb"NRRD000[1-5]\r?\n", first):
            raise InputError(f"it begins with {first[:20]!r}; NRRD0001 to NRRD0005 can be read")
        for line in _lines(header):
            if not line:
                break
            key, separator, value = line.partition(":=")
            if line.startswith("#"):
                continue
            if separator and ": " not in key:
                pairs[key] = value
                continue
            key, value = _parted(line, ":")
            key = re.sub(r"[ _-]", "", key.lower())
            fields[ALIASES.get(key, key)] = value
            if ALIASES.get(key) == "data file" and value.split()[:1] == ["LIST"]:
                fields["list"] = decoded_text(header.file.read(MAX_HEADER))
                break
        else:
            if "data file" not in fields:
                raise InputError("its header has no empty line at its end; it is cut")
        packed = ENCODINGS.get(fields.get("encoding", "").lower()) in KINDS
        if packed and whole(fields, "byte skip"):
            raise InputError("it skips decompressed bytes, which is not supported")
        return fields, pairs, header.file.tell()


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
    for word in re.findall(r"\([^()]*\)|\S+", text):
        parts = "nan" if word == "none" else word.strip("()")
        numbers = numbers_of(parts.replace(",", " "), parts.count(",") + 1)
        found.append(None if np.isnan(numbers).all() else tuple(numbers.tolist()))
    return found


def quoted(text: str) -> list[str]:
    """The texts between quotes, as they are written; a backslash precedes a quote inside."""
    parts = text.replace("\\\\", "\0\0").replace('\\"', "\0\1").split('"')
    return [each.replace("\0\1", '\\"').replace("\0\0", "\\\\") for each in parts[1:-1:2]]


def is_nrrd(head: bytes, path: Path) -> bool:
    """Whether this is NRRD."""
    return head.startswith(b"NRRD000")


def open_nrrd(path: Path, request: Request) -> Source:
    """The array in a NRRD file or behind a NRRD header, or its components.

    Raises InputError for colours, turned grids, more than four dimensions, and files that are cut;
    MissingInputError for a file of values that is not there.
    """
    return _opened(path, request, read_header)


def _axes(fields: Fields, pairs: Fields, sizes: Sequence[int]) -> list[str]:
    """The axis of each dimension (fastest first), "" for that of components.

    The file's kinds, labels and space directions say which dimension is time or components; the
    others are x, y and z in their order. A list with the type or the values of an index is a
    sequence of 3D Slicer, and time.
    """
    directions = directions_of(fields, len(sizes))
    kinds = words_of(fields, "kinds", len(sizes), "domain")
    axes = [""] * len(sizes)
    vector = None
    labels = quoted(fields.get("labels", ""))
    space = fields.get("space", "")
    sequences = [
        place
        for place in range(len(sizes))
        if any(f"axis {place} index {key}" in pairs for key in ("type", "values"))
    ]
    for place, kind in enumerate(kinds):
        label = labels[place] if len(labels) == len(sizes) else ""
        if kind in COLOURS:
            raise InputError(f"its values are colours ({kind}); one number a vertex can be read")
        named = kind in (*SPATIAL, "list") and role_of_name(label) == "t"
        listed = kind == "list" and (place in sequences or (place == 3 and vector is None))
        if kind == "time" or named or listed:
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
    return axes


def _coordinates(
    fields: Fields, pairs: Fields, sizes: Sequence[int], axes: Sequence[str]
) -> dict[str, Variable]:
    """Coordinates of the axes that the header places."""
    coords = _even(fields, sizes, axes)
    units = re.findall(r'"([^"]*)"', fields.get("units", ""))
    if not units:  # those of space count no other dimension
        units = re.findall(r'"([^"]*)"', fields.get("spaceunits", ""))
    for axis, unit in zip(axes, units, strict=False):
        if axis in coords and unit:
            coords[axis] = replace(coords[axis], attributes={"units": unit})
    if "t" in axes:
        coords |= _sequence(pairs, axes.index("t"), sizes[axes.index("t")])
    for axis in AXES:  # those that a file of this project lists, with their names and units
        if f"coordinates_{axis}" in pairs:
            length = sizes[axes.index(axis)] if axis in axes else 1
            values = numbers_of(pairs[f"coordinates_{axis}"], length)
            told = {key: pairs.get(f"{key}_{axis}") for key in ("units", "calendar")}
            extra = {key: text for key, text in told.items() if text is not None}
            name = pairs.get(f"name_{axis}") or AXIS_NAMES[axis]
            coords[axis] = positions(name, values, extra)
    return coords


def _sequence(pairs: Fields, place: int, length: int) -> dict[str, Variable]:
    """The times of a sequence of 3D Slicer along a dimension; none where they are no numbers."""
    words = unquote(pairs.get(f"axis {place} index values", "")).split()
    if len(words) != length or not all(map(is_number, words)):
        return {}
    unit = pairs.get(f"axis {place} index unit", "").strip('" ')
    values = [float(word) for word in words]
    return {"t": positions(AXIS_NAMES["t"], values, {"units": unit} if unit else {})}


def _even(fields: Fields, sizes: Sequence[int], axes: Sequence[str]) -> dict[str, Variable]:
    """Coordinates from directions and origin, else from spacings and minima."""
    coords: dict[str, Variable] = {}
    count = len(sizes)
    spacings = numbers_of(fields.get("spacings", "nan " * count), count)
    minima = numbers_of(fields.get("axis mins", "nan " * count), count)
    maxima = numbers_of(fields.get("axis maxs", "nan " * count), count)
    centres = words_of(fields, "centerings", count, "???")
    lines = zip(axes, spacings, minima, maxima, sizes, centres, strict=True)
    for axis, step, low, high, length, centre in lines:
        if axis and np.isfinite([step, low]).any():
            first = 0.5 if centre == "cell" and np.isfinite(low) else 0.0
            if not np.isfinite(step) and np.isfinite(high):
                step = (high - low) / max(1, length - (centre != "cell"))
            start, by = low if np.isfinite(low) else 0.0, step if np.isfinite(step) else 1.0
            coords[axis] = lattice(axis, start, by, length, first=first)
    directions = directions_of(fields, count)
    if directions is None:
        return coords
    given = [(axis, each) for axis, each in zip(axes, directions, strict=True) if each is not None]
    given.sort(key=lambda pair: "xyzt".find(pair[0]))
    origins = (vectors(fields.get("space origin", "")) or [None])[0] or (0.0,) * len(given)
    if {len(each) for _, each in given} != {len(given)} or len(origins) != len(given):
        raise InputError(f"its space directions {fields['space directions']!r} fit no grid")
    steps = axis_steps(np.array([each for _, each in given]))
    for (axis, _), step, origin in zip(given, steps, origins, strict=True):
        coords[axis] = lattice(axis, origin, float(step), sizes[axes.index(axis)])
    return coords


METAIMAGE_SUFFIXES = (".mha", ".mhd")


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
    return _opened(path, request, _metaimage_header)


def _metaimage_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """The header in the fields of NRRD, no pairs, and the first byte behind it."""
    fields: dict[str, str] = {}
    with Header(path) as header:
        for line in _lines(header):
            key, value = _parted(line, "=") if line.strip() else ("", "")
            fields[key] = value
            if key == "ElementDataFile":
                if value.split()[:1] == ["LIST"]:
                    fields["list"] = decoded_text(header.file.read(MAX_HEADER))
                break
        end = header.file.tell()
    if "ElementDataFile" not in fields:
        raise InputError("its header has no ElementDataFile; the file is cut or no MetaImage")
    if fields.get("ObjectType", "Image") != "Image":
        raise InputError(f"its ObjectType is {fields['ObjectType']!r}; Image can be read")
    count = len(fields.get("DimSize", "").split())
    if count not in (2, 3, 4) or fields.get("NDims") != str(count):
        raise InputError(
            f"it has NDims = {fields.get('NDims')} and DimSize = {fields.get('DimSize')};"
            " 2, 3 or 4 dimensions can be read"
        )
    spacing = numbers_of(_first(fields, "ElementSpacing ElementSize", "1 " * count), count)
    origin = numbers_of(_first(fields, "Offset Position Origin", "0 " * count), count)
    identity = " ".join(map(str, np.eye(count).ravel()))
    matrix = _first(fields, "TransformMatrix Rotation Orientation", identity)
    turn = numbers_of(matrix, count * count).reshape(count, count)
    if not np.isfinite([*spacing, *origin, *turn.ravel()]).all():
        raise InputError("its spacing, its origin or its matrix is not finite")
    channels = whole(fields, "ElementNumberOfChannels", 1, 1)
    big = _is_true(fields, "BinaryDataByteOrderMSB ElementByteOrderMSB")
    plain = "raw" if _is_true(fields, "BinaryData", "True") else "text"
    data = fields["ElementDataFile"]
    found = {
        "content": fields.get("Name", ""),
        "dimension": str(count + 1),
        "sizes": f"{channels} {fields['DimSize']}",
        "kinds": " ".join(["vector", "domain", "domain", "domain", "time"][: count + 1]),
        "type": fields.get("ElementType", "").removesuffix("_ARRAY"),
        "endian": "big" if big else "little",
        "encoding": "gzip" if _is_true(fields, "CompressedData") else plain,
        "byte skip": fields.get("HeaderSize", "0"),
        "slope": fields.get("ElementToIntensityFunctionSlope", "1"),
        "offset": fields.get("ElementToIntensityFunctionOffset", "0"),
        "space directions": " ".join(["none", *map(_vector, spacing[:, None] * turn)]),
        "space origin": _vector(origin),
        "list": fields.get("list", ""),
    }
    return found | ({} if data.upper() == "LOCAL" else {"data file": data}), {}, end


def _vector(numbers: npt.NDArray[np.float64]) -> str:
    return f"({','.join(map(repr, numbers.tolist()))})"


def _first(fields: Fields, names: str, default: str) -> str:
    """The first field of several names that is there."""
    return next((fields[name] for name in names.split() if name in fields), default)


def _is_true(fields: Fields, names: str, default: str = "False") -> bool:
    return _first(fields, names, default).lower() in ("true", "1", "yes")


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
    lengths, dtype_name = given.shape or named.shape, given.dtype or named.dtype
    endian = given.endian or named.endian or "little"
    if lengths is None or dtype_name is None:
        missing = " and ".join(
            word for word, value in (("shape", lengths), ("type", dtype_name)) if value is None
        )
        header, form = path.with_suffix(".nhdr"), f"name the file {RAW_FORM}, or give"
        advice = f"{header} may say it: give that file instead, or" if header.is_file() else form
        raise InputError(
            f"{source}: the {missing} of the raw values is not known; {advice}"
            " --shape x=..,y=..,z=.. and --dtype"
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
        frames = "t" not in lengths and stamp.size % array.end == 0
        advice = f"; with t={stamp.size // array.end} the size would fit" if frames else ""
        layout = f"{'x'.join(map(str, shape))} ({','.join(axes)}) of {dtype.name}"
        raise InputError(
            f"{source} has {stamp.size} bytes; {layout} need exactly {array.end}{advice}"
        )
    return file_source(path, [array.variable(name, axes)], stamp=stamp)


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
    with refusing(f"{source} cannot be read as .npy: it is cut, or damaged"):
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
    values = array.variable(path.stem)
    if fortran:  # time is the fastest dimension: all steps are read together
        values = replace(
            values,
            shape=shape,
            read=lambda places: array.read(places[::-1]).transpose(),
            chunks=shape,
        )
    return file_source(path, [values], stamp=stamp)
