"""Choice of effort or epochs by the time that an encoding may take.

The choice is made before the encoding, which then does not look at the clock: the same effort or
epochs give the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.prediction import Prediction, Predictor, predictor
from fhash_codec.progress import Progress, silent
from fhash_formats.series import Series

__all__ = ["Choice", "choose"]

MARGIN = 1.15
"""Factor on predicted seconds that must fit: they are uncertain."""
MAX_EFFORT = 9
"""Highest effort."""
MAX_EPOCHS = 2000
"""Epochs from which on more hardly change a model."""
PROBED = 0.4
"""Share of the budget after which no further effort is probed."""


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

    def to_dict(self) -> dict[str, Any]:
        """The choice as JSON values; see docs/json.md."""
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

    config: the settings; the profile says which of the two is chosen.
    seconds: the time that probing and encoding may take together.
    capped: whether the effort or epochs of the settings are the most that may be chosen.

    Where even the least does not fit, it is chosen all the same, and `Choice.fits` says so.
    """
    begun = time.perf_counter()

    def left() -> float:
        return seconds - (time.perf_counter() - begun)

    with predictor(series) as one:
        progress("predicting", 0, 1, "")
        search = _most_epochs if config.profile == "paper" else _highest_effort
        chosen, prediction, beyond = search(one, config, seconds, capped, left)
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
            return chosen, prediction, f"{_option(further)} would take {_brief(predicted.seconds)}"
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
    if config.profile == "paper":
        return f"--epochs {config.epochs}"
    return f"--effort {config.effort}"


def _brief(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


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
    told = _brief(prediction.seconds)
    if prediction.bytes is not None:
        told += f" and {prediction.bytes:,} bytes"
    if not fits:
        return (
            f"the time budget of {_brief(seconds)} may not be kept: even {_option(chosen)} is"
            f" predicted to take {told}, after {_brief(probing)} of probing; it is done anyway"
        )
    return (
        f"time budget {_brief(seconds)}: {_option(chosen)}, predicted to take {told} after"
        f" {_brief(probing)} of probing; {beyond}"
    )
