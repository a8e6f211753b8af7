"""Cases of networks: sizes, diverging trainings, tables at the ends of their number type, kinks,
engines, devices."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Check
from fhash_codec.selftest.cases.fields import noise, series, waves
from fhash_codec.selftest.cases.settings import Settings
from fhash_codec.selftest.checks.network_checks import (
    constant_tables,
    devices,
    diverged,
    ends_of_half_precision,
    engines,
    kinks,
    large_tables,
    recovered,
)
from fhash_codec.selftest.checks.oracle import agrees, gradients
from fhash_formats.series import ArraySeries

__all__ = ["NETWORK_CASES"]

SHAPE = (3, 6, 7, 8)
PLAIN = EncodeConfig(profile="paper", width=8, epochs=60, device="cpu")
EXACT = replace(PLAIN, tables="float32", epochs=30)


def _waves() -> ArraySeries:
    return series(waves(SHAPE).astype(np.float32))


def _noise() -> ArraySeries:
    return series(noise(SHAPE).astype(np.float32))


def _spike() -> ArraySeries:
    values = np.zeros(SHAPE, np.float32)
    values[1, 3, 3, 4] = 1.0
    return series(values)


def _case(name: str, about: str, settings: Settings, *checks: Check, **more: Any) -> Case:
    return Case(
        name=name,
        group="networks",
        about=about,
        **{"make": _waves, "settings": settings, "checks": checks, **more},
    )


def _sizes(field: str, sizes: Sequence[int]) -> Settings:
    changes: dict[str, dict[str, Any]] = {
        f"{field.replace('_', '-')}-{size}": {field: size} for size in sizes
    }
    return {name: replace(PLAIN, **change) for name, change in changes.items()}


WILD = {
    f"{layers}-layers-rate-{rate:g}": replace(
        PLAIN, hidden_layers=layers, width=64, learning_rate=rate
    )
    for layers, rate in itertools.product((0, 1, 2), (1.0, 0.3))
}
STEADY = {f"{name}-constant": replace(config, schedule="constant") for name, config in WILD.items()}

NETWORK_CASES = (
    _case(
        "folds",
        "every fold from 2 to 8: few levels or many",
        _sizes("fold", (2, 8)),
        agrees,
        gradients,
        more=_sizes("fold", range(3, 8)),
    ),
    _case(
        "layers",
        "0, 1 and 2 hidden layers",
        _sizes("hidden_layers", (0, 1, 2)),
        agrees,
        gradients,
        more=_sizes("hidden_layers", (3, 8)),
    ),
    _case(
        "embeddings",
        "embeddings of 1 to 8 numbers",
        _sizes("embedding_size", (1, 8)),
        agrees,
        gradients,
        more=_sizes("embedding_size", range(2, 8)),
    ),
    _case(
        "widths",
        "layers of one neuron, and of widths around the size of a kernel",
        _sizes("width", (1, 65)),
        agrees,
        more=_sizes("width", (2, 63, 64, 257)),
    ),
    _case(
        "wild-rates",
        "learning rates at which training diverges: it restarts at a lower one and says so",
        {"2-layers-rate-1": WILD["2-layers-rate-1"]},
        recovered,
        diverged,
        agrees,
        more={
            name: config
            for name, config in {**WILD, **STEADY}.items()
            if "rate-1" in name and name != "2-layers-rate-1"
        },
    ),
    _case(
        "rates-on-the-edge",
        "learning rates at which training may diverge: the result is better than a constant",
        {"1-layers-rate-0.3": WILD["1-layers-rate-0.3"]},
        recovered,
        more={
            name: WILD[name]
            for name in WILD
            if name.endswith("0.3") and name != "1-layers-rate-0.3"
        },
        make=_noise,
    ),
    _case(
        "barely-trained",
        "embeddings as small as at the start of training",
        {
            tables: replace(PLAIN, epochs=1, learning_rate=1e-8, tables=tables)
            for tables in ("float16", "uint8")
        },
        agrees,
        more={
            tables: replace(PLAIN, epochs=1, learning_rate=1e-8, tables=tables)
            for tables in ("float32", "transform")
        },
    ),
    _case(
        "ends-of-tables",
        "embeddings beyond the range of float16, at its ends, constant and tiny",
        {"float16": PLAIN},
        ends_of_half_precision,
        large_tables,
        constant_tables,
    ),
    _case(
        "kinks",
        "derivatives at a ReLU's kink and beside it",
        {"2-layers": replace(PLAIN, hidden_layers=2)},
        kinks,
        gradients,
    ),
    _case(
        "engines",
        "two engines and two devices train one network",
        {"1-layer": EXACT},
        engines,
        devices,
        more={
            "0-layers": replace(EXACT, hidden_layers=0),
            "2-layers": replace(EXACT, hidden_layers=2),
            "fold-5": replace(EXACT, fold=5),
        },
    ),
    _case(
        "engines-on-noise",
        "two engines and two devices train one network on noise",
        {"1-layer": EXACT},
        engines,
        devices,
        make=_noise,
        quick=False,
    ),
    _case(
        "spike-in-a-network",
        "one vertex that differs from all others",
        {"2-layers": replace(PLAIN, hidden_layers=2)},
        agrees,
        make=_spike,
    ),
)
