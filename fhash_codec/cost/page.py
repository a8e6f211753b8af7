"""The page of a cost report: one HTML file that holds plotly, the plots, the tables and the data.

The template `page.html` has its style and its script; `{{...}}` stands for what is filled in here.
"""

from __future__ import annotations

import importlib
import json
from html import escape
from importlib.resources import files
from typing import Any

from fhash_codec.cost.advice import told
from fhash_codec.cost.panels import panels
from fhash_codec.cost.pictures import NOTHING
from fhash_codec.cost.results import CostReport
from fhash_codec.cost.tables import Table, tables
from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.values import plain_json

__all__ = ["json_text", "page", "require_plotly"]

EFFECT_COUNTERS = ("gradients", "secondary_rays", "evaluations")
"""Counters of work that effects alone ask for, where a decoded frame is marched."""
SECTIONS = {"encode": "Encode", "read": "Read", "picture": "Picture", "about": "About"}
"""Headings of the page by the sections of panels and tables."""


def require_plotly() -> Any:
    """The module that holds plotly's JavaScript; raises MissingDependencyError."""
    try:
        return importlib.import_module("plotly.offline")
    except ImportError as error:
        raise MissingDependencyError(
            "a page of costs needs plotly; pip install 'fhash[bench]'"
        ) from error


def json_text(report: CostReport) -> str:
    """The report as JSON, as the file beside the page has it; figures without a value are null."""
    return json.dumps(plain_json(report.to_dict()), indent=1, allow_nan=False)


def page(report: CostReport) -> str:
    """The page; raises MissingDependencyError without plotly."""
    filled = {
        "title": escape(f"What accuracy costs: {report.series}"),
        "summary": _summary(report),
        "sections": "".join(_section(name, report) for name in SECTIONS),
        "data": _embedded(json_text(report)),
        "panels": _embedded(json.dumps([panel.to_dict() for panel in panels(report)])),
        "plotly": require_plotly().get_plotlyjs(),
    }
    template = files("fhash_codec.cost").joinpath("page.html").read_text(encoding="utf-8")
    head, *parts = template.split("{{")
    pieces = [part.split("}}", 1) for part in parts]
    return head + "".join(filled[name] + rest for name, rest in pieces)


def _embedded(text: str) -> str:
    """JSON that may stand in a script element: no tag can end it early."""
    return text.replace("<", "\\u003c")


def _summary(report: CostReport) -> str:
    """Lines on the measurement, and the recommendation."""
    shape = " x ".join(map(str, report.measured_shape))
    facts = [
        f"{report.measured}: {shape} (t, z, y, x), {report.dtype}, {report.raw_bytes / 1e6:.3g} MB",
        f"{report.seconds:.0f} s of a budget of {report.budget_seconds:g} s"
        + (", interrupted: what was measured by then" if report.interrupted else ""),
        ", ".join(f"{name} {value}" for name, value in report.machine.items()),
    ]
    advice = "".join(f"<li>{escape(told(entry))}</li>" for entry in report.advice)
    return "".join(f"<p>{escape(fact)}</p>" for fact in facts) + (
        f"<h2>Recommendation</h2><ul class='advice'>{advice}</ul>" if advice else ""
    )


def _section(name: str, report: CostReport) -> str:
    """A heading, the places of its plots, and its tables."""
    plots = "".join(
        f'<figure class="plot" id="{panel.key}"></figure>'
        for panel in panels(report)
        if panel.section == name
    )
    lists = "".join(_table(table) for table in tables(report) if table.section == name)
    notes = ""
    if name == "about":
        notes = "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in report.notes) + "</ul>"
    if not (plots or lists or notes):
        return ""
    zeros = _zeros(report) if name == "picture" else ""
    return f'<h2>{SECTIONS[name]}</h2>{zeros}<div class="plots">{plots}</div>{lists}{notes}'


def _cell(text: str) -> str:
    """A cell of a table; numbers stand to the right."""
    try:
        float(text)
    except ValueError:
        return f"<td>{escape(text)}</td>"
    return f'<td class="number">{escape(text)}</td>'


def _zeros(report: CostReport) -> str:
    """A line on the picture without effects: all that they would take is 0."""
    plain = [each for each in report.pictures if each.setting == NOTHING]
    if not plain:
        return ""
    counts = ", ".join(
        f"{name.replace('_', ' ')} {plain[0].counters[name]}" for name in EFFECT_COUNTERS
    )
    return f"<p>An effect that is not named costs nothing. With {NOTHING}: {counts}.</p>"


def _table(table: Table) -> str:
    """A table with a button that copies it as tab-separated text."""
    header = "".join(f"<th>{escape(name)}</th>" for name in table.header)
    rows = "".join("<tr>" + "".join(_cell(text) for text in row) + "</tr>" for row in table.rows)
    return (
        f"<details open><summary>{escape(table.title)} ({len(table.rows)})</summary>"
        '<button type="button" class="copy">copy as TSV</button>'
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></details>"
    )
