"""Readers of volumes behind a short header: NIfTI, MRC, OpenDX, legacy VTK and SEG-Y."""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError, MissingInputError
from fhash_formats.readers.file_series import Request, Stamp, library, naming
from fhash_formats.readers.stored_bytes import (
    GZIP,
    CompressedFile,
    NumbersInText,
    PlainFile,
    StoredArray,
    StoredBytes,
    axis_steps,
    lattice,
    numbers_of,
)
from fhash_formats.readers.variables import (
    Source,
    Variable,
    by_ranges,
    components,
    file_source,
    placed,
    positions,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import decoded_text

PACKED_SUFFIX = ".gz"
HEAD_BYTES = 1 << 13
"""Stored bytes in which a compressed header is."""


def _head(path: Path, count: int) -> tuple[bytes, bool]:
    """The first bytes of a file, of its true ones where it is compressed, and whether it is."""
    with path.open("rb") as file:
        data = file.read(HEAD_BYTES)
    return _inflated(data)[:count], data[:2] == GZIP


def _inflated(head: bytes) -> bytes:
    """The first true bytes of a file that may be compressed; none where it is damaged."""
    try:
        return zlib.decompressobj(wbits=47).decompress(head) if head[:2] == GZIP else head
    except zlib.error:
        return b""


def _array(
    path: Path, packed: bool, shape: tuple[int, ...], dtype: np.dtype[Any], start: int
) -> StoredArray:
    """The array that begins at a byte of a file, or of its true bytes."""
    end = start + prod(shape) * dtype.itemsize
    stored: StoredBytes = (
        CompressedFile(path, "deflate", start=0, size=end)
        if packed
        else PlainFile(path, start=0, size=end)
    )
    return StoredArray(path, shape, dtype, stored, offset=start)


NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr")

NIFTI_TYPES = {
    2: "u1",
    4: "i2",
    8: "i4",
    16: "f4",
    32: "c8",
    64: "f8",
    256: "i1",
    512: "u2",
    768: "u4",
    1024: "i8",
    1280: "u8",
    1792: "c16",
}
"""Number types by their code (nifti1.h)."""

NIFTI_LENGTHS = {1: "m", 2: "mm", 3: "um"}
NIFTI_TIMES = {8: "s", 16: "ms", 24: "us"}
"""Units by their code in xyzt_units."""

NIFTI_1 = """sizeof_hdr:i4 skip:S36 dim:8i2 intent_p:3f4 intent_code:i2 datatype:i2 bitpix:i2
slice_start:i2 pixdim:8f4 vox_offset:f4 scl_slope:f4 scl_inter:f4 slice_end:i2 slice_code:i1
xyzt_units:i1 cal:2f4 slice_duration:f4 toffset:f4 gl:2i4 descrip:S80 aux_file:S24 qform_code:i2
sform_code:i2 quatern:3f4 qoffset:3f4 srow:12f4 intent_name:S16 magic:S4"""
NIFTI_2 = """sizeof_hdr:i4 magic:S8 datatype:i2 bitpix:i2 dim:8i8 intent_p:3f8 pixdim:8f8
vox_offset:i8 scl_slope:f8 scl_inter:f8 cal:2f8 slice_duration:f8 toffset:f8 slice_start:i8
slice_end:i8 descrip:S80 aux_file:S24 qform_code:i4 sform_code:i4 quatern:3f8 qoffset:3f8 srow:12f8
slice_code:i4 xyzt_units:i4 intent_code:i4 intent_name:S16"""
"""Fields of the headers in their order (nifti1.h, nifti2.h)."""


def _fields(form: str, data: bytes, order: str) -> Any:
    """The fields of a header, as a numpy record."""
    parts = []
    for field in form.split():
        name, _, kind = field.partition(":")
        match = re.fullmatch(r"(\d*)([ifS])(\d+)", kind)
        assert match is not None
        letter = f"{match[2]}{match[3]}"
        parts.append((name, order + letter if match[2] != "S" else letter, int(match[1] or 1)))
    dtype = np.dtype([(name, kind) if n == 1 else (name, kind, (n,)) for name, kind, n in parts])
    if len(data) < dtype.itemsize:
        raise InputError(f"its header has {len(data)} bytes, {dtype.itemsize} are needed")
    return np.frombuffer(data[: dtype.itemsize], dtype)[0]


def is_nifti(head: bytes, path: Path) -> bool:
    """Whether this is NIfTI, compressed or not, by the size of its header and its magic."""
    head = _inflated(head)
    size = {head[:4], head[3::-1]} & {b"\x5c\x01\0\0", b"\x1c\x02\0\0"}
    return bool(size) and (head[344:347] in (b"n+1", b"ni1") or head[4:7] in (b"n+2", b"ni2"))


def open_nifti(path: Path, request: Request) -> Source:
    """The array of a NIfTI-1 or NIfTI-2 file, or of a pair .hdr and .img.

    Scaled values are packed ones; the affine of the scanner gives positions where it is along the
    axes, else these are along the axes of the array, and a warning (FhashWarning) says so.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        data, packed = _head(path, 540)
        little = int.from_bytes(data[:4], "little")
        big = int.from_bytes(data[:4], "big")
        size = little if little in (348, 540) else big
        if size not in (348, 540):
            raise InputError(f"its header says that it has {little} bytes; NIfTI has 348 or 540")
        order = "<" if size == little else ">"
        header = _fields(NIFTI_1 if size == 348 else NIFTI_2, data, order)
        count = int(header["dim"][0])
        if not 1 <= count <= 7 or (header["dim"][1 : count + 1] < 1).any():
            raise InputError(f"its dimensions are {header['dim'].tolist()}")
        sizes = [int(n) for n in header["dim"][1 : count + 1]]
        while len(sizes) > 2 and sizes[-1] == 1:
            sizes.pop()
        kind = NIFTI_TYPES.get(int(header["datatype"]))
        if kind is None:
            raise InputError(f"its values are of type {int(header['datatype'])}, no numbers")
        dtype = np.dtype(order + kind)
        pair = header["magic"][:2] == b"ni"
        file = path.with_suffix(".img") if pair else path
        if not file.is_file():
            raise MissingInputError(f"its values are in {file}, which is not there")
        offset = max(int(header["vox_offset"]), 0 if pair else size)
        shape = tuple(reversed(sizes))
        array = _array(file, packed, shape, dtype, offset)
        names = ["x", "y", "z", AXIS_NAMES["t"]][: len(sizes)]
        extra = [f"dim{n}" for n in range(5, len(sizes) + 1)]
        whole = Variable(
            name=_stem(path),
            shape=shape,
            dtype=dtype,
            dimensions=tuple(reversed([*names, *extra])),
            attributes=_nifti_attributes(header),
            read=array.read,
        )
        vector = len(sizes) == 5
        arrays = components(whole, 0, interleaved=False) if vector else [whole]
        if vector and sizes[3] == 1:
            arrays = [each for one in arrays for each in components(one, 0, interleaved=False)]
        found = placed(arrays, _nifti_positions(source, header, sizes))
    files = [file] if pair else []
    return file_source(path, found, stamp=stamp, files=files, close=array.stored.close)


def _stem(path: Path) -> str:
    """The name of a file without its suffixes."""
    return path.name.removesuffix(PACKED_SUFFIX).rpartition(".")[0] or path.name


def _nifti_attributes(header: Any) -> dict[str, Any]:
    """Scale, offset and description of the values."""
    slope, inter = float(header["scl_slope"]), float(header["scl_inter"])
    found: dict[str, Any] = {}
    if np.isfinite([slope, inter]).all() and slope != 0 and (slope, inter) != (1, 0):
        found = {"scale_factor": slope, "add_offset": inter}
    told = decoded_text(bytes(header["descrip"]).split(b"\0")[0]).strip()
    return found | ({"long_name": told} if told.isprintable() and told else {})


def _affine(header: Any) -> npt.NDArray[np.float64]:
    """The affine (3, 4) of the array: sform, else qform, else the spacings."""
    if header["sform_code"] > 0:
        return np.asarray(header["srow"], np.float64).reshape(3, 4)
    step = np.asarray(header["pixdim"], np.float64)
    step[1:4] = np.where(step[1:4] > 0, step[1:4], 1.0)
    if header["qform_code"] <= 0:
        return np.hstack([np.diag(step[1:4]), np.zeros((3, 1))])
    b, c, d = (float(n) for n in header["quatern"])
    a = np.sqrt(max(0.0, 1 - (b * b + c * c + d * d)))
    turn = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    lengths = step[1:4] * [1, 1, -1 if step[0] < 0 else 1]
    return np.hstack([turn * lengths, np.asarray(header["qoffset"], np.float64).reshape(3, 1)])


def _nifti_positions(source: str, header: Any, sizes: Sequence[int]) -> dict[str, Variable]:
    units = int(header["xyzt_units"])
    length, time = NIFTI_LENGTHS.get(units & 7, ""), NIFTI_TIMES.get(units & 0x38, "")
    affine = _affine(header)
    try:
        steps, origin = axis_steps(affine[:, :3]), affine[:, 3]
        if (steps == 0).any():
            raise InputError("a spacing is 0")
    except InputError:
        steps, origin = np.linalg.norm(affine[:, :3], axis=0), np.zeros(3)
        steps = np.where((steps > 0) & np.isfinite(steps), steps, 1.0)
        warnings.warn(
            f"{source}: its axes are turned against those of the scanner; positions are along its"
            " own axes, from 0 on",
            FhashWarning,
            stacklevel=2,
        )
    found = {
        axis: lattice(axis, origin[n], steps[n], sizes[n], units=length)
        for n, axis in enumerate("xyz"[: len(sizes)])
    }
    step = float(header["pixdim"][4])
    if len(sizes) > 3 and np.isfinite(step) and step > 0:
        found["t"] = lattice("t", float(header["toffset"]), step, sizes[3], units=time)
    return found


MRC_SUFFIXES = (".mrc", ".map", ".ccp4", ".rec", ".mrcs", ".st")

MRC_TYPES = {0: "i1", 1: "i2", 2: "f4", 4: "c8", 6: "u2", 12: "f2"}
"""Number types by the mode (MRC2014)."""


def is_mrc(head: bytes, path: Path) -> bool:
    """Whether this is MRC or CCP4, compressed or not, by the letters MAP at byte 208."""
    return _inflated(head)[208:212] in (b"MAP ", b"MAP\0")


def open_mrc(path: Path, request: Request) -> Source:
    """The density of an MRC2014 or CCP4 map, positions in angstrom.

    Raises InputError for other modes and axes, and for files that are cut.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        head, packed = _head(path, 1024)
        if len(head) < 1024:
            raise InputError("it is shorter than its header of 1024 bytes")
        order = ">" if head[212:213] == b"\x11" else "<"
        words = np.frombuffer(head[:1024], f"{order}i4")
        floats = np.frombuffer(head[:1024], f"{order}f4").astype(np.float64)
        sizes, kind = [int(n) for n in words[:3]], MRC_TYPES.get(int(words[3]))
        if kind is None or min(sizes) < 1 or words[23] < 0:
            raise InputError(f"its sizes are {sizes} and its mode {int(words[3])}")
        letters = ["xyz"[n - 1] if 1 <= n <= 3 else "?" for n in words[16:19].tolist()]
        if set(letters) != set("xyz"):
            letters = ["x", "y", "z"]  # of programs that leave them out
        dtype = np.dtype(order + kind)
        shape = tuple(reversed(sizes))
        array = _array(path, packed, shape, dtype, 1024 + int(words[23]))
        whole = Variable(
            name=_stem(path),
            shape=shape,
            dtype=dtype,
            dimensions=tuple(reversed(letters)),
            read=array.read,
        )
        coords = {}
        for n, axis in enumerate("xyz"):
            cells, cell = int(words[7 + n]), floats[10 + n]
            column = letters.index(axis)
            step = cell / cells if cells > 0 and np.isfinite(cell) and cell > 0 else 1.0
            unit = "angstrom" if step != 1.0 or cell > 0 else ""
            origin = floats[49 + n] if np.isfinite(floats[49 + n]) else 0.0
            first = int(words[4 + column]) if origin == 0 else 0
            coords[axis] = lattice(axis, origin, step, sizes[column], first=first, units=unit)
    return file_source(path, placed([whole], coords), stamp=stamp, close=array.stored.close)


DX_SUFFIXES = (".dx",)
MAX_DX_HEADER = 1 << 20
"""Bytes of the longest header of OpenDX."""
DX_TYPES = {"float": "f4", "double": "f8", "int": "i4", "short": "i2", "byte": "u1"}
DX_NUMBER = r"[-+0-9.eE]+"


def is_dx(head: bytes, path: Path) -> bool:
    """Whether this is OpenDX: its first object is a grid of positions."""
    return re.match(rb"(\s*#[^\n]*\n|\s)*object\s+\S+\s+class\s+gridpositions", head) is not None


def open_dx(path: Path, request: Request) -> Source:
    """The values of an OpenDX grid (APBS, VMD, Chimera): z is the fastest, as text or as bytes.

    Raises InputError for grids that are turned, and files that are cut.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        with path.open("rb") as file:
            data = file.read(MAX_DX_HEADER)
        text = decoded_text(data)
        counts = re.search(r"class\s+gridpositions\s+counts\s+(\d+)\s+(\d+)\s+(\d+)", text)
        array = re.search(
            r"class\s+array\s+type\s+(\w+)[^\n]*?items\s+(\d+)([^\n]*?)data\s+follows[^\n]*\n", text
        )
        if counts is None or array is None or array[1].lower() not in DX_TYPES:
            raise InputError("it holds no grid of positions with an array of numbers that follows")
        sizes = [int(counts[n]) for n in (1, 2, 3)]
        if prod(sizes) != int(array[2]) or not prod(sizes):
            raise InputError(
                f"its grid has {prod(sizes)} positions, and its array {array[2]} items"
            )
        header = text[: array.start()]
        origin = _dx_numbers(header, "origin")[:1] or [[0.0, 0.0, 0.0]]
        deltas = _dx_numbers(header, "delta") or np.eye(3).tolist()
        if len(deltas) != 3:
            raise InputError(f"it has {len(deltas)} deltas, not 3")
        steps = axis_steps(np.array(deltas))
        order = "<" if "lsb" in array[3] or "lsb" in array[1] else ">"
        dtype = np.dtype(order + DX_TYPES[array[1].lower()])
        start = len(text[: array.end()].encode())
        size = prod(sizes) * dtype.itemsize
        stored: StoredBytes
        if re.search("binary|ieee", array[0]):
            stored = PlainFile(path, start=start, size=size)
        else:
            with path.open("rb") as file:
                file.seek(start)
                stop = _end_of_numbers(file)
            stored = NumbersInText(path, dtype, start=start, size=size, stop=stop)
        whole = Variable(
            name=path.stem,
            shape=tuple(sizes),
            dtype=dtype,
            dimensions=("x", "y", "z"),
            read=StoredArray(path, tuple(sizes), dtype, stored).read,
        )
        coords = {
            axis: lattice(axis, origin[0][n], steps[n], sizes[n]) for n, axis in enumerate("xyz")
        }
    return file_source(path, placed([whole], coords), stamp=stamp, close=stored.close)


def _dx_numbers(text: str, key: str) -> list[list[float]]:
    """The three numbers of each line of a key."""
    found = re.findall(rf"\b{key}\s+({DX_NUMBER}\s+{DX_NUMBER}\s+{DX_NUMBER})", text)
    return [numbers_of(each, 3).tolist() for each in found]


def _end_of_numbers(file: BinaryIO) -> int:
    """The place of the next line that begins with a word, or of the end; the file is there then."""
    place = file.tell()
    while line := file.readline():
        first = line.split(maxsplit=1)[:1]
        if first and first[0][:1].isalpha() and first[0].lower() not in (b"nan", b"inf"):
            break
        place = file.tell()
    file.seek(place)
    return place


LEGACY_SUFFIXES = (".vtk",)
LEGACY_TYPES = {
    "unsigned_char": "u1",
    "char": "i1",
    "unsigned_short": "u2",
    "short": "i2",
    "unsigned_int": "u4",
    "int": "i4",
    "unsigned_long": "u8",
    "long": "i8",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "float": "f4",
    "double": "f8",
}
LEGACY_TIMES = ("TIME", "TimeValue")
"""Names of fields that hold the time: VisIt's and ParaView's."""
MAX_LINE = 4096


@dataclass(frozen=True, kw_only=True)
class _LegacyArray:
    """An array of a legacy file: its section ("POINT_DATA" and so on), name, and values."""

    section: str
    name: str
    count: int
    components: int
    dtype: np.dtype[Any]
    stored: StoredBytes


def is_legacy_vtk(head: bytes, path: Path) -> bool:
    """Whether this is a legacy VTK file."""
    return head.startswith(b"# vtk DataFile")


def open_legacy_vtk(path: Path, request: Request) -> Source:
    """The arrays of structured points or a rectilinear grid in a legacy VTK file.

    The time is that of a field TIME or TimeValue, or of a title such as "time= 0.5". Raises
    InputError for other grids, and files that are cut.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        reader = _LegacyReader(path)
        arrays, lines = reader.arrays, reader.positions()
        found: list[Variable] = []
        for section, cells in (("POINT_DATA", False), ("CELL_DATA", True)):
            space = tuple(max(n - 1, 1) if cells else n for n in reversed(reader.sizes))
            here = [each for each in arrays if each.section == section]
            names = [each.name for each in arrays]
            whole = [
                _legacy_variable(path, each, space, names.count(each.name) > 1) for each in here
            ]
            coords = {
                axis: positions(axis, _centres(values) if cells else values)
                for axis, values in lines.items()
            }
            if reader.time is not None:
                coords["t"] = positions(AXIS_NAMES["t"], [reader.time])
            parts = [each for one in whole for each in components(one, len(AXES[1:]))]
            found += placed(parts, coords, f"header/{section}")
    return file_source(path, found, stamp=stamp)


def _centres(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The centres of the cells between positions."""
    return (values[:-1] + values[1:]) / 2 if len(values) > 1 else values


def _legacy_variable(
    path: Path, array: _LegacyArray, space: tuple[int, ...], shared: bool
) -> Variable:
    if array.count != prod(space):
        raise InputError(f"the array {array.name} has {array.count} values, the grid {prod(space)}")
    shape = (*space, array.components)
    return Variable(
        name=f"{array.section}/{array.name}" if shared else array.name,
        shape=shape,
        dtype=array.dtype,
        dimensions=AXES[1:],
        read=StoredArray(path, shape, array.dtype, array.stored).read,
    )


class _LegacyReader:
    """Reads the header of a legacy file, and notes where its arrays are.

    Attributes:
        sizes: points along x, y and z.
        arrays: of points and cells.
        time: of the grid; None without one.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.sizes = path, (0, 0, 0)
        self.time: float | None = None
        self.arrays: list[_LegacyArray] = []
        self._lines: dict[str, npt.NDArray[np.float64]] = {}
        self._origin, self._spacing = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
        self._section, self._count = "", 0
        with path.open("rb") as self._file:
            self._file.readline(MAX_LINE)
            title = decoded_text(self._file.readline(MAX_LINE))
            self._text = self._words()[:1] == ["ASCII"]
            kind = self._words()
            if kind[:1] != ["DATASET"] or kind[1:2] not in (
                ["STRUCTURED_POINTS"],
                ["RECTILINEAR_GRID"],
            ):
                raise InputError(
                    f"it holds VTK data of the kind {' '.join(kind[1:2]) or '?'};"
                    " STRUCTURED_POINTS and RECTILINEAR_GRID can be read (in ParaView, the filter"
                    " ResampleToImage makes them of other data)"
                )
            self._even = kind[1] == "STRUCTURED_POINTS"
            while words := self._words():
                self._take(words)
        match = re.search(r"time\s*[=:]\s*([-+0-9.eE]+)", title)
        if self.time is None and match is not None:
            self.time = float(numbers_of(match[1], 1)[0])
        if min(self.sizes) < 1:
            raise InputError(f"its dimensions are {self.sizes}")

    def positions(self) -> dict[str, npt.NDArray[np.float64]]:
        """Positions of the points along x, y and z."""
        if self._even:
            return {
                axis: lattice(axis, self._origin[n], self._spacing[n], self.sizes[n]).whole()
                for n, axis in enumerate("xyz")
            }
        for n, axis in enumerate("xyz"):
            if len(self._lines.get(axis, ())) != self.sizes[n]:
                raise InputError(f"its coordinates along {axis} are not {self.sizes[n]}")
        return self._lines

    def _words(self) -> list[str]:
        """The words of the next line that has any; none at the end."""
        while line := self._file.readline(MAX_LINE):
            if words := decoded_text(line).split():
                return words
        return []

    def _take(self, words: Sequence[str]) -> None:
        """Read what a line begins."""
        key = words[0].upper()
        if key == "DIMENSIONS":
            x, y, z = (int(n) for n in _numbers(words, 3))
            self.sizes = (x, y, z)
        elif key == "ORIGIN":
            self._origin = _numbers(words, 3)
        elif key in ("SPACING", "ASPECT_RATIO"):
            self._spacing = _numbers(words, 3)
        elif key.endswith("_COORDINATES") and len(words) == 3:
            array = self._array(words[0], int(words[1]), 1, words[2])
            self._lines[key[0].lower()] = _whole(array)
        elif key in ("POINT_DATA", "CELL_DATA"):
            self._section, self._count = key, int(_numbers(words, 1)[0])
        elif key == "FIELD" and len(words) == 3:
            self._fields(int(words[2]))
        elif key == "METADATA":
            while self._file.readline(MAX_LINE).strip():
                pass  # up to an empty line
        elif key == "SCALARS" and len(words) in (3, 4):
            count = int(words[3]) if len(words) == 4 else 1
            place = self._file.tell()
            if self._words()[:1] != ["LOOKUP_TABLE"]:
                self._file.seek(place)
            self._keep(self._array(words[1], self._count, count, words[2]))
        elif key in ("VECTORS", "NORMALS", "TENSORS") and len(words) == 3:
            count = 9 if key == "TENSORS" else 3
            self._keep(self._array(words[1], self._count, count, words[2]))
        elif key == "LOOKUP_TABLE" and len(words) == 3:
            self._array(words[1], int(words[2]), 4, "float" if self._text else "unsigned_char")
        else:
            raise InputError(f"it has the line {' '.join(words)[:60]!r}, which is not known")

    def _keep(self, array: _LegacyArray) -> None:
        self.arrays.append(array)

    def _fields(self, count: int) -> None:
        for _ in range(count):
            words = self._words()
            if words[:1] == ["METADATA"]:
                self._take(words)
                words = self._words()
            if len(words) != 4:
                raise InputError(f"a field begins with {' '.join(words)[:60]!r}")
            array = self._array(words[0], int(words[2]), int(words[1]), words[3])
            if self._section:
                self._keep(array)
            elif words[0] in LEGACY_TIMES and array.count * array.components == 1:
                self.time = float(_whole(array)[0])

    def _array(self, name: str, count: int, parts: int, kind: str) -> _LegacyArray:
        """An array whose values begin here; the file is behind them then."""
        short = LEGACY_TYPES.get(kind.lower())
        if short is None:
            raise InputError(f"the array {name} is of type {kind}, no numbers")
        if count < 0 or parts < 1:
            raise InputError(f"the array {name} has {count} values of {parts} parts")
        dtype, start = np.dtype(f">{short}"), self._file.tell()
        size = count * parts * dtype.itemsize
        stored: StoredBytes
        if self._text:
            stop = _end_of_numbers(self._file)
            stored = NumbersInText(self.path, dtype, start=start, size=size, stop=stop)
        else:
            stored = PlainFile(self.path, start=start, size=size)
            self._file.seek(start + size)
        return _LegacyArray(
            section=self._section,
            name=name.replace("%20", " "),
            count=count,
            components=parts,
            dtype=dtype,
            stored=stored,
        )


def _whole(array: _LegacyArray) -> npt.NDArray[np.float64]:
    """All values of an array, which is small."""
    found = np.empty(array.count * array.components, array.dtype)
    array.stored.readinto(0, found.view(np.uint8).data)
    return found.astype(np.float64)


def _numbers(words: Sequence[str], count: int) -> list[float]:
    """The numbers behind the first word of a line."""
    numbers: list[float] = numbers_of(" ".join(words[1 : count + 1]), count).tolist()
    return numbers


SEGY_SUFFIXES = (".sgy", ".segy")
LINES = {"inline": 189, "crossline": 193}
"""Bytes of the numbers of lines in the header of a trace (SEG-Y revision 1)."""


def is_segy(head: bytes, path: Path) -> bool:
    """Whether this is SEG-Y by its suffix: its first bytes are any text."""
    return path.suffix.lower() in SEGY_SUFFIXES


def open_segy(path: Path, request: Request) -> Source:
    """The traces of a SEG-Y file: inlines along y, crosslines along x, samples in ms along z.

    Those of one line are along x. Raises MissingDependencyError without segyio, and InputError for
    traces that make no regular grid, or were not stacked.
    """
    source, stamp = str(path), Stamp.of(path)
    segyio = library(source, "SEG-Y", "segyio", "fhash[segy]")
    with naming(source):
        file = segyio.open(source, ignore_geometry=True)
    try:
        with naming(source):
            found = _traces(path, file)
    except BaseException:
        file.close()
        raise
    return file_source(path, found, stamp=stamp, close=file.close)


def _traces(path: Path, file: Any) -> list[Variable]:
    told = {name: file.attributes(byte)[:] for name, byte in LINES.items()}
    lines = {name: np.array(list(dict.fromkeys(each.tolist()))) for name, each in told.items()}
    if len(lines["inline"]) == 1 and len(lines["crossline"]) < file.tracecount:
        lines = {"inline": lines["inline"], "trace": np.arange(file.tracecount)}
    elif len(np.unique(told["inline"][: len(lines["crossline"])])) > 1:
        lines = dict(reversed(lines.items()))  # one crossline after the other
    columns = lines | {"sample": file.samples}
    shape = tuple(len(each) for each in columns.values())
    regular = prod(shape[:-1]) == file.tracecount and all(
        np.array_equal(told[name].reshape(shape[:-1]), grid)
        for name, grid in zip(lines, np.meshgrid(*lines.values(), indexing="ij"), strict=True)
        if name in told
    )
    if not regular:
        raise InputError(
            f"its {file.tracecount} traces make no regular grid of lines {shape[:-1]}, or are not"
            " stacked"
        )

    def get(ranges: list[range]) -> npt.NDArray[Any]:
        slow, fast, samples = ranges
        raw, kept = file.trace.raw, slice(samples.start, samples.stop)
        starts = [line * shape[1] for line in slow]
        return np.stack([raw[n + fast.start : n + fast.stop][:, kept] for n in starts])

    axes = {"inline": "Y", "crossline": "X", "trace": "X", "sample": "Z"}
    whole = Variable(
        name=path.stem,
        shape=shape,
        dtype=np.dtype(file.dtype),
        dimensions=tuple(columns),
        read=by_ranges(shape, get),
    )
    units = {"sample": {"units": "ms", "positive": "down"}}
    coords = [
        positions(name, each, {"axis": axes[name], **units.get(name, {})})
        for name, each in columns.items()
    ]
    return [whole, *coords]
