"""Scenes between the keys of an animation."""

from __future__ import annotations

import numpy as np

from fhash_codec import Volume
from fhash_codec.rendering.animation.animation import Animation, Key
from fhash_codec.rendering.scene.scene import (
    Effects,
    Scene,
    TransferFunctionSpec,
)

SMALL = Scene(size=(20, 14))


def test_keys_are_met_and_their_settings_mixed(volume: Volume) -> None:
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
