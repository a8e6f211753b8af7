"""Chunks of frames, and the types in which values are stored."""

from __future__ import annotations

import io
from pathlib import Path

import h5py
import numpy as np
import pytest
from labelled_region import DATA, labelled_region

from fhash_formats import save_region
from fhash_formats.writers.common.writer import (
    CHUNK_BYTES,
    chunk_shape,
    little_endian,
    write_frame,
)


@pytest.mark.parametrize("dtype", ["u1", "f4", "f8"])
@pytest.mark.parametrize(
    "shape",
    [
        (1, 1, 1, 1),
        (100, 64, 64, 64),
        (3, 256, 256, 256),
        (2, 3, 5000, 5000),
        (1, 1, 1, 10**8),
        (1, 7, 1, 3 * 10**7),
    ],
)
def test_chunks_are_bounded_and_never_span_steps(
    shape: tuple[int, int, int, int], dtype: str
) -> None:
    made = labelled_region(dtype=np.dtype(dtype))
    object.__setattr__(made, "shape", shape)
    chunk = chunk_shape(made)
    assert chunk[0] == 1
    assert all(1 <= length <= limit for length, limit in zip(chunk, (1, *shape[1:]), strict=True))
    size = int(np.prod(chunk)) * made.dtype.itemsize
    assert size <= CHUNK_BYTES
    frame = int(np.prod(shape[1:])) * made.dtype.itemsize
    assert size == frame if frame <= CHUNK_BYTES else size > CHUNK_BYTES / 4


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_a_frame_above_the_bound_is_several_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    import zarr

    monkeypatch.setattr("fhash_formats.writers.common.writer.CHUNK_BYTES", 250)
    (path,) = save_region(tmp_path / f"out{suffix}", labelled_region(), DATA)
    if suffix == ".zarr":
        theta = zarr.open_group(path, mode="r")["theta"]
        assert isinstance(theta, zarr.Array)
        assert theta.chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(theta[:], DATA)
        return
    with h5py.File(path) as file:
        assert file["theta"].chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(file["theta"], DATA)


@pytest.mark.parametrize("dtype", ["f2", ">f4", "f8", ">i2", "u1"])
def test_values_are_stored_little_endian_without_loss(dtype: str) -> None:
    kept = np.dtype(dtype).newbyteorder("<")
    assert little_endian(np.dtype(dtype), half=True) == kept
    assert little_endian(np.dtype(dtype)) == (np.dtype("<f4") if dtype == "f2" else kept)


def test_a_frame_is_written_with_x_fastest() -> None:
    frame = np.arange(24, dtype="f8").reshape(4, 3, 2).transpose()
    handle = io.BytesIO()
    write_frame(handle, frame, np.dtype("<f4"))
    np.testing.assert_array_equal(
        np.frombuffer(handle.getvalue(), "<f4").reshape(frame.shape), frame
    )
