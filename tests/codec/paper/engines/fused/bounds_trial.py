"""A program: some steps of emulated kernels under AddressSanitizer; a planted fault if asked.

Arguments: the folder of the libraries, the number of hidden layers, and a text of the kernels with
what replaces it, or nothing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from emulator import EmulatedDevice

from fhash_codec.coreset.bricks import build_coreset
from fhash_codec.coreset.features import Interval
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.engine import FusedEngine
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def main(folder: str, layers: str, old: str = "", new: str = "") -> None:
    series = ArraySeries(np.random.default_rng(3).random((2, 5, 9, 13), dtype=np.float32))
    coreset = build_coreset(series, scan(series, silent), range(2), [Interval(0.3, 1.0)], 0, silent)
    architecture = Architecture.for_box(coreset.box.shape, 2, width=12, hidden_layers=int(layers))

    def change(text: str) -> str:
        assert not old or old in text
        return text.replace(old, new) if old else text

    device = EmulatedDevice(
        Path(folder), change=change, flags=("-fsanitize=address", "-g1"), order=3
    )
    engine = FusedEngine(
        architecture, coreset, np.full(9, 0.01), seed=7, device=torch.device("cpu"), kernels=device
    )
    every = np.arange(len(coreset.bricks))
    for deterministic in (False, True):
        torch.use_deterministic_algorithms(deterministic)
        engine.train(every[int(deterministic) :])
    engine.infer(every)
    engine.settle()
    print("done")


if __name__ == "__main__":
    main(*sys.argv[1:])
