"""Settings between those of two scenes."""

from __future__ import annotations

from fhash_codec.rendering.animation.mixing import mixed
from fhash_codec.rendering.scene.scene import (
    Isosurface,
)


def test_mixing_keeps_order_and_kinds() -> None:
    one, other = (
        Isosurface(value=1.0, colour="white", opacity=1.0),
        Isosurface(value=3.0, colour="black", opacity=0.0),
    )
    between = mixed((one,), (other,), 0.25)
    assert between == (Isosurface(value=1.5, colour="#bfbfbf", opacity=0.75),)
    assert mixed("viridis", "plasma", 0.5) == "viridis"
    assert mixed(None, one, 0.9) is None
    assert mixed(one, other, 1.0) is other
