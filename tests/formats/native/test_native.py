"""The loader of the native library: what it takes, and what it refuses."""

from __future__ import annotations

import ctypes
import re
import shutil
from pathlib import Path

import pytest
from reference import kernels

from fhash_formats import native
from fhash_formats.errors import MissingDependencyError
from fhash_formats.native import ABI_VERSION, PROTOTYPES, load_library

SOURCES = Path(native.__file__).parent


@pytest.fixture
def built_copy(tmp_path: Path) -> Path:
    """A folder with a copy of the native library."""
    shutil.copy(SOURCES / "libfhash.so", tmp_path)
    return tmp_path


def test_a_folder_without_a_build_is_a_plain_error(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match="there is no native library"):
        load_library(tmp_path, "libfhash", ABI_VERSION, PROTOTYPES)


def test_a_damaged_library_is_a_plain_error(tmp_path: Path) -> None:
    (tmp_path / "libfhash.so").write_bytes(b"not a library")
    with pytest.raises(MissingDependencyError, match="install the package again"):
        load_library(tmp_path, "libfhash", ABI_VERSION, PROTOTYPES)


def test_a_library_of_other_sources_is_a_plain_error(built_copy: Path) -> None:
    assert load_library(built_copy, "libfhash", ABI_VERSION, PROTOTYPES) is not None
    message = f"has ABI {ABI_VERSION}, this version of the package needs {ABI_VERSION + 1}"
    with pytest.raises(MissingDependencyError, match=message):
        load_library(built_copy, "libfhash", ABI_VERSION + 1, PROTOTYPES)


@pytest.mark.parametrize(
    ("prototypes", "version_symbol"),
    [({"fhash_nothing": ()}, "fhash_abi_version"), (PROTOTYPES, "fhash_nothing")],
)
def test_a_library_that_lacks_a_function_is_a_plain_error(
    built_copy: Path, prototypes: native.Prototypes, version_symbol: str
) -> None:
    with pytest.raises(MissingDependencyError, match=r"cannot be used .*fhash_nothing"):
        load_library(built_copy, "libfhash", ABI_VERSION, prototypes, version_symbol=version_symbol)


def test_the_sources_and_the_loader_agree_on_the_abi() -> None:
    assert f"FHASH_ABI = {ABI_VERSION};" in (SOURCES / "core.hpp").read_text(encoding="utf-8")


LISTS = re.compile(r"#define (FHASH_\w+) +\\\n((?:.*\\\n)*.*)\n")
"""Macros of C++ that stand for some arguments of functions."""


def test_the_prototypes_take_as_many_arguments_as_the_sources() -> None:
    exported = re.compile(r"FHASH_(?:EXPORT|KERNEL) \S+ (fhash_\w+)\(([^)]*)\)")
    checked, known = 0, {**PROTOTYPES, **kernels.PROTOTYPES}
    for source in SOURCES.glob("*.cpp"):
        text = source.read_text(encoding="utf-8")
        for macro, meaning in LISTS.findall(text):  # lists of arguments with a name
            text = text.replace(f" {macro}", meaning.replace("\\\n", " "))
        for name, arguments in exported.findall(text):
            if name in known:
                checked += 1
                types = [
                    "*" if "*" in argument else argument.split()[0].removeprefix("std::")
                    for argument in arguments.split(",")
                ]
                names = {
                    native.ARRAY: "*",
                    native.INTEGER: "int64_t",
                    native.REAL: "double",
                    native.FLOAT: "float",
                    ctypes.c_int32: "int32_t",
                    ctypes.c_size_t: "size_t",
                }
                assert types == [names[kind] for kind in known[name]], name
    assert checked >= 16
