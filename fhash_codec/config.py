"""What the user can set for an encoding: one frozen record whose fields carry their own help and limits.

The command line takes the names, defaults and help of its options from these fields, so that there is one place to read and to change.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from fhash_formats.errors import InputError

TABLE_TYPES = ("float32", "float16", "uint8", "transform")
ENGINES = ("slab", "naive")


PROMISES = ("psnr", "max_error", "max_error_rel", "ratio")
"""Settings of which one at most is given: what the compact profile has to keep."""


def setting(
    default: Any,
    help: str,
    *,
    choices: tuple[str, ...] = (),
    low: float | None = None,
    high: float | None = None,
    option: str = "",
    profile: str = "",
) -> Any:
    """A dataclass field with its help (unit and range included), its allowed values, and its command-line name where that differs.

    profile: the only one that takes a value other than the default, where there is one.
    """
    limits = {
        "help": help,
        "choices": choices,
        "low": low,
        "high": high,
        "option": option,
        "profile": profile,
    }
    return dataclasses.field(default=default, metadata=limits)


@dataclass(frozen=True, kw_only=True)
class EncodeConfig:
    """Settings of `encode`; raises InputError for a value that is not allowed."""

    profile: str = setting(
        "compact",
        "'compact' is the smallest file at a promised quality; 'paper' is the published F-Hash, trained from a random start",
        choices=("compact", "paper"),
    )
    features: tuple[str, ...] = setting(
        ("all",),
        "what to keep: interval:LO:HI, isosurface:V, segmentation[:T], mask:FILE or all; repeat to merge several",
        option="feature",
    )
    dilation: int = setting(1, "vertices by which features grow in every direction", low=0, high=64)
    key_frames: str = setting(
        "all",
        "paper: steps to train on, as all, every:K, auto:N (N chosen by interpolation error) or a list such as 0,4,9",
        profile="paper",
    )
    fold: int = setting(
        2, "paper: ratio of resolution from one level to the next", low=2, high=64, profile="paper"
    )
    embedding_size: int = setting(
        2, "paper: numbers trained at each grid corner", low=1, high=16, profile="paper"
    )
    hidden_layers: int = setting(
        1, "paper: hidden layers of the network", low=0, high=8, profile="paper"
    )
    width: int = setting(
        64, "paper: neurons of each hidden layer", low=1, high=1024, profile="paper"
    )
    epochs: int = setting(
        0,
        "paper: passes over the coreset, 0 for 20 or as many as make 1000 training steps",
        low=0,
        high=100_000,
        profile="paper",
    )
    learning_rate: float = setting(
        0.01, "paper: Adam's learning rate at the start", low=1e-8, high=1.0, profile="paper"
    )
    schedule: str = setting(
        "cosine",
        "paper: course of the learning rate over the training",
        choices=("cosine", "constant"),
        profile="paper",
    )
    batch: int = setting(
        0,
        "paper: samples per training step, 0 for a size that suits the data",
        low=0,
        high=2**31,
        profile="paper",
    )
    psnr: float | None = setting(
        None,
        "promise of quality in dB over the coreset of all steps (compact: 50 if nothing is promised); missing it ends with exit code 3",
        low=0.0,
        high=400.0,
    )
    max_error: float | None = setting(
        None,
        "compact: strict bound of the error of each value, in data units",
        low=0.0,
        high=1.7e308,
        profile="compact",
    )
    max_error_rel: float | None = setting(
        None,
        "compact: strict bound of the error of each value, as a fraction of the range of the series",
        low=0.0,
        high=1.0,
        profile="compact",
    )
    ratio: float | None = setting(
        None,
        "compact: make the file this many times smaller than the raw data",
        low=1.0,
        high=1e9,
        profile="compact",
    )
    effort: int = setting(
        5,
        "compact: 1 tries and trains nothing, 2 to 4 choose the transform by trial, from 5 on a head is trained",
        low=1,
        high=9,
        profile="compact",
    )
    tile: str = setting(
        "auto",
        "compact: vertices that are decoded together, as TxZxYxX such as 4x32x32x32; 'auto', or 'whole' for one tile",
        profile="compact",
    )
    tables: str = setting(
        "float16",
        "paper: number type of the stored tables; 'transform' codes them as compact does, for at most 0.1 dB or down to --psnr",
        choices=TABLE_TYPES,
        profile="paper",
    )
    engine: str = setting(
        "auto", "paper: training engine", choices=("auto", *ENGINES), profile="paper"
    )
    device: str = setting("auto", "where to train", choices=("auto", "cpu", "cuda"))
    seed: int = setting(0, "seed of every random choice", low=0, high=2**63 - 1)
    timings: bool = setting(
        True,
        "store seconds with the training history; without, the same input and number of threads give the same bytes",
    )

    def __post_init__(self) -> None:
        # A caller may give one feature as text and key frames as numbers.
        features, key_frames = cast(Any, self.features), cast(Any, self.key_frames)
        if isinstance(features, str):
            object.__setattr__(self, "features", (features,))
        elif not all(isinstance(feature, str) for feature in features):
            raise InputError("feature is not text; a mask in memory goes to encode(..., mask=...)")
        if not isinstance(key_frames, str):
            object.__setattr__(self, "key_frames", ",".join(str(int(step)) for step in key_frames))
        for field in dataclasses.fields(self):
            _check(field, getattr(self, field.name))
        for field in dataclasses.fields(self):
            owner = field.metadata["profile"]
            if owner and owner != self.profile and getattr(self, field.name) != field.default:
                raise InputError(
                    f"{_option(field)} belongs to --profile {owner}; the profile is {self.profile}"
                )
        promised = [
            _option(field)
            for field in dataclasses.fields(self)
            if field.name in PROMISES and getattr(self, field.name) is not None
        ]
        if len(promised) > 1:
            raise InputError(f"{' and '.join(promised)} are given; promise one of them")

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name; `from_dict` gives the same record back."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in vars(self).items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EncodeConfig:
        """A record from `to_dict`'s values; an unknown name raises InputError that offers the nearest known one."""
        known = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
                raise InputError(f"unknown setting '{name}'; did you mean '{near[0]}'?")
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
        }
        return cls(**given)


def _option(field: dataclasses.Field[Any]) -> str:
    """The name of a setting on the command line, without dashes."""
    name: str = field.metadata["option"] or field.name
    return name.replace("_", "-")


def _check(field: dataclasses.Field[Any], value: Any) -> None:
    limits = field.metadata
    name = _option(field)
    if limits["choices"] and value not in limits["choices"]:
        raise InputError(f"{name} is '{value}'; allowed: {', '.join(limits['choices'])}")
    if limits["low"] is not None and value is not None:
        low, high = cast(float, limits["low"]), cast(float, limits["high"])
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
            or not low <= value <= high
        ):
            raise InputError(f"{name} is {value}; allowed: {low:g} to {high:g}")
        if isinstance(field.default, int) and not isinstance(value, int):
            raise InputError(f"{name} is {value}; a whole number is needed")
    if field.name == "features" and not value:
        raise InputError("feature is empty; name at least one, such as 'all'")
