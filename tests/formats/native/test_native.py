"""The loader of the native library: what it takes, and what it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from fhash_formats import native
from fhash_formats.errors import MissingDependencyError
from fhash_formats.native import ABI_VERSION, ffi, load_library, pointer

SOURCES = Path(native.__file__).parent


@pytest.fixture
def built_copy(tmp_path: Path) -> Path:
    """A folder with a copy of the native library."""
    shutil.copy(SOURCES / "libfhash.so", tmp_path)
    return tmp_path


def test_a_folder_without_a_build_is_a_plain_error(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match="there is no native library"):
        load_library(tmp_path, "libfhash", ABI_VERSION, ffi)


def test_a_damaged_library_is_a_plain_error(tmp_path: Path) -> None:
    (tmp_path / "libfhash.so").write_bytes(b"not a library")
    with pytest.raises(MissingDependencyError, match="install the package again"):
        load_library(tmp_path, "libfhash", ABI_VERSION, ffi)


def test_a_library_of_other_sources_is_a_plain_error(built_copy: Path) -> None:
    assert load_library(built_copy, "libfhash", ABI_VERSION, ffi) is not None
    message = f"has ABI {ABI_VERSION}, this version of the package needs {ABI_VERSION + 1}"
    with pytest.raises(MissingDependencyError, match=message):
        load_library(built_copy, "libfhash", ABI_VERSION + 1, ffi)


def test_a_library_that_lacks_its_version_is_a_plain_error(built_copy: Path) -> None:
    with pytest.raises(MissingDependencyError, match=r"cannot be used .*fhash_nothing"):
        load_library(built_copy, "libfhash", ABI_VERSION, ffi, version_symbol="fhash_nothing")


def test_the_sources_and_the_loader_agree_on_the_abi() -> None:
    assert f"FHASH_ABI = {ABI_VERSION};" in (SOURCES / "core.hpp").read_text(encoding="utf-8")


def test_every_function_of_the_headers_is_in_the_library() -> None:
    library = load_library(SOURCES, "libfhash", ABI_VERSION, ffi)
    names = [name for name in ffi.list_types()[0] if ffi.typeof(f"{name} *").kind == "function"]
    assert len(names) > 50
    for name in names:
        assert getattr(library, name)


def test_a_pointer_has_the_type_of_its_array() -> None:
    values = np.arange(4.0)
    assert list(pointer(values)[0:4]) == [0.0, 1.0, 2.0, 3.0]
    assert pointer(None) == ffi.NULL
    with pytest.raises(ValueError, match="not C-contiguous"):
        pointer(values[::2])
    with pytest.raises(TypeError, match="must be a pointer to same type"):
        native.library().fhash_decode_block(ffi.NULL, 0, (1, 1, 1, 1), pointer(values))
