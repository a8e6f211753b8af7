"""A small smooth series for trainings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import plan_training
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def _coreset(bend: float) -> Coreset:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 12, 20, 36)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    series = ArraySeries(values + bend * values**2)
    return build_coreset(series, scan(series, silent), range(3), [Everything()], 0, silent)


@pytest.fixture(scope="session")
def coreset() -> Coreset:
    return _coreset(0.0)


@pytest.fixture(scope="session")
def other_coreset() -> Coreset:
    """The same vertices with other values."""
    return _coreset(0.5)


@pytest.fixture(scope="session")
def setup() -> Callable[..., Any]:
    """A function of a coreset and settings: the plan and a slab engine."""

    def make(coreset: Coreset, epochs: int = 4, **settings: Any) -> Any:
        usual = {"learning_rate": 0.01, "schedule": "cosine", "batch": 0, "seed": 5}
        plan = plan_training(coreset, epochs=epochs, **usual | settings)
        architecture = Architecture.for_box(coreset.box.shape, 3, width=16)
        device = torch.device("cpu")
        return plan, make_engine("slab", architecture, coreset, plan.rates, seed=5, device=device)

    return make
