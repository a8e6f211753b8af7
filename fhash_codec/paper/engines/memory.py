"""Memory that the slab engine needs on a device of its own, told before it starts."""

from __future__ import annotations

from math import prod

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture

LIBRARIES = 1 << 28
"""Bytes for the libraries of CUDA: their code and the workspaces of matrix products."""
UNEVEN = 2
"""Largest number of bricks of a batch, as a multiple of the mean: batches have as many samples."""
TIMES = 2
"""Copies of a step's memory: captured graphs hold theirs beside that of the first steps."""


def needed_bytes(architecture: Architecture, coreset: Coreset, batches: int) -> int:
    """Return about how many bytes a training takes, rather too many than too few.

    Args:
        architecture: the sizes of the model.
        coreset: the training samples.
        batches: batches of an epoch.
    """
    bricks, vertices = len(coreset.bricks), prod(coreset.brick_shape)
    samples = len(coreset.values) + 1
    size = architecture.embedding_size
    coarse = size * sum(prod(level) for level in architecture.levels[1:])
    network = sum(outputs * (inputs + 1) for outputs, inputs in architecture.layer_shapes)
    # Embeddings, mean and square of the finest level; values, masks, offsets and coordinates.
    held = 12 * size * samples + 4 * samples + coreset.mask_bits.nbytes
    held += bricks * (8 + 4 * 8)
    # Four vectors of the numbers in use, their places, rank, mask, and the initial tables.
    held += coarse * (4 * 4 + 8 + 4 + 1 + 4) + 16 * network
    batch = min(UNEVEN * -(-bricks // batches), bricks)
    return LIBRARIES + held + TIMES * batch * vertices * _bytes_a_vertex(architecture)


def _bytes_a_vertex(architecture: Architecture) -> int:
    """Return the bytes that a training step holds for each vertex of its bricks."""
    inputs = architecture.inputs
    hidden = sum(outputs + 1 for outputs, _ in architecture.layer_shapes[:-1])
    # Inputs and their gradients, each also for samples alone; activations and their gradients.
    numbers = 4 * (inputs + 1) + 2 * hidden
    # Rows of the finest level, what Adam makes of them and the effect of missed steps, products of
    # the interpolation, target, residual and its square.
    numbers += 7 * architecture.embedding_size + 4 + 3 * architecture.embedding_size + 4
    # Mask, its bits and sums, ranks, places of the samples and their bricks.
    return 4 * numbers + 2 + 5 * 8
