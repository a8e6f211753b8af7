"""Colours by name, and colours between two points of a map as in VTK."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import ImageColor

from fhash_codec.rendering.colour.colour_maps import COLOUR_MAPS
from fhash_codec.rendering.colour.colours import SPACES, ColourMap, named_map, parse_colour
from fhash_formats.errors import InputError

RAMP = np.linspace(0, 1, 501)


@pytest.mark.parametrize("name", COLOUR_MAPS)
def test_a_map_from_the_other_end(name: str) -> None:
    np.testing.assert_allclose(
        named_map(name + "_r")(RAMP), named_map(name)(1 - RAMP), rtol=0, atol=1e-12
    )


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


def test_a_step_holds_the_colour_before() -> None:
    colours = ColourMap(positions=np.array([0.0, 1.0, 2.0]), points=np.eye(3), space="Step")
    np.testing.assert_array_equal(colours([0.0, 0.99, 1.0, 1.99, 2.0]), np.eye(3)[[0, 0, 1, 1, 2]])


def test_two_points_at_one_value_are_a_jump() -> None:
    colours = ColourMap(
        positions=np.array([0.0, 1.0, 1.0, 2.0]),
        points=np.array([[0.0] * 3, [0.2] * 3, [0.8] * 3, [1.0] * 3]),
    )
    np.testing.assert_allclose(
        colours([0.5, 1 - 1e-9, 1.0, 1.5])[:, 0], [0.1, 0.2, 0.8, 0.9], rtol=0, atol=1e-6
    )


def test_a_rescaled_map_reaches_exactly_to_its_ends() -> None:
    colours = named_map("viridis").rescaled(-273.15, 1e6)
    assert colours.positions[[0, -1]].tolist() == [-273.15, 1e6]
    huge = named_map("viridis").rescaled(-1.7e308, 1.7e308)
    np.testing.assert_allclose(huge(0.0), named_map("viridis")(0.5), rtol=0, atol=1e-9)


def test_a_name_that_pillow_has_looked_up_is_still_known() -> None:
    assert ImageColor.getrgb("tomato") == (255, 99, 71)
    assert parse_colour("tomato") == (1.0, 99 / 255, 71 / 255)
