"""Ctrl-C, SIGTERM and SIGHUP at each stage and file operation: exit code 130, one line, nothing
half-written."""

from __future__ import annotations

import itertools
import signal
from pathlib import Path

import pytest
from faulty import COMMANDS, PROFILES, Bench, moments
from reporting import LONG, record

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
EACH_ALONE = ("render pictures",)
"""Commands with several outputs, each of which is complete or absent by itself."""
COMMITTED = (
    "encode compact",
    "encode paper",
    "encode several",
    "merge",
    "append",
    "decode npy",
    "decode h5",
    "decode zarr",
    "decode pvd",
    "render png",
    "render gif",
)


def stages(bench: Bench, name: str, noted: Path) -> list[tuple[str, int]]:
    """Return the first and the last report of each stage of a command; in the long set, all
    reports."""
    noted.unlink(missing_ok=True)
    words = [word for word in bench.words(name) if word != "-q"]
    ended = bench.server.run(*words, inject=[("note_stages", noted)])
    assert ended.code == 0, ended.output
    reports_of_all = [
        (line.rpartition(" ")[0], int(line.rpartition(" ")[2]))
        for line in noted.read_text().splitlines()
    ]
    chosen = []
    for _, group in itertools.groupby(dict.fromkeys(reports_of_all), key=lambda report: report[0]):
        reports = list(group)
        chosen += reports if LONG else dict.fromkeys([reports[0], reports[-1]])
    return list(dict.fromkeys(chosen))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_at_each_stage_leaves_the_older_output(
    bench: Bench, name: str, tmp_path: Path
) -> None:
    bench.old(name)
    moments_of_stages = stages(bench, name, tmp_path / "stages")
    assert moments_of_stages or name.startswith("decode vtp")
    if name in [f"encode {profile}" for profile in PROFILES]:
        assert {stage for stage, _ in moments_of_stages} >= {
            "scanning",
            "measuring",
            "training" if "paper" in name else "coding",
        }
    for turn, (stage, done) in enumerate(moments_of_stages):
        number = SIGNALS[turn % len(SIGNALS)]
        before = bench.old(name)
        ended = bench.run(name, ("signal_at", stage, done, number))
        assert ended.code == 130, (stage, done, ended.output)
        assert ended.line.startswith("fhash: error: interrupted"), (stage, done)
        now = bench.now()
        kept = {place: data for place, data in now.items() if not place.endswith(".checkpoint")}
        assert kept.keys() == before.keys(), (stage, done)
        # The last report of writing comes when the new file has its name, and the line says so.
        written = stage == "writing" and "was written" in ended.line
        assert written == (stage == "writing" and done > 0), (stage, done, ended.line)
        assert name in EACH_ALONE or written or kept == before, (stage, done)
        assert len(now) == len(kept) or stage in ("training", "coding tables", "measuring"), (
            stage,
            done,
        )
    ended = bench.run(name)  # resumes from the checkpoint, if there is one
    assert ended.code == 0, ended.output
    assert bench.now() == bench.new(name)
    record(
        "a signal at each stage",
        {
            "command": name,
            "stages": len({stage for stage, _ in moments_of_stages}),
            "signals": len(moments_of_stages),
        },
    )


@pytest.mark.parametrize("name", COMMITTED)
def test_a_signal_at_any_operation_leaves_one_of_the_two_outputs(bench: Bench, name: str) -> None:
    count = bench.operations(name)
    for turn, place in enumerate(moments(count)):
        before = bench.old(name)
        ended = bench.run(name, ("at_operation", bench.out, place, -SIGNALS[turn % len(SIGNALS)]))
        now = bench.now()
        if ended.code == 0:  # the signal came after the end of the work
            assert now == bench.new(name), place
            continue
        assert ended.code == 130, (place, ended.output)
        assert ended.line.startswith("fhash: error: interrupted"), place
        kept = {name: data for name, data in now.items() if not name.endswith(".checkpoint")}
        assert kept in (before, bench.new(name)), place
    record(
        "a signal at an operation",
        {"command": name, "operations": count, "signals": len(moments(count))},
    )
