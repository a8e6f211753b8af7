"""Values that a header leaves out, because they follow from FORMAT.md or from the rest.

In a small file the header costs as much as the coefficients. The defaults belong to the format: a
default of the encoder that changes is from then on written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

Change = Callable[[Mapping[str, Any], Mapping[str, Any]], dict[str, Any]]
"""An object and its defaults to the object with or without them."""

__all__ = ["CONFIG_DEFAULTS", "DEFAULTS", "brief", "complete"]

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
"""Values of the settings that a header leaves out."""
DEFAULTS: dict[str, Any] = {
    "features": ["all"],
    "dilation": 1,
    "coreset_fraction": 1.0,
    "coordinates": {},
    "config": CONFIG_DEFAULTS,
    "training": {"seconds": None, "steps": 0, "epochs": 0, "device": "none"},
    "history": {},
}
"""Values of keys that a header leaves out."""
SSIM_WINDOW: dict[str, Any] = {"window": 11, "sigma": 1.5}
"""Window and sigma of the SSIM, in vertices, where the quality was measured."""
DOMAIN_FIGURES = ("psnr", "rmse", "max_abs_error")
"""Figures over the coreset; those over the domain are the same where they are left out."""


def brief(header: Mapping[str, Any]) -> dict[str, Any]:
    """A header without what `complete` puts back."""
    return _changed(_without, header)


def complete(header: Mapping[str, Any]) -> dict[str, Any]:
    """A header with all that was left out; what is there stays, of whatever form it is."""
    return _changed(_with, header)


def _changed(change: Change, header: Mapping[str, Any]) -> dict[str, Any]:
    """A header and its measured quality after `_without` or `_with`."""
    result = change(header, DEFAULTS)
    quality = result.get("quality")
    if isinstance(quality, dict) and "psnr" in quality:
        result["quality"] = change(quality, _of_quality(quality))
    return result


def _of_quality(quality: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults of a measured quality, some of which follow from its figures."""
    same = {f"{name}_domain": quality[name] for name in DOMAIN_FIGURES if name in quality}
    return {**same, "ssim_window": SSIM_WINDOW}


def _without(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The values of an object other than its defaults."""
    result = {}
    for key, value in values.items():
        default = defaults.get(key, ...)
        if isinstance(default, dict) and isinstance(value, dict):
            value, default = _without(value, default), {}
        if value != default:
            result[key] = value
    return result


def _with(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """An object with its defaults in place of what it lacks."""
    result = dict(values)
    for key, default in defaults.items():
        value = result.setdefault(key, {} if isinstance(default, dict) else deepcopy(default))
        if isinstance(default, dict) and isinstance(value, dict):
            result[key] = _with(value, default)
    return result
