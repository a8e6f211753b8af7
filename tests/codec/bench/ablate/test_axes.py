"""Axes of ablations: their settings are allowed, with the default among them."""

from __future__ import annotations

import pytest

from fhash_codec.bench.ablate.axes import AXES, Axis, axes_named
from fhash_codec.config import EncodeConfig
from fhash_formats.errors import InputError


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_the_reference_is_the_default(axis: Axis) -> None:
    common = {"profile": axis.profile, **dict(axis.common)}
    usual = EncodeConfig.from_dict(common)
    reference = EncodeConfig.from_dict({**common, **axis.varied[axis.reference]})
    assert reference.model_fold == usual.model_fold
    assert reference.model_embedding_size == usual.model_embedding_size
    assert reference.model_width == usual.model_width
    for name in set(axis.varied[axis.reference]) - {"fold", "embedding_size", "width"}:
        assert getattr(reference, name) == getattr(usual, name), name


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_all_settings_are_allowed_and_differ(axis: Axis) -> None:
    configs = [
        EncodeConfig.from_dict({"profile": axis.profile, **dict(axis.common), **varied})
        for varied in axis.varied
    ]
    assert len(set(configs)) == len(configs)


def test_axes_are_chosen_by_name_in_their_own_order() -> None:
    assert axes_named([]) == AXES
    assert [axis.name for axis in axes_named(["tile", "batch"])] == ["batch", "tile"]
    with pytest.raises(InputError, match="unknown axis 'bricks'; did you mean 'brick'"):
        axes_named(["bricks"])
