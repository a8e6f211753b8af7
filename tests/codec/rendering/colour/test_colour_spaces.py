"""Conversions between colour spaces."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.colour.colour_spaces import (
    hsv_to_rgb,
    lab_to_rgb,
    rgb_to_hsv,
    rgb_to_lab,
)

RANDOM = np.random.default_rng(5).random((200, 3))


def test_conversions_have_inverses() -> None:
    np.testing.assert_allclose(hsv_to_rgb(rgb_to_hsv(RANDOM)), RANDOM, rtol=0, atol=1e-12)
    np.testing.assert_allclose(lab_to_rgb(rgb_to_lab(RANDOM)), RANDOM, rtol=0, atol=5e-4)
    np.testing.assert_allclose(rgb_to_lab(np.ones(3)), [100, 0, 0], rtol=0, atol=0.01)
