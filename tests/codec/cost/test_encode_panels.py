"""Plots of encodings: a curve for each group, hollow points for predictions."""

from __future__ import annotations

from fhash_codec.cost.encode_panels import encode_panels
from fhash_codec.cost.results import CostReport


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
