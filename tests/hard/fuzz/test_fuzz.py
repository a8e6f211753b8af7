"""The native decoders hold under the sanitizers for a few seconds of fuzzing; `run.py` is for long runs."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import run

SECONDS = 5.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def test_the_native_decoders_under_sanitizers(folder):
    try:
        found = run.fuzz(folder, folder / "crashes", seconds=SECONDS, processes=1, optimise="-O0")
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert not found.crashes, (
        found.crashes[0].with_suffix(".txt").read_text(encoding="utf-8")[:4000]
    )
    # All seeds, which reach most of what there is, and more.
    assert found.executions > len(list((folder / "corpus").iterdir()))
    assert found.edges > 3000


def test_an_overrun_is_found(folder, tmp_path, monkeypatch):
    """Or a fuzzer that is blind would pass."""
    source = (run.NATIVE / "quantise.cpp").read_text(encoding="utf-8")
    loop = "for (std::int64_t i = 0; i < count; i++) {\n        const std::int32_t q"
    assert source.count(loop) == 1
    (tmp_path / "quantise.cpp").write_text(
        source.replace(loop, loop.replace("i < count", "i <= count")), encoding="utf-8"
    )
    (tmp_path / "core.hpp").write_text(
        (run.NATIVE / "core.hpp").read_text(encoding="utf-8"), encoding="utf-8"
    )
    monkeypatch.setattr(run, "NATIVE", tmp_path)
    monkeypatch.setattr(run, "SOURCES", ("quantise",))
    monkeypatch.setattr(run, "CODEC_SOURCES", ())
    monkeypatch.setattr(run, "TARGETS", (run.HERE / "overrun.cpp",))
    try:
        found = run.fuzz(
            folder / "overrun", tmp_path / "crashes", seconds=2.0, processes=1, optimise="-O0"
        )
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert found.crashes
    assert "heap-buffer-overflow" in found.crashes[0].with_suffix(".txt").read_text(
        encoding="utf-8"
    )
