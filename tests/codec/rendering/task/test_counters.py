"""Counters of the work for a picture."""

from __future__ import annotations

import pytest

from fhash_codec.rendering.task.counters import COUNTERS, complete, rows


def test_counters_are_summed_in_one_order() -> None:
    total = complete({"samples": 3, "rays": 1}, {"samples": 4})
    assert list(total) == list(COUNTERS)
    assert total == {**dict.fromkeys(COUNTERS, 0), "rays": 1, "samples": 7}
    with pytest.raises(KeyError):
        complete({"photons": 1})


def test_every_counter_has_a_row() -> None:
    assert [name for name, _, _ in rows({})] == [name.replace("_", " ") for name in COUNTERS]
    assert ("secondary rays", "1,234", COUNTERS["secondary_rays"]) in rows({"secondary_rays": 1234})
