"""The table of bands: its columns are those of the native coder."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fhash_formats import native
from fhash_formats.transform.entropy import table
from fhash_formats.transform.entropy.table import HIGH, KIND, LOW, REFERENCES, single_band


def test_the_columns_are_those_of_the_native_coder() -> None:
    source = (Path(native.__file__).parent / "coder_contexts.hpp").read_text(encoding="utf-8")
    found = re.search(r"enum Column \{([^}]*)\}", source)
    assert found is not None
    columns = dict(re.findall(r"(\w+) = (\d+)", found[1]))
    columns |= dict(re.findall(r"(REFERENCE_\w+) = (\d+)", source))
    assert {"LOW", "HIGH", "KIND", "REFERENCES", "BAND", "SHIFT"} < columns.keys()
    assert columns == {name: str(getattr(table, name)) for name in columns}


def test_a_single_band_is_the_whole_shape_and_refers_to_none() -> None:
    row = single_band((2, 3, 5, 7))[0]
    assert row.dtype == np.int32
    assert len(row) == table.COLUMNS
    assert list(row[LOW:HIGH]) == [0, 0, 0, 0]
    assert list(row[HIGH:KIND]) == [2, 3, 5, 7]
    assert list(row[REFERENCES + table.BAND :: table.REFERENCE_COLUMNS]) == [-1] * 4
