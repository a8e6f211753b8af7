"""An existing file that is to be continued: what its tiles, header and promise say."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

from fhash_codec.appending.figures import Figures
from fhash_codec.appending.growing import GrowingFile
from fhash_codec.appending.layers import LayerCoder
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.config import EncodeConfig
from fhash_codec.header import full_header
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import SOURCE, Container, StoredArray
from fhash_formats.container.header import COMPACT, PLAIN_FEATURE, STEPS, TABLE
from fhash_formats.container.source import damage_named
from fhash_formats.errors import InputError
from fhash_formats.series import AXIS_NAMES
from fhash_formats.transform.tile.integers import TRELLIS_WEIGHT, WEIGHT
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["bound_of_file", "continued"]


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
        kept = _kept_steps(container, steps)
        value_range = ValueRange(*header["value_range"])
        growing = GrowingFile(
            path,
            _coder(container.arrays[TABLE], settings, header, value_range),
            _lasting(header) | {"history": container.header["history"]},
            {axis: container.coordinate(stored) for axis, stored in AXIS_NAMES.items()},
            _figures(path, header, value_range, kept),
            continues=state,
        )
        with growing:
            _keep(growing, container, kept, value_range)
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
        kind = "plain" if PLAIN_FEATURE in header["required_features"] else model["profile"]
        raise InputError(f"{path} is a {kind} file; only files of the profile compact can grow")
    table = container.arrays.get(TABLE)
    settings = None if table is None else table.settings
    if table is None or not isinstance(settings, TileSettings):
        raise InputError(f"{path}: its tiles share no settings, by which more could be coded")
    steps, *frame = header["domain"]["shape"]
    box = [[0, n] for n in frame]
    gaps = table.masked or header["coreset_fraction"] != 1 or "missing/bits" in container.arrays
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


def _kept_steps(container: Container, steps: int | None) -> int:
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
    table: StoredArray, settings: TileSettings, header: Mapping[str, Any], value_range: ValueRange
) -> LayerCoder:
    """The coder of further layers: options of the encoder as the file's effort asks for."""
    effort = header["config"].get("effort")
    config = EncodeConfig(max_error=bound_of_file(header))
    goal = goal_of(config, value_range, 1, 0, integers=table.dtype.kind in "iu")
    coding = Coding(
        weight=TRELLIS_WEIGHT if settings.trellis else WEIGHT,
        filled=True,
        density=0,
        passes=1 if effort in (1, 2) else 2,
        rounds=0 if effort == 1 else 2,
    )
    t, z, y, x = table.chunk_shape
    return LayerCoder(
        tile=(t, z, y, x), settings=settings, coding=goal.bounded(coding), dtype=table.dtype
    )


def _lasting(header: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a full header that stay the same while the file grows."""
    encoder = {name: header["encoder"][name] for name in ("version", "seed")}
    model = {name: value for name, value in header["model"].items() if name != "tiling"}
    config = {**header["config"], "max_error": bound_of_file(header), "max_error_rel": None}
    return {
        **header,
        **({SOURCE: _lasting_source(header[SOURCE])} if SOURCE in header else {}),
        "encoder": encoder,
        "model": {**model, "gains": []},
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


def _keep(growing: GrowingFile, container: Container, kept: int, value_range: ValueRange) -> None:
    """Write what is kept of a file: arrays that do not depend on time, and layers of tiles."""
    for name, array in container.arrays.items():
        if name in (TABLE, STEPS) or name.startswith("coords/"):
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
        growing.keep(streams, span, after - before, value_range)


def _follows_time(array: StoredArray, container: Container) -> bool:
    """Whether an array has an axis of steps."""
    names = {"t", "time", container.coordinate("time").name}
    named = array.dimension_names or ()
    return bool(names.intersection(named)) or (
        not named and container.header["domain"]["shape"][0] in array.shape
    )
