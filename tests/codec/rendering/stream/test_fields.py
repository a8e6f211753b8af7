"""Fields of streamed samples: a decoded frame, or the model itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec.rendering.stream.fields import NetworkField
from fhash_codec.rendering.task.units import Units


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_a_field_of_a_network_has_the_values_and_slopes_of_its_volume(
    files: dict[str, Path], step: float
) -> None:
    x, y, z = np.array([8.7, 19.0]), np.array([10.1, 14.0]), np.array([9.3, 12.0])
    places = np.stack([x, y, z], axis=-1)
    with fhash_codec.open(files["paper"]) as network:
        values, slopes = network.sample(t=step, z=z, y=y, x=x, gradient=True)
        field = NetworkField(network, step, Units())
        np.testing.assert_allclose(field.values(places), values, rtol=1e-5)
        np.testing.assert_allclose(field.slopes(places), slopes[:, :0:-1], rtol=1e-4, atol=1e-5)
