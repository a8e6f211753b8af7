"""The light of a picture, and the noise that it ignores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Scene
from fhash_codec.rendering.picture.lighting import coding_noise
from fhash_codec.rendering.picture.planning import plan_picture


def test_the_errors_of_a_bounded_file_are_noise(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((1, 12, 12, 12)).astype(np.float32)
    for config, factor in (({"max_error": 0.1}, 2), ({"max_error_rel": 0.1}, 2), ({"psnr": 30}, 0)):
        path = tmp_path / "a.fhz"
        fhash_codec.encode(values, path, fhash_codec.EncodeConfig(effort=1, **config))
        with fhash_codec.open(path) as volume:
            largest = volume.container.header["quality"]["max_abs_error"]
            assert largest > 0.01
            assert coding_noise(volume) == pytest.approx(factor * largest)
            assert plan_picture(volume, Scene()).task.noise == pytest.approx(factor * largest)
        path.unlink()
