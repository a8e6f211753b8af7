"""`fhash plan`, and parts that are encoded by it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from click.testing import Result

Fhash = Callable[..., Result]
BOUNDED = ["--max-error", "0.01", "--tile", "1x6x7x8", "--effort", "1", "-q"]


def test_parts_by_a_plan_are_the_file_of_one_command(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    plan, whole, merged = tmp_path / "run.plan", tmp_path / "whole.fhz", tmp_path / "run.fhz"
    result = fhash("plan", data, "-o", plan, *BOUNDED)
    assert result.exit_code == 0, result.stderr
    assert "3 layers, so at most as many parts" in result.stdout
    assert "kg m-3" in result.stdout
    parts = [tmp_path / f"{number}.fhz" for number in (1, 2, 3)]
    for number, part in enumerate(parts, start=1):
        words = ["--part", f"{number}/3", "--plan", plan, "-q"]
        result = fhash("encode", data, "-o", part, *words)
        assert result.exit_code == 0, result.stderr
    assert fhash("merge", *parts, "-o", merged).exit_code == 0
    assert fhash("encode", data, "-o", whole, *BOUNDED, "--no-timings").exit_code == 0
    assert merged.read_bytes() == whole.read_bytes()


def test_what_does_not_fit_is_refused(
    fhash: Fhash, refused: Callable[..., str], data: Path, tmp_path: Path
) -> None:
    plan, part = tmp_path / "run.plan", tmp_path / "1.fhz"
    assert "give max_error" in refused(2, "plan", data, "-o", plan, "--psnr", "40")
    assert not plan.exists()
    assert fhash("plan", data, "-o", plan, *BOUNDED).exit_code == 0
    assert "exists; use --force" in refused(2, "plan", data, "-o", plan, *BOUNDED)
    words = ["encode", data, "-o", part, "--plan", plan]
    assert "--plan goes with --part" in refused(2, *words)
    words += ["--part", "1/3"]
    assert "effort is 2, and 1 in the plan" in refused(2, *words, "--effort", "2")
    assert "they differ in shape" in refused(2, *words, "--t", "0:2")
    plan.write_bytes(plan.read_bytes()[:-9])
    assert "run.plan is damaged" in refused(4, *words)
    assert not part.exists()
    assert "is the input itself" in refused(2, "plan", data, "-o", data, "--force", *BOUNDED)
