"""Training loop, its probe of quality, and its checkpoints."""

from __future__ import annotations

import hashlib
import json
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from math import inf, isfinite, log10
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines import Engine
from fhash_codec.progress import Progress, silent, stage
from fhash_formats.errors import InputError, TrainingError
from fhash_formats.support.files import StopRequest, clear_leftovers, replacing

AT_ONCE = 64
"""Bricks that are evaluated at a time."""


class Diverged(TrainingError):
    """A training came to nothing at its learning rate; a lower rate may do better."""


class Probe:
    """Bricks on which the quality of a model is measured, as a reader decodes them.

    The samples of the fringe do not count. They train embeddings that only times between key
    frames need.

    Attributes:
        bricks: numbers of the bricks, ascending; each holds a vertex of the coreset.
        samples: number of vertices of the coreset in them.
    """

    def __init__(self, coreset: Coreset, limit: int | None = None, seed: int = 0) -> None:
        """Choose bricks of a coreset: all, or at most `limit` at random."""
        self._coreset, counts = coreset, coreset.counts
        order = np.random.default_rng(seed).permutation(len(counts))
        self.bricks: npt.NDArray[np.int64] = np.sort(order[counts[order] > 0][:limit])
        self.samples = int(counts[self.bricks].sum())

    def psnr(self, engine: Engine) -> float | None:
        """Return the PSNR in dB of a model; None if its error is 0.

        The values are normalised, so their range is 1. Raises Diverged if the error is not finite.
        """
        error = 0.0
        for chosen in np.array_split(self.bricks, -(-len(self.bricks) // AT_ONCE)):
            places, counted = self._sample_indices(chosen)
            values = self._coreset.values[places[counted]]
            inferred = engine.infer(chosen)[counted].astype(np.float64)
            # A reader clips values to their range. Clipping must not hide an infinite one.
            decoded = np.where(np.isinf(inferred), np.nan, np.clip(inferred, 0.0, 1.0))
            error += float(np.square(decoded - values).sum())
        if not np.isfinite(error):
            raise Diverged(
                "training diverged: the error is no longer finite; set a lower --learning-rate"
            )
        return None if error == 0 else -10 * log10(error / self.samples)

    def error_of_constant(self) -> float:
        """Return the mean squared error of the best constant for all samples of the bricks."""
        places, counted = self._sample_indices(self.bricks)
        trained = self._coreset.values[places]
        constant = float(trained.mean(dtype=np.float64))
        return float(np.square(trained[counted].astype(np.float64) - constant).mean())

    def _sample_indices(
        self, chosen: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the places (n,) of the samples of bricks in `Coreset.values`, and which count."""
        places, fringe = self._coreset.sample_indices(chosen), self._coreset.fringe
        return places, np.ones(len(places), np.bool_) if fringe is None else ~fringe[places]


BATCH_SAMPLES = 1 << 16
"""Usual samples in a batch: with fewer, its fixed cost shows; with more, an epoch teaches less."""
STEPS_AN_EPOCH = (20, 256)
"""Smallest and largest number of training steps in an epoch, unless a batch size is given."""
USUAL_EPOCHS = 20
"""Smallest number of epochs where none is given."""
USUAL_STEPS = 1000
"""Training steps that the epochs make at least where no number of epochs is given."""
HISTORY_POINTS = 100
"""Largest number of points in the history."""
PROBE_BRICKS = 512
"""Bricks on which the quality of an epoch is measured."""
DIVERGED = 4.0
"""Mean squared error of a batch above which a training diverged, in squares of the value range.

No training starts with so large an error. One that exceeds it ends as a constant as a rule; a
learning rate of 0.1 reaches 2.3 and recovers.
"""
WATCHED = 16
"""Batches between two checks of their errors. A GPU would have to wait for each check."""
USUAL_RATE = 0.01
"""Learning rate up to which a model that gives a constant is not blamed on the rate."""
DEAD = 0.05
"""Share of the values' variance by which the last error of a dead model may differ from it."""
STILL = 0.5
"""Largest distance in dB between the PSNR of a dead model and that of a constant.

It holds in the second half of a training. A model that strays further is still learning.
"""
LOWER = 0.25
"""Factor on the learning rate after a training diverged."""
MAX_RESTARTS = 8
"""Largest number of restarts at a lower learning rate."""


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """The batches and learning rates of a training.

    Attributes:
        epochs: passes over all bricks.
        counts: samples of each brick of the coreset, int64 (bricks,).
        batches: random batches of an epoch.
        seed: seed of the order of the bricks.
        rates: learning rate of every training step, counted from 1, float64
            (epochs * batches + 1,).
    """

    epochs: int
    counts: npt.NDArray[np.int64]
    batches: int
    seed: int
    rates: npt.NDArray[np.float64]

    @property
    def bricks(self) -> int:
        """Bricks of the coreset."""
        return len(self.counts)

    @property
    def batch_samples(self) -> int:
        """Samples of a batch on average."""
        return -(-int(self.counts.sum()) // self.batches)

    def order(self, epoch: int) -> list[npt.NDArray[np.int64]]:
        """Return the batches of an epoch, each brick once, in an order of seed and epoch alone.

        Batches are whole bricks, at least one, and differ in samples by about a brick.
        """
        order = np.random.default_rng([self.seed, epoch]).permutation(self.bricks)
        return np.split(order, batch_ends(self.counts[order], self.batches))


def batch_ends(counts: npt.NDArray[np.int64], batches: int) -> npt.NDArray[np.int64]:
    """Return where each batch but the last ends in a list of bricks, int64 (batches - 1,).

    Args:
        counts: samples of the bricks in their order, none of them negative.
        batches: number of batches, at most as many as there are bricks; none is empty.
    """
    ends = np.cumsum(counts)
    # A brick belongs to the batch in which its middle lies. Doubled, the middles are whole numbers.
    middles = 2 * ends - counts
    numbers = np.arange(1, batches)
    cuts = np.searchsorted(middles * batches, 2 * int(ends[-1]) * numbers)
    # Each batch has a brick at least, and leaves one to each batch that follows.
    cuts = np.maximum.accumulate(np.maximum(cuts, 1) - numbers) + numbers
    return np.minimum(cuts, len(counts) - batches + numbers).astype(np.int64)


def usual_batches(samples: int, bricks: int, batch: int = 0) -> int:
    """Return the training steps of an epoch.

    Args:
        samples: samples of the coreset.
        bricks: bricks that hold them.
        batch: as in `plan_training`.
    """
    if batch:
        batches = max(1, round(samples / batch))
    else:
        low, high = STEPS_AN_EPOCH
        batches = min(max(-(-samples // BATCH_SAMPLES), low), high)
    return min(batches, bricks)


def usual_epochs(batches: int) -> int:
    """Return the epochs where none are given, each of a number of training steps."""
    return max(USUAL_EPOCHS, -(-USUAL_STEPS // batches))


def plan_training(
    coreset: Coreset, *, epochs: int, learning_rate: float, schedule: str, batch: int, seed: int
) -> TrainingPlan:
    """Return a plan for the training on a coreset.

    Args:
        coreset: the training samples.
        epochs: number of epochs; 0 for 20, or for as many as make 1000 training steps.
        learning_rate: learning rate of the first step.
        schedule: cosine lets the rate fall to zero; any other name keeps it constant.
        batch: samples in a batch, rounded to whole bricks; 0 for BATCH_SAMPLES where that makes 20
            to 256 steps an epoch, and else for the nearest size that does.
        seed: seed of the order of the bricks.
    """
    counts = np.diff(coreset.offsets)
    batches = usual_batches(int(counts.sum()), len(counts), batch)
    epochs = epochs or usual_epochs(batches)
    share = np.arange(epochs * batches + 1) / max(epochs * batches, 1)
    rates = learning_rate * (
        0.5 + 0.5 * np.cos(np.pi * share) if schedule == "cosine" else np.ones_like(share)
    )
    return TrainingPlan(epochs=epochs, counts=counts, batches=batches, seed=seed, rates=rates)


@dataclass(kw_only=True)
class TrainingProgress:
    """The progress of a training. Checkpoints store it under the names of these fields.

    Attributes:
        epoch: finished epochs.
        batch: finished batches of the present epoch.
        seconds: time spent, restarts included.
        history: {seconds, epoch, psnr} after epochs; psnr is None where the error is 0.
        restarts: number of restarts, each at LOWER times the learning rate before.
        rounds: the further rounds so far, each as the fields of `rounds.Round`.
    """

    epoch: int = 0
    batch: int = 0
    seconds: float = 0.0
    history: list[dict[str, float | None]] = field(default_factory=list)
    restarts: int = 0
    rounds: list[dict[str, float]] = field(default_factory=list)

    def rate(self, configured: float) -> float:
        """Return the learning rate of the first step, given the one that was configured."""
        return configured * LOWER**self.restarts

    def restarted(self) -> TrainingProgress:
        """Return the progress of a training that begins again at a lower rate.

        It does not return to an earlier state: the moments of Adam have grown with the error.
        """
        return TrainingProgress(seconds=self.seconds, restarts=self.restarts + 1)


SaveProgress = Callable[[TrainingProgress], None]


@dataclass(frozen=True, kw_only=True)
class Breaks:
    """Request to stop, saving, and limit in time of a training.

    Attributes:
        stop: asks for an end, which comes after the running batch.
        save: called with the progress every `save_seconds`, and before `stop` ends the training.
        save_seconds: least time between two calls of `save`.
        budget_seconds: time after which the training ends.
    """

    stop: StopRequest | None = None
    save: SaveProgress | None = None
    save_seconds: float = 60.0
    budget_seconds: float = float("inf")


def train(
    engine: Engine,
    plan: TrainingPlan,
    coreset: Coreset,
    reached: TrainingProgress,
    breaks: Breaks = Breaks(),
    progress: Progress = silent,
) -> bool:
    """Train from where `reached` stands to the end of the plan. Return whether that was reached.

    Every epoch adds {seconds, epoch, psnr} to the history; of more than 100 epochs every 2nd, 3rd,
    ... does. The PSNR in dB is of normalised values of the coreset, without its fringe, on a fixed
    random choice of bricks.

    Args:
        engine: the model in training.
        plan: batches and learning rates.
        coreset: the training samples.
        reached: how far the training has come; changed in place.
        breaks: what saves the training or ends it early.
        progress: called after each batch.

    Raises:
        Diverged: the error of a batch exceeds DIVERGED or is not finite, or a learning rate above
            USUAL_RATE left nothing but a constant.
    """
    loop = _Loop(engine, plan, coreset, reached)
    saving = _Saving(breaks)
    while reached.epoch < plan.epochs:
        for chosen in plan.order(reached.epoch)[reached.batch :]:
            loop.train_batch(chosen)
            asked = breaks.stop is not None and breaks.stop.asked
            due = saving.due(asked)
            if due or reached.batch % WATCHED == 0 or reached.batch == plan.batches:
                loop.check_errors()
            if due:
                saving.save(reached)
            if asked or reached.seconds > breaks.budget_seconds:
                return False
            done = reached.epoch * plan.batches + reached.batch
            progress("training", done, plan.epochs * plan.batches, loop.note)
        loop.end_epoch()
    loop.check_dead()
    return True


class _Loop:
    """The steps of a training and the measurements along the way.

    Attributes:
        note: quality at the end of the last epoch, for the progress line.
    """

    def __init__(
        self, engine: Engine, plan: TrainingPlan, coreset: Coreset, reached: TrainingProgress
    ) -> None:
        self.note = ""
        self._engine, self._plan, self._reached = engine, plan, reached
        self._samples = np.diff(coreset.offsets)
        self._probe = Probe(coreset, PROBE_BRICKS, plan.seed)
        self._epochs_a_point = -(-plan.epochs // HISTORY_POINTS)
        self._errors: list[SupportsFloat] = []
        self._counts: list[int] = []
        self._seconds_before, self._begun = reached.seconds, time.perf_counter()

    def train_batch(self, chosen: npt.NDArray[np.int64]) -> None:
        """Train on a batch of bricks and keep its error until the next check."""
        self._errors.append(self._engine.train(chosen))
        self._counts.append(max(int(self._samples[chosen].sum()), 1))
        self._reached.batch += 1
        self._count_seconds()

    def check_errors(self) -> None:
        """Raise Diverged if a mean squared error since the last check is too large."""
        errors = [float(e) / n for e, n in zip(self._errors, self._counts, strict=True)]
        self._errors, self._counts = [], []
        # A comparison that NaN fails, too.
        if not all(error <= DIVERGED for error in errors):
            error = max(errors) if all(map(isfinite, errors)) else inf
            raise Diverged(
                f"training diverged in epoch {self._reached.epoch + 1}: "
                f"the error reached {error**0.5:.3g} times the range of the values"
            )

    def end_epoch(self) -> None:
        """Count the epoch and, where one is due, add a point to the history."""
        reached = self._reached
        reached.epoch, reached.batch = reached.epoch + 1, 0
        if reached.epoch % self._epochs_a_point == 0 or reached.epoch == self._plan.epochs:
            with stage("curve", "quality of the model after its epochs, on some bricks"):
                psnr = self._probe.psnr(self._engine)
            self._count_seconds()
            reached.history.append(
                {"seconds": reached.seconds, "epoch": reached.epoch, "psnr": psnr}
            )
            self.note = "exact" if psnr is None else f"epoch {reached.epoch}: {psnr:.1f} dB"

    def check_dead(self) -> None:
        """Raise Diverged if a learning rate above the usual one left nothing but a constant."""
        if self._plan.rates[0] > USUAL_RATE and _dead(
            self._reached, self._probe.error_of_constant()
        ):
            raise Diverged("training ended in a constant")

    def _count_seconds(self) -> None:
        self._reached.seconds = self._seconds_before + time.perf_counter() - self._begun


class _Saving:
    """The clock that says when the next checkpoint is due."""

    def __init__(self, breaks: Breaks) -> None:
        self._save, self._seconds = breaks.save, breaks.save_seconds
        self._saved = time.perf_counter()

    def due(self, asked: bool) -> bool:
        """Return whether to save: where the training is asked to end, or where it is time."""
        late = time.perf_counter() - self._saved > self._seconds
        return self._save is not None and (asked or late)

    def save(self, reached: TrainingProgress) -> None:
        """Save, and spend at most a twentieth of the time on saving: a large model takes long."""
        assert self._save is not None
        begun = time.perf_counter()
        self._save(reached)
        self._saved = time.perf_counter()
        self._seconds = max(self._seconds, 20 * (self._saved - begun))


def _dead(reached: TrainingProgress, error: float) -> bool:
    """Return whether the model gave nothing but a constant in the second half of a training.

    The model is dead if its PSNR stayed within STILL dB of the best constant's and its last error
    within the share DEAD.

    Args:
        reached: the training.
        error: mean squared error of the best constant.
    """
    late = [point["psnr"] for point in reached.history[len(reached.history) // 2 :]]
    if not error > 0 or len(late) < 2:
        return False
    constant = -10 * log10(error)
    distances = [abs(psnr - constant) for psnr in late if psnr is not None]
    return (
        len(distances) == len(late)
        and max(distances) <= STILL
        and distances[-1] <= -10 * log10(1 - DEAD)
    )


MAX_NAME_BYTES = 250
"""Bytes of a checkpoint's file name, with those that a temporary name adds; systems allow 255."""
PARTIAL_BYTES = 24
"""Bytes that a temporary name adds while the checkpoint is written."""
UNRELATED = ("device", "psnr", "tables", "timings", "train_on_seconds", "without")
"""Settings that do not change the course of a training, but at most its rounding and its end.

Engines go on from each other's state.
"""


def checkpoint_path(output: Path, coreset: Coreset, config: EncodeConfig) -> Path:
    """Return the path of a training's checkpoint.

    It is `OUTPUT.<digest of coreset and settings>.checkpoint`, beside the output.
    """
    settings = {name: value for name, value in config.to_dict().items() if name not in UNRELATED}
    settings |= {
        "fold": config.model_fold,
        "embedding_size": config.model_embedding_size,
        "width": config.model_width,
    }
    digest = hashlib.sha256(
        json.dumps(
            [version("fhash"), settings, coreset.box, coreset.key_frames], sort_keys=True
        ).encode()
    )
    for array in (coreset.values, coreset.bricks, coreset.mask_bits):
        digest.update(array.data)
    end = f".{digest.hexdigest()[:12]}.checkpoint"
    # A long name may lose its end: the digest tells checkpoints apart.
    room = MAX_NAME_BYTES - len(end) - PARTIAL_BYTES
    start = output.name.encode()[:room].decode(errors="ignore")
    return output.with_name(start + end)


def save_checkpoint(
    path: Path, state: Mapping[str, npt.NDArray[Any]], reached: TrainingProgress
) -> None:
    """Write a checkpoint; the old one stays until the new one is complete.

    Args:
        path: the checkpoint.
        state: state of the engine.
        reached: how far the training has come.
    """
    text = np.frombuffer(json.dumps(asdict(reached)).encode(), dtype=np.uint8)
    with replacing(path, force=True) as temporary, temporary.open("wb") as file:
        np.savez(file, course=text, **state)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> tuple[dict[str, npt.NDArray[Any]], TrainingProgress] | None:
    """Read a checkpoint: the state of the engine, and how far the training had come.

    Returns None where there is no checkpoint. Raises InputError for one that cannot be read.
    Temporary files of a training that was killed while it saved are deleted here, since this
    training may never save.
    """
    clear_leftovers([path])
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
        return state, TrainingProgress(**json.loads(state.pop("course").tobytes()))
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"checkpoint {path} cannot be read; delete it to train from the start"
        ) from error
