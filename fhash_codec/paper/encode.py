"""Encoding in the profile paper: selection, training, tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf, isinf, log10, prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.features.bricks import Coreset, build_coreset, parse_brick, with_steps_between
from fhash_codec.features.features import Feature, FeatureChoice
from fhash_codec.features.key_frames import KeyTimes, time_axis
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import resolve_selection
from fhash_codec.header import brief_history, describe_source, write_series
from fhash_codec.measure.value_range import ValueRange, decoded_type
from fhash_codec.paper.fit import Goal, TrainedModel, train_model
from fhash_codec.paper.network import Architecture, parameter_count
from fhash_codec.paper.storage import write_model, write_tables
from fhash_codec.progress import Progress, stage
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import CORESET, FRINGE, SPARSE, SPARSE_FEATURE
from fhash_formats.errors import InputError
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
BOUND_SHARE = 1.0
"""Root mean square of the error that coded tables should have, as a share of a promised bound.

The finer the tables, the more bytes: those of isabel within 1 % grow by 2 % at 0.6.
"""
BOUND_LOSS = 3.0
"""dB that coding may cost a network which has not learned as much, since the residual has it."""
RESERVE = 0.5
"""dB above a promised PSNR that a model should have before its tables are coded.

Without them the quantiser step would have to be so small that the file is far larger.
"""


WRITINGS = 3
"""Times that coded tables are written at most until the file keeps its promise."""
BULK = (0.01, 0.99)
"""Ends of the bulk, as shares of the values (`measure.errors.find_bulk`)."""
SMALLEST_BULK = 1e-6
"""Range of the bulk at least that a promise about it is kept for, as a share of all values'."""
ROUNDINGS = 2.0
"""Spacings of the largest value that decoded values may be rounded by, at most."""
EXCESS = 0.1
"""dB above a promise for which coded tables are written once more."""
NEAR = 0.01
"""dB above a promise at which they aim then."""


def encode_paper(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
    complete: Callable[[dict[str, Any]], dict[str, Any]],
) -> tuple[dict[str, Any], Path | None, str]:
    """Train the published model on a series and write it.

    Args:
        writer: the container that is being written.
        series: the series.
        config: the settings.
        mask: one more feature, as in `select`.
        path: the output file, beside which the checkpoint of the training lies.
        progress: called with each step of the work.
        complete: measures what is written, and returns a header with its quality.

    Returns:
        The header, the checkpoint to remove once the file is complete, and what may help where the
        file misses its promise.
    """
    selection = select(series, config, progress, mask)
    coreset = selection.coreset
    bound = coded_bound(config, series, selection.scanned.value_range)
    aim = _needed_psnr(selection, config, bound)
    goal = None
    if aim is not None and bound is None:
        goal = Goal(psnr=aim + RESERVE, promised=aim, seconds=float(config.train_on_seconds))
    trained = train_model(selection.samples, selection.architecture, config, path, progress, goal)
    with stage("writing", "coordinates, masks, tables, network and header"):
        described = write_series(writer, series, selection.scanned, coreset.key_frames)
    mark = writer.mark()
    for writing in range(WRITINGS):
        if writing:
            writer.rewind(mark)
        header = _written(writer, series, selection, trained, config, aim, progress) | described
        header = complete(header)
        missing = _missing_psnr(config, header["quality"])
        if aim is None or isinf(missing) or (missing <= 0 and (writing or missing > -EXCESS)):
            break
        if missing > 0 and trained.psnr is not None and trained.psnr < aim + missing:
            break  # no coding of this model keeps it
        aim += missing + NEAR
    return header, trained.checkpoint, _advice(selection, series, trained, config)


def _written(
    writer: ContainerWriter,
    series: Series,
    selection: Selection,
    trained: TrainedModel,
    config: EncodeConfig,
    aim: float | None,
    progress: Progress,
) -> dict[str, Any]:
    """Write tables and network; return the header without coordinates and quality.

    aim: PSNR in dB of the samples that coded tables should have, if any.
    """
    coreset, architecture = selection.coreset, selection.architecture
    if config.coded:
        # No other tables need this module.
        from fhash_codec.paper.table_step import MAX_LOSS, Target, write_coded

        with stage("tables", "coded at a loss that the promise allows"):
            target = Target(psnr=aim, loss=BOUND_LOSS if config.bounded else MAX_LOSS)
            loss = write_coded(writer, architecture, selection.samples, trained, target, progress)
        vertices = parameter_count(architecture.levels, 1)
        header = _header(series, selection, trained, config, vertices)
        header["required_features"] = ["transform"]
        header["model"]["tables_loss_db"] = round(loss, 4)
        return header
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


def coded_bound(config: EncodeConfig, series: Series, value_range: ValueRange) -> float | None:
    """Return the bound, in data units, that what the network lacks is coded within, if any.

    It is the promised one less what the rounding of decoded values may add.

    Raises InputError for one that rounding takes half of.
    """
    bound = config.max_error
    if config.max_error_rel is not None:
        bound = config.max_error_rel * (value_range.high - value_range.low)
    if bound is None or value_range.low == value_range.high:
        return None  # a range of one value decodes to it
    spacing = np.finfo(decoded_type(series.dtype)).eps
    rounding = ROUNDINGS * float(spacing) * max(map(abs, value_range.floats))
    if bound <= 2 * rounding:
        raise InputError(
            f"{series.source}: an error of {bound:g} is within {2 * rounding:.2g}, to which the "
            "network's values are rounded; --profile lattice keeps it"
        )
    return bound - rounding


def _missing_psnr(config: EncodeConfig, quality: Mapping[str, Any]) -> float:
    """Return the dB that a file is short of its promises; below 0 what it has beyond them."""
    found = [(config.psnr, quality["psnr"])]
    if quality["bulk"] is not None:
        found.append((config.psnr_bulk, quality["bulk"]["psnr"]))
    # Where there is no error there is no PSNR.
    short = [
        promised - (inf if psnr is None else psnr)
        for promised, psnr in found
        if promised is not None
    ]
    return max(short, default=0.0)


def number_type(config: EncodeConfig) -> str:
    """Return the type of the numbers of tables, as the header's `model.tables`."""
    if config.coded:
        return "transform"
    return "float16" if config.tables in ("auto", "sparse", "dense") else config.tables


def sparse_tables(coreset: Coreset, config: EncodeConfig) -> bool:
    """Return whether the file gets the embeddings of needed vertices alone.

    By default it does where the samples are fewer than SPARSE_BELOW of the vertices of their box.
    """
    if config.coded or config.tables in ("sparse", "dense"):
        return config.tables == "sparse"
    vertices = len(coreset.key_frames) * prod(coreset.box.shape)
    return len(coreset.values) < SPARSE_BELOW * vertices


def _advice(
    selection: Selection, series: Series, trained: TrainedModel, config: EncodeConfig
) -> str:
    """Return what may help where the file misses its promise, as a sentence without a full stop."""
    if trained.limited:
        return (
            f"Training ended at its limit of --train-on-seconds {config.train_on_seconds}: "
            "more may help"
        )
    if len(selection.coreset.key_frames) < series.shape[0]:
        return "The promise is about all steps: more --key-frames may help"
    return "More --epochs may help"


def _needed_psnr(selection: Selection, config: EncodeConfig, bound: float | None) -> float | None:
    """Return the PSNR in dB that coded tables need over the samples for the promises, if any.

    Within the bulk it counts in the range of that; errors are taken to be alike everywhere.

    bound: of the error in data units, if one is promised.
    """
    needed = [] if config.psnr is None else [config.psnr]
    low, high = selection.scanned.value_range.floats
    if bound is not None and high > low:
        needed.append(-20 * log10(BOUND_SHARE * bound / (high - low)))
    if config.psnr_bulk is not None:
        coreset = selection.coreset
        counted = coreset.values if coreset.fringe is None else coreset.values[~coreset.fringe]
        low, high = np.quantile(counted, BULK)
        needed.append(config.psnr_bulk - 20 * log10(max(high - low, SMALLEST_BULK)))
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
            "profile": config.profile,
            "fold": config.model_fold,
            "embedding_size": architecture.embedding_size,
            "hidden_layers": architecture.hidden_layers,
            "width": architecture.width,
            "tables": number_type(config),
            "levels": [list(level) for level in architecture.levels],
            "parameters": architecture.parameters_of(vertices),
            **({SPARSE: kept} if sparse_tables(coreset, config) else {}),
        },
        "config": config.to_dict(),
        "training": {
            "seconds": seconds if config.timings else None,
            "steps": trained.steps,
            "epochs": trained.epochs,
            "device": trained.device,
            **trained.engine,
            **restarts,
        },
        "history": brief_history(trained.history, timings=config.timings),
    }
