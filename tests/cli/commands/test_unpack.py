"""`fhash unpack`: a container becomes a store of the same chunks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import zarr
from click.testing import Result

import fhash_codec

Fhash = Callable[..., Result]


def test_a_container_is_unpacked_and_packed_again(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    run, store, again = (tmp_path / name for name in ("run.fhz", "run.zarr", "again.fhz"))
    words = ("--max-error", "0.1", "--tile", "2x6x7x8", "--effort", "1", "-q")
    assert fhash("encode", data, "-o", run, *words).exit_code == 0
    result = fhash("unpack", run, "-o", store)
    assert result.exit_code == 0, result.stderr
    assert "2 chunks" in result.stdout
    assert fhash("pack", store, "-o", again).exit_code == 0
    with fhash_codec.open(run) as volume, fhash_codec.open(again) as other:
        array = zarr.open_group(store, mode="r")[volume.name]
        assert np.array_equal(array[...], volume[...])
        assert np.array_equal(other[...], volume[...])


def test_a_feature_is_refused_with_the_way_out(
    refused: Callable[..., str], run: Path, tmp_path: Path
) -> None:
    told = refused(2, "unpack", run, "-o", tmp_path / "run.zarr")
    assert "a part of its domain" in told
    assert "fhash decode" in told
