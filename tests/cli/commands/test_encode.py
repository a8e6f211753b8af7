"""`fhash encode`: the report, determinism, promises, warnings and Ctrl-C."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import Fhash, Refused

import fhash_codec
from fhash_cli.output import Progress

SMALL = ["--effort", "1", "--quiet"]
PAPER = ["--preset=published", "--tables=float16", "--epochs", "2", "--width", "4", "--quiet"]


def test_what_each_stage_bought_is_in_the_table_and_in_json(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    words = ["encode", data, "-o", tmp_path / "run.fhz", "--effort", "2", "--force", "-q"]
    report = json.loads(fhash(*words, "--timings", "--json").stdout)
    assert report["published"] is False
    assert [set(gain) for gain in report["gains"]] == [{"what", "bytes", "seconds"}] * len(
        report["gains"]
    )
    lines = fhash(*words, "--timings", "-v").stdout.splitlines()
    brief = fhash(*words).stdout.splitlines()
    for gain in report["gains"]:
        assert sum(line.startswith(f"  {gain['what']}  ") for line in lines) == 1
        assert not any(line.startswith(f"  {gain['what']}  ") for line in brief)
    assert brief[0].startswith(f"{tmp_path / 'run.fhz'}  ")
    assert len(brief) == 1
    bare = json.loads(fhash(*words, "--json").stdout)
    assert bare["gains"] == []
    assert fhash(*words, "-v").exit_code == 0


@pytest.mark.parametrize(
    "words",
    [["--max-error", "0.125"], ["--max-error-rel", "0.01"], ["--tile", "2x4x4x4", "--psnr", "35"]],
    ids=str,
)
def test_promises_of_the_default_preset_are_kept(
    fhash: Fhash, data: Path, tmp_path: Path, words: list[str]
) -> None:
    report = json.loads(
        fhash("encode", data, "-o", tmp_path / "run.fhz", *words, "--json", *SMALL).stdout
    )
    bound = {"--max-error": 0.125, "--max-error-rel": 0.01 * report["data_range"]}.get(
        words[0], np.inf
    )
    assert 0 < report["max_abs_error"] <= bound
    assert report["psnr"] >= 35
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        assert volume.chunks == ((2, 4, 4, 4) if "--tile" in words else volume.chunks)


@pytest.mark.parametrize("as_json", [False, True])
def test_a_missed_promise_leaves_another_name_prints_the_figures_and_exits_with_3(
    fhash: Fhash, data: Path, tmp_path: Path, as_json: bool
) -> None:
    output = tmp_path / "run.fhz"
    result = fhash(
        "encode", data, "-o", output, "--psnr", "300", *(["--json"] if as_json else []), *PAPER
    )
    assert result.exit_code == 3
    assert len(result.stderr.splitlines()) == 1
    assert "300 dB" in result.stderr
    assert not output.exists()
    missed = tmp_path / "run.missed.fhz"
    assert f"the file is {missed}" in result.stderr
    assert fhash("verify", missed).exit_code == 0
    if as_json:
        report = json.loads(result.stdout)
        assert report["psnr"] < 300
    else:
        assert str(missed) in result.stdout


@pytest.mark.filterwarnings("default")
def test_a_warning_is_one_line_on_stderr(fhash: Fhash, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "in.h5", "w") as file:
        values = file.create_dataset("v", data=np.random.default_rng(0).random((3, 4, 5, 6)))
        time = file.create_dataset("time", data=[0.0, 2.0, 1.0])
        time.make_scale("time")
        values.dims[0].attach_scale(time)
    result = fhash("encode", tmp_path / "in.h5", "-o", tmp_path / "run.fhz", *SMALL)
    assert result.exit_code == 0
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("fhash: warning: ")


def test_ctrl_c_saves_a_checkpoint_and_the_same_command_ends_as_if_nothing_had_been(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [
        "encode",
        data,
        *["--no-timings", "--feature", "interval:2:99"],
        *("6" if word == "2" else word for word in PAPER),
        "-o",
    ]
    assert fhash(*words, tmp_path / "whole.fhz").exit_code == 0
    listen = Progress.__call__

    def stop(self: Progress, stage: str, done: int, *rest: Any) -> None:
        listen(self, stage, done, *rest)
        if (stage, done) == ("training", 3):
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(Progress, "__call__", stop)
        result = fhash(*words, tmp_path / "run.fhz")
    assert (result.exit_code, result.stdout) == (130, "")
    assert len(result.stderr.splitlines()) == 1
    assert "the same command goes on from there" in result.stderr
    assert not (tmp_path / "run.fhz").exists()
    assert list(tmp_path.glob("*.checkpoint"))
    assert fhash(*words, tmp_path / "run.fhz").exit_code == 0
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    assert not list(tmp_path.glob("*.checkpoint"))


@pytest.mark.parametrize("stage", ["scanning", "planning", "coding", "measuring"])
@pytest.mark.parametrize("older", [False, True])
def test_ctrl_c_says_that_the_default_preset_starts_again(
    fhash: Fhash,
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stage: str,
    older: bool,
) -> None:
    output = tmp_path / "run.fhz"
    if older:
        output.write_bytes(b"older")

    def stop(self: Progress, now: str, *rest: Any) -> None:
        if now == stage:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "__call__", stop)
    result = fhash("encode", data, "-o", output, "--force", *SMALL)
    assert (result.exit_code, result.stdout) == (130, "")
    left = f"the older {output} is unchanged" if older else f"{output} is not written"
    assert result.stderr == (
        f"fhash: error: interrupted; {left}, and the same command starts again\n"
    )
    assert [path.read_bytes() for path in tmp_path.iterdir()] == ([b"older"] if older else [])


def test_ctrl_c_after_the_file_was_written_says_so(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(self: Progress, stage: str, done: int, *rest: Any) -> None:
        if (stage, done) == ("writing", 1):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "__call__", stop)
    output = tmp_path / "run.fhz"
    result = fhash("encode", data, "-o", output, *SMALL)
    assert result.exit_code == 130
    assert "interrupted after" in result.stderr
    assert "the file is complete" in result.stderr
    assert fhash("verify", output).exit_code == 0


def test_explain_says_what_took_the_time_and_what_was_left_out(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    words = (
        "encode",
        data,
        "-o",
        tmp_path / "run.fhz",
        *SMALL,
        "--without",
        "ssim",
        "--train",
        "none",
    )
    result = fhash(*words, "-v")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert any(line.split() == ["stage", "seconds", "share", "why"] for line in lines)
    assert any(line.startswith("ssim") and line.endswith("--without ssim") for line in lines)
    assert any(line.startswith("coding") and "%" in line for line in lines)
    assert lines[-1].startswith("other")
    report = json.loads(fhash(*words, "--force", "--json").stdout)
    assert "stages" not in report
    assert report["ssim"] is None
    assert report["quality"]["ssim_window"]["steps"] == []


def test_a_time_budget_chooses_an_effort_and_info_says_what_was_predicted(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run.fhz"
    words = ("encode", data, "-o", run, "--psnr", "40", "--force", "--timings")
    result = fhash(*words, "--time-budget", "10m", "--effort", "2")
    assert result.exit_code == 0
    assert "time budget 600 s: --effort 2, predicted to take" in result.stderr
    assert "the most that is allowed" in result.stderr
    shown = fhash("info", run).stdout
    assert any(line.startswith("predicted") and "it took" in line for line in shown.splitlines())
    encoder = json.loads(fhash("info", run, "--json").stdout)["encoder"]
    assert set(encoder["predicted"]) == {"seconds", "bytes", "psnr"}
    assert encoder["took_seconds"] > 0


BOUNDED = ["--max-error", "0.01", "--tile", "1x6x7x8", "--effort", "1", "-q"]


def test_what_does_not_fit_is_refused(
    fhash: Fhash, refused: Refused, data: Path, tmp_path: Path
) -> None:
    plan, part = tmp_path / "run.plan", tmp_path / "1.fhz"
    assert "give max_error" in refused(2, "plan", data, "-o", plan)
    unknown = refused(2, "plan", data, "-o", plan, "--psnr", "40")  # click 8.2 has no quotes
    assert unknown.replace("'", "").replace(":", "").startswith("No such option --psnr")
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


def parts_of(fhash: Fhash, data: Path, folder: Path, *words: object) -> list[Path]:
    """The three parts of the tiny series."""
    paths = [folder / f"part{number}.fhz" for number in (1, 2, 3)]
    for number, path in enumerate(paths, start=1):
        result = fhash("encode", data, "-o", path, "--part", f"{number}/3", *words)
        assert result.exit_code == 0, result.stderr
        assert fhash("verify", path).exit_code == 0
    return paths


@pytest.mark.parametrize("planned", [False, True])
def test_the_merged_file_is_that_of_one_command(
    fhash: Fhash, data: Path, tmp_path: Path, planned: bool
) -> None:
    plan, whole, merged = (tmp_path / name for name in ("run.plan", "whole.fhz", "run.fhz"))
    if planned:
        result = fhash("plan", data, "-o", plan, *BOUNDED)
        assert result.exit_code == 0, result.stderr
        assert "3 layers, so at most as many parts" in result.stdout
        assert "kg m-3" in result.stdout
    words = ["--plan", plan, "-q"] if planned else BOUNDED
    parts = parts_of(fhash, data, tmp_path, *words)
    result = fhash("merge", *reversed(parts), "-o", merged)
    assert result.exit_code == 0, result.stderr
    assert "3, of 3 parts with 3 tiles" in result.stdout
    assert fhash("encode", data, "-o", whole, *BOUNDED, "--no-timings").exit_code == 0
    assert merged.read_bytes() == whole.read_bytes()


def test_wrong_sets_of_parts_are_refused(
    fhash: Fhash, refused: Refused, data: Path, tmp_path: Path
) -> None:
    parts = parts_of(fhash, data, tmp_path, *BOUNDED)
    output = parts[0].with_name("run.fhz")
    assert "parts 2/3; encode them" in refused(2, "merge", parts[0], parts[2], "-o", output)
    assert "give each part once" in refused(2, "merge", *parts, parts[1], "-o", output)
    assert not output.exists()
    other = ["encode", data, "-o", output, *BOUNDED[2:]]
    assert "give max_error" in refused(2, *other, "--part", "1/3", "--psnr", "40")
    assert "allowed: I/N" in refused(2, *other, "--max-error", "1", "--part", "half")
    assert "allowed: 1/3 to 3/3" in refused(2, *other, "--max-error", "1", "--part", "4/3")
    assert "4 parts of 3 layers" in refused(2, *other, "--max-error", "1", "--part", "1/4")
    assert "--part goes without" in refused(2, *other, "--part", "1/3", "-v")


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
    refused: Refused, run: Path, halves: tuple[Path, Path, np.ndarray]
) -> None:
    _, more, values = halves
    np.save(run.with_name("other.npy"), values[:, :5])
    assert "has a frame (z, y, x) of shape (5, 7, 8)" in refused(
        2, "append", halves[0], run.with_name("other.npy"), "-q"
    )
    assert "no such file" in refused(2, "append", run.with_name("none.fhz"), more, "-q")


def test_without_a_name_the_file_is_named_after_its_data(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fhash("encode", data, *SMALL).exit_code == 0
    assert (tmp_path / f"{data.stem}.fhz").exists()
    assert "exists" in fhash("encode", data, *SMALL).stderr


def test_a_share_of_the_range_may_be_in_percent(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["encode", data, "-o", tmp_path / "a.fhz", *SMALL]
    assert fhash(*words, "--max-error-rel", "2%").exit_code == 0
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["config"]["max_error_rel"] == 0.02
    result = fhash(*words, "--max-error", "2%", "--force")
    assert result.exit_code == 2
    assert "--max-error-rel is a share" in result.stderr


def test_data_in_place_of_a_container_are_no_damage(fhash: Fhash, data: Path) -> None:
    for command in ("decode", "render", "verify"):
        result = fhash(command, data)
        assert result.exit_code == 2
        assert "HDF5 data, no container; encode it first: fhash encode" in result.stderr


def test_two_containers_are_compared(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    for name, psnr in (("a", "30"), ("b", "60")):
        fhash("encode", data, "-o", tmp_path / f"{name}.fhz", "--psnr", psnr, *SMALL)
    report = json.loads(fhash("diff", tmp_path / "a.fhz", tmp_path / "b.fhz", "--json").stdout)
    with fhash_codec.open(tmp_path / "a.fhz") as one, fhash_codec.open(tmp_path / "b.fhz") as other:
        error = float(np.abs(one[...].astype(float) - other[...].astype(float)).max())
    assert report["max_abs_error"] == pytest.approx(error)
