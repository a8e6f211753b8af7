"""The figures of a container, the same from `encode` and from `diff`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fhash_codec.volume import Volume


def report(volume: Volume, quality: dict[str, Any], *, seconds: float) -> dict[str, Any]:
    """JSON values: sizes in bytes, quality in dB and data units (None where the error or the range is 0), how it was trained.

    ratio: raw bytes / bytes of the whole file. psnr, rmse, max_abs_error, ssim: over the coreset of all steps, also those between key
    frames; *_domain: over every finite vertex, the background standing outside the coreset. curve: the training history.
    restarts: how often the training diverged and began again at a quarter of the learning rate.
    tables_loss_db: what coded tables cost at the key frames, None for others.
    seconds: of the whole job that was reported on.
    """
    info = volume.info
    return {
        "path": str(volume.path),
        "bytes": info["bytes"],
        "raw_bytes": info["raw_bytes"],
        "ratio": info["ratio"],
        **{
            name: quality[name] for name in ("psnr", "rmse", "max_abs_error", "ssim", "psnr_domain")
        },
        "seconds": seconds,
        "epochs": info["training"]["epochs"],
        "curve": curve(info["history"]),
        "shape": info["domain"]["shape"],
        "key_frames": info["key_frames"],
        "feature_bounding_box": info["feature_bounding_box"],
        "coreset_fraction": info["coreset_fraction"],
        "data_range": volume.value_range.high - volume.value_range.low,
        "parameters": info["model"]["parameters"],
        "profile": info["model"]["profile"],
        "tables_loss_db": info["model"].get("tables_loss_db"),
        "device": info["training"]["device"],
        "restarts": info["training"].get("restarts", 0),
        "gains": info["model"].get("gains", []),
        "quality": quality,
    }


def curve(
    history: Sequence[Mapping[str, Any]] | Mapping[str, Sequence[Any]],
) -> list[dict[str, Any]]:
    """The points of a header's history, in either of its forms, each with seconds, epoch and psnr."""
    if isinstance(history, Mapping):
        history = [
            dict(zip(history, point, strict=True)) for point in zip(*history.values(), strict=True)
        ]
    return [{"seconds": None, "psnr": None, **point} for point in history]
