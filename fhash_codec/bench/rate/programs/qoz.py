"""QoZ 2, HPEZ and SZ3 as programs: interpolation with a bound, tuned for the data.

All three have the options of the SZ3 program. QoZ and HPEZ take their full search (`-q 4`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from fhash_codec.bench.rate.layouts import Values
from fhash_codec.bench.rate.programs.program import ProgramVariant, called
from fhash_codec.bench.rate.programs.raw_files import as_float, read_raw, write_raw

__all__ = ["QOZ_NAMES", "qoz_variants"]

QOZ_NAMES = {"qoz": "QoZ", "hpez": "HPEZ", "sz3": "SZ3 program"}
"""Names of the programs, and of the codecs."""
FULL_SEARCH = {"qoz": ("-q", "4"), "hpez": ("-q", "4"), "sz3": ()}
"""Options of each program for its strongest mode."""


@dataclass(frozen=True, kw_only=True)
class Qoz:
    """The program at a path, with further options."""

    path: str
    options: tuple[str, ...]

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded within an absolute error; see `Program`."""
        values, raw = as_float(part), file.with_suffix(".raw")
        tolerance = scale[1] * math.pow(10.0, -level / 20)
        write_raw(values, raw)
        lengths = _lengths(part.shape)
        bound = ("-M", "ABS", f"{tolerance:.9g}", *self.options)
        called([self.path, *_type(values.itemsize), "-i", raw, "-z", file, *lengths, *bound])
        raw.unlink()
        # The decoder must be told the type again.
        file.with_suffix(".type").write_text(str(values.itemsize), encoding="ascii")

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array from its file; see `Program`."""
        itemsize = int(file.with_suffix(".type").read_text(encoding="ascii"))
        raw = file.with_suffix(".out")
        called([self.path, *_type(itemsize), "-z", file, "-o", raw, *_lengths(shape)])
        values = read_raw(raw, f"<f{itemsize}", shape)
        raw.unlink()
        return values


def _type(itemsize: int) -> list[str]:
    """Option for float32 or float64."""
    return ["-f" if itemsize == 4 else "-d"]


def _lengths(shape: tuple[int, ...]) -> list[str]:
    """Option and lengths of the axes, the fastest first, without axes of one value."""
    lengths = [n for n in shape if n > 1] or [1]
    return [f"-{len(lengths)}", *(str(n) for n in reversed(lengths))]


def qoz_variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    """Every layout of a program of QOZ_NAMES."""
    return tuple(
        ProgramVariant(
            peer=QOZ_NAMES[name],
            mode="tolerance",
            layout=layout,
            goals=("psnr", "bound"),
            program=Qoz(path=path, options=FULL_SEARCH[name]),
        )
        for layout in ("series", "folded", "frame", "plane")
    )
