"""Heads and tiles for tests, made from random numbers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.head import MAX_WEIGHT, Layer, NeighbourHead, layer_inputs

Floats = npt.NDArray[np.float32]

LOW = float(np.float32(-1.25))
HIGH = float(np.float32(2.7))


def random_head(
    hidden: tuple[int, ...] = (12, 8),
    *,
    seed: int = 0,
    sigma: float = 0.1,
    low: float = LOW,
    high: float = HIGH,
    spread: float = 8.0,
    cross: bool = False,
) -> NeighbourHead:
    """A head of random weights, whose standard deviation is `spread`."""
    random = np.random.default_rng(seed)
    layers = []
    for inputs, outputs in zip(layer_inputs(hidden, cross), [*hidden, 1], strict=True):
        weights = np.rint(
            np.clip(random.normal(size=(outputs, inputs)) * spread, -MAX_WEIGHT, MAX_WEIGHT)
        ).astype(np.int8)
        biases = random.integers(-127, 128, outputs).astype(np.int8)
        layers.append(
            Layer(
                weights=weights,
                biases=biases,
                weight_scale=float(np.float16(0.02)),
                bias_scale=float(np.float16(0.003)),
            )
        )
    return NeighbourHead(
        layers=tuple(layers), sigma=float(np.float32(sigma)), low=low, high=high, cross=cross
    )


def random_tile(shape: tuple[int, ...], seed: int = 1) -> Floats:
    """Noise with plateaus at both ends of the clip range and constant stretches inside it."""
    tile = np.random.default_rng(seed).normal(size=shape).astype(np.float32) * 2
    if shape[1] > 4:
        tile[:, : shape[1] // 2] = np.float32(0.3)
        tile[0, -2:] = 0.0
    return tile
