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
    NAMES,
    STYLES,
    Axis,
    Panel,
    check_folder,
    encode_panels,
    json_text,
    page,
    panels,
    picture_panels,
    plot,
    read_panels,
    single,
    style_of,
    tables,
    write_report,
)
from fhash_codec.cost.results import CostReport
from fhash_formats.errors import InputError, MissingDependencyError, OutputError, OutputExistsError


def test_measured_points_are_full_and_predicted_ones_hollow(report: CostReport) -> None:
    made = {panel.key: panel for panel in encode_panels(report)}
    frontier = made["encode-bytes"]
    assert [(trace.name, trace.hollow, trace.x) for trace in frontier.traces] == [
        ("compact, effort 1", False, (1000,)),
        ("compact, effort 1, predicted", True, (1100,)),
        ("SZ3", False, (2000,)),
        ("compact, effort 5, predicted", True, (900,)),
    ]
    assert frontier.x.log
    assert "0.5 s" in frontier.traces[0].text[0]
    (beside,) = made["predicted"].traces
    assert (beside.x, beside.y) == ((0.4,), (0.5,))


def test_trainings_stages_and_steps(report: CostReport) -> None:
    made = {panel.key: panel for panel in encode_panels(report)}
    assert [trace.y for trace in made["training"].traces] == [(20.0,)]
    assert made["stages"].bars
    assert made["stages"].traces[0].y == ("head",)
    assert made["per-step"].traces[0].y == (40.0,)
    assert "paper, 2 epochs, in training" in [trace.name for trace in made["encode-seconds"].traces]


def test_curves_of_their_own_keep_their_style_and_differ() -> None:
    assert style_of("SZ3", 5) == STYLES["SZ3"]
    assert len(set(STYLES.values())) == len(STYLES)
    assert style_of("frame", 0) != style_of("region", 1)


def test_a_plot_with_one_curve() -> None:
    panel = single(Panel("a", "read", "b", Axis("step"), Axis("dB")), [0.0, 1.0], [40.0, 41.5])
    assert [trace.y for trace in panel.traces] == [(40.0, 41.5)]
    assert panel.traces[0].text == ("0: 40", "1: 41.5")


def test_every_plot_has_points_a_label_and_its_own_key(report: CostReport) -> None:
    made = panels(report)
    assert len({panel.key for panel in made}) == len(made) >= 12
    for panel in made:
        assert panel.x.label
        for trace in panel.traces:
            assert len(trace.x) == len(trace.y) == len(trace.text)


def test_what_was_not_measured_has_no_plot(report: CostReport) -> None:
    empty = replace(report, encodings=(), curves=(), stages=(), per_step=(), reads=(), pictures=())
    assert panels(empty) == []


def test_reads_by_time_and_by_bytes(report: CostReport) -> None:
    by_time, by_bytes = read_panels(report)
    assert [(trace.name, trace.x, trace.y) for trace in by_time.traces] == [
        ("frame", (1.5,), (40.0,))
    ]
    assert by_bytes.traces[0].x == (900.0,)


def test_knobs_effects_and_files(report: CostReport) -> None:
    made = {panel.key: panel for panel in picture_panels(report)}
    # The best picture of a group is what the others are compared with: no point of its own.
    assert made["picture-psnr"].traces[0].y == (30.0,)
    assert made["picture-ssim"].traces[0].y == (0.9,)
    assert made["effects"].traces[0].y == ("nothing named",)
    assert made["picture-bytes"].traces[0].x == (1000.0,)


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture that is quick to draw."""
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


@pytest.mark.parametrize("name", ["plotly.offline", "matplotlib.figure"])
def test_a_missing_library_is_told_at_the_start(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        check_folder(tmp_path / "new", False)


VOID = {"meta", "link", "br", "img", "hr", "input"}


class Reader(HTMLParser):
    """The elements of a page.

    Attributes:
        open: elements that are not closed. loaded: addresses that a browser would fetch.
        texts: contents of scripts by id. places: ids of figures. cells: texts of table cells.
    """

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.texts: dict[str | None, str] = {}
        self.places: list[str | None] = []
        self.cells: list[str] = []
        self._script: str | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loaded += [str(given[name]) for name in ("src", "href", "data") if name in given]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self._script = given.get("id")
        if tag == "figure":
            self.places.append(given.get("id"))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.texts[self._script] = self.texts.get(self._script, "") + data
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


@pytest.fixture
def read(report: CostReport) -> Reader:
    reader = Reader()
    reader.feed(page(report))
    reader.close()
    return reader


def test_the_page_is_one_well_formed_file(read: Reader) -> None:
    assert read.open == []
    assert read.loaded == []


def test_the_style_loads_nothing(report: CostReport) -> None:
    head = page(report).partition("<body>")[0]
    assert not re.search(r"url\(|@import|https?:", head)


def test_the_data_are_those_of_the_json_file(read: Reader, report: CostReport) -> None:
    assert json.loads(read.texts["data"]) == json.loads(json_text(report))
    assert json.loads(read.texts["data"])["series"] == "a.h5 </script> wave"


def test_every_plot_has_a_place_and_every_table_its_cells(read: Reader, report: CostReport) -> None:
    keys = [panel.key for panel in panels(report)]
    assert [panel["key"] for panel in json.loads(read.texts["panels"])] == keys
    assert sorted(map(str, read.places)) == sorted(keys)
    assert {"encode-seconds", "encode-bytes", "read-ms", "effects", "picture-psnr"} <= set(keys)
    shown = [cell for table in tables(report) for row in table.rows for cell in row if cell]
    assert read.cells == shown


def test_the_page_needs_plotly(report: CostReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(MissingDependencyError, match=r"plotly; pip install 'fhash\[bench\]'"):
        page(report)


def test_the_plots_are_drawn_in_colours(report: CostReport, tmp_path: Path) -> None:
    less = replace(report, reads=(), pictures=(), per_step=(), stages=(), curves=())
    plot(less, tmp_path / "cost.png")
    with Image.open(tmp_path / "cost.png") as picture:
        assert len(picture.convert("RGB").getcolors(2**24)) > 50


def test_rows_fit_their_headers(report: CostReport) -> None:
    made = {table.title.split(":")[0].split(",")[0]: table for table in tables(report)}
    assert all(len(row) == len(table.header) for table in made.values() for row in table.rows)
    assert {"Encodings", "Reads", "Pictures", "Left out", "Recommendation"} <= set(made)
    predicted = made["Encodings"].rows[2]
    assert predicted[1:3] == ("-", "9")


def test_an_effect_that_is_not_named_counts_zero(report: CostReport) -> None:
    pictures = next(table for table in tables(report) if table.title.startswith("Pictures"))
    row = dict(zip(pictures.header, pictures.rows[0], strict=True))
    assert row["setting"] == "nothing named"
    assert (row["gradients"], row["secondary rays"]) == ("0", "0")


def test_a_table_without_rows_is_left_out(report: CostReport) -> None:
    titles = [table.title for table in tables(replace(report, reads=(), left_out=()))]
    assert not any(title.startswith(("Reads", "Left out")) for title in titles)
