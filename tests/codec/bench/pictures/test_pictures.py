"""`fhash bench render`: pictures are compared as they are, VTK gets the same scene, and every part has its figures."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.bench.pictures.beside_vtk import Comparison, transfer_functions, turned
from fhash_codec.bench.pictures.likeness import black, picture_psnr, picture_ssim
from fhash_codec.bench.pictures.pictures import FINEST, STEPS, bench_render, in_turns
from fhash_codec.bench.pictures.plot import plot
from fhash_codec.bench.pictures.reference import vtk_picture
from fhash_codec.bench.pictures.results import RenderBench
from fhash_codec.bench.pictures.vtk_peer import VtkPeer
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.march import march
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import Camera, Scene
from fhash_codec.rendering.task.task import Frame, Lighting, Table, Task
from fhash_codec.rendering.task.units import Units
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Coordinate

SHAPE = (4, 12, 14, 16)
SIZE = (72, 60)
LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.3, specular_power=12.0, lamp=None)


def field() -> np.ndarray:
    """Two blobs of which one moves along x, on 0; the small one tells mirrored axes apart."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    large = np.exp(-((z - 5) ** 2 + (y - 6) ** 2 + (x - 6 - t) ** 2) / 12)
    return (
        large + 0.7 * np.exp(-((z - 9) ** 2 + (y - 3) ** 2 + (x - 13) ** 2) / 4) + 0 * t
    ).astype(np.float32)


def axes() -> dict[str, Coordinate]:
    """Spacings that differ, y descending."""
    values = {
        "t": np.arange(4.0),
        "z": 3 + 1.5 * np.arange(12),
        "y": 20 - np.arange(14.0),
        "x": 0.8 * np.arange(16),
    }
    return {
        axis: Coordinate(name=axis, values=positions, attributes={})
        for axis, positions in values.items()
    }


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("blobs") / "blobs.fhz"
    series = ArraySeries(field(), name="density", units="", coords=axes())
    fhash_codec.encode(series, path, EncodeConfig(effort=1, max_error=0.002))
    with fhash_codec.open(path) as opened:
        yield opened


def task(camera: Camera, *, shaded: bool, step: float) -> Task:
    values = np.linspace(0, 1, 512)
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.stack([values, 1 - values, 0.5 + 0 * values], axis=-1).astype(np.float32),
        extinctions=0.5 * np.clip(values - 0.1, 0, None),
    )
    rays = Rays.of(camera, Grid.of(axes()), SIZE)
    return Task(
        rays=rays,
        step=step,
        threshold=0.0,
        table=table,
        lighting=LIGHTING if shaded else None,
        shaded=shaded,
    )


def drawn(asked: Task, values: np.ndarray, mapper: str = "gpu") -> np.ndarray:
    assert asked.table is not None
    peer = VtkPeer(
        values,
        asked.rays.grid,
        asked.table,
        unit=1.0,
        size=SIZE,
        step=asked.step,
        mapper=mapper,
        lighting=asked.lighting,
    )
    try:
        peer.look(asked.rays)
        peer.draw()
        return peer.draw().pixels
    finally:
        peer.close()


CAMERAS = (
    Camera(azimuth=25, elevation=15),
    Camera(view="xz", projection="parallel", azimuth=-10),
    Camera(position=(9.0, 30.0, 12.0), focal_point=(6.0, 13.0, 10.0), view_up=(0.3, 0, 1)),
)


@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
@pytest.mark.parametrize("shaded", [False, True], ids=["unlit", "lit"])
def test_vtk_by_its_own_rules_is_the_reference(camera: Camera, shaded: bool) -> None:
    values, asked = field()[1], task(camera, shaded=shaded, step=0.4)
    theirs = drawn(asked, values)
    assert theirs.max() > 60
    psnr = picture_psnr(black(vtk_picture(values, asked)), theirs, 255.0)
    assert psnr is None or psnr > 50


@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
def test_the_same_picture_as_vtk_unlit(camera: Camera) -> None:
    values, asked = field()[1], task(camera, shaded=False, step=0.05)
    ours = black(march(Frame(values=values, first=(0, 0, 0)), asked).rgba)
    psnr = picture_psnr(ours, drawn(asked, values), 255.0)
    assert psnr is None or psnr > 50


def test_the_ray_caster_of_vtk_gets_the_same_scene() -> None:
    values, asked = field()[1], task(CAMERAS[0], shaded=False, step=0.5)
    psnr = picture_psnr(black(vtk_picture(values, asked)), drawn(asked, values, "cpu"), 255.0)
    assert psnr is None or psnr > 35


def test_vtk_takes_up_another_frame_and_an_empty_window_is_black() -> None:
    asked = task(CAMERAS[0], shaded=False, step=0.5)
    assert asked.table is not None
    first, last = field()[0], field()[3]
    peer = VtkPeer(first, asked.rays.grid, asked.table, unit=1.0, size=SIZE, step=0.5)
    empty = VtkPeer(first, asked.rays.grid, asked.table, unit=1.0, size=SIZE, step=0.5, empty=True)
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


def test_likeness_of_pictures() -> None:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)
    assert picture_psnr(one, one, 255.0) is None
    assert picture_psnr(one, one + np.uint8(10), 255.0) == pytest.approx(20 * np.log10(25.5))
    assert picture_ssim(one, one) == pytest.approx(1.0)
    assert picture_ssim(one, rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)) < 0.2


def test_variants_run_in_turns() -> None:
    order: list[str] = []

    def run(name: str) -> Image:
        order.append(name)
        return Image(rgba=np.zeros((1, 1, 4), dtype=np.float32))

    found = in_turns({"a": lambda: run("a"), "b": lambda: run("b")}, 3)
    assert order == ["a", "b"] * 4
    assert all(milliseconds > 0 for milliseconds, _ in found.values())


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


@pytest.fixture(scope="module")
def result(volume) -> RenderBench:
    return bench_render(volume, Scene(step=1.0), size=24, turns=1)


def test_every_part_has_its_figures(result: RenderBench) -> None:
    report = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert report["refused"] == {}
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
    streams = {(entry["mode"], entry["budget"]): entry for entry in report["streams"]}
    assert all(entry["largest"] < 1e-3 for entry in report["streams"])
    assert streams["arm", None]["passes"] < streams["stream", None]["passes"]
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


def test_a_result_is_drawn(result: RenderBench, tmp_path: Path) -> None:
    plot(result, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="nothing to draw"):
        plot(dataclasses.replace(result, curves=(), against=()), tmp_path / "b.png")


def test_without_vtk_its_parts_say_so(volume, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vtkmodules.vtkRenderingVolume", None)
    found = bench_render(volume, parts=("vtk", "accelerations"), size=16, turns=1)
    assert found.against == ()
    assert "fhash[vtk]" in found.refused["vtk"]
    assert len(found.accelerations) == 4


@pytest.mark.parametrize(
    "arguments", [{"parts": ("speed",)}, {"parts": ()}, {"turns": 0}, {"size": 3}]
)
def test_what_cannot_be_measured(arguments: dict, volume) -> None:
    with pytest.raises(InputError):
        bench_render(volume, **arguments)


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
