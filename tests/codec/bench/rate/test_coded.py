"""A series as a peer codes it, filter or program alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fhash_codec.bench.rate.coded import PeerFiles, there_and_back
from fhash_codec.bench.rate.peers import peers
from fhash_codec.boxes import Box


def test_files_of_a_filter_are_read_by_regions(
    field: Callable[..., np.ndarray], tmp_path: Path
) -> None:
    values = field()
    for variant in peers()["SZ3"]:
        decoded, count = there_and_back(values, variant, 3.0, 40.0, tmp_path)
        assert np.abs(decoded - values).max() <= 0.03 * (1 + 1e-4)
        files = PeerFiles(values, variant, 3.0, 40.0, tmp_path)
        files.encode()
        files.decode()
        read, seconds = files.read_region(1, Box.of(((0, 2), (3, 9), (0, 5))))
        assert 0 < read <= count
        assert seconds > 0
