"""Encoding: series -> coreset -> trained model -> container."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.encode import encode_compact
from fhash_codec.compact.goal import promise
from fhash_codec.comparison import measure
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import Source, open_source
from fhash_codec.header import brief_quality
from fhash_codec.paper.encode import encode_paper
from fhash_codec.progress import Progress, silent
from fhash_codec.report import report
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import InputError, QualityError
from fhash_formats.support.atomic import check_output
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
    with open_source(source) as series:
        masks = [
            feature.removeprefix("mask:")
            for feature in config.features
            if feature.startswith("mask:")
        ]
        check_output(path, force, sources=[*series.files, *masks])
        with ContainerWriter(path, force=force) as writer:
            checkpoint = None
            if config.profile == "compact":
                header = encode_compact(writer, series, config, mask, progress)
            else:
                header, checkpoint = encode_paper(writer, series, config, mask, path, progress)
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
