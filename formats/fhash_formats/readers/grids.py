"""Readers of volumes behind a short header: NIfTI, MRC, OpenDX, cube, legacy VTK and SEG-Y."""

from __future__ import annotations

import warnings
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import takewhile
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.file_series import MAX_AXIS, Request, Stamp, library, naming, refusing
from fhash_formats.readers.stored_bytes import (
    GZIP,
    LONGEST_NUMBER,
    MAX_LINE,
    TYPES,
    CompressedFile,
    FlatArray,
    Header,
    NumbersInText,
    PlainFile,
    StoredBytes,
    axis_steps,
    count_of,
    lattice,
    numbers_of,
)
from fhash_formats.readers.variables import (
    MAX_COMPONENTS,
    Source,
    Variable,
    by_ranges,
    components,
    file_source,
    placed,
    positions,
)
from fhash_formats.readers.vtk import without_hidden
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import decoded_text, is_number

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


def _volume(
    path: Path,
    packed: bool,
    sizes: Sequence[int],
    names: Sequence[str],
    dtype: np.dtype[Any],
    start: int,
) -> tuple[Variable, StoredBytes]:
    """The array (the fastest dimension is the first) that begins at a byte of a file, or of its
    true bytes."""
    shape, size = tuple(reversed(sizes)), start + prod(sizes) * dtype.itemsize
    stored: StoredBytes = PlainFile(path, start=0, size=0 if packed else size)
    if packed:
        stored = CompressedFile(path, "deflate", start=0, size=size)
    array = FlatArray(path, shape, dtype, offset=start, stored=stored)
    name = path.name.removesuffix(".gz").rpartition(".")[0] or path.name
    return array.variable(name, names[::-1]), stored


NIFTI_SUFFIXES = (".nii", ".nii.gz", ".hdr")

NIFTI_CODES = "2 u1 4 i2 8 i4 16 f4 32 c8 64 f8 256 i1 512 u2 768 u4 1024 i8 1280 u8 1792 c16"
"""Number types behind their codes (nifti1.h)."""

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
        data, packed = _head(path, 544)
        end: Literal["little", "big"] = (
            "little" if int.from_bytes(data[:4], "little") in (348, 540) else "big"
        )
        size = int.from_bytes(data[:4], end)
        if size not in (348, 540):
            raise InputError(f"its header says that it has {size} bytes; NIfTI has 348 or 540")
        form = [tuple(each.split(":")) for each in (NIFTI_1 if size == 348 else NIFTI_2).split()]
        if len(data) < size:
            raise InputError(f"its header has {len(data)} bytes, {size} are needed; it is cut")
        header = np.frombuffer(data, np.dtype(form).newbyteorder(end), count=1)[0]
        count = int(header["dim"][0])
        if not 1 <= count <= 7 or (header["dim"][1 : count + 1] < 1).any():
            raise InputError(f"its dimensions are {header['dim'].tolist()}")
        sizes = [int(n) for n in header["dim"][1 : count + 1]]
        while len(sizes) > 2 and sizes[-1] == 1:
            sizes.pop()
        code, *codes = int(header["datatype"]), *NIFTI_CODES.split()
        if str(code) not in codes[::2]:
            raise InputError(f"its values are of type {code}, no numbers")
        dtype = np.dtype(codes[codes.index(str(code)) + 1]).newbyteorder(end)
        pair = header["magic"][:2] == b"ni"
        file = request.beside(path, _image_of(path)) if pair else path
        packed = packed if file is path else _head(file, 0)[1]
        # the header of a single file ends with four bytes that say whether extensions follow
        offset = max(int(header["vox_offset"]), 0 if pair else size + 4)
        names = ["x", "y", "z", AXIS_NAMES["t"], "dim5", "dim6", "dim7"][: len(sizes)]
        whole, stored = _volume(file, packed, sizes, names, dtype, offset)
        whole = replace(whole, attributes=_nifti_attributes(header))
        vector = len(sizes) == 5
        arrays = components(whole, 0, interleaved=False) if vector else [whole]
        if vector and sizes[3] == 1:
            arrays = [each for one in arrays for each in components(one, 0, interleaved=False)]
        found = placed(arrays, _nifti_positions(source, header, sizes))
    files = [file] if pair else []
    return file_source(path, found, stamp=stamp, files=files, close=stored.close)


def _image_of(path: Path) -> Path:
    """The file of the values that belong to a header of its own, compressed or not."""
    plain = path.with_suffix("") if path.suffix.lower() == ".gz" else path
    image = plain.with_suffix(".img")
    packed = image.with_suffix(".img.gz")
    return packed if packed.is_file() and not image.is_file() else image


def _nifti_attributes(header: Any) -> dict[str, Any]:
    """Scale, offset and description of the values.

    A slope of 0, or none that is finite, stands for no scale (nifti1.h).
    """
    slope, inter = float(header["scl_slope"]), float(header["scl_inter"])
    found: dict[str, Any] = {}
    if np.isfinite(slope) and slope != 0 and (slope, inter) != (1, 0):
        if not np.isfinite(inter):
            raise InputError(f"its values have the slope {slope} and the offset {inter}")
        found = {"scale_factor": slope, "add_offset": inter}
    told = decoded_text(bytes(header["descrip"]).split(b"\0")[0]).strip()
    return found | ({"long_name": told} if told.isprintable() and told else {})


def _affine(header: Any) -> npt.NDArray[np.float64]:
    """The affine (3, 4) of the array: sform, else qform, else the spacings."""
    if header["sform_code"] > 0:
        return np.asarray(header["srow"], np.float64).reshape(3, 4)
    step = np.array(header["pixdim"], np.float64)
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

IMOD_STAMP = 1146047817
"""Word 39 of the header of a file by IMOD, whose word 40 has flags."""
IMOD_SIGNED = 1
"""Flag of IMOD: bytes are signed."""
IMOD_INVERTED = 4
"""Flag of IMOD: the origin is that of MRC2014."""
IMOD_HALF_BYTES = 16
"""Flag of IMOD: a byte holds two values."""
VOLUME_STACK = 401
"""First number of a space group that stands for volumes behind each other (MRC2014)."""


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
            raise InputError("it is cut: it is shorter than its header of 1024 bytes")
        order = ">" if head[212:213] == b"\x11" else "<"
        words = np.frombuffer(head[:1024], f"{order}i4")
        floats = np.frombuffer(head[:1024], f"{order}f4").astype(np.float64)
        sizes, kind = [int(n) for n in words[:3]], MRC_TYPES.get(int(words[3]))
        flags = int(words[39]) if words[38] == IMOD_STAMP else None
        if kind is None or min(sizes) < 1 or words[23] < 0 or (flags or 0) & IMOD_HALF_BYTES:
            raise InputError(f"its sizes are {sizes} and its mode {int(words[3])}")
        if kind == "i1" and not _has_signed_bytes(flags, floats[19], floats[20]):
            kind = "u1"
        letters = ["xyz"[n - 1] if 1 <= n <= 3 else "?" for n in words[16:19].tolist()]
        if set(letters) != set("xyz"):
            letters = ["x", "y", "z"]  # of programs that leave them out
        start, names, volumes = 1024 + int(words[23]), letters, int(words[9])
        if words[22] >= VOLUME_STACK and 0 < volumes < sizes[2] and sizes[2] % volumes == 0:
            sizes, names = [*sizes[:2], volumes, sizes[2] // volumes], [*letters, AXIS_NAMES["t"]]
        whole, stored = _volume(path, packed, sizes, names, np.dtype(order + kind), start)
        angles = [float(each) for each in floats[13:16] if np.isfinite(each) and each > 0]
        if any(abs(each - 90) > 1e-3 for each in angles):
            warnings.warn(
                f"{source}: its cell has the angles {', '.join(f'{n:.6g}' for n in angles)};"
                " positions are along its own axes, as if these were at right angles",
                FhashWarning,
                stacklevel=2,
            )
        # before 2013, IMOD wrote the place of the origin of the axes, and not that of the grid
        if flags is not None and not flags & IMOD_INVERTED and words[27] <= 0:
            floats[49:52] *= -1
        coords = {}
        for n, axis in enumerate("xyz"):
            cells, cell = int(words[7 + n]), floats[10 + n]
            column = letters.index(axis)
            step = cell / cells if cells > 0 and np.isfinite(cell) and cell > 0 else 1.0
            unit = "angstrom" if step != 1.0 or cell > 0 else ""
            origin = floats[49 + n] if np.isfinite(floats[49 + n]) else 0.0
            first = int(words[4 + column]) if origin == 0 else 0
            coords[axis] = lattice(axis, origin, step, sizes[column], first=first, units=unit)
    return file_source(path, placed([whole], coords), stamp=stamp, close=stored.close)


def _has_signed_bytes(flags: int | None, low: float, high: float) -> bool:
    """Whether bytes of MRC are signed, as MRC2014 has them.

    flags: of IMOD, None in other files. low, high: least and greatest value by the header, where
    low is not above high; other programs than IMOD leave nothing else that tells.
    """
    return bool(flags & IMOD_SIGNED) if flags is not None else not (0 <= low <= high and high > 127)


DX_SUFFIXES = (".dx",)
DX_TYPES = {"byte": "u1"} | {name: TYPES[name] for name in ("float", "double", "int", "short")}


def is_dx(head: bytes, path: Path) -> bool:
    """Whether this is OpenDX: its first object is a grid of positions."""
    for line in head.split(b"\n"):
        words = line.split()
        if words and not words[0].startswith(b"#"):
            return words[::2][:2] == [b"object", b"class"] and words[3:4] == [b"gridpositions"]
    return False


def open_dx(path: Path, request: Request) -> Source:
    """The values of an OpenDX grid (APBS, VMD, Chimera): z is the fastest, as text or as bytes.

    Raises InputError for grids that are turned, values that are not behind the header or are no
    numbers one by one, and files that are cut.
    """
    stamp = Stamp.of(path)
    with naming(str(path)), Header(path) as header:
        words: list[str] = []
        while "follows" not in (line := header.words()):
            if not line:
                raise InputError("it holds no array of numbers that follows; it is cut or no grid")
            words += [] if line[0].startswith("#") else line
        words += line
        most = path.stat().st_size
        first = words.index("array") if "array" in words else 0
        sizes = [count_of(each, "positions", most, 1) for each in _behind(words, "counts", 3)]
        told = words[first:]
        items, kind = _behind(told, "items", 1), told[told.index("type") + 1 :]
        signed = {"unsigned": "u", "signed": "i"}.get(kind[0], "")
        short = DX_TYPES.get(kind[1 if signed else 0].lower(), "")
        if not first or not short or prod(map(int, _behind(told, "shape", -1))) != 1:
            raise InputError("it holds no array of numbers, one for each position")
        if prod(sizes) != count_of(items[0], "items", most):
            has = f"{prod(sizes)} positions, and its array {items[0]} items"
            raise InputError(f"its grid has {has}")
        grid = words[:first]
        origin = numbers_of(" ".join(_behind(grid, "origin", 3) or "000"), 3)
        places = [n for n, word in enumerate(grid) if word == "delta"]
        deltas = [numbers_of(" ".join(grid[n + 1 : n + 4]), 3) for n in places] or [*np.eye(3)]
        if len(deltas) != 3:
            raise InputError(f"it has {len(deltas)} deltas, not 3")
        steps = axis_steps(np.array(deltas))
        if signed and short[0] in "iu":
            short = signed + short[1:]
        dtype = np.dtype(("<" if "lsb" in told else ">") + short)
        is_text = not {"binary", "ieee"} & {*told}
        values = _values_at(path, header.file, tuple(sizes), dtype, is_text=is_text)
        lines = zip(origin.tolist(), steps, sizes, strict=True)
        coords = {axis: lattice(axis, *each) for axis, each in zip("xyz", lines, strict=True)}
    return file_source(path, placed([values.variable(path.stem, "xyz")], coords), stamp=stamp)


def _behind(words: Sequence[str], key: str, count: int) -> list[str]:
    """The words behind a key, none without one that may be left out; -1: all that are numbers."""
    if key not in words:
        if key in ("origin", "shape"):
            return []
        raise InputError(f"it has no {key}")
    found = words[words.index(key) + 1 :]
    if count < 0:
        return [*takewhile(str.isdecimal, (word[:18] for word in found))]
    if len(found) < count:
        raise InputError(f"{count} numbers do not follow {key}")
    return list(found[:count])


CUBE_SUFFIXES = (".cube", ".cub")


def is_cube(head: bytes, path: Path) -> bool:
    """Whether this is a cube file of Gaussian, by its suffix: its first lines are any text."""
    return path.suffix.lower() in CUBE_SUFFIXES


def open_cube(path: Path, request: Request) -> Source:
    """The density of a cube file, or its orbitals by their numbers (`NAME.17`); z is the fastest.

    Positions are in bohr, in angstrom where the counts are negative. Raises InputError for grids
    that are turned, and files that are cut.
    """
    stamp = Stamp.of(path)
    with naming(str(path)), Header(path) as header:
        lines = [decoded_text(header.line()).split() for _ in range(6)]
        rows = np.stack([numbers_of(" ".join(each[:4]), 4) for each in lines[2:]])
        if not np.isfinite(rows).all() or not rows[1:, 0].all():
            raise InputError("its grid has numbers that are not finite, or no vertices")
        most = path.stat().st_size
        sizes = [abs(count_of(each[0], "vertices", most, -most)) for each in lines[3:]]
        steps = axis_steps(rows[1:, 1:])
        atoms = count_of(lines[2][0], "atoms", most, -most)
        many = count_of([*lines[2], "1"][4], "values a vertex", MAX_COMPONENTS, 1)
        orbitals = [str(n) for n in range(many)]
        for _ in range(abs(atoms)):
            if not header.line():
                raise InputError(f"it is cut: it has fewer than {abs(atoms)} atoms")
        if atoms < 0:  # numbers of orbitals, and how many there are
            words = header.words() or ["0"]
            many = count_of(words[0], "orbitals", MAX_COMPONENTS, 1)
            while len(words) <= many and (line := header.words()):
                words += line
            orbitals = words[1 : many + 1]
            if len(orbitals) < many:
                raise InputError(f"it is cut: it has fewer than {many} numbers of orbitals")
        shape = (*sizes, len(orbitals)) if len(orbitals) != 1 else tuple(sizes)
        values = _values_at(path, header.file, shape, np.dtype(np.float64), is_text=True)
    unit = "bohr" if rows[1, 0] > 0 else "angstrom"
    coords = {
        axis: lattice(axis, rows[0, n + 1], steps[n], sizes[n], units=unit)
        for n, axis in enumerate("xyz")
    }
    whole = values.variable(path.stem, "xyz")
    arrays = components(whole, 3, orbitals) if len(orbitals) != 1 else [whole]
    return file_source(path, placed(arrays, coords), stamp=stamp)


def _values_at(
    path: Path, file: BinaryIO, shape: tuple[int, ...], dtype: np.dtype[Any], *, is_text: bool
) -> FlatArray:
    """The array whose values begin where a file is; it is behind them then.

    Text ends before the next line that begins with a word.
    """
    start, size = file.tell(), prod(shape) * dtype.itemsize
    if not is_text:
        file.seek(start + size)
        return FlatArray(path, shape, dtype, stored=PlainFile(path, start=start, size=size))
    stop, begins = start, True  # whether a line begins here: lines may be long
    while line := file.readline(MAX_LINE):
        first = line[:LONGEST_NUMBER].split(maxsplit=1)[:1] if begins else []
        if first and first[0][:1].isalpha() and first[0].lower() not in (b"nan", b"inf"):
            break
        stop, begins = stop + len(line), line.endswith(b"\n")
    file.seek(stop)
    stored = NumbersInText(path, dtype, start=start, size=size, stop=stop)
    return FlatArray(path, shape, dtype, stored=stored)


LEGACY_SUFFIXES = (".vtk",)
LEGACY_TYPES = {name.replace(" ", "_"): kind for name, kind in TYPES.items()}
LEGACY_TYPES |= {"char": "i1", "long": "i8", "unsigned_long": "u8"}
LEGACY_TYPES |= {"vtktypeint64": "i8", "vtktypeuint64": "u8"}
LEGACY_TIMES = ("TIME", "TimeValue")
"""Names of fields that hold the time: VisIt's and ParaView's."""
MAX_ARRAYS = 1 << 12
"""Arrays of a file."""


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
        names = Counter(name for _, name, _ in reader.arrays)
        found: list[Variable] = []
        for section, cells in (("POINT_DATA", False), ("CELL_DATA", True)):
            space = tuple(max(n - 1, 1) if cells else n for n in reversed(reader.sizes))
            parts: list[Variable] = []
            for name, array in [each[1:] for each in reader.arrays if each[0] == section]:
                count, shape = array.shape[0], (*space, array.shape[1])
                if count != prod(space):
                    told = f"the array {name} has {count} values, the grid {prod(space)}"
                    raise InputError(told)
                full = f"{section}/{name}" if names[name] > 1 else name
                whole = FlatArray(path, shape, array.dtype, stored=array.stored)
                parts += components(whole.variable(full, AXES[1:]), len(space))
            coords = reader.coordinates(cells=cells) if parts else {}
            parts = without_hidden(parts, "CellData" if cells else "PointData")
            found += placed(parts, coords, f"header/{section}")
    return file_source(path, found, stamp=stamp)


class _LegacyReader:
    """Reads the header of a legacy file, and notes where its arrays are.

    Attributes:
        sizes: points along x, y and z.
        arrays: of points and cells: their section ("POINT_DATA" and so on), name, and values
            (count, components).
        time: of the grid; None without one.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.sizes = path, (0, 0, 0)
        self.time: float | None = None
        self.arrays: list[tuple[str, str, FlatArray]] = []
        self._lines: dict[str, npt.NDArray[np.float64]] = {}
        self._origin, self._spacing = np.zeros(3), np.ones(3)
        self._section, self._count = "", "0"
        with Header(path) as self._header:
            self._file = self._header.file
            self._file.readline(MAX_LINE)
            title = decoded_text(self._file.readline(MAX_LINE))
            self._text = self._words()[:1] == ["ASCII"]
            kind = self._words()
            self._even = kind[1:2] == ["STRUCTURED_POINTS"]
            if kind[:1] != ["DATASET"] or not (self._even or kind[1:2] == ["RECTILINEAR_GRID"]):
                raise InputError(
                    f"it holds VTK data of the kind {' '.join(kind[1:2]) or '?'};"
                    " STRUCTURED_POINTS and RECTILINEAR_GRID can be read (in ParaView, the filter"
                    " ResampleToImage makes them of other data)"
                )
            while words := self._words():
                self._take(words)
        for part in title.replace(":", "=").split("time")[1:] if self.time is None else ():
            before, _, rest = part.partition("=")
            word = [*rest.replace(",", " ").split(), ""][0]
            if not before.strip() and is_number(word):
                self.time = float(word)
        if min(self.sizes) < 1:
            raise InputError(f"its dimensions are {self.sizes}")

    def coordinates(self, *, cells: bool) -> dict[str, Variable]:
        """Coordinates of the points or of the centres of cells, and the time."""
        coords = {}
        for n, axis in enumerate("xyz"):
            values = self._lines.get(axis, np.empty(0))
            if self._even:
                origin, step = float(self._origin[n]), float(self._spacing[n])
                values = lattice(axis, origin, step, self.sizes[n]).whole()
            if len(values) != self.sizes[n]:
                raise InputError(f"its coordinates along {axis} are not {self.sizes[n]}")
            if cells and len(values) > 1:
                values = (values[:-1] + values[1:]) / 2
            coords[axis] = positions(axis, values)
        if self.time is not None:
            coords["t"] = positions(AXIS_NAMES["t"], [self.time])
        return coords

    def _words(self) -> list[str]:
        """The words of the next line that has any; none at the end."""
        while line := self._file.readline(MAX_LINE):
            if words := decoded_text(line).split():
                return words
        return []

    def _take(self, words: Sequence[str]) -> None:
        """Read what a line begins."""
        key, numbers = words[0].upper(), " ".join(words[1:4])
        if key == "DIMENSIONS":
            sizes = [*words[1:4], "", "", ""][:3]
            x, y, z = (count_of(each, "points", MAX_AXIS, 1) for each in sizes)
            self.sizes = (x, y, z)
        elif key == "ORIGIN":
            self._origin = numbers_of(numbers, 3)
        elif key in ("SPACING", "ASPECT_RATIO"):
            self._spacing = numbers_of(numbers, 3)
        elif key.endswith("_COORDINATES") and len(words) == 3:
            self._lines[key[0].lower()] = _whole(self._array("", words[1], "1", words[2]))
        elif key in ("POINT_DATA", "CELL_DATA"):
            self._section, self._count = key, " ".join(words[1:2])
        elif key == "FIELD" and len(words) == 3:
            self._fields(count_of(words[2], "fields", MAX_ARRAYS))
        elif key == "METADATA":
            while self._file.readline(MAX_LINE).strip():
                pass  # up to an empty line
        elif key == "SCALARS" and len(words) in (3, 4):
            place = self._file.tell()
            if self._words()[:1] != ["LOOKUP_TABLE"]:
                self._file.seek(place)
            self._array(words[1], self._count, [*words, "1"][3], words[2])
        elif key in ("VECTORS", "NORMALS", "TENSORS") and len(words) == 3:
            self._array(words[1], self._count, "9" if key == "TENSORS" else "3", words[2])
        elif key == "LOOKUP_TABLE" and len(words) == 3:
            self._array("", words[2], "4", "float" if self._text else "unsigned_char")
        else:
            raise InputError(f"it has the line {' '.join(words)[:60]!r}, which is cut or not known")

    def _fields(self, count: int) -> None:
        for _ in range(count):
            words = self._words()
            if words[:1] == ["METADATA"]:
                self._take(words)
                words = self._words()
            if len(words) != 4:
                raise InputError(f"a field begins with {' '.join(words)[:60]!r}")
            array = self._array(words[0], words[2], words[1], words[3])
            if not self._section and words[0] in LEGACY_TIMES and array.shape == (1, 1):
                self.time = float(_whole(array)[0])

    def _array(self, name: str, count: str, parts: str, kind: str) -> FlatArray:
        """An array whose values begin here, which is kept where it has a name and a section."""
        short, most = LEGACY_TYPES.get(kind.lower()), self.path.stat().st_size
        if short is None:
            raise InputError(f"the array {name} is of type {kind}, no numbers")
        shape = (count_of(count, "values", most), count_of(parts, "parts", MAX_COMPONENTS, 1))
        if len(self.arrays) == MAX_ARRAYS:
            raise InputError(f"it has more than {MAX_ARRAYS} arrays")
        dtype = np.dtype(f">{short}")
        array = _values_at(self.path, self._file, shape, dtype, is_text=self._text)
        if name and self._section:
            self.arrays.append((self._section, name.replace("%20", " "), array))
        return array


def _whole(array: FlatArray) -> npt.NDArray[np.float64]:
    """All values of an array, which is small."""
    return array.read((slice(None), slice(None))).ravel().astype(np.float64)


SEGY_SUFFIXES = (".sgy", ".segy")
LINES = {"inline": 189, "crossline": 193}
"""Bytes of the numbers of lines in the header of a trace (SEG-Y revision 1)."""
TRACE_KIND = 29
"""Byte of the code of a trace's kind in its header."""
DEAD = (2, 3)
"""Codes of traces without values: dead ones and dummies."""
SEGY_ORDER = {b"\4\3\2\1": "little", b"\3\4\1\2": "pairs"}
"""Byte orders other than big by the number 16909060 at byte 3297 (SEG-Y revision 2)."""
SEGY_TYPES = (1, 2, 3, 5, 6, 8, 9, 10, 11, 12, 16)
"""Codes of number types that segyio knows; it takes others for IBM's floats."""


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
    with naming(source), ExitStack() as opened:
        with path.open("rb") as stored:
            told = stored.read(3600)[3200:]
        order = SEGY_ORDER.get(told[96:100], "big")
        kind = int.from_bytes(told[24:26], "little" if order == "little" else "big")
        if len(told) < 400:
            raise InputError("it is shorter than its header of 3600 bytes; it is cut")
        if order == "pairs" or kind not in SEGY_TYPES:
            raise InputError(f"its values are of type {kind} in the byte order {order}")
        with refusing("it is cut or damaged"):
            file = opened.enter_context(segyio.open(source, ignore_geometry=True, endian=order))
        found, close = _traces(path, file), opened.pop_all().close
    return file_source(path, found, stamp=stamp, close=close)


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

    dead = np.isin(file.attributes(TRACE_KIND)[:], DEAD).reshape(shape[:-1])

    def hidden(places: tuple[slice | int, ...]) -> npt.NDArray[np.bool_]:
        part = dead[places[:2]]
        return part if isinstance(places[2], int) else part[..., None]

    axes = {"inline": "Y", "crossline": "X", "trace": "X", "sample": "Z"}
    whole = Variable(
        name=path.stem,
        shape=shape,
        dtype=np.dtype(file.dtype),
        dimensions=tuple(columns),
        read=by_ranges(shape, get),
        hidden=hidden if dead.any() else None,
    )
    units = {"sample": {"units": "ms", "positive": "down"}}
    coords = [
        positions(name, each, {"axis": axes[name], **units.get(name, {})})
        for name, each in columns.items()
    ]
    return [whole, *coords]
