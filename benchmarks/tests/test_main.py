"""`fhash bench`: the benchmarks that there are."""

from __future__ import annotations

from collections.abc import Callable

from click.testing import Result

from fhash_bench.main import command


def test_every_benchmark_is_named_in_the_help(fhash: Callable[..., Result]) -> None:
    result = fhash("bench", "--help")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.stdout.splitlines() if line.startswith("  ")]
    assert set(command.commands) <= set(listed)
    assert {"train", "rate", "render"} <= set(command.commands)
