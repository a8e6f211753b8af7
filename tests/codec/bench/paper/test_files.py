"""Files of the data sets of a bench: measured once, kept, and refused where they are too large."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from made_cells import cell

from fhash_codec.bench.paper import files
from fhash_codec.bench.paper.files import MAX_BYTES, files_of
from fhash_codec.bench.paper.ratios import FileResult

SETTINGS = {"feature_resolved": "segmentation:0.3"}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Calls of `measure_files`, which measures nothing."""
    calls: list[Any] = []

    def measure(
        name: str, series: Any, feature: str, *, kind: str, **_: Any
    ) -> tuple[list[FileResult], list[str]]:
        calls.append((name, series, feature, kind))
        made = FileResult(
            data_set=name, feature=kind, codec="c", kind="peer", whole=True, bytes=1,
            raw_bytes=2, psnr=None, reached=True, seconds=None,
        )  # fmt: skip
        return [made], ["ZFP not measured"] if name == "flame" else []

    monkeypatch.setattr(files, "measure_files", measure)
    return calls


def test_each_data_set_and_feature_is_measured_once(asked: list[Any], tmp_path: Path) -> None:
    made = [cell(settings=SETTINGS), cell("dense", settings=SETTINGS), cell(feature="all")]
    found, refused = files_of(made, lambda name: name, tmp_path)  # type: ignore[arg-type, return-value]
    assert asked == [
        ("bubble", "bubble", "segmentation:0.3", "segmentation"),
        ("bubble", "bubble", "all", "all"),
    ]
    assert (len(found), refused) == (2, [])
    assert files_of(made, lambda name: name, tmp_path) == (found, [])  # type: ignore[arg-type, return-value]
    assert len(asked) == 2
    other = cell(settings={"feature_resolved": "segmentation:0.4"})
    files_of([other], lambda name: name, tmp_path)  # type: ignore[arg-type, return-value]
    assert len(asked) == 3


def test_what_a_missing_codec_left_out_is_measured_again(asked: list[Any], tmp_path: Path) -> None:
    for _ in range(2):
        found, refused = files_of([cell(data_set="flame")], lambda name: name, tmp_path)  # type: ignore[arg-type, return-value]
        assert (len(found), refused) == (1, ["ZFP not measured"])
    assert len(asked) == 2


def test_a_damaged_file_is_measured_again(asked: list[Any], tmp_path: Path) -> None:
    files_of([cell()], lambda name: name, tmp_path)  # type: ignore[arg-type, return-value]
    (path,) = tmp_path.iterdir()
    path.write_text("[1")
    files_of([cell()], lambda name: name, tmp_path)  # type: ignore[arg-type, return-value]
    assert len(asked) == 2


def test_a_large_series_is_refused_in_one_line(asked: list[Any], tmp_path: Path) -> None:
    found, refused = files_of(
        [cell(raw_bytes=MAX_BYTES + 1)],
        lambda name: name,  # type: ignore[arg-type, return-value]
        tmp_path,
    )
    assert (found, asked) == ([], [])
    assert refused == [
        "no files of bubble: it has 0.54 GB, at most 0.54 GB are encoded; take a smaller scale"
    ]
