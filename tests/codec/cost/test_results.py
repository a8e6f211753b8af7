"""The recommendation: the best of what was measured, and nothing that was predicted."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest

from fhash_codec.cost.results import CostReport, Encoded, advise, bytes_text, told


def point(name: str, codec: str, seconds: float | None, size: int, psnr: float | None) -> Encoded:
    return Encoded(
        name=name, codec=codec, group=codec, seconds=seconds, bytes=size, psnr=psnr,
        exact=psnr is None,
    )  # fmt: skip


POINTS = [
    point("fast", "compact", 1.0, 2000, 46.0),
    point("small", "compact", 9.0, 1000, 45.0),
    point("peer", "SZ3", 0.1, 3000, 46.0),
    point("good", "compact", 5.0, 9000, 61.0),
    point("only predicted", "compact", None, 1, 99.0),
]


def test_smallest_and_fastest_of_what_reaches_an_accuracy() -> None:
    advice = advise(POINTS, (35.0, 45.0, 50.0, 60.0, 70.0))
    assert [(entry.psnr, entry.aim, entry.name) for entry in advice] == [
        (45.0, "smallest", "small"),
        (45.0, "fastest", "fast"),
        (45.0, "smallest peer", "peer"),
        (60.0, "smallest", "good"),
    ]


def test_exact_values_reach_every_accuracy() -> None:
    (entry,) = advise([point("exact", "compact", 2.0, 5000, None)], (40.0, 70.0))
    assert (entry.psnr, entry.reached) == (70.0, None)
    assert advise([POINTS[-1]]) == ()


def test_a_line_of_advice() -> None:
    (first, *_) = advise(POINTS[:1], (45.0,))
    assert told(first) == "45 dB: 1 s, 2 kB, the smallest: fast"


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (1234, "1.23 kB"), (99_000, "99 kB"), (999_600, "1 MB"), (5e9, "5 GB")],
)
def test_sizes_in_three_digits(count: float, text: str) -> None:
    assert bytes_text(count) == text


def test_a_report_is_json_with_every_field(report: CostReport) -> None:
    values = json.loads(json.dumps(report.to_dict()))
    assert list(values) == [field.name for field in fields(CostReport)]
    assert [entry["measured"] for entry in values["encodings"]] == [True, True, False]
    assert values["pictures"][0]["counters"]["secondary_rays"] == 0
