"""Quality between key frames: places of all steps, and what the source itself has there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.paper.data import Data
from fhash_codec.coreset.key_frames import time_axis

if TYPE_CHECKING:
    from fhash_codec.bench.paper.encodings.trained import TrainedEncoding

MAX_PLACES = 1 << 18
"""Places of all steps together, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Random vertices of a step in the coreset of a neighbouring key frame.

    Attributes:
        key: time of the step in key frames; a whole number at a key frame.
        vertices: int64 (n, 3), z, y, x of the domain.
        truth: normalised values (n,).
        linear: the source's key frames, interpolated to the step, (n,).
    """

    key: float
    vertices: npt.NDArray[np.int64]
    truth: npt.NDArray[np.float32]
    linear: npt.NDArray[np.float32]


def places_of(data: Data) -> list[Places]:
    """Return places of every step; it reads the whole series once."""
    return list(_places(data))


def _places(data: Data) -> Iterator[Places]:
    """Yield the places of one step after the other."""
    times = time_axis(data.series.coords["t"].values)
    keys = np.interp(times, *_ascending(times[list(data.key_frames)]))
    quota = max(1, MAX_PLACES // len(times))
    random = np.random.default_rng(0)
    for step, key in enumerate(keys):
        before = min(int(key), len(data.key_frames) - 1)
        after, share = min(before + 1, len(data.key_frames) - 1), key - before
        mask = data.masks[before] | data.masks[after] if share > 0 else data.masks[before]
        flat = np.flatnonzero(mask)
        if len(flat) > quota:
            flat = np.sort(random.choice(flat, quota, replace=False))
        truth = data.scanned.value_range.to_unit(data.series.read(step).reshape(-1)[flat])
        low, high = (data.frames[number].reshape(-1)[flat] for number in (before, after))
        linear = low + np.float32(share) * (high - low)
        finite = np.isfinite(truth) & np.isfinite(linear)
        yield Places(
            key=float(key),
            vertices=np.stack(np.unravel_index(flat[finite], mask.shape), axis=1),
            truth=truth[finite],
            linear=linear[finite],
        )


def _ascending(
    times: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return key times in ascending order, for np.interp, and their numbers."""
    order = np.argsort(times)
    return times[order], order.astype(np.float64)


def measure_between(encoding: TrainedEncoding, places: list[Places]) -> dict[str, float | None]:
    """Return {"psnr", "psnr_between", "psnr_linear"} in dB, as a `Cell` has them."""
    import torch

    errors: dict[str, list[npt.NDArray[np.float64]]] = {
        "psnr": [],
        "psnr_between": [],
        "psnr_linear": [],
    }
    for step in places:
        decoded = encoding.sample(step.key, torch.from_numpy(step.vertices)).cpu().numpy()
        error = decoded.astype(np.float64) - step.truth
        errors["psnr"].append(error)
        if not step.key.is_integer():
            errors["psnr_between"].append(error)
            errors["psnr_linear"].append(step.linear.astype(np.float64) - step.truth)
    return {name: _psnr(parts) for name, parts in errors.items()}


def _psnr(errors: list[npt.NDArray[np.float64]]) -> float | None:
    """Return the PSNR in dB of normalised errors; None where they are 0 or not finite."""
    every = np.concatenate([np.zeros(0), *errors])
    mean = float(np.square(every).mean()) if len(every) else 0.0
    return -10 * math.log10(mean) if 0 < mean < math.inf else None
