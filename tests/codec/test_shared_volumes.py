"""Volumes are opened once for each state of a file, and closed after their last user."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cf_files import smooth

import fhash_codec
from fhash_codec import EncodeConfig, shared_volumes
from fhash_codec.shared_volumes import acquire, place_of, release, volumes_of
from fhash_formats.errors import InputError, MissingInputError

QUICK = EncodeConfig(effort=1, psnr=30, without=("ssim",))


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("shared") / "run.fhz"
    fhash_codec.encode(smooth(2, 4, 5, 6), path, QUICK)
    return path


def test_a_file_is_opened_once(run: Path) -> None:
    first, second = acquire(str(run)), acquire(str(run))
    assert first is second
    assert list(first.volumes) == ["values"]
    assert first.is_of_this_process()
    with volumes_of(str(run))["values"] as other:
        assert other is not first.volumes["values"]


def test_the_last_user_closes_it(run: Path) -> None:
    handle = acquire(str(run))
    volume = handle.volumes["values"]
    release(handle)
    volume.read(0)
    del handle
    with pytest.raises(InputError, match="closed"):
        volume.container.verify()


def test_another_state_of_the_file_is_another_volume(tmp_path: Path, run: Path) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(run.read_bytes())
    handle = acquire(str(path))
    assert acquire(str(path), None, handle.digest) is handle
    fhash_codec.encode(smooth(3, 4, 5, 6), path, QUICK, force=True)
    assert acquire(str(path)).volumes["values"].shape == (3, 4, 5, 6)
    with pytest.raises(InputError, match="another file"):
        acquire(str(path), None, handle.digest)


def test_few_files_stay_open(run: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shared_volumes, "KEPT", 2)
    for number in range(4):
        path = tmp_path / f"{number}.fhz"
        path.write_bytes(run.read_bytes())
        acquire(str(path))
    assert len(shared_volumes._kept) == 2
    assert len(shared_volumes._open) <= 3


def test_a_forked_process_opens_the_file_again(run: Path, monkeypatch) -> None:
    handle = acquire(str(run))
    parent = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: parent + 1)
    assert not handle.is_of_this_process()
    assert acquire(str(run)) is not handle


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        acquire(str(tmp_path / "none.fhz"))


def test_a_place_is_absolute_or_a_url() -> None:
    assert place_of("a.fhz") == os.path.join(os.getcwd(), "a.fhz")
    assert place_of("https://host/a.fhz") == "https://host/a.fhz"
