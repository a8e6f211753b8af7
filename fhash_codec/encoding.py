"""Encoding: series -> coreset -> trained model -> container."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.encoder import (
    code_series,
    compact_header,
    promise,
    required_features,
    write_table,
)
from fhash_codec.comparison import measure
from fhash_codec.config import EncodeConfig
from fhash_codec.normalise import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.report import brief_history, brief_quality, report
from fhash_codec.scan import Scan
from fhash_codec.selection import Selection, Source, find, opened, select
from fhash_codec.storage import write_model, write_tables
from fhash_codec.trained import Trained, train_model
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats import native
from fhash_formats.container import ContainerWriter, describe_coordinates
from fhash_formats.errors import FhashWarning, InputError, QualityError
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
        masks = [
            feature.removeprefix("mask:")
            for feature in config.features
            if feature.startswith("mask:")
        ]
        check_output(path, force, sources=[*series.files, *masks])
        with ContainerWriter(path, force=force) as writer:
            fill = _compact if config.profile == "compact" else _paper
            header, checkpoint = fill(writer, series, config, mask, path, progress)
            with Volume(writer.preview(header)) as volume:
                quality = measure(series, volume, progress)
            header["quality"] = brief_quality(quality)
            writer.commit(header)
        if checkpoint is not None:
            checkpoint.unlink(missing_ok=True)
    with open_volume(path) as volume:
        figures = report(volume, quality, seconds=time.perf_counter() - begun)
    _check_promise(path, config, figures)
    return figures


def _paper(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
) -> tuple[dict[str, Any], Path | None]:
    """Train the published model and write it; the header without its quality, and the checkpoint to be removed."""
    selected = select(series, config, progress, mask)
    trained = train_model(selected.coreset, selected.architecture, config, path, progress)
    architecture, coreset = selected.architecture, selected.coreset
    loss = None
    write_series(writer, series, selected.scanned, coreset.key_frames)
    if config.tables == "transform":
        from fhash_codec.coded.search import write_coded

        # A promise counts every step; what is between key frames this search does not see.
        psnr = config.psnr if len(coreset.key_frames) == series.shape[0] else None
        loss = write_coded(
            writer,
            architecture,
            coreset,
            trained.fine,
            trained.tables,
            trained.layers,
            psnr,
            progress,
        )
    else:
        write_tables(writer, architecture, coreset, trained.fine, trained.tables, config.tables)
    write_model(writer, architecture, coreset, trained.layers)
    header = _header(series, selected, trained, config)
    if loss is not None:
        header["required_features"] = ["transform"]
        header["model"]["tables_loss_db"] = round(loss, 4)
    return header, trained.checkpoint


def _compact(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
) -> tuple[dict[str, Any], Path | None]:
    """Code the lattice values and write them; the header without its quality."""
    if native.library() is None:
        warnings.warn(
            "the native core is not there (no compiler at installation?): coding takes 2 to 3 times as long with numba, "
            "some 1000 times as long without; the bytes are the same",
            FhashWarning,
            stacklevel=3,
        )
    begun = time.perf_counter()
    found = find(series, config, progress, mask)
    table = code_series(series, found, config, progress)
    described = write_series(writer, series, found.scanned, found.extent.key_frames, brief=True)
    write_table(writer, table)
    planned = table.planned
    seconds = round(time.perf_counter() - begun, 3) if config.timings else None
    training = {"seconds": seconds, "epochs": 0, "device": "cpu"}
    history = brief_history(planned.history, timings=config.timings)
    defaults = EncodeConfig().to_dict()
    header = {
        **_described(series, found.scanned.value_range, config),
        **described,
        "required_features": required_features(table),
        "background": found.extent.background,
        "feature_bounding_box": [list(span) for span in found.extent.box],
        "features": [str(feature) for feature in found.features],
        "coreset_fraction": found.extent.fraction,
        "model": compact_header(table, config),
        "config": {
            name: value for name, value in config.to_dict().items() if value != defaults[name]
        }
        | promise(config),
        "training": training,
        "history": {
            name: [point.get(name) for point in history] for name in (history[0] if history else ())
        },
    }
    return header, None


def _described(series: Series, value_range: ValueRange, config: EncodeConfig) -> dict[str, Any]:
    """What the headers of both profiles say of the series."""
    return {
        "encoder": {"version": version("fhash"), "seed": config.seed},
        "variable": {
            "name": series.name,
            "units": series.units,
            "dtype": series.dtype.name,
            "attributes": dict(series.attributes),
        },
        "domain": {"shape": list(series.shape)},
        "value_range": [value_range.low, value_range.high],
        "dilation": config.dilation,
        "quality": {},
    }


def _check_promise(path: Path, config: EncodeConfig, figures: dict[str, Any]) -> None:
    """Raise QualityError where the written file does not keep what was promised."""
    psnr, largest = figures["psnr"], figures["max_abs_error"]
    asked, found = "", ""
    wanted = (
        promise(config)
        if config.profile == "compact"
        else {}
        if config.psnr is None
        else {"psnr": config.psnr}
    )
    if "psnr" in wanted and figures["rmse"] != 0 and (psnr is None or psnr < wanted["psnr"]):
        asked, found = (
            f"{wanted['psnr']:g} dB were",
            "an unknown PSNR" if psnr is None else f"{psnr:.2f} dB over the coreset",
        )
    bound = wanted.get("max_error", math.inf)
    if "max_error_rel" in wanted:
        bound = wanted["max_error_rel"] * figures["data_range"]
    if largest is not None and largest > bound:
        asked, found = f"at most {bound:g} was", f"a largest error of {largest:g}"
    if asked:
        more = "" if config.profile == "compact" else ". More --epochs may help"
        raise QualityError(
            f"{path}: {found}, {asked} asked for; the file is written{more}", figures
        )


def check_name(path: Path) -> None:
    """Refuse to give a container the name of another kind of file (InputError): most often it is that of the data."""
    if path.suffix.lower() in (suffix for writer in WRITERS for suffix in writer.suffixes):
        raise InputError(
            f"{path}: a container is not a {path.suffix} file; give it a name that ends in .fhz"
        )


MISSING_CHUNK_BYTES = 1 << 20  # a member of its own for each step would cost 130 bytes a step


def write_series(
    writer: ContainerWriter,
    series: Series,
    scanned: Scan,
    key_frames: Sequence[int],
    *,
    brief: bool = False,
) -> dict[str, Any]:
    """Coordinates, key frames, and where the source has no finite value; what the header has to say of them.

    brief: only what the header cannot say in fewer bytes, as the profile compact allows.
    """
    steps = series.shape[0]
    described = describe_coordinates(series.coords) if brief else {}
    for axis, stored in AXIS_NAMES.items():
        if stored not in described:
            coordinate = series.coords[axis]
            writer.add_whole(
                f"coords/{stored}",
                coordinate.values,
                attributes={**coordinate.attributes, "name": coordinate.name},
            )
    if not brief or len(key_frames) < steps:
        writer.add_whole("key_frames", np.array(key_frames, dtype=np.int64))
    if scanned.missing:
        empty = np.zeros(-(-prod(series.shape[1:]) // 8), dtype=np.uint8)
        rows = max(1, min(steps, MISSING_CHUNK_BYTES // empty.size))
        writer.add_array(
            "missing/bits",
            shape=(steps, empty.size),
            dtype=empty.dtype,
            chunk_shape=(rows, empty.size),
            chunks=(
                np.stack(
                    [
                        scanned.missing.get(step, empty)
                        for step in range(start, min(start + rows, steps))
                    ]
                )
                for start in range(0, steps, rows)
            ),
        )
    return {"coordinates": described} if brief else {}


def _header(
    series: Series, selected: Selection, trained: Trained, config: EncodeConfig
) -> dict[str, Any]:
    """The container's header (FORMAT.md), its quality still to be measured."""
    architecture, coreset, value_range = (
        selected.architecture,
        selected.coreset,
        selected.scanned.value_range,
    )
    seconds = trained.history[-1]["seconds"] if trained.history else 0.0
    return {
        **_described(series, value_range, config),
        "background": coreset.background,
        "feature_bounding_box": [list(span) for span in coreset.box],
        "features": [str(feature) for feature in selected.features],
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
        "training": {
            "seconds": seconds if config.timings else None,
            "epochs": trained.epochs,
            "device": trained.device,
            **(
                {"restarts": trained.restarts, "learning_rate": trained.learning_rate}
                if trained.restarts
                else {}
            ),
        },
        "history": brief_history(trained.history, timings=config.timings),
    }
