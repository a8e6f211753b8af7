"""Claims about training, answered from made cells: each verdict follows the curves."""

from __future__ import annotations

from dataclasses import replace

from made_cells import answer, cell

from fhash_codec.bench.paper.answer import CONFIRMED, NOT_REACHED, NOT_TESTABLE, REFUTED


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
