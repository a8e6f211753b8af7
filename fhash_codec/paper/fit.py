"""Training of a model until it is good enough: rounds, devices, interruption."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.devices import (
    enough_memory,
    leave_threads_of_parent,
    same_bits,
    threads_for,
    training_device,
)
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines import Engine, describe_engine, make_engine
from fhash_codec.paper.engines.fused import refusal
from fhash_codec.paper.engines.native import cpu_seconds
from fhash_codec.paper.engines.parameters import needed_bytes
from fhash_codec.paper.network import Architecture, rounding_bound
from fhash_codec.paper.train import (
    MAX_RESTARTS,
    Breaks,
    Diverged,
    Probe,
    TrainingPlan,
    TrainingProgress,
    checkpoint_path,
    load_checkpoint,
    plan_training,
    save_checkpoint,
    train,
    usual_batches,
    usual_epochs,
)
from fhash_codec.progress import Progress, silent, stage, tell
from fhash_formats.errors import (
    FhashWarning,
    InputError,
    InterruptedEncodingError,
    OutputError,
    TrainingError,
)
from fhash_formats.support.files import StopRequest, deferred_interrupts

LOWER_START = 0.5
"""Learning rate at the start of a round, as a share of that of the training."""
MAX_DOUBLINGS = 10
"""Largest number of further rounds, by the gain of the last ones, that are worth one more."""
MIN_STEPS = 8000
"""Training steps before which a small gain says nothing: many trainings pause at their start."""
LEARNED = 3.0
"""Gain in dB since the first epoch after which such a pause is over."""
WATCHED_ROUNDS = 2
"""Rounds whose gain counts: a training may pause for one and then learn again."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Quality that a model must have before its tables are coded.

    Attributes:
        psnr: PSNR in dB over the coreset.
        promised: promised PSNR in dB of the coded tables, at most `psnr`.
        seconds: time that further rounds may take.
    """

    psnr: float
    promised: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Round:
    """A further round of a training.

    Attributes:
        epochs: epochs of the round.
        psnr: PSNR in dB over the coreset before it.
        seconds: seconds of training before it.
    """

    epochs: int
    psnr: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Decision of a measurement of the model: another round or the end.

    Attributes:
        round: the next round; None to end the training.
        message: text for the user; "" where the goal is reached.
        limited: whether the limit in time ends the training.
    """

    round: Round | None
    message: str
    limited: bool = False


def decide(
    goal: Goal,
    psnr: float,
    epochs: int,
    steps: int,
    seconds: float,
    rounds: Sequence[Round],
    first: float = math.inf,
) -> Decision:
    """Decide whether a training goes on.

    Args:
        goal: the quality that is needed, and the limit in time.
        psnr: PSNR in dB of the model over the coreset; infinite for an exact one.
        epochs: finished epochs.
        steps: training steps so far.
        seconds: seconds of training so far.
        rounds: the further rounds so far.
        first: PSNR in dB after the first epoch, infinite where it is not known.
    """
    if psnr >= goal.psnr:
        return Decision(round=None, message="")
    has = f"the model has {psnr:.2f} dB over the coreset after {epochs} epochs"
    needed = f"{goal.promised:g} dB are promised"
    short = (
        "" if psnr < goal.promised else f", which costs bytes: {goal.psnr:g} dB would leave room"
    )
    awake = psnr > first + LEARNED or steps >= MIN_STEPS
    if len(rounds) >= WATCHED_ROUNDS and awake:
        gain = psnr - rounds[-WATCHED_ROUNDS].psnr
        if gain * MAX_DOUBLINGS < WATCHED_ROUNDS * (goal.psnr - psnr):
            return Decision(
                round=None,
                message=f"training ends: {has}, {needed}{short}; "
                f"the last {WATCHED_ROUNDS} rounds brought {gain:.2f} dB",
            )
    begun = rounds[0].seconds if rounds else seconds
    left = goal.seconds - (seconds - begun)
    affordable = left / max(seconds / epochs, 1e-9)
    count = min(epochs, math.floor(min(affordable, float(epochs))))
    if count < 1:
        return Decision(
            round=None,
            message=f"training ends at its limit of {goal.seconds:g} more seconds: {has}, "
            f"{needed}{short}; --train-on-seconds sets the limit",
            limited=True,
        )
    return Decision(
        round=Round(epochs=count, psnr=psnr, seconds=seconds),
        message=f"training goes on for {count} epochs: {has}, {needed}, and {goal.psnr:g} dB "
        "before the tables are coded",
    )


def extended(plan: TrainingPlan, epochs: int, schedule: str) -> TrainingPlan:
    """Return a plan with a further round.

    Args:
        plan: the plan so far.
        epochs: epochs of the round.
        schedule: as in `plan_training`.
    """
    steps = epochs * plan.batches
    share = np.arange(1, steps + 1) / steps
    top = LOWER_START * plan.rates[0]
    rates = top * (0.5 + 0.5 * np.cos(np.pi * share) if schedule == "cosine" else share**0)
    return replace(plan, epochs=plan.epochs + epochs, rates=np.concatenate([plan.rates, rates]))


KEEP_SECONDS = 5.0
"""Seconds of training from which on its checkpoint is kept until the output file is complete."""


@dataclass(frozen=True, kw_only=True)
class TrainedModel:
    """The numbers of a trained model, and how the training went.

    Attributes:
        fine: finest embeddings (E, samples), in the order of `Coreset.values`.
        tables: coarser tables, each (buckets, E).
        layers: weight (out, in) and bias (out,) of each layer.
        epochs: epochs of the training.
        steps: training steps, one for each batch.
        history: {seconds, epoch, psnr} after epochs.
        device: type of the device.
        engine: the engine, as `describe_engine` says it.
        checkpoint: path of the checkpoint, of no more use once the numbers are written.
        restarts: restarts at a lower learning rate.
        learning_rate: learning rate of the last start.
        limited: whether the limit in time ended the training before its goal.
        psnr: PSNR in dB over the samples; None where it was not measured, or without an error.
        rounding: of the outputs of two readers, as `rounding_bound` gives it.
    """

    fine: npt.NDArray[np.float32]
    tables: list[npt.NDArray[np.float32]]
    layers: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
    epochs: int
    steps: int
    history: list[dict[str, float | None]]
    device: str
    engine: dict[str, str | int]
    checkpoint: Path
    restarts: int
    learning_rate: float
    limited: bool
    psnr: float | None
    rounding: float


def train_model(
    coreset: Coreset,
    architecture: Architecture,
    config: EncodeConfig,
    path: Path,
    progress: Progress = silent,
    goal: Goal | None = None,
) -> TrainedModel:
    """Train the model of a coreset.

    The training continues from the checkpoint of the same training beside `path`, if there is one.
    A training that diverges begins again at a lower learning rate, with a FhashWarning.

    Args:
        coreset: the training samples.
        architecture: the sizes of the model.
        config: the settings.
        path: the output file.
        progress: called after each batch.
        goal: quality for which the training goes on beyond its epochs; a FhashWarning says why it
            ends without. None to end it after its epochs.

    Raises:
        TrainingError: no learning rate gives a model.
        InterruptedEncodingError: a signal asked for the end; a checkpoint was saved.
        InputError: the checkpoint cannot be read, or the device or the engine is not available,
            or the memory of the device is not enough.
    """
    with stage("engine", "tables and network at their random start"):
        fitting = _Fitting(coreset, architecture, config, path, progress, goal)
    while True:
        try:
            return fitting.run()
        except Diverged as error:
            # Nothing but the error refers to the engine any more, so that its memory is free before
            # the next one is made: a large model would not fit twice.
            fitting.restart(error)


class _Fitting:
    """The training of one model, over all its restarts."""

    def __init__(
        self,
        coreset: Coreset,
        architecture: Architecture,
        config: EncodeConfig,
        path: Path,
        progress: Progress,
        goal: Goal | None,
    ) -> None:
        """Read the checkpoint if there is one."""
        self._coreset, self._architecture, self._config = coreset, architecture, config
        self._progress, self._goal = progress, goal
        self._limited, self._threads = False, 1
        self._psnr: float | None = None
        self._device = self._choose_device()
        self._checkpoint = checkpoint_path(path, coreset, config)
        saved = load_checkpoint(self._checkpoint)
        self._saved_state = saved[0] if saved else None
        self._reached: TrainingProgress = saved[1] if saved else TrainingProgress()

    def run(self) -> TrainedModel:
        """Train to the end of the plan. Raises Diverged where the learning rate is too high."""
        leave_threads_of_parent()
        with enough_memory(self._device), same_bits(self._device, self._config.deterministic):
            return self._run()

    def _run(self) -> TrainedModel:
        with stage("engine", "tables and network at their random start"):
            plan = self._plan()
            engine = self._engine(plan)
        with (
            stage("training", f"{plan.epochs} epochs of {plan.batches} steps"),
            deferred_interrupts() as stop,
            threads_for(plan.batch_samples) as self._threads,
        ):
            while self._trained_to_end(engine, plan, stop):
                further = self._next_round(engine, plan)
                if further is None:
                    break
                plan = further
                engine.rates = plan.rates
        if stop.asked:
            raise InterruptedEncodingError(
                f"interrupted after {self._reached.epoch} of {plan.epochs} epochs; "
                f"saved in {self._checkpoint}; the same command goes on from there"
            )
        return self._trained(engine, plan)

    def _trained_to_end(self, engine: Engine, plan: TrainingPlan, stop: StopRequest) -> bool:
        """Train to the end of a plan; return whether it was reached."""
        finished_before = self._reached.epoch == plan.epochs
        save = partial(self._save, engine, stop)
        breaks = Breaks(stop=stop, save=save)
        done = train(engine, plan, self._coreset, self._reached, breaks, self._progress)
        # Later work may fail or be interrupted as well. A training worth keeping is kept until
        # the output file is complete.
        worth_keeping = stop.asked or self._reached.seconds > KEEP_SECONDS
        if done and not finished_before and worth_keeping:
            save(self._reached)
        return done

    def _next_round(self, engine: Engine, plan: TrainingPlan) -> TrainingPlan | None:
        """Return the plan with a further round; None where the training ends.

        The whole coreset is measured, once for each round.
        """
        if self._goal is None:
            return None
        psnr = self._psnr = Probe(self._coreset).psnr(engine)
        if self._config.epochs:  # so many were asked for
            return None
        reached = self._reached
        decision = decide(
            self._goal,
            float("inf") if psnr is None else psnr,
            reached.epoch,
            reached.epoch * plan.batches,
            reached.seconds,
            [Round(**earlier) for earlier in reached.rounds],  # type: ignore[arg-type]
            next((point["psnr"] for point in reached.history if point["psnr"]), math.inf),
        )
        if decision.round is None:
            if decision.message:
                warnings.warn(decision.message, FhashWarning, stacklevel=4)
            self._limited = decision.limited
            return None
        tell("training", decision.message)
        reached.rounds.append(asdict(decision.round))
        return extended(plan, decision.round.epochs, self._config.schedule)

    def restart(self, error: TrainingError) -> None:
        """Begin again at a lower learning rate, with a warning.

        Raises TrainingError after MAX_RESTARTS.
        """
        configured = self._config.learning_rate
        if self._reached.restarts == MAX_RESTARTS:
            rate = self._reached.rate(configured)
            raise TrainingError(f"{error}, even at a learning rate of {rate:.3g}") from error
        self._reached, self._saved_state = self._reached.restarted(), None
        lower = self._reached.rate(configured)
        warnings.warn(
            f"{error}; it begins again at a learning rate of {lower:.3g}",
            FhashWarning,
            stacklevel=3,
        )

    def _plan(self) -> TrainingPlan:
        plan = plan_training(
            self._coreset,
            epochs=self._config.epochs,
            learning_rate=self._reached.rate(self._config.learning_rate),
            schedule=self._config.schedule,
            batch=self._config.batch,
            seed=self._config.seed,
        )
        for earlier in self._reached.rounds:
            plan = extended(plan, int(earlier["epochs"]), self._config.schedule)
        return plan

    def _choose_device(self) -> str:
        """Return the device, by the plan without further rounds: the same at each continuation."""
        samples, bricks = len(self._coreset.values), len(self._coreset.bricks)
        batches = usual_batches(samples, bricks, self._config.batch)
        epochs = self._config.epochs or usual_epochs(batches)
        device, why = training_device(
            self._config.device,
            cpu_seconds(self._architecture, samples * epochs),
            needed_bytes(self._architecture, self._coreset),
            refusal(self._architecture),
        )
        tell("engine", f"tables and network at their random start, {why}")
        return device

    def _engine(self, plan: TrainingPlan) -> Engine:
        """Return a new engine, in the state of the checkpoint if there is one."""
        engine = make_engine(
            self._architecture,
            self._coreset,
            plan.rates,
            seed=self._config.seed,
            # CUDA that nobody named gives way to the CPU where its kernels cannot be had.
            device="cpu" if self._device == "cpu" else self._config.device,
        )
        if self._saved_state is not None:
            try:
                engine.restore(self._saved_state)
            except (KeyError, ValueError) as error:
                raise InputError(
                    f"checkpoint {self._checkpoint} does not fit; delete it to train from the start"
                ) from error
        return engine

    def _save(self, engine: Engine, stop: StopRequest, reached: TrainingProgress) -> None:
        """Write a checkpoint. A failure is only a warning, unless the training is asked to end."""
        try:
            save_checkpoint(self._checkpoint, engine.state(), reached)
        except OutputError as error:
            if stop.asked:
                raise
            # The training itself can go on. Only a later interruption would lose it.
            warnings.warn(f"no checkpoint: {error}", FhashWarning, stacklevel=2)

    def _trained(self, engine: Engine, plan: TrainingPlan) -> TrainedModel:
        """Return the numbers of the engine. Raises TrainingError if they are not finite."""
        parameters = engine.parameters()
        if not all(
            bool(np.isfinite(vector).all())
            for vector in (parameters.fine, parameters.coarse, parameters.network)
        ):
            raise TrainingError("the trained numbers are not finite; set a lower --learning-rate")
        tables, layers = parameters.dense(self._architecture)
        peaks = [np.abs(parameters.fine).max(axis=1), *(np.abs(t).max(axis=0) for t in tables)]
        return TrainedModel(
            fine=parameters.fine,
            tables=tables,
            layers=layers,
            epochs=plan.epochs,
            steps=plan.epochs * plan.batches,
            history=self._reached.history,
            device="cpu" if engine.name == "native" else self._device,
            engine=describe_engine(engine, self._threads),
            checkpoint=self._checkpoint,
            restarts=self._reached.restarts,
            learning_rate=self._reached.rate(self._config.learning_rate),
            limited=self._limited,
            psnr=self._psnr,
            rounding=rounding_bound(np.concatenate(peaks), layers),
        )
