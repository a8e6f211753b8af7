"""Scenes, and their text in PNGs."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from PIL import Image as Pictures
from PIL import ImageColor
from PIL.PngImagePlugin import PngInfo

from fhash_codec.rendering.colours import (
    COLOUR_MAPS,
    PIECES,
    SPACES,
    ColourMap,
    hsv_to_rgb,
    lab_to_rgb,
    named_map,
    parse_colour,
    read_preset,
    rgb_to_hsv,
    rgb_to_lab,
)
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.scenes import (
    MAX_TEXT,
    SCENE_KEY,
    Scene,
    TransferFunctionSpec,
    scene_in_png,
)
from fhash_codec.rendering.transfer_function import (
    BACKGROUND,
    INTERVAL,
    OPAQUE,
    PRESETS,
    SURFACE,
    TransferFunction,
    extinction_of,
    opacity_preset,
)
from fhash_formats.errors import FhashWarning, InputError, MissingInputError

VALUES: dict[str, Any] = {
    "camera": {"view": "xz", "position": [1.5, 2.0, 3.25]},
    "size": [30, 20],
    "background": "transparent",
    "effects": {"shading": {"ambient": 0.5}, "buffers": ["depth"]},
    "step": 3.5,
}


def test_a_scene_comes_back_from_its_json() -> None:
    scene = Scene.from_dict(VALUES)
    assert scene.to_dict() == VALUES
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene
    assert Scene().to_dict() == {}


def test_a_scene_is_read_from_toml_json_and_pictures(tmp_path: Path) -> None:
    import numpy as np

    scene = Scene.from_dict(VALUES)
    (tmp_path / "a.json").write_text(json.dumps(VALUES))
    (tmp_path / "a.toml").write_text(
        'size = [30, 20]\nbackground = "transparent"\nstep = 3.5\n'
        '[camera]\nview = "xz"\nposition = [1.5, 2, 3.25]\n'
        '[effects]\nbuffers = ["depth"]\nshading = {ambient = 0.5}\n'
    )
    Image(rgba=np.zeros((2, 3, 4), dtype=np.float32), scene=VALUES).save(tmp_path / "a.png")
    for name in ("a.json", "a.toml", "a.png"):
        assert Scene.load(tmp_path / name) == scene


@pytest.mark.parametrize("name", ["a.json", "a.toml", "a.png"])
def test_a_scene_that_is_not_there(tmp_path: Path, name: str) -> None:
    with pytest.raises(MissingInputError, match="no such"):
        Scene.load(tmp_path / name)
    (tmp_path / name).write_text("[")
    with pytest.raises(InputError, match="not a") as caught:
        Scene.load(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"step": 1, "time": 2}, "step and time exclude each other"),
        ({"step": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"time": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"camra": {}}, "did you mean 'camera'"),
        ({"effects": {"shadow": True}}, "did you mean 'shadows'"),
        ({"evolution": {}}, "steps is missing"),
        ({"effects": {"clip": True}}, "clip cuts nothing"),
        ({"effects": {"clip": {"z": [2, 1]}}}, "z is 2 to 1; the first end must be below"),
        ({"effects": {"clip": {"planes": [{"normal": [0, 0, 1]}]}}}, "either a point or an offset"),
        ({"effects": {"clip": {"planes": [{"offset": 1}]}}}, "normal is missing"),
        (
            {"effects": {"clip": {"planes": [{"normal": [0, 0, 0], "offset": 1}]}}},
            "the normal has no length",
        ),
        (
            {"effects": {"clip": {"planes": 7 * [{"normal": [0, 0, 1], "offset": 1}]}}},
            "clip has 7 planes; allowed: 6",
        ),
        (
            {"effects": {"attenuated_maximum_intensity": {"attenuation": 0}}},
            "attenuation is 0; allowed: 1e-06 to 1000",
        ),
        ({"size": [0, 9]}, "size is 0; allowed: 1 to 16384"),
    ],
)
def test_scenes_that_contradict_themselves_are_refused(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Scene.from_dict(values)


def test_a_clip_and_projections_are_read_and_written() -> None:
    planes = [{"normal": [0, 0, 1], "offset": 2.0}, {"point": [1, 2, 3], "normal": [1, 1, 0]}] * 3
    values = {
        "transfer_function": {"gradient_opacity": [[0, 0.0], [0.5, 1]]},
        "effects": {"clip": {"x": [None, 3.5], "z": [0, None], "planes": planes}},
    }
    scene = Scene.from_dict(values)
    assert Scene.from_dict(scene.to_dict()) == scene
    assert json.loads(json.dumps(scene.to_dict())) == json.loads(json.dumps(values))
    assert Scene.from_dict({"effects": {"clip": False}}) == Scene()
    toml = {"x": [False, 3.5], "z": [0, False], "planes": planes}  # TOML has no null
    assert Scene.from_dict({**values, "effects": {"clip": toml}}) == scene
    both = Scene.from_dict(
        {"effects": {"average_intensity": True, "attenuated_maximum_intensity": True}}
    )
    assert both.effects.projections == ("average", "attenuated")
    assert scene.effects.projections == ()


def chunk(kind: bytes, data: bytes, wrong: int = 0) -> bytes:
    return (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data) ^ wrong)
    )


def png(*chunks: bytes) -> bytes:
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", b"\0" * 13) + b"".join(chunks) + chunk(b"IEND", b"")
    )


def text(content: bytes, packed: bytes = b"\0\0") -> bytes:
    return SCENE_KEY.encode() + b"\0" + packed + b"\0\0" + content


BOMB = zlib.compress(b" " * (MAX_TEXT + 1), 9)


HOSTILE = {
    "empty": (b"", "not a PNG"),
    "other": (b"GIF89a", "not a PNG"),
    "no scene": (png(), "holds no scene"),
    "other text": (png(chunk(b"iTXt", b"Title\0\0\0\0\0hello")), "holds no scene"),
    "no end": (b"\x89PNG\r\n\x1a\n", "holds no scene"),
    "long chunk": (b"\x89PNG\r\n\x1a\n\xff\xff\xff\xffiTXtfhash", "holds no scene"),
    "cut": (png(chunk(b"iTXt", text(b"{}")))[:60], "damaged"),
    "wrong sum": (png(chunk(b"iTXt", text(b"{}"), wrong=1)), "damaged"),
    "no json": (png(chunk(b"iTXt", text(b"{"))), "scene is damaged"),
    "no utf-8": (png(chunk(b"iTXt", text(b'"\xff"'))), "scene is damaged"),
    "deep": (png(chunk(b"iTXt", text(b"[" * 500_000))), "scene is damaged"),
    "a list": (png(chunk(b"iTXt", text(b"[]"))), "table of settings is needed"),
    "unknown key": (png(chunk(b"iTXt", text(b'{"camra": {}}'))), "did you mean 'camera'"),
    "bomb": (png(chunk(b"iTXt", text(BOMB, b"\1\0"))), "longer than 1 MiB"),
    "not packed": (png(chunk(b"iTXt", text(b"{}", b"\1\0"))), "damaged"),
    "too long": (png(chunk(b"iTXt", text(b" " * (MAX_TEXT + 2000)))), "holds no scene"),
    "short": (png(chunk(b"iTXt", SCENE_KEY.encode() + b"\0")), "scene is damaged"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_other_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    content, message = HOSTILE[name]
    path = tmp_path / "hostile.png"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        scene_in_png(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path))


def test_a_packed_scene_and_a_file_that_is_not_there(tmp_path: Path) -> None:
    info = PngInfo()
    info.add_itxt(SCENE_KEY, '{"step": 2}', zip=True)
    Pictures.new("RGB", (2, 2)).save(tmp_path / "a.png", pnginfo=info)
    assert scene_in_png(tmp_path / "a.png") == Scene(step=2)
    with pytest.raises(FileNotFoundError, match="no such picture"):
        scene_in_png(tmp_path / "b.png")
    with pytest.raises(InputError, match="cannot be read"):
        scene_in_png(tmp_path)


RAMP = np.linspace(0, 1, 501)


def test_names_are_read_in_any_case_and_spelling() -> None:
    np.testing.assert_array_equal(named_map("Gray_R")(RAMP), named_map("grey_r")(RAMP))
    with pytest.raises(
        InputError, match=r"colour map 'virdis' is not known; did you mean 'viridis'\?"
    ):
        named_map("virdis")
    with pytest.raises(InputError, match=r"did you mean 'plasma_r'\?"):
        named_map("plasmaa_r")


def test_colours_in_words() -> None:
    assert parse_colour("#ff8000") == (1.0, 128 / 255, 0.0)
    assert parse_colour("#F80") == (1.0, 136 / 255, 0.0)
    assert parse_colour("White") == (1.0, 1.0, 1.0)
    assert parse_colour("lightgray") == parse_colour("lightgrey")
    for wrong in ("", "#12", "#12345g", "rgb(1,2,3)", "ff0000"):
        with pytest.raises(InputError, match="write '#rrggbb' or a name") as caught:
            parse_colour(wrong)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="did you mean 'orange'"):
        parse_colour("ornge")


# Colours of vtkColorTransferFunction 9.7 at 0.25, 0.5 and 0.6 between Moreland's cool and warm.
ENDS = np.array([[0.231, 0.298, 0.753], [0.706, 0.016, 0.15]])


VTK = {
    "RGB": [(0.34975, 0.2275, 0.60225), (0.4685, 0.157, 0.4515), (0.516, 0.1288, 0.3912)],
    "HSV": [
        (0.37596, 0.174746, 0.74125),
        (0.631227, 0.120162, 0.7295),
        (0.7248, 0.098795, 0.704682),
    ],
    "Lab": [
        (0.4666, 0.25309, 0.595453),
        (0.580548, 0.202564, 0.443551),
        (0.613286, 0.179415, 0.384307),
    ],
    "Diverging": [
        (0.553325, 0.688641, 0.995265),
        (0.865395, 0.86541, 0.865396),
        (0.947958, 0.795133, 0.717177),
    ],
}


@pytest.mark.parametrize("space", VTK)
def test_between_two_colours_lies_what_vtk_has(space: str) -> None:
    colours = ColourMap(positions=np.array([-2.0, 2.0]), points=ENDS, space=space)
    np.testing.assert_allclose(colours([-1.0, 0.0, 0.4]), VTK[space], rtol=0, atol=1e-4)


@pytest.mark.parametrize("space", SPACES)
def test_points_clipping_and_missing_values(space: str) -> None:
    positions = np.array([0.0, 1.0, 4.0])
    points = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.9, 1.0]])
    colours = ColourMap(positions=positions, points=points, space=space, nan=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(
        colours([[-9.0, 0.0], [4.0, np.inf]]), points[[[0, 0], [2, 2]]], rtol=0, atol=1e-3
    )
    np.testing.assert_allclose(colours(1.0), points[1], rtol=0, atol=1e-3)
    assert colours(np.nan).tolist() == [0.1, 0.2, 0.3]
    mixed = colours(np.linspace(-1, 5, 999))
    assert np.all((mixed >= 0) & (mixed <= 1))


def test_a_name_that_pillow_has_looked_up_is_still_known() -> None:
    assert ImageColor.getrgb("tomato") == (255, 99, 71)
    assert parse_colour("tomato") == (1.0, 99 / 255, 71 / 255)


OURS = ("balance", "jet")


OTHERS = {
    "grey": "gray",
    "blues": "Blues",
    "greens": "Greens",
    "reds": "Reds",
    "ylgnbu": "YlGnBu",
    "spectral": "Spectral",
    "rdbu": "RdBu",
}


@pytest.mark.parametrize("name", [name for name in COLOUR_MAPS if name not in OURS])
def test_maps_are_those_of_matplotlib(name: str) -> None:
    original = matplotlib.colormaps[OTHERS.get(name, name)]
    places = np.arange(original.N) / (original.N - 1)
    np.testing.assert_allclose(
        named_map(name)(places), original(places)[:, :3], rtol=0, atol=6 / 255
    )


RANDOM = np.random.default_rng(5).random((200, 3))


def test_conversions_have_inverses() -> None:
    np.testing.assert_allclose(hsv_to_rgb(rgb_to_hsv(RANDOM)), RANDOM, rtol=0, atol=1e-12)
    np.testing.assert_allclose(lab_to_rgb(rgb_to_lab(RANDOM)), RANDOM, rtol=0, atol=5e-4)
    np.testing.assert_allclose(rgb_to_lab(np.ones(3)), [100, 0, 0], rtol=0, atol=0.01)


PRESET = {
    "Name": "of mine",
    "ColorSpace": "Lab",
    "RGBPoints": [0, 1, 0, 0, 5, 0, 1, 0, 10, 0, 0, 1],
    "Points": [0, 0, 0.5, 0, 4, 1, 0.5, 0, 10, 0.5, 0.5, 0],
    "NanColor": [0.25, 0, 0],
}


def written(folder: Path, content: Any) -> Path:
    path = folder / "preset.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    "content", [PRESET, [PRESET], [{"Name": "no colours"}, PRESET, {"RGBPoints": []}]]
)
def test_one_or_a_list(tmp_path: Path, content: Any) -> None:
    preset = read_preset(written(tmp_path, content))
    assert (preset.name, preset.colours.space, preset.colours.nan) == (
        "of mine",
        "Lab",
        (0.25, 0.0, 0.0),
    )
    np.testing.assert_array_equal(preset.colours.positions, [0, 5, 10])
    np.testing.assert_allclose(preset.colours(5.0), [0, 1, 0], rtol=0, atol=1e-3)
    np.testing.assert_array_equal(preset.opacity, [[0, 0], [4, 1], [10, 0.5]])
    assert not preset.is_relative


def test_colours_and_opacities_move_together(tmp_path: Path) -> None:
    preset = read_preset(written(tmp_path, PRESET)).rescaled(100, 200)
    np.testing.assert_array_equal(preset.colours.positions, [100, 150, 200])
    np.testing.assert_allclose(preset.opacity, [[100, 0], [140, 1], [200, 0.5]])


# Opacities of vtkPiecewiseFunction 9.7 from 0 to 1, at these places.
PLACES = [0.1, 0.25, 0.4, 0.45, 0.49, 0.5, 0.51, 0.6, 0.9]
CURVES = {
    (0.7, 0.0): [0.07143, 0.17857, 0.28571, 0.32143, 0.35, 0.35714, 0.36429, 0.42857, 0.83333],
    (0.5, 0.5): [
        2.0e-05,
        4.0e-03,
        8.905e-02,
        2.2001e-01,
        4.2884e-01,
        0.5,
        5.7116e-01,
        9.1095e-01,
        9.9998e-01,
    ],
    (0.5, 1.0): [0.0, 0.0, 0.00538, 0.06613, 0.35253, 0.5, 0.64747, 0.99462, 1.0],
    (0.3, 0.2): [0.01502, 0.27203, 0.70111, 0.77639, 0.82576, 0.83673, 0.84717, 0.92047, 0.99883],
}


@pytest.mark.parametrize("curve", CURVES)
def test_curves_become_straight_pieces(tmp_path: Path, curve: tuple[float, float]) -> None:
    preset = read_preset(written(tmp_path, {**PRESET, "Points": [0, 0, *curve, 1, 1, 0.5, 0]}))
    assert preset.opacity is not None
    assert len(preset.opacity) == PIECES + 1
    assert np.all(np.diff(preset.opacity[:, 0]) > 0)
    np.testing.assert_allclose(
        np.interp(PLACES, *preset.opacity.T), CURVES[curve], rtol=0, atol=6e-3
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a preset of ParaView"),
        ("[" * 100_000, "not a preset of ParaView"),
        ([], "holds no preset with RGBPoints"),
        ({"Name": "x", "IndexedColors": [1, 0, 0]}, "IndexedColors are for categories"),
        ("7", "holds no preset"),
        (
            {**PRESET, "RGBPoints": []},
            "RGBPoints is not a list of finite numbers, 4 for each point",
        ),
        ({**PRESET, "RGBPoints": [0, 1, 0]}, "RGBPoints is not a list"),
        ({**PRESET, "RGBPoints": [0, 1, 0, "0"]}, "RGBPoints is not a list"),
        ({**PRESET, "RGBPoints": [0, 1, 0, float("nan")]}, "RGBPoints is not a list"),
        ({**PRESET, "RGBPoints": [10**400, 1, 0, 0]}, "RGBPoints is not a list"),
        ({**PRESET, "RGBPoints": [1, 0, 0, 0, 0, 1, 1, 1]}, "values of RGBPoints do not ascend"),
        ({**PRESET, "RGBPoints": [1, 0, 0, 0, 1, 1, 1, 1]}, "values of RGBPoints do not ascend"),
        ({**PRESET, "RGBPoints": [0, 0, 0, 0, 1, 1, 1, 1.5]}, "colour outside 0 to 1"),
        ({**PRESET, "ColorSpace": "Luv"}, "ColorSpace is 'Luv'; allowed: RGB"),
        ({**PRESET, "Points": [0, 0, 0.5, 0, 0, 1, 0.5, 0]}, "values of Points do not ascend"),
        ({**PRESET, "Points": [0, 2, 0.5, 0]}, "outside 0 to 1"),
        ({**PRESET, "NanColor": [1]}, "NanColor is not a list"),
    ],
)
def test_other_files_are_refused_in_one_line_colours(
    tmp_path: Path, content: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_preset(written(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_a_preset_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such preset"):
        read_preset(tmp_path / "none.json")


RANGE = (0.0, 10.0)


def at(name: str, values: Any, **arguments: Any) -> list[float]:
    points = opacity_preset(
        name,
        **{"shown": RANGE, "value_range": RANGE, "features": (), "histogram": None, **arguments},
    )
    assert np.all(np.diff(points[:, 0]) > 0)
    assert np.all((points[:, 1] >= 0) & (points[:, 1] <= 1))
    return np.interp(values, *points.T).tolist()


def test_the_presets_of_pyvista() -> None:
    assert at("linear", [0, 2.5, 10]) == [0, 0.25, 1]
    assert at("linear_r", [0, 2.5, 10]) == [1, 0.75, 0]
    np.testing.assert_allclose(at("geom", [0, 9, 10]), [0, (1e-6 / 255) ** 0.1, 1], atol=0.01)
    np.testing.assert_allclose(at("geom_r", [10, 1, 0]), at("geom", [0, 9, 10]))
    np.testing.assert_allclose(
        at("sigmoid", [1, 4, 5, 6, 10]),
        [0, 1 / (1 + np.e**2), 0.5, 1 / (1 + np.e**-2), 1],
        atol=0.01,
    )
    assert at("foreground", [0, 0.04, 1, 10]) == pytest.approx([0, 1, 1, 1])
    assert at("opaque", [-5, 0, 10, 50]) == [1, 1, 1, 1]


def test_surfaces_and_intervals_of_one_value_are_tents() -> None:
    for feature in ("isosurface:3", "interval:3:3"):
        assert at("auto", [2, 3, 4], features=(feature,)) == pytest.approx([0, SURFACE, 0])


def test_several_features_show_the_largest_opacity() -> None:
    features = ("interval:1:5", "isosurface:4.9", "segmentation:8")
    values = np.linspace(0, 10, 4001)
    alone = [at("auto", values, features=(feature,)) for feature in features]
    np.testing.assert_allclose(
        at("auto", values, features=features), np.max(alone, axis=0), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("feature", ["all", "mask:m.npy"])
def test_without_a_feature_the_background_is_clear(feature: str) -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(4, 0.1, 9000), rng.uniform(0, 10, 1000)])
    counts, edges = np.histogram(values, 256, RANGE)
    opacities = at("auto", [0, 3.9, 4, 4.1, 7, 10], features=(feature,), histogram=(edges, counts))
    assert opacities[2] == 0
    assert opacities[0] > opacities[1]
    assert BACKGROUND >= opacities[5] >= opacities[4] > opacities[3]
    assert opacities[5] == pytest.approx(BACKGROUND, rel=0.1)
    assert at("auto", [0, 10], features=(feature,)) == [0, BACKGROUND]


def test_one_value_alone_in_a_histogram() -> None:
    counts = np.zeros(256, dtype=np.int64)
    edges = np.linspace(0, 10, 257)
    assert at("auto", [0, 10], histogram=(edges, counts)) == [0, BACKGROUND]
    counts[7] = 100
    assert at("auto", [edges[7]], histogram=(edges, counts)) == [0]
    assert at("auto", [3.0], histogram=(edges, counts), value_range=(3.0, 3.0)) == [BACKGROUND]


def test_up_to_eight_vertices_every_value_is_seen_as_through_eight_spacings() -> None:
    full = 1 - (1 - BACKGROUND) ** 8
    histogram = (np.linspace(0, 10, 11), np.array([90, 1, 1, 1, 1, 1, 1, 1, 1, 1]))
    for vertices, length in ((2, 1.0), (8, 7.0), (8, 9.0)):
        (opacity,) = set(at("auto", [0, 3, 10], thinnest=(vertices, length), histogram=histogram))
        through = 1 - (1 - opacity) ** length
        assert through == pytest.approx(max(full, 1 - (1 - BACKGROUND) ** length))
    thick = at("auto", [0, 3, 10], thinnest=(9, 8.0), histogram=histogram)
    assert thick == at("auto", [0, 3, 10], histogram=histogram)
    assert thick[0] == 0


VALUES_TRANSFER_FUNCTION = np.linspace(-2, 12, 1401)


def made(spec: dict[str, Any] | None = None, **arguments: Any) -> TransferFunction:
    return TransferFunction.of(
        TransferFunctionSpec.from_dict(spec or {}),
        **{"value_range": (0.0, 10.0), "spacing": 1.0, **arguments},
    )


@pytest.mark.parametrize(
    ("positions", "spec", "ends"),
    [
        ((0.0, 1.0), {}, (0, 10)),
        ((-1.0, 1.0), {"range": [2, 3]}, (2, 3)),
        ((3.0, 7.0), {}, (3, 7)),
        ((3.0, 7.0), {"range": [0, 1]}, (0, 1)),
    ],
)
def test_presets_of_paraview(
    tmp_path: Path, positions: tuple[float, float], spec: dict[str, Any], ends: tuple[float, float]
) -> None:
    low, high = positions
    path = tmp_path / "p.json"
    path.write_text(
        json.dumps(
            {
                "RGBPoints": [low, 0, 0, 0, high, 1, 1, 1],
                "Points": [low, 0, 0.5, 0, high, 0.5, 0.5, 0],
            }
        )
    )
    function = made({"colours": str(path), **spec})
    assert tuple(function.colours.positions) == ends
    np.testing.assert_allclose(function.points, [[ends[0], 0], [ends[1], 0.5]])
    assert len(made({"colours": str(path), **spec, "opacity": "opaque"}).points) == 1


@pytest.mark.parametrize("density", [0.01, 1.0])
@pytest.mark.parametrize(
    "opacity", [*PRESETS[2:], "auto", [[1, 0], [2, 0.9], [2.5, 0], [6, 0], [7, 1.0]]]
)
def test_a_table_is_the_function(opacity: Any, density: float) -> None:
    function = made({"opacity": opacity, "density": density})
    low, high, colours, extinctions = function.table()
    assert (colours.shape, colours.dtype, extinctions.shape, extinctions.dtype) == (
        (4096, 3),
        np.float32,
        (4096,),
        np.float64,
    )
    inside = VALUES_TRANSFER_FUNCTION[
        (VALUES_TRANSFER_FUNCTION >= 0) & (VALUES_TRANSFER_FUNCTION <= 10)
    ]
    place = (inside - low) / (high - low) * 4095
    tabled = np.interp(place, np.arange(4096), 1 - np.exp(-extinctions))
    # Towards opacity 1 the extinction rises without bound: entries beside a point may differ.
    away = np.min(np.abs(inside[:, None] - function.points[:, 0]), axis=1) > (high - low) / 4095
    np.testing.assert_allclose(
        tabled[away], (1 - np.exp(-function.extinction(inside)))[away], rtol=0, atol=0.02
    )
    shown = function.extinction(inside) > 0
    mixed = np.stack(
        [np.interp(place, np.arange(4096), colours[:, channel]) for channel in range(3)], axis=-1
    )
    np.testing.assert_allclose(mixed[shown], function.colour(inside)[shown], rtol=0, atol=2e-3)


def test_a_range_shows_something_where_any_value_of_it_has_an_opacity() -> None:
    function = made({"opacity": [[1, 0], [2, 0.5], [3, 0], [6, 0], [7, 0.5], [8, 0]]})
    entry = (function.span[1] - function.span[0]) / 4095
    for a, b in np.sort(np.random.default_rng(3).uniform(-1, 11, (500, 2))):
        for low, high in ((a, b), (a, a)):
            wider = low - entry, high + entry
            truth = any(wider[0] < end and wider[1] > begin for begin, end in ((1, 3), (6, 8)))
            assert function.shows(low, high) is truth


def test_a_peak_that_a_table_misses_is_told() -> None:
    function = made(
        {
            "opacity": [
                [1, 0],
                [2, 0.5],
                [3, 0],
                [6.00031, 0],
                [6.00032, 1],
                [6.00033, 0],
                [8, 0],
                [9, 0.2],
            ]
        }
    )
    with pytest.warns(FhashWarning, match="peak of the opacity is narrower"):
        function.table(64)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"opacity": "liner"}, r"opacity 'liner' is not known; did you mean 'linear'\?"),
        ({"colours": "virids"}, "did you mean 'viridis'"),
        ({"colours": "none.json"}, "no such preset"),
        ({"colours": "v" * 5000}, "is not known"),
        ({"colours": "a\0b.json"}, "not a preset"),
        ({"colours": [[1, "red"], [1, "blue"]]}, "values of 'colours' do not ascend"),
        ({"colours": []}, "values of 'colours' do not ascend"),
        ({"colours": [[1, "rot"]]}, "colour 'rot' is not known"),
        ({"opacity": []}, "no points"),
        ({"opacity": [[2, 0], [1, 1]]}, "values of 'opacity' do not ascend"),
        ({"opacity": [[1, 0], [2, 1.5]]}, "opacity is 1.5 at the value 2; allowed: 0 to 1"),
        ({"opacity": [[1, 0], [2, 0]]}, "shows nothing"),
        ({"opacity": [[20, 0], [30, 1]]}, "shows nothing"),
        ({"density": 0}, "shows nothing"),
        ({"range": [3, 3]}, "range is 3 to 3"),
        ({"opacity": "feature"}, "'feature' needs a file of an interval"),
    ],
)
def test_words_that_make_no_function(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        made(spec)
    assert "\n" not in str(caught.value)


def test_a_constant_series_and_json() -> None:
    function = made({"opacity": "opaque"}, value_range=(3.0, 3.0))
    low, high, *_ = function.table()
    assert low < high
    assert function.shows(3.0, 3.0)
    assert np.all(function.extinction([3.0]) == OPAQUE)
    assert json.loads(json.dumps(function.to_dict()))["opacity"] == [[3.0, 1.0]]
    assert made({}, value_range=(3.0, 3.0), features=("isosurface:3",)).shows(3.0, 3.0)


LARGEST = float(np.finfo(np.float64).max)


@pytest.mark.parametrize("value", [LARGEST, -LARGEST, 5e-324, 0.0])
@pytest.mark.parametrize("opacity", ["auto", "linear", "opaque"])
def test_a_constant_at_the_end_of_float64_has_a_table(value: float, opacity: str) -> None:
    with np.errstate(all="raise", under="ignore"):
        function = made(
            {"opacity": opacity},
            value_range=(value, value),
            features=("isosurface:" + repr(value),),
        )
        low, high, colours, extinctions = function.table()
    assert -LARGEST <= low < high <= LARGEST
    assert np.isfinite(colours).all()
    assert np.isfinite(extinctions).all()
    assert function.shows(value, value)


@pytest.mark.parametrize("reach", [LARGEST, 1e300, 1.0])
def test_a_range_whose_width_overflows_is_drawn_like_any_other(reach: float) -> None:
    features = ("interval:-inf:" + repr(reach / 2),)
    with np.errstate(all="raise", under="ignore"):
        function = made({}, value_range=(-reach, reach), features=features)
        opacities = function.opacity(reach * np.array([-1, -0.5, 0.4, 0.425, 0.5, 1]))
        function.table()
        linear = made({"opacity": "linear"}, value_range=(-reach, reach)).opacity(
            reach * np.array([-1, -0.5, 0, 1])
        )
    np.testing.assert_allclose(opacities / INTERVAL, [1, 1, 2 / 3, 0.5, 0, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear, [0, 0.25, 0.5, 1])


def test_light_that_passes_does_not_depend_on_the_steps() -> None:
    for steps in (1, 10, 10_000_000):
        passed = np.exp(-extinction_of(0.7, 2.0) * 2.0 / steps)
        assert float(passed) == pytest.approx(0.3 ** (1 / steps), rel=1e-12)
