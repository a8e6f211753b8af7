"""The report on one encoding."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import pictures
from fhash_codec.cost.one import report_on_encode
from fhash_codec.encoding import encode
from fhash_formats.series import ArraySeries


def test_stages_steps_reads_and_the_file_itself(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures.PictureCosts, "measure", lambda self, series, files: None)
    config = EncodeConfig(effort=2, psnr=45.0)
    path = tmp_path / "run.fhz"
    figures = encode(series, path, config)
    report = report_on_encode(series, figures, config, budget=100.0)
    (point,) = report.encodings
    assert (point.name, point.options) == ("run.fhz", "--psnr 45 --effort 2")
    assert point.bytes == path.stat().st_size
    assert [step["step"] for step in report.per_step] == [0, 1, 2, 3]
    assert sum(stage.seconds for stage in report.stages) <= report.seconds
    assert report.gains[-1].bytes > 0
    assert {read.file for read in report.reads} == {"run.fhz"}
    assert report.seconds >= figures["seconds"]
