"""The renderer, and evolutions."""

from __future__ import annotations

import io
import itertools
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked import ended_well, forked, needs_fork
from PIL import Image as Pictures
from rarely import rarely

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene, Volume
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering import render, tiled_frame
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import named_map
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.image import Image, Pen, overlay, surrounded, time_text
from fhash_codec.rendering.layout import (
    TITLE_GAP,
    Layout,
    drawable,
    lay_out,
    length,
    line_height,
    quantity_of,
    scales,
    strips,
    ticks,
    wrapped,
)
from fhash_codec.rendering.march_task import Units
from fhash_codec.rendering.renderer import evolution
from fhash_codec.rendering.scenes import (
    USUAL_EFFECTS,
    Camera,
    Effects,
    Evolution,
    LegendEntry,
    scene_in_png,
)
from fhash_codec.rendering.view import edges
from fhash_formats.errors import InputError, OutputExistsError
from fhash_formats.series import Coordinate

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
    step = image.scene["step"]
    assert dict(image.scene) == Scene(step=step, effects=USUAL_EFFECTS).to_dict()
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


@pytest.mark.parametrize("preset", ["default", "published"])
@pytest.mark.parametrize(
    ("full", "chosen"), [((), 0), ((2,), 2), ((4, 6), 4), ((1, 3), 0), (range(9), 0)]
)
def test_the_default_step_is_that_of_most_structure_of_five(
    tmp_path: Path, full: Sequence[int], chosen: int, preset: str
) -> None:
    """Steps 0, 2, 4, 6 and 8 are looked at; equal ones give the earliest."""
    values = np.zeros((9, 6, 7, 8), np.float32)
    for step in full:
        values[step, 2:4, 2:5, 3:6] = 1
    values[0, 0, 0, 0] = 4  # the range of the series, and hardly a sight
    network = {"preset": "published", "tables": "float32", "epochs": 60}
    settings = EncodeConfig(max_error=0.01) if preset == "default" else EncodeConfig(**network)
    fhash_codec.encode(values, tmp_path / "run.fhz", settings)
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        plan = Renderer(volume).plan(Scene(size=(20, 20)))
        assert plan.step == plan.scene.step
        assert plan.step == chosen or (preset == "published" and set(full) <= {1, 3})
        surface = {"effects": {"isosurfaces": [{"value": 0.5}]}}
        surfaces = Scene.from_dict({**surface, "transfer_function": {"nothing": True}})
        assert Renderer(volume).plan(surfaces).step == chosen or not full


def test_the_step_that_is_asked_for_is_taken(volume: Volume) -> None:
    renderer = Renderer(volume)
    for moment in ({"step": 0.0}, {"step": 1.5}, {"time": 0.0}):
        assert renderer.plan(Scene.from_dict(moment)).scene == Scene.from_dict(moment)


def scene(**parts: Any) -> Scene:
    return Scene.from_dict({"size": [40, 32], **parts})


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
    original = tiled_frame.decoded_frame

    def noted(volume: Volume, step: float, *others: Any) -> Any:
        steps.append(step)
        return original(volume, step, *others)

    monkeypatch.setattr(tiled_frame, "decoded_frame", noted)
    return steps


def test_what_was_decoded_is_kept(renderer: Renderer, decoded: list[float]) -> None:
    first = renderer.render(scene(step=0))
    renderer.render(scene(step=0, camera={"azimuth": 40}))
    renderer.render(scene(step=2))
    last = renderer.render(scene(step=0))
    assert decoded == [0, 2]
    np.testing.assert_array_equal(first.rgba, last.rgba)


def test_what_comes_next_is_decoded_beside(volume: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[tuple[float, bool]] = []
    original = tiled_frame.decoded_frame

    def counted(volume: Volume, step: float, *others: Any) -> Any:
        decoded.append((step, threading.current_thread() is threading.main_thread()))
        return original(volume, step, *others)

    monkeypatch.setattr(tiled_frame, "decoded_frame", counted)
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
        assert none.render(scene(step=0)).rgba[..., 3].any()
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
    frame = tiled_frame.decoded_frame(volume, 0.5, 0, ((0, 20), (0, 24), (0, 28)), Units())
    np.testing.assert_allclose(frame.values, (volume.read(0) + volume.read(1)) / 2, atol=1e-5)
    coarse = tiled_frame.decoded_frame(volume, 0.5, 1, ((0, 20), (0, 24), (0, 28)), Units())
    np.testing.assert_allclose(
        coarse.values, (volume.read_lod(0, 1) + volume.read_lod(1, 1)) / 2, atol=1e-5
    )
    assert coarse.stride == 2


def test_what_lies_outside_the_coreset_is_not_seen(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["feature"]) as volume:
        frame = tiled_frame.decoded_frame(volume, 0.0, 0, ((0, 20), (0, 24), (0, 28)), Units())
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
    values = {"size": [30, 30], "step": 0, "march": march, "transfer_function": fog}
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


def of_steps(**fields: Any) -> Scene:
    return Scene(**{"size": (20, 14), **fields})


def test_an_evolution_is_a_grid_of_its_steps(volume: Volume, drawing: Any) -> None:
    draw = drawing()
    asked = Evolution(steps=(0.0, 1.0, 2.5, 3.0, 4.0), columns=3)
    scene = of_steps(effects=Effects(colour_bar=True), background="transparent", evolution=asked)
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
    assert Scene.from_dict(image.scene) == scene


@pytest.mark.parametrize(
    ("count", "size", "columns"),
    [(1, (64, 64), 1), (6, (64, 64), 3), (5, (128, 16), 1), (4, (16, 128), 4)],
)
def test_an_evolution_is_wider_than_high(
    count: int, size: tuple[int, int], columns: int, volume: Volume, drawing: Any
) -> None:
    scene = of_steps(size=size, evolution=Evolution(steps=(0.0,) * count))
    image = evolution(volume, scene, draw=drawing())
    assert image.rgba.shape[1] // size[0] == columns


def test_evolutions_that_cannot_be(volume: Volume, drawing: Any) -> None:
    for steps, columns, size, part in (
        ([], None, (9, 9), "at least one"),
        ([0], 2, (9, 9), "columns"),
        ([0] * 9, 9, (9999, 9), "pixels"),
    ):
        given = of_steps(size=size, evolution=Evolution(steps=steps, columns=columns))
        with pytest.raises(InputError, match=part):
            evolution(volume, given, draw=drawing())
    with pytest.raises(InputError, match="at least one"):
        evolution(volume, of_steps(), draw=drawing())
    with pytest.raises(InputError, match="the scene is an evolution"):
        Renderer(volume).plan(of_steps(evolution=Evolution(steps=(0.0,))))


SCENE = Scene(
    size=(3, 2), camera=Camera(view="xz", position=(1.5, 2.0, 3.25)), background="#204060", step=3.5
)


def image(**arguments: Any) -> Image:
    rgba = np.zeros((2, 3, 4), dtype=np.float32)
    rgba[0, 0] = 0.5, 0, 0, 0.5
    rgba[1, 2] = 0, 1, 0, 1
    return Image(**{"rgba": rgba, "scene": SCENE.to_dict(), "source": "/data/run.fhz", **arguments})


def test_pixels_over_a_background() -> None:
    pixels = image().to_uint8()
    assert (pixels.shape, pixels.dtype) == ((2, 3, 3), np.uint8)
    assert pixels[0, 1].tolist() == [0x20, 0x40, 0x60]
    assert pixels[0, 0].tolist() == [144, 32, 48]
    assert pixels[1, 2].tolist() == [0, 255, 0]
    assert image().to_uint8("white")[0, 0].tolist() == [255, 128, 128]


def test_a_notebook_shows_the_picture() -> None:
    with Pictures.open(io.BytesIO(image()._repr_png_())) as found:
        np.testing.assert_array_equal(np.asarray(found), image().to_uint8())
    assert repr(image()) == "<fhash Image 3x2 of run.fhz in 0 s>"


@pytest.mark.parametrize("suffix", [".jpg", ".JPEG"])
def test_a_jpeg_holds_the_pixels(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"view{suffix}"
    rgba = np.ones((40, 60, 4), dtype=np.float32)
    rgba[:, :30, 0] = 0
    wide = image(rgba=rgba)
    assert wide.save(path) == [path]
    with Pictures.open(path) as found:
        assert found.format == "JPEG"
        difference = np.asarray(found).astype(int) - wide.to_uint8()
    assert np.abs(difference).max() < 24
    with pytest.raises(OutputExistsError):
        wide.save(path)


def test_other_names_and_transparent_jpegs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"written as \.png, \.jpg or \.jpeg"):
        image().save(tmp_path / "view.gif")
    clear = image(scene=Scene(background="transparent").to_dict())
    with pytest.raises(InputError, match="JPEG cannot be transparent"):
        clear.save(tmp_path / "view.jpg")
    assert not list(tmp_path.iterdir())


def test_a_colour_bar_and_a_legend_are_drawn_in_their_colours() -> None:
    colours = named_map("viridis").rescaled(0, 2)
    entry = LegendEntry(text="fast", colour="#ff0000")
    layout = strips((160, 120), Effects(colour_bar=True, legend=(entry,)), colours, "u [m/s]")
    assert layout.bar is not None
    assert layout.legend is not None
    pen = Pen(160, 120, "white")
    drawn, opacity = pen.colour_bar(layout.bar, colours)
    left, top, right, bottom = layout.bar.box
    middle = (left + right) // 2
    np.testing.assert_allclose(drawn[top, middle], colours(2.0), atol=0.05)
    np.testing.assert_allclose(drawn[bottom - 1, middle], colours(0.0), atol=0.05)
    assert opacity[:, : left - 2].max() == 0
    squares, opacity = pen.legend(layout.legend)
    at, row, _ = layout.legend.entries[0]
    np.testing.assert_allclose(squares[int(row) + 3, int(at) + 3], [1, 0, 0])


COORDS = {
    axis: Coordinate(name=axis, values=np.linspace(0, extent, 11), attributes={"units": "km"})
    for axis, extent in zip("xyz", (4, 3, 2), strict=True)
}


GRID = Grid.of(COORDS)


SIZES = [(256, 256), (300, 700), (1024, 512)]


NAMES = ("box", "axes", "colour_bar", "time_label")


def drawn(
    effects: Effects,
    size: tuple[int, int] = (256, 256),
    background: str = "#ffffff",
    fill: float = 0.0,
    **camera: Any,
) -> Image:
    rgba = np.zeros((size[1], size[0], 4), dtype=np.float32)
    scene = Scene(background=background, size=size, effects=effects, camera=Camera(**camera))
    colours = named_map("plasma").rescaled(-3, 5)
    layout, rays = lay_out(scene, GRID, COORDS, colours, "speed [m/s]")
    left, top, width, height = layout.view
    rgba[top : top + height, left : left + width, 3] = fill
    image = Image(rgba=rgba, scene=scene.to_dict())
    return overlay(image, effects, rays, layout, colours=colours, label="step 3   t = 1 s")


def test_nothing_is_drawn_unless_asked_for() -> None:
    image = Image(rgba=np.zeros((4, 4, 4), dtype=np.float32))
    rays = Rays.of(Camera(), GRID, (4, 4))
    layout = Layout(size=(4, 4), view=(0, 0, 4, 4))
    assert overlay(image, Effects(), rays, layout, colours=named_map("grey")) is image
    assert surrounded(image, Effects(box=True), colours=named_map("grey"), quantity="") is image


@pytest.mark.parametrize("background", ["#ffffff", *rarely("#10121c", "transparent")])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_every_effect_is_seen_on_any_background(
    name: str, size: tuple[int, int], background: str
) -> None:
    image = drawn(Effects(**{name: True}), size, background)
    assert image.rgba.shape == (size[1], size[0], 4)
    assert np.all((image.rgba >= 0) & (image.rgba <= 1 + 1e-6))
    assert np.all(image.rgba[..., :3] <= image.rgba[..., 3:] + 1e-6)
    paper = np.array(
        [0, 0, 0] if background == "transparent" else list(bytes.fromhex(background[1:]))
    )
    drawn_on = np.abs(image.to_uint8()[..., :3].astype(int) - paper).max(axis=-1) > 100
    if background == "transparent":
        drawn_on = image.to_uint8()[..., 3] > 100
    assert drawn_on.sum() > 100
    assert drawn_on.mean() < 0.2


def test_edges_at_the_back_are_hidden_by_an_opaque_volume_and_those_at_the_front_are_not() -> None:
    clear, filled = (drawn(Effects(box=True), fill=fill).rgba for fill in (0.0, 1.0))
    rays = Rays.of(Camera(), GRID, (256, 256))
    back = [edge for edge in edges(rays) if edge.fronts == 0]
    front = [edge for edge in edges(rays) if edge.fronts == 2]
    outline = [edge for edge in edges(rays) if edge.fronts == 1]
    assert (len(back), len(front), len(outline)) == (3, 3, 6)

    def at(picture: np.ndarray, edge: Any) -> float:
        x, y = edge.ends.mean(axis=0)
        return float(picture[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2, :3].max())

    for edge in back:
        assert at(filled, edge) == 0
        assert at(clear, edge) > 0
    for edge in front + outline:
        assert at(filled, edge) > 0


def test_from_inside_the_volume_the_overlay_is_finite() -> None:
    everything = Effects(box=True, axes=True, colour_bar=True, time_label=True)
    inside = drawn(
        everything, position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60
    )
    assert np.all(np.isfinite(inside.rgba))


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("z [µm]", "z [um]"),
        ("Température [°C]", "Temperature [°C]"),
        ("u [m s⁻¹]", "u [m s-1]"),
        ("\N{GREEK SMALL LETTER RHO} [kg m\N{MINUS SIGN}3]", "rho [kg m-3]"),
        ("密度", "??"),
    ],
)
def test_texts_are_drawn_in_letters_that_the_font_has(text: str, drawn: str) -> None:
    assert drawable(text) == drawn


def test_the_text_of_a_time() -> None:
    def times(values: list[float], units: str) -> Coordinate:
        return Coordinate(name="time", values=np.array(values), attributes={"units": units})

    assert time_text(0, 0.0, times([0], "")) == ""
    assert time_text(0, 0.0, times([0], "s")) == "step 0   t = 0 s"
    assert time_text(3, 0.25, times([0, 0.25], "s")) == "step 3   t = 0.25 s"
    assert time_text(3.5, 1e-9, times([0, 2e-9], "")) == "step 3.5   t = 1e-09"
    late = times([347921.001, 347921.002], "s")
    assert time_text(0, 347921.001, late) == "step 0   t = 347921.001 s"
    dated = times([40.0, 40.25], "days since 2001-01-01")
    assert time_text(1, 40.25, dated) == "step 1   2001-02-10 06:00"
    assert time_text(0, 40.0, dated) == "step 0   2001-02-10"


LONG = "sea_water_potential_temperature [degree_Celsius]"


@pytest.mark.parametrize("limit", [12.0, 40.0, 90.0, 150.0, 1000.0])
def test_lines_are_no_longer_than_their_limit_and_hold_every_letter(limit: float) -> None:
    lines = wrapped(LONG, 10, limit)
    assert all(length(line, 10) <= limit for line in lines)
    assert "".join(lines).replace(" ", "") == LONG.replace(" ", "")
    assert (len(lines) == 1) is (limit == 1000)


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 3e7, 1e300])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_ticks_lie_within_the_ends_at_any_scale(scale: float, count: int) -> None:
    for low, high in ((0.13, 0.97), (-5.0, 3.0), (99.99, 100.01)):
        marks = ticks(low * scale, high * scale, count)
        values, texts = [value for value, _ in marks], [text for _, text in marks]
        assert 1 <= len(marks) <= 2.6 * count + 2
        assert len(set(texts)) == len(texts)
        assert all(
            low * scale - 1e-9 * abs(scale) <= value <= high * scale + 1e-9 * scale
            for value in values
        )
        np.testing.assert_allclose(
            [float(text) for text in texts], values, rtol=1e-6, atol=1e-9 * scale
        )


def test_ticks_that_are_out_of_view_have_no_number() -> None:
    grid, view = Grid.of(COORDS), (0.0, 0.0, 400.0, 400.0)
    near = Rays.of(Camera(view="xz", zoom=3), grid, (400, 400))
    labels, marks, _ = scales(near, view, view, COORDS, 12, breaking=0)
    assert not labels
    assert not marks
    beside = Rays.of(
        Camera(view="xz", zoom=3, focal_point=(0.0, 1.5, 0.0), position=(0.0, -15.0, 0.0)),
        grid,
        (400, 400),
    )
    texts = [label.lines[0] for label in scales(beside, view, view, COORDS, 12, breaking=0)[0]]
    assert sorted(texts) == ["0", "0.0", "0.5", "1", "1.0", "x [km]", "z [km]"]


SIZES_LAYOUT = [(256, 256), (512, 512), (1024, 1024), (480, 270), (270, 480), (256, 700)]
Box = tuple[float, float, float, float]
LOW = 9.87e14
HIGH = 9.88e14


def coords(kind: str) -> dict[str, Coordinate]:
    def at(name: str, first: float, last: float, count: int, units: str) -> Coordinate:
        values = np.linspace(first, last, count)
        return Coordinate(name=name, values=values, attributes={"units": units})

    return {
        "plain": {axis: at(axis, -1, 1, 9, "m") for axis in "xyz"},
        "flat": {
            "x": at("longitude", 0, 358, 90, "degrees_east"),
            "y": at("latitude", 89, -89, 45, "degrees_north"),
            "z": at("level", 0, 0, 1, "1"),
        },
        "long": {
            "x": at("projection_x_coordinate", 1234567.125, 1234890.5, 20, "kilometres"),
            "y": at("projection_y_coordinate", -1234567.1, -1234890.5, 20, "kilometres"),
            "z": at("geopotential_height_above_ellipsoid", 1e5, 1.003e5, 20, "kilometres"),
        },
    }[kind]


EVERYTHING = Effects(
    box=True,
    axes=True,
    colour_bar=True,
    time_label=True,
    legend=(
        LegendEntry(text="sea_water_temperature 12.5 to 13.75 degree_Celsius", colour="red"),
        LegendEntry(text="sea_water_temperature = 20 degree_Celsius", colour="blue"),
    ),
)


def laid_out(
    kind: str,
    size: tuple[int, int],
    effects: Effects = EVERYTHING,
    quantity: str = "atmosphere_mass_content_of_cloud_condensed_water [kg m-2 s-1]",
    **camera: Any,
) -> tuple[Layout, Rays]:
    axes = coords(kind)
    scene = Scene(size=size, effects=effects, camera=Camera(**camera))
    colours = named_map("viridis").rescaled(LOW, HIGH)
    return lay_out(scene, Grid.of(axes), axes, colours, quantity)


def covered(layout: Layout, rays: Rays) -> np.ndarray:
    """The pixels (H, W) of the picture whose rays meet the drawn box."""
    origins, directions = rays.pixels()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (rays.grid.bounds.T[:, None, None] - origins) / directions
    enter = np.nanmax(np.minimum(ends[0], ends[1]), axis=-1)
    leave = np.nanmin(np.maximum(ends[0], ends[1]), axis=-1)
    whole = np.zeros(layout.size[::-1], dtype=bool)
    left, top, width, height = layout.view
    whole[top : top + height, left : left + width] = enter < leave
    return whole


def texts(layout: Layout) -> list[tuple[str, Box]]:
    """Every text with the box that it takes, as the pen writes it."""
    found = [(" ".join(label.lines), label.box) for label in layout.labels]
    bar = layout.bar
    if bar is not None:
        left, top, right, bottom = bar.box
        pitch = line_height(bar.size)
        for value, text in bar.marks:
            row = bottom - (value - LOW) / (HIGH - LOW) * (bottom - top)
            at = right + bar.size // 4 + 2
            box = at, row - pitch / 2, at + length(text, bar.size) + 2, row + pitch / 2
            found.append((text, box))
        for number, line in enumerate(reversed(bar.title)):
            row = top - (number + TITLE_GAP) * pitch
            box = left - 2, row - pitch / 2, left + length(line, bar.size), row + pitch / 2
            found.append((line, box))
    if layout.legend is not None:
        side = layout.legend.size
        for at, top, entry in layout.legend.entries:
            wide = 1.4 * side + length(entry.text, side) + 2
            found.append((entry.text, (at, top - side / 4, at + wide, top + 1.25 * side)))
    return found


@pytest.mark.parametrize("size", SIZES_LAYOUT, ids=str)
@pytest.mark.parametrize(
    ("kind", "camera"),
    [
        ("plain", {}),
        ("plain", {"azimuth": 77.0, "elevation": -20.0}),
        ("plain", {"view": "xz", "projection": "parallel"}),
        ("plain", {"zoom": 2.5}),
        ("flat", {}),
        ("flat", {"view": "iso"}),
        ("long", {}),
    ],
    ids=str,
)
def test_nothing_covers_the_volume_or_is_cut(
    kind: str, camera: dict[str, Any], size: tuple[int, int]
) -> None:
    layout, rays = laid_out(kind, size, **camera)
    volume = covered(layout, rays)
    assert volume.sum() > 0.02 * volume.size
    left, top, width, height = layout.view
    assert width >= 0.15 * size[0]
    assert height >= 0.15 * size[1]
    boxes = texts(layout)
    for text, box in boxes:
        assert box[0] >= -0.5, text
        assert box[1] >= -0.5, text
        assert box[2] <= size[0] + 0.5, text
        assert box[3] <= size[1] + 0.5, text
        rows = slice(max(int(box[1]), 0), int(np.ceil(box[3])))
        columns = slice(max(int(box[0]), 0), int(np.ceil(box[2])))
        assert not volume[rows, columns].any(), text
    for (one, first), (other, second) in itertools.combinations(boxes, 2):
        apart = (
            first[2] <= second[0] + 1
            or second[2] <= first[0] + 1
            or first[3] <= second[1] + 1
            or second[3] <= first[1] + 1
        )
        assert apart, (one, other)
    assert layout.bar is not None
    assert layout.bar.box[0] >= left + width
    assert layout.time is not None
    assert layout.time[3] <= top


def test_in_a_tiny_picture_the_volume_keeps_its_place() -> None:
    layout, rays = laid_out("plain", (24, 20))
    assert rays.size == layout.view[2:]
    assert rays.size[0] >= 0.3 * 24 - 1


def test_names_of_quantities() -> None:
    assert quantity_of("speed", "m s-1") == "speed [m s-1]"
    assert quantity_of("share", "1") == quantity_of("share", "") == "share"
