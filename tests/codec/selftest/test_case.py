"""A finding holds up to its limit; a run decodes its file once."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.selftest.case import Finding, Run


@pytest.mark.parametrize(
    ("worst", "holds"),
    [(0.5, True), (1.0, True), (np.nextafter(1.0, 2.0), False), (np.inf, False), (np.nan, False)],
)
def test_a_finding_holds_up_to_its_limit(worst: float, holds: bool) -> None:
    assert Finding(name="a", worst=worst, limit=1.0, unit="").holds is holds


def test_a_run_decodes_its_file_once(run: Run) -> None:
    assert run.decoded.shape == run.values.shape
    assert run.decoded is run.decoded
    assert run.data_range == float(run.values.max()) - float(run.values.min())
