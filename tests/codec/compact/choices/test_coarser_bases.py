"""Coarser bases: kept where they make the file smaller at the same quality, else left alone."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.choices.bases import Bases
from fhash_codec.compact.choices.coarser_bases import coarser_bases
from fhash_codec.compact.choices.step import find_step
from fhash_codec.compact.choices.transform import (
    basis_bytes,
    refit,
    usual_transform,
)
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.blocks import Index, Tile
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.settings import TileSettings

GOAL = Goal(psnr=40.0, data_range=8.0)


class Patterns:
    """One tile in which each line along x is a sum of a few patterns, with a little noise."""

    shape = tile = (1, 8, 24, 48)
    in_memory = True

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        rng = np.random.default_rng(0)
        patterns = rng.normal(size=(12, 48)) * 0.7 ** np.arange(12)[:, None]
        values = rng.normal(size=(1, 8, 24, 12)) @ patterns
        values += rng.normal(0, 0.02, values.shape)
        return Tile(values.clip(-4, 4).astype(np.float32), None)


@pytest.fixture
def workers() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


def begun(sample: Sample, fineness: float) -> TileSettings:
    """Settings with a basis along x that is so many times finer than the step asks for."""
    usual = usual_transform(Patterns.tile).axes
    settings = TileSettings(
        transform=TransformSpec(axes=(*usual[:3], AxisTransform(kind="haar", depth=1))),
        step=0.3,
        center=0.0,
        low=-4.0,
        high=4.0,
    )
    basis = Bases(sample, replace(settings, step=settings.step / fineness)).along(3)
    spec = TransformSpec(axes=(*usual[:3], basis))
    return find_step(sample, replace(settings, transform=spec), Coding(), GOAL, tries=6)[0]


def test_bases_that_are_too_fine_become_coarser(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = begun(sample, 20.0)
    settings, outcome = find_step(sample, settings, Coding(), GOAL, tries=6)
    found = coarser_bases(sample, settings, outcome, Coding(), GOAL)
    assert found is not None
    other, new = found
    saved = basis_bytes(settings.transform) - basis_bytes(other.transform)
    assert saved > 100
    assert new.size + basis_bytes(other.transform) < outcome.size + basis_bytes(settings.transform)
    assert new.psnr(GOAL.data_range) == pytest.approx(40.0, abs=0.2)


def test_bases_that_do_not_pay_are_left_alone(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = begun(sample, 1.0)
    coarse = refit(sample, settings, 40.0)
    coarse, outcome = find_step(sample, coarse, Coding(), GOAL, tries=6)
    found = coarser_bases(sample, coarse, outcome, Coding(), GOAL)
    if found is None:
        return
    chosen, new = found
    total = new.size + basis_bytes(chosen.transform)
    # They are coarser already than any that is tried. Finer ones of more bytes come out only where
    # with these no step keeps the promise.
    missed = outcome.psnr(GOAL.data_range) < 39.8
    assert missed or total <= 1.02 * (outcome.size + basis_bytes(coarse.transform))
    assert new.psnr(GOAL.data_range) >= min(outcome.psnr(GOAL.data_range), 39.8)


def test_without_bases_nothing_is_tried(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = TileSettings(
        transform=usual_transform(Patterns.tile), step=0.3, center=0.0, low=-4.0, high=4.0
    )
    settings, outcome = find_step(sample, settings, Coding(), GOAL, tries=3)
    assert coarser_bases(sample, settings, outcome, Coding(), GOAL) is None


def test_a_file_with_coarser_bases_keeps_its_promise(tmp_path: Path) -> None:
    values = Patterns().read((0, 0, 0, 0)).values
    report = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=40.0, effort=2))
    assert report["psnr"] >= 40.0
    whats = [gain["what"] for gain in report["gains"]]
    assert {"coarser bases", "coarser bases (left out)"} & {*whats} or "klt" not in str(
        fhash_codec.open(tmp_path / "a.fhz").container.arrays["tables/level_1"].settings
    )
