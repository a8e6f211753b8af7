"""`fhash bench render`: tables, one JSON object, a plot, and refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from fhash_bench.pictures import vtk

Fhash = Callable[..., Result]

QUICK = ["--size", "16", "--turns", "1", "-q"]


def test_prints_tables(fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vtk, "FINE_SIZE", 16)
    monkeypatch.setattr(vtk, "EXPLAINED_SIZE", 16)
    result = fhash(
        "bench",
        "render",
        run,
        *QUICK,
        "--part",
        "accelerations",
        "--part",
        "exactness",
    )
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert [line.split("  ")[0] for line in lines if "PSNR" in line][:2] == [
        "acceleration",
        "VTK on software OpenGL",
    ]
    assert any(line.startswith("early termination  ") for line in lines)
    assert any("medians of 1" in line for line in lines)


def test_prints_one_json_object_of_a_scene(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text("step = 1.5\n")
    result = fhash(
        "bench", "render", run, *QUICK, "--part", "accelerations", "--scene", scene, "--json"
    )
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert report["step"] == 1.5
    assert [entry["name"] for entry in report["accelerations"]][:2] == [
        "skipping",
        "early termination",
    ]
    assert report["curves"] == []


def test_draws(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    picture = tmp_path / "bench.png"
    words = ["bench", "render", run, *QUICK, "--part", "curves", "--plot", picture]
    assert fhash(*words).exit_code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--part", "speed"], "allowed: effects"),
        (["--size", "3"], "16"),
        (["--scene", "none.json"], "no such scene"),
        (["--plot", "none/a.png"], "does not exist"),
    ],
)
def test_refuses_in_one_line(
    words: list[str], part: str, refused: Callable[..., str], run: Path
) -> None:
    assert part in refused(2, "bench", "render", run, "-q", *words)


def test_a_wrong_ospray_is_refused_before_anything_is_measured(fhash: Fhash, run: Path) -> None:
    for words, message in (
        (["--part", "shell", "--ospray", "no_such_module"], "no OSPRay there"),
        (["--part", "orbit", "--ospray", "no_such_module"], "the part 'shell'"),
    ):
        result = fhash("bench", "render", run, *QUICK, *words)
        assert result.exit_code == 2
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
