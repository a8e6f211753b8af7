"""Settings of tiles: as JSON and back, and the values that are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
from tiles import SETTINGS

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.settings import TileSettings


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"double": True, "offsets": (-5, -1, 0)},
        {"mask": MaskLevels(), "quantum": 0.0},
        {"clip": True},
        {"trellis": True, "offsets": (-5, -1, 0, 0, 1, -128)},
        {"trellis": True, "offsets": (0,) * 6},
    ],
)
def test_settings_come_back_from_json(changes: dict[str, Any]) -> None:
    settings = replace(SETTINGS, **changes)
    again = TileSettings.from_dict(json.loads(json.dumps(settings.to_dict())))
    assert again == settings


def test_defaults_are_left_out_of_json() -> None:
    settings = replace(SETTINGS, quantum=0.0)
    assert set(settings.to_dict()) == {"transform", "step", "center", "range"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": 0.0}, "do not fit together"),
        ({"step": 1e-300}, "not for float32"),
        ({"low": 4.0}, "do not fit together"),
        ({"quantum": -1.0}, "do not fit together"),
        ({"center": float("nan")}, "center is nan"),
        ({"step": True}, "step is True"),
        ({"offsets": (0, 0)}, "three whole numbers"),
        ({"offsets": (0, 0, 129)}, "three whole numbers"),
        ({"offsets": (0,) * 6}, "three whole numbers"),
        ({"trellis": True}, "six whole numbers"),
        ({"origin": 1.0}, "origin is 1.0; a 64-bit integer"),
        ({"origin": 1 << 64}, "a 64-bit integer is needed"),
        ({"high": 10**400}, "high is 1000"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(SETTINGS, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stepp": 1.0}, "unknown setting 'stepp'"),
        ({"range": [1.0]}, "range is"),
        ({"offsets": 3}, "offsets are three"),
        ({"double": 1}, "double is true or false"),
        ({"clip": None}, "clip is true or false"),
        ({"trellis": 1}, "trellis is true or false"),
        ({"head": "%"}, "not base64"),
    ],
)
def test_json_values_of_other_kinds_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, DamagedFileError), match=message):
        TileSettings.from_dict({**SETTINGS.to_dict(), **changes})


def test_a_missing_key_is_named() -> None:
    values = SETTINGS.to_dict()
    del values["center"]
    with pytest.raises(InputError, match="setting center is missing"):
        TileSettings.from_dict(values)
