"""The machine that a benchmark ran on."""

from __future__ import annotations

import json
import os
from math import prod

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import (
    MIN_STEPS,
    OVERRUN,
    PEERS,
    Allowance,
    BudgetSpentError,
    CroppedSeries,
    Wish,
    cropped,
    described,
    facts_of,
    machine,
    paper_config,
    wishes,
)
from fhash_codec.progress import silent
from fhash_formats.errors import RegionError
from fhash_formats.series import ArraySeries


def test_the_machine_is_described_by_json_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    described = machine()
    assert described["device"] == "cpu"
    assert described["processor"]
    assert described["cores"] == os.cpu_count()
    assert described["threads"] == 3
    assert json.loads(json.dumps(described)) == described


class Clock:
    """A clock that stands until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_part_ends_at_its_share_and_what_does_not_fit_is_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 20.0
    assert allowance.left == 30.0
    assert allowance.has("short", 30.0)
    assert not allowance.has("long", 31.0)
    assert not allowance.has("half", 16.0, share=0.5)
    clock.now = 70.0
    assert allowance.left == 0.0
    entry, _ = allowance.left_out
    assert (entry.what, entry.late) == ("long", True)
    assert "31 s" in entry.why
    assert "30 s" in entry.why


def test_work_that_overruns_is_ended_and_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 10.0
    guarded = allowance.guard(silent, share=0.5)
    clock.now = 10.0 + 20 * (1 + OVERRUN)
    guarded("stage", 1, 2, "")
    clock.now += 0.1
    with allowance.work("an encoding"):
        guarded("stage", 2, 2, "")
        pytest.fail("it went on")
    assert [entry.what for entry in allowance.left_out] == ["an encoding"]
    with pytest.raises(BudgetSpentError):
        guarded("stage", 2, 2, "")


def test_ctrl_c_ends_the_work_and_everything_after_it() -> None:
    allowance = Allowance(100.0)
    with allowance.work("a picture"):
        raise KeyboardInterrupt
    assert allowance.interrupted
    assert not allowance.has("another", 0.0)
    assert {entry.why for entry in allowance.left_out} == {"interrupted"}


def array(shape: tuple[int, ...]) -> ArraySeries:
    return ArraySeries(np.arange(prod(shape), dtype=np.float32).reshape(shape))


def test_a_series_that_is_small_enough_stays_whole() -> None:
    series = array((3, 4, 5, 6))
    assert cropped(series, prod(series.shape)) is series
    assert described(series) == "the whole series"


@pytest.mark.parametrize("vertices", [20_000, 3000, 200, 1])
def test_a_crop_has_about_the_vertices_asked_for(vertices: int) -> None:
    series = array((20, 1, 30, 40))
    crop = cropped(series, vertices)
    assert isinstance(crop, CroppedSeries)
    assert prod(crop.shape) <= 1.3 * vertices + 2 * MIN_STEPS
    assert crop.shape[0] >= MIN_STEPS
    assert crop.shape[1] == 1
    (t, *_), (_, y, x) = (crop.steps[0],), crop.region
    expected = series.values[t : t + crop.shape[0], :, slice(*y), slice(*x)]
    np.testing.assert_array_equal(np.stack(list(crop.frames())), expected)
    assert crop.coords["x"].values[0] == x[0]
    assert "a crop, " in described(crop)
    assert f"x {x[0]}:{x[1]}" in described(crop)
    with pytest.raises(RegionError):
        crop.read(crop.shape[0])


def test_range_bulk_size_and_missing_values() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    values[0, 0, 0, :3] = np.nan
    facts = facts_of(ArraySeries(values), silent)
    assert facts.missing == 3
    assert facts.raw_bytes == values.nbytes
    assert facts.width == pytest.approx(1, abs=0.01)
    assert facts.bulk is not None
    assert 0.97 < facts.bulk.high - facts.bulk.low < facts.width
    errors = facts.errors()
    errors.add(0, values[0], values[0] + np.float32(0.1))
    assert errors.psnr == pytest.approx(20, abs=0.1)


def test_a_constant_series_has_no_width() -> None:
    facts = facts_of(ArraySeries(np.ones((2, 3, 4, 5))), silent)
    assert (facts.width, facts.bulk) == (0.0, None)


def test_the_default_and_the_peers_come_early_and_every_name_once() -> None:
    every = list(wishes())
    assert EncodeConfig() in [wish.config for wish in every[:6]]
    assert [wish.codec for wish in every[1:4]] == list(PEERS)
    names = [wish.name for wish in every]
    assert len(names) == len(set(names))
    assert {wish.codec for wish in every} == {"compact", "paper", *PEERS}


def test_options_give_the_encoding_again() -> None:
    config = EncodeConfig(effort=3, psnr=45.0)
    wish = Wish(codec="compact", group="compact, effort 3", config=config)
    assert wish.options == "--psnr 45 --effort 3"
    assert wish.name == "compact, effort 3, 45 dB"
    assert Wish(codec="compact", group="g", config=EncodeConfig()).options == ""
    paper = Wish(codec="paper", group="paper", config=paper_config(1))
    assert (paper.name, paper.options) == ("paper, 1 epoch", "--profile paper --epochs 1")
