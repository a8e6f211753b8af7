"""Figures of a container as JSON values, the same from `encode` and from `diff`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fhash_codec.volume import Volume

FIGURES = ("psnr", "rmse", "max_abs_error", "ssim", "psnr_domain")
"""Figures of a quality that a report has at its top level, beside all of them in `quality`."""


def report(
    volume: Volume, quality: dict[str, Any], *, seconds: float, files: Iterable[Path] = ()
) -> dict[str, Any]:
    """Sizes, quality and training of a container, as JSON values.

    quality: `metrics.Quality` as JSON values. seconds: duration of the whole job. files: files and
    folders that the series was read from.

    Of the values returned:
        bytes, raw_bytes: of the whole file, and of the series in its own number type.
        ratio: raw_bytes / bytes.
        source_bytes, source_ratio: of the files that were read, as they lie on disk, and their
            ratio to `bytes`; None where there are no files.
        psnr, rmse, max_abs_error, ssim: over the coreset of all steps, those between key frames
            included; in dB and data units. None if the error or the range is 0.
        psnr_bulk: over the vertices of the coreset whose original value lies in the bulk, the range
            of the middle 98 % of its values, relative to the width of that range. None without a
            bulk, or if the error is 0.
        psnr_domain: over every finite vertex, with the background outside the coreset.
        curve: the training history.
        restarts: how often the training diverged and began again at a quarter of the learning rate.
        tables_loss_db: dB that coded tables lose at the key frames; None for other tables.
    """
    info = volume.info
    device = info["training"]["device"]
    source = bytes_on_disk(files)
    return {
        "path": str(volume.path),
        "bytes": info["bytes"],
        "raw_bytes": info["raw_bytes"],
        "ratio": info["ratio"],
        "source_bytes": source,
        "source_ratio": None if source is None else source / info["bytes"],
        **{name: quality[name] for name in FIGURES},
        "psnr_bulk": None if quality["bulk"] is None else quality["bulk"]["psnr"],
        "seconds": seconds,
        "epochs": info["training"]["epochs"],
        "curve": info["history"],
        "shape": info["domain"]["shape"],
        "key_frames": info["key_frames"],
        "feature_bounding_box": info["feature_bounding_box"],
        "coreset_fraction": info["coreset_fraction"],
        "data_range": volume.value_range.high - volume.value_range.low,
        "parameters": info["model"]["parameters"],
        "profile": info["model"]["profile"],
        "tables_loss_db": info["model"].get("tables_loss_db"),
        # What is not trained is computed on the CPU.
        "device": "cpu" if device == "none" else device,
        "restarts": info["training"].get("restarts", 0),
        "gains": info["model"].get("gains", []),
        "quality": quality,
    }


def bytes_on_disk(paths: Iterable[Path]) -> int | None:
    """Bytes of files, and of all files below folders; None without any, or if one is gone."""
    total, found = 0, False
    try:
        for path in paths:
            found = True
            if not path.is_dir():
                total += path.stat().st_size
                continue
            for folder, _, names in os.walk(path):
                total += sum(os.stat(os.path.join(folder, name)).st_size for name in names)
    except OSError:
        return None
    return total if found else None
