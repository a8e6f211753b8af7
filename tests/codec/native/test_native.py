"""The loader of the codec's native library, and what is left when one of the two is missing."""

from __future__ import annotations

from pathlib import Path

from exports import exported

import fhash_codec.native as codec_native
import fhash_formats.native as formats_native
from fhash_codec.native import ABI_VERSION, PROTOTYPES

SOURCES = Path(codec_native.__file__).parent


def test_it_is_a_library_of_its_own() -> None:
    library, other = codec_native.library(), formats_native.library()
    assert library is not None
    assert library is codec_native.library()
    assert library is not other
    assert library.fhash_codec_abi_version() == ABI_VERSION


def test_the_two_libraries_share_no_function() -> None:
    assert not PROTOTYPES.keys() & formats_native.PROTOTYPES.keys()


def test_the_sources_and_the_loader_agree_on_the_abi() -> None:
    source = (SOURCES / "codec.cpp").read_text(encoding="utf-8")
    assert f"FHASH_CODEC_ABI = {ABI_VERSION};" in source


def test_the_prototypes_take_the_arguments_of_the_sources() -> None:
    assert exported(SOURCES) == PROTOTYPES
