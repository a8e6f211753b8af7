"""A smooth tile, settings, heads and predictors for it, and its streams in every form."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from specs import spec_of

from fhash_formats.native import crc32c
from fhash_formats.transform.head import INPUTS, MAX_WEIGHT, Layer, NeighbourHead
from fhash_formats.transform.predict import Predictor, passes_of
from fhash_formats.transform.spec import MaskLevels
from fhash_formats.transform.tile import Coding, encode_tile, exact_tile
from fhash_formats.transform.tile_format import TileSettings

Values = npt.NDArray[Any]

SHAPE = (2, 3, 7, 10)
SPEC = spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), SHAPE)
SETTINGS = TileSettings(
    transform=SPEC, step=0.1, center=0.5, low=-2.0, high=3.0, quantum=0.08 * (1 - 1e-6)
)


def wave(shape: tuple[int, ...] = SHAPE, dtype: npt.DTypeLike = np.float32) -> Values:
    """A sum of sines within the range of SETTINGS."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    return (np.sin(0.3 * t + 0.5 * y) + np.cos(0.4 * x - 0.2 * z) + 0.3).astype(dtype)


def same(values: Values, others: Values) -> bool:
    """Whether two arrays have one type and the same values, NaN included."""
    return values.dtype == others.dtype and np.array_equal(
        values, others, equal_nan=values.dtype.kind == "f"
    )


WHOLE = (4, 12, 13, 14)
"""Shape of a tile with a head."""


def with_head(hidden: tuple[int, ...] = (12, 8)) -> TileSettings:
    """Settings of tiles of the shape WHOLE, whose head has random weights."""
    spec = spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), WHOLE)
    head = random_head(hidden, spread=16.0)
    return replace(SETTINGS, transform=spec, quantum=0.0, head=head, clip=True)


def streams() -> dict[str, tuple[Values, bytes]]:
    """A tile and its stream, with own settings, for each combination of sections."""
    values = wave((1, 3, 4, 5))
    holes = values.copy()
    holes[0, 1, 2, 1:4] = [np.nan, np.inf, -np.inf]
    integers = (values * 50).astype("i2")
    coarse, fine = replace(SETTINGS, quantum=0.0), replace(SETTINGS, quantum=0.002)
    own, nothing = Coding(own_settings=True), np.zeros(holes.shape, bool)
    masked, some = replace(coarse, mask=MaskLevels()), values > 0.5
    predictor = predictor_of((0, 1, 1, 1), step=fine.quantum)
    return {
        "plain": (values, encode_tile(values, coarse, own).data),
        "residual": (values, encode_tile(values, fine, replace(own, error=0.001)).data),
        "blocks": (values, encode_tile(values, fine, replace(own, error=0.001, cut=1 << 4)).data),
        "missing": (holes, encode_tile(holes, SETTINGS, replace(own, error=0.04)).data),
        "empty": (holes, encode_tile(holes, coarse, own, in_coreset=nothing).data),
        "exact": (holes, exact_tile(holes).data),
        "integers": (integers, encode_tile(integers, replace(SETTINGS, high=99.0), own).data),
        "mask": (holes, encode_tile(holes, masked, own, in_coreset=some).data),
        "exact mask": (values, exact_tile(values, occupied=some).data),
        "empty mask": (values, encode_tile(values, masked, own, in_coreset=nothing).data),
        "predicted": (
            values,
            encode_tile(values, replace(fine, predictor=predictor), replace(own, error=0.001)).data,
        ),
        "labels": (
            integers,
            encode_tile(integers // 30, replace(coarse, labels=True), replace(own, error=0.0)).data,
        ),
    }


def resealed(data: bytes) -> bytes:
    """A changed stream with the checksum of what it is now."""
    return crc32c(data[4:]).to_bytes(4, "little") + data[4:]


def damaged_copies(data: bytes) -> list[bytes]:
    """A stream cut at every length, with bytes after its end, and with each of its bits flipped."""
    flipped = [
        data[:n] + bytes([data[n] ^ 1 << bit]) + data[n + 1 :]
        for n in range(len(data))
        for bit in range(8)
    ]
    return [*(data[:n] for n in range(len(data))), data + b"\0", data + b"\x01a", *flipped]


Four = tuple[int, int, int, int]


def predictor_of(
    levels: Four = (2, 3, 3, 3),
    order: Four = (0, 1, 2, 3),
    reach: int = 1,
    seed: int = 0,
    step: float = 1.0,
    origin: float = 0.0,
) -> Predictor:
    """A predictor with random weights for the passes of these levels, order and reach."""
    count = sum(len(a_pass.taps) for a_pass in passes_of(levels, order, reach))
    weights = np.random.default_rng(seed).integers(-300, 301, count)
    return Predictor(
        step=step,
        origin=origin,
        levels=levels,
        order=order,
        reach=reach,
        weights=tuple(weights.tolist()),
    )


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
) -> NeighbourHead:
    """A head of random weights, whose standard deviation is `spread`."""
    random = np.random.default_rng(seed)
    layers = []
    for inputs, outputs in pairwise((INPUTS, *hidden, 1)):
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
    return NeighbourHead(layers=tuple(layers), sigma=float(np.float32(sigma)), low=low, high=high)


def random_tile(shape: tuple[int, ...], seed: int = 1) -> Floats:
    """Noise with plateaus at both ends of the clip range and constant stretches inside it."""
    tile = np.random.default_rng(seed).normal(size=shape).astype(np.float32) * 2
    if shape[1] > 4:
        tile[:, : shape[1] // 2] = np.float32(0.3)
        tile[0, -2:] = 0.0
    return tile
