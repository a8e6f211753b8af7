"""A program: emulated kernels under AddressSanitizer; a planted fault if asked.

Arguments: the folder of the libraries, `bricks` for some steps of training, `between` for one with
samples between key frames or `points`, the number of hidden layers, and a text of the kernels with
what replaces it, or nothing.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch
from emulator import EmulatedDevice, HeldTable

from fhash_codec.features.bricks import build_coreset, with_steps_between
from fhash_codec.features.features import FeatureChoice, Interval
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines.fused.engine import FusedEngine, FusedPoints, PointKernels
from fhash_codec.paper.network import Architecture, ArrayTable, Network
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def bricks(device: EmulatedDevice, layers: int, keys: tuple[int, int] = (0, 1)) -> None:
    """Train and evaluate, with atomics and in a fixed order."""
    steps = keys[1] + 1
    series = ArraySeries(np.random.default_rng(3).random((steps, 5, 9, 13), dtype=np.float32))
    choice, scanned = FeatureChoice(keys, [Interval(0.3, 1.0)]), scan(series, silent)
    coreset = build_coreset(series, scanned, choice, silent, fringe=True)
    times = KeyTimes(times=np.arange(steps), key_frames=keys)
    coreset = with_steps_between(coreset, series, scanned.value_range, times, silent)
    architecture = Architecture.for_box(coreset.box.shape, 2, width=12, hidden_layers=layers)
    engine = FusedEngine(
        architecture, coreset, np.full(9, 0.01), seed=7, device=torch.device("cpu"), kernels=device
    )
    every = np.arange(len(coreset.bricks))
    for deterministic in (False, True):
        torch.use_deterministic_algorithms(deterministic)
        engine.train(every[int(deterministic) :])
    engine.infer(every)
    engine.settle()


def points(device: EmulatedDevice, layers: int) -> None:
    """Evaluate places of the whole box, its far corner too, by tables with and without bitmaps."""
    random, box = np.random.default_rng(3), (5, 9, 13)
    architecture = Architecture.for_box(box, 2, width=12, hidden_layers=layers)
    last = np.array(box[::-1]) - 1.0
    places = np.concatenate([random.uniform(0, last, (90, 3)), [0 * last, last]])
    for table in (ArrayTable, HeldTable):
        network = Network(
            levels=architecture.levels,
            embedding_size=2,
            tables=[table(random.random((*level, 2))) for level in architecture.levels],
            layers=tuple(
                (random.random(shape, np.float32), random.random(shape[0], np.float32))
                for shape in architecture.layer_shapes
            ),
            box_size=box,
            key_frames=2,
        )
        fused = FusedPoints(network, 0.4, device=torch.device("cpu"), kernels=PointKernels(device))
        fused.values(torch.from_numpy(places))
        fused.slopes(torch.from_numpy(places))


def main(folder: str, kernels: str, layers: str, old: str = "", new: str = "") -> None:
    def change(text: str) -> str:
        assert not old or old in text
        return text.replace(old, new) if old else text

    device = EmulatedDevice(
        Path(folder), change=change, flags=("-fsanitize=address", "-g1"), order=3
    )
    tried = {"bricks": bricks, "between": partial(bricks, keys=(0, 2)), "points": points}
    tried[kernels](device, int(layers))
    print("done")


if __name__ == "__main__":
    main(*sys.argv[1:])
