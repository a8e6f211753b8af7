"""The plan: cells that it asks for, each by another name where a setting differs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fhash_codec.bench.paper.plan import BenchPlan, requests_of
from fhash_formats.series import ArraySeries

QUICK = BenchPlan.quick(device="cpu")


def test_the_quick_plan_of_the_scenes() -> None:
    requests = list(requests_of(QUICK, QUICK.encodings, None, "data"))
    assert len(requests) == 3 * (3 * 5 + 1)  # the protocol released has one encoding
    assert len({request.filename for request in requests}) == len(requests)
    shapes = {request.data_set: request.settings["shape"] for request in requests}
    assert shapes == {
        "flame": [17, 7, 22, 25],
        "bubble": [31, 32, 16, 16],
        "shell": [17, 27, 27, 27],
    }
    keys = {request.data_set: request.settings["key_frames"] for request in requests}
    assert keys == {"flame": "auto:10", "bubble": "auto:9", "shell": "auto:10"}
    assert {request.feature for request in requests} == {"segmentation"}


def test_the_full_plan_has_the_papers_key_frames() -> None:
    plan = BenchPlan(device="cpu")
    requests = list(requests_of(plan, ("fhash",), None, "data"))
    assert len(requests) == 3 * 3 * 4 * 3
    epochs = {request.protocol: request.settings["epochs"] for request in requests}
    assert epochs == {"published": 60, "released": 120, "equal": 60, "best": 60}
    keys = {request.data_set: request.settings["key_frames"] for request in requests}
    assert keys == {"flame": "auto:10", "bubble": "auto:9", "shell": "auto:10"}


def test_latency_is_timed_once_for_each_published_encoding() -> None:
    requests = requests_of(replace(QUICK, seeds=2), ("fhash",), None, "data")
    timed = [request for request in requests if request.settings["latency"]]
    assert {(request.protocol, request.seed) for request in timed} == {("published", 1)}


@pytest.mark.parametrize(
    "changed", [{"epochs": 5}, {"key_frames": "0,2,4"}, {"picture_size": 64}, {"views": 2}]
)
def test_a_changed_setting_is_another_cell(series: ArraySeries, changed: dict) -> None:
    names = [
        {request.filename for request in requests_of(plan, ("fhash",), series, "blob")}
        for plan in (QUICK, replace(QUICK, **changed))
    ]
    assert names[0] != names[1]
    assert len(names[0]) == 4
