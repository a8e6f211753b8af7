"""The norms of the synthesis vectors: those of the vectors themselves, on short and long axes."""

from __future__ import annotations

import numpy as np
import pytest
from specs import MIXES, noise, spec_of

from fhash_formats.transform.axes.lifting import Transform
from fhash_formats.transform.axes.spec import AxisTransform
from fhash_formats.transform.axes.weights import axis_norms, band_lengths


def test_a_low_band_is_half_as_long_rounded_up() -> None:
    assert band_lengths(13, 5) == [13, 7, 4, 2, 1, 1]
    assert band_lengths(4, 0) == [4]


def test_without_a_transform_all_norms_are_1() -> None:
    assert axis_norms(AxisTransform(kind="none"), 3).tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("kinds", MIXES)
@pytest.mark.parametrize("shape", [(2, 3, 5, 7), (3, 8, 16, 12)])
def test_norms_are_those_of_the_synthesis_vectors(
    shape: tuple[int, ...], kinds: tuple[str, ...]
) -> None:
    transform = Transform(spec_of(kinds, (1, 2, 3, 3), shape), shape, np.float64)
    places = np.random.default_rng(2).choice(int(np.prod(shape)), 25, replace=False)
    for place in places:
        impulse = np.zeros(shape)
        impulse.flat[place] = 1.0
        assert np.sqrt(np.sum(transform.inverse(impulse) ** 2)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("kinds", [("haar",) * 4, ("9/7",) * 4])
def test_white_noise_in_the_coefficients_is_as_large_in_the_values(kinds: tuple[str, ...]) -> None:
    shape = (8, 16, 32, 32)
    transform = Transform(spec_of(kinds, (2, 2, 3, 3), shape), shape, np.float64)
    assert np.var(transform.inverse(noise(shape, np.float64))) == pytest.approx(1.0, rel=0.05)
    band = np.zeros(shape)
    band[4:, :4, 16:, :16] = noise((4, 4, 16, 16), np.float64)
    assert np.sum(transform.inverse(band) ** 2) / band[4:, :4, 16:, :16].size == pytest.approx(
        1.0, rel=0.15
    )


@pytest.mark.parametrize("shape", [(1, 1, 1, 1500), (600, 1, 2, 3), (1, 1, 700, 530)])
def test_long_axes_have_the_norms_of_the_interior(shape: tuple[int, ...]) -> None:
    transform = Transform(spec_of(("9/7",) * 4, (4,) * 4, shape), shape, np.float64)
    middle = tuple(n * 3 // 4 if n > 512 else 0 for n in shape)  # inside the finest high band
    impulse = np.zeros(shape)
    impulse[middle] = 1.0
    assert np.sum(transform.inverse(impulse) ** 2) == pytest.approx(1.0, abs=1e-6)
