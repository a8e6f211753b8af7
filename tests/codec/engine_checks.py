"""Agreement of training engines with the float64 oracle, as tests of every engine ask for it."""

from __future__ import annotations

import numpy as np

from fhash_codec.paper.engines.parameters import Parameters

RATE = 0.01
"""Learning rate of the trainings."""


def assert_near(ours: Parameters, theirs: Parameters) -> None:
    """Parameters agree by median and count after some steps of Adam.

    Near a ReLU's kink float32 may take the other side, in torch's own Adam as well.
    """
    for a, b in (
        (ours.fine, theirs.fine),
        (ours.coarse, theirs.coarse),
        (ours.network, theirs.network),
    ):
        if not a.size:
            continue
        # What no sample moved is 0 in ours and still at its start in the oracle's.
        apart = np.abs(a - b)[a != 0]
        # A thousandth of one Adam step.
        assert np.median(apart) < 1e-3 * RATE
        assert (apart > 1e-3).mean() < 0.01
