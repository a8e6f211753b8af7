"""A trained model: from a checkpoint or the start, again at a lower rate where it diverges, kept where it is interrupted."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import (
    FhashWarning,
    InputError,
    InterruptedEncodingError,
    OutputError,
    TrainingError,
)
from fhash_formats.support.interrupts import deferred_interrupts

__all__ = ["Trained", "train_model"]

KEEP_SECONDS = 5.0
"""Of training, from which on it is kept until its file is complete."""


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What training gives: the model's numbers, how it went, and the checkpoint that is no longer needed once they are written.

    fine: (bricks, E, vertices of a brick); tables: the coarser levels (buckets, E); layers: (weight (out, in), bias (out,)).
    learning_rate: at which it came to its end, after so many `restarts` at lower and lower ones.
    """

    fine: npt.NDArray[np.float32]
    tables: list[npt.NDArray[np.float32]]
    layers: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
    epochs: int
    history: list[dict[str, float | None]]
    device: str
    checkpoint: Path
    restarts: int
    learning_rate: float


def train_model(
    coreset: Coreset,
    architecture: Architecture,
    config: EncodeConfig,
    path: Path,
    progress: Progress = silent,
) -> Trained:
    """Train the model of a coreset, from the checkpoint of the same training beside `path` if there is one.

    A training that diverges begins again at a lower learning rate, with a FhashWarning. Raises TrainingError where no rate helps.
    """
    # torch takes seconds to import, and nothing that comes before needs it.
    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.training.checkpoint import (
        checkpoint_path,
        load_checkpoint,
        save_checkpoint,
    )
    from fhash_codec.paper.training.train import (
        MAX_RESTARTS,
        Course,
        Diverged,
        plan_training,
        train,
    )
    from fhash_codec.training.devices import choose_device
    from fhash_codec.training.threads import threads_for

    device = choose_device(config.device)
    checkpoint = checkpoint_path(path, coreset, config)
    saved = load_checkpoint(checkpoint)
    course = saved[1] if saved else Course()

    def save(now: Course) -> None:
        try:
            save_checkpoint(checkpoint, engine.state(), now)
        except OutputError as error:
            if stop.asked:
                raise
            # The training itself can go on; only an interruption would cost more.
            warnings.warn(f"no checkpoint: {error}", FhashWarning, stacklevel=2)

    while True:
        rate = course.rate(config.learning_rate)
        plan = plan_training(
            coreset,
            epochs=config.epochs,
            learning_rate=rate,
            schedule=config.schedule,
            batch=config.batch,
            seed=config.seed,
        )
        engine = make_engine(
            config.engine, architecture, coreset, plan.rates, seed=config.seed, device=device
        )
        if saved:
            try:
                engine.restore(saved[0])
            except (KeyError, RuntimeError, ValueError) as error:
                raise InputError(
                    f"checkpoint {checkpoint} does not fit; delete it to train from the start"
                ) from error
        kept = course.epoch == plan.epochs
        try:
            with (
                deferred_interrupts() as stop,
                threads_for(plan.batch_bricks * prod(coreset.brick_shape)),
            ):
                done = train(engine, plan, coreset, course, stop=stop, save=save, progress=progress)
                # What follows may fail or be interrupted as well: a training worth keeping is kept until the file is complete.
                if done and not kept and (stop.asked or course.seconds > KEEP_SECONDS):
                    save(course)
            break
        except Diverged as error:
            if course.restarts == MAX_RESTARTS:
                raise TrainingError(f"{error}, even at a learning rate of {rate:.3g}") from error
            course, saved = course.again(), None
            lower = course.rate(config.learning_rate)
            warnings.warn(
                f"{error}; it begins again at a learning rate of {lower:.3g}",
                FhashWarning,
                stacklevel=2,
            )
        del engine  # before the next one: a large model would not fit twice
    if stop.asked:
        raise InterruptedEncodingError(
            f"interrupted after {course.epoch} of {plan.epochs} epochs; saved in {checkpoint}; the same command goes on from there"
        )
    parameters = engine.parameters()
    if not all(
        bool(part.isfinite().all())
        for part in (parameters.fine, parameters.coarse, parameters.network)
    ):
        raise TrainingError("the trained numbers are not finite; set a lower --learning-rate")
    tables, layers = parameters.dense(architecture)
    return Trained(
        fine=parameters.fine.numpy(),
        tables=[table.numpy() for table in tables],
        layers=[(weight.numpy(), bias.numpy()) for weight, bias in layers],
        epochs=plan.epochs,
        history=course.history,
        device=device.type,
        checkpoint=checkpoint,
        restarts=course.restarts,
        learning_rate=rate,
    )
