"""Tasks of planning for arrays, and a series to plan, that tests of several choices use."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import EncodeConfig
from fhash_codec.compact.attempt import GainLog, PlanTask
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.tiles import Blocks, Index
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries
from fhash_formats.transform.tile_format import Shape


def waves(shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Waves (t, z, y, x), float32, that move unevenly with a little noise; about -2 .. 2."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    values = np.sin(0.21 * x + 0.1 * t) + np.cos(0.17 * y - 0.2 * t) * np.sin(0.3 * z + 0.05 * t)
    return (values + 0.02 * np.random.default_rng(1).normal(size=shape)).astype(np.float32)


def plan_task(
    values: npt.NDArray[Any],
    workers: ThreadPoolExecutor,
    fixed_tile: Shape | None = None,
    **promise: Any,
) -> PlanTask:
    """The task of planning an array at effort 2. promise: settings, 40 dB without any."""
    series, config = ArraySeries(values), EncodeConfig(effort=2, **(promise or {"psnr": 40.0}))
    selection = select_features(series, config, silent)
    value_range = selection.scanned.value_range
    return PlanTask(
        blocks=Blocks(series, selection.extent, series.shape),
        value_range=value_range,
        features=selection.features,
        config=config,
        goal=goal_of(config, value_range, 1, 0),
        fixed_tile=fixed_tile,
        workers=workers,
        gains=GainLog(100),
    )


class SingleTile:
    """Blocks of one tile; a subclass has `shape`, `tile`, `in_memory` and `read`."""

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1
