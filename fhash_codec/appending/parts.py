"""Parts of a series, each a container, and their merging."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypedDict, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.series_plan import DIGESTS, SeriesPlan, bounded, code_layers
from fhash_codec.compact.tiles import Blocks, CodedTiles
from fhash_codec.comparison import Report, measure, report, ssim_budget, steps_of_ssim
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Extent, packed_masks, resolve_features
from fhash_codec.features.occupancy import BLOCK, has_blocks, read_bits, unpack, write_blocks
from fhash_codec.features.scan import Scan, scan_steps
from fhash_codec.features.selection import Source, mask_files, open_source
from fhash_codec.header import (
    brief_quality,
    check_name,
    describe_source,
    described_source,
    write_series,
)
from fhash_codec.measure.metrics import Comparer, Comparison
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import SOURCE, Container, ContainerWriter
from fhash_formats.container.growing import TableParts
from fhash_formats.container.header import BITS_ARRAY, EVERYTHING, MISSING_ARRAY, NOT_STORED, TABLE
from fhash_formats.container.record import Record
from fhash_formats.container.zip_file import damage_named
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.readers.belonging import Labels, require_alike
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate, Series, StepsSeries
from fhash_formats.support.files import check_output, many_files
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile_format import TileSettings

PART = "part"
"""Key of a part's header: its `number`, from 1, `of` so many parts; `first`, its first step in the
whole, and the `steps` of that; `size` and `nonzero`, bytes of its tiles and coefficients in them
other than 0; `ssim_steps`, the steps of the whole whose SSIM counts; `source`, that of the whole,
in part 1 alone. Part i of N has the layers of tiles from floor(L (i - 1) / N) to floor(L i / N)."""
ERRORS = "step_errors"
"""Array of a part: sums of the errors of each step, of which the figures of the whole follow."""
WHOLE = "whole/"
"""Prefix of arrays of the first part that belong to the whole series."""
COLUMNS = 10
"""Numbers that it has for each step, see `_row`."""
COUNTS = (0, 3, 5, 9)
"""Those of them that count vertices."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of several parts of a series, counted from 1.

    Raises InputError for a part that is none of them.
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise InputError(
                f"part {self.number}/{self.of}; allowed: 1/{self.of} to {self.of}/{self.of}"
            )

    @classmethod
    def parse(cls, text: str) -> Part:
        """The part that a text such as "3/16" names; raises InputError for another text."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None:
            raise InputError(f"part '{text}'; allowed: I/N, such as 3/16 for the third of 16")
        return cls(number=int(match[1]), of=int(match[2]))

    def layers(self, count: int) -> range:
        """The layers of tiles that the part has of `count`; raises InputError for too few."""
        if count < self.of:
            raise InputError(
                f"{self.of} parts of {count} layers of tiles: each part needs one; ask for "
                f"{count} parts at most, or for tiles of fewer steps (--tile)"
            )
        return range(count * (self.number - 1) // self.of, count * self.number // self.of)


def encode_part(
    source: Source,
    path: str | Path,
    config: EncodeConfig | None,
    part: Part,
    *,
    plan: SeriesPlan | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Report:
    """Encode one part of a series; `merge` makes one file of all of them.

    The arguments are those of `encode`; the promise is a bound of the error, and times are not
    kept, so that the parts make the file of `encode` with `timings=False`, byte for byte.

    plan: of the whole series, as `plan_parts` makes it once for all parts; then only the steps of
        the part are read. It has the settings; those of `config` must be the same, if given. The
        part plans the whole series by itself if None.

    Raises what `encode` raises, and InputError for a promise that no part alone can keep and for a
    plan of other data or settings.
    """
    path = Path(path)
    config = _settings(config, plan)
    check_name(path)
    check_output(path, force)
    begun = time.perf_counter()
    with open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        if plan is None:
            plan = SeriesPlan.make(series, config, progress)
        plan.require(series)
        quality = _Job(series, plan, part).write(path, force, progress)
        series.check()
        with open_volume(path) as volume:
            return report(volume, quality, seconds=time.perf_counter() - begun, files=series.files)


def _settings(config: EncodeConfig | None, plan: SeriesPlan | None) -> EncodeConfig:
    """The settings of a part; raises InputError where they are not those of its plan."""
    if plan is None:
        return bounded(config or EncodeConfig())
    if config is not None:
        plan.require_settings(vars(config))
    return plan.config


def comparison_of(errors: npt.NDArray[np.float64], first: int) -> Comparison:
    """The comparison of the steps of a part, which begin at step `first` of the whole.

    errors: (steps, COLUMNS), as a part has them.
    """
    coreset, domain, similarity = np.split(errors, [DOMAIN, SIMILARITY], axis=1)
    return Comparison(
        stop=first + len(errors),
        coreset=coreset,
        domain=np.pad(domain, ((0, 0), (0, coreset.shape[1] - domain.shape[1]))),
        similarity=similarity,
        between=None,
        seconds=0.0,
        ssim_seconds=0.0,
    )


def _rows(comparison: Comparison) -> npt.NDArray[np.float64]:
    """The numbers of each step: sums over the coreset, the domain, and the similarity."""
    domain = comparison.domain[:, : SIMILARITY - DOMAIN]
    return np.hstack([comparison.coreset, domain, comparison.similarity])


class _Job:
    """A part that is to be coded, measured and written."""

    def __init__(self, series: Series, plan: SeriesPlan, part: Part) -> None:
        self.series, self.plan, self.part = series, plan, part
        self.layers = part.layers(plan.layers)
        self.steps = plan.steps(self.layers)

    def write(self, path: Path, force: bool, progress: Progress) -> dict[str, Any]:
        """Write the part and measure it; its quality."""
        plan = self.plan
        missing = scan_steps(
            self.series,
            self.steps,
            plan.value_range,
            may_miss=plan.has_missing,
            progress=progress,
        )
        blocks = self._blocks(missing, progress)
        with thread_pool() as workers:
            coded = code_layers(blocks, plan.recipe, self.layers, workers, progress)
        blocks.forget()  # measuring needs the memory
        with ContainerWriter(path, force=force) as writer:
            header = self._write_arrays(writer, blocks, coded, missing)
            quality, errors, whole = self._measured(writer, header, progress)
            writer.add_whole(ERRORS, errors)
            low, high = header["value_range"]
            header["quality"] = brief_quality(
                writer, quality, high - low, (len(self.steps), *self.series.shape[1:])
            )
            header[PART] |= {
                "number": self.part.number,
                "of": self.part.of,
                "first": self.steps.start,
                "steps": self.series.shape[0],
                "size": coded.outcome.size,
                "nonzero": coded.outcome.nonzero,
                "ssim_steps": whole,
                "series": [self.plan.labels[name] for name in DIGESTS],
            }
            writer.commit(header)
        return quality

    def _blocks(self, missing: Mapping[int, npt.NDArray[np.uint8]], progress: Progress) -> Blocks:
        """The series in tiles, of which those of the part can be read."""
        plan, shape = self.plan, self.series.shape
        packed = [np.empty(0, np.uint8)] * shape[0]  # those of other steps are not looked at
        if plan.samples < shape[0] * prod(plan.box.shape):
            features = resolve_features(
                plan.features, self.series, range(shape[0]), plan.value_range, progress
            )
            dilation = plan.config.dilation
            masks = packed_masks(self.series, missing, self.steps, features, dilation)
            for step, mask in masks.items():
                packed[step] = mask
        extent = Extent(
            box=plan.box,
            key_frames=tuple(range(shape[0])),
            packed=packed,
            domain=shape[1:],
            samples=plan.samples,
            background=plan.header["background"],
        )
        dtype = self.series.source_dtype or self.series.dtype
        origin = plan.value_range.origin(dtype)
        return Blocks(self.series, extent, plan.recipe.tile, origin).by_layers()

    def _write_arrays(
        self,
        writer: ContainerWriter,
        blocks: Blocks,
        coded: CodedTiles,
        missing: Mapping[int, npt.NDArray[np.uint8]],
    ) -> dict[str, Any]:
        """Write coordinates, masks and tiles; the header without its quality."""
        plan, steps = self.plan, StepsSeries(self.series, self.steps)
        value_range = plan.value_range
        scanned = Scan(
            value_range=value_range,
            mean=value_range.low,
            finite_count=0,
            missing={step - self.steps.start: bits for step, bits in missing.items()},
        )
        described = write_series(
            writer,
            steps,
            scanned,
            range(len(self.steps)),
            everything=EVERYTHING in plan.features,
        )
        source = self._write_source(writer)
        parts = TableParts(
            shape=(len(self.steps), *blocks.shape[1:]),
            dtype=blocks.source_dtype,
            tile=blocks.tile,
            settings=replace(plan.recipe.settings, origin=blocks.origin),
            streams=coded.streams,
        )
        parts.write(writer)
        if has_blocks(parts.settings.mask is not None, plan.features):
            # of vertices: those of the whole are not known
            write_blocks(writer, partial(self._mask, blocks), parts.shape, 0)
        own = deepcopy(dict(plan.header))
        own["required_features"] = ["transform"]
        own["model"]["levels"] = [list(parts.shape)]
        own["model"]["parameters"] += coded.outcome.nonzero
        gaps = plan.samples < prod(self.series.shape)
        told = describe_source(steps, value_range, plan.config, gaps=gaps)
        return {**told, **described, **own, PART: source}

    def _mask(self, blocks: Blocks, step: int) -> npt.NDArray[np.bool_]:
        """The mask (z, y, x) of the box at a step of the part."""
        at = self.steps.start + step
        found = blocks.masks(range(at, at + 1))
        return np.ones(blocks.shape[1:], np.bool_) if found is None else found[0]

    def _measured(
        self, writer: ContainerWriter, header: Mapping[str, Any], progress: Progress
    ) -> tuple[dict[str, Any], npt.NDArray[np.float64], list[int]]:
        """The quality of what is written, the errors of each step, and the steps of the SSIM."""
        rows: list[npt.NDArray[np.float64]] = []
        whole = steps_of_ssim(self.series, ssim_budget(self.plan.config))
        with Volume(writer.preview(header)) as volume:
            quality = measure(
                StepsSeries(self.series, self.steps),
                volume,
                progress,
                [step - self.steps.start for step in whole if step in self.steps],
                lambda comparison: rows.append(_rows(comparison)),
            )
        return quality, np.concatenate(rows), whole

    def _write_source(self, writer: ContainerWriter) -> dict[str, Any]:
        """Write what belongs to the whole series in its source, in the first part alone."""
        if self.part.number != 1:
            return {}
        whole = describe_source(self.series, self.plan.value_range, self.plan.config)
        for name, array in described_source(self.series, self.series.coords, {})[1].items():
            writer.add_whole(f"{WHOLE}{name}", array)
        kept = {SOURCE: whole.get(SOURCE), NOT_STORED: whole["variable"].get(NOT_STORED)}
        return {key: value for key, value in kept.items() if value is not None}


DOMAIN = 5
"""Number in a row of errors of the first that is of the whole domain."""
SIMILARITY = 8
"""Number in a row of errors that is the sum of the SSIM; the next one is its count."""
SIMILAR = 1.001
"""Largest SSIM of a vertex, rounding included."""
MOST_ERROR = 4.0
"""Largest error, and square of one, with the range of the values scaled to at most 1."""
OWN = ("coordinates", "domain", "quality", "required_features", SOURCE, PART)
"""Keys of a part's header that differ from part to part."""
OWN_MODEL = ("levels", "parameters")
"""Keys of its model that do."""
OWN_VARIABLE = ("fill", NOT_STORED)
"""Keys of its variable that do: of values that some steps alone have."""


class MergeReport(TypedDict):
    """A file that was joined of parts."""

    path: Annotated[str, "the file written"]
    bytes: Annotated[int, "its size"]
    parts: Annotated[int, "files that were joined"]
    steps: Annotated[int, "its steps"]
    tiles: Annotated[int, "tiles that were copied"]
    psnr: Annotated[float | None, "dB over all steps"]
    rmse: Annotated[float | None, "root of the mean squared error, in data units"]
    max_abs_error: Annotated[float | None, "largest error, in data units"]


def merge(
    paths: Sequence[str | Path],
    output: str | Path,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> MergeReport:
    """Join the parts of a series, given in any order, to the container `output`.

    paths: files of `encode_part`, or `fhash encode --part`. Tiles are copied, and checked by their
    checksums; none is coded again. The result is, byte for byte, the file of one encoding with the
    same settings and `timings=False`.

    Raises InputError for files that are no parts or not of one encoding, for gaps and overlaps;
    DamagedFileError for damaged ones; OutputExistsError and OutputError.
    """
    joined = join_parts(paths, output, force=force, progress=progress)
    return {
        "path": str(output),
        "bytes": joined.size,
        "parts": joined.parts,
        "steps": joined.steps,
        "tiles": joined.tiles,
        "psnr": joined.quality["psnr"],
        "rmse": joined.quality["rmse"],
        "max_abs_error": joined.quality["max_abs_error"],
    }


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
        bits = container.arrays.get(BITS_ARRAY)
        exact = bits is not None and BLOCK not in bits.attributes
        if has_blocks(table.masked, header["features"]) and not exact:
            raise DamagedFileError(f"{self.path}: array {BITS_ARRAY} is missing or not of vertices")
        self.table, self.settings = table, table.settings
        self.errors = errors.read()
        if not _are_sums(self.errors, prod(header["domain"]["shape"][1:])):
            raise DamagedFileError(f"{self.path}: array {ERRORS} has numbers that are no errors")

    @cached_property
    def labels(self) -> Labels:
        """The labels that tell its series from others."""
        coords = {axis: self.container.coordinate(AXIS_NAMES[axis]) for axis in AXES}
        return Labels.of_file(self.path, self.container.header, coords)

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
            "frame": header["domain"]["shape"][1:],
            "bulk": (header["quality"].get("bulk") or {}).get("range"),
            "tile": self.table.chunk_shape,
            "settings": self.settings.to_bytes(),
            "positions": [(c.name, c.attributes, c.values.tobytes()) for c in positions],
            "time": (time.name, time.attributes),
            "series": header[PART].get("series"),
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
        require_alike(part.labels, first.labels)
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

    def tiles(self) -> Iterator[tuple[_Piece, tuple[int, ...]]]:
        """Part and index of each tile, in C order of the whole."""
        for part in self.parts:
            for index in product(*map(range, part.table.grid)):
                yield part, index

    def sizes(self) -> npt.NDArray[np.int64]:
        """Bytes of each tile, from the indices of the parts."""

        def size(part: _Piece, place: tuple[int, ...]) -> int:
            with damage_named(part.path):
                return part.table.place(place)[1]

        return np.fromiter((size(*place) for place in self.tiles()), np.int64, len(self))

    def __len__(self) -> int:
        return sum(prod(part.table.grid) for part in self.parts)

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | Sequence[bytes]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        return _read(*next(islice(self.tiles(), index, None)))

    def __iter__(self) -> Iterator[bytes]:
        return (_read(part, place) for part, place in self.tiles())


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
        if has_blocks(table.settings.mask is not None, header["features"]):
            self._write_blocks(writer, table)
        progress("merging", 1, 1, "")
        header["variable"] = self._variable()
        if SOURCE in first.container.header[PART]:
            header[SOURCE] = first.container.header[PART][SOURCE]
        header["required_features"] = ["transform"]
        header["coordinates"] = described["coordinates"]
        header["domain"] = {"shape": list(self.shape)}
        header["model"] = self._model(table)
        quality = self._quality(ValueRange(low, high), header["background"])
        header["quality"] = brief_quality(writer, quality, high - low, self.shape)
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
            stored = part.container.arrays.get(MISSING_ARRAY)
            if stored is not None:
                steps = enumerate(stored.read(), start=part.first)
                rows.update({step: bits for step, bits in steps if bits.any()})
        return rows

    def _write_blocks(self, writer: ContainerWriter, table: TableParts) -> None:
        """Write the occupancy of the whole."""
        _, *box = table.shape

        def mask(step: int) -> npt.NDArray[np.bool_]:
            part = next(part for part in reversed(self._parts) if part.first <= step)
            (bits,) = read_bits(part.container, step - part.first, step - part.first + 1)
            return unpack(bits, (box[0], box[1], box[2]))

        write_blocks(writer, mask, table.shape, int(self.streams.sizes().sum()))

    def _model(self, table: TableParts) -> dict[str, Any]:
        """The model of the whole: that of a part, with the numbers of all of them."""
        first = self._parts[0]
        model = dict(first.container.header["model"])
        weights = model["parameters"] - first.nonzero
        model["levels"] = [list(table.shape)]
        model["parameters"] = sum(part.nonzero for part in self._parts) + weights
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
            comparer.add(comparison_of(part.errors, part.first))
        return comparer.quality(first.ssim_steps).to_dict()
