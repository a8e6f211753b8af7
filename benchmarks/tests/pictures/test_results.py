"""The plot of `fhash bench render`."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import pytest

from fhash_bench.pictures.results import Against, Playback, RenderBench, Switch, plot
from fhash_formats.errors import InputError


def test_a_result_is_drawn(result: RenderBench, tmp_path: Path) -> None:
    plot(result, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="nothing to draw"):
        plot(dataclasses.replace(result, curves=(), against=()), tmp_path / "b.png")


def against(shaded: bool, ours_ms: float, vtk_ms: float) -> Against:
    return Against(
        scene="fog",
        shaded=shaded,
        size=16,
        ours_ms=ours_ms,
        whole_ms=ours_ms,
        vtk_ms=vtk_ms,
        window_ms=1.0,
        psnr=None,
        ssim=1.0,
        samples=9,
    )


@pytest.fixture
def empty() -> RenderBench:
    return RenderBench(
        series="a",
        shape=(2, 3, 4, 5),
        step=1.0,
        size=16,
        turns=1,
        effects=(),
        accelerations=(),
        streams=(),
        against=(),
        exactness=(),
        playback=(),
        curves=(),
        refused={},
        machine={},
        notes=(),
    )


def test_a_summary_has_what_was_measured(empty: RenderBench) -> None:
    assert empty.summary() == {}
    unlit = [against(False, 1.0, vtk) for vtk in (2.0, 4.0, 9.0)]
    measured = replace(empty, against=(*unlit, against(True, 2.0, 6.0)))
    assert measured.summary() == {
        "unshaded_median": 4.0,
        "unshaded_least": 2.0,
        "shaded_median": 3.0,
        "shaded_least": 3.0,
    }
    played = Playback(scene="fog", shaded=False, size=16, steps=3, ours_ms=6.0, vtk_ms=4.0)
    assert replace(empty, playback=(played,)).summary() == {"playback_median": 1.5}


def test_json_values_have_the_ratios(empty: RenderBench) -> None:
    switch = Switch(
        name="jitter", off_ms=2.0, on_ms=3.0, counters_off={}, counters_on={}, psnr=None
    )
    values = replace(empty, effects=(switch,), against=(against(False, 1.0, 2.0),)).to_dict()
    assert values["effects"][0]["ratio"] == 1.5
    assert values["against"][0]["ratio"] == 2.0
    assert json.loads(json.dumps(values)) == {**values, "shape": [2, 3, 4, 5]} | {
        name: list(values[name]) for name in values if isinstance(values[name], tuple)
    }
