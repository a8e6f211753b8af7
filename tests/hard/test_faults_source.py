"""A source that changes, shrinks, grows or vanishes while it is read is refused.

The command ends with one line and exit code 2, and never mixes two versions.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from faulty import PROFILES, Bench, values
from reporting import LONG, record
from sources import FORMS

STAGES = {
    "compact": ["scanning", "selecting", "planning", "coding", "measuring"],
    "paper": ["scanning", "selecting", "gathering", "training", "measuring"],
}
HOW = ("vanish", "shrink", "grow", "touch", "other")
QUICK = {
    ("compact", "scanning", "other"),
    ("compact", "selecting", "touch"),
    ("compact", "coding", "shrink"),
    ("compact", "measuring", "vanish"),
    ("paper", "training", "other"),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_source_that_changes_is_refused(bench: Bench, tmp_path: Path, form: str) -> None:
    module = {"NetCDF": "h5netcdf", "NetCDF 3": "scipy"}.get(form)
    if module:
        pytest.importorskip(module)
    tried = 0
    for profile, stages in STAGES.items():
        for stage in stages:
            for how in HOW:
                if not LONG and (profile, stage, how) not in QUICK:
                    continue
                if form == "a mask" and stage != "selecting":
                    continue  # it is read in this stage only
                check(bench, tmp_path / "source", form, profile, stage, how)
                tried += 1
    assert tried > 0
    record("a source that changes", {"form": form, "changes": tried})


def check(bench: Bench, folder: Path, form: str, profile: str, stage: str, how: str) -> None:
    what = (profile, stage, how)
    for place in (folder / "here", folder / "other"):
        place.mkdir(parents=True)
    other, _ = FORMS[form](folder / "other", values(7))
    target, words = FORMS[form](folder / "here", values(0))
    before = bench.old(f"encode {profile}")
    act = str(other) if how == "other" else how
    if target.is_dir() and how in ("shrink", "grow", "touch"):
        target = target / "c" / "1" / "0" / "0" / "0"  # a chunk
    ended = bench.server.run(
        "encode",
        *words,
        "-o",
        bench.out / "a.fhz",
        "--force",
        *PROFILES[profile],
        inject=[("change_at", stage, 0 if stage == "planning" else 1, target, act)],
    )
    assert ended.code == 2, (what, ended.output)
    assert ended.line.startswith("fhash: error: "), what
    assert "changed while it was being read" in ended.line or "cannot be read" in ended.line, (
        what,
        ended.line,
    )
    assert "please report" not in ended.line
    assert {
        place: data for place, data in bench.now().items() if not place.endswith(".checkpoint")
    } == before, what
    shutil.rmtree(folder)
