"""Occupancy and layers of a file with coded tables, through the same coder as the tables.

Beside coded tables they would be a third of the file or more. The occupancy is coded as labels,
without loss. The larger matrices of the MLP are quantised; the tables are then coded for the layers
as the file has them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.network import Floats, Layer
from fhash_codec.paper.storage import write_occupancy
from fhash_formats.container import ContainerWriter
from fhash_formats.container.coding import transform_codecs
from fhash_formats.container.header import MASK_ARRAY, MASK_FEATURES
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.settings import TileSettings

MIN_WEIGHTS = 512
"""Smallest matrix that is quantised: the description of its coding takes some 200 bytes."""
WEIGHT_STEPS = tuple(2.0**-power for power in range(2, 13))
"""Quantiser steps tried for the weights of a matrix, as shares of their root mean square."""
MASK_VERTICES = 4 << 20
"""Vertices of a chunk of the occupancy; a frame is read by decoding one chunk."""

_PLAIN = TransformSpec.from_dict(dict.fromkeys("tzyx", "none"))


def quantised_layers(
    layers: Sequence[Layer], error: Callable[[Sequence[Layer]], float], allowed: float
) -> tuple[list[Layer], list[TileSettings | None]]:
    """Return layers with quantised weights, and how each matrix is coded.

    The step is the largest at which the error of the model stays allowed.

    Args:
        layers: weight and bias of each layer.
        error: mean squared error of the model with some layers.
        allowed: largest error.

    Returns:
        The layers as the file will have them, and the settings of each matrix; None for a matrix
        that is not quantised.
    """
    for share in WEIGHT_STEPS:
        settings = [_weight_settings(weight, share) for weight, _ in layers]
        quantised = [
            (weight if how is None else _decoded(weight, how), bias)
            for (weight, bias), how in zip(layers, settings, strict=True)
        ]
        if error(quantised) <= allowed:
            return quantised, settings
    return list(layers), [None] * len(layers)


def write_layers(
    writer: ContainerWriter, layers: Sequence[Layer], settings: Sequence[TileSettings | None]
) -> None:
    """Write the layers of `quantised_layers`."""
    for number, ((weight, bias), how) in enumerate(zip(layers, settings, strict=True), start=1):
        codecs = None if how is None else transform_codecs(how)
        writer.add_whole(f"mlp/weight_{number}", weight, codecs=codecs)
        writer.add_whole(f"mlp/bias_{number}", bias)


def write_mask(writer: ContainerWriter, coreset: Coreset) -> None:
    """Write the occupancy of a coreset as `occupancy/mask`, coded as labels.

    A number has one bit for each feature. More than MASK_FEATURES are written as bits.
    """
    box, grids = coreset.box.shape, coreset.grids
    keys = len(coreset.occupancy)
    steps = max(1, min(keys, MASK_VERTICES // prod(box)))
    if len(grids) > MASK_FEATURES:
        write_occupancy(writer, coreset)
        return

    def numbers(key: int) -> npt.NDArray[np.uint8]:
        result = np.zeros(box, np.uint8)
        for bit, packed in enumerate(grids):
            result |= occupancy.unpack(packed[key], box).view(np.uint8) << np.uint8(bit)
        return result

    writer.add_array(
        MASK_ARRAY,
        shape=(keys, *box),
        dtype=np.uint8,
        chunk_shape=(steps, *box),
        chunks=(
            np.stack([numbers(key) for key in range(first, min(first + steps, keys))])
            for first in range(0, keys, steps)
        ),
        dimension_names=("t", "z", "y", "x"),
        codecs=transform_codecs(
            TileSettings(
                transform=_PLAIN,
                step=1.0,
                center=0.0,
                low=0.0,
                high=float((1 << len(grids)) - 1),
                labels=True,
            )
        ),
    )


def _weight_settings(weight: Floats, share: float) -> TileSettings | None:
    """Return the settings of a matrix for a step, as a share of the root mean square."""
    size = float(np.sqrt(np.square(weight, dtype=np.float64).mean()))
    if weight.size < MIN_WEIGHTS or not size > 0:
        return None
    return TileSettings(
        transform=_PLAIN,
        step=float(str(np.float32(share * size))),
        center=0.0,
        low=float(str(weight.min())),
        high=float(str(weight.max())),
    )


def _decoded(weight: Floats, settings: TileSettings) -> Floats:
    """Return a matrix as a reader of the file gets it."""
    shape = weight.shape
    tile = encode_tile(weight.reshape(1, 1, *shape), settings, Coding())
    return np.ascontiguousarray(tile.decoded.reshape(shape))
