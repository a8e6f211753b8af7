"""Tables of a report: rows as wide as their header, zeros shown."""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.cost.results import CostReport
from fhash_codec.cost.tables import tables


def test_rows_fit_their_headers(report: CostReport) -> None:
    made = {table.title.split(":")[0].split(",")[0]: table for table in tables(report)}
    assert all(len(row) == len(table.header) for table in made.values() for row in table.rows)
    assert {"Encodings", "Reads", "Pictures", "Left out", "Recommendation"} <= set(made)
    predicted = made["Encodings"].rows[2]
    assert predicted[1:3] == ("-", "9")


def test_an_effect_that_is_not_named_counts_zero(report: CostReport) -> None:
    pictures = next(table for table in tables(report) if table.title.startswith("Pictures"))
    row = dict(zip(pictures.header, pictures.rows[0], strict=True))
    assert row["setting"] == "nothing named"
    assert (row["gradients"], row["secondary rays"]) == ("0", "0")


def test_a_table_without_rows_is_left_out(report: CostReport) -> None:
    titles = [table.title for table in tables(replace(report, reads=(), left_out=()))]
    assert not any(title.startswith(("Reads", "Left out")) for title in titles)
