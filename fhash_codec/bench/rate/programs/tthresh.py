"""TTHRESH (Ballester-Ripoll, Lindstrom, Pajarola 2019): a Tucker decomposition of the whole.

It steers by PSNR alone. For a bound the search takes the lowest PSNR whose decoded values keep it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

import numpy as np

from fhash_codec.bench.rate.layouts import Values
from fhash_codec.bench.rate.programs.program import ProgramVariant, called
from fhash_codec.bench.rate.programs.raw_files import as_float, read_raw, write_raw

__all__ = ["tthresh_variants"]

UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of a uniformly distributed error lies below the tolerance of a level."""
HALF_RANGE = 20 * math.log10(2)
"""dB by which the program's PSNR lies below ours: it is relative to half of the range."""
CONSTANT = Struct("<d")
"""A part of one value alone, which the program would take minutes and megabytes for."""
LEAST_AXES = 3
"""Axes that an array must have."""


@dataclass(frozen=True, kw_only=True)
class Tthresh:
    """The program at a path."""

    path: str

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded; see `Program`. Its axes go from the fastest to the slowest."""
        low, high = float(part.min()), float(part.max())
        if low == high:
            file.write_bytes(CONSTANT.pack(low))
            return
        own = high - low
        # The program's PSNR is relative to the range of what it is given.
        psnr = level + UNIFORM - HALF_RANGE + 20 * math.log10(max(own, 1e-9 * scale[1]) / scale[1])
        lengths = [n for n in part.shape if n > 1]
        lengths += [1] * (LEAST_AXES - len(lengths))
        values, raw = as_float(part), file.with_suffix(".raw")
        write_raw(values, raw)
        kind = "float" if values.itemsize == 4 else "double"
        sizes = [str(n) for n in reversed(lengths)]
        target = ("-p", f"{max(psnr, 0.1):.6f}")
        called([self.path, "-i", raw, "-t", kind, "-s", *sizes, *target, "-c", file])
        raw.unlink()

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array from its file; see `Program`. The program keeps the number type."""
        if file.stat().st_size == CONSTANT.size:
            return np.full(shape, CONSTANT.unpack(file.read_bytes())[0])
        raw = file.with_suffix(".out")
        called([self.path, "-c", file, "-o", raw])
        count = math.prod(shape)
        wide = raw.is_file() and raw.stat().st_size == 8 * count
        values = read_raw(raw, "<f8" if wide else "<f4", shape)
        raw.unlink()
        return values


def tthresh_variants(path: str) -> tuple[ProgramVariant, ...]:
    """All of the series together, four axes or three."""
    return tuple(
        ProgramVariant(
            peer="TTHRESH",
            mode="PSNR",
            layout=layout,
            goals=("psnr", "bound"),
            program=Tthresh(path=path),
        )
        for layout in ("series", "frame")
    )
