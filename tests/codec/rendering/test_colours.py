"""Colours, colour spaces, colour maps and ParaView's presets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from PIL import ImageColor

from fhash_codec.rendering.colour_maps import COLOUR_MAPS
from fhash_codec.rendering.colours import (
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
from fhash_formats.errors import InputError

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
def test_other_files_are_refused_in_one_line(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_preset(written(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_a_preset_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such preset"):
        read_preset(tmp_path / "none.json")
