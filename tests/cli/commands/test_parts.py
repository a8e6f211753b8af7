"""`fhash plan`, `fhash merge` and `fhash append`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
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
    assert "give max_error" in refused(2, "plan", data, "-o", plan)
    assert "No such option '--psnr'" in refused(2, "plan", data, "-o", plan, "--psnr", "40")
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


@pytest.fixture
def parts(data: Path, tmp_path: Path, fhash: Fhash) -> list[Path]:
    """The three parts of the tiny series."""
    paths = [tmp_path / f"part{number}.fhz" for number in (1, 2, 3)]
    for number, path in enumerate(paths, start=1):
        result = fhash("encode", data, "-o", path, *BOUNDED, "--part", f"{number}/3")
        assert result.exit_code == 0, result.stderr
        assert fhash("verify", path).exit_code == 0
    return paths


def test_the_merged_file_is_that_of_one_command(
    fhash: Fhash, data: Path, parts: list[Path]
) -> None:
    whole, merged = parts[0].with_name("whole.fhz"), parts[0].with_name("run.fhz")
    assert fhash("encode", data, "-o", whole, *BOUNDED, "--no-timings").exit_code == 0
    result = fhash("merge", *reversed(parts), "-o", merged)
    assert result.exit_code == 0, result.stderr
    assert "3, of 3 parts with 3 tiles" in result.stdout
    assert merged.read_bytes() == whole.read_bytes()


def test_wrong_sets_of_parts_are_refused(
    refused: Callable[..., str], data: Path, parts: list[Path]
) -> None:
    output = parts[0].with_name("run.fhz")
    assert "parts 2/3; encode them" in refused(2, "merge", parts[0], parts[2], "-o", output)
    assert "give each part once" in refused(2, "merge", *parts, parts[1], "-o", output)
    assert not output.exists()
    other = ["encode", data, "-o", output, *BOUNDED[2:]]
    assert "give max_error" in refused(2, *other, "--part", "1/3", "--psnr", "40")
    assert "allowed: I/N" in refused(2, *other, "--max-error", "1", "--part", "half")
    assert "allowed: 1/3 to 3/3" in refused(2, *other, "--max-error", "1", "--part", "4/3")
    assert "4 parts of 3 layers" in refused(2, *other, "--max-error", "1", "--part", "1/4")
    assert "--part goes without" in refused(2, *other, "--part", "1/3", "--explain")


BOUNDED_APPEND = ["--max-error", "0.01", "--tile", "2x6x7x8", "--effort", "1", "-q"]


@pytest.fixture
def halves(tmp_path: Path, fhash: Fhash) -> tuple[Path, Path, np.ndarray]:
    """A file of the first 4 steps of a series, the data of the 3 others, and all of it."""
    values = np.cumsum(np.random.default_rng(0).random((7, 6, 7, 8)), axis=3).astype(np.float32)
    np.save(tmp_path / "first.npy", values[:4])
    np.save(tmp_path / "more.npy", values[4:])
    run = tmp_path / "run.fhz"
    assert fhash("encode", tmp_path / "first.npy", "-o", run, *BOUNDED_APPEND).exit_code == 0
    return run, tmp_path / "more.npy", values


def test_append_and_read(fhash: Fhash, halves: tuple[Path, Path, np.ndarray]) -> None:
    run, more, values = halves
    result = fhash("append", run, more, "-q")
    assert result.exit_code == 0, result.stderr
    assert "7: 4 kept, 3 appended" in result.stdout
    np.save(more.with_name("all.npy"), values)
    assert fhash("diff", more.with_name("all.npy"), run, "--max-error", "0.01").exit_code == 0
    assert fhash("verify", run).exit_code == 0
    assert "7" in fhash("info", run).stdout


def test_steps_are_replaced(fhash: Fhash, halves: tuple[Path, Path, np.ndarray]) -> None:
    run, more, _ = halves
    result = json.loads(fhash("append", run, more, "--keep", "2", "--json", "-q").stdout)
    assert (result["steps"], result["kept"], result["appended"]) == (5, 2, 3)


def test_unsuitable_files_are_refused(
    refused: Callable[..., str], run: Path, halves: tuple[Path, Path, np.ndarray]
) -> None:
    _, more, values = halves
    np.save(run.with_name("other.npy"), values[:, :5])
    assert "shape (z, y, x)" in refused(2, "append", halves[0], run.with_name("other.npy"), "-q")
    assert "no such file" in refused(2, "append", run.with_name("none.fhz"), more, "-q")
