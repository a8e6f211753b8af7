"""The table of bands: its columns have the same numbers in Python and in C++."""

from __future__ import annotations

import re
from pathlib import Path

from fhash_formats import native
from fhash_formats.transform.entropy import table as bands
from fhash_formats.transform.entropy.table import COLUMNS, single_band


def test_integers_that_were_not_transformed_are_one_band() -> None:
    table = single_band((2, 3, 4, 5))
    assert table.shape == (1, COLUMNS)
    assert list(table[0, :9]) == [0, 0, 0, 0, 2, 3, 4, 5, 0]
    assert list(table[0, 9::5]) == [-1] * 4


def test_columns_have_the_same_numbers_in_the_native_coder() -> None:
    source = (Path(native.__file__).parent / "coder.cpp").read_text(encoding="utf-8")
    listed = re.search(r"enum Column \{(.*?)\}", source, flags=re.DOTALL)
    assert listed is not None
    columns = dict(re.findall(r"(\w+) = (\d+)", listed[1]))
    counts = dict(re.findall(r"(REFERENCE_COUNT|REFERENCE_COLUMNS) = (\d+)", source))
    assert columns.keys() == {"LOW", "HIGH", "KIND", "REFERENCES", "BAND", "SHIFT"}
    for name, number in (columns | counts).items():
        assert getattr(bands, name) == int(number), name
    assert bands.REFERENCES + bands.REFERENCE_COUNT * bands.REFERENCE_COLUMNS == COLUMNS
