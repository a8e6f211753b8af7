"""Settings of tiles: as bytes and back, and the values that are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from heads import random_head
from predictors import predictor_of
from specs import spec_of
from tiles import SETTINGS, SHAPE

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.settings import TileSettings

CHANGES: list[dict[str, Any]] = [
    {},
    {"double": True, "offsets": (-5, -1, 0, 0, 0, 0)},
    {"mask": MaskLevels(), "quantum": 0.0},
    {"mask": MaskLevels(edges=(-1.5, 3.0), scores=(1, 0, 4095), others=(7, 8, 9), reach=64)},
    {"clip": True, "labels": True},
    {"trellis": True, "offsets": (-5, -1, 0, 0, 1, -127)},
    {"head": random_head((3, 4), cross=True)},
    {"predictor": predictor_of((1, 2, 2, 2), (0, 3, 1, 2), 1, step=0.25)},
    {"transform": spec_of(("klt", "none", "5/3", "klt"), (0, 0, 3, 0), SHAPE, 0.1)},
    {"origin": -(1 << 63), "low": -(1 << 62), "high": (1 << 62) + 1},
    {"origin": (1 << 64) - 1, "low": 0.0, "high": 5.0},
    {"low": -(1 << 63), "high": (1 << 63) - 1},
]


@pytest.mark.parametrize("changes", CHANGES)
def test_settings_come_back_from_bytes_and_text(changes: dict[str, Any]) -> None:
    settings = replace(SETTINGS, **changes)
    data = settings.to_bytes()
    again = TileSettings.from_bytes(data)
    assert again.to_bytes() == data
    assert TileSettings.from_text(settings.to_text()) is again
    if "head" not in changes:
        assert again == settings
    assert type(again.low) is (int if settings.origin or abs(settings.low) > 1 << 53 else float)


@pytest.mark.parametrize("changes", CHANGES)
def test_cut_and_longer_bytes_are_damage(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    for other in [*(data[:n] for n in range(0, len(data), 1 + len(data) // 97)), data + b"\0"]:
        with pytest.raises(DamagedFileError):
            TileSettings.from_bytes(other)


@pytest.mark.parametrize("changes", CHANGES)
def test_changed_bytes_are_damage_or_other_settings(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    random = np.random.default_rng(0)
    for at in [*range(60), *random.integers(0, len(data), 100).tolist()]:
        other = bytearray(data)
        other[at % len(data)] = int(random.integers(256))
        try:
            TileSettings.from_bytes(bytes(other))
        except DamagedFileError:
            continue


def test_ends_about_an_origin_are_whole() -> None:
    for ends in ({"low": 0.5, "high": 2.0}, {"low": 0, "high": 1 << 63}):
        with pytest.raises(InputError, match="about an origin"):
            replace(SETTINGS, origin=7, **ends).to_bytes()


@pytest.mark.parametrize("text", [None, 3, "%", "QUJD", "\u00e9"])
def test_text_that_holds_no_settings_is_damage(text: Any) -> None:
    with pytest.raises(DamagedFileError, match="settings"):
        TileSettings.from_text(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": 0.0}, "do not fit together"),
        ({"step": 1e-300}, "not for float32"),
        ({"low": 4.0}, "do not fit together"),
        ({"quantum": -1.0}, "do not fit together"),
        ({"center": float("nan")}, "center is nan"),
        ({"step": True}, "step is True"),
        ({"offsets": (0, 0, 0)}, "six whole numbers"),
        ({"offsets": (0, 0, 0, 0, 0, 128)}, "six whole numbers"),
        ({"origin": 1.0}, "origin is 1.0; a 64-bit integer"),
        ({"origin": 1 << 64}, "a 64-bit integer is needed"),
        ({"high": 10**400}, "high is 1000"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(SETTINGS, **changes)
