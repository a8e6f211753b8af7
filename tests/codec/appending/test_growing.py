"""`GrowingFile`: what the header of a file says while it grows."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.appending import growing
from fhash_codec.appending.figures import Figures
from fhash_codec.appending.growing import GrowingFile
from fhash_codec.appending.planning import plan_layers
from fhash_formats.series import index_coordinate

SHAPE = (3, 4, 5)


@pytest.fixture
def begun(tmp_path):
    """A file without steps, and its frames."""
    frames = np.random.default_rng(0).random((6, *SHAPE)).astype(np.float32)
    frames[3:] += 2
    config = EncodeConfig(max_error=0.05, effort=1, tile="2x3x4x5")
    plan = plan_layers(list(frames[:2]), config, 0.05, None)
    variable = {"name": "u", "units": "", "dtype": "float32", "attributes": {}}
    lengths = zip(("t", "z", "y", "x"), (1, *SHAPE), strict=True)
    coords = {axis: index_coordinate(axis, n) for axis, n in lengths}
    header = {**plan.header, "variable": variable}
    return GrowingFile(tmp_path / "a.fhz", plan.coder, header, coords, Figures(1.0)), frames


def add(file: GrowingFile, frames: np.ndarray, first: int, **options) -> None:
    with ThreadPoolExecutor(1) as workers:
        layer = file.coder.code(list(frames[first : first + 2]), file.figures, workers)
    file.add(layer, [float(first), first + 1.0], **options)


def test_the_header_follows_the_layers(begun) -> None:
    file, frames = begun
    with file:
        for first in (0, 2, 4):
            add(file, frames, first)
            with fhash_codec.open(file.path) as volume:
                so_far = frames[: first + 2]
                assert volume.shape == so_far.shape
                assert volume.info["value_range"] == [so_far.min(), so_far.max()]
                assert len(volume.info["quality"]["per_step"]) == first + 2
                parameters = volume.info["model"]["parameters"]
    assert parameters > 0
    assert (file.steps, file.times, file.shape) == (6, (0, 1, 2, 3, 4, 5), SHAPE)


def test_layers_may_be_published_together(begun) -> None:
    file, frames = begun
    with file:
        add(file, frames, 0, publish=False)
        add(file, frames, 2, publish=False)
        assert not file.path.exists()
        file.publish()
    with fhash_codec.open(file.path) as volume:
        assert np.abs(volume[:] - frames[:4]).max() <= 0.05
    assert os.listdir(file.path.parent) == ["a.fhz"]


def test_there_is_a_limit_of_steps(begun, monkeypatch) -> None:
    file, frames = begun
    monkeypatch.setattr(growing, "MAX_STEPS", 3)
    with file:
        add(file, frames, 0)
        with pytest.raises(InputError, match="at most 3: begin another"):
            add(file, frames, 2)
    with fhash_codec.open(file.path) as volume:
        assert volume.shape[0] == 2
