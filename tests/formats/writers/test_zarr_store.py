"""Zarr: one chunk for each step, all of them stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from labelled_region import SHAPE, labelled_region

from fhash_formats import save_region


def test_zarr_is_one_chunk_a_step_and_none_is_missing(tmp_path: Path) -> None:
    import zarr

    nothing = np.zeros(SHAPE, "i4")
    nothing[1] = 7
    (path,) = save_region(tmp_path / "out.zarr", labelled_region(dtype=np.dtype("i4")), nothing)
    theta = zarr.open_group(path, mode="r")["theta"]
    assert isinstance(theta, zarr.Array)
    assert (theta.metadata.zarr_format, theta.chunks, theta.nchunks_initialized) == (
        3,
        (1, 4, 5, 6),
        3,
    )
    assert sum(file.is_file() for file in (path / "theta" / "c").rglob("*")) == 3
    np.testing.assert_array_equal(theta[:], nothing)
