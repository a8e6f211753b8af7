"""Comparison of a container with its series."""

from __future__ import annotations

import pytest

import fhash_codec
from fhash_codec import InputError
from fhash_formats.series import ArraySeries


def test_diff_refuses_another_shape(field, encoded) -> None:
    with pytest.raises(InputError, match=r"shape \(4, 8, 10, 18\)"):
        fhash_codec.diff(ArraySeries(field()), encoded[1])


def test_a_volume_is_equal_to_its_own_decoded_values(encoded) -> None:
    """The coreset has no error; the background stands outside, where the decoded values are NaN."""
    with fhash_codec.open(encoded[1]) as volume:
        figures = fhash_codec.diff(volume[...], encoded[1])
    assert (figures["rmse"], figures["max_abs_error"], figures["psnr"]) == (0, 0, None)
    assert figures["quality"]["rmse_domain"] == 0
    assert len(figures["quality"]["per_step"]) == 5
