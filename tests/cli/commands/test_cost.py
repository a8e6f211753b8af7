"""`fhash cost`, and `fhash encode --report`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from command_line import Fhash, Refused

from fhash_cli.options import DURATION
from fhash_codec.config import EncodeConfig
from fhash_codec.cost import cost
from fhash_codec.cost import report as files
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.plan import Wish

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
