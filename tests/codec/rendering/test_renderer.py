"""The renderer, and evolutions."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked import ended_well, forked, needs_fork

import fhash_codec
from fhash_codec import Renderer, Scene, Volume
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering import render
from fhash_codec.rendering import renderer as module
from fhash_codec.rendering.march_task import Units
from fhash_codec.rendering.renderer import evolution
from fhash_codec.rendering.scenes import Effects, Evolution, scene_in_png
from fhash_codec.rendering.scenes import Scene as Scene_evolution
from fhash_formats.errors import InputError

SMALL = Scene(size=(40, 32))


def test_the_function_renders_a_picture(volume: Volume) -> None:
    image = fhash_codec.render(volume, SMALL)
    assert image.rgba.shape == (32, 40, 4)
    assert image.rgba[..., 3].max() > 0.1
    assert image.source == volume.path.name
    assert image.seconds > 0
    assert image._repr_png_().startswith(b"\x89PNG")


def test_without_a_scene_the_default_is_rendered(volume: Volume) -> None:
    stages = []
    image = render(volume, progress=lambda stage, *_: stages.append(stage))
    assert image.rgba.shape == (*Scene().size[::-1], 4)
    assert dict(image.scene) == Scene().to_dict()
    assert set(stages) == {"decoding", "marching"}


@pytest.mark.parametrize(
    "statement",
    [
        "import fhash_codec.rendering.renderer; f = fhash_codec.render",
        "from fhash_codec import render as f; import fhash_codec.rendering.scenes as s",
        "from fhash_codec import *; f = render; import fhash_codec.rendering.scenes",
    ],
)
def test_the_function_is_the_same_whatever_was_imported_before(statement: str) -> None:
    check = "import fhash_codec.rendering; assert fhash_codec.rendering.render is f"
    subprocess.run([sys.executable, "-c", f"{statement}; {check}"], check=True)


def test_importing_the_package_loads_no_renderer() -> None:
    code = (
        "import sys, fhash_codec.rendering; slow = ('PIL', 'fhash_codec.rendering.'); "
        "print([name for name in sys.modules if name.startswith(slow)])"
    )
    command = [sys.executable, "-c", code]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "[]\n"


SMALL_RENDERER = {"size": [40, 32]}


def scene(**parts: Any) -> Scene:
    return Scene.from_dict({**SMALL_RENDERER, **parts})


def test_a_picture_is_what_its_file_says(volume: Volume, tmp_path: Path) -> None:
    shown = scene(effects={"box": True, "colour_bar": True}, step=1)
    image = fhash_codec.render(volume, shown)
    image.save(tmp_path / "view.png")
    assert scene_in_png(tmp_path / "view.png") == shown
    again = fhash_codec.render(volume, scene_in_png(tmp_path / "view.png"))
    np.testing.assert_array_equal(again.rgba, image.rgba)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The steps that renderers decode, in order."""
    steps: list[float] = []
    original = module.decoded_frame

    def noted(volume: Volume, step: float, *others: Any) -> Any:
        steps.append(step)
        return original(volume, step, *others)

    monkeypatch.setattr(module, "decoded_frame", noted)
    return steps


def test_what_was_decoded_is_kept(renderer: Renderer, decoded: list[float]) -> None:
    first = renderer.render(scene())
    renderer.render(scene(camera={"azimuth": 40}))
    renderer.render(scene(step=2))
    last = renderer.render(scene())
    assert decoded == [0, 2]
    np.testing.assert_array_equal(first.rgba, last.rgba)


def test_what_comes_next_is_decoded_beside(volume: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[tuple[float, bool]] = []
    original = module.decoded_frame

    def counted(volume: Volume, step: float, *others: Any) -> Any:
        decoded.append((step, threading.current_thread() is threading.main_thread()))
        return original(volume, step, *others)

    monkeypatch.setattr(module, "decoded_frame", counted)
    renderer, alone = Renderer(volume), Renderer(volume)
    shown = [scene(step=step) for step in (0, 1, 2)]
    for current, following in zip(shown, [*shown[1:], None], strict=True):
        np.testing.assert_array_equal(
            renderer.render(current, upcoming=following).rgba, alone.render(current).rgba
        )
    assert [entry for entry in decoded if not entry[1]] == [(1, False), (2, False)]
    assert sorted(entry[0] for entry in decoded) == [0, 0, 1, 1, 2, 2]
    # Prefetched frames that are not needed, and scenes without a plan or a frame, do no harm.
    renderer.render(shown[0], upcoming=scene(step=0.5))
    assert renderer.render(scene(step=1.5)).rgba.any()
    renderer.render(shown[0], upcoming=scene(step=99))
    renderer.render(shown[0], upcoming=scene(step=1.25, march={"mode": "arm"}))
    with pytest.raises(InputError, match="step 99 is outside"):
        renderer.render(scene(step=99))


@needs_fork
def test_a_forked_process_does_not_wait_for_what_its_parent_decodes(volume: Volume) -> None:
    renderer = Renderer(volume)
    expected = renderer.render(scene(step=1)).rgba
    renderer = Renderer(volume)
    renderer.render(scene(step=0), upcoming=scene(step=1))

    def draws() -> bool:
        shown = renderer.render(scene(step=1), upcoming=scene(step=2)).rgba
        return np.array_equal(shown, expected) and renderer.render(scene(step=2)).rgba.any()

    assert ended_well(forked(draws))
    np.testing.assert_array_equal(renderer.render(scene(step=1)).rgba, expected)


def test_what_does_not_fit_is_not_kept(volume: Volume, decoded: list[float]) -> None:
    frame = int(np.prod(volume.shape[1:])) * 4
    small = Renderer(volume, memory=frame + 10)
    for step in (0, 1, 1, 2, 1):
        small.render(scene(step=step))
    assert decoded == [0, 1, 2, 1]
    decoded.clear()
    none = Renderer(volume, memory=10)
    for _ in range(2):
        assert none.render(scene()).rgba[..., 3].any()
    assert decoded == [0, 0]


def test_a_part_of_the_volume_makes_the_picture_of_all(volume: Volume) -> None:
    volume.chunks = (1, 4, 4, 4)
    close = scene(camera={"zoom": 6, "projection": "parallel", "view": "xy"})
    renderer = Renderer(volume)
    region = renderer.plan(close).region
    assert np.prod([high - low for low, high in region]) < np.prod(volume.shape[1:])
    cropped = renderer.render(close)
    full = Renderer(volume)
    full.render(scene())
    np.testing.assert_allclose(full.render(close).rgba, cropped.rgba, atol=1e-5)


def test_nothing_in_the_picture_is_an_empty_picture(volume: Volume) -> None:
    away = scene(camera={"position": [100, 100, 100], "focal_point": [200, 200, 200]})
    image = fhash_codec.render(volume, away)
    assert not image.rgba.any()
    assert image.counters["samples"] == 0


def test_a_step_between_is_the_mean_of_values(volume: Volume) -> None:
    frame = module.decoded_frame(volume, 0.5, 0, ((0, 20), (0, 24), (0, 28)), Units())
    np.testing.assert_allclose(frame.values, (volume.read(0) + volume.read(1)) / 2, atol=1e-5)
    coarse = module.decoded_frame(volume, 0.5, 1, ((0, 20), (0, 24), (0, 28)), Units())
    np.testing.assert_allclose(
        coarse.values, (volume.read_lod(0, 1) + volume.read_lod(1, 1)) / 2, atol=1e-5
    )
    assert coarse.stride == 2


def test_what_lies_outside_the_coreset_is_not_seen(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["feature"]) as volume:
        frame = module.decoded_frame(volume, 0.0, 0, ((0, 20), (0, 24), (0, 28)), Units())
        assert np.isnan(frame.values).any()
        assert frame.first == tuple(low for low, _ in volume.box)
        image = fhash_codec.render(volume, scene(transfer_function={"opacity": "opaque"}))
        assert 0 < (image.rgba[..., 3] > 0.5).mean() < 0.5


def test_light_costs_secondary_rays_and_nothing_else(renderer: Renderer) -> None:
    plain, shaded = (renderer.render(scene(effects=effects)) for effects in ({}, {"shading": True}))
    for name in ("shadows", "ambient_occlusion"):
        dark = renderer.render(scene(effects={name: True}))
        assert dark.counters["secondary_rays"] > 0
        assert {**dark.counters, "secondary_rays": 0} == plain.counters
        np.testing.assert_allclose(dark.rgba[..., 3], plain.rgba[..., 3], atol=1e-6)
        assert dark.rgba[..., :3].sum() < plain.rgba[..., :3].sum()
        both = renderer.render(scene(effects={name: True, "shading": True}))
        assert both.counters == {
            **shaded.counters,
            "secondary_rays": dark.counters["secondary_rays"],
        }
        assert renderer.render(scene(effects={name: {"strength": 0}})).counters == plain.counters


@pytest.mark.parametrize("factor", [5e-324, 1e307, -1e307], ids=str)
def test_values_at_the_ends_of_float64_have_a_picture(tmp_path: Path, factor: float) -> None:
    values = np.linspace(-17, 17, 5 * 6 * 7).reshape(1, 5, 6, 7).round() * factor
    fhash_codec.encode(values, tmp_path / "a.fhz", fhash_codec.EncodeConfig(effort=1))
    with fhash_codec.open(tmp_path / "a.fhz") as volume, np.errstate(all="raise", under="ignore"):
        shown = Renderer(volume)
        image = shown.render(scene())
        assert shown.histogram()[1].sum() == values.size
    assert np.isfinite(image.rgba).all()
    assert image.rgba[..., 3].max() > 0.1


def test_values_beyond_the_range_of_a_header_are_counted_at_its_ends(volume: Volume) -> None:
    shown = Renderer(volume)
    narrow = ValueRange(1e-320, 2e-320)  # as in a file that was changed
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="raise", under="ignore"):
        patch.setattr(volume, "value_range", narrow)
        counts = shown.histogram()[1]
    assert counts.sum() == counts[0] + counts[-1] > 0


@pytest.mark.parametrize(
    ("kind", "mode"), [("compact", "cache"), ("paper", "cache"), ("paper", "arm")]
)
def test_nothing_outside_a_clip_is_decoded_or_evaluated(
    files: dict[str, Path], kind: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    regions: list[Any] = []
    read = Volume.read

    def noted(self: Volume, t: float, region: Any = None, **more: Any) -> Any:
        regions.append(region)
        return read(self, t, region, **more)

    monkeypatch.setattr(Volume, "read", noted)
    clip = {"z": [9, 10], "planes": [{"normal": [1, 0, 0], "offset": 5}]}
    march = {"mode": mode, "lod": 0}
    fog = {"opacity": "linear", "density": 0.05}
    values = {"size": [30, 30], "march": march, "transfer_function": fog}
    with fhash_codec.open(files[kind]) as volume:
        whole = Renderer(volume).render(Scene.from_dict(values))
        regions.clear()
        part = Renderer(volume).render(Scene.from_dict({**values, "effects": {"clip": clip}}))
        first, tile = volume.box.z[0], volume.chunks[1]
    assert bool(regions) == (kind == "compact" or mode == "cache")
    for region in regions:
        low, high = region[0]
        assert 0 <= (9 - low) < tile
        assert low in (first, first + (9 - first) // tile * tile)
        assert 11 <= high < 11 + tile
    assert part.counters["decoded_vertices"] <= whole.counters["decoded_vertices"]
    assert 0 < part.counters["samples"] < 0.5 * whole.counters["samples"]
    assert part.counters["evaluations"] <= part.counters["samples"]


SMALL_EVOLUTION = Scene_evolution(size=(20, 14))


def test_an_evolution_is_a_grid_of_its_steps(volume: Volume, drawing: Any) -> None:
    draw = drawing()
    asked = Evolution(steps=(0.0, 1.0, 2.5, 3.0, 4.0), columns=3)
    scene = dataclasses.replace(
        SMALL_EVOLUTION, effects=Effects(colour_bar=True), background="transparent", evolution=asked
    )
    image = evolution(volume, scene, draw=draw)
    assert image.rgba.shape == (2 * 14 + 1, 3 * 20 + 2, 4)
    for number, step in enumerate([0, 1, 2.5, 3, 4]):
        row, column = divmod(number, 3)
        panel = image.rgba[row * 15 : row * 15 + 14, column * 21 : column * 21 + 20]
        np.testing.assert_allclose(panel[..., 0], step / 10, rtol=1e-6)
    assert not image.rgba[:, 20].any()
    assert not image.rgba[15:, 42:].any()
    assert not any(each.effects.colour_bar or each.effects.legend for each in draw.scenes)
    assert all(each.effects.time_label for each in draw.scenes)
    assert image.counters == {"rays": 5 * 280}
    assert image.seconds == 2.5
    assert Scene_evolution.from_dict(image.scene) == scene


@pytest.mark.parametrize(
    ("count", "size", "columns"),
    [(1, (64, 64), 1), (6, (64, 64), 3), (5, (128, 16), 1), (4, (16, 128), 4)],
)
def test_an_evolution_is_wider_than_high(
    count: int, size: tuple[int, int], columns: int, volume: Volume, drawing: Any
) -> None:
    scene = dataclasses.replace(
        SMALL_EVOLUTION, size=size, evolution=Evolution(steps=(0.0,) * count)
    )
    image = evolution(volume, scene, draw=drawing())
    assert image.rgba.shape[1] // size[0] == columns


def test_evolutions_that_cannot_be(volume: Volume, drawing: Any) -> None:
    for steps, columns, size, part in (
        ([], None, (9, 9), "at least one"),
        ([0], 2, (9, 9), "columns"),
        ([0] * 9, 9, (9999, 9), "pixels"),
    ):
        with pytest.raises(InputError, match=part):
            evolution(
                volume,
                dataclasses.replace(
                    SMALL_EVOLUTION, size=size, evolution=Evolution(steps=steps, columns=columns)
                ),
                draw=drawing(),
            )
    with pytest.raises(InputError, match="at least one"):
        evolution(volume, SMALL_EVOLUTION, draw=drawing())
    with pytest.raises(InputError, match="steps of its own"):
        dataclasses.replace(SMALL_EVOLUTION, step=1.0, evolution=Evolution(steps=(0.0,)))
    with pytest.raises(InputError, match="the scene is an evolution"):
        Renderer(volume).plan(
            dataclasses.replace(SMALL_EVOLUTION, evolution=Evolution(steps=(0.0,)))
        )
