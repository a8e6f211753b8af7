"""Work of the profile paper: epochs alone change the training."""

from __future__ import annotations

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.paper_work import PaperProbe

PROBE = PaperProbe(
    stages={"scan": 1.0, "writing": 2.0},
    step=0.5,
    curve=0.25,
    samples=100_000,
    bricks=1000,
    bytes=1000,
)


@pytest.mark.parametrize(
    ("epochs", "points", "steps"), [(1, 1, 20), (30, 30, 600), (150, 75, 3000), (0, 50, 1000)]
)
def test_each_step_and_each_point_of_the_curve_is_counted(
    epochs: int, points: int, steps: int
) -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=epochs)
    assert PROBE.seconds(config) == 3 + 0.5 * steps + 0.25 * points


def test_a_batch_of_another_size_makes_other_steps() -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=10, batch=10_000)
    assert PROBE.seconds(config) == 3 + 0.5 * 100 + 0.25 * 10
