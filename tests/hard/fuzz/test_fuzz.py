"""The native code holds under the sanitizers for a few seconds of fuzzing.

`run.py` is for long runs. The quick set starts from every fifth seed, the long set from all.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import run
from reporting import LONG

SECONDS = 5.0
"""Seconds for which the fuzzer mutates inputs, after it has run all seeds."""
EVERY = 1 if LONG else 5
"""Every so many of the seeds of each target are run. 5 has no factor in common with the numbers of
seeds of one setup (2 and 3), so that all kinds of seeds take turns."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def test_the_native_code_under_sanitizers(folder: Path) -> None:
    try:
        figures = run.fuzz(
            folder,
            folder / "crashes",
            seconds=SECONDS,
            processes=1,
            every=EVERY,
            optimise="-O0",
        )
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert not figures.crashes, (
        figures.crashes[0].with_suffix(".txt").read_text(encoding="utf-8")[:4000]
    )
    # All seeds were run, which reach most of the code, and more inputs.
    assert figures.executions > len(list((folder / "corpus").iterdir()))
    assert figures.edges > 3000


def test_every_target_has_a_name_and_seeds(folder: Path) -> None:
    if not (folder / "corpus").exists():
        run.prepare(folder, EVERY)
    import seeds

    source = (run.HERE / "targets.cpp").read_text(encoding="utf-8")
    assert re.findall(r"targets = (\d+);", source) == [str(len(seeds.NAMES) - n) for n in (0, 1)]
    first = {path.read_bytes()[0] for path in (folder / "corpus").iterdir()}
    assert first == set(range(len(seeds.NAMES)))


def test_an_overrun_is_seen(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fuzzer that sees nothing would pass all other tests."""
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
        figures = run.fuzz(
            folder / "overrun", tmp_path / "crashes", seconds=2.0, processes=1, optimise="-O0"
        )
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert figures.crashes
    assert "heap-buffer-overflow" in figures.crashes[0].with_suffix(".txt").read_text(
        encoding="utf-8"
    )


def test_code_that_does_not_compile_is_no_reason_to_skip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a compiler without sanitizers is one: else a defect would stop the fuzzer for good."""
    broken = tmp_path / "broken.cpp"
    broken.write_text("int missing();\nint used = missing() +;\n", encoding="utf-8")
    monkeypatch.setattr(run, "SOURCES", ())
    monkeypatch.setattr(run, "CODEC_SOURCES", ())
    monkeypatch.setattr(run, "TARGETS", (broken,))
    try:
        with pytest.raises(RuntimeError, match=r"(?s)does not compile: .*broken\.cpp"):
            run.build(tmp_path / "built", optimise="-O0")
    except run.CannotBuild as error:
        pytest.skip(str(error))
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(run.CannotBuild, match="no compiler"):
        run.build(tmp_path / "built")
