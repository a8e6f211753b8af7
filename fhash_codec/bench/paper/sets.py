"""The paper's data sets and the configurations of its encodings, by integers alone."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import TypeVar

from fhash_codec.bench.paper.printed import SETS as TITLES
from fhash_codec.bench.paper.printed import TABLE_2
from fhash_codec.boxes import Sizes
from fhash_codec.paper.network import level_resolutions, parameter_count
from fhash_formats.errors import InputError, suggestion

Number = TypeVar("Number", int, float)

EMBEDDING_SIZE = 2
"""Numbers of an embedding (paper, section 4.2)."""
BATCH = 1 << 21
"""Samples of a batch (paper, section 4.2)."""
USUAL_COARSEST = 4
"""Corners per axis of the coarsest hashed level, for data that are not the paper's."""
TCNN_WEIGHTS = 16
"""Multiple to which tiny-cuda-nn pads the inputs and outputs of its fused network."""
WIDTH = 64
"""Neurons of a hidden layer (paper, section 4.2)."""


@dataclass(frozen=True, kw_only=True)
class PaperSet:
    """A data set of the paper, its analogue here, and what the paper prints of its encodings.

    Attributes:
        title: the paper's name.
        frame: vertices (z, y, x) (paper, Table 2).
        steps: time steps.
        key_frames: key frames.
        grid: corners (z, y, x) of the single-resolution dense grid. The paper does not print them;
            its counts of parameters come out with these alone.
        coarsest: corners per axis of the coarsest hashed level, in the same way.
        segmentation_box: vertices (z, y, x) of its feature bounding box (paper, Table 2).
    """

    title: str
    frame: Sizes
    steps: int
    key_frames: int
    grid: Sizes
    coarsest: int
    segmentation_box: Sizes


def _resembled(scene: str, grid: Sizes, coarsest: int) -> PaperSet:
    """Return the data set that a scene resembles, with what the paper does not print of it."""
    printed = TABLE_2[scene]
    (x, y, z), box = printed.shape, printed.box
    return PaperSet(
        title=TITLES[scene],
        frame=(z, y, x),
        steps=printed.steps,
        key_frames=printed.key_frames,
        grid=grid,
        coarsest=coarsest,
        segmentation_box=(box[2], box[1], box[0]),
    )


SETS: dict[str, PaperSet] = {
    "flame": _resembled("flame", (64, 192, 192), 8),
    "bubble": _resembled("bubble", (256, 128, 128), 4),
    "shell": _resembled("shell", (192, 192, 192), 4),
}
"""The paper's data sets, by the scene of the simulator that resembles them."""

SCALES = {"full": 1, "half": 2, "quarter": 4, "eighth": 8}
"""Divisors of the paper's lengths, by name."""


def paper_set(name: str) -> PaperSet:
    """Return the data set that a scene resembles; raises InputError for another name."""
    if name not in SETS:
        raise InputError(f"data set is '{name}'; {suggestion(name, SETS)}")
    return SETS[name]


def scaled(lengths: Sizes, divisor: int) -> Sizes:
    """Return lengths divided and rounded up: 200 x 172 x 54 at 4 is 50 x 43 x 14."""
    z, y, x = (-(-length // divisor) for length in lengths)
    return z, y, x


def hash_resolutions(frame: Sizes, coarsest: int) -> list[int]:
    """Return the corners per axis of the hashed levels, finest first.

    Each has half as many as the one before, down to `coarsest`; the finest is the first power of
    two times `coarsest` that covers the longest axis. The paper's sets get 6, 7 and 7 levels from
    256 down to 8, 4 and 4.
    """
    finest = coarsest
    while finest < max(frame):
        finest *= 2
    resolutions = [finest]
    while resolutions[-1] > coarsest:
        resolutions.append(resolutions[-1] // 2)
    return resolutions


def hash_table(frame: Sizes) -> int:
    """Return the buckets of a hash table: the largest power of two below the frame's vertices.

    The paper's sets get its 2^20, 2^21 and 2^23.
    """
    return 1 << max((prod(frame) - 1).bit_length() - 1, 4)


def dense_levels(grid: Sizes) -> list[Sizes]:
    """Return the corners (z, y, x) of the levels of a multi-resolution dense grid, finest first.

    Each level halves the one before, rounding up, as long as an axis has more than two corners.
    """
    levels = [grid]
    while max(levels[-1]) > 2:
        z, y, x = (-(-length // 2) for length in levels[-1])
        levels.append((z, y, x))
    return levels


def hash_parameters(frame: Sizes, coarsest: int, key_frames: int) -> int:
    """Return the numbers in the tables of the hash encoding: every level has a whole table."""
    levels = len(hash_resolutions(frame, coarsest))
    return levels * hash_table(frame) * EMBEDDING_SIZE * key_frames


def tcnn_tables(frame: Sizes, coarsest: int, key_frames: int) -> int:
    """Return the numbers in tiny-cuda-nn's tables: none is larger than its level's grid.

    A table has a multiple of 8 buckets.
    """
    table = hash_table(frame)
    buckets = (min(-(-(n**3) // 8) * 8, table) for n in hash_resolutions(frame, coarsest))
    return sum(buckets) * EMBEDDING_SIZE * key_frames


def tcnn_network(levels: int, key_frames: int) -> int:
    """Return the weights of tiny-cuda-nn's networks: two hidden layers, padded, without biases."""
    inputs = -(-levels * EMBEDDING_SIZE // TCNN_WEIGHTS) * TCNN_WEIGHTS
    return (inputs * WIDTH + WIDTH * WIDTH + WIDTH * TCNN_WEIGHTS) * key_frames


def dense_parameters(grid: Sizes, key_frames: int) -> int:
    """Return the numbers of a single-resolution dense grid for each key frame."""
    return prod(grid) * EMBEDDING_SIZE * key_frames


def dense_multi_parameters(grid: Sizes, key_frames: int) -> int:
    """Return the numbers of a multi-resolution dense grid for each key frame."""
    return sum(dense_parameters(level, key_frames) for level in dense_levels(grid))


def fhash_parameters(box: Sizes, key_frames: int, fold: int = 2) -> int:
    """Return the numbers in the tables of F-Hash."""
    return parameter_count(level_resolutions(box, key_frames, fold), EMBEDDING_SIZE)


def paper_parameters(name: str) -> dict[str, int]:
    """Return the parameters of each encoding at the paper's configuration of a data set.

    They are those of the tables; `tcnn` counts its networks too, as the paper's figures do.
    `fhash` is that of the segmentation.
    """
    known = paper_set(name)
    frame, keys = known.frame, known.key_frames
    levels = len(hash_resolutions(frame, known.coarsest))
    return {
        "hash": hash_parameters(frame, known.coarsest, keys),
        "tcnn": tcnn_tables(frame, known.coarsest, keys) + tcnn_network(levels, keys),
        "dense": dense_parameters(known.grid, keys),
        "dense-multi": dense_multi_parameters(known.grid, keys),
        "fhash": fhash_parameters(known.segmentation_box, keys),
    }
