"""Claims answered from made cells: each verdict follows the figures, and turns with them."""

from __future__ import annotations

from typing import Any

import pytest
from made_cells import BETWEEN, LATENCY, answer, cell, cells

from fhash_codec.bench.paper.answer import CONFIRMED, NOT_TESTABLE, REFUTED
from fhash_codec.bench.paper.claims import answers, claims_table
from fhash_codec.bench.paper.ratios import FileResult


def test_every_claim_has_an_answer_even_without_cells() -> None:
    assert {each.verdict for each in answers([])} == {NOT_TESTABLE}
    found = answers(cells())
    assert len({each.claim for each in found}) == 13
    assert len(found) == 13 + 4  # four of them in each of two protocols
    assert all(each.figures for each in found)


@pytest.mark.parametrize(("used", "verdict"), [(0.3, REFUTED), (1.0, CONFIRMED)])
def test_buckets(used: float, verdict: str) -> None:
    assert answer("buckets", cell(buckets_used=used)).verdict == verdict


def test_steps_between_key_frames() -> None:
    assert answer("critical changes", cell()).verdict == REFUTED
    steady = BETWEEN | {"missed_share": 0.0, "psnr_between": 49.5}
    assert answer("critical changes", cell(between=steady)).verdict == CONFIRMED
    drop = BETWEEN | {"missed_share": 0.0}
    assert answer("critical changes", cell(between=drop)).verdict == REFUTED
    assert answer("super-resolution", cell()).verdict == REFUTED
    better = cell(between=BETWEEN | {"psnr_between": 33.0})
    assert answer("super-resolution", better).verdict == CONFIRMED
    assert answer("super-resolution", cell(between=None)).verdict == NOT_TESTABLE
    unknown = cell(between=BETWEEN | {"psnr_between": None, "missed_share": None})
    assert answer("super-resolution", unknown).verdict == NOT_TESTABLE


def test_pictures_through_encodings() -> None:
    found = answer("ARM", cell())
    assert found.verdict == CONFIRMED
    assert "1.5x in ms, 5x in passes" in found.figures
    found = answer("renders faster", cell(), cell("dense"))
    assert found.verdict == REFUTED
    assert "for F-Hash alone, as in the paper 2x" in found.figures
    fast: dict[str, Any] = {**LATENCY, "on": {**LATENCY["on"], "arm_ms": 50.0}}  # type: ignore[dict-item]
    assert answer("renders faster", cell(latency=fast), cell("dense")).verdict == CONFIRMED


def result(kind: str, bytes: int, **others: Any) -> FileResult:
    fields: dict[str, Any] = {
        "data_set": "bubble",
        "feature": "segmentation",
        "codec": kind,
        "kind": kind,
        "whole": kind != "paper",
        "bytes": bytes,
        "raw_bytes": 10**6,
        "psnr": 45.5,
        "reached": True,
        "seconds": None,
    }
    return FileResult(**{**fields, **others})


def test_files_beside_other_codecs() -> None:
    files = [result("paper", 9000), result("peer", 3000), result("compact", 1500)]
    files.append(result("coded", 3600))
    found = answer("compression", files=files)
    assert found.verdict == CONFIRMED
    assert "3x, with tables coded by the transform 1.2x; best peer / profile compact 2x" in (
        found.figures
    )
    small = [result("paper", 900), *files[1:]]
    assert answer("compression", files=small).verdict == REFUTED
    missed = [result("paper", 900, reached=False), *files[1:]]
    assert answer("compression", files=missed).verdict == NOT_TESTABLE


def test_shares_of_the_volume() -> None:
    assert answer("20 %", cell()).verdict == CONFIRMED
    assert answer("20 %", cell(coreset_share=0.3)).verdict == REFUTED


def test_the_answers_as_a_table() -> None:
    table = claims_table(cells())
    assert [row[2] for row in table.rows] == [each.verdict for each in answers(cells())]
