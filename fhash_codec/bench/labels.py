"""`fhash bench labels`: bytes of labels beside `xz -9e`, everything without loss."""

from __future__ import annotations

import lzma
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import fhash_codec
from fhash_codec.bench.label_kinds import KINDS
from fhash_codec.bench.machine import machine
from fhash_codec.config import EncodeConfig
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import FhashError, InputError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.transform.chunk import encode_chunk

__all__ = ["LabelBench", "LabelSize", "bench_labels"]

NOTES = (
    "bytes of fhash are the whole file, at max_error 0; of xz the compressed array alone (xz -9e)",
    "bytes of the codec are those of one Zarr chunk that holds the whole series",
    "the made series are fixed; 'many' and 'ranks' led to coding more than 256 labels, the others"
    " were not looked at when the coder of labels was designed",
)


@dataclass(frozen=True, kw_only=True)
class LabelSize:
    """Figures of one series.

    Attributes:
        kind: its name.
        dtype, shape: of the array (t, z, y, x).
        distinct: number of different values.
        raw_bytes: bytes of the array.
        xz_bytes, fhash_bytes, codec_bytes: bytes of `xz -9e`, of the container, and of the codec
            for Zarr.
        seconds: time of encoding the container.
    """

    kind: str
    dtype: str
    shape: tuple[int, ...]
    distinct: int
    raw_bytes: int
    xz_bytes: int
    fhash_bytes: int
    codec_bytes: int
    seconds: float

    @property
    def ratio(self) -> float:
        """Bytes of the container over those of xz: below 1, fhash is smaller."""
        return self.fhash_bytes / self.xz_bytes


@dataclass(frozen=True, kw_only=True)
class LabelBench:
    """Figures of all series, the worst ratio first."""

    sizes: tuple[LabelSize, ...]
    machine: dict[str, Any]
    notes: tuple[str, ...] = NOTES

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "kinds": [asdict(size) | {"ratio": size.ratio} for size in self.sizes],
            "machine": self.machine,
            "notes": list(self.notes),
        }


def bench_labels(
    source: Source | None = None,
    *,
    kinds: Sequence[str] = (),
    effort: int | None = None,
    progress: Progress = silent,
) -> LabelBench:
    """Measure one source, or the made series of `kinds` (all of them where none are named).

    Args:
        source: a file, a Series or an array, which is held in memory; None for made series.
        kinds: names of KINDS.
        effort: of encoding; None for the usual one.
        progress: is told the number of series done.

    Raises InputError for an unknown kind and for a source together with kinds, and FhashError where
    a file does not decode to the values that went in.
    """
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise InputError(f"kind is '{unknown[0]}'; allowed: {', '.join(KINDS)}")
    if source is not None and kinds:
        raise InputError("kinds are made series; leave them out where DATA is given")
    settings = {} if effort is None else {"effort": effort}
    config = EncodeConfig.from_dict({"max_error": 0.0, "timings": False, **settings})
    total = 1 if source is not None else len(kinds or KINDS)
    sizes = []
    with tempfile.TemporaryDirectory(prefix="fhash-bench-") as folder:
        for number, (kind, series) in enumerate(_series(source, kinds or tuple(KINDS))):
            progress("measuring", number, total, kind)
            sizes.append(_measured(kind, series, config, Path(folder) / "run.fhz"))
    progress("measuring", total, total, "")
    ordered = sorted(sizes, key=lambda size: -size.ratio)
    return LabelBench(sizes=tuple(ordered), machine=machine())


def _series(source: Source | None, kinds: Sequence[str]) -> Iterator[tuple[str, Series]]:
    """Name and series of all that is measured."""
    if source is None:
        for kind in kinds:
            # xz keeps a fill value as well, so it is data here.
            yield kind, ArraySeries(KINDS[kind](), name=kind, keep_extremes=True)
        return
    with open_source(source) as series:
        yield f"{series.source} {series.name}", series


def _measured(kind: str, series: Series, config: EncodeConfig, path: Path) -> LabelSize:
    """Figures of a series. Raises FhashError where the file decodes to other values."""
    values = np.stack(list(series.frames()))
    begun = time.perf_counter()
    fhash_codec.encode(series, path, config, force=True)
    seconds = time.perf_counter() - begun
    with open_volume(path) as volume:
        if not np.array_equal(volume[...], values, equal_nan=values.dtype.kind == "f"):
            raise FhashError(f"{kind}: the file decodes to other values than those that went in")
    return LabelSize(
        kind=kind,
        dtype=values.dtype.name,
        shape=values.shape,
        distinct=int(np.unique(values).size),
        raw_bytes=values.nbytes,
        xz_bytes=len(lzma.compress(values.tobytes(), preset=9 | lzma.PRESET_EXTREME)),
        fhash_bytes=path.stat().st_size,
        codec_bytes=len(encode_chunk(values, max_error=0.0)),
        seconds=seconds,
    )
