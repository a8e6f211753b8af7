"""The native libraries: one of the codec, and one of networks."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec.native as codec_native
import fhash_formats.native as formats_native
from fhash_codec import native as codec_native_network
from fhash_codec.native import ABI_VERSION, network
from fhash_codec.native.network import (
    ABI_VERSION as ABI_VERSION_NETWORK,
)
from fhash_formats.native import pointer

SOURCES = Path(codec_native.__file__).parent


def test_it_is_a_library_of_its_own() -> None:
    library, other = codec_native.library(), formats_native.library()
    assert library is not None
    assert library is codec_native.library()
    assert library is not other
    assert library.fhash_codec_abi_version() == ABI_VERSION


def test_the_sources_and_the_loader_agree_on_the_abi() -> None:
    source = (SOURCES / "codec.cpp").read_text(encoding="utf-8")
    assert f"FHASH_CODEC_ABI = {ABI_VERSION};" in source


@pytest.mark.parametrize("room", [codec_native, network])
def test_every_function_of_the_header_is_in_the_library(room: Any) -> None:
    header = next(Path(room.__file__).parent.glob("*.h")).read_text(encoding="utf-8")
    names = re.findall(r"^FHASH_EXPORT \w+ (fhash_\w+)\(", header, re.MULTILINE)
    assert len(names) > 8
    for name in names:
        assert getattr(room.library(), name)


SOURCES_NETWORK = Path(network.__file__).parent


def test_it_is_a_library_of_its_own_network() -> None:
    library = network.library()
    assert library not in (codec_native_network.library(), formats_native.library())
    assert library.fhash_network_abi_version() == ABI_VERSION_NETWORK


def test_the_sources_and_the_loader_agree_on_the_abi_network() -> None:
    source = (SOURCES_NETWORK / "network.cpp").read_text(encoding="utf-8")
    assert f"FHASH_NETWORK_ABI = {ABI_VERSION_NETWORK};" in source


def test_arithmetic_runs_on_the_paths_of_the_machine_alone() -> None:
    library = network.library()
    paths = library.fhash_network_paths()
    assert paths & 1
    lanes = {1: 4, 2: 8, 4: 16}
    for path in (0, 1, 2, 3, 4, 8):
        done = library.fhash_network_fma(path, 5)
        if path in lanes and path & paths:
            assert done == 5 * 2 * 12 * lanes[path]
        else:
            assert done == -3


def test_copies_count_what_is_read_and_what_is_written() -> None:
    library = network.library()
    source, copy = np.arange(100, dtype=np.float32), np.zeros(100, np.float32)
    assert library.fhash_network_copy(pointer(copy), pointer(source), 400) == 800
    np.testing.assert_array_equal(copy, source)
