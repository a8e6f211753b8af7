"""Small coresets of noise for the engines."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Interval
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import Probe, TrainingProgress, plan_training, train
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def _noise_coreset(
    shape: tuple[int, int, int, int], low: float = 0.3, fringe: bool = False
) -> Coreset:
    series = ArraySeries(np.random.default_rng(3).random(shape, dtype=np.float32))
    scanned = scan(series, silent)
    return build_coreset(
        series, scanned, range(shape[0]), [Interval(low, 1.0)], 0, silent, fringe=fringe
    )


def _in_coreset(coreset: Coreset) -> npt.NDArray[np.bool_]:
    return np.unpackbits(coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)).astype(bool)


def _trained(coreset: Coreset, settings: dict[str, Any], name: str, device: str) -> dict[str, Any]:
    """Train an engine, go on from its state in another one, and return what came of it."""
    key_frames, samples = len(coreset.key_frames), len(coreset.values)
    architecture = Architecture.for_box(coreset.box.shape, key_frames, **{"width": 16, **settings})
    plan = plan_training(
        coreset, epochs=1, learning_rate=0.01, schedule="constant", batch=samples // 4 + 1, seed=0
    )
    rates = np.append(plan.rates, [0.01, 0.01])

    def new() -> Any:
        return make_engine(name, architecture, coreset, rates, seed=7, device=torch.device(device))

    first, second, every = new(), new(), np.arange(len(coreset.bricks))
    train(first, plan, coreset, TrainingProgress())
    second.restore({name: np.array(array) for name, array in first.state().items()})
    for _ in range(2):
        error = float(second.train(every[::2].copy()))
    psnr, values = Probe(coreset).psnr(second), second.infer(every)
    assert values.device.type == device
    second.settle()
    parameters = second.parameters()
    return {
        "error": error,
        "psnr": psnr,
        "values": values.cpu().numpy(),
        **{part: getattr(parameters, part).numpy() for part in ("fine", "coarse", "network")},
    }


@pytest.fixture(scope="session")
def trained() -> Callable[..., dict[str, Any]]:
    """A function of (coreset, settings, name, device): what a training and a continuation give."""
    return _trained


@pytest.fixture(scope="session")
def noise_coreset() -> Callable[..., Coreset]:
    """A function of (shape, low, fringe): noise; values from `low` to 1 are the feature."""
    return _noise_coreset


@pytest.fixture(scope="session")
def in_coreset() -> Callable[[Coreset], npt.NDArray[np.bool_]]:
    """A function of a coreset: which vertices (bricks, vertices) of its bricks are samples."""
    return _in_coreset
