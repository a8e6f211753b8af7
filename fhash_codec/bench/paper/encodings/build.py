"""Encodings by name: their levels, their models, and the batches of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.corners import GridLevel, HashLevel, Level
from fhash_codec.bench.paper.encodings.gather import GatherModel
from fhash_codec.bench.paper.encodings.lattice import LatticeModel
from fhash_codec.bench.paper.encodings.places import of_key_frame
from fhash_codec.bench.paper.encodings.trained import Model, Part, TrainedEncoding
from fhash_codec.bench.paper.protocols import RATE, Arrangement
from fhash_codec.bench.paper.sets import (
    SETS,
    USUAL_COARSEST,
    dense_levels,
    hash_resolutions,
    hash_table,
    scaled,
)
from fhash_codec.boxes import Sizes
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.network import ceil_log, level_resolutions
from fhash_codec.paper.train import TrainingPlan


def build(
    name: str,
    data: Data,
    arranged: Arrangement,
    *,
    steps: int,
    epochs: int,
    seed: int,
    device: torch.device,
) -> TrainedEncoding:
    """Return an encoding before its training.

    Args:
        name: dense, dense-multi, hash, tcnn or fhash.
        data: what it is trained on.
        arranged: how it is trained.
        steps: Adam steps of each model in an epoch, at most the bricks of its samples.
        epochs: epochs that will be trained at most.
        seed: seed of the initial numbers and of the order of the samples.
        device: where it is trained.

    Raises:
        MissingDependencyError: tcnn, where tiny-cuda-nn or a CUDA device is missing.
    """
    samples: Coreset = getattr(data, arranged.samples)
    unit = data.key_range if arranged.released else (0.0, 1.0)
    if arranged.released:
        values = (samples.values - unit[0]) / (unit[1] - unit[0])
        samples = replace(samples, values=values.astype(np.float32))
    keys = tuple(range(len(data.key_frames)))
    pieces = (
        [(keys, samples)]
        if arranged.joint
        else [((key,), of_key_frame(samples, key)) for key in keys]
    )
    parts: list[Part] = []
    for part_keys, coreset in pieces:
        if not len(coreset.bricks):
            continue
        # Models of single key frames must not start alike.
        part_seed = seed * len(keys) + part_keys[0]
        plan = _plan(coreset, steps, epochs, part_seed, arranged.schedule)
        before = parts[-1].model if parts else None
        model = _model(name, data, arranged, coreset, plan, part_seed, device, before)
        parts.append(Part(part_keys, coreset, plan, model))
    levels = levels_of(name, data, samples, arranged) if name == "hash" else []
    hashed = [level for level in levels if isinstance(level, HashLevel)]
    corners = [level.corners_per_axis**3 for level in hashed]
    collided = sum(level.collisions() * n for level, n in zip(hashed, corners, strict=True))
    return TrainedEncoding(
        name,
        parts,
        data,
        in_time=name == "fhash",
        unit=unit,
        collisions=collided / sum(corners) if corners else 0.0,
    )


def levels_of(name: str, data: Data, coreset: Coreset, arranged: Arrangement) -> Sequence[Level]:
    """Return the levels of an encoding for the key frames and the box of some samples.

    Dense grids have the resolution of the box; where they cover the whole domain of an analogue of
    the paper's data, that of the paper's grid, scaled as the data are.
    """
    box, count = coreset.box.shape, len(coreset.key_frames)
    sizes = (count, *box)
    if name == "fhash":
        resolutions = level_resolutions(box, count, 2)
        if arranged.released:
            resolutions = resolutions[: max(1, ceil_log(min(box), 2))]
        return [GridLevel(resolution, sizes, False) for resolution in resolutions]
    if name == "hash":
        coarsest = SETS[data.name].coarsest if data.name in SETS else USUAL_COARSEST
        table = hash_table(box)
        return [HashLevel(n, table, sizes) for n in hash_resolutions(box, coarsest)]
    grid = paper_grid(data) if arranged.whole else box
    grids = dense_levels(grid) if name == "dense-multi" else [grid]
    return [GridLevel((count, *level), sizes, True) for level in grids]


def paper_grid(data: Data) -> Sizes:
    """Return the corners (z, y, x) of the paper's dense grid at the scale of some data."""
    known = SETS.get(data.name)
    if known is None:
        return data.frame_shape
    divisor = round(max(known.frame) / max(data.frame_shape))
    return scaled(known.grid, divisor)


def _model(
    name: str,
    data: Data,
    arranged: Arrangement,
    coreset: Coreset,
    plan: TrainingPlan,
    seed: int,
    device: torch.device,
    before: Model | None,
) -> Model:
    """Return a model of the arranged engine; arguments as of `build`.

    before: the model of the key frame before, whose corners it may share.
    """
    if arranged.engine == "tcnn":
        from fhash_codec.bench.paper.encodings.tcnn import TcnnModel

        coarsest = SETS[data.name].coarsest if data.name in SETS else USUAL_COARSEST
        return TcnnModel(coreset, plan.rates, coarsest=coarsest, seed=seed, device=device)
    levels = levels_of(name, data, coreset, arranged)
    if arranged.engine == "lattice":
        grids = [level for level in levels if isinstance(level, GridLevel)]
        return LatticeModel(grids, coreset, plan.rates, seed=seed, device=device)
    like = before if isinstance(before, GatherModel) else None
    return GatherModel(levels, coreset, plan.rates, seed=seed, device=device, like=like)


def _plan(coreset: Coreset, steps: int, epochs: int, seed: int, schedule: str) -> TrainingPlan:
    """Return the batches of a model: whole bricks, in an order of their own each epoch."""
    batches = min(steps, len(coreset.bricks))
    share = np.arange(epochs * batches + 1) / (epochs * batches)
    falling = 0.5 + 0.5 * np.cos(np.pi * share)
    return TrainingPlan(
        epochs=epochs,
        counts=np.diff(coreset.offsets),
        batches=batches,
        seed=seed,
        rates=RATE * (falling if schedule == "cosine" else np.ones_like(share)),
    )
