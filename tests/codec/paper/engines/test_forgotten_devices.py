"""Planted faults: wherever an engine may forget its device, the pretended device sees it.

Each test compiles the sources of an engine with one place changed that puts a tensor on the device.
"""

from __future__ import annotations

import importlib
import re
import sys
import types
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from pretended_cuda import MixedDevices, pretended_cuda

from fhash_codec.coreset.bricks import Coreset

DEVICE = re.compile(
    r"\.to\((?:self\.)?device(?:, self\.dtype)?\)|device=device, "
    r"|, device=(?:(?:self|mask|bricks)\.)?_?device\b"
)
"""Every place of an engine's source that puts a tensor on the device."""
ON_THE_CPU = "self._scratch_memory[name] = torch.empty"
"""A line that no other device comes to."""
SHAPE = (2, 6, 10, 20)
"""Shape of the series."""
LOW = 0.8
"""Smallest value of the feature: few vertices are samples."""
FILES = {
    "slab": (
        "fhash_codec.paper.engines.slab",
        "fhash_codec.paper.engines.upsampling",
        "fhash_codec.paper.engines.sending",
        "fhash_codec.paper.engines.columns",
        "fhash_codec.training.positions",
    ),
    "naive": ("fhash_codec.paper.engines.naive",),
}
"""Modules of an engine, the one with its class first."""
BETWEEN = {"fhash_codec.paper.engines.columns"}
"""Modules that put nothing on the device, but call one that does."""


def text_of(name: str) -> str:
    """The source of a module."""
    return Path(str(importlib.import_module(name).__file__)).read_text(encoding="utf-8")


def faulty(engine: str, module: str, source: str) -> type[Any]:
    """The class of an engine with one module compiled from another source."""
    compiled: dict[str, types.ModuleType] = {}
    for name in reversed(FILES[engine]):
        text = source if name == module else text_of(name)
        made = types.ModuleType(name)
        sys.modules[name], before = made, sys.modules[name]
        try:
            exec(compile(text, name, "exec"), made.__dict__)
        finally:
            sys.modules[name] = before
        for earlier in compiled.values():
            for attribute in set(vars(earlier)) & set(vars(made)):
                value = vars(earlier)[attribute]
                if getattr(value, "__module__", None) == earlier.__name__:
                    setattr(made, attribute, value)
        compiled[name] = made
    found = compiled[FILES[engine][0]]
    return getattr(found, {"slab": "SlabEngine", "naive": "NaiveEngine"}[engine])  # type: ignore[no-any-return]


def faults() -> list[Any]:
    """Parameters (engine, module, source), one for each place that may forget the device."""
    found = []
    for engine, names in FILES.items():
        for name in names:
            text = text_of(name)
            for match in DEVICE.finditer(text):
                line = text[: match.start()].count("\n") + 1
                if ON_THE_CPU in text.splitlines()[line - 1]:
                    continue
                found.append(
                    pytest.param(
                        engine,
                        name,
                        text[: match.start()] + text[match.end() :],
                        id=f"{name.split('.')[-1]}:{line}",
                    )
                )
    return found


def traffic(trained: Callable[..., Any], coreset: Coreset, engine: str) -> dict[str, int]:
    """Waits for the device and copies to it of a training, a continuation and an evaluation."""
    with pretended_cuda() as pretended:
        trained(coreset, {"width": 8}, engine, "cuda")
    return {name: pretended.counts[name] for name in ("waits", "copies", "pageable")}


@pytest.fixture(scope="module")
def rightly(
    noise_coreset: Callable[..., Coreset], trained: Callable[..., Any]
) -> Callable[[str], dict[str, int]]:
    """A function of an engine's name: the traffic of the engine without a fault."""
    return lru_cache(lambda engine: traffic(trained, noise_coreset(SHAPE, LOW), engine))


@pytest.mark.parametrize(("engine", "module", "source"), faults())
def test_a_forgotten_device_is_seen(
    noise_coreset: Callable[..., Coreset],
    trained: Callable[..., Any],
    rightly: Callable[[str], dict[str, int]],
    monkeypatch: pytest.MonkeyPatch,
    engine: str,
    module: str,
    source: str,
) -> None:
    expected, kind = rightly(engine), faulty(engine, module, source)
    monkeypatch.setattr(sys.modules[FILES[engine][0]], kind.__name__, kind)
    try:
        found = traffic(trained, noise_coreset(SHAPE, LOW), engine)
    except (MixedDevices, TypeError, AssertionError):
        return
    # What CUDA allows, but by a wait or a copy in each step.
    assert found != expected


def test_there_are_faults_of_every_module() -> None:
    modules = {name for names in FILES.values() for name in names}
    assert {parameter.values[1] for parameter in faults()} == modules - BETWEEN
    assert len(faults()) >= 8
