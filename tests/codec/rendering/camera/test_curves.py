"""The cubic that never overshoots."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.curves import pchip


def test_the_cubic_never_overshoots() -> None:
    at, values = np.array([0.0, 0.1, 0.5, 0.6, 1.0]), np.array([[0.0], [1.0], [1.0], [5.0], [4.0]])
    curve = np.array([pchip(at, values, share)[0] for share in np.linspace(0, 1, 501)])
    assert curve.min() >= -1e-12
    assert curve.max() <= 5 + 1e-12
    inside = curve[(np.linspace(0, 1, 501) >= 0.1) & (np.linspace(0, 1, 501) <= 0.5)]
    np.testing.assert_allclose(inside, 1.0)
    for share, value in zip(at, values[:, 0], strict=True):
        assert pchip(at, values, share)[0] == pytest.approx(value)
