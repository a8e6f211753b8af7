"""Encoding of the published network: selection, training, tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import log10, prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.goal import held_psnr, promise
from fhash_codec.config import PAIR, EncodeConfig
from fhash_codec.features.bricks import Coreset, build_coreset, parse_brick, with_steps_between
from fhash_codec.features.features import Feature, FeatureChoice
from fhash_codec.features.key_frames import KeyTimes, time_axis
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import resolve_selection
from fhash_codec.header import brief_history, describe_source, write_series
from fhash_codec.measure.errors import find_bulk, whole_psnr
from fhash_codec.measure.value_range import ValueRange, decoded_type
from fhash_codec.paper.coding import MAX_LOSS, ModelCoding
from fhash_codec.paper.fit import Goal, TrainedModel, train_model
from fhash_codec.paper.network import Architecture, parameter_count
from fhash_codec.paper.storage import load_network, write_model, write_tables
from fhash_codec.progress import Progress, stage
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import CORESET, FRINGE, PAPER, SPARSE, SPARSE_FEATURE
from fhash_formats.series import Series


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Training samples that the settings select from a series, and the model to fit to them.

    Attributes:
        scanned: value range and missing values of the series.
        features: the features of interest.
        coreset: the samples at the key frames.
        samples: those of the training: the same, or with those of the steps between.
        architecture: the sizes of the model.
    """

    scanned: Scan
    features: tuple[Feature, ...]
    coreset: Coreset
    samples: Coreset
    architecture: Architecture


def select(
    series: Series, config: EncodeConfig, progress: Progress, mask: npt.ArrayLike | None = None
) -> Selection:
    """Find the features of a series at its key frames and gather the coreset for training.

    Args:
        series: the series.
        config: the settings.
        progress: called with each step of the work.
        mask: booleans (t, z, y, x) or (z, y, x), one more feature. It replaces 'all' where the
            settings name no other feature.

    Raises:
        InputError: the settings do not fit the series, or they select nothing.
    """
    brick = parse_brick(config.brick)
    scanned, key_frames, features = resolve_selection(series, config, progress, mask)
    with stage("coreset", "samples at the key frames, for the training"):
        coreset = build_coreset(
            series,
            scanned,
            FeatureChoice(key_frames, features, config.dilation),
            progress,
            fringe=config.samples != "published",
            brick=brick,
        )
        samples = coreset
        if config.samples == "all":
            times = KeyTimes(
                times=time_axis(series.coords["t"].values), key_frames=coreset.key_frames
            )
            value_range = scanned.value_range
            samples = with_steps_between(coreset, series, value_range, times, progress)
    architecture = Architecture.for_box(
        coreset.box.shape,
        len(key_frames),
        fold=config.model_fold,
        embedding_size=config.model_embedding_size,
        hidden_layers=config.hidden_layers,
        width=config.model_width,
    )
    return Selection(
        scanned=scanned,
        features=features,
        coreset=coreset,
        samples=samples,
        architecture=architecture,
    )


SPARSE_BELOW = 0.5
"""Share of samples in their box below which tables have needed vertices alone.

Sparse tables of a share of 0.52 take 0.58 of the memory of dense ones and 0.99 of the file, and a
point in them takes 1.7 times as long. At 0.22 these are 0.28, 0.97 and 1.7.
"""
RESERVE = 0.5
"""dB above a promised PSNR that a model should have before its tables are coded.

Without them the quantiser step would have to be so small that the file is far larger.
"""


WHOLE = ValueRange(0.0, 1.0)
"""Range of the coreset's values."""


@dataclass(frozen=True, kw_only=True)
class EncodedNetwork:
    """A network that is written.

    Attributes:
        header: complete, with the measured quality.
        checkpoint: to be removed once the file is complete.
        advice: what may help where the file misses its promise.
        rounding: difference between values of two readers at most, as a share of the range.
    """

    header: dict[str, Any]
    checkpoint: Path
    advice: str
    rounding: float


def encode_paper(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
    complete: Callable[[dict[str, Any]], dict[str, Any]],
) -> EncodedNetwork:
    """Train the published model on a series and write it.

    Args:
        writer: the container that is being written.
        series: the series.
        config: the settings.
        mask: one more feature, as in `select`.
        path: the output file, beside which the checkpoint of the training lies.
        progress: called with each step of the work.
        complete: measures what is written, and returns a header with its quality.
    """
    selection = select(series, config, progress, mask)
    coreset, value_range = selection.coreset, selection.scanned.value_range
    counted = coreset.values if coreset.fringe is None else coreset.values[~coreset.fringe]
    bulk = find_bulk(lambda: iter([counted]), WHOLE)
    if config.tables == "auto" or any(getattr(config, name) is not None for name in PAIR):
        about = WHOLE if value_range.low < value_range.high else value_range
        promised: dict[str, Any] = promise(config, about, bulk)
        config = replace(config, **promised)
    aim = _needed_psnr(config, bulk)
    goal = None
    if aim is not None:
        goal = Goal(psnr=aim + RESERVE, promised=aim, seconds=float(config.train_on_seconds))
    trained = train_model(selection.samples, selection.architecture, config, path, progress, goal)
    if aim is not None:  # the tables' numbers are about those of the training
        aim = _with_room(aim, _rounding(series, value_range, trained.rounding))
    coding = None
    if config.coded:
        with stage("tables", "coded at a loss that the promise allows"):
            coding = ModelCoding.of(
                selection.architecture, selection.samples, trained, aim, progress
            )
    with stage("writing", "coordinates, masks, tables, network and header"):
        described = write_series(writer, series, selection.scanned, coreset.key_frames)
    mark = writer.mark()
    while True:
        header = _written(writer, series, selection, trained, config, coding) | described
        header = complete(header)
        with writer.preview(header) as container:
            network = load_network(container)
            rounding = _rounding(series, value_range, network.rounding())
            if coding is None:
                break
            with stage("measuring", "loss of the coded tables"):
                loss = coding.loss(network)
        header["model"]["tables_loss_db"] = round(loss, 4)
        missing = loss - MAX_LOSS
        if coding.in_reach:
            missing = _missing_psnr(config, header["quality"], rounding, value_range)
        with stage("tables", "coded at a loss that the promise allows"):
            coding = coding.following(missing, loss, progress)
        if coding is None:
            break
        writer.rewind(mark)
    return EncodedNetwork(
        header=header,
        checkpoint=trained.checkpoint,
        advice=_advice(selection, series, trained, config, rounding),
        rounding=rounding,
    )


def _written(
    writer: ContainerWriter,
    series: Series,
    selection: Selection,
    trained: TrainedModel,
    config: EncodeConfig,
    coding: ModelCoding | None,
) -> dict[str, Any]:
    """Write tables and network; return the header without coordinates and quality."""
    coreset, architecture = selection.coreset, selection.architecture
    if coding is not None:
        with stage("writing", "tables"):
            coding.write(writer)
        vertices = parameter_count(architecture.levels, 1)
        header = _header(series, selection, trained, config, vertices)
        return header | {"required_features": ["transform"]}
    sparse = sparse_tables(coreset, config)
    with stage("writing", "tables"):
        vertices = write_tables(
            writer,
            architecture,
            coreset,
            trained.fine,
            trained.tables,
            number_type(config),
            sparse=sparse,
        )
        write_model(writer, coreset, trained.layers)
    header = _header(series, selection, trained, config, vertices)
    return header | {"required_features": [SPARSE_FEATURE]} if sparse else header


def _rounding(series: Series, value_range: ValueRange, rounding: float) -> float:
    """Return the largest difference of values of two readers, as a share of the range.

    rounding: that of the network's outputs; decoded values are rounded to their type once more.
    """
    width = value_range.high - value_range.low
    if not width:
        return 0.0
    spacing = np.spacing(decoded_type(series.dtype).type(max(map(abs, value_range.floats))))
    return rounding + float(spacing) / width


def _with_room(aim: float, rounding: float) -> float:
    """Return the PSNR in dB at which every reader has `aim`; `aim` where none is enough."""
    error = 10 ** (-aim / 20) - rounding
    return -20 * log10(error) if error > 0 else aim


def _missing_psnr(
    config: EncodeConfig, quality: Mapping[str, Any], rounding: float, value_range: ValueRange
) -> float:
    """Return the dB that a file is short of its promises; below 0 what it has beyond them."""
    short = []
    if config.psnr is not None:
        short.append(config.psnr - held_psnr(quality["psnr"], rounding))
    if config.psnr_bulk is not None and quality["bulk"] is not None:
        low, high = quality["bulk"]["range"]
        of_bulk = rounding * (value_range.high - value_range.low) / (high - low)
        short.append(config.psnr_bulk - held_psnr(quality["bulk"]["psnr"], of_bulk))
    return max(short, default=0.0)


def number_type(config: EncodeConfig) -> str:
    """Return the type of the numbers of tables, as the header's `model.tables`."""
    if config.coded:
        return "transform"
    return "float16" if config.tables in ("sparse", "dense") else config.tables


def sparse_tables(coreset: Coreset, config: EncodeConfig) -> bool:
    """Return whether the file gets the embeddings of needed vertices alone.

    By default it does where the samples are fewer than SPARSE_BELOW of the vertices of their box.
    """
    if config.coded or config.tables in ("sparse", "dense"):
        return config.tables == "sparse"
    vertices = len(coreset.key_frames) * prod(coreset.box.shape)
    return len(coreset.values) < SPARSE_BELOW * vertices


def _advice(
    selection: Selection,
    series: Series,
    trained: TrainedModel,
    config: EncodeConfig,
    rounding: float,
) -> str:
    """Return what may help where the file misses its promise, as a sentence without a full stop."""
    if config.psnr is not None and held_psnr(None, rounding) < config.psnr:
        return (
            f"No network of these numbers has more than {held_psnr(None, rounding):.1f} dB in "
            "every reader, since float32 rounds otherwise in each: leave --preset out"
        )
    if trained.limited:
        return (
            f"Training ended at its limit of --train-on-seconds {config.train_on_seconds}: "
            "more may help"
        )
    if config.epochs:
        return f"--epochs {config.epochs} ended the training; without, it goes on for the promise"
    if len(selection.coreset.key_frames) < series.shape[0]:
        return "The promise is about all steps: more --key-frames may help"
    return "More --epochs may help"


def _needed_psnr(config: EncodeConfig, bulk: ValueRange | None) -> float | None:
    """Return the PSNR in dB that coded tables need over the samples for the promises, if any.

    Within the bulk it counts in the range of that; errors are taken to be alike everywhere.

    bulk: of the samples.
    """
    needed = [] if config.psnr is None else [config.psnr]
    if config.psnr_bulk is not None and bulk is not None:
        needed.append(whole_psnr(config.psnr_bulk, bulk, 1.0))
    return max(needed) if needed and config.coded else None


def _header(
    series: Series,
    selection: Selection,
    trained: TrainedModel,
    config: EncodeConfig,
    vertices: int,
) -> dict[str, Any]:
    """Return the container's header (FORMAT.md, Header), without its quality.

    `vertices` is the number of vertices of all tables in the file.
    """
    architecture, coreset = selection.architecture, selection.coreset
    kept = CORESET if coreset.fringe is None else FRINGE
    seconds = trained.history[-1]["seconds"] if trained.history else 0.0
    restarts = (
        {"restarts": trained.restarts, "learning_rate": trained.learning_rate}
        if trained.restarts
        else {}
    )
    return {
        **describe_source(series, selection.scanned.value_range, config),
        "background": coreset.background,
        "feature_bounding_box": [list(span) for span in coreset.box],
        "features": [str(feature) for feature in selection.features],
        "coreset_fraction": coreset.fraction,
        "model": {
            "profile": PAPER,
            "fold": config.model_fold,
            "embedding_size": architecture.embedding_size,
            "hidden_layers": architecture.hidden_layers,
            "width": architecture.width,
            "tables": number_type(config),
            "levels": [list(level) for level in architecture.levels],
            "parameters": architecture.parameters_of(vertices),
            **({SPARSE: kept} if sparse_tables(coreset, config) else {}),
        },
        "config": config.settings(),
        "training": {
            "seconds": seconds if config.timings else None,
            "steps": trained.steps,
            "epochs": trained.epochs,
            "device": trained.device,
            **trained.engine,
            **restarts,
        },
        "history": brief_history(trained.history) if config.timings else {},
    }
