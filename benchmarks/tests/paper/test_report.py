"""Reports of the paper's bench: tables, answers to claims, and files at a quality."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from made_cells import BETWEEN, LATENCY, answer, cell, cells

from fhash_bench.kept import of_fields
from fhash_bench.paper import files, report
from fhash_bench.paper.claims import (
    CONFIRMED,
    NOT_REACHED,
    NOT_TESTABLE,
    REFUTED,
    answers,
    claims_table,
    spread,
    verdict,
)
from fhash_bench.paper.files import MAX_BYTES, FileResult, files_of, files_table, measure_files
from fhash_bench.paper.printed import PaperTable, shown
from fhash_bench.paper.report import paper_tables, plot_convergence, tables_of, write_report
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
        monkeypatch.setattr(files.fhash_codec, "encode", self.encode)
        monkeypatch.setattr(files, "open_volume", self.open)

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
        points=[point("SZ3", 900), point("ZFP", 700, reached=False), point("fhash default", 300)],
        refused={"SPERR rate": "too small"},
        raw_bytes=10_000,
    )
    monkeypatch.setattr(files, "bench_rate", lambda *args, **options: bench)
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
    paper = [config for config in encodings.configs if config.published]
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
        ("default", False, True),
        ("peer", True, True),
        ("peer", True, False),
        ("default", True, True),
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

    monkeypatch.setattr(files, "bench_rate", refuse)
    results, refused = measure_files("mine", SERIES, "all")
    assert {each.kind for each in results} == {"paper", "coded", "default"}
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
    assert of_fields(FileResult, made.to_dict()) == made
    with pytest.raises(InputError, match="needed: bytes"):
        of_fields(FileResult, {"bytes": 1})


def test_the_median_decides() -> None:
    assert verdict([], 10, 1) == NOT_TESTABLE
    assert verdict([1.0, 10.0, 12.0], 10, 1) == CONFIRMED
    assert verdict([1.0, 9.9, 12.0], 10, 1) == NOT_REACHED
    assert verdict([0.9], 10, 1) == REFUTED


def test_a_spread_names_its_ends_where_they_differ() -> None:
    assert spread([], "x") == "-"
    assert spread([2.0], "x") == "2x"
    assert spread([3.0, 1.0, 12.345], " dB") == "3 dB (1 to 12.3)"


def test_every_claim_has_an_answer_even_without_cells() -> None:
    # Two claims are answered by the paper's own configurations.
    assert [each.verdict for each in answers([])].count(CONFIRMED) == 2
    assert {each.verdict for each in answers([])} == {CONFIRMED, NOT_TESTABLE}
    found = answers(cells())
    assert len({each.claim for each in found}) == 13
    assert len(found) == 13 + 4  # four of them in each of two protocols
    assert all(each.figures for each in found)


def test_buckets_and_parameters_are_those_of_the_design() -> None:
    found = answer("100 % of the buckets", cell(buckets_used=0.3))
    assert found.verdict == CONFIRMED
    assert "30 % of the embeddings" in found.figures
    dense = cell("dense", parameters={"tables": 300_000, "mlp": 10})
    found = answer("least number of parameters", cell(), dense)
    assert found.verdict == CONFIRMED
    assert "1.86x (1.25 to 2.88) those of F-Hash; a dense grid of the same box" in found.figures
    assert found.figures.endswith("0.75x")


def test_steps_between_key_frames() -> None:
    assert answer("critical changes", cell()).verdict == REFUTED
    steady = BETWEEN | {"missed_share": 0.0, "psnr_between": 49.5}
    assert answer("critical changes", cell(between=steady)).verdict == CONFIRMED
    drop = BETWEEN | {"missed_share": 0.0}
    assert answer("critical changes", cell(between=drop)).verdict == REFUTED


@pytest.mark.parametrize(
    ("protocol", "part", "linear"),
    [("equal", "psnr_between", 29.5), ("published", "psnr_inner", 31.5)],
)
def test_super_resolution_is_beside_the_interpolated_source(
    protocol: str, part: str, linear: float
) -> None:
    def found(value: float | None) -> str:
        made = cell("fhash", protocol, between=BETWEEN | {part: value})
        return answer("super-resolution", made).verdict

    assert found(linear + 3) == CONFIRMED
    assert found(linear + 0.5) == found(linear - 0.5) == NOT_REACHED
    assert found(linear - 3) == REFUTED
    assert found(None) == NOT_TESTABLE


def test_released_stands_beside_the_others_as_published() -> None:
    made = [cell("dense", "published"), cell("fhash", "published")]
    own = answer("converges", *made, cell("fhash", "released", rise=8.0), protocol="released")
    assert own.verdict == NOT_REACHED
    assert "of pictures: seconds 7x (6 to 8)" in own.figures


def test_pictures_through_encodings() -> None:
    found = answer("ARM", cell())
    assert found.verdict == CONFIRMED
    assert "1.5x in ms, 5x in passes" in found.figures
    found = answer("renders faster", cell(), cell("dense"))
    assert found.verdict == NOT_REACHED
    assert "for F-Hash alone, as in the paper 2x" in found.figures
    fast: dict[str, Any] = {**LATENCY, "on": {**LATENCY["on"], "arm_ms": 50.0}}  # type: ignore[dict-item]
    assert answer("renders faster", cell(latency=fast), cell("dense")).verdict == CONFIRMED


def result(kind: str, bytes: int, **others: Any) -> FileResult:
    fields: dict[str, Any] = {
        "data_set": "bubble",
        "feature": "segmentation",
        "codec": kind,
        "kind": kind,
        "whole": kind != "paper",
        "bytes": bytes,
        "raw_bytes": 10**6,
        "psnr": 45.5,
        "reached": True,
        "seconds": None,
    }
    return FileResult(**{**fields, **others})


def test_files_beside_other_codecs() -> None:
    files = [result("paper", 9000), result("peer", 3000), result("default", 1500)]
    files.append(result("coded", 3600))
    found = answer("compression", files=files)
    assert found.verdict == CONFIRMED
    assert "3x, with tables coded by the transform 1.2x; best peer / default preset 2x" in (
        found.figures
    )
    small = [result("paper", 900), *files[1:]]
    assert answer("compression", files=small).verdict == REFUTED
    missed = [result("paper", 900, reached=False), *files[1:]]
    assert answer("compression", files=missed).verdict == NOT_TESTABLE


def test_the_answers_as_a_table() -> None:
    table = claims_table(cells())
    assert [row[2] for row in table.rows] == [each.verdict for each in answers(cells())]


def test_speed_is_answered_by_protocol() -> None:
    slow = [cell(name, "published", rise=0.2) for name in ("dense", "hash")]
    made = [*slow, cell("fhash", "published"), cell("dense", rise=3.0), cell(rise=4.0)]
    published = answer("converges", *made, protocol="published")
    equal = answer("converges", *made, protocol="equal")
    assert (published.verdict, equal.verdict) == (CONFIRMED, NOT_REACHED)
    assert "of pictures: seconds 1.43x (1.2 to 1.5), epochs" in equal.figures
    assert "of the coreset: seconds 1.33x (1.25 to 1.4)" in equal.figures
    assert equal.figures.count("(0 that F-Hash alone reached)") == 2
    assert "(2 that F-Hash alone reached); of the coreset" in published.figures


def test_accuracy_turns_with_the_curves() -> None:
    assert answer("most accurate", cell(), cell("dense")).verdict == CONFIRMED
    assert answer("most accurate", cell(rise=0.5), cell("dense")).verdict == REFUTED
    assert answer("most accurate", cell(rise=1.02), cell("dense")).verdict == NOT_REACHED


def test_collisions_are_judged_at_the_end() -> None:
    made = [cell("hash", rise=2.5, collisions=0.9), cell("dense-multi", rise=2.0)]
    assert answer("Collisions", *made).verdict == REFUTED
    made = [cell("hash", rise=1.5, collisions=0.9), cell("dense-multi", rise=2.0)]
    found = answer("Collisions", *made)
    assert found.verdict == CONFIRMED
    assert "4 dB after 8 epochs, 20 dB at the end" in found.figures
    assert "90 %" in found.figures


def test_without_pictures_the_coreset_decides() -> None:
    made = [cell(), cell("dense", rise=0.2)]
    bare = [
        replace(each, curve=tuple(replace(point, picture_psnr=None) for point in each.curve))
        for each in made
    ]
    found = answer("converges", *bare)
    assert found.verdict == CONFIRMED
    assert "of pictures" not in found.figures


def test_encodings_that_are_missing_test_nothing() -> None:
    for words in ("converges", "most accurate", "Collisions"):
        assert answer(words, cell()).verdict == NOT_TESTABLE


PNG = b"\x89PNG"


def test_a_picture_for_each_data_set_and_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(
        report, "_draw", lambda title, encodings, path: drawn.append((title, list(encodings)))
    )
    made = [*cells()[:2], cell(seed=1), cell(data_set="my data", feature="interval:0:1")]
    assert [path.name for path in plot_convergence(made, tmp_path)] == [
        "convergence-bubble-segmentation-published.png",
        "convergence-bubble-segmentation-equal.png",
        "convergence-my_data-interval_0_1-equal.png",
    ]
    assert drawn[0] == (
        "Argon Bubble (bubble), segmentation, protocol published",
        ["dense", "dense-multi"],
    )


def test_curves_of_seeds_replace_an_older_picture(tmp_path: Path) -> None:
    made = [cell(), cell(seed=1, rise=3.0)]
    made = [replace(each, curve=each.curve[:4]) for each in made]
    old = tmp_path / "convergence-bubble-segmentation-equal.png"
    old.write_bytes(b"old")
    assert plot_convergence(made, tmp_path) == [old]
    assert old.read_bytes().startswith(PNG)


def test_curves_without_figures_are_left_out(tmp_path: Path) -> None:
    made = cell()
    bare = replace(
        made,
        curve=tuple(
            replace(point, picture_psnr=None, coreset_psnr=None) for point in made.curve[:3]
        ),
    )
    (path,) = plot_convergence([bare], tmp_path)
    assert path.read_bytes().startswith(PNG)


def test_without_matplotlib_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise MissingDependencyError("a plot needs matplotlib")

    monkeypatch.setattr(report, "require_matplotlib", refuse)
    with pytest.raises(MissingDependencyError, match="matplotlib"):
        plot_convergence([cell()], tmp_path)


def test_tables_and_claims_of_cells() -> None:
    names = [table.name for table in tables_of(cells())]
    assert names[-1] == "claims"
    assert len(set(names)) == len(names)
    assert tables_of([]) == ()


def test_files_are_written(tmp_path: Path) -> None:
    made = [cell("fhash"), cell("hash")]
    files, missing = write_report(made, tables_of(made), tmp_path)
    assert not missing
    assert [path.suffix for path in files] == [".md", ".png"]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    assert "Claims of the paper" in files[0].read_text()
    assert write_report([], [], tmp_path / "gone") == ([], [])


def test_without_matplotlib_a_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*words: object) -> None:
        raise MissingDependencyError("needs matplotlib")

    monkeypatch.setattr(report, "plot_convergence", refuse)
    files, missing = write_report([cell()], tables_of([cell()]), tmp_path)
    assert [path.name for path in files] == ["tables.md"]
    assert missing == ["no curves: needs matplotlib"]


def tables(*made: Any) -> dict[str, PaperTable]:
    return {table.name: table for table in paper_tables(made)}


def rows(table: PaperTable) -> list[dict[str, str]]:
    heading, *lines = table.lines()
    return [dict(zip(heading, line, strict=True)) for line in lines]


def test_all_tables_of_all_protocols() -> None:
    made = tables(*cells())
    for protocol in ("published", "equal"):
        for name in ("3-pictures", "3-volume", "4", "5", "6"):
            assert f"table-{name}-{protocol}" in made
    assert {"trainings", "table-1", "table-3-parameters", "between-equal"} <= made.keys()
    assert "table-3-pictures-best" not in made


def test_convergence_counts_seconds_epochs_and_steps() -> None:
    found = rows(tables(cell(), cell(seed=1, rise=3.0), cell("dense"))["table-3-volume-equal"])
    at = {(row["dB"], row["of"]): row for row in found}
    assert at["30", "epochs"]["fhash"] == "6 (5-7)"
    assert at["30", "epochs"]["dense"] == "20"
    assert at["30", "epochs"]["best other / fhash"] == "3.333"
    assert at["30", "Adam steps"]["dense"] == "100"
    assert at["30", "seconds"]["dense"] == "10"
    assert at["30", "epochs"]["hash"] == "-"


def test_what_is_not_reached_is_no_number() -> None:
    found = rows(tables(cell(), cell("dense", rise=0.1))["table-3-volume-equal"])
    row = next(row for row in found if (row["dB"], row["of"]) == ("40", "epochs"))
    assert (row["dense"], row["best other / fhash"]) == ("NR", "others NR")


def test_printed_figures_are_marked() -> None:
    found = tables(*cells())
    pictures = rows(found["table-3-pictures-published"])
    quoted = [row for row in pictures if "quoted" in row["of"]]
    assert [row["fhash"] for row in quoted] == ["1.1", "2.2", "3.4"]
    assert quoted[1]["hash"] == "NR"
    assert not any("quoted" in row["of"] for row in rows(found["table-3-volume-equal"]))
    latency = rows(found["table-6-equal"])
    heading = "ms, stream / ARM (paper, quoted)"
    where = {(row["encoding"], row["occupancy"]): row[heading] for row in latency}
    assert where["fhash", "on"].startswith("63.01 / 43.4")
    assert where["fhash", "off"] == "-" == where["dense", "on"]
    assert where["dense", "off"].startswith("256.9")


def test_users_data_have_nothing_printed() -> None:
    found = tables(cell(data_set="mine", feature="interval:0:1"))
    for table in found.values():
        if table.name not in ("table-1", "table-3-parameters"):
            assert not any("quoted" in text for row in rows(table) for text in row.values())
    assert "interval:0:1" in found["table-4-equal"].title


def test_accuracy_after_thirty_epochs_or_the_last() -> None:
    table = tables(cell("dense"))["table-4-equal"]
    assert "after 30 epochs" in table.title
    assert rows(table)[0]["dense"] == "12"
    assert rows(table)[3]["dense"] == "40"
    short = cell("dense")
    short = cell("dense", curve=short.curve[:11])
    table = tables(short)["table-4-equal"]
    assert "after 10 epochs" in table.title
    assert rows(table)[3]["dense"] == "20"


def test_the_papers_ratio_counts_four_bytes_a_parameter() -> None:
    made = cell(parameters={"tables": 900, "mlp": 100}, raw_bytes=40_000, bytes=2_000)
    found = {row["figure"]: row["fhash"] for row in rows(tables(made)["table-5-equal"])}
    assert found["raw / (4 B x parameters)"] == "10"
    assert found["raw / stored bytes"] == "20"
    assert found["ratio (paper, quoted)"] == "46.8"


def test_parameters_of_the_papers_configuration() -> None:
    found = {
        (row["data set"], row["encoding"]): row["computed"]
        for row in rows(tables(cell())["table-3-parameters"])
    }
    assert found["Combustion", "MHE"] == "125,829,120"
    assert found["Supernova", "MHE (tiny-cuda-nn)"] == "215,768,320"
    assert found["Supernova", "F-Hash"] == "112,857,968"


def test_levels_of_table_1() -> None:
    found = rows(tables(cell())["table-1"])
    assert {row["fold"]: row["levels, computed"] for row in found} == {"2": "8", "4": "4", "6": "3"}


def test_cells_without_latency_have_no_such_table() -> None:
    made = tables(cell(latency=None, between=None))
    assert not any("table-6" in name or "between" in name for name in made)
    assert shown(made["table-5-equal"].rows[3][-1]) == "-"
