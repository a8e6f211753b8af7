"""Prediction of an encoding: seconds, bytes and PSNR for some settings, before it is done."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import FhashWarning, QualityError
from fhash_formats.series import Series, StepsSeries

__all__ = ["Prediction", "predict"]

PART_VERTICES = 1 << 18
"""Vertices of the part of a series that is encoded for a prediction, at least one step."""
EPOCHS = 2
"""Epochs of a training that is predicted from."""
USUAL_EPOCHS = 50
"""Epochs where the settings name none: 1000 steps at 20 an epoch."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Prediction of an encoding.

    Attributes:
        seconds: of the whole job, measuring included.
        bytes: of the file; None where nothing tells them.
        psnr: in dB over the coreset; None where nothing tells it, and for exact values.
        basis: what the prediction rests on, and how uncertain it is, as one line of text.
    """

    seconds: float
    bytes: int | None
    psnr: float | None
    basis: str


def predict(
    series: Series, configs: Sequence[EncodeConfig], *, progress: Progress = silent
) -> list[Prediction]:
    """Predict the encodings of a series, one for each of the settings.

    series: the data; a part of them is read.
    configs: the settings.
    progress: called with each step of the work.

    Raises InputError for settings that do not fit the series.
    """
    part = _part(series)
    share = prod(part.shape) / prod(series.shape)
    predictions = []
    for number, config in enumerate(configs):
        progress("predicting", number, len(configs), "")
        predictions.append(_of_part(part, config, share))
    progress("predicting", len(configs), len(configs), "")
    return predictions


def _part(series: Series) -> Series:
    """Return the steps in the middle of a series that have at most PART_VERTICES together."""
    steps = series.shape[0]
    count = min(steps, max(1, PART_VERTICES // prod(series.shape[1:])))
    first = (steps - count) // 2
    return StepsSeries(series, range(first, first + count))


def _of_part(part: Series, config: EncodeConfig, share: float) -> Prediction:
    """Return what the encoding of a part tells of the whole; `share` is its share of that."""
    trained = {"epochs": EPOCHS} if config.profile == "paper" else {}
    begun = time.perf_counter()
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        try:
            report = encode(part, Path(folder) / "part.fhz", replace(config, **trained))
        except QualityError as error:
            report = error.figures
    seconds = (time.perf_counter() - begun) / share
    if trained:
        seconds *= max(1.0, (config.epochs or USUAL_EPOCHS) / EPOCHS)
    return Prediction(
        seconds=seconds,
        bytes=round(report["bytes"] / share),
        psnr=None if trained else report["psnr"],
        basis=f"an encoding of {part.shape[0]} steps, scaled by their number",
    )
