"""Encoding by the compact profile."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.goal import promise
from fhash_codec.compact.tiles_to_promise import (
    code_series,
    compact_header,
    required_features,
    write_table,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.header import brief_history, describe_source, write_series
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
    path: Path,
    progress: Progress,
) -> tuple[dict[str, Any], Path | None]:
    """Code the lattice values and write them; the header without its quality."""
    if native.library() is None:
        warnings.warn(
            "the native core is not there (no compiler at installation?): coding takes 2 to 3 times as long with numba, "
            "some 1000 times as long without; the bytes are the same",
            FhashWarning,
            stacklevel=3,
        )
    begun = time.perf_counter()
    found = select_features(series, config, progress, mask)
    table = code_series(series, found, config, progress)
    described = write_series(writer, series, found.scanned, found.extent.key_frames, brief=True)
    write_table(writer, table)
    planned = table.planned
    seconds = round(time.perf_counter() - begun, 3) if config.timings else None
    training = {"seconds": seconds, "epochs": 0, "device": "cpu"}
    history = brief_history(planned.history, timings=config.timings)
    defaults = EncodeConfig().to_dict()
    header = {
        **describe_source(series, found.scanned.value_range, config),
        **described,
        "required_features": required_features(table),
        "background": found.extent.background,
        "feature_bounding_box": [list(span) for span in found.extent.box],
        "features": [str(feature) for feature in found.features],
        "coreset_fraction": found.extent.fraction,
        "model": compact_header(table, config),
        "config": {
            name: value for name, value in config.to_dict().items() if value != defaults[name]
        }
        | promise(config),
        "training": training,
        "history": {
            name: [point.get(name) for point in history] for name in (history[0] if history else ())
        },
    }
    return header, None
