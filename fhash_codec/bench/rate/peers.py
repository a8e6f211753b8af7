"""The peers of `fhash bench rate`: other codecs in their best layouts and settings, in HDF5 files.

SZ3, SPERR, ZFP and Blosc are the HDF5 filters of hdf5plugin. BitRound is that of numcodecs,
followed by Blosc (zstd, shuffle). Traps:

- SPERR's filter takes the axes in reverse unless `swap` is set, and crashes on NaN. Its PSNR refers
  to the range of one chunk, so a constant error over all frames needs a setting for each chunk.
- ZFP silently replaces NaN, and rounds its tolerance down to a power of two.
- Chunk caches are off: otherwise reading back would return what was written.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fhash_codec.bench.rate.layouts import Values, joined, parts_of
from fhash_formats.errors import InputError, MissingDependencyError

Filter = Mapping[str, Any]

LADDER = 20 * math.log10(2)
"""dB between settings that are powers of two apart."""
MAX_CHUNK = 2**31
"""Bytes of the largest chunk; HDF5 allows less than 4 GiB."""


BOTH = ("psnr", "bound")
"""Goals of a peer that is tried for every kind of quality."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One mode and layout of a peer.

    Attributes:
        peer: its name.
        mode: the kind of its setting, for people.
        layout: one of `layouts.LAYOUTS`; a dataset holds one of its parts.
        goals: qualities it is tried for, `psnr`, `bound` or both.
        setting: gives the HDF5 filter for (part of the data, range of the data, level). A level is
            a quality in dB: a uniform tolerance of range * 10^(-level / 20) stands at `level`.
        step: distance in dB of levels that differ at all, 0 for any.
        prepare: changes the values before the filter, at a level.
        chunk: largest length of a chunk along an axis of its layout, None for no limit.
        lossless: there is nothing to set, and values may be of any type and not finite.
    """

    peer: str
    mode: str
    layout: str
    goals: tuple[str, ...]
    setting: Callable[[Values, float, float], Filter]
    step: float = 0.0
    prepare: Callable[[Values, float], Values] | None = None
    chunk: int | None = None
    lossless: bool = False

    @property
    def name(self) -> str:
        """Description such as "SPERR rate, a chunk per frame"."""
        chunks = "a chunk" if self.chunk is None else f"chunks of {self.chunk}"
        return f"{self.peer} {self.mode}, {chunks} per {self.layout}"

    def chunk_shape(self, part: Values) -> tuple[int, ...]:
        """Shape of the chunks of a dataset: all of it, or even parts within the limits."""
        if self.chunk is not None:
            return tuple(-(-n // -(-n // self.chunk)) for n in part.shape)
        first, *others = part.shape
        return (max(1, min(first, MAX_CHUNK * first // part.nbytes)), *others)


def tolerance(data_range: float, level: float) -> float:
    """The absolute error at a level."""
    return data_range * math.pow(10.0, -level / 20)


def peers() -> dict[str, tuple[Variant, ...]]:
    """Every peer by name. Raises MissingDependencyError without hdf5plugin."""
    try:
        plugins = importlib.import_module("hdf5plugin")
    except ImportError as error:
        raise MissingDependencyError(
            "bench rate compares with the codecs of hdf5plugin; pip install 'fhash[bench]'"
        ) from error
    return {
        "SZ3": _sz3(plugins),
        "SPERR": _sperr(plugins),
        "ZFP": _zfp(plugins),
    }


def _sz3(plugins: Any) -> tuple[Variant, ...]:
    def absolute(part: Values, data_range: float, level: float) -> Filter:
        return plugins.SZ3(absolute=tolerance(data_range, level))  # type: ignore[no-any-return]

    return tuple(
        Variant(peer="SZ3", mode="tolerance", layout=layout, goals=BOTH, setting=absolute)
        for layout in ("frame", "plane", "series", "folded")
    )


def _sperr(plugins: Any) -> tuple[Variant, ...]:
    def absolute(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Sperr(absolute=tolerance(data_range, level), swap=True)  # type: ignore[no-any-return]

    def psnr(part: Values, data_range: float, level: float) -> Filter:
        own = max(float(part.max()) - float(part.min()), 1e-9 * data_range)
        quality = max(0.1, level + 20 * math.log10(own / data_range))
        return plugins.Sperr(peak_signal_to_noise_ratio=quality, swap=True)  # type: ignore[no-any-return]

    def rate(part: Values, data_range: float, level: float) -> Filter:
        # Bits a value. Each 6 dB double them, nearly true at low rates; the search does the rest.
        return plugins.Sperr(rate=min(63.9, max(2.0**-15, 2.0 ** (level / 6 - 9))), swap=True)  # type: ignore[no-any-return]

    # At equal PSNR a tolerance costs more bytes than the other modes: it is for bounds alone.
    modes = (("PSNR", "psnr", psnr), ("rate", "psnr", rate), ("tolerance", "bound", absolute))
    return tuple(
        Variant(peer="SPERR", mode=mode, layout=layout, goals=(goal,), setting=setting)
        for mode, goal, setting in modes
        for layout in ("frame", "plane", "folded")
    )


def _zfp(plugins: Any) -> tuple[Variant, ...]:
    def accuracy(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Zfp(accuracy=tolerance(data_range, level))  # type: ignore[no-any-return]

    return tuple(
        Variant(
            peer="ZFP", mode="tolerance", layout=layout, goals=BOTH, setting=accuracy, step=LADDER
        )
        for layout in ("frame", "plane", "series")
    )


@contextmanager
def stored(
    values: Values, variant: Variant, data_range: float, level: float, path: Path | None = None
) -> Iterator[Any]:
    """An open HDF5 file that holds values (t, z, y, x), in memory, or at `path` if one is given.

    Raises InputError for a shape or a setting that the filter refuses.
    """
    import h5py

    if variant.prepare is not None:
        values = variant.prepare(values, level)
    place: dict[str, Any] = {"driver": "core", "backing_store": False} if path is None else {}
    with h5py.File(path or f"{id(values)}.h5", "w", rdcc_nbytes=0, **place) as file:
        try:
            for number, part in enumerate(parts_of(values, variant.layout)):
                filters = variant.setting(part, data_range, level)
                file.create_dataset(
                    str(number),
                    data=part,
                    chunks=variant.chunk_shape(part),
                    track_times=False,
                    **filters,
                )
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{variant.name}: {error}") from error
        yield file


def opened_file(path: Path) -> Any:
    """The file of `stored` at a path, for reading, without a chunk cache; a context manager."""
    import h5py

    return h5py.File(path, "r", rdcc_nbytes=0)


def stored_bytes(file: Any) -> int:
    """Bytes of the chunks alone: the file's own structure is left out, which favours the peers."""
    return sum(int(dataset.id.get_storage_size()) for dataset in file.values())


def read_all(file: Any, variant: Variant, shape: tuple[int, ...]) -> Values:
    """Every value of a series of `shape` (t, z, y, x), decoded."""
    parts = [file[str(number)][...] for number in range(len(file))]
    return joined(parts, variant.layout, shape)


def filled(values: Values) -> Values:
    """Replace each value that is not finite by the nearest finite one before it in its row along x.

    Where there is none before it, by the nearest after it; where a row has none, along y, z and t.
    At least one value must be finite.
    """
    result = values.copy()
    for axis in (3, 2, 1, 0):
        for line in (result, np.flip(result, axis)):
            finite = np.isfinite(line)
            if finite.all():
                return result
            shape = [-1 if number == axis else 1 for number in range(4)]
            places = np.where(finite, np.arange(line.shape[axis]).reshape(shape), 0)
            np.maximum.accumulate(places, axis=axis, out=places)
            line[...] = np.take_along_axis(line, places, axis)
    return result
