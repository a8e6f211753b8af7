"""ParaView's preset files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.colour.paraview import PIECES, read_preset
from fhash_formats.errors import InputError

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


def test_what_a_preset_may_leave_out(tmp_path: Path) -> None:
    preset = read_preset(written(tmp_path, {"RGBPoints": [-1, 0, 0, 0, 1, 1, 1, 1]}))
    assert (preset.name, preset.colours.space, preset.opacity, preset.is_relative) == (
        "preset",
        "RGB",
        None,
        True,
    )


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
