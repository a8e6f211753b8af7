"""Settings that many cases share: both profiles, every kind of promise, every type of tables.
Networks are small and trainings short."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from fhash_codec.config import EncodeConfig

__all__ = ["COMPACT", "EXACT", "MORE", "PAPER", "QUICK", "of_all"]

Settings = Mapping[str, EncodeConfig]

COMPACT: Settings = {
    "bound": EncodeConfig(max_error_rel=1e-3, effort=2),
    "psnr": EncodeConfig(psnr=50.0, effort=1),
}
EXACT: Settings = {"exact": EncodeConfig(max_error=0.0, effort=1)}
PAPER: Settings = {"paper": EncodeConfig(profile="paper", width=8, epochs=5)}
QUICK: Settings = {**COMPACT, **PAPER}
MORE: Settings = {
    **EXACT,
    "head": EncodeConfig(psnr=60.0, effort=5),
    "bound-tight": EncodeConfig(max_error_rel=1e-6, effort=4),
    "tiles": EncodeConfig(max_error_rel=1e-2, effort=1, tile="2x3x4x5"),
    "paper-float32": EncodeConfig(
        profile="paper", width=16, hidden_layers=2, epochs=20, tables="float32"
    ),
    "paper-uint8": EncodeConfig(
        profile="paper", width=4, embedding_size=1, epochs=20, tables="uint8"
    ),
    "paper-transform": EncodeConfig(profile="paper", width=8, epochs=20, tables="transform"),
}
"""Additional settings of the long set."""


def of_all(settings: Settings, **changes: Any) -> dict[str, EncodeConfig]:
    """The same settings with the fields in `changes` replaced in each of them."""
    return {name: replace(config, **changes) for name, config in settings.items()}
