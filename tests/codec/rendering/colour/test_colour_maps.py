"""Named colour maps against matplotlib's."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from fhash_codec.rendering.colour.colour_maps import COLOUR_MAPS
from fhash_codec.rendering.colour.colours import named_map

OURS = ("balance", "jet")


OTHERS = {
    "grey": "gray",
    "blues": "Blues",
    "greens": "Greens",
    "reds": "Reds",
    "ylgnbu": "YlGnBu",
    "spectral": "Spectral",
    "rdbu": "RdBu",
}


@pytest.mark.parametrize("name", [name for name in COLOUR_MAPS if name not in OURS])
def test_maps_are_those_of_matplotlib(name: str) -> None:
    original = matplotlib.colormaps[OTHERS.get(name, name)]
    places = np.arange(original.N) / (original.N - 1)
    np.testing.assert_allclose(
        named_map(name)(places), original(places)[:, :3], rtol=0, atol=6 / 255
    )
