"""`fhash pack`: a store that the codec wrote becomes a container."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from click.testing import Result

import fhash_codec
from fhash_formats.transform.zarr_codec import TransformCodec

Fhash = Callable[..., Result]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store of two variables that are coded, and one that is not."""
    values = np.arange(3 * 6 * 7 * 8, dtype=np.float32).reshape(3, 6, 7, 8)
    group = zarr.open_group(tmp_path / "run.zarr", mode="w")
    for name in ("u", "v"):
        array = group.create_array(
            name, shape=values.shape, chunks=(2, 6, 4, 8), dtype="f4", fill_value=0,
            serializer=TransformCodec(max_error=0.5), dimension_names=["time", "z", "y", "x"],
        )  # fmt: skip
        array[...] = values
    group.create_array("w", data=values, dimension_names=["time", "z", "y", "x"])
    return tmp_path / "run.zarr"


def test_variables_are_packed(fhash: Fhash, store: Path) -> None:
    run = store.with_suffix(".fhz")
    result = fhash("pack", store, "-o", run, "--var", "u,v")
    assert result.exit_code == 0, result.stderr
    assert "u          3 x 6 x 7 x 8 in 4 tiles of 2 x 6 x 4 x 8; error within 0.5" in result.stdout
    assert fhash("verify", run).exit_code == 0
    assert "command" not in fhash("info", run, "--var", "u").stdout
    with fhash_codec.open(run, variable="v") as volume:
        array = zarr.open_group(store, mode="r")["v"]
        assert np.array_equal(volume[...], array[...])


def test_what_cannot_be_packed_is_refused(
    refused: Callable[..., str], fhash: Fhash, store: Path
) -> None:
    run = store.with_suffix(".fhz")
    assert "w is not coded by fhash.transform" in refused(2, "pack", store, "-o", run)
    assert "coded by bytes, zstd" in refused(2, "pack", store, "-o", run, "--var", "w")
    assert "a name twice" in refused(2, "pack", store, "-o", run, "--var", "u,u")
    (store / "u" / "c" / "1" / "0" / "1" / "0").unlink()
    assert "--absent fill" in refused(2, "pack", store, "-o", run, "--var", "u")
    words = ("pack", store, "-o", run, "--var", "u", "--absent", "fill", "-q")
    result = fhash(*words)
    assert result.exit_code == 0, result.stderr
    assert "1 not in the store" in result.stdout
    assert "--force" in refused(2, *words)
