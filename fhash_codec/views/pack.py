"""Packing of a Zarr store whose chunks are tiles into a container."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec.comparison import bytes_on_disk
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encodable
from fhash_codec.features.scan import Scan, scan_rows
from fhash_codec.header import PACKED, check_name, describe_source, write_missing, write_series
from fhash_codec.measure.value_range import Mean, ValueRange, pieces
from fhash_codec.progress import Progress, silent
from fhash_formats.container import ContainerWriter
from fhash_formats.container.array import SINGLE_MEMBER_TILES, TRANSFORM, ArrayMetadata, Codec
from fhash_formats.container.header import TABLE
from fhash_formats.errors import DamagedFileError, FhashWarning, InputError, MissingInputError
from fhash_formats.readers.file_series import FileSeries, Request, selection
from fhash_formats.readers.registry import list_variables
from fhash_formats.readers.zarr_coded import CodedArray, coded_names, open_coded
from fhash_formats.support.files import check_output
from fhash_formats.support.threads import map_ahead, thread_pool, usable_threads
from fhash_formats.support.values import exact_number, json_attributes
from fhash_formats.transform.tile import encode_chunk

TOGETHER_BYTES = 1 << 30
"""Decoded bytes of a member at most; its coded bytes, which are fewer, are held together."""
AHEAD = 2
"""Chunks that are read and decoded ahead, for each thread."""

Index = tuple[int, ...]


@dataclass(kw_only=True)
class _Look:
    """A chunk that was read and decoded.

    Attributes:
        stream: its bytes.
        low, high: range of its values; infinities the other way round where it has none.
        mean: of its values.
        occupied: number of its vertices that its mask has.
        missing: mask of its vertices without a value, within the array; None where all have one.
        absent: whether the store lacks it.
    """

    stream: bytes
    low: float
    high: float
    mean: Mean
    occupied: int
    missing: npt.NDArray[np.bool_] | None
    absent: bool


@dataclass(kw_only=True)
class Facts:
    """Facts of all values of a variable, gathered tile by tile.

    Attributes:
        shape: of the variable (t, z, y, x).
        mean: of the values.
        low, high: their range.
        occupied: number of vertices that masks have.
        missing: packed bits of the vertices without a value, for each step with some.
        absent: number of chunks that the store lacks.
        bytes: of all tiles.
    """

    shape: tuple[int, ...]
    mean: Mean = field(default_factory=Mean)
    low: float = np.inf
    high: float = -np.inf
    occupied: int = 0
    missing: dict[int, npt.NDArray[np.uint8]] = field(default_factory=dict)
    absent: int = 0
    bytes: int = 0
    _layer: npt.NDArray[np.bool_] | None = None
    _first: int = 0
    _last_bits: npt.NDArray[np.uint8] | None = None

    def add(self, look: _Look, region: tuple[slice, ...]) -> None:
        """Add a tile in its place; tiles come in the order of their first step."""
        self.mean.join(look.mean)
        self.low, self.high = min(self.low, look.low), max(self.high, look.high)
        self.occupied += look.occupied
        self.absent += look.absent
        self.bytes += len(look.stream)
        steps, *space = region
        if steps.start != self._first:
            self.flush()
            self._first = steps.start
        if look.missing is not None:
            if self._layer is None:
                self._layer = np.zeros((steps.stop - steps.start, *self.shape[1:]), np.bool_)
            self._layer[:, *space] = look.missing

    def flush(self) -> None:
        """Keep the missing vertices of the steps so far; equal masks of steps are kept once."""
        if self._layer is None:
            return
        for step, frame in enumerate(self._layer, start=self._first):
            if frame.any():
                bits = np.packbits(frame)
                if self._last_bits is None or not np.array_equal(bits, self._last_bits):
                    self._last_bits = bits
                self.missing[step] = self._last_bits
        self._layer = None

    @property
    def value_range(self) -> ValueRange:
        """The range of the values, of which there is at least one."""
        return ValueRange(self.low, self.high)


class Tiles:
    """The tiles of a variable, read, decoded and checked as they are iterated.

    Attributes:
        codecs: of the array that holds them.
        shard: shape of its shards; None for a single tile.
        facts: of the tiles so far.
    """

    def __init__(self, array: CodedArray, source: str, *, fill_absent: bool = False) -> None:
        """Prepare the tiles of an array of the store `source`.

        fill_absent: take the fill value for chunks that the store lacks, also where it marks no
            missing value.
        """
        self._array, self._source = array, source
        marks = bool(array.fill != array.fill) or array.fill in array.fills
        self._fill_absent = fill_absent or marks
        codec: Codec = {"name": TRANSFORM, "configuration": array.configuration}
        self.codecs: list[Codec] = [codec]
        self.metadata = ArrayMetadata(
            shape=array.shape,
            dtype=array.dtype,
            chunk_shape=array.tile,
            codecs=self.codecs,
            together=_together(array.tile, array.grid, array.dtype.itemsize),
        )
        self.facts = Facts(shape=array.shape)

    def __len__(self) -> int:
        return prod(self._array.grid)

    def streams(self, told: Callable[[int], None]) -> Iterator[bytes]:
        """Yield the tiles in the order of the file; `told` gets the number of those that are done.

        Raises DamagedFileError for a chunk that does not decode, and InputError for infinities and
        for a chunk that the store lacks, unless its fill value is taken.
        """
        with thread_pool() as pool:
            order, again = self.metadata.in_order(), self.metadata.in_order()
            looks = map_ahead(pool, self._look, order, AHEAD * usable_threads())
            for number, (index, look) in enumerate(zip(again, looks, strict=True), start=1):
                self.facts.add(look, self.metadata.region(index))
                told(number)
                yield look.stream
        self.facts.flush()

    def check_against_store(self) -> None:
        """Compare the first and the last tile with what zarr decodes from the store.

        Raises RuntimeError where a value differs: then the tiles are not where they belong.
        """
        last = tuple(n - 1 for n in self._array.grid)
        for index in dict.fromkeys([(0, 0, 0, 0), last]):
            own = self._decode(self._stream(index)[0])[0][self._inside(index)]
            stored = self._array.values(index)
            if not np.array_equal(own, stored, equal_nan=own.dtype.kind == "f"):
                raise RuntimeError(f"chunk {index} decodes to other values than zarr finds in it")

    @cached_property
    def _fill_stream(self) -> bytes:
        """The tile of a chunk that the store lacks."""
        array = self._array
        return encode_chunk(np.full(array.tile, array.fill, array.dtype), max_error=0.0)

    def _stream(self, index: Index) -> tuple[bytes, bool]:
        """The bytes of a chunk, and whether the store lacks it."""
        stream = self._array.stream(index)
        if stream is not None:
            return stream, False
        if not self._fill_absent:
            raise InputError(
                f"{self._source}: the store lacks chunk {index} of {self._array.name}, and its fill"
                f" value {self._array.fill} marks no missing value; if the store is complete, take"
                " that value by --absent fill (absent='fill')"
            )
        return self._fill_stream, True

    def _inside(self, index: Index) -> tuple[slice, ...]:
        """The part of a tile within the array."""
        region = self.metadata.region(index)
        return tuple(slice(0, along.stop - along.start) for along in region)

    def _decode(self, stream: bytes) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_] | None]:
        """The values of a tile, and its mask where it may have one, as a reader decodes them."""
        coder, data = self.metadata.tiles, memoryview(stream)
        assert coder is not None
        return coder.decode_masked(data) if coder.masked else (coder.decode(data), None)

    def _look(self, index: Index) -> _Look:
        """Read and decode a chunk."""
        array = self._array
        stream, absent = self._stream(index)
        try:
            decoded, mask = self._decode(stream)
        except DamagedFileError as error:
            raise DamagedFileError(
                f"{self._source}: chunk {index} of {array.name} is damaged: {error}"
            ) from error
        inside = self._inside(index)
        values = decoded[inside]
        occupied = None if mask is None else mask[inside]
        missing = _missing(values, array.fills)
        if missing is not None:
            infinite = values.dtype.kind == "f" and bool(np.isinf(values).any())
            if infinite:
                raise InputError(
                    f"{self._source}: variable {array.name} has infinite values, which a container"
                    f" has no place for: fhash encode {self._source} --var {array.name}"
                )
            kept = values[~missing]
        else:
            kept = values
        low, high, mean = np.inf, -np.inf, Mean()
        for piece in pieces(kept) if kept.size else ():
            _, least, most = scan_rows(piece[None], mean)
            low, high = min(low, least), max(high, most)
        if missing is not None and occupied is not None:
            missing = missing & occupied
        return _Look(
            stream=stream,
            low=low,
            high=high,
            mean=mean,
            occupied=values.size if occupied is None else int(np.count_nonzero(occupied)),
            missing=missing if missing is not None and missing.any() else None,
            absent=absent,
        )


def _missing(values: npt.NDArray[Any], fills: Sequence[Any]) -> npt.NDArray[np.bool_] | None:
    """A mask of the values that stand for none, infinities included; None where all are values."""
    found = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(values.shape, np.bool_)
    for fill in fills:
        found |= values == fill
    return found if found.any() else None


def _together(tile: Index, grid: Index, itemsize: int) -> Index:
    """Numbers of tiles along each axis that lie in a member, so that steps keep their order.

    A member has several layers along t only where it has all of each.
    """
    most = max(1, min(SINGLE_MEMBER_TILES, TOGETHER_BYTES // (prod(tile) * itemsize)))
    counts = [1] * len(grid)
    for axis in reversed(range(len(grid))):
        counts[axis] = min(grid[axis], most // prod(counts))
        if counts[axis] < grid[axis]:
            break
    return tuple(counts)


ABSENT = ("refuse", "fill")
"""Values of `absent`."""


class PackedVariable(TypedDict):
    """A variable that was packed."""

    shape: Annotated[list[int], "steps and vertices (t, z, y, x)"]
    tile: Annotated[list[int], "of a chunk of the store"]
    tiles: Annotated[int, "chunks"]
    absent: Annotated[int, "chunks that the store lacks, which have its fill value"]
    bytes: Annotated[int, "all chunks, coded"]
    raw_bytes: Annotated[int, "the values in their own type"]
    value_range: Annotated[list[float], "smallest and largest value"]
    codec: Annotated[dict[str, Any], "`max_error`, `max_error_rel` or `step`, if known"]


class PackReport(TypedDict):
    """A file that was packed of a store."""

    path: Annotated[str, "the file written"]
    bytes: Annotated[int, "its size"]
    source_bytes: Annotated[int | None, "bytes of the store on disk"]
    raw_bytes: Annotated[int, "the values in their own type"]
    ratio: Annotated[float, "`raw_bytes / bytes`"]
    seconds: Annotated[float, "of the whole command"]
    variables: Annotated[dict[str, PackedVariable], "the variables by name"]


def pack(
    source: str | Path,
    path: str | Path,
    *,
    variables: Sequence[str] | None = None,
    axes: Sequence[str] | None = None,
    select: Mapping[str, int | str] | None = None,
    absent: str = ABSENT[0],
    timings: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> PackReport:
    """Make a container of the arrays of a Zarr store that `fhash.transform` coded.

    The bytes of the chunks are copied, so that every value has the bits that zarr decodes from the
    store. Each chunk is decoded once, for the range of the values and to check it. Figures that
    need the original data, such as the PSNR, are not in the file.

    source: a folder or a ZIP of Zarr format 3.
    variables: names of those to pack. By default all that are coded; a further variable of numbers
        is then refused, since it would be lost.
    axes, select: as in `open_series`. A dimension along which an index is selected has chunks of
        length 1.
    absent: "fill" takes the fill value for chunks that the store lacks; "refuse" does so only where
        that value marks missing values, with a warning.
    timings: keep the date; without it the same store gives the same bytes.
    force: replace a file that exists.

    Raises InputError for arrays that have to be coded again, and for chunks that are missing;
    DamagedFileError for damaged chunks; OutputExistsError and OutputError.
    """
    begun = time.perf_counter()
    source, path = _folder(source), Path(os.path.normpath(path))
    if absent not in ABSENT:
        raise InputError(f"absent is '{absent}'; allowed: {', '.join(ABSENT)}")
    check_name(path)
    check_output(path, force, sources=[source])
    root, names = _all_coded(source) if variables is None else (source, list(variables))
    request = Request(axes=None if axes is None else tuple(axes), select=selection(select))
    job = _Job(source=root, request=request, absent=absent, timings=timings, progress=progress)
    figures: dict[str, PackedVariable] = {}
    several = names if len(names) > 1 else ()
    with ContainerWriter(path, force=force, variables=several) as writer:
        if len(names) == 1:
            with job.opened(names[0]) as (series, array):
                header, figures[array.name] = job.write(writer, series, array, "")
            size = writer.commit(header)
        else:
            size = _write_several(writer, job, names, figures)
    raw = sum(each["raw_bytes"] for each in figures.values())
    return {
        "path": str(path),
        "bytes": size,
        "source_bytes": bytes_on_disk([source]),
        "raw_bytes": raw,
        "ratio": raw / size,
        "seconds": time.perf_counter() - begun,
        "variables": figures,
    }


def _write_several(
    writer: ContainerWriter, job: _Job, names: Sequence[str], figures: dict[str, PackedVariable]
) -> int:
    """Write several variables, and add the figures of each; the bytes of the file."""
    for name in names:
        # Every variable is opened once, so that one that cannot be taken is refused at once.
        with job.opened(name) as (series, _):
            metadata = series.metadata
    writer.attributes = {} if metadata is None else json_attributes(metadata.attributes)
    for number, name in enumerate(names, start=1):
        with job.opened(name) as (series, array):
            note = f"{name}, {number} of {len(names)}"
            header, figures[name] = job.write(writer, series, array, note)
        writer.finish(header)
    return writer.commit()


@dataclass(frozen=True, kw_only=True)
class _Job:
    """The wishes about a store, and how one of its variables is written."""

    source: Path
    request: Request
    absent: str
    timings: bool
    progress: Progress

    @contextmanager
    def opened(self, name: str) -> Iterator[tuple[FileSeries, CodedArray]]:
        """The series of a variable and its chunks."""
        request = Request(var=name, axes=self.request.axes, select=self.request.select)
        with open_coded(self.source, request) as opened:
            yield opened

    def write(
        self, writer: ContainerWriter, series: FileSeries, array: CodedArray, note: str
    ) -> tuple[dict[str, Any], PackedVariable]:
        """Write the arrays of a variable; its header and its figures."""
        nothing = Scan(value_range=ValueRange(0.0, 0.0), mean=0.0, finite_count=0, missing={})
        described = write_series(
            writer,
            series,
            nothing,
            range(series.shape[0]),
        )
        tiles = Tiles(array, series.source, fill_absent=self.absent == "fill")
        total = len(tiles)
        self.progress("packing", 0, total, note)
        writer.add_array(
            TABLE,
            shape=array.shape,
            dtype=array.dtype,
            chunk_shape=array.tile,
            together=tiles.metadata.together,
            chunks=tiles.streams(lambda done: self.progress("packing", done, total, note)),
            codecs=tiles.codecs,
        )
        tiles.check_against_store()
        series.check()
        facts = tiles.facts
        if facts.absent and self.absent != "fill":
            warnings.warn(
                f"{self.source}: the store lacks {facts.absent} of {total} chunks of {array.name}, "
                "which have no value in the container either; pack it again if it was still being"
                " written",
                FhashWarning,
                stacklevel=4,
            )
        if facts.mean.count == 0:
            raise InputError(
                f"{series.source}: variable {array.name} has no finite value; nothing to pack"
            )
        scan = Scan(
            value_range=facts.value_range,
            mean=min(max(facts.mean.value(), facts.low), facts.high),
            finite_count=facts.mean.count,
            missing=facts.missing,
        )
        if scan.missing:
            write_missing(writer, series.shape, scan)
        config = EncodeConfig(timings=self.timings)
        header = _header(series, array, tiles, scan, described, config)
        raw = prod(array.shape) * array.dtype.itemsize
        return header, {
            "shape": list(array.shape),
            "tile": list(array.tile),
            "tiles": total,
            "absent": facts.absent,
            "bytes": facts.bytes,
            "raw_bytes": raw,
            "value_range": [scan.value_range.low, scan.value_range.high],
            "codec": array.quality,
        }


def _header(
    series: FileSeries,
    array: CodedArray,
    tiles: Tiles,
    scan: Scan,
    described: Mapping[str, Any],
    config: EncodeConfig,
) -> dict[str, Any]:
    """The header of a variable. What only the original data could tell is not in it."""
    coder, facts = tiles.metadata.tiles, tiles.facts
    settings = None if coder is None else coder.settings
    source = describe_source(series, scan.value_range, config)
    weights = 0
    if settings is not None and settings.head is not None:
        weights = settings.head.size
    bound = {name: array.quality[name] for name in ("max_error",) if name in array.quality}
    encoder = {**source["encoder"], "command": PACKED}
    return {
        **source,
        **described,
        "required_features": ["transform"],
        "encoder": {**encoder, **({"codec": array.quality} if array.quality else {})},
        "background": exact_number(_in_type(scan.mean, array.dtype)),
        "feature_bounding_box": [[0, n] for n in array.shape[1:]],
        "features": ["all"],
        "dilation": 0,
        "coreset_fraction": facts.occupied / prod(array.shape),
        "model": {
            "profile": "compact",
            "levels": [list(array.shape)],
            "embedding_size": 1,
            "tables": array.dtype.name,
            "parameters": weights,
        },
        "config": {**config.settings(), **bound},
        "quality": {},
        "training": {"seconds": None, "steps": 0, "epochs": 0, "device": "none"},
        "history": {},
    }


def _in_type(value: float, dtype: np.dtype[Any]) -> float:
    """A number within the range of the type of the values."""
    return float(dtype.type(value)) if dtype.kind == "f" else value


def _folder(source: str | Path) -> Path:
    """The path of a store; raises InputError for a URL, MissingInputError without a file."""
    if "://" in str(source):
        raise InputError(f"{source}: a store is packed from a folder or a ZIP; copy it here first")
    if not Path(source).exists():
        raise MissingInputError(f"{source}: no such file or folder")
    return Path(os.path.normpath(source))


def _all_coded(source: Path) -> tuple[Path, list[str]]:
    """The store, and the names of its variables, all of which are coded.

    Raises InputError where there is none, and where others would be lost.
    """
    root, coded = coded_names(source)
    names = [name for name, is_coded in coded.items() if is_coded]
    if not names:
        raise InputError(
            f"{source} has no variable that fhash.transform coded in Zarr format 3: "
            f"fhash encode {source}"
        )
    lost = [name for name in encodable(list_variables(root)) if name in coded.keys() - names]
    if lost:
        raise InputError(
            f"{source}: variable {lost[0]} is not coded by fhash.transform and would be left out; "
            f"name those to pack by --var {','.join(names)}, or use fhash encode {source}"
        )
    return root, names
