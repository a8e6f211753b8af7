"""ARM beside the cache: figures of each size, and up to how many pictures ARM is faster."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_bench.pictures import render as module
from fhash_bench.pictures import render as pictures
from fhash_bench.pictures.render import bench_render, break_even
from fhash_bench.pictures.results import NETWORK_PARTS, BreakEven, RenderBench
from fhash_codec import EncodeConfig, Scene, Volume, encode
from fhash_codec.cost.uses import FINEST, STEPS, in_turns
from fhash_codec.progress import silent
from fhash_codec.rendering.image import Image
from fhash_formats.errors import InputError


def figures(first: float, kept: float, arm: float) -> BreakEven:
    return BreakEven(size=8, first_ms=first, kept_ms=kept, arm_ms=arm, evaluations=1, auto="cache")


@pytest.mark.parametrize(
    ("first", "kept", "arm", "pictures"),
    [(100, 10, 40, 3), (100, 10, 101, 0), (100, 10, 100, 1), (100, 10, 10, None), (9, 10, 11, 0)],
)
def test_the_cache_wins_from_some_number_of_pictures_on(first, kept, arm, pictures) -> None:
    pair = figures(first, kept, arm)
    assert pair.pictures == pictures
    assert pair.ratio == arm / first
    if pictures:
        assert pictures * arm <= first + (pictures - 1) * kept
        assert (pictures + 1) * arm > first + pictures * kept


@pytest.mark.parametrize(("lost", "count"), [(np.inf, 3), (0.0, 1)])
def test_sizes_are_measured_until_arm_has_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: float, count: int
) -> None:
    monkeypatch.setattr(module, "LOST", lost)
    path = tmp_path / "a.fhz"
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    fhash_codec.encode(field, path, EncodeConfig(profile="paper", epochs=1, width=4))
    with fhash_codec.open(path) as volume:
        pairs = break_even(volume, Scene(), 1, 16, silent)
    assert [pair.size for pair in pairs] == [4, 8, 16][:count]
    for pair in pairs:
        assert min(pair.first_ms, pair.kept_ms, pair.arm_ms) > 0
        assert pair.auto in ("cache", "arm")
    assert pairs[-1].evaluations > 0


def test_variants_run_in_turns() -> None:
    order: list[str] = []

    def run(name: str) -> Image:
        order.append(name)
        return Image(rgba=np.zeros((1, 1, 4), dtype=np.float32))

    found = in_turns({"a": lambda: run("a"), "b": lambda: run("b")}, 3)
    assert order == ["a", "b"] * 4
    assert all(milliseconds > 0 for milliseconds, _ in found.values())


def test_every_part_has_its_figures(result: RenderBench) -> None:
    report = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert report["refused"] == dict.fromkeys(
        NETWORK_PARTS, "the file has no network to march through"
    )
    effects = {entry["name"]: entry for entry in report["effects"]}
    assert effects["shading"]["counters_off"]["gradients"] == 0
    assert effects["shading"]["counters_on"]["gradients"] > 0
    assert effects["shadows"]["counters_off"]["secondary_rays"] == 0
    assert effects["shadows"]["counters_on"]["secondary_rays"] > 0
    assert all(
        entry["off_ms"] > 0 and entry["on_ms"] > 0 and entry["ratio"] > 0
        for entry in report["effects"]
    )
    for entry in report["accelerations"]:
        assert entry["counters_on"]["samples"] <= entry["counters_off"]["samples"], entry["name"]
    assert report["machine"]["vtk"].startswith("VTK 9")
    assert "no OpenGL" not in report["machine"]["vtk"]
    assert len(report["against"]) == 8
    assert {entry["size"] for entry in report["against"]} == {24, 48}
    assert all(entry["ours_ms"] > 0 and entry["window_ms"] > 0 for entry in report["against"])
    assert all(entry["psnr"] is None or entry["psnr"] > 25 for entry in report["against"])
    for entry in report["exactness"]:
        assert (
            entry["psnr"] is None
            or entry["psnr"] > {"": 50, "cell": 25, "central": 42}[entry["gradient"]]
        ), entry
        assert entry["explained"] is None or entry["explained"] > 50, entry
    assert [entry["steps"] for entry in report["playback"]] == [3] * 4
    assert report["summary"].keys() == {
        "unshaded_median",
        "unshaded_least",
        "shaded_median",
        "shaded_least",
        "playback_median",
    }


def test_quality_rises_with_finer_steps(result: RenderBench) -> None:
    points = [point for point in result.curves if point.knob == "step"]
    assert [point.value for point in points] == [*STEPS, FINEST["step"]]
    assert points[-1].psnr is None
    qualities = [point.psnr for point in points[:-1] if point.psnr is not None]
    assert qualities == sorted(qualities)
    assert [point.samples for point in points] == sorted(point.samples for point in points)
    assert {point.knob for point in result.curves} == {"step", "threshold", "lod"}


def test_without_vtk_its_parts_say_so(volume: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vtkmodules.vtkRenderingVolume", None)
    found = bench_render(volume, parts=("vtk", "accelerations"), size=16, turns=1)
    assert found.against == ()
    assert "fhash[bench]" in found.refused["vtk"]
    assert len(found.accelerations) == 4


@pytest.mark.parametrize(
    "arguments", [{"parts": ("speed",)}, {"parts": ()}, {"turns": 0}, {"size": 3}]
)
def test_what_cannot_be_measured(arguments: dict[str, Any], volume: Volume) -> None:
    with pytest.raises(InputError):
        bench_render(volume, **arguments)


def test_marches_through_a_network_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "STREAM_SIZE", 12)
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    encode(field, tmp_path / "a.fhz", EncodeConfig(profile="paper", epochs=1, width=4))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        result = bench_render(volume, parts=NETWORK_PARTS, size=16, turns=1)
    assert result.refused == {}
    streams = {(entry.mode, entry.budget): entry for entry in result.streams}
    assert streams["arm", None].passes < streams["stream", None].passes
    assert streams["arm", None].largest == streams["stream", None].largest < 0.5
    assert streams["cache", None].evaluations == 0 < streams["arm", None].evaluations
    assert result.break_even
