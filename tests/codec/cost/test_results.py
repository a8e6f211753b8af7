"""Records of costs as JSON values."""

from __future__ import annotations

import json
from dataclasses import fields

from fhash_codec.cost.results import CostReport


def test_a_report_is_json_with_every_field(report: CostReport) -> None:
    values = json.loads(json.dumps(report.to_dict()))
    assert list(values) == [field.name for field in fields(CostReport)]
    assert [entry["measured"] for entry in values["encodings"]] == [True, True, False]
    assert values["pictures"][0]["counters"]["secondary_rays"] == 0
