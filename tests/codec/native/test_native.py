"""The loader of the codec's native library, and what is left when one of the two is missing."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from exports import exported

import fhash_codec.native as codec_native
import fhash_formats.native as formats_native
from fhash_codec.measure.sums import range_and_sum
from fhash_codec.native import ABI_VERSION, PROTOTYPES
from fhash_formats.transform.numcodecs_codec import NumcodecsTransform

SOURCES = Path(codec_native.__file__).parent

needs_library = pytest.mark.skipif(
    codec_native.library() is None, reason="the native library was not built here"
)


def test_the_environment_switches_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_NATIVE", "0")
    assert codec_native.library() is None


@needs_library
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


@pytest.mark.filterwarnings("ignore::fhash_formats.errors.FhashWarning")
@pytest.mark.parametrize("missing", [codec_native, formats_native])
def test_figures_and_bytes_are_the_same_without_one_of_the_libraries(
    missing: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.sin(np.arange(256, dtype=np.float32)).reshape(4, 4, 4, 4)
    figures = range_and_sum(values)
    data = NumcodecsTransform(max_error=0.01).encode(values)
    monkeypatch.setattr(missing, "_FOLDER", tmp_path)
    assert missing.library() is None
    assert range_and_sum(values) == figures
    assert NumcodecsTransform(max_error=0.01).encode(values) == data
