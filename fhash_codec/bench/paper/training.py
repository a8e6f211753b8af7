"""Training of one cell: epochs on the clock, measurements outside it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.bench.paper.cell import Point
from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.encoding import Encoding
from fhash_codec.progress import Progress, silent

EVERY_EPOCH = 20
"""Epochs from the first that are all measured."""
POINTS = 20
"""Points of a curve after these, about."""
DECIBELS = (20.0, 30.0, 40.0)
"""PSNR in dB to which the paper's Table 3 gives times."""

Frames = Sequence[npt.NDArray[np.float32]]
PictureMeasure = Callable[[Frames], tuple[float, float]]
"""Mean PSNR in dB and SSIM of pictures of the key frames' normalised frames (z, y, x)."""


@dataclass(frozen=True, kw_only=True)
class Trained:
    """The course of a training.

    Attributes:
        curve: points, the first before training.
        seconds: of all epochs, as `Point` has them, without the measurements.
    """

    curve: tuple[Point, ...]
    seconds: float


def measured_epochs(epochs: int) -> list[int]:
    """Return the epochs after which a training is measured, 0 and the last one included.

    All up to EVERY_EPOCH are, and 30, of which the paper's Table 4 is.
    """
    every = max(1, (epochs - EVERY_EPOCH) // POINTS)
    return [
        epoch
        for epoch in range(epochs + 1)
        if epoch <= EVERY_EPOCH or epoch in (30, epochs) or (epoch - EVERY_EPOCH) % every == 0
    ]


def train(
    encoding: Encoding,
    data: Data,
    epochs: int,
    *,
    device: torch.device,
    picture: PictureMeasure | None = None,
    progress: Progress = silent,
) -> Trained:
    """Train an encoding and measure it on the way.

    Args:
        encoding: the encoding, changed in place. The caller has warmed up its kind.
        data: what it is trained on and compared with.
        epochs: passes over its samples.
        device: where it computes.
        picture: measures pictures of the key frames.
        progress: called after each epoch.
    """
    # Others on the machine do not slow a processor's own seconds.
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    points, seconds = [_point(encoding, data, 0, 0.0, picture)], 0.0
    measured = set(measured_epochs(epochs))
    for epoch in range(epochs):
        begun = clock()
        encoding.train_epoch(epoch)
        wait(device)
        seconds += clock() - begun
        if epoch + 1 in measured:
            points.append(_point(encoding, data, epoch + 1, seconds, picture))
        latest = points[-1].coreset_psnr
        note = "" if latest is None else f"{latest:.1f} dB"
        progress("training", epoch + 1, epochs, note)
    return Trained(curve=tuple(points), seconds=seconds)


def rank(curve: Sequence[Point]) -> tuple[int, float, float]:
    """Return a key that is larger for the better of two courses of an encoding.

    More of DECIBELS reached on the coreset come first, then fewer seconds to the last of these,
    then the highest PSNR.
    """
    seconds = [first_seconds(curve, decibels) for decibels in DECIBELS]
    reached = [value for value in seconds if value is not None]
    highest = max((point.coreset_psnr or -math.inf for point in curve), default=-math.inf)
    return len(reached), -reached[-1] if reached else -math.inf, highest


def first_seconds(curve: Sequence[Point], decibels: float) -> float | None:
    """Return the seconds of training to a PSNR of the coreset; None where it is not reached."""
    return next(
        (p.seconds for p in curve if p.coreset_psnr is not None and p.coreset_psnr >= decibels),
        None,
    )


def wait(device: torch.device) -> None:
    """Wait until a GPU has finished; a CPU always has."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def _point(
    encoding: Encoding,
    data: Data,
    epoch: int,
    seconds: float,
    picture: PictureMeasure | None,
) -> Point:
    """Return the figures of an encoding after some epochs."""
    encoding.settle()
    frames = [encoding.frame(key) for key in range(len(data.key_frames))]
    step = epoch * encoding.steps_an_epoch
    if not all(np.isfinite(frame).all() for frame in frames):
        return Point(step=step, epoch=epoch, seconds=seconds)
    picture_psnr, picture_ssim = (None, None) if picture is None else picture(frames)
    return Point(
        step=step,
        epoch=epoch,
        seconds=seconds,
        coreset_psnr=masked_psnr(data.frames, frames, data.masks),
        picture_psnr=picture_psnr,
        picture_ssim=picture_ssim,
    )


def masked_psnr(
    truth: Frames, frames: Frames, masks: Sequence[npt.NDArray[np.bool_]]
) -> float | None:
    """Return the PSNR in dB of normalised frames (z, y, x) over masked vertices.

    The peak is 1. It is None without an error, and without a vertex.
    """
    squares = count = 0.0
    for original, decoded, mask in zip(truth, frames, masks, strict=True):
        difference = original[mask].astype(np.float64) - decoded[mask]
        squares, count = squares + float(difference @ difference), count + len(difference)
    return 10 * math.log10(count / squares) if squares > 0 else None
