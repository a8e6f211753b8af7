"""Writing through HDF5: a failed write and Ctrl-C do no damage."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelled_region import DATA, labelled_region

from fhash_formats import save_region
from fhash_formats.writers.common.held_file import HeldFile


@pytest.mark.parametrize("suffix", [".h5", ".nc"])
def test_ctrl_c_inside_hdf5_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    # h5py swallows what is raised while it releases an object; without the delay the file that
    # remained had a hole.
    write, calls = HeldFile.write, []

    def interrupted(self: HeldFile, data: Any, /) -> int:
        calls.append(len(data))
        if len(calls) == 5:
            signal.raise_signal(signal.SIGINT)
        return write(self, data)

    def frames() -> Iterator[np.ndarray]:
        yield from DATA

    monkeypatch.setattr(HeldFile, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_region(tmp_path / f"out{suffix}", labelled_region(), frames())
    assert len(calls) >= 5
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_is_raised_once_it_is_safe(tmp_path: Path) -> None:
    with HeldFile(tmp_path / "a") as file:
        assert file.write(b"12345") == 5
        file.truncate("no length")  # type: ignore[arg-type]
        assert isinstance(file.failure, TypeError)
        assert file.write(b"678") == 3  # dropped, and said to be written
        with pytest.raises(TypeError), file.calling():
            pass
    assert (tmp_path / "a").read_bytes() == b"12345"


def test_the_first_failure_stands_for_its_consequences(tmp_path: Path) -> None:
    with HeldFile(tmp_path / "a") as file:
        file.failure = OSError("the disk is full")
        with pytest.raises(OSError, match="the disk is full"), file.calling():
            raise RuntimeError("a consequence")
