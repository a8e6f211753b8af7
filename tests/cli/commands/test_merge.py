"""`fhash encode --part` and `fhash merge`: several machines, the file of one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

Fhash = Callable[..., Result]
BOUNDED = ["--max-error", "0.01", "--tile", "1x6x7x8", "--effort", "1", "-q"]


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
