"""`merge`: the files of all parts of a series become one, without coding again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.parts import COLUMNS, COUNTS, ERRORS, PART, WHOLE, comparisons_of
from fhash_codec.compact.tiles_to_promise import all_tiles
from fhash_codec.container_name import check_name
from fhash_codec.coreset.scan import Scan
from fhash_codec.header import brief_quality, write_series
from fhash_codec.measure.metrics import Comparer
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_formats.container import SOURCE, Container, ContainerWriter
from fhash_formats.container.header import NOT_STORED, TABLE
from fhash_formats.container.record import Record
from fhash_formats.container.source import damage_named
from fhash_formats.container.table_parts import TableParts
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate, Series
from fhash_formats.support.atomic import check_output
from fhash_formats.support.open_files import many_files
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["Joined", "join_parts", "merge"]

SIMILARITY = 8
"""Number in a row of errors that is the sum of the SSIM; the next one is its count."""
SIMILAR = 1.001
"""Largest SSIM of a vertex, rounding included."""
MOST_ERROR = 4.0
"""Largest error, and square of one, with the range of the values scaled to at most 1."""
OWN = ("coordinates", "domain", "quality", "required_features", SOURCE, PART)
"""Keys of a part's header that differ from part to part."""
OWN_MODEL = ("levels", "parameters", "gains")
"""Keys of its model that do."""
OWN_VARIABLE = ("fill", NOT_STORED)
"""Keys of its variable that do: of values that some steps alone have."""


def merge(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Join the parts of a series, given in any order, to the container `output`.

    paths: files of `encode_part`, or `fhash encode --part`. Tiles are copied, and checked by their
    checksums; none is coded again. The result is, byte for byte, the file of one encoding with the
    same settings and `timings=False`.

    Returns path, bytes, parts, steps and tiles; psnr, rmse and max_abs_error over all steps. Raises
    InputError for files that are no parts or not of one encoding, for gaps and overlaps;
    DamagedFileError for damaged ones; OutputExistsError and OutputError.
    """
    joined = join_parts(paths, output, force=force, progress=progress)
    figures = {name: joined.quality[name] for name in ("psnr", "rmse", "max_abs_error")}
    counted = {"parts": joined.parts, "steps": joined.steps, "tiles": joined.tiles}
    return {"path": str(output), "bytes": joined.size, **counted, **figures}


class Joined(NamedTuple):
    """A file that was made of parts: bytes, counts, and its quality as `report` takes it."""

    size: int
    parts: int
    steps: int
    tiles: int
    quality: dict[str, Any]


def join_parts(
    paths: Sequence[str | Path], output: str | Path, *, force: bool, progress: Progress
) -> Joined:
    """Join parts to a container; arguments and errors are those of `merge`."""
    output = Path(output)
    check_name(output)
    check_output(output, force, sources=list(paths))
    with many_files(len(paths)), ExitStack() as stack:
        parts = [_Piece(stack.enter_context(Container.open(path))) for path in paths]
        parts.sort(key=lambda part: part.first)
        _require_whole(parts)
        whole = _Whole(parts)
        with ContainerWriter(output, force=force) as writer:
            header, quality = whole.write(writer, progress)
            size = writer.commit(header)
    return Joined(size, len(parts), whole.shape[0], len(whole.streams), quality)


class _Piece:
    """A part that is read.

    Raises InputError for a container that is no part, DamagedFileError for one that contradicts
    itself.
    """

    def __init__(self, container: Container) -> None:
        self.container, self.path = container, container.path
        header = container.header
        if container.variables or PART not in header:
            raise InputError(
                f"{self.path} is no part of a series but a whole file; parts are made by "
                "fhash encode --part I/N"
            )
        record = Record(header, "header key ").record(PART)
        most = 1 << 40
        self.of = record.integer("of", 1, most)
        self.number = record.integer("number", 1, self.of)
        self.steps = record.integer("steps", 1, most)
        self.first = record.integer("first", 0, self.steps - 1)
        self.size = record.integer("size", 0, 1 << 62)
        self.nonzero = record.integer("nonzero", 0, 1 << 62)
        count = len(record.get("ssim_steps")) if isinstance(record.get("ssim_steps"), list) else 0
        self.ssim_steps = list(record.integers("ssim_steps", count, 0, self.steps - 1))
        self.length = int(header["domain"]["shape"][0])
        errors = container.arrays.get(ERRORS)
        table = container.arrays.get(TABLE)
        if errors is None or errors.shape != (self.length, COLUMNS) or errors.dtype != np.float64:
            raise DamagedFileError(f"{self.path}: array {ERRORS} is missing or does not fit")
        if table is None or not isinstance(table.settings, TileSettings):
            raise DamagedFileError(f"{self.path}: array {TABLE} has no settings of all tiles")
        if not isinstance(header["model"].get("gains"), list):
            raise DamagedFileError(f"{self.path}: header key model.gains is missing or no list")
        self.table, self.settings = table, table.settings
        self.errors = errors.read()
        if not _are_sums(self.errors, prod(header["domain"]["shape"][1:])):
            raise DamagedFileError(f"{self.path}: array {ERRORS} has numbers that are no errors")

    @cached_property
    def shared(self) -> dict[str, Any]:
        """The keys and settings that all parts of a series have in common."""
        header = self.container.header
        model = {name: value for name, value in header["model"].items() if name not in OWN_MODEL}
        positions = [self.container.coordinate(axis) for axis in ("z", "y", "x")]
        time = self.container.coordinate("time")
        return {
            **{name: value for name, value in header.items() if name not in OWN},
            "variable": {
                name: value
                for name, value in header["variable"].items()
                if name not in OWN_VARIABLE
            },
            "model": model,
            "gains": header["model"]["gains"][:-1],
            "frame": header["domain"]["shape"][1:],
            "bulk": (header["quality"].get("bulk") or {}).get("range"),
            "tile": self.table.chunk_shape,
            "settings": self.settings.to_bytes(),
            "positions": [(c.name, c.attributes, c.values.tobytes()) for c in positions],
            "time": (time.name, time.attributes),
            "parts": (self.of, self.steps, self.ssim_steps),
        }


def _are_sums(errors: npt.NDArray[np.float64], vertices: int) -> bool:
    """Whether numbers can be sums of the errors of steps of so many vertices, see `_row`."""
    counts, others = errors[:, COUNTS], np.delete(errors, [*COUNTS, SIMILARITY], axis=1)
    similarity = np.abs(errors[:, SIMILARITY])
    return bool(
        np.isfinite(errors).all()
        and ((counts >= 0) & (counts <= vertices) & (counts == np.rint(counts))).all()
        and ((others >= 0) & (others <= MOST_ERROR * (1 + vertices))).all()
        and (similarity <= errors[:, SIMILARITY + 1] * SIMILAR).all()
    )


def _require_whole(parts: Sequence[_Piece]) -> None:
    """Raise InputError unless parts are of one encoding and make up all of its steps."""
    if not parts:
        raise InputError("no parts are given; name the files of fhash encode --part")
    first, end = parts[0], 0
    for part in parts:
        different = [name for name, value in part.shared.items() if first.shared.get(name) != value]
        if different or part.shared.keys() != first.shared.keys():
            what = different[0] if different else "header"
            raise InputError(
                f"{part.path} and {first.path} are not of one encoding, they differ in {what}; "
                "parts need the same data, settings and version of fhash"
            )
        if part.first < end:
            raise InputError(
                f"{part.path} has steps from {part.first} on, and the parts before reach to "
                f"{end - 1}; give each part once"
            )
        if part.first > end:
            raise InputError(_gap(parts, end, part.first))
        if part.length % part.table.chunk_shape[0] and part.first + part.length < part.steps:
            raise DamagedFileError(f"{part.path}: its last layer of tiles is not whole")
        end = part.first + part.length
    if end != first.steps:
        raise InputError(_gap(parts, end, first.steps))


def _gap(parts: Sequence[_Piece], start: int, end: int) -> str:
    known = {part.number for part in parts}
    lacking = [number for number in range(1, min(parts[0].of, 1 << 20) + 1) if number not in known]
    names = ", ".join(f"{number}/{parts[0].of}" for number in lacking[:5])
    return f"steps {start} to {end - 1} are missing: parts {names}; encode them and merge again"


@dataclass(frozen=True)
class _Streams(Sequence[bytes]):
    """The tiles of several parts, one after the other in time, read when they are asked for."""

    parts: Sequence[_Piece]

    def places(self) -> Iterator[tuple[_Piece, tuple[int, ...]]]:
        """Part and index of each tile, in C order of the whole."""
        for part in self.parts:
            for index in product(*map(range, part.table.grid)):
                yield part, index

    def sizes(self) -> npt.NDArray[np.int64]:
        """Bytes of each tile, from the indices of the parts."""

        def size(part: _Piece, place: tuple[int, ...]) -> int:
            with damage_named(part.path):
                return part.table.coded_bytes(place)

        return np.fromiter((size(*place) for place in self.places()), np.int64, len(self))

    def __len__(self) -> int:
        return sum(prod(part.table.grid) for part in self.parts)

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | Sequence[bytes]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        return _read(*next(islice(self.places(), index, None)))

    def __iter__(self) -> Iterator[bytes]:
        return (_read(part, place) for part, place in self.places())


def _read(part: _Piece, place: tuple[int, ...]) -> bytes:
    """The bytes of a tile, checked; raises DamagedFileError that names the part."""
    with damage_named(part.path):
        return bytes(part.table.coded(place))


class _Positions(Series):
    """The labels of the whole series; its values are in the parts."""

    def __init__(
        self,
        shape: tuple[int, int, int, int],
        coords: Mapping[str, Coordinate],
        variable: Mapping[str, Any],
    ) -> None:
        self.source, self.shape, self.coords = "parts", shape, coords
        self.name, self.units = variable["name"], variable["units"]
        self.attributes, self.dtype = variable["attributes"], np.dtype(variable["dtype"])

    def read(self, step: int) -> npt.NDArray[Any]:
        raise InputError("a series of parts has labels alone")


class _Whole:
    """All parts of a series, in the order of their steps."""

    def __init__(self, parts: Sequence[_Piece]) -> None:
        self._parts = parts
        frame = parts[0].container.header["domain"]["shape"][1:]
        self.shape: tuple[int, int, int, int] = (parts[0].steps, *frame)
        self.streams = _Streams(parts)

    def write(
        self, writer: ContainerWriter, progress: Progress
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Write the arrays of the whole; its header, and its quality with all digits."""
        first = self._parts[0]
        header = dict(first.container.header)
        for name in (PART, "format", "format_version"):
            del header[name]
        low, high = header["value_range"]
        scan = Scan(
            value_range=ValueRange(low, high), mean=low, finite_count=0, missing=self._missing()
        )
        series = _Positions(self.shape, self._coords(), header["variable"])
        described = write_series(writer, series, scan, range(self.shape[0]))
        for name, array in first.container.arrays.items():
            if name.startswith(WHOLE):
                writer.add_whole(name.removeprefix(WHOLE), array.read())
        table = TableParts(
            shape=(self.shape[0], *first.table.shape[1:]),
            dtype=first.table.dtype,
            tile=first.table.chunk_shape,
            settings=first.settings,
            streams=self.streams,
            sizes=self.streams.sizes(),
        )
        progress("merging", 0, 1, "")
        table.write(writer)
        progress("merging", 1, 1, "")
        header["variable"] = self._variable()
        if SOURCE in first.container.header[PART]:
            header[SOURCE] = first.container.header[PART][SOURCE]
        header["required_features"] = ["transform"]
        header["coordinates"] = described["coordinates"]
        header["domain"] = {"shape": list(self.shape)}
        header["model"] = self._model(table)
        quality = self._quality(ValueRange(low, high), header["background"])
        header["quality"] = brief_quality(writer, quality, high - low, self.shape[0])
        return header, quality

    def _variable(self) -> dict[str, Any]:
        """The entry of the variable of the whole."""
        headers = [part.container.header for part in self._parts]
        variable = dict(headers[0]["variable"])
        told = {name: variable.pop(name, None) for name in OWN_VARIABLE}
        told["fill"] = next(
            (h["variable"]["fill"] for h in headers if "fill" in h["variable"]), None
        )
        told[NOT_STORED] = headers[0][PART].get(NOT_STORED)
        return variable | {name: value for name, value in told.items() if value is not None}

    def _coords(self) -> dict[str, Coordinate]:
        """The positions of the whole."""
        containers = [part.container for part in self._parts]
        coords = {axis: containers[0].coordinate(AXIS_NAMES[axis]) for axis in AXES}
        times = np.concatenate([one.coordinate("time").values for one in containers])
        time = coords["t"]
        coords["t"] = Coordinate(name=time.name, values=times, attributes=time.attributes)
        return coords

    def _missing(self) -> dict[int, npt.NDArray[np.uint8]]:
        """The bits of the missing values of each step that has some, where parts have an array."""
        rows: dict[int, npt.NDArray[np.uint8]] = {}
        for part in self._parts:
            stored = part.container.arrays.get("missing/bits")
            if stored is not None:
                steps = enumerate(stored.read(), start=part.first)
                rows.update({step: bits for step, bits in steps if bits.any()})
        return rows

    def _model(self, table: TableParts) -> dict[str, Any]:
        """The model of the whole: that of a part, with the numbers of all of them."""
        first = self._parts[0]
        model = dict(first.container.header["model"])
        weights = model["parameters"] - first.nonzero
        model["levels"] = [list(table.shape)]
        model["parameters"] = sum(part.nonzero for part in self._parts) + weights
        last = all_tiles(sum(part.size for part in self._parts))
        model["gains"] = [*model["gains"][:-1], last]
        return model

    def _quality(self, value_range: ValueRange, background: float) -> dict[str, Any]:
        """The quality of the whole, from the sums of each step."""
        first = self._parts[0]
        bulk = first.shared["bulk"]
        comparer = Comparer(
            value_range.high - value_range.low,
            background,
            None if bulk is None else ValueRange(*bulk),
        )
        for part in self._parts:
            for comparison in comparisons_of(part.errors, part.first):
                comparer.add(comparison)
        return comparer.quality(first.ssim_steps).to_dict()
