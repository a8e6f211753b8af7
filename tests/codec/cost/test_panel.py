"""Plots with one curve, and the styles of curves."""

from __future__ import annotations

from fhash_codec.cost.panel import STYLES, Axis, Panel, single, style_of


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
