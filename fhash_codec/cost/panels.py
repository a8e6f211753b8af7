"""Every plot of a cost report."""

from __future__ import annotations

from fhash_codec.cost.encode_panels import encode_panels
from fhash_codec.cost.panel import Panel
from fhash_codec.cost.results import CostReport
from fhash_codec.cost.use_panels import picture_panels, read_panels

__all__ = ["panels"]


def panels(report: CostReport) -> list[Panel]:
    """Every plot for which there are points; those that compare encodings need two."""
    made = [*encode_panels(report), *read_panels(report), *picture_panels(report)]
    return [panel for panel in made if any(trace.x for trace in panel.traces)]
