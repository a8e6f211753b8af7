"""A running simulation that appends for ever, and tells after each step how many are written.

As a program: python kill_writer.py FILE [resume]. A test kills it. Its frames are those of `frame`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

BOUND = 1e-3
SHAPE = (4, 10, 12)
TILE = "3x4x10x12"


def frame(step: int) -> np.ndarray:
    """Values (z, y, x) of a step."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    return (np.sin(5 * x + 0.2 * step) * np.cos(4 * y) + z).astype(np.float32)


def main(path: Path, *, resume: bool) -> None:
    """Append steps until the process is killed."""
    from fhash_codec import EncodeConfig, Writer

    if resume:
        writer = Writer.resume(path)
    else:
        config = EncodeConfig(max_error=BOUND, effort=1, tile=TILE)
        writer = Writer(path, shape=SHAPE, config=config)
    with writer:
        while True:
            writer.append(frame(writer.steps), time=0.5 * writer.steps)
            print(writer.steps_written, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), resume=len(sys.argv) > 2)
