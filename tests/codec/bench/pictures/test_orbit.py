"""An orbit about a shell: bricks that are kept change no picture."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.bench.pictures.orbit import orbit, shell


def test_a_shell_lies_about_the_middle() -> None:
    values = shell(41)
    assert values.shape == (41, 41, 41)
    assert values.dtype == np.float32
    assert values.max() > 0.9
    assert values[20, 20, 20] == values[0, 0, 0] == pytest.approx(0, abs=1e-6)


def test_pictures_with_kept_bricks_take_the_same_samples() -> None:
    unlit, lit = orbit(2, 24, side=40)
    assert unlit.name == "shell of 40^3, unlit: bricks kept"
    for switch in (unlit, lit):
        assert switch.counters_off == switch.counters_on
        assert switch.off_ms > 0
        assert switch.on_ms > 0
    assert unlit.counters_on["gradients"] == 0 < lit.counters_on["gradients"]
