"""Training of a cell: points of the curve, and what their figures mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.cell import Point
from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.training import masked_psnr, measured_epochs, rank, train


class Constant:
    """An encoding that is right in half of its epochs, and not finite in one."""

    name, tables, mlp, samples_an_epoch, steps_an_epoch = "constant", 1, 1, 10, 3

    def __init__(self, data: Data) -> None:
        self.data, self.epoch, self.settled = data, -1, True

    def train_epoch(self, epoch: int) -> None:
        assert epoch == self.epoch + 1
        self.epoch, self.settled = epoch, False

    def settle(self) -> None:
        self.settled = True

    def frame(self, key: int) -> np.ndarray:
        assert self.settled
        shift = {-1: 0.5, 0: 0.1, 1: math.nan}.get(self.epoch, 0.01)
        return (self.data.frames[key] + shift).astype(np.float32)


def test_curve(data: Data) -> None:
    told = []
    result = train(
        Constant(data),  # type: ignore[arg-type]
        data,
        3,
        device=torch.device("cpu"),
        picture=lambda frames: (float(len(frames)), 0.5),
        progress=lambda *words: told.append(words),
    )
    assert [point.epoch for point in result.curve] == [0, 1, 2, 3]
    assert [point.step for point in result.curve] == [0, 3, 6, 9]
    psnr = [point.coreset_psnr for point in result.curve]
    assert psnr[2] is None
    assert [psnr[0], psnr[1], psnr[3]] == pytest.approx([6.0206, 20, 40], abs=1e-3)
    assert result.curve[3].picture_psnr == 3.0
    seconds = [point.seconds for point in result.curve]
    assert seconds == sorted(seconds)
    assert result.seconds == seconds[-1]
    assert [words[:3] for words in told] == [("training", n, 3) for n in (1, 2, 3)]


def test_psnr_of_masked_vertices(data: Data) -> None:
    wrong = [np.where(mask, frame, 7) for frame, mask in zip(data.frames, data.masks, strict=True)]
    assert masked_psnr(data.frames, wrong, data.masks) is None  # no error
    wrong[0] = wrong[0] + np.float32(0.1)
    vertices = sum(mask.sum() for mask in data.masks)
    expected = 20 + 10 * math.log10(vertices / data.masks[0].sum())
    assert masked_psnr(data.frames, wrong, data.masks) == pytest.approx(expected, abs=1e-4)
    assert masked_psnr(data.frames, wrong, [np.zeros_like(mask) for mask in data.masks]) is None


def test_measured_epochs() -> None:
    assert measured_epochs(3) == [0, 1, 2, 3]
    assert measured_epochs(20) == list(range(21))
    for epochs in (31, 60, 200, 5000):
        found = measured_epochs(epochs)
        assert {0, 20, 30, epochs} <= set(found)
        assert len(found) < 100


def test_rank_prefers_quality_then_seconds() -> None:
    def curve(*psnr: float, each: float = 1.0) -> list[Point]:
        return [
            Point(step=n, epoch=n, seconds=each * n, coreset_psnr=value)
            for n, value in enumerate(psnr)
        ]

    ordered = [
        curve(5, 18, 19),
        curve(5, 18, 19.5),
        curve(5, 20, 33, each=2),
        curve(5, 20, 31),
        curve(5, 41, 3, each=9),
    ]
    ranks = [rank(course) for course in ordered]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == len(ranks)
