"""Frames whose tiles are decoded as rays come to them: pictures of every way to march agree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_field import SCENES, blobs

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene, Volume
from fhash_codec.boxes import Box
from fhash_codec.rendering import tiled_frame
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march_task import Arrays, Units
from fhash_codec.rendering.tiled_frame import TiledFrame, decoded_frame
from fhash_formats.errors import DamagedFileError
from fhash_formats.series import ArraySeries, Coordinate

TILE: dict[str, Any] = {"effort": 1, "tile": "1x8x8x8"}


def uneven() -> ArraySeries:
    """The blobs on uneven axes z and x, with a slab without values."""
    values = blobs()
    values[:, 5:9, :, 4:13] = np.nan
    steps = {"z": 1 + 0.5 * np.sin(np.arange(20)), "x": 1 + 0.6 * np.cos(np.arange(28))}
    coords = {axis: np.cumsum(pace) for axis, pace in steps.items()} | {"t": np.arange(3.0)}
    coords["y"] = np.arange(24.0)
    return ArraySeries(
        values, coords={axis: Coordinate(name=axis, values=at) for axis, at in coords.items()}
    )


KINDS: dict[str, tuple[Callable[[], Any], EncodeConfig]] = {
    "plain": (blobs, EncodeConfig(**TILE, train="none")),
    "trained": (blobs, EncodeConfig(**TILE, train="2s")),
    "bounded": (blobs, EncodeConfig(**TILE, max_error=0.3)),
    "feature": (blobs, EncodeConfig(**TILE, features=("interval:3:99",), dilation=0)),
    "uneven": (uneven, EncodeConfig(**TILE)),
    "fast": (blobs, EncodeConfig(effort=1, preset="fast")),
    "small": (blobs, EncodeConfig(effort=1, preset="small")),
}


class TiledFiles(dict[str, Path]):
    """Paths by kind of KINDS; a file is encoded when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def __missing__(self, kind: str) -> Path:
        values, config = KINDS[kind]
        self[kind] = path = self.folder / f"{kind}.fhz"
        fhash_codec.encode(values(), path, config)
        return path


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> TiledFiles:
    """Files of small tiles."""
    return TiledFiles(tmp_path_factory.mktemp("tiled"))


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a block be a tile of 8^3."""
    monkeypatch.setattr(tiled_frame, "BLOCK", 8)


def picture(
    source: Path | Renderer, mode: str, scene: dict[str, Any], size: tuple[int, int] = (48, 40)
) -> Image:
    march = {"lod": 0, **scene.get("march", {}), "mode": mode}
    asked = Scene.from_dict({"size": size, **scene, "march": march})
    if isinstance(source, Renderer):
        return source.render(asked)
    with fhash_codec.open(source) as volume:
        return Renderer(volume).render(asked)


def assert_same(found: Image, expected: Image, atol: float) -> None:
    """Compare colours, depths and normals."""
    np.testing.assert_allclose(found.rgba, expected.rgba, atol=atol)
    if expected.depth is not None and found.depth is not None:
        np.testing.assert_allclose(found.depth, expected.depth, atol=1e-3)
    if expected.normal is not None and found.normal is not None:
        np.testing.assert_allclose(found.normal, expected.normal, atol=1e-3)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("kind", ["plain", "bounded", "feature", "uneven"])
def test_every_way_to_march_a_file_makes_one_picture(
    tiled: TiledFiles, kind: str, scene: dict[str, Any]
) -> None:
    cache, arm, stream = (picture(tiled[kind], mode, scene) for mode in ("cache", "arm", "stream"))
    assert cache.rgba[..., 3].max() > 0.02
    assert_same(arm, cache, 1e-6)
    assert_same(stream, cache, 1e-3)
    assert arm.counters["evaluations"] == stream.counters["evaluations"] == 0


@pytest.mark.parametrize("kind", ["trained", "fast", "small"])
@pytest.mark.parametrize("scene", ["surfaces", "between", "all light"])
def test_so_it_does_of_every_preset(tiled: TiledFiles, kind: str, scene: str) -> None:
    test_every_way_to_march_a_file_makes_one_picture(tiled, kind, SCENES[scene])


@pytest.mark.parametrize(
    ("kind", "lod"), [("plain", 1), ("plain", 2), ("feature", 1), ("uneven", 1)]
)
@pytest.mark.parametrize(
    "scene",
    [
        "surfaces",
        "shaded",
        "narrow",
        "between",
        "graded by central differences",
        "clipped",
        "average",
    ],
)
def test_so_it_does_of_every_level_of_detail(
    tiled: TiledFiles, kind: str, lod: int, scene: str
) -> None:
    march = {"march": {"lod": lod}}
    test_every_way_to_march_a_file_makes_one_picture(tiled, kind, {**SCENES[scene], **march})


@pytest.mark.torch
@pytest.mark.parametrize("kind", ["plain", "uneven"])
@pytest.mark.parametrize("scene", ["shaded", "surfaces", "maximum", "all light", "between"])
def test_tensors_of_a_device_make_the_same_picture(
    tiled: TiledFiles, kind: str, scene: str, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame is marched as on CUDA, by tensors of the processor."""
    cache = picture(tiled[kind], "cache", SCENES[scene])
    used: list[str] = []

    def arrays_on(device: str) -> Arrays:
        used.append(device)
        return tensors

    monkeypatch.setattr("fhash_codec.rendering.plan.arrays_on", arrays_on)
    monkeypatch.setattr("fhash_codec.devices.has_device", lambda: True)
    there = {**SCENES[scene], "march": {"device": "cuda"}}
    assert_same(picture(tiled[kind], "stream", there), cache, 1e-3)
    assert set(used) == {"cuda"}


def test_all_threads_make_the_picture_of_one(tiled: TiledFiles) -> None:
    for scene in ("surfaces", "narrow"):
        with fhash_codec.open(tiled["plain"]) as volume:
            one, many = (
                picture(Renderer(volume, threads=threads), "arm", SCENES[scene], (120, 100))
                for threads in (1, 5)
            )
        assert_same(many, one, 1e-6)
        assert many.counters["decoded_vertices"] == one.counters["decoded_vertices"]


OPAQUE: dict[str, Any] = {
    "step": 0,
    "camera": {"view": "xy", "projection": "parallel"},
    "transfer_function": {"opacity": [[-1, 1], [99, 1]]},
}
"""A view of the first opaque layer."""


def test_tiles_behind_what_is_opaque_are_not_decoded(tiled: TiledFiles) -> None:
    cache, arm = (picture(tiled["plain"], mode, OPAQUE) for mode in ("cache", "arm"))
    assert cache.counters["decoded_vertices"] == 20 * 24 * 28
    assert arm.counters["decoded_vertices"] <= 8 * 24 * 28
    assert_same(arm, cache, 1e-6)


def test_a_frame_goes_on_from_what_is_decoded(
    tiled: TiledFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[Box] = []

    def noted(volume: Volume, step: float, lod: int, region: Box, units: Units) -> Any:
        decoded.append(region)
        return decoded_frame(volume, step, lod, region, units)

    monkeypatch.setattr(tiled_frame, "decoded_frame", noted)
    with fhash_codec.open(tiled["plain"]) as volume:
        renderer = Renderer(volume)
        first = picture(renderer, "arm", OPAQUE)
        some = len(decoded)
        assert some > 1
        again = picture(renderer, "arm", OPAQUE)
        assert len(decoded) == some
        np.testing.assert_array_equal(again.rgba, first.rgba)
        assert again.counters["decoded_vertices"] == first.counters["decoded_vertices"]
        plain = {"step": 0}
        whole = picture(renderer, "cache", plain)
        assert whole.counters["decoded_vertices"] == 20 * 24 * 28
        regions = [
            {(z, y, x) for z in range(*box.z) for y in range(*box.y) for x in range(*box.x)}
            for box in decoded
        ]
        assert sum(map(len, regions)) == len(set().union(*regions)) == 20 * 24 * 28
        assert_same(whole, picture(tiled["plain"], "cache", plain), 0)
        assert_same(picture(renderer, "arm", plain), whole, 0)


@pytest.mark.parametrize("threads", [1, 4])
def test_a_tile_that_cannot_be_decoded_ends_the_picture(
    tiled: TiledFiles, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    calls: list[int] = []

    def damaged(*given: Any) -> Any:
        calls.append(0)
        if len(calls) > 3:
            raise DamagedFileError("a tile is damaged")
        return decoded_frame(*given)

    monkeypatch.setattr(tiled_frame, "decoded_frame", damaged)
    with fhash_codec.open(tiled["plain"]) as volume:
        for scene in (SCENES["plain"], SCENES["surfaces"], SCENES["maximum"]):
            calls.clear()
            renderer = Renderer(volume, threads=threads)
            with pytest.raises(DamagedFileError, match="a tile is damaged"):
                picture(renderer, "arm", {"step": 0, **scene}, (100, 80))
            assert len(calls) <= 3 + threads


def test_values_that_are_scaled_are_decoded_at_once(tmp_path: Path) -> None:
    values = blobs() * np.float32(3e36)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(**TILE))
    cache, arm = (picture(tmp_path / "a.fhz", mode, {"step": 0}) for mode in ("cache", "arm"))
    assert cache.rgba[..., 3].max() > 0.02
    assert_same(arm, cache, 0)


@pytest.mark.parametrize("lod", [0, 1, 2])
@pytest.mark.parametrize("kind", ["plain", "feature", "uneven"])
def test_blocks_make_the_frame_that_is_decoded_at_once(
    tiled: TiledFiles, kind: str, lod: int
) -> None:
    with fhash_codec.open(tiled[kind]) as volume:
        plan = Renderer(volume).plan(Scene(step=0.25))
        given: dict[str, Any] = {"units": plan.units, "warp": plan.task.rays.grid.warp}
        region = Box.of_shape(volume.shape[1:])
        whole, parts = (
            TiledFrame(volume, 0.25, lod, region, **given, whole=at_once)
            for at_once in (True, False)
        )
        assert parts.vertices == 0
        for block in np.ndindex(*parts.decoded.shape):
            parts.decode(block)
            parts.decode(block)
        again = TiledFrame(volume, 0.25, lod, region, **given, whole=False)
        again.complete()
    for frame in (parts, again):
        assert frame.vertices == whole.vertices == frame.frame.values.size
        rounding = 1e-6 if kind == "uneven" else 0  # of what is resampled
        for found, expected in (
            (frame.frame.values, whole.frame.values),
            (frame.bricks.low, whole.bricks.low),
            (frame.bricks.high, whole.bricks.high),
        ):
            np.testing.assert_allclose(found, expected, rtol=0, atol=rounding)
        assert frame.frame.first == whole.frame.first


@pytest.mark.parametrize(
    ("scene", "mode"),
    [
        ({}, "cache"),
        ({"effects": {"isosurfaces": [{"value": 4}]}}, "arm"),
        ({"effects": {"isosurfaces": [{"value": 4, "opacity": 0.5}]}}, "cache"),
        ({"effects": {"isosurfaces": [{"value": 4}], "maximum_intensity": True}}, "cache"),
        ({"effects": {"isosurfaces": [{"value": 4}], "shadows": True}}, "cache"),
        ({"transfer_function": {"opacity": [[0, 1], [10, 1]]}}, "arm"),
        ({"transfer_function": {"opacity": [[0, 0.01], [10, 0.1]]}}, "cache"),
    ],
)
def test_auto_is_arm_where_rays_end_early(
    tiled: TiledFiles, monkeypatch: pytest.MonkeyPatch, scene: dict[str, Any], mode: str
) -> None:
    with fhash_codec.open(tiled["plain"]) as volume:
        asked = Scene.from_dict({"step": 0, "march": {"lod": 0}, **scene})
        planned = Renderer(volume).plan(asked)
        assert planned.mode == mode
        line = planned.to_dict()["march"]
        assert ("rays end at what is opaque" in line) == (mode == "arm")
        assert ("fastest on a CPU where rays need most tiles" in line) == (mode == "cache")
        monkeypatch.setattr(tiled_frame, "BLOCK", 64)  # the whole frame is one block
        assert Renderer(volume).plan(asked).mode == "cache"
