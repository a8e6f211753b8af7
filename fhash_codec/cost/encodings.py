"""Encodings of `fhash cost`, each made once, and fits of both models to choose between them."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any, TypedDict

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.config import MODELS, EncodeConfig
from fhash_codec.cost.plan import (
    MIN_STEPS,
    Allowance,
    Facts,
    Wish,
    cropped,
    described,
    facts_of,
    options_of,
)
from fhash_codec.cost.prediction import Prediction, Predictor
from fhash_codec.cost.probe import reported
from fhash_codec.cost.results import Curve, Encoded, seconds_text
from fhash_codec.encoding import encode
from fhash_codec.features.key_frames import KeyTimes, time_axis
from fhash_codec.features.selection import select_features
from fhash_codec.measure.errors import Errors
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import Scene
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InputError,
    InterruptedEncodingError,
    QualityError,
)
from fhash_formats.series import Series, StepsSeries

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
            return self._usual[config.effort]
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
        if wish.codec == "paper":  # it trains until it keeps its promise
            config = replace(config, train_on_seconds=int(share * self._allowance.left))
        guarded = self._progress
        if not wish.always:
            guarded = self._allowance.guard(self._progress, share=share)
        missed = False
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FhashWarning)
                report = encode(self._series, path, config, force=True, progress=guarded)
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
        if wish.codec == "compact":
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


CROP_VERTICES = 1 << 19
"""Vertices of the crop to which both models are fitted."""
SCALED = ("tables", "occupancy")
"""Groups of arrays that grow with a series; what else a file has does not."""
DEARER = {"small": 1.0, "balanced": 1.1, "fast": 1.5}
"""Bytes that a model may take for faster regions, as a multiple of the fewest, by the access."""
SIDE = 256
"""Pixels along both sides of the picture."""
REGION = 16
"""Vertices along each axis of the region."""
PLACES = 5
"""Random places of which the median is taken; `uses` reads at one more as a warm-up."""
REGION_SECONDS = 1.0
"""Seconds after which no further place is read for a median."""


@dataclass(frozen=True, kw_only=True)
class ModelPrice:
    """Price of one model, from a crop; bytes and seconds are foretold for the whole series."""

    profile: Annotated[str, "of the model"]
    bytes: Annotated[int, "of the file, foretold"]
    seconds: Annotated[float, "of the encoding, foretold"]
    region_ms: Annotated[float, "milliseconds of a region of 16^3 of a file that is just opened"]
    picture_ms: Annotated[float, "milliseconds of a first picture of 256 x 256 of the crop"]
    psnr: Annotated[float | None, "in dB over the crop"]
    between: Annotated[float | None, "dB at every other step, of a file without them"]
    kept: Annotated[bool, "whether the promise is kept"]


class ModelsCompared(TypedDict):
    """The choice between both models, as JSON values."""

    chosen: Annotated[str, "`compact` or `paper`"]
    why: Annotated[str, "why"]
    crop: Annotated[str, "the part of the series that both were fitted to; empty without a choice"]
    prices: Annotated[list[dict[str, Any]], list[ModelPrice], "what each costs"]


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """The model that was chosen.

    Attributes:
        config: the settings with the profile that was chosen.
        prices: of both models; none where the settings leave no choice.
        crop: the part of the series that was fitted.
        why: the reason, as one line of text.
    """

    config: EncodeConfig
    prices: tuple[ModelPrice, ...]
    crop: str
    why: str

    def to_dict(self) -> ModelsCompared:
        """The choice as JSON values."""
        return {
            "chosen": self.config.profile,
            "why": self.why,
            "crop": self.crop,
            "prices": [vars(price) for price in self.prices],
        }


def choose_model(
    series: Series,
    config: EncodeConfig,
    *,
    budget: float = math.inf,
    progress: Progress = silent,
) -> ModelChoice:
    """Fit both models to a crop of a series, and choose one for the whole.

    The cheaper is the one of the fewest bytes or, by `config.access`, the one of faster regions
    where it takes at most DEARER times as many.

    Args:
        series: the series.
        config: settings; those of one profile alone count for that one.
        budget: seconds that the encoding may take.
        progress: is told about each fit.

    Raises InputError for settings that do not fit the series.
    """
    if config.ratio is not None or config.bounded:
        option = "--ratio" if config.ratio is not None else "a bound"
        chosen = config.of_profile("compact")
        return ModelChoice(
            config=chosen, prices=(), crop="", why=f"only the lattice takes {option}"
        )
    try:
        part, prices = _prices(series, config, progress)
    except InputError as error:
        # Where the settings themselves are wrong, the encoding says so.
        chosen = config.of_profile("compact")
        why = f"no crop of the middle steps can be fitted: {error}"
        return ModelChoice(config=chosen, prices=(), crop="", why=why)
    best, why = _cheapest(prices, config.access, budget)
    return ModelChoice(
        config=config.of_profile(best.profile),
        prices=tuple(prices),
        crop=described(part),
        why=why,
    )


def _prices(
    series: Series, config: EncodeConfig, progress: Progress
) -> tuple[Series, list[ModelPrice]]:
    """The part of a series that both models were fitted to, and their prices for the whole."""
    part, asked, counted = series, config, None
    if prod(series.shape) > CROP_VERTICES:
        steps = series.shape[0]
        first = max(0, (steps - MIN_STEPS) // 2)
        middle = StepsSeries(series, range(first, min(steps, first + MIN_STEPS)))
        extent = select_features(middle, config.of_profile("compact"), silent).extent
        counted = extent.fraction * prod(series.shape)
        part = cropped(series, CROP_VERTICES, extent.box)
        asked = _for_part(config, facts_of(series, progress), facts_of(part, silent))
    prices = []
    for number, profile in enumerate(MODELS):
        progress("fitting", number, len(MODELS), f"{MODELS[profile]} on {described(part)}")
        prices.append(_price(part, asked.of_profile(profile), counted))
    progress("fitting", len(MODELS), len(MODELS), "")
    return part, prices if part is series else _foretold(prices, series, config)


def _for_part(config: EncodeConfig, whole: Facts, part: Facts) -> EncodeConfig:
    """The settings for a part, whose errors may be those that are promised for the whole."""

    def moved(promised: float | None, width: float, own: float) -> float | None:
        if promised is None or not (width > 0 and own > 0):
            return promised
        return min(max(promised - 20 * math.log10(width / own), 0.0), 400.0)

    widths = [
        0.0 if facts.bulk is None else facts.bulk.high - facts.bulk.low for facts in (whole, part)
    ]
    return replace(
        config,
        psnr=moved(config.psnr, whole.width, part.width),
        psnr_bulk=moved(config.psnr_bulk, *widths),
    )


def _foretold(
    prices: Sequence[ModelPrice], series: Series, config: EncodeConfig
) -> list[ModelPrice]:
    """Prices of a crop with the lattice's bytes by its prediction, and the network's likewise."""
    told = Predictor(series).predict(config.of_profile("compact"))
    lattice = prices[0]
    if told.bytes is None:
        return list(prices)
    share = told.bytes / lattice.bytes
    scaled = [replace(price, bytes=round(price.bytes * share)) for price in prices]
    return [replace(scaled[0], seconds=told.seconds), *scaled[1:]]


def _price(part: Series, config: EncodeConfig, counted: float | None) -> ModelPrice:
    """The price of a model. counted: vertices of the coreset of the whole; None for those here."""
    with TemporaryDirectory() as folder:
        report, kept = reported(part, Path(folder) / "part.fhz", config)
        with open_volume(report["path"]) as volume:
            sizes = {name: each.nbytes_stored for name, each in volume.container.arrays.items()}
            growing = sum(n for name, n in sizes.items() if name.split("/")[0] in SCALED)
            picture = Renderer(volume).render(Scene(size=(SIDE, SIDE)))
        here = report["coreset_fraction"] * prod(part.shape)
        share = 1.0 if counted is None else min(here / counted, 1.0)
        return ModelPrice(
            profile=config.profile,
            bytes=round(report["bytes"] + growing * (1 / share - 1)),
            seconds=report["seconds"] / share,
            region_ms=_region_ms(report["path"], part.shape),
            picture_ms=1000 * picture.seconds,
            psnr=report["psnr"],
            between=_between(part, config, Path(folder) / "half.fhz"),
            kept=kept,
        )


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


def _between(part: Series, config: EncodeConfig, path: Path) -> float | None:
    """PSNR in dB at every other step, of a file of the others."""
    steps = part.shape[0]
    if steps < 3:
        return None
    kept = range(0, steps, 2)
    half = replace(config, key_frames="all")
    report, _ = reported(StepsSeries(part, kept), path, half)
    times = KeyTimes(times=time_axis(part.coords["t"].values), key_frames=tuple(kept))
    with open_volume(report["path"]) as volume:
        errors = Errors(volume.value_range.high - volume.value_range.low)
        for step in range(1, kept[-1], 2):
            decoded = volume.read(times.key_index(step))
            original = part.read(step)
            errors.add(step, original, decoded, np.isfinite(decoded) & np.isfinite(original))
        return errors.psnr


def _cheapest(prices: Sequence[ModelPrice], access: str, budget: float) -> tuple[ModelPrice, str]:
    """The price to take, and why."""
    keeping = [price for price in prices if price.kept] or prices
    fitting = [price for price in keeping if price.seconds <= budget]
    if not fitting:
        fastest = min(keeping, key=lambda price: price.seconds)
        return fastest, f"the sooner one; {seconds_text(budget)} are too few for either"
    fewest = min(fitting, key=lambda price: price.bytes)
    affordable = [price for price in fitting if price.bytes <= DEARER[access] * fewest.bytes]
    best = min(affordable, key=lambda price: price.region_ms)
    if len(keeping) == 1:
        return best, "the other does not keep the promise"
    if len(fitting) == 1:
        return best, f"the other takes longer than {seconds_text(budget)}"
    if best is fewest:
        return best, f"the fewest bytes, --access {access}"
    times = best.bytes / fewest.bytes
    return best, f"faster regions for {times:.2f} times the bytes, --access {access}"
