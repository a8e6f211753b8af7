"""Curves of convergence as pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from made_cells import cell, cells

from fhash_bench.paper import report
from fhash_bench.paper import report as plot
from fhash_bench.paper.printed import PaperTable, shown
from fhash_bench.paper.report import paper_tables, plot_convergence, tables_of, write_report
from fhash_formats.errors import MissingDependencyError

PNG = b"\x89PNG"


def test_a_picture_for_each_data_set_and_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(
        plot, "_draw", lambda title, encodings, path: drawn.append((title, list(encodings)))
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

    monkeypatch.setattr(plot, "require_matplotlib", refuse)
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
