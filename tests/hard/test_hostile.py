"""Hostile files are refused with one line and exit code 4, or decoded.

They never lead to another exception, a hang or a large allocation. FHASH_HARD=1 runs the long set.
Mutations are numbered, and a number is always the same file: `python tests/hard/hostile_trial.py
--write NUMBER FILE.fhz` writes it, to show a failure again.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from pathlib import Path

import hostile
import hostile_trial
import mutations
import numpy as np
import pytest
from reporting import LONG, record

MANY = 12_000
"""Mutations; kinds and goldens take turns."""

pytestmark = [
    pytest.mark.hard,
    pytest.mark.skipif(
        sys.platform != "linux", reason="limits on memory and time are those of Linux"
    ),
]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> hostile.Report:
    if not LONG:
        pytest.skip("half an hour; make hard runs it")
    numbers = range(MANY)
    processes = min(4, len(os.sched_getaffinity(0)))
    result = hostile.trials(numbers, processes, tmp_path_factory.mktemp("hostile"))
    assert result.mutations == len(numbers)
    record("hostile files", {"memory_limit": hostile_trial.MEMORY, **result.figures()})
    return result


def test_no_hostile_file_does_harm(report: hostile.Report) -> None:
    assert not report.wrong, "\n".join(report.wrong[:20]) + f"\n{len(report.wrong)} in all"


def test_all_kinds_of_mutations_were_tried(report: hostile.Report) -> None:
    assert set(report.kinds) == set(mutations.KINDS)


def test_every_kind_meets_labels_and_clipped_values(report: hostile.Report) -> None:
    """Kinds pass over goldens without what they change, so some could meet none of the newest."""
    clipped, labelled = set(mutations.NEWEST[::2]), set(mutations.NEWEST[1::2])
    # These kinds change ordinary arrays, clipped values or labels only.
    kinds = set(mutations.KINDS) - mutations.PARTIAL
    for kind in kinds - {"values", "clip"}:
        assert report.met[kind] & labelled, kind
    for kind in kinds - {"values", "labels"}:
        assert report.met[kind] & clipped, kind
    assert "compact-many-labels" in report.met["labels"]


def test_kinds_of_plain_files_take_turns_among_them(report: hostile.Report) -> None:
    for kind in mutations.PLAIN_KINDS - {"occupancy"}:
        assert len(report.met[kind]) >= 2, kind
        assert all("-plain-" in golden for golden in report.met[kind])
    assert len(report.met["occupancy"]) >= 3


def test_damage_is_refused_and_much_of_what_is_sealed_reaches_the_decoders(
    report: hostile.Report,
) -> None:
    """Without this, the mutations would test less than they say."""
    refused, decoded = Counter(), Counter()
    for kind, ends in report.kinds.items():
        refused[kind] += ends["refused"]
        decoded[kind] += ends["decoded"]
    assert all(refused[kind] > 0 for kind in mutations.DAMAGES)
    assert all(
        decoded[kind] > 0
        for kind in (
            *("stream", "settings", "values", "coordinates", "header", "giant", "shuffled"),
            *("labels", "clip", "integers"),
            *sorted(mutations.PARTIAL),
        )
    )
    # A sealed mutation gets past the checksums and is refused for its contents only.
    assert sum(decoded.values()) > 0.1 * (sum(decoded.values()) + sum(refused.values()))


def test_the_limits_hold(report: hostile.Report) -> None:
    assert report.worst_bytes[0] <= hostile_trial.MEMORY


@pytest.mark.parametrize("number", [0, 100, 250])
def test_a_number_is_always_the_same_file(number: int) -> None:
    assert mutations.mutation(number) == mutations.mutation(number)


def test_a_worker_that_crashes_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without this, a crash of the native library would not be noticed."""
    monkeypatch.setenv("FHASH_HOSTILE_CRASH", "1")
    result = hostile.trials([0, 1, 2], 1, tmp_path)
    assert result.mutations == 3
    assert [line for line in result.wrong if line.startswith("1 ") and "SIGSEGV" in line]
    assert len(result.wrong) == 1


@pytest.mark.parametrize("golden", ["compact-clip", "compact-named", "compact-origin"])
def test_the_oracle_of_clipping_sees_one_value_beyond_the_range_of_its_tile(
    golden: str, tmp_path: Path
) -> None:
    """Labels and exact values are not clipped; without clipping nothing lies beyond."""
    data, _ = mutations.goldens()[golden]
    sound = mutations.Mutation(number=0, golden=golden, kind="clip", sealed=True, data=data)
    trial = hostile_trial.Trial(sound, tmp_path)
    _, high = hostile_trial.clip_ends(sound)
    clipped = np.isfinite(high) if high.dtype.kind == "f" else high < np.iinfo(high.dtype).max
    assert clipped.any() != (golden == "compact-named")  # its tiles are labels
    values = np.array(hostile_trial.expected_values(golden, None))
    assert not trial.beyond(values, None)
    for where in (np.argwhere(clipped)[-1:], np.argwhere(~clipped)[-1:]):
        for vertex in map(tuple, where):
            changed = values.copy()
            changed[vertex] = high[vertex] + 1 if clipped[vertex] else 10**9
            region = [(i, i + 1) for i in vertex]
            part = changed[tuple(slice(*ends) for ends in region)]
            assert trial.beyond(changed, None) == trial.beyond(part, region) == clipped[vertex]
