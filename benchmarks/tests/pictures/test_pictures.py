"""`fhash bench render`: every part has its figures; VTK and OSPRay draw the same pictures."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blobs import CAMERAS, SHAPE, axes, drawn, field, task

import fhash_codec
from fhash_bench.pictures import render as render_module
from fhash_bench.pictures import shell as shell_module
from fhash_bench.pictures.render import bench_render, break_even
from fhash_bench.pictures.results import (
    NETWORK_PARTS,
    Against,
    BreakEven,
    Playback,
    RenderBench,
    Switch,
    plot,
)
from fhash_bench.pictures.shell import (
    OsprayPeer,
    beside_shell,
    find_ospray,
    load_ospray,
    orbit,
    shell,
)
from fhash_bench.pictures.vtk import Comparison, VtkPeer, transfer_functions, turned, vtk_picture
from fhash_codec import EncodeConfig, Volume, encode
from fhash_codec.cost.uses import FINEST, STEPS, black, in_turns, picture_psnr
from fhash_codec.progress import silent
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Units
from fhash_codec.rendering.scenes import Camera, Scene
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries


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


@pytest.mark.vtk
def test_vtk_draws_the_shell_unlit_and_lit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shell_module, "SIDE", 24)
    found = beside_shell(1, 24)
    assert [(pair.scene, pair.shaded) for pair in found] == [
        ("shell of 24^3", False),
        ("shell of 24^3", True),
    ]
    for pair in found:
        assert pair.peer.startswith("VTK 9")
        assert pair.ours_ms > 0
        assert pair.peer_ms >= 0
        assert pair.ratio == pair.peer_ms / pair.ours_ms
        assert pair.psnr is None or pair.psnr > 20


def test_without_any_peer_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise MissingDependencyError("comparing with VTK needs it: pip install 'fhash[bench]'")

    monkeypatch.setattr(shell_module, "require_vtk", missing)
    with pytest.raises(MissingDependencyError, match="pip install"):
        beside_shell(1, 16)


def test_a_shell_lies_about_the_middle() -> None:
    values = shell(41)
    assert values.shape == (41, 41, 41)
    assert values.dtype == np.float32
    assert values.max() > 0.9
    assert values[20, 20, 20] == values[0, 0, 0] == pytest.approx(0, abs=1e-6)


def test_pictures_with_kept_bricks_take_the_same_samples() -> None:
    unlit, lit = orbit(2, 24, side=40)
    assert unlit.name == "shell of 40^3, unlit: bricks kept"
    for switch in (unlit, lit):
        assert switch.counters_off == switch.counters_on
        assert switch.off_ms > 0
        assert switch.on_ms > 0
    assert unlit.counters_on["gradients"] == 0 < lit.counters_on["gradients"]


FAKE = r"""
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
typedef void *H;
static FILE *notes;
static char handle[64];
static int next, wide, high;
static float *pixels;
static H made(const char *kind, const char *name) {
    fprintf(notes, "new %s %s\n", kind, name);
    fflush(notes);
    return handle + ++next % 60;
}
int ospInit(int *count, const char **words) {
    notes = fopen(getenv("FAKE_OSPRAY_NOTES"), "w");
    fprintf(notes, "init %d %s\n", *count, words[1]);
    return 0;
}
H ospGetCurrentDevice(void) { return handle; }
int64_t ospDeviceGetProperty(H d, uint32_t which) { return which == 1 ? MAJOR : which; }
const char *ospDeviceGetLastErrorMsg(H d) { return "an error"; }
H ospNewSharedData(const void *data, uint32_t type, uint64_t x, int64_t a, uint64_t y, int64_t b,
                   uint64_t z, int64_t c, void *f, void *g) {
    fprintf(notes, "data %u %d %d %d first %g\n", type, (int)x, (int)y, (int)z, *(float *)data);
    return handle + ++next % 60;
}
H ospNewVolume(const char *name) { return made("volume", name); }
H ospNewTransferFunction(const char *name) { return made("function", name); }
H ospNewCamera(const char *name) { return made("camera", name); }
H ospNewRenderer(const char *name) { return made("renderer", name); }
H ospNewVolumetricModel(H volume) { return made("model", ""); }
H ospNewGroup(void) { return made("group", ""); }
H ospNewInstance(H group) { return made("instance", ""); }
H ospNewWorld(void) { return made("world", ""); }
H ospNewFrameBuffer(int w, int h, uint32_t format, uint32_t channels) {
    wide = w, high = h;
    pixels = calloc(4 * w * h, sizeof(float));
    for (int i = 0; i < w; i++) pixels[4 * i] = 1;  /* the lowest row is red */
    return made("buffer", "");
}
void ospSetParam(H t, const char *name, uint32_t type, const float *v) {
    fprintf(notes, "param %s %u %g %g\n", name, type, v[0], v[1]);
}
void ospSetFloat(H t, const char *name, float v) { fprintf(notes, "float %s %g\n", name, v); }
void ospSetVec3f(H t, const char *name, float x, float y, float z) {
    fprintf(notes, "vector %s %g %g %g\n", name, x, y, z);
}
void ospSetObject(H t, const char *name, H v) { fprintf(notes, "object %s\n", name); }
void ospSetObjectAsData(H t, const char *name, uint32_t type, H v) {
    fprintf(notes, "objects %s %u\n", name, type);
}
void ospCommit(H o) {}
void ospRelease(H o) { fprintf(notes, "release\n"); fflush(notes); }
H ospRenderFrame(H b, H r, H c, H w) { return made("future", ""); }
void ospWait(H f, uint32_t event) { fprintf(notes, "wait %u\n", event); }
const void *ospMapFrameBuffer(H b, uint32_t channel) { return pixels; }
void ospUnmapFrameBuffer(const void *p, H b) {}
"""


def built(folder: Path, source: str, name: str = "libospray.so") -> Path:
    """A shared library of a C source."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    (folder / "fake.c").write_text(source)
    path = folder / name
    subprocess.run([compiler, "-shared", "-fPIC", "-o", path, folder / "fake.c"], check=True)
    return path


def test_ospray_is_given_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_OSPRAY_NOTES", str(tmp_path / "notes"))
    built(tmp_path, FAKE.replace("MAJOR", "3"))
    library, version = load_ospray(find_ospray(str(tmp_path)), 2)
    assert version == "3.2.3"
    asked, values = task(CAMERAS[0], shaded=False, step=0.25), field()[1]
    assert asked.table is not None
    grid = asked.rays.grid
    peer = OsprayPeer(library, values, grid, asked.table, size=(6, 4), step=asked.step)
    peer.look(asked.rays)
    drawn = peer.draw()
    peer.close()
    # The rows of OSPRay begin at the bottom.
    assert drawn.pixels.shape == (4, 6, 3)
    assert drawn.pixels[3, :, 0].tolist() == [255] * 6
    assert not drawn.pixels[:3].any()
    notes = (tmp_path / "notes").read_text().splitlines()
    assert notes[0] == "init 2 --osp:num-threads=2"
    assert "data 6000 {2} {1} {0}".format(*values.shape) in notes[2]
    spacing = np.abs(grid.spacing)
    assert "vector gridSpacing " + " ".join(f"{part:g}" for part in spacing) in notes
    assert f"float volumeSamplingRate {spacing.min() / asked.step:g}" in notes
    assert f"float densityScale {asked.table.extinctions.max():g}" in notes
    assert f"param value 10000 {asked.table.low:g} {asked.table.high:g}" in notes
    assert any(line.startswith("float fovy") for line in notes)
    assert sum(line.startswith("release") for line in notes) > 10
    assert {"new volume structuredRegular", "new renderer scivis"} <= set(notes)


def test_what_is_no_ospray_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_OSPRAY_NOTES", str(tmp_path / "notes"))
    for named in (str(tmp_path), "no_such_module", "json", "a b"):
        with pytest.raises(InputError, match="no OSPRay there"):
            find_ospray(named)
    text = tmp_path / "text.so"
    text.write_text("no library")
    with pytest.raises(InputError, match="cannot be loaded"):
        load_ospray(find_ospray(str(text)), 1)
    other = built(tmp_path, "int other(void) { return 1; }", "other.so")
    with pytest.raises(InputError, match="it has no ospInit, so it is no OSPRay 2 or 3"):
        load_ospray(other, 1)
    old = built(tmp_path, FAKE.replace("MAJOR", "1"), "old.so")
    with pytest.raises(InputError, match=r"OSPRay 1\.2\.3; versions 2 and 3 are known"):
        load_ospray(old, 1)


def test_transfer_functions_are_of_the_values() -> None:
    values = field()[1]
    found = transfer_functions(values, Units())
    feature = np.array(found["feature"].opacity)
    assert np.all(np.diff(feature[:, 0]) > 0)
    inside = (values > feature[0, 0]) & (values < feature[-1, 0])
    assert 0.01 < inside.mean() < 0.2
    np.testing.assert_allclose(
        found["fog"].opacity, [(values.min(), 0), (values.max(), 0.02)], atol=1e-6
    )
    flat = np.array(
        transfer_functions(np.full((2, 2, 2), 3.0, dtype=np.float32), Units())["feature"].opacity
    )
    assert np.all(np.diff(flat[:, 0]) > 0)


def test_sides_are_spread_over_a_turn() -> None:
    scene = Scene(camera=Camera(azimuth=30))
    assert [turned(scene, turn, 4).camera.azimuth for turn in range(4)] == [30, 120, 210, 300]


@pytest.mark.vtk
def test_a_comparison_is_of_the_whole_domain(tmp_path: Path) -> None:
    path = tmp_path / "part.fhz"
    series = ArraySeries(field(), name="density", units="", coords=axes())
    fhash_codec.encode(
        series, path, EncodeConfig(features=("interval:0.5:2",), effort=1, max_error=0.002)
    )
    with fhash_codec.open(path) as opened:
        found = Comparison(opened, Scene(size=(16, 16)), 1, lambda *report: None)
    assert found.values.shape == SHAPE[1:]
    assert np.isfinite(found.values).all()


@pytest.mark.vtk
@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
@pytest.mark.parametrize("shaded", [False, True], ids=["unlit", "lit"])
def test_vtk_by_its_own_rules_is_the_reference(camera: Camera, shaded: bool) -> None:
    values, asked = field()[1], task(camera, shaded=shaded, step=0.4)
    theirs = drawn(asked, values)
    assert theirs.max() > 60
    psnr = picture_psnr(black(vtk_picture(values, asked)), theirs, 255.0)
    assert psnr is None or psnr > 50


@pytest.mark.vtk
@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
def test_the_same_picture_as_vtk_unlit(camera: Camera) -> None:
    values, asked = field()[1], task(camera, shaded=False, step=0.05)
    ours = black(march(Frame(values=values, first=(0, 0, 0)), asked).rgba)
    psnr = picture_psnr(ours, drawn(asked, values), 255.0)
    assert psnr is None or psnr > 50


@pytest.mark.vtk
def test_the_ray_caster_of_vtk_gets_the_same_scene() -> None:
    values, asked = field()[1], task(CAMERAS[0], shaded=False, step=0.5)
    psnr = picture_psnr(black(vtk_picture(values, asked)), drawn(asked, values, "cpu"), 255.0)
    assert psnr is None or psnr > 35


@pytest.mark.vtk
def test_vtk_takes_up_another_frame_and_an_empty_window_is_black() -> None:
    asked = task(CAMERAS[0], shaded=False, step=0.5)
    first, last = field()[0], field()[3]
    peer = VtkPeer(first, asked, unit=1.0)
    empty = VtkPeer(first, asked, unit=1.0, empty=True)
    peer.look(asked.rays)
    before = peer.draw().pixels
    peer.load(last)
    after = peer.draw()
    np.testing.assert_array_equal(after.pixels, drawn(asked, last, "cpu"))
    assert not np.array_equal(before, after.pixels)
    assert after.seconds > 0
    assert not empty.draw().pixels.any()
    assert "VTK 9" in peer.version
    peer.close()
    empty.close()


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
    monkeypatch.setattr(render_module, "LOST", lost)
    path = tmp_path / "a.fhz"
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    fhash_codec.encode(
        field, path, EncodeConfig(preset="published", tables="float16", epochs=1, width=4)
    )
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


@pytest.mark.vtk
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
    monkeypatch.setattr(render_module, "STREAM_SIZE", 12)
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    encode(
        field,
        tmp_path / "a.fhz",
        EncodeConfig(preset="published", tables="float16", epochs=1, width=4),
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        result = bench_render(volume, parts=NETWORK_PARTS, size=16, turns=1)
    assert result.refused == {}
    cache, streamed, adaptive = result.streams
    assert (cache.mode, streamed.mode, adaptive.mode) == ("cache", "stream", "arm")
    assert cache.samples > 0
    assert streamed.samples == adaptive.samples
    assert adaptive.largest == pytest.approx(streamed.largest, abs=2e-5)  # rounding of two marchers
    assert max(streamed.largest, adaptive.largest) < 0.5
    assert cache.evaluations == 0 < adaptive.evaluations
    assert result.break_even
