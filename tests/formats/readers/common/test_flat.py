"""Arrays without chunks: only the frame's bytes are read, and a file that changes is refused."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stored_series import (
    VALUES,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError
from fhash_formats.readers.common import flat
from fhash_formats.readers.common.flat import FlatArray


@given(
    shape=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    place=st.integers(0, 3),
    part=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    block=st.sampled_from([1, 64, 10**6]),
    run=st.sampled_from([1, 10**6]),
)
@settings(max_examples=60)
def test_a_part_of_a_flat_array_is_that_part(
    tmp_path_factory: pytest.TempPathFactory,
    shape: list[int],
    place: int,
    part: tuple[int, int],
    block: int,
    run: int,
) -> None:
    place = place % len(shape)
    start, stop = sorted(min(edge, shape[place]) for edge in part)
    values = np.arange(np.prod(shape), dtype=">i4").reshape(shape)
    path = tmp_path_factory.mktemp("flat") / "a"
    path.write_bytes(b"head" + values.tobytes())
    ranges = tuple(
        slice(start, stop) if at == place else slice(0, length) for at, length in enumerate(shape)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flat, "BLOCK_BYTES", block)
        patch.setattr(flat, "SHORTEST_RUN", run)
        np.testing.assert_array_equal(
            FlatArray(path, tuple(shape), values.dtype, offset=4).read(ranges), values[ranges]
        )


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_variable_cannot_be_named(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    (tmp_path / "a_6x5x3x4_f4.raw").write_bytes(VALUES.tobytes())
    with pytest.raises(InputError, match="--var v cannot be used"):
        open_series(tmp_path / ("a.npy" if kind == "npy" else "a_6x5x3x4_f4.raw"), var="v")


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_file_that_changes_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a_6x5x3x4_f4.{kind}"
    for change in (
        lambda: os.truncate(path, 500),
        path.unlink,
        lambda: os.truncate(path, 5000),
        lambda: os.utime(path, ns=(1, 1)),
    ):
        if kind == "npy":
            np.save(path, VALUES)
        else:
            path.write_bytes(VALUES.tobytes())
        with open_series(path) as series:
            np.testing.assert_array_equal(series.read(0), VALUES[0])
            change()
            with pytest.raises(InputError, match=r"changed while it was being read|cannot be read"):
                series.read(1)


def test_a_file_cut_during_a_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(VALUES.tobytes()[:-1])
    with pytest.raises(InputError, match="ends after 1439 bytes, 1440 are needed"):
        FlatArray(path, VALUES.shape, VALUES.dtype).read(
            (slice(3, 4), slice(0, 3), slice(0, 5), slice(0, 6))
        )


@pytest.mark.parametrize("order", ["t,z,y,x", "z,t,y,x"])
def test_one_frame_is_read_at_a_time(
    tmp_path: Path, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_formats.readers.common.file_series.SLAB_BYTES", 1)
    values = np.zeros((40, 40, 64, 64), np.float32)
    np.save(tmp_path / "a.npy", values)
    count = 0
    original = FlatArray._read

    def counted(self: FlatArray, file: Any, into: np.ndarray, start: int) -> None:
        nonlocal count
        count += into.nbytes
        original(self, file, into, start)

    monkeypatch.setattr(FlatArray, "_read", counted)
    with open_series(tmp_path / "a.npy", axes=order) as series:
        series.read(0)
        count = 0
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count == 2 * values[0].nbytes
    assert peak < 3 * values[0].nbytes


def test_a_short_run_among_many_others_is_read_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.random.default_rng(0).integers(0, 9, (2, 5000, 4, 4), np.uint8)  # (z, t, y, x)
    monkeypatch.setattr(flat, "BLOCK_BYTES", 1000)
    np.save(tmp_path / "a.npy", values)
    with open_series(tmp_path / "a.npy", axes="z,t,y,x") as series:
        series._together = 1  # as for frames above the bound of a slab
        series.read(0)
        tracemalloc.start()
        np.testing.assert_array_equal(series.read(4000), values[:, 4000])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < values[0].nbytes
