"""Cases of networks train small networks on the CPU, and reach every size that they name."""

from __future__ import annotations

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.cases import networks

CASES = {case.name: case for case in networks.CASES}


def configs(name: str) -> list[EncodeConfig]:
    return [*CASES[name].settings.values(), *CASES[name].more.values()]


def test_all_settings_are_of_the_profile_paper_on_the_cpu() -> None:
    for name in CASES:
        assert {(config.profile, config.device) for config in configs(name)} == {("paper", "cpu")}


@pytest.mark.parametrize(
    ("name", "field", "sizes"),
    [
        ("folds", "fold", {2, 3, 4, 5, 6, 7, 8}),
        ("layers", "hidden_layers", {0, 1, 2, 3, 8}),
        ("embeddings", "embedding_size", {1, 2, 3, 4, 5, 6, 7, 8}),
        ("widths", "width", {1, 2, 63, 64, 65, 257}),
    ],
)
def test_every_size_is_tried(name: str, field: str, sizes: set[int]) -> None:
    assert {getattr(config, field) for config in configs(name)} == sizes
    assert len(configs(name)) == len(sizes)


def test_wild_rates_are_tried_with_every_depth_and_schedule() -> None:
    tried = {(config.hidden_layers, config.schedule) for config in configs("wild-rates")}
    schedules = {config.schedule for config in configs("wild-rates")}
    assert len(schedules) == 2
    assert tried == {(layers, schedule) for layers in (0, 1, 2) for schedule in schedules}
    assert {config.learning_rate for config in configs("wild-rates")} == {1.0}
