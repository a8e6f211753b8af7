"""Bytes and values that change from one repetition to another are seen."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import repeating

Broken = Callable[[Run, Check], set[str]]


@pytest.mark.parametrize("check", repeating.CHECKS)
def test_the_easy_case_keeps_every_property(run: Run, broken: Broken, check: Check) -> None:
    assert broken(run, check) == set()


@pytest.mark.parametrize("thorough", [False, True])
def test_bytes_that_depend_on_the_threads_are_seen(
    compact_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch, thorough: bool
) -> None:
    encode = repeating.encode
    counts = []

    def other(source: object, path: object, config: EncodeConfig, **rest: object) -> object:
        counts.append(int(os.environ["FHASH_THREADS"]))
        return encode(source, path, replace(config, seed=counts[-1]), **rest)

    monkeypatch.setattr(repeating, "encode", other)
    run = replace(compact_run, thorough=thorough)
    assert broken(run, repeating.same_bytes) == {"same bytes by other threads"}
    assert counts == [1, 2] if thorough else len(counts) == 1


def test_bytes_that_differ_are_counted(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abcd")
    assert repeating._count_unequal_bytes(b"abcd", tmp_path / "a") == 0
    assert repeating._count_unequal_bytes(b"abxd", tmp_path / "a") == 1
    assert repeating._count_unequal_bytes(b"axc", tmp_path / "a") == 2
