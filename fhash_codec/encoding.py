"""Encoding: series -> coreset -> trained model -> container."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.architecture import Architecture
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset import Coreset
from fhash_codec.metrics import measure_quality
from fhash_codec.progress import Progress, silent
from fhash_codec.report import report
from fhash_codec.scan import Scan
from fhash_codec.selection import Selection, Source, opened, select
from fhash_codec.storage import write_model
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import InterruptedEncodingError, QualityError
from fhash_formats.series import Series
from fhash_formats.writers.atomic import check_output


def encode(
    source: Source, path: str | Path, config: EncodeConfig | None = None, *, force: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Encode a series into the container `path`, complete or not at all; the figures of what was written (see `report`).

    source: a file (opened by `fhash_formats.open_series`), a Series, or an array (t, z, y, x) or (z, y, x).
    Ctrl-C during the training saves a checkpoint beside `path` and raises InterruptedEncodingError; the same call goes on from it to
    the same result. Raises QualityError, with the file written and its figures in the error, if `config.psnr` was not reached, and
    InputError for what cannot be encoded.
    """
    config, path = config or EncodeConfig(), Path(path)
    begun = time.perf_counter()
    check_output(path, force=force)
    with opened(source) as series:
        selected = select(series, config, progress)
        coreset = selected.coreset
        trained = train_model(coreset, selected.architecture, config, path, progress)
        with ContainerWriter(path, force=force) as writer:
            _write_series(writer, series, selected.scanned, coreset)
            write_model(writer, selected.architecture, coreset, trained.fine, trained.tables, trained.layers, config.tables)
            header = _header(series, selected, trained, config)
            with Volume(writer.preview(header)) as volume:
                header["quality"] = measure_quality(
                    series.read, volume.read, series.shape[0], volume.value_range.high - volume.value_range.low, volume.background, progress
                ).to_dict()
            writer.commit(header)
        trained.checkpoint.unlink(missing_ok=True)
    with open_volume(path) as volume:
        figures = report(volume, header["quality"], seconds=time.perf_counter() - begun)
    reached = figures["psnr"]
    if config.psnr is not None and reached is not None and reached < config.psnr:
        raise QualityError(
            f"{path}: {reached:.2f} dB over the coreset, {config.psnr:g} dB were asked for; the file is written. More --epochs may help",
            figures,
        )
    return figures


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
        engine.restore(saved[0])
        course = saved[1]
    with deferred_interrupts() as stop, threads_for(plan.batch_bricks * prod(coreset.brick_shape)):
        done = train(
            engine, plan, coreset, course, stop=stop, save=lambda now: save_checkpoint(checkpoint, engine.state(), now), progress=progress
        )
    if not done:
        raise InterruptedEncodingError(
            f"interrupted in epoch {course.epoch + 1} of {plan.epochs}; saved in {checkpoint}; the same command goes on from there"
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
    for axis, stored in {"t": "time", "z": "z", "y": "y", "x": "x"}.items():
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
    history = trained.history if config.timings else [{**point, "seconds": None} for point in trained.history]
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
