"""`fhash cost` and `fhash encode --report`: files, text, and what is refused."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import Result

from fhash_cli.options import DurationType
from fhash_codec.cost import cost
from fhash_codec.cost import report as files
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.plan import Wish
from fhash_codec.cost.prediction import Prediction

Fhash = Callable[..., Result]
NAMES = ["cost.html", "cost.json", "cost.png"]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """One encoding, no pictures, and a PNG that is quick to draw."""
    from fhash_codec.config import EncodeConfig

    wish = Wish(codec="compact", group="g", config=EncodeConfig(effort=1, psnr=40.0))
    prediction = Prediction(seconds=0.01, bytes=9, psnr=40.0, basis="")
    monkeypatch.setattr(cost, "wishes", lambda: iter([wish]))
    foretold = SimpleNamespace(predict=lambda config: prediction)
    monkeypatch.setattr(cost, "predictor", lambda series: nullcontext(foretold))
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
    assert lines[0].startswith("40 dB: ") or lines[0].startswith("45 dB: ")
    assert any(line.startswith("measured  the whole series") for line in lines)
    again = fhash(*words)
    assert again.exit_code == 2
    assert "--force" in again.stderr
    printed = json.loads(fhash(*words, "--force", "--json").stdout)
    stored = json.loads((folder / "cost.json").read_text())
    assert printed == {"paths": printed["paths"], **stored}


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
    refused: Callable[..., str], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "does not exist" in refused(2, "cost", data, "-o", tmp_path / "no" / "where")
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    line = "a page of costs needs plotly; pip install 'fhash[bench]'"
    assert refused(2, "cost", data, "-o", tmp_path / "new") == line
    words = ["encode", data, "-o", tmp_path / "a.fhz", "--report", tmp_path / "new"]
    assert refused(2, *words) == line


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90.0), ("2m", 120.0), ("1.5h", 5400.0), ("30", 30.0)]
)
def test_times_are_read(text: str, seconds: float) -> None:
    assert DurationType().convert(text, None, None) == seconds


def test_other_times_are_refused(refused: Callable[..., str], data: Path) -> None:
    assert "'soon' is no time" in refused(2, "cost", data, "--budget", "soon")
    assert "allowed: 1s to 24h" in refused(2, "cost", data, "--budget", "0")
