"""Growing containers: figures, open layers, and how work is taken up after a stop."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.head import JOINT
from fhash_codec.compact.tiles import (
    Coding,
    Outcome,
    Tile,
    Worked,
    code,
    code_tiles,
    coding_of,
    padded_tile,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.header import SEARCH, brief_quality, full_header
from fhash_codec.measure.errors import Errors, ErrorSums, error_sums
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_formats.container import (
    SOURCE,
    Container,
    ContainerWriter,
    StoredArray,
    describe_coordinates,
)
from fhash_formats.container.array import transform_codecs
from fhash_formats.container.growing import GrowingArray, GrowingContainer
from fhash_formats.container.header import (
    COMPACT,
    MISSING_ARRAY,
    NOT_STORED,
    PLAIN_FEATURE,
    STEPS,
    TABLE,
)
from fhash_formats.container.zip_file import damage_named
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import AXIS_NAMES, MAX_SPANS, Coordinate, NotStored
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import PACKING, Values, exact_number, is_within
from fhash_formats.transform.tile import TRELLIS_WEIGHT, WEIGHT, CodedTile, decode_tile
from fhash_formats.transform.tile_format import TileSettings, parse_stream

ROUNDED_ONCE = 1 - 1e-12
"""Factor of a figure that was rounded up to some decimals, so that it is not once more.

Its float may lie above the decimal number.
"""


class Figures:
    """Errors of the steps of a file so far.

    Attributes:
        scale: power of two by which errors are multiplied before they are squared.
        steps: errors of each step, scaled.
    """

    def __init__(self, scale: float, steps: Sequence[ErrorSums] = ()) -> None:
        self.scale = scale
        self.steps = list(steps)

    @staticmethod
    def scale_of(value_range: ValueRange) -> float:
        """The power of two by which errors of values of a range are scaled."""
        width = value_range.high - value_range.low
        return power_of_two(width if width > 0 else max(abs(value_range.high), 1.0))

    @classmethod
    def of_header(cls, header: Mapping[str, Any], scale: float) -> Figures:
        """The errors that a full header (`full_header`) tells, rounded to the worse side.

        Raises InputError for a file that does not tell them of each step.
        """
        steps, *frame = header["domain"]["shape"]
        told = header["quality"].get("per_step", [])
        most = header["quality"].get("max_abs_error")
        # That of all steps is rounded less: it keeps the promise where those of steps may not.
        limit = float(most) if isinstance(most, int | float) else math.inf
        count, errors = math.prod(frame), []
        for step in range(steps):
            figures = told[step] if step < len(told) else {}
            pair: list[Any] = [figures.get(name) for name in ("rmse", "max_abs_error")]
            if not all(isinstance(one, int | float) and one >= 0 for one in pair):
                raise InputError(
                    f"the file does not tell the errors of step {step}, and a longer one could not"
                )
            root = float(pair[0]) * ROUNDED_ONCE * scale
            largest = min(float(pair[1]), limit) * ROUNDED_ONCE * scale
            errors.append(ErrorSums(count, count * root * root, largest))
        return cls(scale, errors)

    def measure(self, original: Values, decoded: Values) -> ErrorSums:
        """The errors of a decoded frame (z, y, x)."""
        sums = error_sums(original, decoded, None, self.scale)
        if sums.number != original.size:
            raise RuntimeError("a decoded frame has values that are not finite")
        return sums

    def header(
        self, writer: ContainerWriter, data_range: float, shape: Sequence[int]
    ) -> dict[str, Any]:
        """The header's `quality`.

        Args:
            writer: of the container; it gets an array for the figures of many steps.
            data_range: width of the header's value range.
            shape: of the series (t, z, y, x).
        """
        errors = Errors(data_range, scale=self.scale)
        errors.take(np.array(self.steps, dtype=np.float64).reshape(-1, len(ErrorSums._fields)))
        whole = {name: getattr(errors, name) for name in ("psnr", "rmse", "max_abs_error")}
        everywhere = {f"{name}_domain": value for name, value in whole.items()}
        per_step = errors.per_step()
        quality: dict[str, Any] = {**whole, **everywhere, "ssim_window": {}, "per_step": per_step}
        return brief_quality(writer, quality, data_range, shape)


DECODED_AGAIN = 8
"""Tiles of which one is decoded from its bytes, as a reader does it."""


class CodedLayer(NamedTuple):
    """A layer of tiles, coded."""

    streams: list[bytes]
    """Bytes of each tile, in C order."""
    errors: list[ErrorSums]
    """Scaled errors of each step."""
    nonzero: int
    """Number of coefficients that are not 0."""
    value_range: ValueRange
    """Range of the values, in data units."""


@dataclass(frozen=True, kw_only=True)
class LayerCoder:
    """Coder of the layers of a file; its tiles keep a strict bound of the error.

    Attributes:
        tile: shape (t, z, y, x) of a tile.
        settings: that all tiles share.
        coding: options of the encoder, the bound among them.
        dtype: number type of the values.
    """

    tile: tuple[int, int, int, int]
    settings: TileSettings
    coding: Coding
    dtype: np.dtype[Any]

    def code(
        self, frames: Sequence[npt.NDArray[Any]], figures: Figures, workers: ThreadPoolExecutor
    ) -> CodedLayer:
        """Code some steps, at most those of a tile; a shorter layer is padded by its last step.

        frames: finite values (z, y, x) of each step. figures: measures the errors.
        """
        values = np.stack(frames)
        decoded = np.empty_like(values)
        grid = [-(-n // length) for n, length in zip(values.shape[1:], self.tile[1:], strict=True)]

        def work(job: tuple[int, tuple[int, ...]]) -> Worked:
            number, index = job
            region = (slice(None), *chunk_region(index, self.tile[1:], values.shape[1:]))
            coded, outcome = self._code(number, padded_tile(values[region], None, self.tile))
            decoded[region] = coded.decoded[tuple(slice(0, n) for n in decoded[region].shape)]
            return coded.data, outcome, None

        coded = code_tiles(enumerate(product(*map(range, grid))), work, workers)
        errors = [figures.measure(*pair) for pair in zip(values, decoded, strict=True)]
        value_range = ValueRange(*_ends(values))
        nonzero = coded.outcome.nonzero
        return CodedLayer(coded.streams, errors, nonzero, value_range)

    def _code(self, number: int, tile: Tile) -> tuple[CodedTile, Outcome]:
        """Code a tile, by settings of its own where its values leave the range of the shared ones.

        The bound holds either way. The shared ones clip such values, and the residual then has to
        bring them back; of the two codings the one with fewer bytes is taken.
        """
        own = replace(self.coding, own_settings=True)
        trials = [(code(tile, other, own), other) for other in self._wider(tile)]
        if not self._is_far(tile):
            trials.insert(0, (code(tile, self.settings, self.coding), self.settings))
        (coded, outcome), settings = min(trials, key=lambda trial: len(trial[0][0].data))
        if number % DECODED_AGAIN == 0:
            again = decode_tile(coded.data, self.tile, self.dtype, settings)
            if not np.array_equal(again, coded.decoded):
                raise RuntimeError(f"tile {number} decodes to other values than its encoder found")
        return coded, outcome

    def _is_far(self, tile: Tile) -> bool:
        """Whether the differences from the origin that tiles share are beyond int64."""
        origin = self.settings.origin
        return origin != 0 and not all(
            is_within(int(end) - origin, np.dtype(np.int64)) for end in _ends(tile.values)
        )

    def _wider(self, tile: Tile) -> Iterator[TileSettings]:
        """Yield settings with a wider range for a tile whose values leave that of the file."""
        shared = self.settings
        ends = ValueRange(*_ends(tile.values))
        low, high = ends.moved(-shared.origin).ends
        if self._is_far(tile):
            origin = ends.origin(self.dtype)
            low, high = ends.moved(-origin).ends
            wider = replace(shared, origin=origin, center=0.0, low=low, high=high)
            yield replace(wider, double=True, head=None, predictor=None)
            return
        if self.coding.exact or (shared.low <= low and high <= shared.high):
            return
        yield replace(
            shared,
            low=min(low, shared.low),
            high=max(high, shared.high),
            head=None,
            predictor=None,
            clip=False,
        )


def _ends(values: npt.NDArray[Any]) -> tuple[float, float]:
    """The least and the greatest of finite values, exactly."""
    return exact_number(values.min().item()), exact_number(values.max().item())


MAX_STEPS = 1 << 20
"""Steps of a growing file: its header tells the errors of each, and has at most 16 MiB."""


class GrowingFile:
    """A compact file under way; a context manager.

    Attributes:
        path: of the file.
        coder: of its layers.
        figures: errors of its steps.
        steps: number of steps in it.
    """

    def __init__(
        self,
        path: Path,
        coder: LayerCoder,
        header: Mapping[str, Any],
        coords: Mapping[str, Coordinate],
        figures: Figures,
        *,
        force: bool = False,
        continues: os.stat_result | None = None,
    ) -> None:
        """Prepare a file without steps.

        header: what stays the same while it grows, `variable` included. coords: of the axes "z",
        "y" and "x"; and name and attributes of "t". force: replace a file that exists. continues:
        state of the file that this one goes on from and replaces.
        """
        self.path, self.coder, self.figures = path, coder, figures
        self._header, self._coords = dict(header), dict(coords)
        self._times: list[float] = []
        self._layers = self._nonzero = 0
        self._range: ValueRange | None = None
        self._container = GrowingContainer(path, force=force, continues=continues)
        frame = tuple(coords[axis].values.size for axis in ("z", "y", "x"))
        self._container.begin()
        self._array = GrowingArray(
            name=TABLE,
            frame=frame,
            dtype=coder.dtype,
            tile=coder.tile,
            codecs=transform_codecs(coder.settings),
        )

    def __enter__(self) -> GrowingFile:
        self._container.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._container.close()

    @property
    def steps(self) -> int:
        """Number of steps that were added."""
        return len(self._times)

    @property
    def times(self) -> tuple[float, ...]:
        """Time of each step."""
        return tuple(self._times)

    @property
    def shape(self) -> tuple[int, ...]:
        """Vertices (z, y, x) of a frame."""
        return tuple(self._array.frame)

    def add(self, layer: CodedLayer, times: Sequence[float], *, publish: bool = True) -> None:
        """Write a layer; with `publish`, make the file complete with it.

        Raises InputError for a file that takes no more steps, OutputError where it cannot be
        written; it then stays as it was.
        """
        self.write_layer(layer.streams, times, layer.nonzero, layer.value_range)
        self.figures.steps.extend(layer.errors)
        if publish:
            self.publish()

    def carry(self, name: str, array: StoredArray) -> None:
        """Write an array that does not depend on time, as another file has it."""
        self._container.add_whole(
            name,
            array.read(),
            dimension_names=array.dimension_names,
            attributes=array.attributes,
        )

    def write_layer(
        self, streams: Sequence[bytes], times: Sequence[float], nonzero: int, values: ValueRange
    ) -> None:
        """Write a layer without making the file complete, nor telling its errors."""
        if len(self._times) + len(times) > MAX_STEPS:
            raise InputError(
                f"{self.path} has {len(self._times)} steps; a file has at most {MAX_STEPS}: "
                "begin another"
            )
        self._container.add_layer(self._array, self._layers, streams)
        self._layers += 1
        self._times.extend(times)
        self._nonzero += nonzero
        known = self._range or values
        self._range = ValueRange(min(known.low, values.low), max(known.high, values.high))

    def publish(self) -> None:
        """Make the file complete, with the layers so far."""
        mark = self._container.mark()
        self._container.begin()
        self._container.describe(self._array, self.steps)
        described = describe_coordinates({**self._coords, "t": self.time})
        self._container.publish(self._full_header(described), mark)

    @property
    def time(self) -> Coordinate:
        """The times of the steps that were added."""
        known = self._coords["t"]
        values = np.array(self._times, dtype=np.float64)
        return Coordinate(name=known.name, values=values, attributes=known.attributes)

    def forget_packing(self) -> None:
        """Keep no packing of the source: the steps that follow are no counts of it."""
        if SOURCE in self._header:
            source = {key: each for key, each in self._header[SOURCE].items() if key != "stored"}
            own = source.get("variable", {})
            source["variable"] = {key: each for key, each in own.items() if key not in PACKING}
            self._header[SOURCE] = source

    def note(self, never: NotStored | None, count: int) -> None:
        """Keep in the header what nobody wrote of the next `count` steps, and of those before."""
        variable = dict(self._header["variable"])
        before = variable.pop(NOT_STORED, None)
        told = [] if before is None else [(before, 0, self.steps)]
        told += [] if never is None else [(never.to_dict(), self.steps, count)]
        if told:
            share = sum(each["share"] * steps for each, _, steps in told) / (self.steps + count)
            spans = [
                [min(first + low, first + steps), min(first + high, first + steps)]
                for each, first, steps in told
                for low, high in each["steps"]
                if low < steps
            ]
            # of a file that keeps fewer steps than it told of, the share is a bound
            share = min(share, sum(high - low for low, high in spans) / (self.steps + count))
            fills = {each.get("fill") for each, _, _ in told}
            variable[NOT_STORED] = {"share": round(share, 6), "steps": spans[:MAX_SPANS]}
            if len(fills) == 1 and None not in fills:
                variable[NOT_STORED]["fill"] = fills.pop()
        self._header["variable"] = variable

    def _full_header(self, described: Mapping[str, Any]) -> dict[str, Any]:
        """The header of the file as it is now. described: the positions that it tells."""
        assert self._range is not None
        settings = self.coder.settings
        shape = [self.steps, *self._array.frame]
        weights = 0 if settings.head is None else settings.head.size
        return {
            **self._header,
            "required_features": ["transform"],
            "domain": {"shape": shape},
            "value_range": [self._range.low, self._range.high],
            "coordinates": described,
            "model": {
                **self._header["model"],
                "levels": [shape],
                "parameters": self._nonzero + weights,
            },
            "quality": self.figures.header(
                self._container, self._range.high - self._range.low, shape
            ),
        }


@contextmanager
def continued(path: Path, steps: int | None = None) -> Iterator[GrowingFile]:
    """The file `path` for further layers; it stays as it is until the first one is added.

    steps: number of its steps to keep; all if None.

    Raises InputError for a file that cannot be continued or does not end with a whole layer,
    MissingInputError and DamagedFileError as `Container.open`.
    """
    state = os.stat(path) if path.exists() else None
    with Container.open(path) as container:
        assert state is not None
        if container.variables:
            raise InputError(f"{path} has several variables; only a file of one can grow")
        header = full_header(container.header, container.arrays)
        settings = _settings(container, header)
        kept = _steps_to_keep(container, steps)
        value_range = ValueRange(*header["value_range"])
        growing = GrowingFile(
            path,
            _coder(path, container.arrays[TABLE], settings, header, value_range),
            _lasting(header) | {"history": container.header["history"]},
            {axis: container.coordinate(stored) for axis, stored in AXIS_NAMES.items()},
            _figures(path, header, value_range, kept),
            continues=state,
        )
        with growing:
            _copy_layers(growing, container, kept, value_range)
            yield growing


def bound_of_file(header: Mapping[str, Any]) -> float | None:
    """The strict bound of the error that a full header promises, in data units; None without."""
    config = header["config"]
    low, high = header["value_range"]
    if isinstance(config.get("max_error"), int | float):
        return float(config["max_error"])
    if isinstance(config.get("max_error_rel"), int | float):
        return float(config["max_error_rel"]) * float(high - low)
    return None


def _settings(container: Container, header: Mapping[str, Any]) -> TileSettings:
    """The settings that all tiles share; raises InputError for a file that cannot grow."""
    path, model = container.path, header["model"]
    if model["profile"] != COMPACT or PLAIN_FEATURE in header["required_features"]:
        kind = "a plain file" if model["profile"] == COMPACT else "the published network"
        raise InputError(f"{path} is {kind}, which cannot grow")
    table = container.arrays.get(TABLE)
    settings = None if table is None else table.settings
    if table is None or not isinstance(settings, TileSettings):
        raise InputError(f"{path}: its tiles share no settings, by which more could be coded")
    steps, *frame = header["domain"]["shape"]
    box = [[0, n] for n in frame]
    gaps = table.masked or header["coreset_fraction"] != 1 or MISSING_ARRAY in container.arrays
    if gaps or header["feature_bounding_box"] != box or table.shape != (steps, *frame):
        raise InputError(
            f"{path} keeps features or has missing values or key frames; only a file that keeps "
            "every vertex of every step can grow"
        )
    if bound_of_file(header) is None:
        raise InputError(
            f"{path} does not promise a bound of the error, which alone can be kept for steps that "
            "come later; encode it with --max-error or --max-error-rel"
        )
    return settings


def _steps_to_keep(container: Container, steps: int | None) -> int:
    """The number of steps to keep; raises InputError unless they are whole layers."""
    path, table = container.path, container.arrays[TABLE]
    there, layer = table.shape[0], table.chunk_shape[0]
    kept = there if steps is None else steps
    if kept > there or kept < 1:
        raise InputError(f"{path}: {kept} steps are to be kept; it has {there}")
    if kept % layer:
        whole = kept // layer * layer
        fewer = f"keep {whole} steps and append the others again, or " if whole else ""
        raise InputError(
            f"{path}: step {kept} lies within a layer of {layer} steps that are coded together, "
            f"and coding some of them twice would add up errors; {fewer}begin another file"
        )
    return kept


def _coder(
    path: Path,
    table: StoredArray,
    settings: TileSettings,
    header: Mapping[str, Any],
    value_range: ValueRange,
) -> LayerCoder:
    """The coder of further layers: options of the encoder as the file's effort asks for."""
    effort = header["config"].get("effort", EncodeConfig().effort)
    config = EncodeConfig(max_error=bound_of_file(header))
    goal = goal_of(config, value_range, 1, 0, integers=table.dtype.kind in "iu")
    try:
        fast = parse_stream(table.coded((0,) * len(table.grid))).fast
    except DamagedFileError as error:
        raise DamagedFileError(f"{path}: {error}") from error
    weight = TRELLIS_WEIGHT if settings.trellis else WEIGHT
    joint = 0.0 if settings.head is None else JOINT
    coding = coding_of(effort, fast=fast, weight=weight, filled=True, density=0, joint=joint)
    t, z, y, x = table.chunk_shape
    return LayerCoder(
        tile=(t, z, y, x), settings=settings, coding=goal.bounded(coding), dtype=table.dtype
    )


def _lasting(header: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a full header that stay the same while the file grows."""
    model = {name: header["model"][name] for name in header["model"] if name not in SEARCH}
    config = {**header["config"], "max_error": bound_of_file(header), "max_error_rel": None}
    return {
        **header,
        **({SOURCE: _lasting_source(header[SOURCE])} if SOURCE in header else {}),
        "encoder": {"version": header["encoder"]["version"]},
        "model": model,
        "config": config,
    }


def _lasting_source(source: Mapping[str, Any]) -> dict[str, Any]:
    """The entry of the source without what is true of the first steps alone."""
    lasting = {name: value for name, value in source.items() if name not in ("digest", "date")}
    # Later times may need every bit of float64.
    lasting["variables"] = [
        {key: value for key, value in one.items() if key != "dtype" or one.get("axis") != "t"}
        for one in source.get("variables", [])
    ]
    return lasting


def _figures(path: Path, header: Mapping[str, Any], value_range: ValueRange, kept: int) -> Figures:
    """The errors of the steps that are kept."""
    try:
        figures = Figures.of_header(header, Figures.scale_of(value_range))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    del figures.steps[kept:]
    return figures


def _copy_layers(
    growing: GrowingFile, container: Container, kept: int, value_range: ValueRange
) -> None:
    """Write what is kept of a file: arrays that do not depend on time, and layers of tiles."""
    for name, array in container.arrays.items():
        if name in (TABLE, STEPS):
            continue
        if _follows_time(array, container):
            raise InputError(
                f"{container.path}: array {name} has a value for each step; a file with such "
                "arrays cannot grow"
            )
        growing.carry(name, array)
    for one in container.header.get(SOURCE, {}).get("variables", []):
        if "axis" not in one and container.coordinate("time").name in one.get("dimensions", []):
            raise InputError(
                f"{container.path}: {one['name']} of its source has a value for each step; a file "
                "with such arrays cannot grow"
            )
    table = container.arrays[TABLE]
    times = container.coordinate("time").values
    layer = table.chunk_shape[0]
    told = container.header["model"]["parameters"]
    head = growing.coder.settings.head
    weights = 0 if head is None else head.size
    for number in range(kept // layer):
        first = number * layer
        tiles = product(*map(range, table.grid[1:]))
        with damage_named(container.path):
            streams = [bytes(table.coded((number, *tile))) for tile in tiles]
        # Where steps are dropped this is a share: the file has one number for all of them.
        before, after = (max(0, told - weights) * k // table.grid[0] for k in (number, number + 1))
        span = [float(time) for time in times[first : first + layer]]
        growing.write_layer(streams, span, after - before, value_range)


def _follows_time(array: StoredArray, container: Container) -> bool:
    """Whether an array has an axis of steps."""
    names = {"t", "time", container.coordinate("time").name}
    named = array.dimension_names or ()
    return bool(names.intersection(named)) or (
        not named and container.header["domain"]["shape"][0] in array.shape
    )
