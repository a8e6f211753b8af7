"""The lean form of a compact file's header (FORMAT.md, Lean headers), and the full form of it.

In a small file the header costs as much as the coefficients. The lean form leaves out what follows
from the rest, and rounds the figures of single steps to hundredths of a dB.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import ROUND_CEILING, Context
from typing import Any, TypeGuard

__all__ = ["CONFIG_DEFAULTS", "full", "lean", "may_be_lean"]

LEAN_SINCE = (1, 5)
"""(major, minor) of the first format whose headers may be lean."""
COMPACT = "compact"
"""Profile whose headers are lean."""

CONFIG_DEFAULTS: dict[str, Any] = {
    "access": "balanced",
    "batch": 0,
    "brick": "auto",
    "device": "auto",
    "dilation": 1,
    "effort": 5,
    "embedding_size": 0,
    "engine": "auto",
    "epochs": 0,
    "features": ["all"],
    "fold": 0,
    "fringe": "trained",
    "hidden_layers": 2,
    "key_frames": "all",
    "learning_rate": 0.01,
    "max_error": None,
    "max_error_rel": None,
    "profile": "compact",
    "psnr": None,
    "psnr_bulk": None,
    "ratio": None,
    "schedule": "cosine",
    "seed": 0,
    "tables": "float16",
    "tile": "auto",
    "timings": True,
    "train_on_seconds": 3600,
    "width": 0,
    "without": [],
}
"""Values of the settings that a lean header leaves out. They belong to the format: a default of the
encoder that changes is from then on written."""

SSIM_WINDOW = {"window": 11, "sigma": 1.5}
"""Window and sigma of the SSIM, in vertices, that a lean header leaves out."""
STEP_FIGURES = ("rmse", "max_abs_error")
"""Figures of a step that a lean header keeps; the PSNR follows."""
DOMAIN_FIGURES = ("psnr", "rmse", "max_abs_error")
"""Figures that a lean header leaves out for the domain where the coreset has the same."""
DOMAIN = "_domain"
"""Suffix of the figures over all vertices."""
HUNDREDTHS = 2000
"""Hundredths of a dB of a factor of ten."""
EXACT = -1
"""Number in place of the decibels of a figure that is 0."""
GAIN = ("what", "bytes", "seconds")
"""Entries of a list in `gains`, in this order."""
DIGITS = 5
"""Significant digits of a figure that comes back from decibels."""


def lean(header: Mapping[str, Any]) -> dict[str, Any]:
    """The lean form of a compact file's header; `full` gives it back, figures of steps rounded."""
    config, quality, model = header["config"], dict(header["quality"]), dict(header["model"])
    kept = {
        name: value
        for name, value in config.items()
        if name not in CONFIG_DEFAULTS or value != CONFIG_DEFAULTS[name]
    }
    low, high = header["value_range"]
    steps = _lean_steps(quality.get("per_step"), high - low)
    if steps is not None:
        del quality["per_step"]
        quality["steps"] = steps
    for name in DOMAIN_FIGURES:
        if name in quality and quality.get(name + DOMAIN, math.nan) == quality[name]:
            del quality[name + DOMAIN]
    window = quality.get("ssim_window")
    if isinstance(window, Mapping):
        quality["ssim_window"] = {
            name: value
            for name, value in window.items()
            if name not in SSIM_WINDOW or value != SSIM_WINDOW[name]
        }
        if not quality["ssim_window"]:
            del quality["ssim_window"]
    model["gains"] = [
        [gain[name] for name in GAIN if name in gain] for gain in model.get("gains", ())
    ]
    return {**header, "config": kept, "quality": quality, "model": model}


def may_be_lean(header: Mapping[str, Any]) -> bool:
    """Whether a header is one of the profile compact in a format that has lean headers."""
    version, model = header.get("format_version", (0, 0)), header.get("model", {})
    return tuple(version) >= LEAN_SINCE and model.get("profile") == COMPACT


def full(header: Mapping[str, Any]) -> dict[str, Any]:
    """A header in its full form, whatever the file has. What another writer misshaped is left out.

    Headers of the profile paper and of earlier formats are returned as they are.
    """
    if not may_be_lean(header):
        return dict(header)
    model = header["model"]
    quality = dict(header.get("quality", {}))
    low, high = header.get("value_range", (0.0, 0.0))
    if "steps" in quality:
        steps = _full_steps(quality.pop("steps"), high - low, quality.get("max_abs_error"))
        quality["per_step"] = steps
    for name in DOMAIN_FIGURES:
        if name in quality:
            quality.setdefault(name + DOMAIN, quality[name])
    if "psnr" in quality:
        window = quality.get("ssim_window", {})
        if isinstance(window, Mapping):
            quality["ssim_window"] = {**SSIM_WINDOW, **window}
    result = {**header, "quality": quality}
    if "gains" in model:
        result["model"] = {**model, "gains": _full_gains(model["gains"])}
    return result


def _lean_steps(per_step: Any, data_range: float) -> dict[str, list[int | None]] | None:
    """Figures of steps as whole hundredths of a dB below the range; None where that cannot be.

    The first number of each list is the smallest; the others are counted from it.
    """
    if not isinstance(per_step, Mapping) or data_range <= 0:
        return None
    result: dict[str, list[int | None]] = {}
    for name in STEP_FIGURES:
        shares = [None if value is None else value / data_range for value in per_step[name]]
        if any(share is not None and not math.isfinite(share) for share in shares):
            return None
        levels = [
            math.floor(-HUNDREDTHS * math.log10(share)) if share else None for share in shares
        ]
        lowest = min((level for level in levels if level is not None), default=0)
        result[name] = [lowest]
        for share, level in zip(shares, levels, strict=True):
            exact = None if share is None else EXACT
            result[name].append(exact if level is None else level - lowest)
    return result


def _full_steps(
    steps: Any, data_range: float, largest: float | None
) -> dict[str, list[float | None]]:
    """Figures of steps as lists by name, from decibels; an empty object for misshapen ones.

    largest: the largest error of all steps, which rounding must not pass.
    """
    if not isinstance(steps, Mapping) or data_range <= 0:
        return {}
    lists = {name: steps.get(name) for name in STEP_FIGURES}
    result: dict[str, list[float | None]] = {}
    for name, levels in lists.items():
        if not _is_list_of_levels(levels):
            return {}
        lowest, *others = levels
        limit = largest if name == "max_abs_error" and isinstance(largest, int | float) else None
        result[name] = [_figure(lowest, level, data_range, limit) for level in others]
    return result


def _is_list_of_levels(levels: Any) -> TypeGuard[list[Any]]:
    """Whether a value is a list of whole numbers or null, the first one no null."""
    return (
        isinstance(levels, list)
        and len(levels) > 0
        and levels[0] is not None
        and all(level is None or (type(level) is int and abs(level) < 10**7) for level in levels)
    )


def _figure(lowest: int, level: int | None, data_range: float, limit: float | None) -> float | None:
    """The figure that is so many hundredths of a dB below a range, rounded up."""
    if level is None:
        return None
    if level == EXACT:
        return 0.0
    exponent = math.log10(data_range) - (lowest + level) / HUNDREDTHS
    if not -300 < exponent < 300:
        return None
    value = math.pow(10.0, exponent)
    if limit is not None and value >= limit:
        return float(limit)
    context = Context(prec=DIGITS, rounding=ROUND_CEILING)
    rounded = float(context.create_decimal_from_float(value))
    return rounded if limit is None else min(rounded, float(limit))


def _full_gains(gains: Any) -> list[Any]:
    """The gains of the steps of an encoding, as objects."""
    if not isinstance(gains, list):
        return []
    return [
        dict(zip(GAIN, gain, strict=False)) if isinstance(gain, list) else gain
        for gain in gains
        if isinstance(gain, Mapping | list)
    ]
