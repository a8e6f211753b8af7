"""Animations, films, evolution and tracking: what changes from picture to picture, and what is kept of what is there."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pictures

import fhash_codec
from fhash_codec import EncodeConfig, Renderer
from fhash_codec.rendering.animation.animate import animate, numbered
from fhash_codec.rendering.animation.animation import Animation, Key
from fhash_codec.rendering.animation.film import film
from fhash_codec.rendering.animation.mixing import mixed
from fhash_codec.rendering.animation.tracking import (
    COLOURS,
    Tracked,
    follow,
    parse_tracked,
    tracking_scene,
)
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.curves import pchip
from fhash_codec.rendering.camera.poses import CameraPath
from fhash_codec.rendering.picture.evolution import evolution
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import (
    Camera,
    Effects,
    Evolution,
    Isosurface,
    Scene,
    TransferFunctionSpec,
    scene_in_png,
)
from fhash_formats.errors import (
    FhashWarning,
    InputError,
    MissingDependencyError,
    OutputError,
    OutputExistsError,
    RegionError,
)
from fhash_formats.series import ArraySeries, Coordinate

SHAPE = (5, 8, 9, 10)
SMALL = Scene(size=(20, 14))


def ball() -> np.ndarray:
    """A ball of about 1 on 0 that moves along x."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return np.exp(-((z - 3) ** 2 + (y - 4) ** 2 + (x - 2 - t) ** 2) / 5).astype(np.float32)


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("ball") / "ball.fhz"
    axes = {
        "t": [0.0, 1.0, 2.0, 4.0, 8.0],
        "z": 0.5 * np.arange(8),
        "y": np.arange(9.0),
        "x": 10 - np.arange(10.0),
    }
    coords = {
        axis: Coordinate(name=axis, values=np.asarray(values, dtype=float), attributes={})
        for axis, values in axes.items()
    }
    series = ArraySeries(ball(), name="density", units="", coords=coords)
    fhash_codec.encode(
        series, path, EncodeConfig(features=("interval:-1:9",), effort=1, max_error=0.002)
    )
    with fhash_codec.open(path) as opened:
        yield opened


class Drawing:
    """Draws flat pictures that tell step, camera and size, and notes what it was asked for."""

    def __init__(self) -> None:
        self.scenes: list[Scene] = []
        self.upcoming: list[Scene | None] = []

    def __call__(self, scene: Scene, *, upcoming: Scene | None = None) -> Image:
        self.scenes.append(scene)
        self.upcoming.append(upcoming)
        width, height = scene.size
        rgba = np.ones((height, width, 4), dtype=np.float32)
        rgba[..., 0] = (scene.step or 0) / 10
        rgba[..., 1] = scene.camera.azimuth % 360 / 360
        return Image(
            rgba=rgba, counters={"rays": width * height}, scene=scene.to_dict(), seconds=0.5
        )


def eye(camera: Camera, grid: Grid) -> np.ndarray:
    rays = Rays.of(camera, grid, (40, 30))
    return rays.eye * grid.spacing + grid.origin


# -- what changes ----------------------------------------------------------------------------------------------------------


def test_steps_pass_evenly_and_once(volume) -> None:
    animation = Animation.parse("steps", volume)
    scenes = animation.scenes(SMALL, volume)
    assert [scene.step for scene in scenes] == [0, 1, 2, 3, 4]
    assert {scene.camera for scene in scenes} == {SMALL.camera}
    assert animation.rate == 8
    between = Animation.parse("steps=4:1", volume)
    assert [
        scene.step for scene in dataclasses.replace(between, frames=7).scenes(SMALL, volume)
    ] == [4, 3.5, 3, 2.5, 2, 1.5, 1]


def test_times_pass_evenly(volume) -> None:
    scenes = dataclasses.replace(Animation.parse("time=0:8", volume), frames=5).scenes(
        dataclasses.replace(SMALL, step=3.0), volume
    )
    assert [(scene.step, scene.time) for scene in scenes] == [
        (None, 0),
        (None, 2),
        (None, 4),
        (None, 6),
        (None, 8),
    ]


def test_a_whole_turn_ends_before_it_begins_again(volume) -> None:
    animation = dataclasses.replace(Animation.parse("orbit", volume), frames=8)
    scene = dataclasses.replace(SMALL, camera=Camera(azimuth=10), step=2.0)
    scenes = animation.scenes(scene, volume)
    assert [each.camera.azimuth for each in scenes] == [10 + 45 * number for number in range(8)]
    assert {each.step for each in scenes} == {2.0}
    half = dataclasses.replace(Animation.parse("orbit=180", volume), frames=3).scenes(scene, volume)
    assert [each.camera.azimuth for each in half] == [10, 100, 190]


def test_time_and_orbit_together(volume) -> None:
    scenes = dataclasses.replace(Animation.parse("steps,orbit=90", volume), frames=3).scenes(
        SMALL, volume
    )
    assert [(scene.step, scene.camera.azimuth) for scene in scenes] == [(0, 0), (2, 45), (4, 90)]


def test_keys_are_met_and_their_settings_mixed(volume) -> None:
    keys = (
        Key(
            at=0.0,
            background="#000000",
            step=0.0,
            transfer_function=TransferFunctionSpec(opacity=((0.0, 0.0), (1.0, 0.2))),
        ),
        Key(
            at=0.5,
            background="#804020",
            step=4.0,
            transfer_function=TransferFunctionSpec(opacity=((0.5, 0.4), (3.0, 0.6))),
        ),
        Key(at=1.0, background="#804020", step=4.0, effects=Effects(shadows=True)),  # type: ignore[arg-type]
    )
    scenes = Animation(frames=9, keys=keys).scenes(SMALL, volume)
    assert [scene.step for scene in scenes[:5]] == [0, 1, 2, 3, 4]
    assert scenes[2].background == "#402010"
    np.testing.assert_allclose(scenes[2].transfer_function.opacity, [[0.25, 0.2], [2.0, 0.4]])
    assert [scene.effects.shadows is None for scene in scenes] == [True] * 8 + [False]
    assert scenes[4].transfer_function == keys[1].transfer_function


def test_mixing_keeps_order_and_kinds() -> None:
    one, other = (
        Isosurface(value=1.0, colour="white", opacity=1.0),
        Isosurface(value=3.0, colour="black", opacity=0.0),
    )
    between = mixed((one,), (other,), 0.25)
    assert between == (Isosurface(value=1.5, colour="#bfbfbf", opacity=0.75),)
    assert mixed("viridis", "plasma", 0.5) == "viridis"
    assert mixed(None, one, 0.9) is None
    assert mixed(one, other, 1.0) is other


def test_a_file_says_what_the_words_say(volume, tmp_path: Path) -> None:
    toml = tmp_path / "way.toml"
    toml.write_text(
        'steps = [0, 4]\norbit = 90\nframes = 3\n[[keys]]\ncamera = {view = "xy"}\n[[keys]]\ncamera = {view = "xy", zoom = 4}\n'
    )
    animation = Animation.parse(str(toml), volume)
    scenes = animation.scenes(SMALL, volume)
    assert [scene.camera.azimuth for scene in scenes] == [0, 45, 90]
    np.testing.assert_allclose([scene.camera.zoom for scene in scenes], [1, 2, 4])
    assert Animation.from_dict(animation.to_dict()) == animation
    other = tmp_path / "scene.json"
    other.write_text('{"camera": {"view": "yz"}, "background": "#102030", "size": [999, 9]}')
    found = Key(scene=str(other), step=1.0).over(SMALL)
    assert (found.camera.view, found.background, found.size, found.step) == (
        "yz",
        "#102030",
        SMALL.size,
        1.0,
    )


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("steps=3", "malformed"),
        ("orbit=left", "malformed"),
        ("nowhere.toml", "no such animation"),
    ],
)
def test_words_that_mean_nothing(words: str, part: str, volume) -> None:
    with pytest.raises(InputError, match=part):
        Animation.parse(words, volume)


@pytest.mark.parametrize(
    ("values", "part"),
    [
        ({"steps": [0, 1], "times": [0, 1]}, "exclude"),
        ({"frame": 3}, "did you mean 'frames'"),
        ({"keys": [{"at": 0.5}, {"at": 0.5}]}, "ascend"),
        ({"keys": [{"at": 0.5}, {}]}, "ascend"),
        ({"keys": [{"camra": {}}]}, "did you mean 'camera'"),
        ({"steps": [0, 1], "keys": [{"step": 1}, {}]}, "not by both"),
        ({"frames": 0}, "allowed"),
    ],
)
def test_animations_that_are_none(values: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        Animation.from_dict(values)


def test_nothing_changes_and_steps_outside_are_refused(volume) -> None:
    with pytest.raises(InputError, match="nothing changes"):
        Animation(frames=4).scenes(SMALL, volume)
    for animation in (
        Animation(steps=(0, 5)),
        Animation(times=(-1, 2)),
        Animation(keys=(Key(step=9.0), Key())),
    ):
        with pytest.raises(RegionError):
            animation.scenes(SMALL, volume)


# -- the camera's way ------------------------------------------------------------------------------------------------------


def test_two_poses_are_joined_at_one_speed(volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(view="xz"), Camera(view="yz"))
    path = CameraPath(at=np.array([0.0, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    middle = grid.corners.mean(axis=1)
    directions = [eye(path.camera(share), grid) - middle for share in np.linspace(0, 1, 7)]
    lengths = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-9)
    turns = [
        np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
        for a, b in itertools.pairwise(directions)
    ]
    np.testing.assert_allclose(turns, 15.0, rtol=1e-6)
    assert path.camera(0.0) is cameras[0]
    assert path.camera(2.0) is cameras[1]


def test_a_way_through_poses_is_smooth(volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="xz"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="xy", zoom=2.0),
        Camera(view="zx", elevation=20.0),
    )
    path = CameraPath(at=np.array([0.0, 0.2, 0.7, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    for share, camera in zip(path.at, cameras, strict=True):
        for near in (max(share - 1e-7, 0), min(share + 1e-7, 1)):
            np.testing.assert_allclose(eye(path.camera(near), grid), eye(camera, grid), atol=1e-3)
    # Speeds on both sides of a pose are the same.
    for share in path.at[1:-1]:
        before, here, after = (
            eye(path.camera(share + shift), grid) for shift in (-1e-5, 0.0, 1e-5)
        )
        np.testing.assert_allclose(
            here - before, after - here, atol=2e-7 * np.linalg.norm(here), rtol=1e-2
        )
    zooms = [path.camera(share).zoom for share in np.linspace(0, 1, 50)]
    assert min(zooms) >= 1 - 1e-12
    assert max(zooms) <= 2 + 1e-12


def test_cameras_with_the_same_above_them_stay_upright(volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="iso"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="yz", azimuth=160.0, elevation=-40.0),
    )
    path = CameraPath(at=np.array([0.0, 0.5, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    for share in np.linspace(0, 1, 21):
        rays = Rays.of(path.camera(share), grid, (40, 30))
        assert (rays.right * grid.spacing)[2] == pytest.approx(0.0, abs=1e-9)
        assert (rays.up * grid.spacing)[2] > 0
    above = CameraPath(
        at=np.array([0.0, 1.0]),
        cameras=(Camera(view="iso"), Camera(view="xz", elevation=90.0)),
        grid=grid,
        size=(40, 30),
    )
    for share in (0.5, 0.999):
        assert np.isfinite(eye(above.camera(share), grid)).all()


def test_angles_are_followed_as_given(volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(azimuth=0.0), Camera(azimuth=720.0, elevation=40.0))
    path = CameraPath(at=np.array([0.0, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    assert path.camera(0.25) == Camera(azimuth=180.0, elevation=10.0)


def test_the_cubic_never_overshoots() -> None:
    at, values = np.array([0.0, 0.1, 0.5, 0.6, 1.0]), np.array([[0.0], [1.0], [1.0], [5.0], [4.0]])
    found = np.array([pchip(at, values, share)[0] for share in np.linspace(0, 1, 501)])
    assert found.min() >= -1e-12
    assert found.max() <= 5 + 1e-12
    inside = found[(np.linspace(0, 1, 501) >= 0.1) & (np.linspace(0, 1, 501) <= 0.5)]
    np.testing.assert_allclose(inside, 1.0)
    for share, value in zip(at, values[:, 0], strict=True):
        assert pchip(at, values, share)[0] == pytest.approx(value)


# -- pictures on disk ------------------------------------------------------------------------------------------------------


def test_pictures_are_numbered_and_hold_their_scene(volume, tmp_path: Path) -> None:
    draw = Drawing()
    done = animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.png", draw=draw)
    assert [path.name for path in done.paths] == [f"a.000{number}.png" for number in range(5)]
    assert (done.rendered, done.kept, done.counters) == (5, 0, {"rays": 5 * 280})
    assert [scene_in_png(path) for path in done.paths] == draw.scenes
    assert draw.upcoming == [*draw.scenes[1:], None]
    assert [path.name for path in numbered(Path("b.png"), 10_001)][-1] == "b.10000.png"


def test_an_interrupted_animation_goes_on(volume, tmp_path: Path) -> None:
    animation, output = Animation.parse("steps", volume), tmp_path / "a.png"
    whole = animate(volume, SMALL, animation, output, draw=Drawing())
    before = [path.read_bytes() for path in whole.paths]
    whole.paths[1].unlink()
    whole.paths[3].unlink()
    draw = Drawing()
    done = animate(volume, SMALL, animation, output, draw=draw)
    assert (done.rendered, done.kept) == (2, 3)
    assert [scene.step for scene in draw.scenes] == [1, 3]
    assert draw.upcoming == [None, None]  # what follows is there already
    assert [path.read_bytes() for path in whole.paths] == before


@pytest.mark.parametrize("spoil", ["cut", "scene", "another volume"])
def test_pictures_that_are_not_right_are_replaced_only_by_force(
    spoil: str, volume, tmp_path: Path
) -> None:
    animation, output = Animation.parse("steps", volume), tmp_path / "a.png"
    paths = animate(volume, SMALL, animation, output, draw=Drawing()).paths
    scene = SMALL
    if spoil == "cut":
        paths[2].write_bytes(paths[2].read_bytes()[:-20])
    elif spoil == "scene":
        scene = dataclasses.replace(SMALL, background="red")
    else:
        # The same scene and the same file name, but other values.
        image = dataclasses.replace(
            Drawing()(animation.scenes(SMALL, volume)[2]),
            scene=animation.scenes(SMALL, volume)[2].to_dict(),
        )
        dataclasses.replace(image, source=str(volume.path), digest="0" * 64).save(
            paths[2], force=True
        )
    draw = Drawing()
    with pytest.raises(OutputExistsError, match=r"a\.000"):
        animate(volume, scene, animation, output, draw=draw)
    assert draw.scenes == []
    done = animate(volume, scene, animation, output, force=True, draw=draw)
    assert done.rendered == (5 if spoil == "scene" else 1)
    assert [scene_in_png(path) for path in paths] == animation.scenes(scene, volume)


def test_pictures_with_buffers_are_kept_only_with_them(volume, tmp_path: Path) -> None:
    scene = dataclasses.replace(SMALL, effects=Effects(buffers=("depth",)))

    def draw(each: Scene, *, upcoming: Scene | None = None) -> Image:
        return dataclasses.replace(Drawing()(each), depth=np.ones((14, 20), dtype=np.float32))

    animation, output = Animation.parse("steps=0:1", volume), tmp_path / "a.png"
    animate(volume, scene, animation, output, draw=draw)
    assert animate(volume, scene, animation, output, draw=draw).kept == 2
    (tmp_path / "a.0001.depth.npy").unlink()
    assert animate(volume, scene, animation, output, draw=draw, force=True).kept == 1


def test_longer_animations_of_the_name_are_mentioned(volume, tmp_path: Path) -> None:
    animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.png", draw=Drawing())
    with pytest.warns(FhashWarning, match=r"a\.0003\.png and 1 more"):
        animate(
            volume, SMALL, Animation.parse("steps=0:2", volume), tmp_path / "a.png", draw=Drawing()
        )


def test_outputs_of_other_kinds_are_refused(volume, tmp_path: Path) -> None:
    animation, draw = Animation.parse("steps", volume), Drawing()
    for output, pictures in (("a.avi", None), ("a.png", "b.png"), ("a.gif", "b.jpg")):
        with pytest.raises(InputError, match="use such a name"):
            animate(volume, SMALL, animation, tmp_path / output, pictures=pictures, draw=draw)
    assert draw.scenes == []
    assert list(tmp_path.iterdir()) == []


# -- films -----------------------------------------------------------------------------------------------------------------


def read_film(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Frames (n, H, W, 3) of an MP4."""
    import imageio_ffmpeg

    words = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(words, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, size[1], size[0], 3)


def test_a_film_shows_the_pictures_in_order(volume, tmp_path: Path) -> None:
    scene = dataclasses.replace(SMALL, size=(41, 27))
    done = animate(
        volume, scene, Animation.parse("steps", volume), tmp_path / "a.mp4", draw=Drawing()
    )
    assert [path.name for path in done.paths] == ["a.mp4"]
    frames = read_film(tmp_path / "a.mp4", (42, 28))
    assert len(frames) == 5
    np.testing.assert_allclose(frames[..., 0].mean(axis=(1, 2)), 25.5 * np.arange(5), atol=6)


def test_a_film_of_kept_pictures_is_the_same(volume, tmp_path: Path) -> None:
    animation = Animation.parse("steps", volume)
    scene = dataclasses.replace(SMALL, background="transparent")
    first = animate(
        volume, scene, animation, tmp_path / "a.mp4", pictures=tmp_path / "p.png", draw=Drawing()
    )
    assert [path.name for path in first.paths] == [
        *(f"p.000{number}.png" for number in range(5)),
        "a.mp4",
    ]
    draw = Drawing()
    second = animate(
        volume, scene, animation, tmp_path / "b.mp4", pictures=tmp_path / "p.png", draw=draw
    )
    assert (second.kept, draw.scenes) == (5, [])
    np.testing.assert_array_equal(
        read_film(tmp_path / "a.mp4", (20, 14)), read_film(tmp_path / "b.mp4", (20, 14))
    )


def test_a_gif_shows_the_pictures_in_order(volume, tmp_path: Path) -> None:
    animation = dataclasses.replace(Animation.parse("steps", volume), fps=10.0)
    animate(volume, SMALL, animation, tmp_path / "a.gif", draw=Drawing())
    with Pictures.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.info["duration"], picture.info["loop"]) == (5, 100, 0)
        for number in range(5):
            picture.seek(number)
            np.testing.assert_allclose(
                np.asarray(picture.convert("RGB"))[0, 0, 0], 25.5 * number, atol=2
            )


def test_an_interrupted_film_leaves_nothing(volume, tmp_path: Path) -> None:
    def draw(scene: Scene, *, upcoming: Scene | None = None) -> Image:
        if scene.step == 2:
            raise KeyboardInterrupt
        return Drawing()(scene)

    for name in ("a.mp4", "a.gif"):
        with pytest.raises(KeyboardInterrupt):
            animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / name, draw=draw)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_film_is_refused_before_any_work(volume, tmp_path: Path) -> None:
    (tmp_path / "a.gif").write_bytes(b"mine")
    draw = Drawing()
    with pytest.raises(OutputExistsError):
        animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.gif", draw=draw)
    assert draw.scenes == []
    animate(
        volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.gif", draw=draw, force=True
    )
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF")


def test_without_the_package_an_mp4_says_what_to_install(
    volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    draw = Drawing()
    with pytest.raises(MissingDependencyError, match=r"fhash\[video\]"):
        animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.mp4", draw=draw)
    assert draw.scenes == []


def test_an_encoder_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    frames = iter([np.zeros((256, 256, 3), dtype=np.uint8)] * 50)
    with pytest.raises(OutputError, match="ffmpeg failed") as caught:
        film(tmp_path / "a.mp4", frames, (256, 256), 24.0)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# -- evolution and tracking ------------------------------------------------------------------------------------------------


def test_an_evolution_is_a_grid_of_its_steps(volume) -> None:
    draw = Drawing()
    asked = Evolution(steps=(0.0, 1.0, 2.5, 3.0, 4.0), columns=3)
    scene = dataclasses.replace(
        SMALL, effects=Effects(colour_bar=True), background="transparent", evolution=asked
    )
    image = evolution(volume, scene, draw=draw)
    assert image.rgba.shape == (2 * 14 + 1, 3 * 20 + 2, 4)
    for number, step in enumerate([0, 1, 2.5, 3, 4]):
        row, column = divmod(number, 3)
        panel = image.rgba[row * 15 : row * 15 + 14, column * 21 : column * 21 + 20]
        np.testing.assert_allclose(panel[..., 0], step / 10, rtol=1e-6)
    assert not image.rgba[:, 20].any()
    assert not image.rgba[15:, 42:].any()
    assert [each.effects.colour_bar for each in draw.scenes] == [False] * 4 + [True]
    assert all(each.effects.time_label for each in draw.scenes)
    assert image.counters == {"rays": 5 * 280}
    assert image.seconds == 2.5
    assert Scene.from_dict(image.scene) == scene


@pytest.mark.parametrize(
    ("count", "size", "columns"),
    [(1, (64, 64), 1), (6, (64, 64), 3), (5, (128, 16), 1), (4, (16, 128), 4)],
)
def test_an_evolution_is_wider_than_high(
    count: int, size: tuple[int, int], columns: int, volume
) -> None:
    scene = dataclasses.replace(SMALL, size=size, evolution=Evolution(steps=(0.0,) * count))
    image = evolution(volume, scene, draw=Drawing())
    assert image.rgba.shape[1] // size[0] == columns


def test_evolutions_that_cannot_be(volume) -> None:
    for steps, columns, size, part in (
        ([], None, (9, 9), "at least one"),
        ([0], 2, (9, 9), "columns"),
        ([0] * 9, 9, (9999, 9), "pixels"),
    ):
        with pytest.raises(InputError, match=part):
            evolution(
                volume,
                dataclasses.replace(
                    SMALL, size=size, evolution=Evolution(steps=steps, columns=columns)
                ),
                draw=Drawing(),
            )
    with pytest.raises(InputError, match="at least one"):
        evolution(volume, SMALL, draw=Drawing())
    with pytest.raises(InputError, match="steps of its own"):
        dataclasses.replace(SMALL, step=1.0, evolution=Evolution(steps=(0.0,)))
    with pytest.raises(InputError, match="the scene is an evolution"):
        Renderer(volume).plan(dataclasses.replace(SMALL, evolution=Evolution(steps=(0.0,))))


def test_a_renderer_draws_evolutions(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["compact"]) as real:
        image = fhash_codec.render(
            real, dataclasses.replace(SMALL, evolution=Evolution(steps=(0.0, 1.5), columns=2))
        )
        single = fhash_codec.render(
            real, dataclasses.replace(SMALL, step=1.5, effects=Effects(time_label=True))
        )
        np.testing.assert_array_equal(image.rgba[:, -SMALL.size[0] :], single.rgba)


def test_features_get_colours_and_thresholds(volume) -> None:
    found = parse_tracked(["interval:0.2:0.4", "isosurface:0.7=#ff0000", "segmentation"], volume)
    assert [str(each.feature).split(":")[0] for each in found] == [
        "interval",
        "isosurface",
        "segmentation",
    ]
    assert [each.colour for each in found] == [COLOURS[0], "#ff0000", COLOURS[2]]
    assert 0.1 < found[2].feature.threshold < 0.9  # type: ignore[attr-defined]
    assert [str(each.feature) for each in parse_tracked([], volume)] == ["interval:-1:9"]


@pytest.mark.parametrize(
    "text", ["all", "mask:m.npy", "interval:0:1=#12", "blob:3", "interval:3:1"]
)
def test_features_that_values_do_not_tell(text: str, volume) -> None:
    with pytest.raises(InputError):
        parse_tracked([text], volume)


def test_a_value_of_two_features_has_both_colours_and_the_larger_opacity(volume) -> None:
    from fhash_codec.rendering.colour.transfer_function import TransferFunction

    scene = tracking_scene(
        SMALL,
        parse_tracked(
            ["interval:0.2:0.6=#ff0000", "interval:0.4:0.8=#0000ff", "isosurface:0.9=#00ff00"],
            volume,
        ),
        volume,
    )
    assert scene.effects.isosurfaces == (Isosurface(value=0.9, colour="#00ff00"),)
    function = TransferFunction.of(scene.transfer_function, value_range=(0.0, 1.0), spacing=1.0)
    np.testing.assert_allclose(
        function.colour([0.3, 0.5, 0.7]), [[1, 0, 0], [0.5, 0, 0.5], [0, 0, 1]], atol=0.01
    )
    np.testing.assert_allclose(
        function.opacity([0.1, 0.3, 0.5, 0.7, 0.85]), [0, 0.3, 0.3, 0.3, 0], atol=1e-9
    )


def test_isosurfaces_alone_leave_the_volume_out(volume) -> None:
    scene = tracking_scene(SMALL, parse_tracked(["isosurface:0.5"], volume), volume)
    assert scene.transfer_function.nothing
    with pytest.raises(InputError, match="no feature"):
        tracking_scene(SMALL, [], volume)


def test_a_feature_is_followed(volume) -> None:
    (found,) = follow(volume, parse_tracked(["segmentation:0.5"], volume), [0.0, 3.0])
    first, last = found["steps"]
    assert (first["time"], last["time"]) == (0, 4)
    np.testing.assert_allclose(first["centroid"], [8, 4, 1.5], atol=0.3)  # x descends from 10
    np.testing.assert_allclose(last["centroid"], [5, 4, 1.5], atol=0.3)
    assert first["vertices"] > 10
    assert first["bounds"][2] == [1.0, 2.0]
    (nowhere,) = follow(
        volume,
        [Tracked(feature=parse_tracked(["interval:5:6"], volume)[0].feature, colour="red")],
        [0.0],
    )
    assert nowhere["steps"][0] == {
        "step": 0.0,
        "time": 0.0,
        "vertices": 0,
        "centroid": None,
        "bounds": None,
    }
