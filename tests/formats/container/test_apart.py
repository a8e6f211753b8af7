"""Names of arrays in the codec of a table: put back by a reader, refused where they do not fit."""

from __future__ import annotations

import base64
import copy
from collections.abc import Callable
from typing import Any

import pytest
from table_files import HEAD, MASK, PLAIN

from fhash_formats.container.apart import (
    HEAD_ARRAY,
    MASK_ARRAY,
    TABLE,
    inline,
    with_settings,
)
from fhash_formats.container.coding import transform_codecs
from fhash_formats.container.sharding import sharding_codecs
from fhash_formats.errors import DamagedFileError

SETTINGS = {**PLAIN.to_dict(), "mask": MASK.to_dict()}


def documents(*, shards: bool) -> dict[str, dict[str, Any]]:
    """The documents of a table with both parts apart, as far as `inline` looks at them."""
    codec = {"name": "fhash.transform", "configuration": SETTINGS}
    places = {"head": {"array": HEAD_ARRAY}, "mask": {"array": MASK_ARRAY, **MASK.to_dict()}}
    codecs: Any = [*with_settings([codec], places), {"name": "crc32c"}]
    if shards:
        codecs = sharding_codecs([1, 2, 3, 4], codecs)
    return {
        TABLE: {"codecs": codecs, "shape": [1]},
        HEAD_ARRAY: {"codecs": [{"name": "fhash.head"}]},
        MASK_ARRAY: {"codecs": [{"name": "fhash.mask"}]},
        "other": {"codecs": transform_codecs(PLAIN)},
    }


@pytest.mark.parametrize("shards", [True, False])
def test_the_parts_come_back(shards: bool) -> None:
    given = documents(shards=shards)
    kept = copy.deepcopy(given)
    result = inline(given, lambda name: HEAD.to_bytes() if name == HEAD_ARRAY else b"")
    assert given == kept
    codecs = result[TABLE]["codecs"]
    inner = codecs[0]["configuration"]["codecs"] if shards else codecs
    assert inner[0]["configuration"] == {
        **SETTINGS,
        "head": base64.b64encode(HEAD.to_bytes()).decode("ascii"),
    }
    assert inner[1] == {"name": "crc32c"}
    assert {name: result[name] for name in result if name != TABLE} == {
        name: kept[name] for name in kept if name != TABLE
    }


def configuration(given: dict[str, Any]) -> dict[str, Any]:
    result: dict[str, Any] = given[TABLE]["codecs"][0]["configuration"]
    return result


WRONG: dict[str, Callable[[dict[str, Any]], object]] = {
    "mlp/other": lambda given: configuration(given).update(head={"array": "mlp/other"}),
    "mlp/parameters is no array": lambda given: given.pop(HEAD_ARRAY),
    "no array coded by fhash.mask": lambda given: given[MASK_ARRAY].update(
        codecs=transform_codecs(PLAIN)
    ),
    "names None as the place of its head": lambda given: configuration(given).pop("head"),
    "names None as the place of its mask": lambda given: configuration(given)["mask"].pop("array"),
    "other is coded by fhash.head": lambda given: given["other"].update(
        codecs=[{"name": "fhash.head"}]
    ),
    "other has no head": lambda given: given["other"].update(codecs=given[TABLE]["codecs"]),
    "names None": lambda given: given.pop(TABLE),
}


@pytest.mark.parametrize("message", WRONG)
def test_names_that_do_not_fit_are_damage(message: str) -> None:
    given = documents(shards=False)
    WRONG[message](given)
    with pytest.raises(DamagedFileError, match=message):
        inline(given, lambda _: HEAD.to_bytes())


@pytest.mark.parametrize(
    "codecs",
    [
        None,
        5,
        [],
        [3],
        [{"name": ["a"]}],
        [{"name": "fhash.transform"}],
        [{"name": "fhash.transform", "configuration": [1]}],
        [{"name": "fhash.transform", "configuration": {"head": 5, "mask": [1]}}],
        [{"name": "sharding_indexed", "configuration": {"codecs": 7}}],
        [{"name": "sharding_indexed", "configuration": {"codecs": [[1]]}}],
    ],
)
def test_codecs_of_any_form_are_left_to_their_own_checks(codecs: Any) -> None:
    given = {TABLE: {"codecs": codecs}, "other": {"codecs": codecs}}
    assert inline(given, lambda _: b"") == given
