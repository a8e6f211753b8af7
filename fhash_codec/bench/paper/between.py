"""Quality between key frames: places of all steps, and what the source itself has there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.paper.data import Data
from fhash_codec.features.key_frames import time_axis

if TYPE_CHECKING:
    from fhash_codec.bench.paper.encodings.trained import TrainedEncoding

MAX_PLACES = 1 << 18
"""Places of all steps together, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Random vertices of a step in the coreset of a neighbouring key frame.

    Attributes:
        key: time of the step in key frames.
        between: whether the step is no key frame.
        vertices: int64 (n, 3), z, y, x of the domain.
        truth: normalised values (n,).
        linear: the source's key frames, interpolated to the step, (n,).
        fringe: bool (n,), whether a vertex is in the coreset of one of the two key frames alone.
        selected: vertices of the step's own features.
        missed: of these, how many are in the coreset of neither key frame.
    """

    key: float
    between: bool
    vertices: npt.NDArray[np.int64]
    truth: npt.NDArray[np.float32]
    linear: npt.NDArray[np.float32]
    fringe: npt.NDArray[np.bool_]
    selected: int
    missed: int


def places_of(data: Data) -> list[Places]:
    """Return places of every step; it reads the whole series once."""
    return list(_places(data))


def _places(data: Data) -> Iterator[Places]:
    """Yield the places of one step after the other."""
    times = time_axis(data.series.coords["t"].values)
    keys = np.interp(times, *_ascending(times[list(data.key_frames)]))
    around = [(int(np.floor(key)), int(np.ceil(key))) for key in keys]
    # All steps give the same share of their vertices, so that no step counts for more than it has.
    vertices = sum(int((data.masks[low] | data.masks[high]).sum()) for low, high in around)
    taken = min(1.0, MAX_PLACES / max(vertices, 1))
    random = np.random.default_rng(0)
    for step, (key, (before, after)) in enumerate(zip(keys, around, strict=True)):
        mask, fringe = (
            data.masks[before] | data.masks[after],
            data.masks[before] ^ data.masks[after],
        )
        flat = np.flatnonzero(mask)
        if taken < 1:
            flat = np.sort(random.choice(flat, math.ceil(taken * len(flat)), replace=False))
        frame = data.series.read(step)
        feature = np.logical_or.reduce([each.select(frame, step) for each in data.features])
        truth = data.scanned.value_range.to_unit(frame.reshape(-1)[flat])
        low, high = (data.frames[number].reshape(-1)[flat] for number in (before, after))
        linear = low + np.float32(key - before) * (high - low)
        finite = np.isfinite(truth) & np.isfinite(linear)
        yield Places(
            key=float(key),
            between=step not in data.key_frames,
            vertices=np.stack(np.unravel_index(flat[finite], mask.shape), axis=1),
            truth=truth[finite],
            linear=linear[finite],
            fringe=fringe.reshape(-1)[flat[finite]],
            selected=int(np.count_nonzero(feature)),
            missed=int(np.count_nonzero(feature & ~mask)),
        )


def _ascending(
    times: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return key times in ascending order, for np.interp, and their numbers."""
    order = np.argsort(times)
    return times[order], order.astype(np.float64)


def measure_between(encoding: TrainedEncoding, places: list[Places]) -> dict[str, float | None]:
    """Return the figures of all steps, as a `Cell` has them: PSNR in dB, and shares."""
    import torch

    errors: dict[str, list[npt.NDArray[np.float64]]] = {
        "psnr": [],
        "psnr_key_frames": [],
        "psnr_between": [],
        "psnr_linear": [],
        "psnr_inner": [],
        "psnr_inner_linear": [],
        "psnr_fringe": [],
        "psnr_fringe_linear": [],
    }
    for step in places:
        decoded = encoding.sample(step.key, torch.from_numpy(step.vertices)).cpu().numpy()
        error = decoded.astype(np.float64) - step.truth
        errors["psnr"].append(error)
        if not step.between:
            errors["psnr_key_frames"].append(error)
            continue
        linear = step.linear.astype(np.float64) - step.truth
        errors["psnr_between"].append(error)
        errors["psnr_linear"].append(linear)
        errors["psnr_inner"].append(error[~step.fringe])
        errors["psnr_inner_linear"].append(linear[~step.fringe])
        errors["psnr_fringe"].append(error[step.fringe])
        errors["psnr_fringe_linear"].append(linear[step.fringe])
    between = [step for step in places if step.between]
    return {
        **{name: _psnr(parts) for name, parts in errors.items()},
        "fringe_share": _share(
            sum(int(step.fringe.sum()) for step in between), sum(map(_compared, between))
        ),
        "missed_share": _share(
            sum(step.missed for step in between), sum(step.selected for step in between)
        ),
    }


def _compared(step: Places) -> int:
    """Return the number of places of a step."""
    return len(step.truth)


def _share(part: int, whole: int) -> float | None:
    """Return a part as a share; None of nothing."""
    return part / whole if whole else None


def _psnr(errors: list[npt.NDArray[np.float64]]) -> float | None:
    """Return the PSNR in dB of normalised errors; None where they are 0 or not finite."""
    every = np.concatenate([np.zeros(0), *errors])
    mean = float(np.square(every).mean()) if len(every) else 0.0
    return -10 * math.log10(mean) if 0 < mean < math.inf else None
