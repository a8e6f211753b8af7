"""Plan for a series that is encoded in parts, and the settings that the parts share."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from fhash_codec.boxes import Box
from fhash_codec.compact.encode import CodedTable, plan_series, table_header
from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.sample import fill
from fhash_codec.compact.tiles import (
    Blocks,
    CodedTiles,
    Coding,
    Tile,
    Worked,
    code,
    code_tiles,
    fits_memory,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import Source, mask_files, open_source, select_features
from fhash_codec.measure.value_range import Ranks, ValueRange
from fhash_codec.progress import Progress, silent
from fhash_formats.container import record as strict_json
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.errors import (
    DamagedFileError,
    InputError,
    MissingInputError,
    UnsupportedFileError,
)
from fhash_formats.series import AXES, Series
from fhash_formats.support.files import check_output, replacing
from fhash_formats.support.threads import thread_pool
from fhash_formats.support.values import json_attributes, plain_json
from fhash_formats.transform.tile import DENSITIES
from fhash_formats.transform.tile_format import Shape, TileSettings

MAX_TILE_LENGTH = 1 << 24
"""Vertices of a tile along an axis, at most."""
_SWITCHES = ("filled", "keep_missing", "own_settings", "exact", "fast")
"""Options of the encoder that are true or false."""
_COUNTS = ("rounds", "passes")
"""Options of the encoder that count how often it does something."""
MAX_COUNT = 64
"""Largest of these numbers."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The coding of every tile of a series.

    Attributes:
        tile: shape (t, z, y, x) of a tile.
        settings: that all tiles share.
        coding: options of the encoder, the bound among them.
        filling: settings and density by which tiles are filled before they are coded (`fill`); None
            where the encoder finds fill values of its own, or none are needed.
    """

    tile: Shape
    settings: TileSettings
    coding: Coding
    filling: tuple[TileSettings, int] | None = None

    @classmethod
    def of(cls, plan: CodingPlan) -> Recipe:
        """The recipe of a plan under a bound of the error."""
        sample = plan.sample if plan.coding.filled else None
        return cls(
            tile=plan.blocks.tile,
            settings=plan.settings,
            coding=replace(plan.coding, bulk=None),  # it is measured by, and changes no byte
            filling=None if sample is None else sample.filling,
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON values; `from_dict` takes them."""
        coding = {name: value for name, value in vars(self.coding).items() if name != "bulk"}
        values = {"tile": list(self.tile), "settings": self.settings.to_text(), "coding": coding}
        if self.filling is not None:
            settings, density = self.filling
            values["filling"] = {"settings": settings.to_text(), "density": density}
        return values

    @classmethod
    def from_dict(cls, record: Record) -> Recipe:
        """The inverse of `to_dict`. Raises DamagedFileError or InputError for anything else."""
        t, z, y, x = record.integers("tile", 4, 1, MAX_TILE_LENGTH)
        filling = None
        if record.has("filling"):
            told = record.record("filling")
            density = told.integer("density", 0, max(DENSITIES))
            told.need(density in (0, *DENSITIES), "density", f"0 or one of {list(DENSITIES)}")
            filling = _settings(told, (t, z, y, x)), density
        return cls(
            tile=(t, z, y, x),
            settings=_settings(record, (t, z, y, x)),
            coding=_coding(record.record("coding")),
            filling=filling,
        )


def _settings(record: Record, tile: Shape) -> TileSettings:
    """The settings of a record for tiles of a shape; raises InputError or DamagedFileError."""
    settings = TileSettings.from_text(record.text("settings"))
    settings.transform.check(tile)
    return settings


def _coding(record: Record) -> Coding:
    """The options of the encoder in a record; raises DamagedFileError."""
    options: dict[str, Any] = {name: record.get(name) for name in _SWITCHES}
    for name, switch in options.items():
        record.need(isinstance(switch, bool), name, "true or false")
    options |= {name: record.integer(name, 0, MAX_COUNT) for name in _COUNTS}
    density = record.integer("density", 0, max(DENSITIES))
    none_needed = density == 0 and options["filled"]
    record.need(none_needed or density in DENSITIES, "density", f"one of {list(DENSITIES)}")
    for name in ("weight", "aim", "joint"):
        options[name] = record.number(name)
        record.need(options[name] >= 0, name, "a number from 0 on")
    error = record.number_or_null("error")
    record.need(error is None or error >= 0, "error", "a number from 0 on, or null")
    return Coding(error=error, density=density, **options)


def code_layers(
    blocks: Blocks,
    recipe: Recipe,
    layers: range,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> CodedTiles:
    """Code some layers of tiles along time, with the bytes that they have in a whole table.

    blocks: the series in the tiles of the recipe. One layer is in memory at a time.

    Raises DamagedFileError for a recipe whose settings are not of these tiles. Progress stage:
    "coding".
    """

    def work(tile: Tile) -> Worked:
        if recipe.filling is not None:
            tile = fill(tile, *recipe.filling)
        coded, outcome = code(tile, recipe.settings, recipe.coding)
        return coded.data, outcome, None

    assert blocks.tile == recipe.tile
    count = len(layers) * math.prod(blocks.grid[1:])
    _, *grid = blocks.grid
    indices = ((t, z, y, x) for t, z, y, x in product(layers, *map(range, grid)))
    tiles = (blocks.read(index) for index in indices)
    return code_tiles(tiles, work, workers, lambda done: progress("coding", done, count, ""))


FORMAT = "fhash plan"
"""Name of the format, the first thing that a reader looks at."""
MAX_BYTES = strict_json.MAX_BYTES
"""Bytes of a plan, at most."""


@dataclass(frozen=True, kw_only=True)
class SeriesPlan:
    """The decisions on a series, which all of its parts share.

    Attributes:
        config: the settings; they promise a bound of the error.
        labels: name, shape and number type of the series, and a digest of its coordinates.
        value_range: of all finite values, in data units.
        has_missing: whether any value is missing.
        features: the resolved features, as texts.
        box: the feature bounding box, fused over all steps.
        samples: vertices of the coreset over all steps.
        recipe: the coding of each tile.
        header: the header's entries that do not depend on a part.
    """

    config: EncodeConfig
    labels: Mapping[str, Any]
    value_range: ValueRange
    has_missing: bool
    features: tuple[str, ...]
    box: Box
    samples: int
    recipe: Recipe
    header: Mapping[str, Any]

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Vertices (t, z, y, x) of the series."""
        t, z, y, x = self.labels["shape"]
        return t, z, y, x

    @property
    def layers(self) -> int:
        """Number of layers of tiles along time."""
        return -(-self.shape[0] // self.recipe.tile[0])

    def steps(self, layers: range) -> range:
        """The steps of some layers."""
        length = self.recipe.tile[0]
        return range(layers.start * length, min(layers.stop * length, self.shape[0]))

    @classmethod
    def make(
        cls,
        series: Series,
        config: EncodeConfig,
        progress: Progress = silent,
        known: tuple[Scan, Ranks] | None = None,
    ) -> SeriesPlan:
        """Plan a series: one pass over all steps for their range, and trials on a sample of tiles.

        config: as `bounded` returns it. known: as in `select_features`, in place of that pass.
        Raises what `encode` raises while it plans.
        """
        selection = select_features(
            series, config, progress, ranked=not fits_memory(series), known=known
        )
        with thread_pool() as workers:
            plan, _, bulk = plan_series(series, selection, config, workers, progress)
        table = CodedTable(plan=plan, bulk=bulk)
        return cls(
            config=config,
            labels=_labels(series),
            value_range=selection.scanned.value_range,
            has_missing=bool(selection.scanned.missing),
            features=tuple(str(feature) for feature in selection.features),
            box=selection.extent.box,
            samples=selection.extent.samples,
            recipe=Recipe.of(plan),
            header=plain_json(table_header(series, selection, table, config, None)),
        )

    def require(self, series: Series) -> None:
        """Raise InputError unless the labels of a series are those of the plan."""
        for name, value in _labels(series).items():
            if self.labels.get(name) != value:
                told = "" if name in DIGESTS else f": {self.labels.get(name)}, not {value}"
                raise InputError(
                    f"the plan is of other data than {series.source}, they differ in {name}{told}; "
                    "give the same data and the same --var, --axes, --t, or make the plan anew"
                )

    def require_settings(self, given: Mapping[str, Any]) -> None:
        """Raise InputError where a setting, by its name, is not that of the plan.

        Parts keep no times, whatever `timings` is.
        """
        for name, value in given.items():
            known = getattr(self.config, name)
            if value != known and name != "timings":
                raise InputError(
                    f"{name} is {value}, and {known} in the plan; leave it out, or make the plan "
                    "anew"
                )

    def to_bytes(self) -> bytes:
        """The plan as JSON."""
        values: dict[str, Any] = {
            "format": FORMAT,
            "version": version("fhash"),
            "config": self.config.to_dict(),
            "labels": dict(self.labels),
            "value_range": [self.value_range.low, self.value_range.high],
            "has_missing": self.has_missing,
            "features": list(self.features),
            "box": [list(span) for span in self.box],
            "samples": self.samples,
            "recipe": self.recipe.to_dict(),
            "header": dict(self.header),
        }
        digest = hashlib.sha256(strict_json.dumps(values, "the plan")).hexdigest()
        return strict_json.dumps({**values, "digest": digest}, "the plan")

    @classmethod
    def from_bytes(cls, data: bytes, what: str = "the plan") -> SeriesPlan:
        """The inverse of `to_bytes`; `what` names the plan in messages.

        Raises InputError for something else, DamagedFileError for a plan that was changed, and
        UnsupportedFileError for one of another version of fhash.
        """
        try:
            values = strict_json.loads(data)
        except DamagedFileError as error:
            raise DamagedFileError(f"{what} is damaged, or no plan of fhash: {error}") from error
        if values.get("format") != FORMAT:
            raise InputError(f"{what} is no plan; `fhash plan` makes one")
        if values.get("version") != version("fhash"):
            raise UnsupportedFileError(
                f"{what} was made by fhash {str(values.get('version'))[:40]}, and this is "
                f"{version('fhash')}; all parts need one version: make the plan anew"
            )
        digest = values.pop("digest", None)
        if digest != hashlib.sha256(strict_json.dumps(values, what)).hexdigest():
            raise DamagedFileError(f"{what} is damaged: its digest differs; make it anew")
        try:
            return cls._read(Record(values, ""))
        except (InputError, DamagedFileError) as error:
            raise DamagedFileError(f"{what} is damaged: {error}") from error

    @classmethod
    def _read(cls, record: Record) -> SeriesPlan:
        labels, header, config = record.get("labels"), record.get("header"), record.get("config")
        for key, value in (("labels", labels), ("header", header), ("config", config)):
            record.need(isinstance(value, Mapping), key, "an object")
        shape = record.record("labels").integers("shape", 4, 1, MAX_LENGTH)
        has_missing, box = record.get("has_missing"), record.get("box")
        record.need(isinstance(has_missing, bool), "has_missing", "true or false")
        record.need(_is_box(box, shape[1:]), "box", "three spans within the domain")
        recipe = Recipe.from_dict(record.record("recipe"))
        lengths = [shape[0], *(high - low for low, high in box)]
        if any(n > length for n, length in zip(recipe.tile, lengths, strict=True)):
            raise DamagedFileError(f"tiles of {recipe.tile} are larger than the series")
        for key, kind in (("model", Mapping), ("quality", Mapping), ("encoder", Mapping)):
            record.need(isinstance(header.get(key), kind), "header", f"an object {key}")
        record.record("header").record("model").integer("parameters", 0, 1 << 62)
        return cls(
            config=bounded(EncodeConfig.from_dict(config)),
            labels=labels,
            value_range=ValueRange(*record.numbers("value_range", 2)),
            has_missing=has_missing,
            features=tuple(record.texts("features")),
            box=Box.of((low, high) for low, high in box),
            samples=record.integer("samples", 1, prod(lengths)),
            recipe=recipe,
            header=header,
        )

    @classmethod
    def read(cls, path: str | Path) -> SeriesPlan:
        """The plan in a file; raises what `from_bytes` does, and MissingInputError."""
        try:
            with open(path, "rb") as file:
                return cls.from_bytes(file.read(MAX_BYTES + 1), str(path))
        except FileNotFoundError as error:
            raise MissingInputError(f"{path} does not exist; `fhash plan` makes a plan") from error
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from error


def plan_parts(
    source: Source,
    path: str | Path,
    config: EncodeConfig,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> SeriesPlan:
    """Plan a series and write the plan as the file `path`, complete or not at all.

    The other arguments are those of `encode`. `encode_part` takes the plan; it may be given to any
    number of machines that read the same data with the same version of fhash.

    Raises what `encode` raises while it plans, OutputExistsError and OutputError.
    """
    path, config = Path(path), bounded(config)
    check_output(path, force)
    with open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        plan = SeriesPlan.make(series, config, progress)
        series.check()
    with replacing(path, force=force) as temporary:
        temporary.write_bytes(plan.to_bytes())
    return plan


def bounded(config: EncodeConfig) -> EncodeConfig:
    """The settings of parts: without times, which differ from part to part.

    Raises InputError for a promise that no part alone can keep.
    """
    if config.published or (config.max_error is None and config.max_error_rel is None):
        raise InputError(
            "a part keeps a promise by itself, which is a bound of the error: give max_error or "
            "max_error_rel, and not the preset published"
        )
    return replace(config, timings=False)


DIGESTS = ("coordinates", "attributes")
"""Labels of which a plan keeps a digest alone."""


def _labels(series: Series) -> dict[str, Any]:
    """The labels by which a series is told from another one; JSON values."""
    digest = hashlib.sha256()
    for axis in AXES:
        coordinate = series.coords[axis]
        digest.update(f"{axis} {coordinate.name!r} {coordinate.values.size}".encode())
        digest.update(coordinate.values.astype("<f8").tobytes())
        digest.update(_plain(coordinate.attributes))
    return {
        "name": str(series.name),
        "units": str(series.units),
        "shape": list(series.shape),
        "dtype": (series.source_dtype or series.dtype).newbyteorder("=").name,
        "coordinates": digest.hexdigest(),
        "attributes": hashlib.sha256(_plain(series.attributes)).hexdigest(),
    }


def _plain(attributes: Mapping[str, Any]) -> bytes:
    """The bytes of some attributes, in any order."""
    kept = json_attributes(attributes, without=frozenset())
    return strict_json.dumps(dict(sorted(kept.items())), "the attributes")


def _is_box(value: Any, domain: list[int]) -> bool:
    """Whether a JSON value is three spans [low, high] within a domain (z, y, x)."""
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(
            isinstance(span, list)
            and len(span) == 2
            and all(type(n) is int for n in span)
            and 0 <= span[0] < span[1] <= length
            for span, length in zip(value, domain, strict=True)
        )
    )
