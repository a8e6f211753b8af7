"""The files of a report: all or none, and never among other files unless asked."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from fhash_codec.cost import report as files
from fhash_codec.cost.report import (
    INK,
    LINE,
    NAMES,
    STYLES,
    Point,
    _best,
    check_folder,
    encode_panels,
    page,
    panels,
    picture_panels,
    plot,
    read_panels,
    style_of,
    svg,
    tables,
    write_report,
)
from fhash_codec.cost.results import (
    DEFAULT,
    DEFAULT_OPTIONS,
    NETWORK,
    TRAINING,
    CostReport,
    LeftOut,
    advice_rows,
    conclusion,
)
from fhash_formats.errors import InputError, MissingDependencyError, OutputError, OutputExistsError


def test_measured_points_and_their_size(report: CostReport) -> None:
    made = {panel.key: panel for panel in encode_panels(report)}
    frontier = made["encode-bytes"]
    assert {name: [point.x for point in points] for name, points in frontier.curves.items()} == {
        "effort 5": [900],
        "effort 1": [1000],
        "SZ3": [2000],
    }
    assert frontier.log == "x"
    assert "1 kB, 0.5 s, 40.1 dB" in frontier.curves["effort 1"][0].text
    assert (made["answer"].section, frontier.section) == ("", "")


def test_lines_join_those_alone_than_which_none_is_better(report: CostReport) -> None:
    (panel, *_) = encode_panels(report)
    points = [Point("a", x, y, "") for x, y in ((2, 40), (1, 50), (3, 60), (4, 60))]
    assert [point[1:3] for point in _best(points, panel)] == [(1, 50), (3, 60)]


def test_figures_of_a_sample_are_drawn_and_told_as_intervals(report: CostReport) -> None:
    grown = tuple(each.grown((2.0, 4.0), (3.0, 5.0), 115200) for each in report.encodings)
    part = replace(report, encodings=grown, measured="a sample", measured_shape=(2, 6, 10, 12))
    (panel, *_) = encode_panels(part)
    assert [point.ends for point in panel.curves["effort 5"]] == [(4.0, 8.0)]
    row = next(row for row in advice_rows(part) if row[1] == "smallest, default")
    assert row[2:4] == ("4 to 8 s", "2.7 to 4.5 kB")
    assert "2.6 to 4.3 times smaller: 2.7 to 4.5 kB, 4 to 8 s" in conclusion(part)
    assert "whole file, 4 x 6 x 10 x 12" in page(part)
    assert "Measured: a sample, 2 x 6 x 10 x 12" in page(part)


def test_rows_name_peers_the_default_and_what_is_wrong(report: CostReport) -> None:
    usual, *others = report.encodings
    network = replace(
        usual, name=NETWORK, codec="published", options="--preset published", bytes=12000,
        psnr=41.0, missed=True,
    )  # fmt: skip
    rows = advice_rows(replace(report, encodings=(usual, *others, network)))
    assert [row[0] for row in rows] == ["40 dB", "", "", "50 dB", "", ""]
    assert rows[2][1:] == ("SZ3", "0.5 s", "2 kB", "-", "<tolerance>")
    assert rows[3][-1] == "default: 50 dB and 40 dB of the bulk"
    assert rows[4][-1] == "--preset published; misses its promise; larger than the data"
    late = LeftOut(what=NETWORK, why="stopped after 3 s, its share of the time", late=True)
    (row,) = [row for row in advice_rows(replace(report, left_out=(late,))) if row[1] == NETWORK]
    assert row[2:] == ("-", "-", "-", f"--preset published: {late.why}")


def test_trainings_stages_and_steps(report: CostReport) -> None:
    made = {panel.key: panel for panel in encode_panels(report)}
    assert [point.y for point in made["training"].curves["published network, 2 epochs"]] == [20.0]
    assert made["stages"].bars
    assert made["stages"].curves[""][0].y == "head"
    assert made["per-step"].curves[""][0].y == 40.0


def test_what_training_saves_is_told_and_drawn_beside_the_default(report: CostReport) -> None:
    (usual, *others) = report.encodings
    usual = replace(usual, name=DEFAULT, options="", seconds=3.0, bytes=900, region_ms=2.0)
    trained = [
        replace(usual, name=f"training {train}", group=TRAINING, options=f"--train {train}",
                seconds=seconds, bytes=size)
        for train, seconds, size in (("2s", 6.0, 800), ("none", 1.0, 1500))
    ]  # fmt: skip
    report = replace(report, encodings=(usual, *others, *trained))
    made = {panel.key: panel for panel in encode_panels(report)}
    points = made["saved"].curves[TRAINING]
    assert [point[1:3] for point in points] == [(1.0, 1500), (3.0, 900), (6.0, 800)]
    assert TRAINING not in made["answer"].curves
    assert advice_rows(report)[-3:] == [
        ("training", "none", "1 s", "1.5 kB", "2 ms", "--train none"),
        ("", "default", "3 s", "900 B", "2 ms", DEFAULT_OPTIONS),
        ("", "2s", "6 s", "800 B", "2 ms", "--train 2s"),
    ]
    untold = replace(report, encodings=(usual, *others))
    assert "saved" not in {panel.key for panel in panels(untold)}


def test_curves_of_their_own_keep_their_style_and_differ() -> None:
    assert style_of("SZ3", 5) == STYLES["SZ3"]
    assert len(set(STYLES.values())) == len(STYLES)
    assert style_of("frame", 0) != style_of("region", 1)


def test_every_plot_has_points_a_label_and_its_own_key(report: CostReport) -> None:
    made = panels(report)
    assert len({panel.key for panel in made}) == len(made) >= 12
    assert made[0].key == "answer"
    assert all(panel.x and all(panel.curves.values()) for panel in made)


def test_what_was_not_measured_has_no_plot(report: CostReport) -> None:
    empty = replace(report, encodings=(), curves=(), stages=(), per_step=(), reads=(), pictures=())
    assert panels(empty) == []


def test_reads_by_time_and_by_bytes(report: CostReport) -> None:
    by_time, by_bytes = read_panels(report)
    assert [point[:3] for point in by_time.curves["frame"]] == [("frame", 1.5, 40.0)]
    assert by_bytes.curves["frame"][0].x == 900.0


def test_knobs_effects_and_files(report: CostReport) -> None:
    made = {panel.key: panel for panel in picture_panels(report)}
    # The best picture of a group is what the others are compared with: no point of its own.
    assert [point.y for point in made["picture-psnr"].curves["step length"]] == [30.0]
    assert [point.y for point in made["picture-ssim"].curves["step length"]] == [0.9]
    assert made["effects"].curves[""][0].y == "nothing named"
    assert made["picture-bytes"].curves["effort 1"][0].x == 1000


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that are quick to draw."""
    monkeypatch.setattr(files, "svg", lambda panel: "<svg></svg>")
    monkeypatch.setattr(files, "plot", lambda report, path: path.write_bytes(b"PNG"))


def test_page_picture_and_json(report: CostReport, tmp_path: Path) -> None:
    paths = write_report(report, tmp_path / "new")
    assert sorted(path.name for path in paths) == sorted(NAMES)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(NAMES)
    assert json.loads((tmp_path / "new" / "cost.json").read_text())["seconds"] == 3.0
    with pytest.raises(OutputExistsError, match="holds files"):
        write_report(report, tmp_path / "new")
    write_report(report, tmp_path / "new", force=True)


def test_other_files_stay(report: CostReport, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(OutputExistsError, match="--force"):
        check_folder(tmp_path, False)
    write_report(report, tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_a_failure_leaves_nothing(
    report: CostReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(report: CostReport, path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "plot", fail)
    with pytest.raises(KeyboardInterrupt):
        write_report(report, tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_unsuitable_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file"):
        check_folder(tmp_path / "file", True)
    with pytest.raises(OutputError, match="does not exist"):
        check_folder(tmp_path / "no" / "where", False)
    (tmp_path / "data.zarr").mkdir()
    with pytest.raises(InputError, match="input"):
        check_folder(tmp_path / "data.zarr", True, (tmp_path / "data.zarr",))


def test_a_missing_library_is_told_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"matplotlib; pip install 'fhash\[bench\]'"):
        check_folder(tmp_path / "new", False)


VOID = {"meta", "link", "br", "img", "hr", "input"}


class Reader(HTMLParser):
    """The elements of a page.

    Attributes:
        open: elements that are not closed. loaded: addresses that a browser would fetch.
        places: ids of figures. cells: texts of table cells. titles: texts for the mouse.
        shown: what stands before the tabs.
    """

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.places: list[str | None] = []
        self.cells: list[str] = []
        self.titles: list[str] = []
        self.shown = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loaded += [str(given[name]) for name in ("src", "href", "data") if name in given]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "figure":
            self.places.append(given.get("id"))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        if "section" not in self.open:
            self.shown += data
        if self.open and self.open[-1] == "td":
            self.cells.append(data)
        if self.open[-2:] == ["g", "title"]:
            self.titles.append(data)


@pytest.fixture(scope="module")
def read(report: CostReport) -> Reader:
    reader = Reader()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "svg", svg)
        reader.feed(page(report))
    reader.close()
    return reader


def test_the_page_is_one_well_formed_file(read: Reader) -> None:
    assert read.open == []
    assert read.loaded == []


def test_the_style_loads_nothing(report: CostReport) -> None:
    head = page(report).partition("<body>")[0]
    assert not re.search(r"url\(|@import|https?:", head)


def test_the_answer_stands_before_the_tabs(read: Reader) -> None:
    told = (
        "The default settings make the data 12.8 times smaller: 900 B, 2 s, 50.2 dB; the smallest"
    )
    assert told in read.shown
    assert read.places[0] == "answer"
    for text in ("40 dB", "fastest", "--effort 1 --psnr 40", "7.5 ms", "Type fhash encode DATA"):
        assert text in read.shown
    assert "gradients" not in read.shown


def test_every_plot_has_a_place_and_every_table_its_cells(read: Reader, report: CostReport) -> None:
    keys = [panel.key for panel in panels(report)]
    assert sorted(map(str, read.places)) == sorted(keys)
    assert {"answer", "encode-bytes", "read-ms", "effects", "picture-psnr"} <= set(keys)
    shown = [cell for table in tables(report) for row in table.rows for cell in row if cell]
    assert [cell for cell in read.cells if cell][-len(shown) :] == shown
    assert "SZ3 <tolerance>\n2 kB, 0.5 s, 51.0 dB" in read.titles


def test_a_plot_has_the_colours_of_the_theme(report: CostReport) -> None:
    drawn = svg(panels(report)[0])
    assert "var(--ink)" in drawn
    assert "var(--line)" in drawn
    assert not {INK, LINE, "#000000", "#ffffff"} & set(re.findall("#[0-9a-f]{6}", drawn))
    assert "<a" not in drawn
    assert ">default</text>" in drawn


def test_the_plots_are_drawn_in_colours(report: CostReport, tmp_path: Path) -> None:
    less = replace(
        report,
        series="a_$ wave_$",
        units="m$^",
        reads=(),
        pictures=(),
        per_step=(),
        stages=(),
        curves=(),
    )
    plot(less, tmp_path / "cost.png")
    with Image.open(tmp_path / "cost.png") as picture:
        assert len(picture.convert("RGB").getcolors(2**24)) > 50


def test_rows_fit_their_headers(report: CostReport) -> None:
    made = {table.title.split(",")[0]: table for table in tables(report)}
    assert all(len(row) == len(table.header) for table in made.values() for row in table.rows)
    assert {"Encodings", "Reads", "Pictures", "Left out"} <= set(made)
    # A column in which nothing stands says nothing.
    assert not {"exact", "seconds range"} & set(made["Encodings"].header)
    effect = dict(zip(made["Pictures"].header, made["Pictures"].rows[0], strict=True))
    assert (effect["setting"], effect["gradients"]) == ("nothing named", "0")


def test_a_table_without_rows_is_left_out(report: CostReport) -> None:
    titles = [table.title for table in tables(replace(report, reads=(), left_out=()))]
    assert not any(title.startswith(("Reads", "Left out")) for title in titles)
