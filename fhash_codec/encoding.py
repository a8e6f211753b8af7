"""Encoding: a series in, a container out, whose quality is measured on the file as it decodes."""

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
from fhash_codec.training.devices import need_torch
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import InputError, QualityError
from fhash_formats.support.atomic import check_output

DATA_SUFFIXES = frozenset(
    (".npy", ".h5", ".hdf5", ".nc", ".nc4", ".zarr", ".raw", ".vti", ".vtr", ".pvd", ".vtkhdf")
)
"""Suffixes of the data files that `fhash decode` writes. No container may have one of them."""


def encode(
    source: Source,
    path: str | Path,
    config: EncodeConfig | None = None,
    *,
    mask: npt.ArrayLike | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode a series into the container `path`, complete or not at all.

    source: a file (opened by `fhash_formats.open_series`), a Series, or an array (t, z, y, x) or
        (z, y, x), labelled or not.
    config: the settings; the defaults if None.
    mask: booleans (t, z, y, x) or (z, y, x), one more feature. It is the only feature if the
        settings name none.
    force: replace a file that exists.

    Returns the figures of the written file (see `report`). Ctrl-C during the training saves a
    checkpoint beside `path` and raises InterruptedEncodingError; the same call then continues from
    the checkpoint to the same result. Raises InputError for a source or settings that cannot be
    encoded, and MissingDependencyError for the profile paper without torch. Raises QualityError,
    with the file written and its figures in the error, if the file misses what the settings
    promise.
    """
    config, path = config or EncodeConfig(), Path(os.path.normpath(path))
    begun = time.perf_counter()
    check_name(path)
    check_output(path, force)
    if config.profile == "paper":
        need_torch("profile paper")
    with open_source(source) as series:
        check_output(path, force, sources=[*series.files, *_mask_files(config)])
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


def check_name(path: Path) -> None:
    """Raise InputError for a container named like a data file: most often the source itself."""
    if path.suffix.lower() in DATA_SUFFIXES:
        raise InputError(
            f"{path}: a container is not a {path.suffix} file; give it a name that ends in .fhz"
        )


def _mask_files(config: EncodeConfig) -> list[str]:
    """Paths of the masks among the features."""
    prefix = "mask:"
    return [text.removeprefix(prefix) for text in config.features if text.startswith(prefix)]


def _check_promise(path: Path, config: EncodeConfig, figures: dict[str, Any]) -> None:
    """Raise QualityError if the written file misses what the settings promise."""
    missed = _missed_bound(config, figures) or _missed_psnr(config, figures)
    if missed is not None:
        advice = "" if config.profile == "compact" else ". More --epochs may help"
        raise QualityError(f"{path}: {missed}; the file is written{advice}", figures)


def _missed_psnr(config: EncodeConfig, figures: dict[str, Any]) -> str | None:
    """Text on a PSNR below the promised one; None if there is no such promise or it holds."""
    promised = promise(config).get("psnr") if config.profile == "compact" else config.psnr
    if promised is None or figures["rmse"] == 0:
        return None
    psnr = figures["psnr"]
    if psnr is None:
        return f"an unknown PSNR, {promised:g} dB were asked for"
    if psnr < promised:
        return f"{psnr:.2f} dB over the coreset, {promised:g} dB were asked for"
    return None


def _missed_bound(config: EncodeConfig, figures: dict[str, Any]) -> str | None:
    """Text on an error beyond the promised bound; None if there is no such promise or it holds."""
    bound = math.inf
    if config.max_error is not None:
        bound = config.max_error
    elif config.max_error_rel is not None:
        bound = config.max_error_rel * figures["data_range"]
    largest = figures["max_abs_error"]
    if largest is not None and largest > bound:
        return f"a largest error of {largest:g}, at most {bound:g} was asked for"
    return None
