"""Hostile files are refused with one line and exit code 4, or decoded.

They never lead to another exception, a hang or a large allocation. FHASH_HARD=1 runs the long set.
Mutations are numbered, and a number is always the same file: `python tests/hard/hostile_trial.py
--write NUMBER FILE.fhz` writes it, to show a failure again.
"""

from __future__ import annotations

import os
import sys
from collections import Counter

import hostile
import hostile_trial
import mutations
import pytest
from reporting import LONG, record

QUICK, MANY = 560, 12_000
"""Mutations; all kinds of all goldens take turns."""

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="limits on memory and time are those of Linux"
)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    numbers = range(MANY if LONG else QUICK)
    processes = min(4, len(os.sched_getaffinity(0)))
    found = hostile.trials(numbers, processes, tmp_path_factory.mktemp("hostile"))
    assert found.mutations == len(numbers)
    record("hostile files", {"memory_limit": hostile_trial.MEMORY, **found.figures()})
    return found


def test_no_hostile_file_does_harm(report):
    assert not report.wrong, "\n".join(report.wrong[:20]) + f"\n{len(report.wrong)} in all"


def test_all_kinds_of_mutations_were_tried(report):
    assert set(report.kinds) == set(mutations.KINDS)


def test_damage_is_refused_and_much_of_what_is_sealed_reaches_the_decoders(report):
    """Without this, the mutations would test less than they say."""
    refused, decoded = Counter(), Counter()
    for kind, ends in report.kinds.items():
        refused[kind] += ends["refused"]
        decoded[kind] += ends["decoded"]
    assert all(refused[kind] > 0 for kind in mutations.DAMAGES)
    assert all(
        decoded[kind] > 0
        for kind in ("stream", "settings", "values", "coordinates", "header", "giant", "shuffled")
    )
    # A mutation that is sealed gets past the checksums: it is refused for what it says.
    assert sum(decoded.values()) > 0.1 * (sum(decoded.values()) + sum(refused.values()))


def test_the_limits_hold(report):
    assert report.worst_seconds[0] < hostile_trial.SECONDS
    assert report.worst_bytes[0] <= hostile_trial.MEMORY


@pytest.mark.parametrize("number", [0, 100, 250])
def test_a_number_is_always_the_same_file(number):
    assert mutations.mutation(number) == mutations.mutation(number)


def test_a_worker_that_crashes_is_told(tmp_path, monkeypatch):
    """Without this, a crash of the native library would not be noticed."""
    monkeypatch.setenv("FHASH_HOSTILE_CRASH", "1")
    found = hostile.trials([0, 1, 2], 1, tmp_path)
    assert found.mutations == 3
    assert [line for line in found.wrong if line.startswith("1 ") and "SIGSEGV" in line]
    assert len(found.wrong) == 1
