"""Texts that fit: lengths, lines and fonts."""

from __future__ import annotations

import pytest

from fhash_codec.rendering.picture.lettering import (
    SMALLEST,
    Label,
    fitted,
    font_size,
    length,
    line_height,
    wrapped,
)

LONG = "sea_water_potential_temperature [degree_Celsius]"


@pytest.mark.parametrize("limit", [12.0, 40.0, 90.0, 150.0, 1000.0])
def test_lines_are_no_longer_than_their_limit_and_hold_every_letter(limit: float) -> None:
    lines = wrapped(LONG, 10, limit)
    assert all(length(line, 10) <= limit for line in lines)
    assert "".join(lines).replace(" ", "") == LONG.replace(" ", "")
    assert (len(lines) == 1) is (limit == 1000)


def test_lines_break_where_words_end() -> None:
    assert wrapped("density [kg/m3]", 10, 60) == ("density", "[kg/m3]")
    assert wrapped(LONG, 10, 60)[:2] == ("sea_water_", "potential_")
    assert wrapped("", 10, 50) == ("",)


def test_the_font_is_the_largest_that_fits() -> None:
    assert fitted([LONG], 20, 10_000) == 20
    size = fitted([LONG], 20, 240)
    assert length(LONG, size) <= 240 < length(LONG, size + 1)
    assert fitted([LONG], 20, 3) == SMALLEST


def test_larger_pictures_have_larger_letters() -> None:
    assert [font_size(side, side) for side in (64, 256, 1024)] == [9, 10, 20]
    assert font_size(2000, 256) == 10


def test_a_turned_label_is_as_high_as_it_was_wide() -> None:
    flat = Label(lines=("depth [m]", "down"), centre=(50, 60), size=12)
    wide, tall = flat.extent
    assert tall > 2 * line_height(12)
    assert Label(lines=flat.lines, centre=(50, 60), size=12, upright=True).extent == (tall, wide)
    left, top, right, bottom = flat.box
    assert ((left + right) / 2, (top + bottom) / 2) == (50, 60)
