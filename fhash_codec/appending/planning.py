"""Tiles and settings of a growing file, chosen on its first steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.layers import LayerCoder
from fhash_codec.compact.encode import training_header
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.plan import plan
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import FeatureSelection, select_features
from fhash_codec.header import HEAD_POINTS, brief_history
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries
from fhash_formats.support.threads import thread_pool

__all__ = ["GrowingPlan", "bound_of", "plan_layers"]

OVERHEAD_BYTES = 2000
"""Approximate bytes of a file without its tiles."""


@dataclass(frozen=True, kw_only=True)
class GrowingPlan:
    """The decisions that are made on the first steps of a file.

    Attributes:
        coder: of the layers.
        header: of the file as far as it stays the same while the file grows.
    """

    coder: LayerCoder
    header: dict[str, Any]


def bound_of(config: EncodeConfig, value_range: ValueRange | None) -> float:
    """The strict bound of the error that settings promise, in data units.

    value_range: of the whole run; None if it is not known.

    Raises InputError for settings that a file cannot keep whose later steps are not known yet.
    """
    if config.profile != "compact":
        raise InputError(
            f"profile '{config.profile}' needs all steps at once; a file that grows is of the "
            "profile compact"
        )
    if config.features != ("all",):
        raise InputError(
            f"features {', '.join(config.features)} are given; a file that grows keeps everything "
            "(feature 'all')"
        )
    if config.max_error is not None:
        return float(config.max_error)
    if config.max_error_rel is None:
        raise InputError(
            "a file that grows promises a bound of the error, which holds step by step: give "
            "max_error, or max_error_rel with value_range; a PSNR or a ratio depends on steps that "
            "are yet to come"
        )
    if value_range is None:
        raise InputError(
            "max_error_rel is a fraction of the range of the whole run, which is not known yet: "
            "give value_range=(low, high) beside it, or max_error in data units"
        )
    return config.max_error_rel * (value_range.high - value_range.low)


def plan_layers(
    frames: Sequence[npt.NDArray[Any]],
    config: EncodeConfig,
    bound: float,
    value_range: ValueRange | None,
) -> GrowingPlan:
    """Choose tiles and settings on the first steps.

    frames: finite values (z, y, x) of each step. bound: of the error, in data units.
    value_range: that is expected of the whole run; that of the frames if None.

    Raises InputError for a tile that cannot be had.
    """
    series = ArraySeries(np.stack(frames))
    series.keep_extremes = True  # values of a simulation are data
    promised = replace(config, max_error=bound, max_error_rel=None, timings=False)
    selection = select_features(series, promised, silent)
    whole = _joined(selection.scanned.value_range, value_range)
    origin = whole.origin(series.dtype)
    expected = whole.moved(-origin)
    raw_bytes = prod(series.shape) * series.dtype.itemsize
    integers = series.dtype.kind in "iu"
    goal = goal_of(promised, expected, raw_bytes, OVERHEAD_BYTES, integers=integers)
    with thread_pool() as workers:
        found = plan(
            Blocks(series, selection.extent, series.shape, origin),
            expected,
            promised,
            goal,
            OVERHEAD_BYTES,
            workers,
            silent,
            selection.features,
        )
    coder = LayerCoder(
        tile=found.blocks.tile,
        settings=replace(found.settings, origin=origin),
        coding=found.coding,
        dtype=found.blocks.source_dtype,
    )
    header = _header(selection, promised, coder)
    header["training"] = training_header(found.history, timings=False)
    header["history"] = brief_history(found.history, timings=False, most=HEAD_POINTS)
    return GrowingPlan(coder=coder, header=header)


def _joined(first: ValueRange, second: ValueRange | None) -> ValueRange:
    if second is None:
        return first
    return ValueRange(min(first.low, second.low), max(first.high, second.high))


def _header(selection: FeatureSelection, config: EncodeConfig, coder: LayerCoder) -> dict[str, Any]:
    """The header's entries that the first steps decide."""
    head, extent = coder.settings.head, selection.extent
    return {
        "encoder": {"version": version("fhash"), "seed": config.seed},
        "background": extent.background,
        "feature_bounding_box": [list(span) for span in extent.box],
        "features": [str(feature) for feature in selection.features],
        "dilation": config.dilation,
        "coreset_fraction": 1.0,
        "model": {
            "profile": "compact",
            "embedding_size": 1,
            "tables": coder.dtype.name,
            "head": None if head is None else {"hidden": list(head.hidden), "cross": head.cross},
            "gains": [],
        },
        "config": config.to_dict(),
    }
