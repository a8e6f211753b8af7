"""Encoding: series -> coreset -> trained model -> container."""

from __future__ import annotations

import os
import time
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.architecture import Architecture
from fhash_codec.comparison import measure
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset import Coreset
from fhash_codec.progress import Progress, silent
from fhash_codec.report import report
from fhash_codec.scan import Scan
from fhash_codec.selection import Selection, Source, opened, select
from fhash_codec.storage import write_model
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import FhashWarning, InputError, InterruptedEncodingError, OutputError, QualityError
from fhash_formats.series import AXIS_NAMES, Series
from fhash_formats.writers.atomic import check_output
from fhash_formats.writers.registry import WRITERS


def encode(
    source: Source,
    path: str | Path,
    config: EncodeConfig | None = None,
    *,
    mask: npt.ArrayLike | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode a series into the container `path`, complete or not at all; the figures of what was written (see `report`).

    source: a file (opened by `fhash_formats.open_series`), a Series, or an array (t, z, y, x) or (z, y, x), labelled or not.
    mask: booleans (t, z, y, x) or (z, y, x), one more feature, and the only one where the settings name no other.
    Ctrl-C during the training saves a checkpoint beside `path` and raises InterruptedEncodingError; the same call goes on from it to
    the same result. Raises QualityError, with the file written and its figures in the error, if `config.psnr` was not reached, and
    InputError for what cannot be encoded.
    """
    config, path = config or EncodeConfig(), Path(os.path.normpath(path))
    begun = time.perf_counter()
    check_name(path)
    check_output(path, force)
    with opened(source) as series:
        masks = [feature.removeprefix("mask:") for feature in config.features if feature.startswith("mask:")]
        check_output(path, force, sources=[*series.files, *masks])
        selected = select(series, config, progress, mask)
        coreset = selected.coreset
        trained = train_model(coreset, selected.architecture, config, path, progress)
        with ContainerWriter(path, force=force) as writer:
            _write_series(writer, series, selected.scanned, coreset)
            write_model(writer, selected.architecture, coreset, trained.fine, trained.tables, trained.layers, config.tables)
            header = _header(series, selected, trained, config)
            with Volume(writer.preview(header)) as volume:
                header["quality"] = measure(series, volume, progress)
            writer.commit(header)
        trained.checkpoint.unlink(missing_ok=True)
    with open_volume(path) as volume:
        figures = report(volume, header["quality"], seconds=time.perf_counter() - begun)
    reached = figures["psnr"]
    if config.psnr is not None and figures["rmse"] != 0 and (reached is None or reached < config.psnr):
        found = "an unknown PSNR" if reached is None else f"{reached:.2f} dB"
        raise QualityError(
            f"{path}: {found} over the coreset, {config.psnr:g} dB were asked for; the file is written. More --epochs may help",
            figures,
        )
    return figures


def check_name(path: Path) -> None:
    """Refuse to give a container the name of another kind of file (InputError): most often it is that of the data."""
    if path.suffix.lower() in (suffix for writer in WRITERS for suffix in writer.suffixes):
        raise InputError(f"{path}: a container is not a {path.suffix} file; give it a name that ends in .fhz")


KEEP_SECONDS = 5.0  # of training, from which on it is kept until its file is complete


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What training gives: the model's numbers, how it went, and the checkpoint that is no longer needed once they are written.

    fine: (bricks, E, vertices of a brick); tables: the coarser levels (buckets, E); layers: (weight (out, in), bias (out,)).
    """

    fine: npt.NDArray[np.float32]
    tables: list[npt.NDArray[np.float32]]
    layers: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
    epochs: int
    history: list[dict[str, float | None]]
    device: str
    checkpoint: Path


def train_model(coreset: Coreset, architecture: Architecture, config: EncodeConfig, path: Path, progress: Progress = silent) -> Trained:
    """Train the model of a coreset, from the checkpoint of the same training beside `path` if there is one."""
    # torch takes seconds to import, and nothing that comes before needs it.
    from fhash_codec.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
    from fhash_codec.engines import choose_device, make_engine
    from fhash_codec.engines.threads import threads_for
    from fhash_codec.interrupts import deferred_interrupts
    from fhash_codec.train import Course, plan_training, train

    plan = plan_training(
        coreset, epochs=config.epochs, learning_rate=config.learning_rate, schedule=config.schedule, batch=config.batch, seed=config.seed
    )
    device = choose_device(config.device)
    engine = make_engine(config.engine, architecture, coreset, plan.rates, seed=config.seed, device=device)
    checkpoint = checkpoint_path(path, coreset, config)
    course = Course()
    saved = load_checkpoint(checkpoint)
    if saved:
        try:
            engine.restore(saved[0])
        except (KeyError, RuntimeError, ValueError) as error:
            raise InputError(f"checkpoint {checkpoint} does not fit; delete it to train from the start") from error
        course = saved[1]
    kept = course.epoch == plan.epochs

    def save(now: Course) -> None:
        try:
            save_checkpoint(checkpoint, engine.state(), now)
        except OutputError as error:
            if stop.asked:
                raise
            # The training itself can go on; only an interruption would cost more.
            warnings.warn(f"no checkpoint: {error}", FhashWarning, stacklevel=2)

    with deferred_interrupts() as stop, threads_for(plan.batch_bricks * prod(coreset.brick_shape)):
        done = train(engine, plan, coreset, course, stop=stop, save=save, progress=progress)
        # What follows may fail or be interrupted as well: a training worth keeping is kept until the file is complete.
        if done and not kept and (stop.asked or course.seconds > KEEP_SECONDS):
            save(course)
    if stop.asked:
        raise InterruptedEncodingError(
            f"interrupted after {course.epoch} of {plan.epochs} epochs; saved in {checkpoint}; the same command goes on from there"
        )
    parameters = engine.parameters()
    tables, layers = parameters.dense(architecture)
    return Trained(
        fine=parameters.fine.numpy(),
        tables=[table.numpy() for table in tables],
        layers=[(weight.numpy(), bias.numpy()) for weight, bias in layers],
        epochs=plan.epochs,
        history=course.history,
        device=device.type,
        checkpoint=checkpoint,
    )


def _write_series(writer: ContainerWriter, series: Series, scanned: Scan, coreset: Coreset) -> None:
    """Coordinates, key frames, and where the source has no finite value."""
    for axis, stored in AXIS_NAMES.items():
        coordinate = series.coords[axis]
        writer.add_whole(f"coords/{stored}", coordinate.values, attributes={**coordinate.attributes, "name": coordinate.name})
    writer.add_whole("key_frames", np.array(coreset.key_frames, dtype=np.int64))
    if scanned.missing:
        empty = np.zeros(-(-prod(series.shape[1:]) // 8), dtype=np.uint8)
        writer.add_array(
            "missing/bits",
            shape=(series.shape[0], empty.size),
            dtype=empty.dtype,
            chunk_shape=(1, empty.size),
            chunks=(scanned.missing.get(step, empty)[None] for step in range(series.shape[0])),
        )


def _header(series: Series, selected: Selection, trained: Trained, config: EncodeConfig) -> dict[str, Any]:
    """The container's header (FORMAT.md), its quality still to be measured."""
    architecture, coreset, value_range = selected.architecture, selected.coreset, selected.scanned.value_range
    seconds = trained.history[-1]["seconds"] if trained.history else 0.0
    # Milliseconds and hundredths of a dB: more digits would say nothing and cost bytes.
    history = [
        {
            "seconds": _rounded(point["seconds"], 3) if config.timings else None,
            "epoch": point["epoch"],
            "psnr": _rounded(point["psnr"], 2),
        }
        for point in trained.history
    ]
    return {
        "encoder": {"version": version("fhash"), "seed": config.seed},
        "variable": {"name": series.name, "units": series.units, "dtype": series.dtype.name, "attributes": dict(series.attributes)},
        "domain": {"shape": list(series.shape)},
        "value_range": [value_range.low, value_range.high],
        "background": coreset.background,
        "feature_bounding_box": [list(span) for span in coreset.box],
        "features": [str(feature) for feature in selected.features],
        "dilation": config.dilation,
        "coreset_fraction": coreset.fraction,
        "model": {
            "profile": config.profile,
            "fold": config.fold,
            "embedding_size": architecture.embedding_size,
            "hidden_layers": architecture.hidden_layers,
            "width": architecture.width,
            "tables": config.tables,
            "levels": [list(level) for level in architecture.levels],
            "parameters": architecture.parameters,
        },
        "config": config.to_dict(),
        "training": {"seconds": seconds if config.timings else None, "epochs": trained.epochs, "device": trained.device},
        "quality": {},
        "history": history,
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
