"""Prediction of an encoding: seconds, bytes and PSNR before it is done; effort by a time budget."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import prod
from typing import Annotated, TypedDict

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.probe import (
    PaperProbe,
    now,
    part_of,
    probe_compact,
    probe_paper,
    promise_of_part,
    windows_of,
)
from fhash_codec.cost.results import seconds_text
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Series

PART = 0.25
"""Share of the steps of a short series that is encoded at most: a probe must not take long."""
WHOLE_SECONDS = 1.0
"""Predicted seconds up to which the whole series is encoded instead: nobody waits for these."""
TRAINED_ON = 4 << 20
"""Vertices of a series up to which the published network is probed on all of it."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Prediction of an encoding.

    Attributes:
        seconds: of the whole job, measuring included.
        bytes: of the file; None where nothing tells them.
        psnr: in dB over the coreset; None where nothing tells it, and for exact values.
        basis: what the prediction rests on, and how uncertain it is, as one line of text.
        stages: seconds of each stage, by the names of `fhash_codec.progress`.
    """

    seconds: float
    bytes: int | None
    psnr: float | None
    basis: str
    stages: dict[str, float] = field(default_factory=dict)


class Predictor:
    """Prediction of several encodings of one series, by encodings of a part of it."""

    def __init__(self, series: Series) -> None:
        self._series = series
        self._encoded: dict[EncodeConfig, Prediction] = {}
        self._trainings: dict[EncodeConfig, PaperProbe] = {}

    def predict(self, config: EncodeConfig) -> Prediction:
        """Predict the encoding with some settings.

        Raises InputError for settings that do not fit the series.
        """
        with warnings.catch_warnings():
            # The encoding itself will say them.
            warnings.simplefilter("ignore", FhashWarning)
            if config.published:
                return self._paper(config)
            if config not in self._encoded:
                self._encoded[config] = self._compact(config)
            return self._encoded[config]

    def _compact(self, config: EncodeConfig) -> Prediction:
        begun, series = now(), self._series
        part, vertices = part_of(series, PART), prod(series.shape)
        try:
            asked = promise_of_part(config, part, series)
            probe = probe_compact(part, asked)
            if not self._encoded and sum(probe.stages.values()) < WHOLE_SECONDS:
                # The first encoding of a process also pays for what is loaded.
                probe = probe_compact(part, asked)
        except InputError:
            # The part may lack what the whole has: a feature, steps of a mask, room for a ratio.
            part, probe = series, probe_compact(series, config)
        if part is not series and sum(probe.stage_seconds(vertices).values()) < WHOLE_SECONDS:
            part, probe = series, probe_compact(series, config)
        stages = probe.stage_seconds(vertices)
        return Prediction(
            seconds=sum(stages.values()),
            bytes=probe.bytes(vertices),
            psnr=probe.psnr,
            basis=_basis(part, series, now() - begun),
            stages=stages,
        )

    def _paper(self, config: EncodeConfig) -> Prediction:
        begun, series = now(), self._series
        key = replace(config, epochs=0, timings=True)
        part = windows_of(series, TRAINED_ON) if config.key_frames == "all" else series
        if key not in self._trainings:
            share = part.shape[0] / series.shape[0]
            self._trainings[key] = probe_paper(part, share, key)
        probe = self._trainings[key]
        stages = probe.stage_seconds(config)
        more = config.coded and not config.epochs
        return Prediction(
            seconds=sum(stages.values()),
            bytes=None if config.coded else probe.bytes,
            psnr=None,
            basis=f"two epochs on {_steps(part, series)}, in {now() - begun:.1f} s"
            + ("; further rounds for the promise are not counted" if more else "")
            + "; the PSNR is not told before the training",
            stages=stages,
        )


def _steps(part: Series, series: Series) -> str:
    """The part of a series that was encoded, in words."""
    if part is series:
        return "the whole series"
    crop = " cropped in space" if part.shape[1:] != series.shape[1:] else ""
    return f"{part.shape[0]} of {series.shape[0]} steps{crop}"


def _basis(part: Series, series: Series, seconds: float) -> str:
    """The basis of a prediction without the published network, in words."""
    uncertain = "seconds within a factor of 2, bytes within one of 1.7, more often too many"
    if part is series:
        uncertain = "bytes as they will be, seconds as far as the machine stays as it is"
    return f"an encoding of {_steps(part, series)}, in {seconds:.1f} s; {uncertain}"


MARGIN = 1.15
"""Factor on predicted seconds that must fit: they are uncertain."""
MAX_EFFORT = 9
"""Highest effort."""
MAX_EPOCHS = 2000
"""Epochs from which on more hardly change a model."""
PROBED = 0.4
"""Share of the budget after which no further effort is probed."""


class Predicted(TypedDict):
    """A prediction of an encoding, as JSON values."""

    seconds: Annotated[float, "of the encoding, without the predictions"]
    bytes: Annotated[int | None, "of the file"]
    psnr: Annotated[float | None, "in dB over the coreset"]
    basis: Annotated[str, "what the prediction rests on, and how uncertain it is"]


class TimeBudget(TypedDict):
    """The choice of effort or epochs by a time budget, as JSON values."""

    seconds: Annotated[float, "the budget"]
    probing_seconds: Annotated[float, "of it, what the predictions took"]
    chosen: Annotated[str, "the option that was chosen, such as `--effort 3`"]
    why: Annotated[str, "why"]
    fits: Annotated[bool, "whether the encoding was predicted to fit"]
    predicted: Annotated[Predicted, "what was predicted"]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Settings that were chosen by a time budget.

    Attributes:
        config: the settings, with the effort or the epochs that were chosen.
        prediction: what they should take.
        seconds: the budget.
        probing: seconds that the predictions took.
        fits: whether the prediction keeps the budget.
        why: what was chosen and why, as one line of text.
    """

    config: EncodeConfig
    prediction: Prediction
    seconds: float
    probing: float
    fits: bool
    why: str

    @property
    def option(self) -> str:
        """The option that was chosen, as the command line takes it."""
        return _option(self.config)

    def to_dict(self) -> TimeBudget:
        """The choice as JSON values."""
        told = self.prediction
        return {
            "seconds": self.seconds,
            "probing_seconds": round(self.probing, 3),
            "chosen": self.option,
            "why": self.why,
            "fits": self.fits,
            "predicted": {
                "seconds": told.seconds,
                "bytes": told.bytes,
                "psnr": told.psnr,
                "basis": told.basis,
            },
        }


def choose(
    series: Series,
    config: EncodeConfig,
    seconds: float,
    *,
    capped: bool = False,
    progress: Progress = silent,
) -> Choice:
    """Choose the highest effort, or the most epochs, that a series should be encoded with in time.

    config: the settings; the preset says which of the two is chosen.
    seconds: the time that probing and encoding may take together.
    capped: whether the effort or epochs of the settings are the most that may be chosen.

    Where even the least does not fit, it is chosen all the same, and `Choice.fits` says so.
    """
    begun = time.perf_counter()

    def left() -> float:
        return seconds - (time.perf_counter() - begun)

    progress("predicting", 0, 1, "")
    search = _most_epochs if config.published else _highest_effort
    chosen, prediction, beyond = search(Predictor(series), config, seconds, capped, left)
    progress("predicting", 1, 1, "")
    remaining = left()
    fits = MARGIN * prediction.seconds <= remaining
    return Choice(
        config=chosen,
        prediction=prediction,
        seconds=seconds,
        probing=seconds - remaining,
        fits=fits,
        why=_why(seconds, seconds - remaining, chosen, prediction, beyond, fits=fits),
    )


def _highest_effort(
    one: Predictor, config: EncodeConfig, seconds: float, capped: bool, left: Callable[[], float]
) -> tuple[EncodeConfig, Prediction, str]:
    """Return the settings with the highest effort that fits, their prediction, and why no higher.

    left: returns the seconds that are left.
    """
    chosen = replace(config, effort=1)
    prediction = one.predict(chosen)
    for effort in range(2, (config.effort if capped else MAX_EFFORT) + 1):
        if left() < (1 - PROBED) * seconds:
            return chosen, prediction, "probing more would take too much of it"
        further = replace(config, effort=effort)
        predicted = one.predict(further)
        if predicted.seconds * MARGIN > left():
            return (
                chosen,
                prediction,
                f"{_option(further)} would take {seconds_text(predicted.seconds)}",
            )
        chosen, prediction = further, predicted
    return chosen, prediction, "the most that is allowed" if capped else "the highest"


def _most_epochs(
    one: Predictor, config: EncodeConfig, seconds: float, capped: bool, left: Callable[[], float]
) -> tuple[EncodeConfig, Prediction, str]:
    """Return the settings with the most epochs that fit; see `_highest_effort`."""

    def at(epochs: int) -> tuple[EncodeConfig, Prediction]:
        settings = replace(config, epochs=epochs)
        return settings, one.predict(settings)

    most = config.epochs if capped and config.epochs else MAX_EPOCHS
    chosen = at(1)
    low, high = 1, most
    # All epochs share one probe, so that each of these predictions takes no time.
    while low < high:
        middle = (low + high + 1) // 2
        candidate = at(middle)
        if MARGIN * candidate[1].seconds <= left():
            low, chosen = middle, candidate
        else:
            high = middle - 1
    return *chosen, "the most that is allowed" if low == most else "more would not fit"


def _option(config: EncodeConfig) -> str:
    """The option of a choice, as the command line takes it."""
    if config.published:
        return f"--epochs {config.epochs}"
    return f"--effort {config.effort}"


def _why(
    seconds: float,
    probing: float,
    chosen: EncodeConfig,
    prediction: Prediction,
    beyond: str,
    *,
    fits: bool,
) -> str:
    """One line that says what was chosen and why."""
    told = seconds_text(prediction.seconds)
    budget, probed = seconds_text(seconds), seconds_text(probing)
    if prediction.bytes is not None:
        told += f" and {prediction.bytes:,} bytes"
    if not fits:
        return (
            f"the time budget of {budget} may not be kept: even {_option(chosen)} is"
            f" predicted to take {told}, after {probed} of probing; it is done anyway"
        )
    return (
        f"time budget {budget}: {_option(chosen)}, predicted to take {told} after"
        f" {probed} of probing; {beyond}"
    )
