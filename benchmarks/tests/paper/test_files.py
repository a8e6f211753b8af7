"""Files of the data sets of a bench: measured once, kept, and refused where they are too large."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from made_cells import cell

from fhash_bench.paper import files
from fhash_bench.paper import files as ratios
from fhash_bench.paper.files import MAX_BYTES, FileResult, files_of, files_table, measure_files
from fhash_bench.rate.measuring import Point
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Series

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


SERIES: Any = object()


def point(codec: str, count: int, *, reached: bool = True) -> Point:
    return Point(
        codec=codec, goal="psnr", asked=45.0, reached=reached, bytes=count, psnr=45.1,
        max_error=0.1, setting=f"{codec} tolerance", as_asked=None,
    )  # fmt: skip


class Encodings:
    """Stand-in for encoding: files of F-Hash that gain 15 dB by twice the epochs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.configs: list[Any] = []
        monkeypatch.setattr(ratios.fhash_codec, "encode", self.encode)
        monkeypatch.setattr(ratios, "open_volume", self.open)

    def encode(self, series: Series, path: Path, config: Any, *, progress: Any) -> None:
        progress("training", 1, 2, "")
        self.configs.append(config)

    def open(self, path: Path) -> Any:
        config = self.configs[-1]
        psnr = config.psnr or {20: 33.0, 40: 48.0}[config.epochs]
        info = {
            "bytes": 500,
            "raw_bytes": 10_000,
            "quality": {"psnr": psnr},
        }
        volume = SimpleNamespace(info=info)

        class Opened:
            def __enter__(self) -> Any:
                return volume

            def __exit__(self, *_: object) -> None:
                return None

        return Opened()


@pytest.fixture
def encodings(monkeypatch: pytest.MonkeyPatch) -> Encodings:
    bench = SimpleNamespace(
        points=[point("SZ3", 900), point("ZFP", 700, reached=False), point("fhash compact", 300)],
        refused={"SPERR rate": "too small"},
        raw_bytes=10_000,
    )
    monkeypatch.setattr(ratios, "bench_rate", lambda *args, **options: bench)
    return Encodings(monkeypatch)


def test_files_are_encoded_until_they_have_the_quality(encodings: Encodings) -> None:
    told: list[Any] = []
    results, refused = measure_files(
        "bubble",
        SERIES,
        "segmentation:0.3",
        kind="segmentation",
        progress=lambda *w: told.append(w),
    )
    paper = [config for config in encodings.configs if config.profile == "paper"]
    assert [(config.tables, config.epochs) for config in paper[:4]] == [
        ("float32", 20),
        ("float32", 40),
        ("float16", 20),
        ("float16", 40),
    ]
    assert (paper[4].tables, paper[4].psnr) == ("transform", 45.0)
    assert {config.features for config in encodings.configs} == {("segmentation:0.3",)}
    assert [(each.kind, each.whole, each.reached) for each in results] == [
        ("paper", False, True),
        ("paper", False, True),
        ("coded", False, True),
        ("compact", False, True),
        ("peer", True, True),
        ("peer", True, False),
        ("compact", True, True),
    ]
    assert results[0].ratio == 20
    assert results[0].codec == "F-Hash, float32, 40 epochs"
    assert refused == ["SPERR rate not measured: too small"]
    assert told[-1][1] == told[-1][2]
    assert ("files", 2, 5, "bubble, F-Hash, coded tables: training 1/2") in told


def test_without_peers_a_line_says_so(
    encodings: Encodings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **options: Any) -> None:
        raise MissingDependencyError("pip install 'fhash[bench]'")

    monkeypatch.setattr(ratios, "bench_rate", refuse)
    results, refused = measure_files("mine", SERIES, "all")
    assert {each.kind for each in results} == {"paper", "coded", "compact"}
    assert refused == ["SZ3, SPERR, ZFP not measured: pip install 'fhash[bench]'"]


def test_the_smallest_file_comes_first_and_printed_ratios_are_marked(
    encodings: Encodings,
) -> None:
    results, refused = measure_files("bubble", SERIES, "segmentation")
    heading, *rows = files_table(results, refused).lines()
    table = [dict(zip(heading, row, strict=True)) for row in rows]
    measured = [row for row in table if row["reached"] != "-"]
    assert [row["bytes"] for row in measured] == ["300", "500", "500", "500", "500", "900", "700"]
    assert [row["reached"] for row in measured] == ["yes"] * 6 + ["no"]
    quoted = {row["codec"]: row["ratio"] for row in table if row["reached"] == "-"}
    assert quoted["TTHRESH on Argon Bubble (paper, quoted)"] == "1,107.4"
    assert quoted["F-Hash on Argon Bubble (paper, quoted)"] == "46.8"
    assert "SPERR rate not measured: too small" in files_table(results, refused).notes


def test_results_go_through_json() -> None:
    made = FileResult(
        data_set="a", feature="b", codec="c", kind="peer", whole=True, bytes=1, raw_bytes=2,
        psnr=None, reached=True, seconds=None,
    )  # fmt: skip
    assert FileResult.from_dict(made.to_dict()) == made
    with pytest.raises(InputError, match="needed: bytes"):
        FileResult.from_dict({"bytes": 1})
