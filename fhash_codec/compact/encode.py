"""Encoding by the compact profile: series -> coreset -> coded tiles -> container."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.choices.head import HeadHistory
from fhash_codec.compact.choices.head_samples import BATCH_VOXELS
from fhash_codec.compact.coded_table import (
    CodedTable,
    DecodedTiles,
    model_header,
)
from fhash_codec.compact.goal import promise
from fhash_codec.compact.tiles.blocks import fits_memory
from fhash_codec.compact.tiles_to_promise import code_series, resized
from fhash_codec.compact.tiles_to_size import ByteWindow
from fhash_codec.compact.tiling_record import tiling_header
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.features import Everything
from fhash_codec.coreset.selection import FeatureSelection, select_features
from fhash_codec.header import (
    HEAD_POINTS,
    brief_history,
    describe_source,
    write_series,
)
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_codec.stage_clock import stage
from fhash_formats.container import ContainerWriter
from fhash_formats.series import Series

HEADER_BYTES = 750
"""Bytes that a header has at least beside the description of the source, approximately."""
STEP_BYTES = 5
"""Approximate bytes of the figures of a step in a header."""
WRITINGS = 4
"""Times that a file is written at most for a promised ratio."""


def encode_compact(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    progress: Progress,
    complete: Callable[[dict[str, Any], DecodedTiles], dict[str, Any]],
) -> dict[str, Any]:
    """Code the values of a series and write them; the header.

    For a promised ratio they are written again until the whole file has it, where a step of the
    quantiser allows that.

    mask: booleans (t, z, y, x) or (z, y, x), one more feature.
    complete: measures what is written, and returns a header with its quality. Its second argument
        are the tiles whose decoded values are known.
    """
    begun = time.perf_counter()
    selection = select_features(series, config, progress, mask, ranked=not fits_memory(series))
    gaps = selection.extent.fraction < 1
    source = describe_source(series, selection.scanned.value_range, config, gaps=gaps)
    with stage("writing", "coordinates and masks of missing values, tiles, header"):
        described = write_series(
            writer,
            series,
            selection.scanned,
            selection.extent.key_frames,
            everything=any(isinstance(feature, Everything) for feature in selection.features),
        )
    mark = writer.mark()
    overhead = writer.size(source) + HEADER_BYTES + STEP_BYTES * series.shape[0]
    table = code_series(series, selection, config, progress, overhead=overhead)
    if config.ratio is None:
        table.plan.blocks.forget()  # all is coded, and measuring needs the memory
    for _ in range(WRITINGS):
        parts = table.parts
        with stage("writing", "tiles"):
            parts.write(writer)
        seconds = round(time.perf_counter() - begun, 3) if config.timings else None
        own = table_header(selection, table, config, seconds)
        own["required_features"] = ["transform"]
        header = complete(source | described | own, table.in_source)
        overhead = writer.size(header) - table.outcome.size
        if config.ratio is None or ByteWindow.of(table.plan.goal, overhead).holds(table):
            break
        other = resized(table, overhead, progress)
        if other.outcome.size == table.outcome.size:
            break
        table = other
        writer.rewind(mark)
    return header


def table_header(
    selection: FeatureSelection, table: CodedTable, config: EncodeConfig, seconds: float | None
) -> dict[str, Any]:
    """Return what a header says beside the source and its coordinates, without the quality.

    seconds: duration of the encoding; None if it is not to be told.
    """
    extent = selection.extent
    trained = table.plan.history
    tiling = tiling_header(table, timings=config.timings, quick=config.effort == 1)
    return {
        "encoder": {
            "version": version("fhash"),
            "seed": config.seed,
            **({} if seconds is None else {"seconds": seconds}),
        },
        "background": extent.background,
        "feature_bounding_box": [list(span) for span in extent.box],
        "features": [str(feature) for feature in selection.features],
        "coreset_fraction": extent.fraction,
        "model": model_header(table, config) | ({} if tiling is None else {"tiling": tiling}),
        "config": config.to_dict() | promise(config, selection.scanned.value_range, table.bulk),
        # The figures are measured on the written bytes, within this bulk.
        "quality": {"bulk": _described(table.bulk)},
        "training": training_header(trained, timings=config.timings),
        "history": brief_history(trained, timings=config.timings, most=HEAD_POINTS),
    }


def training_header(history: HeadHistory, *, timings: bool) -> dict[str, Any]:
    """Return what a header says of the training of the best head, which has this history.

    The device is "none" where nothing was trained.
    """
    if not history:
        return {"seconds": 0 if timings else None, "steps": 0, "epochs": 0, "device": "none"}
    last = history[-1]
    seconds, steps, samples = last["seconds"], last["epoch"], last["samples"]
    assert seconds is not None
    assert steps is not None
    assert samples is not None
    return {
        "seconds": round(seconds, 3) if timings else None,
        "steps": int(steps),
        "epochs": max(1, round(steps * BATCH_VOXELS / samples)),
        "device": "cpu",
    }


def _described(bulk: ValueRange | None) -> dict[str, Any] | None:
    """Return what a header says of a bulk that nothing was measured in yet."""
    return None if bulk is None else {"range": [bulk.low, bulk.high]}
