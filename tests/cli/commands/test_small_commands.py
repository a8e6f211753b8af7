"""Commands with few options: cost, selftest, the plugin of HDF5, ParaView."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Fhash, Refused

from fhash_cli.options import DURATION
from fhash_codec.config import EncodeConfig
from fhash_codec.cost import cost
from fhash_codec.cost import report as files
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.plan import Wish
from fhash_codec.selftest import run as workers
from fhash_codec.selftest.case import Case, Finding
from fhash_codec.selftest.run import CaseResult, Summary


@pytest.mark.parametrize("place", [0.02, 0.3, 0.5, 0.7, 0.9])
def test_a_flipped_bit_is_found(refused: Refused, run: Path, tmp_path: Path, place: float) -> None:
    damaged = bytearray(run.read_bytes())
    damaged[int(len(damaged) * place)] ^= 16
    (tmp_path / "bad.fhz").write_bytes(damaged)
    assert str(tmp_path / "bad.fhz") in refused(4, "verify", tmp_path / "bad.fhz")


SMALL = ["--effort", "1", "--quiet"]


@pytest.fixture(scope="module")
def report(data: Path, run: Path) -> dict[str, float]:
    from click.testing import CliRunner

    from fhash_cli.main import program

    result = CliRunner().invoke(program, ["diff", str(data), str(run), "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def test_diff_agrees_with_what_the_encoder_measured(
    fhash: Fhash, run: Path, report: dict[str, float]
) -> None:
    stored = json.loads(fhash("info", run, "--json").stdout)["quality"]
    for name in ("psnr", "rmse", "max_abs_error", "psnr_domain"):
        # The file has six digits of the figure, rounded to the worse side.
        assert report[name] == pytest.approx(stored[name], rel=1e-5)
        assert (report[name] >= stored[name]) == name.startswith("psnr")


@pytest.mark.parametrize(
    ("gate", "figure", "sign"), [("--min-psnr", "psnr", 1), ("--max-error", "max_abs_error", -1)]
)
def test_a_gate_closes_just_beyond_the_figure(
    fhash: Fhash, data: Path, run: Path, report: dict[str, float], gate: str, figure: str, sign: int
) -> None:
    assert fhash("diff", data, run, gate, report[figure] - sign * 1e-6).exit_code == 0
    missed = fhash("diff", data, run, gate, report[figure] + sign * 1e-6, "--json")
    assert missed.exit_code == 3
    assert json.loads(missed.stdout)[figure] == report[figure]
    assert len(missed.stderr.splitlines()) == 1


def test_an_exact_file_passes_every_gate(fhash: Fhash, tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.full((2, 3, 4, 5), 7.0, dtype=np.float32))
    assert fhash("encode", tmp_path / "flat.npy", "-o", tmp_path / "run.fhz", *SMALL).exit_code == 0
    result = fhash(
        "diff", tmp_path / "flat.npy", tmp_path / "run.fhz", "--min-psnr", "200", "--max-error", "0"
    )
    assert (result.exit_code, result.stderr) == (0, "")
    assert "PSNR            exact" in result.stdout


@pytest.mark.parametrize(
    ("figures", "words", "missed"),
    [
        (
            {"psnr": None, "rmse": 0.0, "max_abs_error": 0.0},
            ["--min-psnr", "200", "--max-error", "0"],
            "",
        ),
        (
            {"psnr": None, "rmse": 0.1, "max_abs_error": 0.1},
            ["--min-psnr", "1"],
            "no PSNR is defined in the coreset; at least 1 dB",
        ),
        (
            {"psnr": None, "rmse": None, "max_abs_error": None},
            ["--min-psnr", "1"],
            "no PSNR is defined in the coreset",
        ),
        (
            {"psnr": None, "rmse": None, "max_abs_error": None},
            ["--max-error", "1"],
            "no value can be compared in the coreset; at most 1",
        ),
    ],
)
def test_a_figure_that_is_not_defined_meets_no_gate(
    fhash: Fhash,
    data: Path,
    run: Path,
    report: dict[str, float],
    monkeypatch: pytest.MonkeyPatch,
    figures: dict[str, float | None],
    words: list[str],
    missed: str,
) -> None:
    monkeypatch.setattr("fhash_codec.diff", lambda *_, **__: {**report, **figures})
    result = fhash("diff", data, run, *words)
    assert result.exit_code == (3 if missed else 0)
    assert missed in result.stderr
    assert len(result.stderr.splitlines()) == bool(missed)


def test_a_missing_value_is_told_of_where_it_is_forgotten(fhash: Fhash, tmp_path: Path) -> None:
    values = np.arange(60.0, dtype=np.float32).reshape(1, 3, 4, 5)
    values[0, 0, 0, 0] = -999
    np.save(tmp_path / "a.npy", values)
    data, run = tmp_path / "a.npy", tmp_path / "a.fhz"
    words = ["--effort", "1", "--max-error", "1"]
    result = fhash("encode", data, "-o", run, *words, "--missing", "-999", "--missing", "5.5")
    assert result.exit_code == 0
    assert f"--missing 5.5: {data} holds no such value" in result.stderr
    assert "-999" not in result.stderr
    assert "missing where the source had -999" in fhash("info", run).stdout
    said = f"{run} was encoded with --missing -999"
    assert said in fhash("diff", data, run).stderr
    assert said not in fhash("diff", data, run, "--missing", "-999").stderr
    assert said not in fhash("diff", data, run, "--quiet").stderr


def both(path: Path, **changes: dict[str, str]) -> Path:
    with h5py.File(path, "w") as file:
        for number, name in enumerate(["flow/u", "flow/w"]):
            data = file.create_dataset(name, data=np.full((2, 3, 4, 5), number, "f4"))
            data.attrs["units"] = changes.get("units", "m/s")
        scale = file.create_dataset("flow/x", data=changes.get("x", np.arange(5.0) + 2))
        file["flow/u"].dims[3].attach_scale(scale)
        file["flow/w"].dims[3].attach_scale(scale)
    return path


def test_the_variable_is_that_of_the_container(fhash: Fhash, tmp_path: Path) -> None:
    data, run = both(tmp_path / "a.h5"), tmp_path / "w.fhz"
    assert fhash("encode", data, "--var", "w", "-o", run, *SMALL).exit_code == 0
    result = fhash("diff", data, run, "--max-error", "0", "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert json.loads(result.stdout)["differences"] == []


def test_differences_beside_the_values_are_told(
    fhash: Fhash, refused: Refused, tmp_path: Path
) -> None:
    data, run = both(tmp_path / "a.h5"), tmp_path / "w.fhz"
    assert fhash("encode", data, "--var", "w", "-o", run, *SMALL).exit_code == 0
    result = fhash("diff", data, run, "--var", "u")
    assert result.exit_code == 0
    assert "are of the variable u" in result.stderr
    other = both(tmp_path / "b.h5", units="km/h", x=np.arange(5.0))
    assert fhash("diff", other, run).stderr.splitlines() == [
        f"fhash: {other}: the data are in km/h, {run} in m/s"
    ]
    moved = both(tmp_path / "c.h5", x=np.arange(5.0) + 1)
    lines = json.loads(fhash("diff", moved, run, "--json").stdout)["differences"]
    assert lines == [f"the data have other positions along x than {run} (1 to 5, not 2 to 6)"]
    np.save(tmp_path / "named.npy", np.full((2, 3, 4, 5), 1, "f4"))
    assert fhash("diff", tmp_path / "named.npy", run).stderr == ""
    with h5py.File(data, "a") as file:
        file["other/w"] = file["flow/w"][...]
    assert "choose one with --var" in refused(2, "diff", data, run)


@pytest.mark.parametrize(
    ("shell", "words"),
    [
        ("zsh", ("#compdef fhash", "_FHASH_COMPLETE=zsh_complete")),
        ("fish", ("complete --no-files --command fhash", "_FHASH_COMPLETE=fish_complete")),
        ("bash", ("complete -o nosort -F", "_FHASH_COMPLETE=bash_complete")),
    ],
)
def test_code_for_a_shell(fhash: Fhash, shell: str, words: tuple[str, ...]) -> None:
    result = fhash("completion", shell)
    assert result.exit_code == 0
    for word in words:
        assert word in result.stdout


def test_another_shell_is_refused(refused: Refused) -> None:
    assert "'csh' is not one of 'bash', 'zsh', 'fish'" in refused(2, "completion", "csh")


@pytest.mark.parametrize(
    ("line", "found"), [("fhash enc", "plain,encode"), ("fhash encode x --ps", "plain,--psnr")]
)
def test_words_are_completed(line: str, found: str) -> None:
    words = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}
    result = subprocess.run(
        [sys.executable, "-m", "fhash_cli.main"],
        env={**os.environ, **words, "_FHASH_COMPLETE": "bash_complete"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found in result.stdout.splitlines()


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Replaces the run of cases: each has the figure {"worst": figure}.

    The arguments of the call are added under their names.
    """
    asked: dict[str, float] = {"worst": 0.5}

    def run(
        cases: list[Case], *, everything: bool, processes: int | None, progress: object
    ) -> Summary:
        asked.update(cases=len(cases), everything=everything, processes=processes or 0)
        finding = Finding(name="bound", worst=asked["worst"], limit=1.0, unit="of it", under="psnr")
        return Summary(
            results=[
                CaseResult(
                    name=case.name,
                    group=case.group,
                    about=case.about,
                    under=("psnr",),
                    findings=(finding,),
                )
                for case in cases
            ]
        )

    monkeypatch.setattr(workers, "run_cases", run)
    return asked


def test_one_case_runs_and_holds(fhash: Fhash) -> None:
    result = fhash("selftest", "--case", "nothing-finite", "--processes", "1", "--quiet")
    assert result.exit_code == 0, result.output
    assert "values      1        3" in result.stdout
    assert result.stdout.endswith("everything holds\n")


def test_a_failure_is_listed_and_exits_with_1(fhash: Fhash, measured: dict[str, float]) -> None:
    measured["worst"] = 1.25
    result = fhash("selftest", "--group", "times", "--quiet")
    assert result.exit_code == 1
    assert "uneven: psnr: bound is 1.25 of it, at most 1" in result.stdout
    assert result.stderr == ""


def test_json_holds_every_figure(fhash: Fhash, measured: dict[str, float]) -> None:
    result = fhash("selftest", "--case", "spike", "--case", "twos", "--json")
    printed = json.loads(result.stdout)
    assert result.exit_code == 0
    assert printed["holds"] is True
    assert [case["name"] for case in printed["cases"]] == ["twos", "spike"]
    assert printed["cases"][0]["findings"][0] == {
        "name": "bound",
        "worst": 0.5,
        "limit": 1.0,
        "unit": "of it",
        "under": "psnr",
        "holds": True,
    }


def test_all_runs_more(fhash: Fhash, measured: dict[str, float]) -> None:
    assert fhash("selftest", "--quiet").exit_code == 0
    few = measured["cases"]
    assert not measured["everything"]
    assert fhash("selftest", "--all", "--processes", "3", "--quiet").exit_code == 0
    assert measured["cases"] >= few
    assert measured["everything"]
    assert measured["processes"] == 3


def test_the_report_is_written_once(
    fhash: Fhash, measured: dict[str, float], tmp_path: Path
) -> None:
    path = tmp_path / "stability.md"
    assert fhash("selftest", "--case", "spike", "--report", path, "--quiet").exit_code == 0
    assert f" fhash {version('fhash')}, python {platform.python_version()}," in path.read_text()
    assert (
        "| spike | one value of 1e6, all others 0 | psnr | bound (psnr) | 0.5 of it | 1 |"
        in path.read_text()
    )
    again = fhash("selftest", "--case", "spike", "--report", path)
    assert again.exit_code == 2
    assert "--force" in again.stderr
    assert (
        fhash("selftest", "--case", "spike", "--report", path, "--force", "--quiet").exit_code == 0
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--case", "spikey"), "unknown case 'spikey'; did you mean 'spike'?"),
        (("--group", "frontes"), "unknown group 'frontes'; did you mean 'fronts'?"),
        (("--report", "no/such/folder/a.md"), "no/such/folder"),
        (("--processes", "0"), "0 is not in the range"),
    ],
)
def test_what_cannot_be_is_refused(refused: Refused, words: tuple[str, ...], message: str) -> None:
    assert message in refused(2, "selftest", *words)


def test_the_folder_of_the_plugin_of_hdf5_is_printed(fhash: Fhash) -> None:
    assert Path(fhash("hdf5-plugin-path").stdout.strip(), "libfhash.so").is_file()


PARAVIEW = """#!/bin/sh
cat "$PV_PLUGIN_CONFIG_FILE"
test -f "${PYTHONPATH%%:*}/sitecustomize.py" && echo "opened $@"
exit 3
"""


def test_paraview_is_started_with_its_reader(
    fhash: Fhash, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, library = fhash("paraview").stdout.splitlines()
    assert Path(reader).is_file()
    assert Path(library.removeprefix("FHASH_LIBRARY=")).is_file()
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    (tmp_path / "paraview").write_text(PARAVIEW)
    (tmp_path / "paraview").chmod(0o755)
    words = [sys.executable, "-m", "fhash_cli.main", "paraview", "a.fhz", "b.fhz"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 3
    assert f'filename="{reader}"' in done.stdout
    assert "opened a.fhz b.fhz" in done.stdout
    monkeypatch.setenv("PATH", "")
    assert "no program paraview" in refused(2, "paraview", "a.fhz")


NAMES = ["cost.html", "cost.json", "cost.png"]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """One encoding, no pictures, and a PNG that is quick to draw."""
    wish = Wish(codec="default", group="g", config=EncodeConfig(effort=1, psnr=40.0))
    monkeypatch.setattr(cost, "wishes", lambda features: iter([wish]))
    monkeypatch.setattr(pictures.PictureCosts, "measure", lambda *_: None)
    monkeypatch.setattr(files, "plot", lambda report, path: path.write_bytes(b"PNG"))


@pytest.mark.usefixtures("quick")
def test_cost_writes_a_report_and_says_what_is_best(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "report"
    words = ["cost", data, "-o", folder, "--budget", "1m", "-q"]
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    assert sorted(path.name for path in folder.iterdir()) == NAMES
    lines = result.stdout.splitlines()
    assert lines[0].split() == ["accuracy", "encoding", "time", "size", "16^3", "region", "options"]
    assert lines[1].startswith("40 dB     fastest, smallest")
    assert max(map(len, lines[:5])) <= 100
    assert any(line.startswith("measured  the whole series") for line in lines)
    again = fhash(*words)
    assert again.exit_code == 2
    assert "--force" in again.stderr
    printed = json.loads(fhash(*words, "--force", "--json").stdout)
    stored = json.loads((folder / "cost.json").read_text())
    assert printed == {"paths": printed["paths"], **stored}
    assert stored["series"].startswith(f"{data.name} ")


@pytest.mark.usefixtures("quick")
def test_an_interrupted_measurement_keeps_its_report(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cost, "measure_uses", interrupted)
    result = fhash("cost", data, "-o", tmp_path / "report", "-q")
    assert result.exit_code == 130
    assert "has what was measured until then" in result.stderr
    assert json.loads((tmp_path / "report" / "cost.json").read_text())["interrupted"]


@pytest.mark.usefixtures("quick")
def test_encode_writes_a_report_on_its_file(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    path, folder = tmp_path / "a.fhz", tmp_path / "report"
    words = ["encode", data, "-o", path, "--effort", "1", "-q", "--report", folder]
    assert fhash(*words).exit_code == 0
    assert sorted(written.name for written in folder.iterdir()) == NAMES
    (point,) = json.loads((folder / "cost.json").read_text())["encodings"]
    assert (point["name"], point["bytes"]) == ("a.fhz", path.stat().st_size)


def test_a_missing_library_or_folder_is_told_before_any_work(
    refused: Refused, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "does not exist" in refused(2, "cost", data, "-o", tmp_path / "no" / "where")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    line = "a report of costs needs matplotlib; pip install 'fhash[bench]'"
    assert refused(2, "cost", data, "-o", tmp_path / "new") == line
    words = ["encode", data, "-o", tmp_path / "a.fhz", "--report", tmp_path / "new"]
    assert refused(2, *words) == line


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90.0), ("2m", 120.0), ("1.5h", 5400.0), ("30", 30.0)]
)
def test_times_are_read(text: str, seconds: float) -> None:
    assert DURATION.convert(text, None, None) == seconds


def test_other_times_are_refused(refused: Refused, data: Path) -> None:
    assert "'soon' is no time" in refused(2, "cost", data, "--budget", "soon")
    assert "allowed: 1s to 24h" in refused(2, "cost", data, "--budget", "0")
