"""Encodings of `fhash cost`, each made once."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import (
    Allowance,
    Wish,
    options_of,
)
from fhash_codec.cost.prediction import Prediction
from fhash_codec.cost.results import DEFAULT, TRAINING, Curve, Encoded
from fhash_codec.encoding import encode
from fhash_codec.progress import Progress
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InterruptedEncodingError,
    QualityError,
)
from fhash_formats.series import Series

ONE_SHARE = 0.6
"""Share of the time left for encoding that one encoding may take, so that others follow."""
PREDICT_SHARE = 0.05
"""Share of the budget that predicting may take; without a prediction USUAL_SECONDS serve."""
USUAL_RATE = 2e6
"""Vertices a second of the fastest encoding, before one was measured."""
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
        self._usual: dict[int, float] = {}
        self._predicting = 0.0

    def measure(self, wish: Wish, *, share: float = ONE_SHARE) -> None:
        """Measure a wish, or keep its prediction where there is no time for it.

        A wish that was measured before is not measured again.

        share: share of the time left that it may take.
        """
        assert wish.config is not None
        before = next((point for point in self.points if point.name == wish.name), None)
        if before is not None and before.measured:
            return
        if wish.group == TRAINING and all(curve.name != DEFAULT for curve in self.curves):
            self._allowance.leave_out(wish.name, "the default settings expect no gain from an MLP")
            return
        with self._allowance.work(f"prediction of {wish.name}"):
            self._predict(wish.config)
        point = _predicted(wish, self._predictions.get(wish.config))
        expected = self._expected(wish.config)
        if wish.always or self._allowance.has(wish.name, expected, share=share):
            with self._allowance.work(wish.name):
                point = self._encode(wish, point, share)
        if before is not None:
            self.points.remove(before)
        if point.measured or point.predicted_seconds is not None:
            self.points.append(point)

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
        prediction = self._predictions.get(config)
        if config.effort in self._usual:
            return self._usual[config.effort] + (config.training_seconds or 0.0)
        if prediction is not None:
            # This machine, under its present load, differs from the predictions by a factor.
            return prediction.seconds * median(self._ratios or [1.0])
        fastest = self._usual.get(1, prod(self._series.shape) / USUAL_RATE)
        return fastest * USUAL_SECONDS[config.effort]

    def _encode(self, wish: Wish, point: Encoded, share: float) -> Encoded:
        """Encode, and keep the file; the point as predicted where that failed.

        share: share of the time left after which the encoding is stopped, unless it is made always.
        """
        assert wish.config is not None
        path, config = self._folder / f"{len(self.files)}.fhz", wish.config
        if config.published:  # it trains until it keeps its promise
            config = replace(config, train_on_seconds=int(share * self._allowance.left))
        guarded = self._progress
        if not wish.always:
            guarded = self._allowance.guard(self._progress, share=share)
        missed = False
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FhashWarning)
                timed = replace(config, timings=True)  # for the course of the training
                report = encode(self._series, path, timed, force=True, progress=guarded)
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
        kept = Path(report["path"])
        self.files.append(KeptFile(name=measured.name, path=kept, psnr=measured.psnr))
        if report["curve"]:
            self.curves.append(Curve(name=measured.name, points=tuple(report["curve"])))
        if not wish.config.published and wish.group != TRAINING:
            self._usual[wish.config.effort] = report["seconds"]
            if point.predicted_seconds:
                self._ratios.append(report["seconds"] / point.predicted_seconds)
        return measured


def _predicted(wish: Wish, prediction: Prediction | None) -> Encoded:
    """The point of a wish before it is measured."""
    assert wish.config is not None
    point = Encoded(
        name=wish.name, codec=wish.codec, group=wish.group, options=options_of(wish.config)
    )
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
        region_ms=_region_ms(report["path"], report["shape"]),
    )


REGION = 16
"""Vertices along each axis of the region."""
PLACES = 5
"""Random places of which the median is taken; `uses` reads at one more as a warm-up."""
REGION_SECONDS = 1.0
"""Seconds after which no further place is read for a median."""


def _region_ms(path: str, shape: Sequence[int]) -> float:
    """Median milliseconds of regions at random places, each of a file that is opened for it."""
    random = np.random.default_rng(0)
    taken: list[float] = []
    while len(taken) < PLACES and sum(taken) < REGION_SECONDS:
        low = [int(random.integers(0, max(n - REGION, 0) + 1)) for n in shape[1:]]
        region = Box.of((a, min(a + REGION, n)) for a, n in zip(low, shape[1:], strict=True))
        step, begun = int(random.integers(0, shape[0])), time.perf_counter()
        with open_volume(path) as volume:
            volume.read(step, region)
        taken.append(time.perf_counter() - begun)
    return 1000 * median(taken)
