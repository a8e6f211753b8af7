"""Plots of reads and pictures."""

from __future__ import annotations

from fhash_codec.cost.results import CostReport
from fhash_codec.cost.use_panels import picture_panels, read_panels


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
