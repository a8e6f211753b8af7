"""Plots of encodings: a curve for each group, hollow points for predictions."""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.cost.panels import (
    STYLES,
    Axis,
    Panel,
    encode_panels,
    panels,
    picture_panels,
    read_panels,
    single,
    style_of,
)
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


def test_curves_of_their_own_keep_their_style_and_differ() -> None:
    assert style_of("SZ3", 5) == STYLES["SZ3"]
    assert len(set(STYLES.values())) == len(STYLES)
    assert style_of("frame", 0) != style_of("region", 1)


def test_a_plot_with_one_curve() -> None:
    empty = Panel(
        key="a", section="read", title="b", x=Axis(label="step"), y=Axis(label="dB"), traces=()
    )
    panel = single(empty, [0.0, 1.0], [40.0, 41.5])
    assert [trace.y for trace in panel.traces] == [(40.0, 41.5)]
    assert panel.traces[0].text == ("0: 40", "1: 41.5")
    assert panel.to_dict()["x"] == {"label": "step", "unit": "", "log": False, "reversed": False}


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
