"""Encoding by the compact profile: series -> coreset -> coded tiles -> container."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.coded_table import model_header, required_features, write_table
from fhash_codec.compact.goal import promise
from fhash_codec.compact.tiles_to_promise import code_series
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.features import Everything
from fhash_codec.coreset.selection import select_features
from fhash_codec.header import brief_history, describe_source, history_columns, write_series
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_formats import native
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import FhashWarning
from fhash_formats.series import Series


def encode_compact(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    progress: Progress,
) -> dict[str, Any]:
    """Code the values of a series and write them; the header without its quality.

    mask: booleans (t, z, y, x) or (z, y, x), one more feature.

    Warns (FhashWarning) where the native library is missing.
    """
    if native.library() is None:
        warnings.warn(
            "the native core is not there (no compiler at installation?): coding takes 2 to 3"
            " times as long with numba, some 1000 times as long without; the bytes are the same",
            FhashWarning,
            stacklevel=3,
        )
    begun = time.perf_counter()
    selection = select_features(series, config, progress, mask)
    extent = selection.extent
    table = code_series(series, selection, config, progress)
    described = write_series(
        writer,
        series,
        selection.scanned,
        extent.key_frames,
        brief=True,
        everything=any(isinstance(feature, Everything) for feature in selection.features),
    )
    write_table(writer, table)
    seconds = round(time.perf_counter() - begun, 3) if config.timings else None
    history = brief_history(table.plan.history, timings=config.timings)
    return {
        **describe_source(series, selection.scanned.value_range, config),
        **described,
        "required_features": required_features(table),
        "background": extent.background,
        "feature_bounding_box": [list(span) for span in extent.box],
        "features": [str(feature) for feature in selection.features],
        "coreset_fraction": extent.fraction,
        "model": model_header(table, config),
        "config": _changed_options(config)
        | promise(config, selection.scanned.value_range, table.bulk),
        # The figures are measured on the written bytes, within this bulk.
        "quality": {"bulk": _described(table.bulk)},
        "training": {"seconds": seconds, "epochs": 0, "device": "cpu"},
        "history": history_columns(history),
    }


def _described(bulk: ValueRange | None) -> dict[str, Any] | None:
    """Return what a header says of a bulk that nothing was measured in yet."""
    return None if bulk is None else {"range": [bulk.low, bulk.high]}


def _changed_options(config: EncodeConfig) -> dict[str, Any]:
    """Return the options that differ from their defaults."""
    defaults = EncodeConfig().to_dict()
    return {name: value for name, value in config.to_dict().items() if value != defaults[name]}
