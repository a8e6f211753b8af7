"""QoZ, HPEZ and SZ3 by a stand-in: the bound holds, axes of one vertex are left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.programs.qoz import NAMES, variants


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(4, 6, 20, 24), (1, 6, 20, 24), (3, 1, 1, 9)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_level_is_a_tolerance(
    qoz: str,
    field: Callable[..., np.ndarray],
    tmp_path: Path,
    name: str,
    shape: tuple[int, ...],
    dtype: type,
) -> None:
    values = field(shape).astype(dtype) + dtype(0.1)
    for variant in variants(name, qoz):
        coded = variant.encode(values, 3.0, 40.0, tmp_path)
        difference = variant.decode(coded).astype(float) - values
        assert 0 < np.abs(difference).max() <= 0.03 * (1 + 1e-6)
        assert variant.peer == NAMES[name]
