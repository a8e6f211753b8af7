"""The page: one file, nothing loaded from elsewhere, valid HTML, and the data of the JSON file."""

from __future__ import annotations

import json
import re
import sys
from html.parser import HTMLParser

import pytest

from fhash_codec.cost.page import json_text, page
from fhash_codec.cost.panels import panels
from fhash_codec.cost.results import CostReport
from fhash_codec.cost.tables import tables
from fhash_formats.errors import MissingDependencyError

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
