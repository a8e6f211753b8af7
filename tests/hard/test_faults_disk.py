"""A disk that is full from the n-th operation on, for every n: the command prints one line and
changes nothing."""

from __future__ import annotations

import errno

import pytest
from faulty import COMMANDS, Bench, moments
from reporting import record

EACH_ALONE = ("render pictures",)
"""Commands with several outputs, each of which is complete or absent by itself."""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_fills_up_at_any_operation_changes_nothing(bench: Bench, name: str) -> None:
    count, failed = bench.operations(name), 0
    for number in moments(count):
        before = bench.old(name)
        ended = bench.run(name, ("at_operation", bench.out, number, errno.ENOSPC))
        now = bench.now()
        if ended.code == 0:  # the operation was not needed, such as a link
            assert now == bench.new(name), (number, ended.output)
            continue
        failed += 1
        assert ended.code == 1, (number, ended.output)
        assert ended.line.startswith("fhash: error: "), number
        assert "no space left on the disk" in ended.line, number
        if name in EACH_ALONE:
            assert now.keys() == before.keys()
            assert all(
                data in (before[place], bench.new(name)[place]) for place, data in now.items()
            ), number
        else:
            assert now == before, number
    assert failed
    record(
        "a full disk",
        {"command": name, "operations": count, "tried": len(moments(count)), "refused": failed},
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_that_may_not_become_so_long_changes_nothing(bench: Bench, name: str) -> None:
    before = bench.old(name)
    longest = max(len(data) for data in bench.new(name).values() if data is not None)
    for size in {
        longest - 1,
        longest // 2,
        min(700, longest // 4),
    }:  # larger than the message, which goes to a file, too
        ended = bench.run(name, ("file_limit", size))
        assert ended.code == 1, (size, ended.output)
        assert ended.line.startswith("fhash: error: "), size
        assert "cannot be written: File too large" in ended.line, (size, ended.line)
        if name not in EACH_ALONE:
            assert bench.now() == before, size
        before = bench.old(name)
