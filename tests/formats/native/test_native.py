"""The loader of the native library: what it takes, what it refuses, how it is switched off."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

from fhash_formats import native
from fhash_formats.errors import MissingDependencyError

SOURCES = Path(native.__file__).parent


def test_the_environment_switches_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_NATIVE", "0")
    assert native.library() is None


def test_every_thread_gets_the_same_library() -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: native.library(), range(16)))
    assert all(library is found[0] for library in found)


def test_a_folder_without_a_build_has_no_library(tmp_path: Path) -> None:
    assert native._load(tmp_path) is None


def test_a_damaged_library_is_a_plain_error(tmp_path: Path) -> None:
    (tmp_path / f"_core{EXTENSION_SUFFIXES[0]}").write_bytes(b"not a library")
    with pytest.raises(MissingDependencyError, match="FHASH_NATIVE=0"):
        native._load(tmp_path)


@pytest.mark.skipif(native.library() is None, reason="the native library was not built here")
def test_a_library_of_other_sources_is_a_plain_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = next(
        path for suffix in EXTENSION_SUFFIXES if (path := SOURCES / f"_core{suffix}").is_file()
    )
    copy = tmp_path / built.name
    shutil.copy(built, copy)
    assert native._load(tmp_path) is not None
    monkeypatch.setattr(native, "ABI_VERSION", native.ABI_VERSION + 1)
    message = (
        f"has ABI {native.ABI_VERSION - 1}, this version of the package needs {native.ABI_VERSION}"
    )
    with pytest.raises(MissingDependencyError, match=message):
        native._load(tmp_path)


def test_the_sources_and_the_loader_agree_on_the_abi() -> None:
    assert f"FHASH_ABI = {native.ABI_VERSION};" in (SOURCES / "core.hpp").read_text(
        encoding="utf-8"
    )
