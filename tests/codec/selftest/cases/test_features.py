"""The features of the cases lie where their names say."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases import features
from fhash_codec.selftest.cases.fields import SHAPE, lattice

CASES = {case.name: case for case in features.CASES}


def values_of(case: Case) -> np.ndarray:
    return np.stack(list(case.make().frames()))


def in_feature(name: str) -> np.ndarray:
    """The vertices (t, z, y, x) in the interval of a case."""
    (config, *_) = CASES[name].settings.values()
    (feature,) = config.features
    low, high = map(float, feature.removeprefix("interval:").split(":"))
    values = values_of(CASES[name])
    return (values >= low) & (values <= high)


def test_all_settings_of_a_case_have_its_feature() -> None:
    for case in features.CASES:
        configs = [*case.settings.values(), *case.more.values()]
        assert len({(config.features, config.dilation) for config in configs}) == 1, case.name


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("one-vertex", [1, 1, 1, 1]),
        ("whole-box", [2, 2, 2, 2]),
        ("opposite-corners", [8, 8, 8, 16]),
        ("empty-key-frames", [0, 0, 630, 0]),
        ("one-key-frame-filled", [0, 0, 0, 99]),
        ("nothing-selected", [0, 0, 0, 0]),
        ("everything", [990] * 4),
        ("open-interval", [990] * 4),
    ],
)
def test_a_feature_has_the_stated_number_of_vertices(name: str, counts: list[int]) -> None:
    assert in_feature(name).sum(axis=(1, 2, 3)).tolist() == counts


def test_the_feature_at_every_border_is_the_surface_of_the_domain() -> None:
    inside = np.zeros(SHAPE, dtype=bool)
    inside[:, 1:-1, 1:-1, 1:-1] = True
    np.testing.assert_array_equal(in_feature("at-every-border"), ~inside)


def test_no_two_vertices_of_every_second_vertex_touch() -> None:
    selected = in_feature("every-second-vertex")
    for axis in range(4):
        before = np.moveaxis(selected, axis, 0)
        assert not (before[1:] & before[:-1]).any()


def test_the_feature_beside_missing_values_touches_them() -> None:
    missing = np.isnan(values_of(CASES["beside-missing"]))
    _, _, y, _ = lattice()
    assert (in_feature("beside-missing") & (np.abs(y - 5) == 1)).any()
    assert missing[y == 5].all()
