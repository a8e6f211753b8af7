"""The function `render`, under each name and after any import."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering import render

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


def test_it_is_the_picture_of_a_renderer(volume: Volume) -> None:
    np.testing.assert_array_equal(render(volume, SMALL).rgba, Renderer(volume).render(SMALL).rgba)


@pytest.mark.parametrize(
    "statement",
    [
        "import fhash_codec.rendering.renderer; f = fhash_codec.render",
        "from fhash_codec import render as f; import fhash_codec.rendering.scene.scene as s",
        "from fhash_codec import *; f = render; import fhash_codec.rendering.scene.scene",
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
