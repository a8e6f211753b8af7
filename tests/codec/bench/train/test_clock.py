"""The two clocks of a measurement."""

from __future__ import annotations

import torch

from fhash_codec.bench.train.clock import SHORTEST, Spent, now, wait


def test_seconds_add_up_by_each_clock() -> None:
    assert Spent(3.0, 2.0) - Spent(1.0, 0.5) + Spent(0.5, 0.5) == Spent(2.5, 2.0)


def test_processors_count_on_a_cpu_and_wall_time_elsewhere() -> None:
    spent = Spent(wall=3.0, cpu=2.0)
    assert (spent.on("cpu"), spent.on("cuda"), spent.on("wall")) == (2.0, 3.0, 3.0)
    assert Spent().on("cpu") == SHORTEST


def test_work_advances_the_clock_of_processors() -> None:
    begun = now()
    while (now() - begun).cpu == 0:
        sum(range(10_000))
    assert (now() - begun).wall > 0


def test_a_cpu_is_not_waited_for() -> None:
    wait(torch.device("cpu"))
