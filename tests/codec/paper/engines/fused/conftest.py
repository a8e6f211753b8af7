"""Engines of every shape that the fused kernels do, on an emulated device.

Tests of this folder import the module `emulator` beside them; pytest's importlib mode puts no
folder of tests on the path.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.paper.network import Architecture

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def library_folder(tmp_path_factory) -> Path:
    """The folder of the compiled kernels; the test is skipped without g++."""
    if shutil.which("g++") is None:
        pytest.skip("g++ compiles the emulated kernels, and is not here")
    return tmp_path_factory.mktemp("kernels")


@pytest.fixture
def emulated(library_folder):
    """A function of the arguments of `EmulatedDevice` after the folder."""
    from emulator import EmulatedDevice

    return lambda **settings: EmulatedDevice(library_folder, **settings)


@pytest.fixture
def engines_of(noise_coreset, emulated):
    """A function of a shape, settings and a device: coreset, both engines, and the oracle.

    Of the settings, `low` and `keys` are those of `noise_coreset`; `times` are the vertices along
    time of the first levels, which are then all.
    """

    import torch
    from readable_paper import NaiveEngine

    from fhash_codec.paper.engines.fused.engine import FusedEngine
    from fhash_codec.paper.engines.native import NativeEngine

    def make(shape, settings, steps=40, **device):
        settings = {"width": 16, **settings}
        low, keys, times = (settings.pop(name, ()) for name in ("low", "keys", "times"))
        coreset = noise_coreset(shape, low or 0.3, keys=keys, fringe=bool(keys))
        architecture = Architecture.for_box(coreset.box.shape, len(coreset.key_frames), **settings)
        if times:
            levels = zip(times, architecture.levels, strict=False)
            architecture = replace(
                architecture, levels=tuple((t, *level[1:]) for t, level in levels)
            )
        rates, cpu = np.full(steps + 1, 0.01), torch.device("cpu")
        fused = FusedEngine(
            architecture, coreset, rates, seed=7, device=cpu, kernels=emulated(**device)
        )
        return (
            coreset,
            fused,
            NativeEngine(architecture, coreset, rates, seed=7),
            NaiveEngine(architecture, coreset, rates, seed=7),
        )

    return make
