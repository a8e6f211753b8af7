"""Planted faults: wherever an engine may forget its device, the pretended device sees it.

Each test compiles the sources of an engine with one place changed that puts a tensor on the device.
"""

from __future__ import annotations

import importlib
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pretended_cuda import MixedDevices, pretended_cuda

from fhash_codec.features.bricks import Coreset

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
FILES = (
    "fhash_codec.paper.engines.slab",
    "fhash_codec.paper.engines.parameters",
    "fhash_codec.paper.engines.parameters",
)
"""Modules of the slab engine, the one with its class first."""


def text_of(name: str) -> str:
    """The source of a module."""
    return Path(str(importlib.import_module(name).__file__)).read_text(encoding="utf-8")


def faulty(module: str, source: str) -> type[Any]:
    """The class of the engine with one module compiled from another source."""
    compiled: dict[str, types.ModuleType] = {}
    for name in reversed(FILES):
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
    return compiled[FILES[0]].SlabEngine  # type: ignore[no-any-return]


def faults() -> list[Any]:
    """Parameters (module, source), one for each place that may forget the device."""
    found = []
    for name in FILES:
        text = text_of(name)
        for match in DEVICE.finditer(text):
            line = text[: match.start()].count("\n") + 1
            if ON_THE_CPU in text.splitlines()[line - 1]:
                continue
            source = text[: match.start()] + text[match.end() :]
            found.append(pytest.param(name, source, id=f"{name.split('.')[-1]}:{line}"))
    return found


def traffic(trained: Callable[..., Any], coreset: Coreset) -> dict[str, int]:
    """Waits for the device and copies to it of a training, a continuation and an evaluation."""
    with pretended_cuda() as pretended:
        trained(coreset, {"width": 8}, "slab", "cuda")
    return {name: pretended.counts[name] for name in ("waits", "copies", "pageable")}


@pytest.fixture(scope="module")
def rightly(noise_coreset: Callable[..., Coreset], trained: Callable[..., Any]) -> dict[str, int]:
    """The traffic of the engine without a fault."""
    return traffic(trained, noise_coreset(SHAPE, LOW))


@pytest.mark.parametrize(("module", "source"), faults())
def test_a_forgotten_device_is_seen(
    noise_coreset: Callable[..., Coreset],
    trained: Callable[..., Any],
    rightly: dict[str, int],
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    source: str,
) -> None:
    monkeypatch.setattr(sys.modules[FILES[0]], "SlabEngine", faulty(module, source))
    try:
        found = traffic(trained, noise_coreset(SHAPE, LOW))
    except (MixedDevices, TypeError, AssertionError):
        return
    # What CUDA allows, but by a wait or a copy in each step.
    assert found != rightly


def test_there_are_faults_of_every_module() -> None:
    assert {parameter.values[0] for parameter in faults()} == set(FILES)
    assert len(faults()) >= 8
