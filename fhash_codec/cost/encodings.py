"""Encodings of this package in `fhash cost`: each one is made once, and its file is kept."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from statistics import median
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import EPOCHS, Allowance, Wish, paper_config
from fhash_codec.cost.prediction import Prediction
from fhash_codec.cost.results import Curve, Encoded
from fhash_codec.encoding import encode
from fhash_codec.progress import Progress
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InterruptedEncodingError,
    QualityError,
)
from fhash_formats.series import Series

ONE_SHARE = 0.6
"""Share of the time left for encoding that one encoding may take, so that others follow."""
MAX_SCALE = 4.0
"""Largest factor between measured and predicted seconds that later predictions are scaled by."""
DEFAULT_SHARE = 0.85
"""Share that the default settings may take: most people will use them."""
PREDICT_SHARE = 0.12
"""Share of the budget that predicting may take; without a prediction USUAL_SECONDS serve."""
USUAL_RATE = 2e6
"""Vertices a second of the fastest encoding, before one was measured."""
USUAL_TRAINING = 3e5
"""Samples a second of a training, before one was measured."""
USUAL_SECONDS = {1: 1.0, 2: 3.0, 3: 5.0, 5: 15.0, 7: 40.0, 9: 80.0}
"""Rough seconds of each effort over those of effort 1."""


@dataclass(frozen=True, kw_only=True)
class KeptFile:
    """A container that was made."""

    name: str
    path: Path
    psnr: float | None


class OwnEncodings:
    """The encodings of one series by this package.

    Attributes:
        points: what was measured, or predicted only.
        curves: courses of trainings.
        files: the containers made, in the folder given.
    """

    def __init__(
        self,
        series: Series,
        folder: Path,
        allowance: Allowance,
        predict: Callable[[EncodeConfig], Prediction],
        progress: Progress,
    ) -> None:
        """Prepare; nothing is encoded yet.

        Args:
            series: what is encoded.
            folder: place of the containers, which the caller removes.
            allowance: the time there is.
            predict: predicts an encoding of the series.
            progress: called with each step of the work.
        """
        self._predict_one = predict
        self._series, self._folder = series, folder
        self._allowance, self._progress = allowance, progress
        self.points: list[Encoded] = []
        self.curves: list[Curve] = []
        self.files: list[KeptFile] = []
        self._ratios: list[float] = []
        self._predictions: dict[EncodeConfig, Prediction] = {}
        self._fastest = prod(series.shape) / USUAL_RATE
        self._usual: dict[str, float] = {}
        self._predicting = 0.0
        self._share = ONE_SHARE

    def measure(self, wish: Wish, *, share: float = ONE_SHARE) -> None:
        """Measure a wish, or keep its prediction where there is no time for it.

        A wish that was measured before is not measured again.

        share: share of the time left that it may take.
        """
        self._share = share
        if wish.codec == "paper":
            self._measure_paper(wish)
        else:
            self._measure(wish)

    def _measure(self, wish: Wish) -> Encoded:
        assert wish.config is not None
        before = next((point for point in self.points if point.name == wish.name), None)
        if before is not None and before.measured:
            return before
        with self._allowance.work(f"prediction of {wish.name}"):
            self._predict(wish.config)
        point = _predicted(wish, self._predictions.get(wish.config))
        share = self._share
        if wish.config == EncodeConfig():
            share = max(share, DEFAULT_SHARE)
        if self._allowance.has(wish.name, self._expected(wish.config), share=share):
            with self._allowance.work(wish.name):
                point = self._encode(wish, point, share)
        if before is not None:
            self.points.remove(before)
        if point.measured or point.predicted_seconds is not None:
            self.points.append(point)
        return point

    def _measure_paper(self, wish: Wish) -> None:
        """Train one epoch, then as many as fit; the course of the longer training is a curve."""
        if any(point.codec == "paper" and point.measured for point in self.points):
            return
        first = self._measure(replace(wish, config=paper_config(1)))
        if not first.seconds or self._allowance.interrupted:
            return
        epoch = self.curves[-1].points[-1]["seconds"] or first.seconds
        rest = max(first.seconds - epoch, 0.0)
        # A training that is stopped leaves nothing: half of its share is for what goes wrong.
        limit = 0.5 * self._share * self._allowance.left
        fitting = [epochs for epochs in EPOCHS if rest + epochs * epoch <= limit]
        if fitting:
            config = paper_config(fitting[-1])
            self._usual[_kind(config)] = rest + fitting[-1] * epoch
            self._measure(replace(wish, config=config))
        else:
            self._allowance.has("paper, more epochs", max(rest + EPOCHS[0] * epoch, limit))

    def _predict(self, config: EncodeConfig) -> None:
        """Predict an encoding, unless predictions have taken their share of the time."""
        spent = self._allowance.spent
        limit = PREDICT_SHARE * self._allowance.seconds
        if config in self._predictions or self._predicting > limit:
            return
        self._progress("predicting", 0, 1, "")
        self._predictions[config] = self._predict_one(config)
        self._progress("predicting", 1, 1, "")
        self._predicting += self._allowance.spent - spent

    def _expected(self, config: EncodeConfig) -> float:
        """Seconds that an encoding will take: as one of its kind did, or by its prediction."""
        kind, prediction = _kind(config), self._predictions.get(config)
        if kind in self._usual:
            return self._usual[kind]
        if prediction is not None:
            return prediction.seconds * self._scale
        if config.profile == "paper":
            return prod(self._series.shape) * config.epochs / USUAL_TRAINING
        return self._usual.get("effort 1", self._fastest) * USUAL_SECONDS[config.effort]

    @property
    def _scale(self) -> float:
        """Factor by which this machine, under its present load, differs from the predictions."""
        if not self._ratios:
            return 1.0
        return min(max(median(self._ratios), 1 / MAX_SCALE), MAX_SCALE)

    def _encode(self, wish: Wish, point: Encoded, share: float) -> Encoded:
        """Encode, and keep the file; the point as predicted where that failed.

        share: share of the time left after which the encoding is stopped.
        """
        assert wish.config is not None
        path = self._folder / f"{len(self.files)}.fhz"
        guarded = self._allowance.guard(self._progress, share=share)
        missed = False
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FhashWarning)
                report = encode(self._series, path, wish.config, force=True, progress=guarded)
        except QualityError as error:
            report, missed = error.figures, True
        except InterruptedEncodingError:  # a training turns Ctrl-C into this
            raise KeyboardInterrupt from None
        except FhashError as error:
            self._allowance.leave_out(wish.name, str(error))
            return point
        finally:
            for leftover in self._folder.glob("*.checkpoint"):
                leftover.unlink()
        measured = encoded_of(report, point, missed=missed)
        self.files.append(KeptFile(name=measured.name, path=path, psnr=measured.psnr))
        if report["curve"]:
            self.curves.append(Curve(name=measured.name, points=tuple(report["curve"])))
        self._usual[_kind(wish.config)] = report["seconds"]
        if point.predicted_seconds and wish.codec == "compact":
            self._ratios.append(report["seconds"] / point.predicted_seconds)
        return measured


def _kind(config: EncodeConfig) -> str:
    """Name of the encodings that take about as long as one with these settings."""
    if config.profile == "paper":
        return f"paper, {config.epochs}"
    return f"effort {config.effort}"


def _predicted(wish: Wish, prediction: Prediction | None) -> Encoded:
    """The point of a wish before it is measured."""
    point = Encoded(name=wish.name, codec=wish.codec, group=wish.group, options=wish.options)
    if prediction is None:
        return point
    return replace(
        point,
        predicted_seconds=prediction.seconds,
        predicted_bytes=prediction.bytes,
        predicted_psnr=prediction.psnr,
        basis=prediction.basis,
    )


def encoded_of(report: Mapping[str, Any], point: Encoded, *, missed: bool) -> Encoded:
    """A point with the figures of an encoding's report (`fhash_codec.comparison`)."""
    return replace(
        point,
        seconds=report["seconds"],
        bytes=report["bytes"],
        ratio=report["ratio"],
        psnr=report["psnr"],
        psnr_bulk=report["psnr_bulk"],
        max_abs_error=report["max_abs_error"],
        exact=report["rmse"] == 0,
        missed=missed,
    )
