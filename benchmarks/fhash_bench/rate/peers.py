"""Peers: filters of HDF5, and programs that the user names (QoZ 2, HPEZ, SZ3, TTHRESH, ffmpeg)."""

from __future__ import annotations

import importlib
import itertools
import math
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from struct import Struct
from typing import Any, Protocol, TypeAlias

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.cost.peers import (
    BOTH,
    LADDER,
    Filter,
    Variant,
    joined,
    opened_file,
    parts_of,
    peers,
    read_all,
    stored,
    stored_bytes,
)
from fhash_formats.errors import InputError
from fhash_formats.support.values import Values

SMALL_CHUNK = 32
"""Vertices along an axis of a chunk, as a user who reads regions would choose."""

Spans = list[tuple[int, int]]

LEAST_SECONDS = 1e-6
"""Seconds that work takes at least, so that a rate of it is finite."""


@dataclass(frozen=True, kw_only=True)
class Spent:
    """Seconds of some work.

    Attributes:
        wall: from its beginning to its end.
        core: of all cores together, those of programs that it ran included.
    """

    wall: float
    core: float


def spent(work: Callable[[], object]) -> Spent:
    """Do some work and return the seconds that it took."""
    wall, core = time.perf_counter(), core_seconds()
    work()
    return Spent(
        wall=max(LEAST_SECONDS, time.perf_counter() - wall),
        core=max(LEAST_SECONDS, core_seconds() - core),
    )


def core_seconds() -> float:
    """Seconds of all cores that this process and the programs that it ran took so far."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def all_filters() -> dict[str, tuple[Variant, ...]]:
    """Every peer that is a filter, by name. Raises MissingDependencyError without hdf5plugin."""
    found = peers()
    plugins = importlib.import_module("hdf5plugin")
    rounding = replace(
        _lossless(plugins, "BitRound", "bits"), lossless=False, step=LADDER, prepare=_rounded
    )
    return {**found, "BitRound": (rounding,), "Blosc": (_lossless(plugins, "Blosc", "lossless"),)}


def _lossless(plugins: Any, peer: str, mode: str) -> Variant:
    """Blosc (zstd, shuffle) on single frames."""

    def setting(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Blosc(cname="zstd", clevel=5, shuffle=plugins.Blosc.SHUFFLE)  # type: ignore[no-any-return]

    return Variant(peer=peer, mode=mode, layout="frame", goals=BOTH, setting=setting, lossless=True)


def small_chunks(variants: Sequence[Variant]) -> Variant:
    """Variant of a peer for random access: small chunks of a frame.

    All chunks share one tolerance, since they differ in range and detail.
    """
    return replace(
        next(variant for variant in reversed(variants) if variant.layout == "frame"),
        chunk=SMALL_CHUNK,
    )


def _rounded(values: Values, level: float) -> Values:
    """Values with as many bits of the mantissa as a level has steps."""
    from numcodecs import BitRound

    bits = min(max(round(level / LADDER), 1), np.finfo(values.dtype).nmant)
    codec = BitRound(bits)
    return np.asarray(codec.decode(codec.encode(np.array(values))), dtype=values.dtype).reshape(
        values.shape
    )


def read_region(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> Values:
    """A region (z, y, x) of one step of a series of `shape`."""
    parts = [
        dataset[tuple(slice(*span) for span in spans)]
        for dataset, spans in _parts(file, variant, shape, step, region)
    ]
    return np.concatenate([part.reshape(-1, *part.shape[-2:]) for part in parts])


def touched_bytes(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> int:
    """Stored bytes of the chunks that a region of one step meets."""
    total = 0
    for dataset, spans in _parts(file, variant, shape, step, region):
        firsts = [
            range(low // n * n, high, n)
            for (low, high), n in zip(spans, dataset.chunks, strict=True)
        ]
        total += sum(
            int(dataset.id.get_chunk_info_by_coord(corner).size)
            for corner in itertools.product(*firsts)
        )
    return total


def _parts(
    file: Any, variant: Variant, shape: tuple[int, ...], step: int, region: Box
) -> list[tuple[Any, Spans]]:
    """The datasets that hold a region of one step, with its spans in them."""
    found = spans_of(variant.layout, shape, step, region)
    return [(file[str(number)], spans) for number, spans in found]


def spans_of(
    layout: str, shape: tuple[int, ...], step: int, region: Box
) -> list[tuple[int, Spans]]:
    """Part numbers that hold a region (z, y, x) of one step, with its spans in each."""
    steps, planes = shape[:2]
    (low, high), *plane = region
    if layout == "frame":
        return [(step, [*region])]
    if layout == "plane":
        return [(z, [(step, step + 1), *plane]) for z in range(low, high)]
    if layout == "folded":
        return [(0, [(step * planes + low, step * planes + high), *plane])]
    if layout == "turned":
        return [(0, [(z * steps + step, z * steps + step + 1), *plane]) for z in range(low, high)]
    return [(0, [(step, step + 1), *region])]


TIMEOUT = 900.0
"""Seconds after which a call of a program is ended."""
SHOWN = 200
"""Letters of a program's message that are shown."""


class Program(Protocol):
    """A codec that is a program: it codes one array into one file."""

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded.

        part: finite values, two to four axes.
        file: the file to write; others beside it are scratch.
        scale: smallest value of the series, and its range.
        level: quality in dB, as of `Variant.setting`.

        Raises InputError where the program fails.
        """

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array of that shape from its file; raises InputError where the program fails."""


@dataclass(frozen=True, kw_only=True)
class Coded:
    """A series as a program coded it.

    Attributes:
        files: of the parts.
        shape: of the series (t, z, y, x).
        scale: smallest value of the series, and its range.
    """

    files: tuple[Path, ...]
    shape: tuple[int, ...]
    scale: tuple[float, float]

    @property
    def bytes(self) -> int:
        """Bytes of all files."""
        return sum(file.stat().st_size for file in self.files)


@dataclass(frozen=True, kw_only=True)
class ProgramVariant:
    """One mode and layout of a program; see `peers.Variant`, whose attributes it shares."""

    peer: str
    mode: str
    layout: str
    goals: tuple[str, ...]
    program: Program
    step: float = 0.0
    lossless: bool = False

    @property
    def name(self) -> str:
        """Description such as "TTHRESH PSNR, a file per series"."""
        return f"{self.peer} {self.mode}, a file per {self.layout}"

    def encode(self, values: Values, data_range: float, level: float, folder: Path) -> Coded:
        """Code values (t, z, y, x) at a level into files in a folder; raises InputError."""
        scale = (float(values.min()), data_range)
        files = []
        for number, part in enumerate(parts_of(values, self.layout)):
            file = folder / f"part-{number}"
            try:
                self.program.encode(np.ascontiguousarray(part), file, scale, level)
            except InputError as error:
                raise InputError(f"{self.name}: {error}") from error
            if not file.is_file():
                raise InputError(f"{self.name}: the program wrote no file")
            files.append(file)
        return Coded(files=tuple(files), shape=values.shape, scale=scale)

    def decode(self, coded: Coded) -> Values:
        """The values (t, z, y, x) of coded files; raises InputError."""
        steps, planes, *plane = coded.shape
        shapes = {
            "frame": (planes, *plane),
            "plane": (steps, *plane),
            "series": coded.shape,
            "folded": (steps * planes, *plane),
            "turned": (steps * planes, *plane),
        }
        try:
            parts = [
                self.program.decode(file, shapes[self.layout], coded.scale) for file in coded.files
            ]
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from error
        return joined(parts, self.layout, coded.shape)


@contextmanager
def folder_of(parent: Path) -> Iterator[Path]:
    """A folder for one coded series, which is removed with all that a program left there."""
    with tempfile.TemporaryDirectory(prefix="peer-", dir=parent) as name:
        yield Path(name)


def executable(name: str, path: str) -> str:
    """The program at a path, or found by its name; raises InputError where there is none."""
    found = shutil.which(path)
    if found is None:
        raise InputError(f"peer {name}: '{path}' is no program that can be run")
    return os.path.abspath(found)


def called(arguments: Sequence[str | Path], timeout: float = TIMEOUT) -> bytes:
    """Run a program on one thread where it can be told so; what it printed on stdout.

    Raises InputError, in one line, where it cannot be run, fails, or takes too long. Then it is
    ended with all that it started.
    """
    words = [str(argument) for argument in arguments]
    name = Path(words[0]).name
    try:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    except OSError as error:
        raise InputError(f"{name} cannot be run: {error.strerror or error}") from error
    with process:
        try:
            printed, told = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired as error:
            _end(process)
            raise InputError(f"{name} was ended after {timeout:g} s") from error
        except BaseException:
            _end(process)
            raise
    if process.returncode:
        raise InputError(f"{name} failed with {process.returncode}: {_last_line(told or printed)}")
    return printed


def _end(process: subprocess.Popen[Any]) -> None:
    """End a process and those of its session."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _last_line(told: bytes) -> str:
    """The last line that says something, without letters that a terminal would act on."""
    lines = [line.strip() for line in told.decode("utf-8", "replace").splitlines()]
    last = next((line for line in reversed(lines) if line), "it said nothing")
    return "".join(letter if letter.isprintable() else "?" for letter in last)[:SHOWN]


def as_float(values: Values) -> Values:
    """Values as little-endian float32, or as float64 where float32 would lose some of them."""
    narrow = values.astype("<f4")
    wide = values.dtype.itemsize > 4 and not np.array_equal(narrow, values)
    return values.astype("<f8") if wide else narrow


def write_raw(values: Values, file: Path) -> None:
    """Write an array in C order, nothing else."""
    values.tofile(file)


def read_raw(file: Path, dtype: str, shape: tuple[int, ...]) -> Values:
    """An array of a file that holds nothing else; raises InputError for another size."""
    try:
        values = np.fromfile(file, dtype=dtype)
    except OSError as error:
        raise InputError(f"it wrote no values: {error.strerror}") from error
    count = int(np.prod(shape))
    if values.size != count:
        raise InputError(f"it gave {values.size} values, not {count}")
    return values.reshape(shape)


QOZ_NAMES = {"qoz": "QoZ", "hpez": "HPEZ", "sz3": "SZ3 program"}
"""Names of the programs, and of the codecs."""
FULL_SEARCH = {"qoz": ("-q", "4"), "hpez": ("-q", "4"), "sz3": ()}
"""Options of each program for its strongest mode."""


@dataclass(frozen=True, kw_only=True)
class Qoz:
    """The program at a path, with further options."""

    path: str
    options: tuple[str, ...]

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded within an absolute error; see `Program`."""
        values, raw = as_float(part), file.with_suffix(".raw")
        tolerance = scale[1] * math.pow(10.0, -level / 20)
        write_raw(values, raw)
        lengths = _lengths(part.shape)
        bound = ("-M", "ABS", f"{tolerance:.9g}", *self.options)
        called([self.path, *_type(values.itemsize), "-i", raw, "-z", file, *lengths, *bound])
        raw.unlink()
        # The decoder must be told the type again.
        file.with_suffix(".type").write_text(str(values.itemsize), encoding="ascii")

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array from its file; see `Program`."""
        itemsize = int(file.with_suffix(".type").read_text(encoding="ascii"))
        raw = file.with_suffix(".out")
        called([self.path, *_type(itemsize), "-z", file, "-o", raw, *_lengths(shape)])
        values = read_raw(raw, f"<f{itemsize}", shape)
        raw.unlink()
        return values


def _type(itemsize: int) -> list[str]:
    """Option for float32 or float64."""
    return ["-f" if itemsize == 4 else "-d"]


def _lengths(shape: tuple[int, ...]) -> list[str]:
    """Option and lengths of the axes, the fastest first, without axes of one value."""
    lengths = [n for n in shape if n > 1] or [1]
    return [f"-{len(lengths)}", *(str(n) for n in reversed(lengths))]


def qoz_variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    """Every layout of a program of QOZ_NAMES."""
    return tuple(
        ProgramVariant(
            peer=QOZ_NAMES[name],
            mode="tolerance",
            layout=layout,
            goals=("psnr", "bound"),
            program=Qoz(path=path, options=FULL_SEARCH[name]),
        )
        for layout in ("series", "folded", "frame", "plane")
    )


TTHRESH_UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of a uniformly distributed error lies below the tolerance of a level."""
HALF_RANGE = 20 * math.log10(2)
"""dB by which the program's PSNR lies below ours: it is relative to half of the range."""
CONSTANT = Struct("<d")
"""A part of one value alone, which the program would take minutes and megabytes for."""
LEAST_AXES = 3
"""Axes that an array must have."""


@dataclass(frozen=True, kw_only=True)
class Tthresh:
    """The program at a path."""

    path: str

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded; see `Program`. Its axes go from the fastest to the slowest."""
        low, high = float(part.min()), float(part.max())
        if low == high:
            file.write_bytes(CONSTANT.pack(low))
            return
        own = high - low
        # The program's PSNR is relative to the range of what it is given.
        psnr = (
            level
            + TTHRESH_UNIFORM
            - HALF_RANGE
            + 20 * math.log10(max(own, 1e-9 * scale[1]) / scale[1])
        )
        lengths = [n for n in part.shape if n > 1]
        lengths += [1] * (LEAST_AXES - len(lengths))
        values, raw = as_float(part), file.with_suffix(".raw")
        write_raw(values, raw)
        kind = "float" if values.itemsize == 4 else "double"
        sizes = [str(n) for n in reversed(lengths)]
        target = ("-p", f"{max(psnr, 0.1):.6f}")
        called([self.path, "-i", raw, "-t", kind, "-s", *sizes, *target, "-c", file])
        raw.unlink()

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array from its file; see `Program`. The program keeps the number type."""
        if file.stat().st_size == CONSTANT.size:
            return np.full(shape, CONSTANT.unpack(file.read_bytes())[0])
        raw = file.with_suffix(".out")
        called([self.path, "-c", file, "-o", raw])
        count = math.prod(shape)
        wide = raw.is_file() and raw.stat().st_size == 8 * count
        values = read_raw(raw, "<f8" if wide else "<f4", shape)
        raw.unlink()
        return values


def tthresh_variants(path: str) -> tuple[ProgramVariant, ...]:
    """All of the series together, four axes or three."""
    return tuple(
        ProgramVariant(
            peer="TTHRESH",
            mode="PSNR",
            layout=layout,
            goals=("psnr", "bound"),
            program=Tthresh(path=path),
        )
        for layout in ("series", "frame")
    )


LEAST = 64
"""Vertices of a picture along each axis; shorter ones are filled up with their last value."""
MULTIPLE = 8
"""Lengths of a picture are multiples of it."""
QUIET = ("-v", "error", "-nostdin", "-y")
"""Options of every call: nothing but errors is said, and nothing asked."""
LISTING_SECONDS = 60.0
"""Seconds in which a program must list its encoders."""


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """An encoder of ffmpeg.

    Attributes:
        name: in ffmpeg.
        stream: format of the bare stream.
        bits: of a grey value, each tried.
        quality: options; {0} stands for the quantiser.
        most: coarsest quantiser; 0 is the finest.
        slope: quantisers for each dB.
    """

    name: str
    stream: str
    bits: tuple[int, ...]
    quality: tuple[str, ...]
    most: int
    slope: float = 1.0


ENCODERS = {
    "hevc": (
        Encoder(
            name="libx265",
            stream="hevc",
            bits=(10, 12),
            quality=(
                *("-preset", "slow", "-tune", "psnr"),
                *("-x265-params", "qp={0}:keyint=-1:log-level=none"),
            ),
            most=51,
        ),
    ),
    "av1": (
        Encoder(
            name="libaom-av1",
            stream="obu",
            bits=(10, 12),
            quality=("-cpu-used", "4", "-crf", "{0}", "-b:v", "0", "-g", "9999"),
            most=63,
            slope=1.4,
        ),
        Encoder(
            name="libsvtav1",
            stream="obu",
            bits=(10,),
            quality=("-preset", "4", "-crf", "{0}", "-g", "9999"),
            most=63,
            slope=1.4,
        ),
    ),
    "vvc": (
        Encoder(
            name="libvvenc",
            stream="vvc",
            bits=(10,),
            quality=("-preset", "medium", "-qp", "{0}", "-g", "9999"),
            most=63,
        ),
    ),
}
"""Encoders of each video codec. All that a program has are tried."""
VIDEO_NAMES = {"hevc": "HEVC", "av1": "AV1", "vvc": "VVC"}
"""Names of the codecs."""
FINEST = 70.0
"""Level in dB of the finest quantiser."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """An encoder of the ffmpeg at a path, with so many bits."""

    path: str
    encoder: Encoder
    bits: int

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array (planes, y, x) as a film; see `Program`."""
        low, data_range = scale
        top = 2**self.bits - 1
        grey = np.rint((part.astype(np.float64) - low) * (top / data_range)).clip(0, top)
        height, width = (_filled(n) for n in part.shape[1:])
        missing = [(0, 0), (0, height - part.shape[1]), (0, width - part.shape[2])]
        pictures = np.pad(grey.astype("<u2"), missing, mode="edge").reshape(len(part), -1)
        colours = np.full((len(part), height * width // 2), 2 ** (self.bits - 1), "<u2")
        raw = file.with_suffix(".raw")
        write_raw(np.concatenate([pictures, colours], axis=1), raw)
        quantiser = round((FINEST - level) * self.encoder.slope)
        quantiser = min(max(quantiser, 0), self.encoder.most)
        source = ("-pix_fmt", self._pixels, "-s", f"{width}x{height}", "-r", "25", "-i", raw)
        quality = [option.format(quantiser) for option in self.encoder.quality]
        target = ("-threads", "1", "-f", self.encoder.stream, file)
        coder = ("-c:v", self.encoder.name, *quality)
        called([self.path, *QUIET, "-f", "rawvideo", *source, *coder, *target])
        raw.unlink()

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array (planes, y, x) from its film; see `Program`."""
        low, data_range = scale
        raw = file.with_suffix(".out")
        target = ("-f", "rawvideo", "-pix_fmt", self._pixels, "-fps_mode", "passthrough", raw)
        called([self.path, *QUIET, "-f", self.encoder.stream, "-i", file, *target])
        height, width = (_filled(n) for n in shape[1:])
        size = height * width
        films = read_raw(raw, "<u2", (shape[0], size + size // 2))
        raw.unlink()
        grey = films[:, :size].reshape(shape[0], height, width)[:, : shape[1], : shape[2]]
        return np.asarray(grey * (data_range / (2**self.bits - 1)) + low)

    @property
    def _pixels(self) -> str:
        """ffmpeg's name of the number type."""
        return f"yuv420p{self.bits}le"


def video_variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    """The films of a video codec, for each encoder that an ffmpeg has.

    Raises InputError where it has none, or is no ffmpeg.
    """
    listed = called([path, "-v", "error", "-encoders"], LISTING_SECONDS)
    there = {
        words[1] for words in map(str.split, listed.decode("utf-8", "replace").splitlines())
        if len(words) > 1
    }  # fmt: skip
    encoders = [encoder for encoder in ENCODERS[name] if encoder.name in there]
    if not encoders:
        wanted = " or ".join(encoder.name for encoder in ENCODERS[name])
        raise InputError(f"peer {name}: {path} has no encoder {wanted}")
    return tuple(
        ProgramVariant(
            peer=VIDEO_NAMES[name],
            mode=f"{encoder.name} {bits} bit",
            layout=layout,
            goals=("psnr",),
            program=Video(path=path, encoder=encoder, bits=bits),
            step=1.0 / encoder.slope,
        )
        for encoder in encoders
        for bits in encoder.bits
        for layout in ("turned", "folded")
    )


def _filled(length: int) -> int:
    """Length of a picture that holds an axis."""
    return max(LEAST, math.ceil(length / MULTIPLE) * MULTIPLE)


PROGRAMS = ("tthresh", *QOZ_NAMES, *VIDEO_NAMES)
"""Names that can be given."""


def programs(
    named: Mapping[str, str],
) -> tuple[dict[str, tuple[ProgramVariant, ...]], dict[str, str]]:
    """The variants of programs by the names of their codecs, and why others were left out.

    named: path by name.

    Raises InputError for an unknown name, or a path without a program.
    """
    found: dict[str, tuple[ProgramVariant, ...]] = {}
    refused: dict[str, str] = {}
    for name, given in named.items():
        if name not in PROGRAMS:
            raise InputError(f"peer is '{name}'; programs: {', '.join(PROGRAMS)}")
        path = executable(name, given)
        try:
            variants = _variants(name, path)
        except InputError as error:
            refused[name] = str(error)
        else:
            found[variants[0].peer] = variants
    return found, refused


def _variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    if name == "tthresh":
        return tthresh_variants(path)
    if name in QOZ_NAMES:
        return qoz_variants(name, path)
    return video_variants(name, path)


AnyVariant: TypeAlias = Variant | ProgramVariant
"""A mode and layout of a peer."""


def there_and_back(
    values: Values, variant: AnyVariant, data_range: float, level: float, folder: Path
) -> tuple[Values, int]:
    """Values (t, z, y, x) as they are decoded, and the bytes they took; raises InputError.

    folder: place of temporary files.
    """
    if isinstance(variant, ProgramVariant):
        with folder_of(folder) as own:
            coded = variant.encode(values, data_range, level, own)
            return variant.decode(coded), coded.bytes
    with stored(values, variant, data_range, level) as file:
        return read_all(file, variant, values.shape), stored_bytes(file)


class PeerFiles:
    """Files of a peer in a folder, written and read again and again to be timed."""

    def __init__(
        self, values: Values, variant: AnyVariant, data_range: float, level: float, folder: Path
    ) -> None:
        """Prepare files of values (t, z, y, x) at a level. folder: removed by the caller."""
        self._values, self._variant = values, variant
        self._range, self._level, self._folder = data_range, level, folder
        self._path = folder / "peer.h5"
        self._coded: Coded | None = None

    def encode(self) -> None:
        """Write the files; raises InputError."""
        if isinstance(self._variant, ProgramVariant):
            self._coded = self._variant.encode(self._values, self._range, self._level, self._folder)
            return
        with stored(self._values, self._variant, self._range, self._level, self._path):
            pass

    def decode(self) -> None:
        """Read every value back; raises InputError."""
        if isinstance(self._variant, ProgramVariant):
            assert self._coded is not None
            self._variant.decode(self._coded)
            return
        with opened_file(self._path) as file:
            read_all(file, self._variant, self._values.shape)

    def read_region(self, step: int, region: Box) -> tuple[int, Spent]:
        """Bytes that a region of one step takes, and seconds after opening the file.

        A program must decode everything.
        """
        if isinstance(self._variant, ProgramVariant):
            assert self._coded is not None
            return self._coded.bytes, spent(self.decode)
        where = (self._variant, self._values.shape, step, region)
        with opened_file(self._path) as file:
            taken = spent(lambda: read_region(file, *where))
            return touched_bytes(file, *where), taken
