"""All plots of a report: each has points, and a name of its own."""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.cost.panels import panels
from fhash_codec.cost.results import CostReport


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
