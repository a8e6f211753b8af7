"""Files of the profile compact with a head that was not trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.encode import code_series
from fhash_formats.transform.head import Layer, NeighbourHead


def field(steps: int = 2) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (steps, 9, 30, 28)), indexing="ij")
    return (np.tanh(30 * (x - 0.4 - 0.2 * y * t)) + 0.2 * np.sin(9 * y + 3 * z)).astype(np.float32)


def with_head(path: Path, head: NeighbourHead) -> Path:
    """A file whose head was not trained: two tiles along y."""
    config = EncodeConfig(effort=2, psnr=40.0, tile="2x9x15x28")

    def patched(*args: Any, **options: Any) -> Any:
        table = code_series(*args, **options)
        settings = replace(table.plan.settings, head=head)
        return replace(table, plan=replace(table.plan, settings=settings), decoded={})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fhash_codec.compact.encode.code_series", patched)
        patch.setattr("fhash_codec.encoding.missed_promise", lambda *_: None)
        fhash_codec.encode(field(), path, config)
    return path


def some_head(*, scale: float = 0.03125, sigma: float = 0.125) -> NeighbourHead:
    """A head of random weights."""
    rng = np.random.default_rng(3)
    layers = tuple(
        Layer(
            weights=rng.integers(-20, 21, shape).astype(np.int8),
            biases=rng.integers(-99, 100, shape[0]).astype(np.int8),
            weight_scale=scale,
            bias_scale=0.0078125,
        )
        for shape in ((4, 28), (3, 4), (1, 3))
    )
    return NeighbourHead(layers=layers, sigma=sigma, low=-1.5, high=1.25)
