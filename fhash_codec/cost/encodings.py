"""Encodings of `fhash cost`, each made once."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.compact.goal import promise
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import QUICK, RUNS, Allowance, Facts, Wish, options_of
from fhash_codec.cost.probe import of_width
from fhash_codec.cost.results import BOUND, DEFAULT, TRAINING, Curve, Encoded
from fhash_codec.encoding import encode
from fhash_codec.progress import Progress
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import (
    FhashWarning,
    InterruptedEncodingError,
    QualityError,
)
from fhash_formats.series import Series

ONE_SHARE = 0.6
"""Share of the time left for encoding that one encoding may take, so that others follow."""


@dataclass(frozen=True, kw_only=True)
class KeptFile:
    """A container that was made."""

    name: str
    path: Path
    psnr: float | None


class OwnEncodings:
    """The encodings of one series by this package.

    Attributes:
        points: what was measured.
        curves: courses of trainings.
        files: the containers made, in the folder given.
    """

    def __init__(
        self,
        series: Series,
        facts: Facts,
        folder: Path,
        allowance: Allowance,
        progress: Progress,
    ) -> None:
        """Prepare; nothing is encoded yet.

        Args:
            series: what is encoded.
            facts: its figures; of a sample, PSNR and promises refer to the range of the whole.
            folder: place of the containers, which the caller removes.
            allowance: the time there is.
            progress: called with each step of the work.
        """
        self._series, self._facts, self._folder = series, facts, folder
        self._allowance, self._progress = allowance, progress
        self.points: list[Encoded] = []
        self.curves: list[Curve] = []
        self.files: list[KeptFile] = []
        self._usual: dict[int, float] = {}
        self._begun: set[str] = set()

    def measure(self, wish: Wish, *, share: float = ONE_SHARE) -> None:
        """Measure a wish, once, if there is time for it.

        share: share of the time left that it may take.
        """
        assert wish.config is not None
        if wish.name in self._begun:
            return
        if wish.group == TRAINING:
            why = ""
            if self._facts.sample:
                why = "the training of a sample says little of that of the whole"
            elif all(curve.name != DEFAULT for curve in self.curves):
                why = "the default settings expect no gain from an MLP"
            if why:
                self._allowance.leave_out(wish.name, why)
                return
        if wish.always or self._allowance.has(wish.name, self._expected(wish.config), share=share):
            self._begun.add(wish.name)
            with self._allowance.work(wish.name):
                self._encode(wish, share)

    def _expected(self, config: EncodeConfig) -> float:
        """Seconds that an encoding will take at least: those of the nearest effort measured."""
        if not self._usual:
            return 0.0
        above = [effort for effort in self._usual if effort >= config.effort]
        return self._usual[min(above, default=max(self._usual))] + (config.training_seconds or 0.0)

    def _encode(self, wish: Wish, share: float) -> None:
        """Encode, and keep the file and its figures.

        share: share of the time left after which the encoding is stopped, unless it is made always.
        """
        assert wish.config is not None
        path, config = self._folder / f"{len(self.files)}.fhz", self._of_sample(wish.config)
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
                seconds = report["seconds"]
                runs, most = 1, self._longest(wish)
                while runs < RUNS and (seconds < QUICK or seconds > most):
                    report = encode(self._series, path, timed, force=True, progress=guarded)
                    seconds, runs = min(seconds, report["seconds"]), runs + 1
                seconds = min(seconds, most)
        except QualityError as error:
            report, missed = error.figures, True
            seconds = report["seconds"]
        except InterruptedEncodingError:  # a training turns Ctrl-C into this
            raise KeyboardInterrupt from None
        finally:
            for leftover in self._folder.glob("*.checkpoint"):
                leftover.unlink()
        point = Encoded(
            name=wish.name, codec=wish.codec, group=wish.group, options=options_of(wish.config)
        )
        point = encoded_of({**report, "seconds": seconds}, point, missed=missed)
        if point.psnr is not None:
            point = replace(point, psnr=point.psnr + self._facts.decibels)
        self.points.append(point)
        kept = Path(report["path"])
        self.files.append(KeptFile(name=point.name, path=kept, psnr=point.psnr))
        if report["curve"]:
            self.curves.append(Curve(name=point.name, points=tuple(report["curve"])))
        if not wish.config.published and wish.group != TRAINING:
            self._usual[wish.config.effort] = seconds

    def _longest(self, wish: Wish) -> float:
        """Seconds beyond which a time is noise: those of a higher PSNR with the same effort."""
        asked = math.inf if wish.config is None or wish.config.psnr is None else wish.config.psnr
        higher = (
            point.seconds
            for point in self.points
            if point.group == wish.group and BOUND not in point.options
            if (point.psnr or 0.0) > asked + 1.0
        )
        return min(higher, default=math.inf)

    def _of_sample(self, config: EncodeConfig) -> EncodeConfig:
        """The settings with which a sample gets the errors that the whole series would have."""
        if not self._facts.sample:
            return config
        promised: dict[str, Any] = {**promise(config, self._facts.value_range, self._facts.bulk)}
        return of_width(replace(config, **promised), self._facts.decibels)


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
