"""Rates of both profiles on this machine and this series, probed on a few tiles and epochs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fhash_codec.compact.attempt import (
    Attempt,
    GainLog,
    PlanTask,
    cheap_tiling,
    even_tile,
    first_tile,
    parse_tile,
)
from fhash_codec.compact.goal import find_step, goal_of
from fhash_codec.compact.head import PERCEPTRON, training_pairs
from fhash_codec.compact.head_training import (
    BATCH_VOXELS,
    CHOSEN_AT,
    MEASUREMENTS,
    STARTS,
    Budget,
    foretold_gain,
    train_head,
)
from fhash_codec.compact.plan import LabelTrial, has_labels, look_at_labels
from fhash_codec.compact.predictor import TRIAL_ROWS, IntegerTile, fit_weights
from fhash_codec.compact.sample import Sample, priced
from fhash_codec.compact.stages import first_guess, first_settings
from fhash_codec.compact.tiles import Blocks, Coding, Outcome, Tile, code, total
from fhash_codec.compact.transform import likely_transform, tile_costs, usual_transform
from fhash_codec.comparison import EncodeReport
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.features.bricks import BRICK_BITS
from fhash_codec.features.selection import select_features
from fhash_codec.measure.errors import find_bulk
from fhash_codec.measure.metrics import BUDGET, Comparer, measure_quality, ssim_steps
from fhash_codec.paper.train import HISTORY_POINTS, usual_batches, usual_epochs
from fhash_codec.progress import recording, silent
from fhash_formats.errors import FhashWarning, QualityError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.support.threads import usable_threads
from fhash_formats.transform.tile import decode_tile
from fhash_formats.transform.tile_format import Shape, TileSettings

OVERHEAD_BYTES = 2000
"""Approximate bytes of a container without its tiles."""
PROBE_VERTICES = 1 << 17
"""Vertices of a probed tile; larger ones are cut to about this size."""
PROBE_VERTICES_OF_FEW_BYTES = 1 << 19
"""The same where a vertex takes less than FEW_BYTES: there borders count, and coding is fast."""
FEW_BYTES = 0.02
"""Bytes for each vertex below which a series takes few bytes."""
MAX_STEPS = 32
"""Steps of a probed tile at most."""
MIN_TILES = 4
"""Tiles that are probed at least, where a series has so many."""
COMPARED_VERTICES = 1 << 20
"""Vertices of the frames that are compared for the rate of measuring, at least one frame."""

FITTED_TILES = 32
"""Tiles from which the weights of a predictor are fitted at most; more cost in proportion."""
FAR = 1.0
"""Distance in dB from the promised PSNR from which on a better step is looked for."""

now: Callable[[], float] = time.perf_counter
"""Clock of all probes, in seconds."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """First look at a series under a promise, as the encoder takes it.

    Attributes:
        task: the series, or a part of it, and the promise.
        attempt: outcome of the first guess.
        labels: outcome of coding as labels; None where the values are none.
        tile: tile of the whole series, by the size of the first guess.
        shape: box of the whole series over all its steps.
        share: share of the series that was looked at.
        selecting: seconds of scan, features and bulk, of the whole series.
        guessing: seconds of the first guess, of the whole series.
        labelling: seconds of the trial of labels; 0 without one.
        costing: seconds in which all tiles are transformed once, of the whole series.
    """

    task: PlanTask
    attempt: Attempt
    labels: LabelTrial | None
    tile: Shape
    shape: Shape
    share: float
    selecting: float
    guessing: float
    labelling: float
    costing: float


def look_at(part: Series, steps: int, config: EncodeConfig, workers: ThreadPoolExecutor) -> Look:
    """Look at a series.

    part: the series, or some of its steps.
    steps: number of steps of the whole series.
    config: settings with the promise and the features.
    """
    share = part.shape[0] / steps
    begun = now()
    selection = select_features(part, config, silent)
    origin = selection.scanned.value_range.origin(part.source_dtype or part.dtype)
    value_range = selection.scanned.value_range.moved(-origin)
    blocks = Blocks(part, selection.extent, part.shape, origin)
    integers = blocks.dtype.kind in "iu"
    bulk = find_bulk(blocks.counted_values, value_range, whole=integers)
    selecting = (now() - begun) / share
    raw = prod(part.shape) * (part.source_dtype or part.dtype).itemsize
    goal = goal_of(config, value_range, raw, OVERHEAD_BYTES, bulk, integers=integers)
    shape: Shape = (steps, *blocks.shape[1:])
    fixed = parse_tile(config.tile, shape)
    task = PlanTask(
        blocks=blocks,
        value_range=value_range,
        features=selection.features,
        config=config,
        goal=goal,
        fixed_tile=fixed,
        workers=workers,
        gains=GainLog(OVERHEAD_BYTES),
    )
    begun = now()
    tiled = blocks.retile(fixed or first_tile(blocks.shape))
    settings = first_settings(task, tiled)
    labels, labels_begun = None, now()
    if goal.size is None and has_labels(task, tiled):
        labels = look_at_labels(task, tiled, settings)
    costs_begun = now()
    labelling = costs_begun - labels_begun
    tile_costs(tiled, settings, workers)
    costing = now() - costs_begun
    attempt = first_guess(task, tiled, settings)
    guessing = now() - begun - costing - labelling
    size, time = attempt.outcome.size / share, attempt.settings.transform.axes[0]
    return Look(
        task=task,
        attempt=attempt,
        labels=labels,
        tile=fixed or cheap_tiling(shape, size, config.access, time).tile,
        shape=shape,
        share=share,
        selecting=selecting,
        guessing=max(guessing - costing, 0.0) + costing / share,
        labelling=labelling,
        costing=costing / share,
    )


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Rates of coding and measuring, and the outcome of the probed tiles.

    Attributes:
        trial: coding as for a trial of a transform.
        price: pricing as for one; None where the encoder codes all trials.
        search: coding as for the search of a step.
        final: coding of all tiles for the file, filling included.
        fill: filling of the vertices that do not count, at density 2; 0 where all count.
        basis: fitting a basis of the data's own along one axis, of all threads together.
        has_bases: whether the quick choice of a transform took such bases.
        decode: decoding.
        compare: comparing a decoded value with its original, of all threads together.
        ssim: the SSIM, likewise.
        predict: coding by a predictor; 0 without a bound.
        fit: seconds in which the weights of a predictor are fitted for a trial.
        settings: settings that the tiles were coded with last.
        sample: the probed tiles.
        outcome: what the part would take that was looked at.
    """

    trial: float
    price: float | None
    search: float
    final: float
    fill: float
    basis: float
    has_bases: bool
    decode: float
    compare: float
    ssim: float
    predict: float
    fit: float
    settings: TileSettings
    sample: Sample
    outcome: Outcome


def search_coding(look: Look, effort: int) -> Coding:
    """The options of the encoder in the search of a step, as `stages.fill_tiles` sets them."""
    rounds = 0 if effort == 1 else 2 if effort < 7 else 4
    coding = replace(look.attempt.coding, passes=2 if effort > 2 else 1, rounds=rounds)
    if not look.task.blocks.complete:
        coding = replace(coding, rounds=2, filled=True)
    return look.task.goal.bounded(coding)


def probe_rates(look: Look, config: EncodeConfig) -> Rates:
    """Code some tiles as the encoder would with these settings, and measure the time."""
    task, effort = look.task, config.effort
    sample, settings = _probed_sample(look)
    trial_coding = task.goal.bounded(look.attempt.coding)
    trial, outcome, coded = coded_tiles(sample, settings, trial_coding)
    if _is_far(look, outcome):
        settings, _ = find_step(sample, settings, look.attempt.coding, task.goal, tries=4)
        trial, outcome, coded = coded_tiles(sample, settings, trial_coding)
    trials, price = priced(sample, settings, effort), None
    if trials is not sample:
        begun = now()
        trials.run_all([(settings, trial_coding)])
        price = (now() - begun) * usable_threads() / _vertices(sample)
    bases = 0.0
    if effort > 1 and "transform" not in config.without:
        with recording() as clock:
            settings = likely_transform(sample, settings, trial_coding)
        fitted = [entry for entry in clock.stages() if entry.stage == "bases"]
        bases = sum(entry.seconds / entry.times for entry in fitted)
    search, fill, coding = trial, 0.0, search_coding(look, effort)
    if effort > 1 or not task.blocks.complete:
        search, outcome, coded = coded_tiles(sample, settings, coding)
    final = search
    if not task.blocks.complete:
        begun = now()
        sample.filled(settings, 2)
        fill = (now() - begun) * usable_threads() / _vertices(sample)
        final += fill * max(task.density, 1) / 2
    compare, ssim = _measuring(task.blocks, look)
    predict = fit = 0.0
    if task.goal.error:
        count = prod(-(-n // m) for n, m in zip(look.shape, look.tile, strict=True))
        predict, fit = _predicting(sample, settings, count)
    vertices = prod(task.blocks.shape)
    return Rates(
        trial=trial,
        price=price,
        search=search,
        final=final,
        fill=fill,
        basis=bases / vertices,
        has_bases=any(axis.basis is not None for axis in settings.transform.axes),
        decode=_decoding(sample, settings, coded),
        compare=compare,
        ssim=ssim,
        predict=predict,
        fit=fit,
        settings=settings,
        sample=sample,
        outcome=outcome,
    )


def _is_far(look: Look, outcome: Outcome) -> bool:
    """Whether the first guess of a step misses the promised PSNR by much on these tiles."""
    goal = look.task.goal
    if goal.psnr is None or goal.data_range == 0:
        return False
    return abs(outcome.psnr(goal.data_range) - goal.psnr) > FAR


def _probed_sample(look: Look) -> tuple[Sample, TileSettings]:
    """Return some tiles of the part, cut to a small size, with settings of the first guess."""
    blocks = look.task.blocks
    t, z, y, x = look.tile
    tile: Shape = (min(t, blocks.shape[0]), z, y, x)
    few = look.attempt.outcome.size < FEW_BYTES * prod(blocks.shape)
    limit = PROBE_VERTICES_OF_FEW_BYTES if few else PROBE_VERTICES
    if prod(tile) > limit:
        tile = even_tile(tile, prod(tile) // limit + 1, min(tile[0], MAX_STEPS))
    tiled = blocks.retile(tile)
    settings = replace(look.attempt.settings, transform=usual_transform(tiled.tile))
    count = max(MIN_TILES, usable_threads())
    costs = tile_costs(tiled, settings, look.task.workers)
    sample = Sample(tiled, count * prod(tiled.tile), look.task.workers, costs)
    return sample.filled(settings, 1), settings


def coded_tiles(
    sample: Sample, settings: TileSettings, coding: Coding
) -> tuple[float, Outcome, list[bytes]]:
    """Code tiles: the rate, what the part would take, and the streams."""

    def work(tile: Tile) -> tuple[float, bytes, Outcome]:
        begun = now()
        coded, outcome = code(tile, settings, coding)
        return now() - begun, coded.data, outcome

    results = sample.map(work)
    pairs = list(zip(results, sample.weights, strict=True))
    seconds = sum(result[0] * weight for result, weight in pairs)
    vertices = sample.tiles[0].values.size * sum(sample.weights)
    outcome = total([result[2] for result in results], sample.weights)
    return seconds / vertices, outcome, [result[1] for result in results]


def _vertices(sample: Sample) -> int:
    return sum(tile.values.size for tile in sample.tiles)


def _decoding(sample: Sample, settings: TileSettings, streams: list[bytes]) -> float:
    """The rate of decoding the streams of the tiles of a sample."""
    shape, dtype = sample.blocks.tile, sample.blocks.dtype

    def work(data: bytes) -> float:
        begun = now()
        decode_tile(data, shape, dtype, settings)
        return now() - begun

    seconds = sum(map(work, streams))
    return seconds / (len(streams) * prod(shape))


def _measuring(blocks: Blocks, look: Look) -> tuple[float, float]:
    """The rates of comparing frames and of their SSIM, of all threads together."""
    plane = prod(blocks.shape[1:])
    steps = max(1, min(blocks.shape[0], COMPARED_VERTICES // plane))
    values = blocks.retile((steps, *blocks.shape[1:])).read((0, 0, 0, 0)).values
    values = np.nan_to_num(values.astype(np.float32))
    changed = values + np.float32(look.task.goal.expected_error)
    rates = []
    for measured in ([], ssim_steps(steps, plane, BUDGET)):
        begun = now()
        comparer = Comparer(look.task.goal.data_range, 0.0)
        original, decoded = (ArraySeries(frames).read_steps for frames in (values, changed))
        measure_quality(comparer, original, decoded, values.shape, measured)
        rates.append((now() - begun) / (steps * plane))
    return rates[0], max(rates[1] - rates[0], 0.0)


def _predicting(sample: Sample, settings: TileSettings, count: int) -> tuple[float, float]:
    """The rate of coding by a predictor, and the seconds of fitting its weights.

    count: tiles of the series, from each of which the fit takes some values.
    """
    from fhash_formats.transform.predict import Predictor
    from fhash_formats.transform.tile import predicted_size

    step = settings.quantum or settings.step
    with np.errstate(all="ignore"):
        values = np.nan_to_num(sample.tiles[0].values.astype(np.float64))
        scaled = np.clip(np.rint((values - settings.center) / step), -(2.0**29), 2.0**29)
    tile = IntegerTile(scaled.astype(np.int32), None)
    depths = [min(3, (length - 1).bit_length()) for length in tile.integers.shape]
    levels, order = (depths[0], depths[1], depths[2], depths[3]), (0, 1, 2, 3)
    begun = now()
    fitted = min(count, FITTED_TILES)
    weights = fit_weights([tile] * fitted, levels, order, 1, TRIAL_ROWS)
    fit = (now() - begun) * count / fitted
    predictor = Predictor(
        step=step, origin=settings.center, levels=levels, order=order, reach=1, weights=weights
    )
    begun = now()
    predicted_size(tile.integers, None, predictor)
    return (now() - begun) / tile.integers.size, fit


HEAD_UPDATES = 120
"""Updates of the head that is trained for the rate of its training."""
HEAD_SAMPLES = 40_000
"""Voxels that this head learns from."""
TESTED = 0.2
"""Voxels that the gain is measured on, as a share of those that are learned from."""
FORWARD = 1 / 3
"""Time of evaluating a batch, as a share of that of an update."""


@dataclass(frozen=True, kw_only=True)
class HeadProbe:
    """Gain of heads by least squares, a short training of one, and rates that follow from it.

    Attributes:
        gain_db: gain in dB of least squares.
        looking: seconds of these.
        update: seconds of an update of the head.
        sampling: seconds for each voxel that is drawn.
        final: rate of coding with the head, beyond that without.
    """

    gain_db: float
    looking: float
    update: float
    sampling: float
    final: float


def probe_head(look: Look, rates: Rates, config: EncodeConfig) -> HeadProbe | None:
    """Train a head for a moment; None where there is nothing to learn."""
    coding = replace(search_coding(look, config.effort), error=None)
    pairs = training_pairs(rates.sample, rates.settings, coding)
    low, high = rates.settings.low, rates.settings.high
    begun = now()
    gain = foretold_gain(pairs, low, high, config.seed)
    looking, begun = now() - begun, now()
    budget = Budget(updates=HEAD_UPDATES, samples=HEAD_SAMPLES)
    trained = train_head(pairs, low, high, PERCEPTRON, budget, seed=config.seed)
    if trained is None:
        return None
    seconds = now() - begun
    training = min(trained.history[-1][0], seconds)
    with_head = replace(rates.settings, head=trained.head)
    final = coded_tiles(rates.sample, with_head, search_coding(look, config.effort))[0]
    return HeadProbe(
        gain_db=gain,
        looking=looking,
        update=training / updates_of(HEAD_UPDATES, HEAD_SAMPLES),
        sampling=(seconds - training) / (HEAD_SAMPLES * (1 + TESTED)),
        final=max(final - rates.search, 0.0),
    )


def updates_of(updates: int, samples: int) -> float:
    """The number of updates of one network that take as long as a whole training.

    STARTS networks begin side by side, and the best goes on alone. The gain is measured on held-out
    voxels, once for each network at that place and some times on the way.
    """
    learning = updates * (1 + (STARTS - 1) * CHOSEN_AT)
    batches = max(1.0, samples * TESTED / BATCH_VOXELS)
    return learning + (MEASUREMENTS + STARTS - 1) * batches * FORWARD


EPOCHS = 2
"""Epochs of the probe."""
ONCE = ("opening", "engine", "other")
"""Stages that take the same time for a part of a series, and begin a process at that."""


@dataclass(frozen=True, kw_only=True)
class PaperProbe:
    """An encoding of two epochs.

    Attributes:
        stages: seconds of each stage but the training, for the whole series.
        step: seconds of a training step.
        curve: seconds of a measurement after an epoch.
        samples: samples of the coreset, of the whole series.
        bricks: bricks that hold them, at most.
        bytes: of the file for the whole series.
    """

    stages: Mapping[str, float]
    step: float
    curve: float
    samples: int
    bricks: int
    bytes: int

    def stage_seconds(self, config: EncodeConfig) -> dict[str, float]:
        """Return the predicted seconds of each stage, for settings that differ in epochs alone."""
        batches = usual_batches(self.samples, self.bricks, config.batch)
        epochs = config.epochs or usual_epochs(batches)
        points = len(range(0, epochs, -(-epochs // HISTORY_POINTS)))
        return {
            **self.stages,
            "training": epochs * batches * self.step,
            "curve": points * self.curve,
        }

    def of_share(self, share: float, batch: int = 0) -> PaperProbe:
        """The probe of a share of the series, or above 1 of a larger one.

        batch: as in EncodeConfig.
        """
        samples, bricks = (max(1, round(count * share)) for count in (self.samples, self.bricks))
        before, after = (
            usual_batches(*counts, batch)
            for counts in ((self.samples, self.bricks), (samples, bricks))
        )
        return replace(
            self,
            stages={
                name: seconds if name in ONCE else seconds * share
                for name, seconds in self.stages.items()
            },
            # A step takes as long as it has samples.
            step=self.step * (samples / after) / (self.samples / before),
            samples=samples,
            bricks=bricks,
            bytes=round(self.bytes * share),
        )


def probe_paper(part: Series, share: float, config: EncodeConfig) -> PaperProbe:
    """Encode a part of a series for two epochs, with batches of its size; the probe of the whole.

    share: share of the series that the part is.
    """
    config = replace(config, epochs=EPOCHS, psnr=None, psnr_bulk=None, timings=True)
    with TemporaryDirectory() as folder:
        report, _ = reported(part, Path(folder) / "part.fhz", config)
    stages = {entry["stage"]: entry["seconds"] for entry in report["stages"]}
    training, curve = stages.pop("training", 0.0), stages.pop("curve", 0.0)
    keys = len(report["key_frames"])
    vertices = prod(hi - lo for lo, hi in report["feature_bounding_box"]) * keys
    samples = max(1, round(report["coreset_fraction"] * prod(part.shape[1:]) * keys))
    bricks = max(1, vertices >> sum(BRICK_BITS))
    first, last = (point["seconds"] or 0.0 for point in (report["curve"][0], report["curve"][-1]))
    second = min(max(last - first - curve / EPOCHS, 0.0), training)
    return PaperProbe(
        stages=stages,
        step=second / usual_batches(samples, bricks, config.batch),
        curve=curve / EPOCHS,
        samples=samples,
        bricks=bricks,
        bytes=report["bytes"],
    ).of_share(1 / share, config.batch)


def reported(part: Series, path: Path, config: EncodeConfig) -> tuple[EncodeReport, bool]:
    """The report of an encoding, without warnings, and whether it keeps its promise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        try:
            return encode(part, path, config), True
        except QualityError as error:
            return error.figures, False
