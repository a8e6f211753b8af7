"""Verdicts on values, and values as text."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from made_cells import BETWEEN, LATENCY, answer, cell, cells

from fhash_bench.paper.claims import (
    CONFIRMED,
    NOT_REACHED,
    NOT_TESTABLE,
    REFUTED,
    answers,
    claims_table,
    spread,
    verdict,
)
from fhash_bench.paper.files import FileResult


def test_the_median_decides() -> None:
    assert verdict([], 10, 1) == NOT_TESTABLE
    assert verdict([1.0, 10.0, 12.0], 10, 1) == CONFIRMED
    assert verdict([1.0, 9.9, 12.0], 10, 1) == NOT_REACHED
    assert verdict([0.9], 10, 1) == REFUTED


def test_a_spread_names_its_ends_where_they_differ() -> None:
    assert spread([], "x") == "-"
    assert spread([2.0], "x") == "2x"
    assert spread([3.0, 1.0, 12.345], " dB") == "3 dB (1 to 12.3)"


def test_every_claim_has_an_answer_even_without_cells() -> None:
    # Two claims are answered by the paper's own configurations.
    assert [each.verdict for each in answers([])].count(CONFIRMED) == 2
    assert {each.verdict for each in answers([])} == {CONFIRMED, NOT_TESTABLE}
    found = answers(cells())
    assert len({each.claim for each in found}) == 13
    assert len(found) == 13 + 4  # four of them in each of two protocols
    assert all(each.figures for each in found)


def test_buckets_and_parameters_are_those_of_the_design() -> None:
    found = answer("100 % of the buckets", cell(buckets_used=0.3))
    assert found.verdict == CONFIRMED
    assert "30 % of the embeddings" in found.figures
    dense = cell("dense", parameters={"tables": 300_000, "mlp": 10})
    found = answer("least number of parameters", cell(), dense)
    assert found.verdict == CONFIRMED
    assert "1.86x (1.25 to 2.88) those of F-Hash; a dense grid of the same box" in found.figures
    assert found.figures.endswith("0.75x")


def test_steps_between_key_frames() -> None:
    assert answer("critical changes", cell()).verdict == REFUTED
    steady = BETWEEN | {"missed_share": 0.0, "psnr_between": 49.5}
    assert answer("critical changes", cell(between=steady)).verdict == CONFIRMED
    drop = BETWEEN | {"missed_share": 0.0}
    assert answer("critical changes", cell(between=drop)).verdict == REFUTED


@pytest.mark.parametrize(
    ("protocol", "part", "linear"),
    [("equal", "psnr_between", 29.5), ("published", "psnr_inner", 31.5)],
)
def test_super_resolution_is_beside_the_interpolated_source(
    protocol: str, part: str, linear: float
) -> None:
    def found(value: float | None) -> str:
        made = cell("fhash", protocol, between=BETWEEN | {part: value})
        return answer("super-resolution", made).verdict

    assert found(linear + 3) == CONFIRMED
    assert found(linear + 0.5) == found(linear - 0.5) == NOT_REACHED
    assert found(linear - 3) == REFUTED
    assert found(None) == NOT_TESTABLE


def test_released_stands_beside_the_others_as_published() -> None:
    made = [cell("dense", "published"), cell("fhash", "published")]
    own = answer("converges", *made, cell("fhash", "released", rise=8.0), protocol="released")
    assert own.verdict == NOT_REACHED
    assert "of pictures: seconds 7x (6 to 8)" in own.figures


def test_pictures_through_encodings() -> None:
    found = answer("ARM", cell())
    assert found.verdict == CONFIRMED
    assert "1.5x in ms, 5x in passes" in found.figures
    found = answer("renders faster", cell(), cell("dense"))
    assert found.verdict == NOT_REACHED
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


def test_the_answers_as_a_table() -> None:
    table = claims_table(cells())
    assert [row[2] for row in table.rows] == [each.verdict for each in answers(cells())]


def test_speed_is_answered_by_protocol() -> None:
    slow = [cell(name, "published", rise=0.2) for name in ("dense", "hash")]
    made = [*slow, cell("fhash", "published"), cell("dense", rise=3.0), cell(rise=4.0)]
    published = answer("converges", *made, protocol="published")
    equal = answer("converges", *made, protocol="equal")
    assert (published.verdict, equal.verdict) == (CONFIRMED, NOT_REACHED)
    assert "of pictures: seconds 1.43x (1.2 to 1.5), epochs" in equal.figures
    assert "of the coreset: seconds 1.33x (1.25 to 1.4)" in equal.figures
    assert equal.figures.count("(0 that F-Hash alone reached)") == 2
    assert "(2 that F-Hash alone reached); of the coreset" in published.figures


def test_accuracy_turns_with_the_curves() -> None:
    assert answer("most accurate", cell(), cell("dense")).verdict == CONFIRMED
    assert answer("most accurate", cell(rise=0.5), cell("dense")).verdict == REFUTED
    assert answer("most accurate", cell(rise=1.02), cell("dense")).verdict == NOT_REACHED


def test_collisions_are_judged_at_the_end() -> None:
    made = [cell("hash", rise=2.5, collisions=0.9), cell("dense-multi", rise=2.0)]
    assert answer("Collisions", *made).verdict == REFUTED
    made = [cell("hash", rise=1.5, collisions=0.9), cell("dense-multi", rise=2.0)]
    found = answer("Collisions", *made)
    assert found.verdict == CONFIRMED
    assert "4 dB after 8 epochs, 20 dB at the end" in found.figures
    assert "90 %" in found.figures


def test_without_pictures_the_coreset_decides() -> None:
    made = [cell(), cell("dense", rise=0.2)]
    bare = [
        replace(each, curve=tuple(replace(point, picture_psnr=None) for point in each.curve))
        for each in made
    ]
    found = answer("converges", *bare)
    assert found.verdict == CONFIRMED
    assert "of pictures" not in found.figures


def test_encodings_that_are_missing_test_nothing() -> None:
    for words in ("converges", "most accurate", "Collisions"):
        assert answer(words, cell()).verdict == NOT_TESTABLE
