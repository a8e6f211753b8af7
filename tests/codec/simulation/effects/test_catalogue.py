"""The catalogue: every effect, its settings, and messages for those that are wrong."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest

from fhash_codec.simulation.effects.catalogue import EFFECTS, effect_of
from fhash_codec.simulation.effects.vortex import Vortex
from fhash_formats.errors import InputError

DOCUMENT = Path(__file__).resolve().parents[4] / "docs" / "scenes.md"
NAMED = "advection vortex rotation front fingers diffusion turbulence buoyancy shell blob"


def test_all_effects_are_there_and_off_by_strength() -> None:
    assert set(EFFECTS) == set(NAMED.split())
    for kind, effect in EFFECTS.items():
        assert effect.role in ("flow", "body", "bend", "spread")
        assert not effect_of({"effect": kind}, 1).idle
        assert effect_of({"effect": kind, "strength": 0}, 1).idle == "its strength is 0"


def test_settings_have_help_and_limits() -> None:
    for effect in EFFECTS.values():
        for setting in dataclasses.fields(effect):
            assert setting.metadata["help"]
            assert setting.metadata["choices"] or setting.metadata["high"] is not None


def documented() -> dict[str, dict[str, tuple[str, str, str]]]:
    """Rows of the tables in the document, by effect and setting: default, range, meaning."""
    tables = {}
    for section in DOCUMENT.read_text(encoding="utf-8").split("\n### ")[1:]:
        rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|$", section, re.M)
        tables[section.split("`")[1]] = {name: (*rest,) for name, *rest in rows}
    return tables


def text_of(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value)
    return value if isinstance(value, str) else f"{value:g}"


def test_the_document_has_every_setting_with_its_default_and_range() -> None:
    expected = {
        kind: {
            setting.name: (
                text_of(setting.default),
                ", ".join(setting.metadata["choices"])
                or f"{setting.metadata['low']:g} to {setting.metadata['high']:g}",
                setting.metadata["help"],
            )
            for setting in dataclasses.fields(effect)
        }
        for kind, effect in EFFECTS.items()
    }
    assert documented() == expected


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"effect": "vortx"}, "effect 3 is 'vortx'; did you mean 'vortex'"),
        ({"effect": "vortex", "speed": 1}, "effect 3, vortex: unknown setting 'speed'"),
        ({"effect": "vortex", "strength": "fast"}, "strength is 'fast'; a number from -1000"),
        ({"effect": "vortex", "strength": 1001}, "strength is 1001; allowed: -1000 to 1000"),
        ({"effect": "vortex", "axis": "w"}, "axis is 'w'; allowed: z, y, x"),
        ({"effect": "vortex", "centre": [0, 1]}, "a list of 3"),
        ({"effect": "blob", "strength": float("nan")}, "strength is nan"),
        ({"strength": 1}, 'effect 3 has no name; write effect = "NAME"'),
        (7, "effect 3 is 7; a table of settings is needed"),
        ({"effect": ["a"]}, "effect 3 has no name"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(table: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as error:
        effect_of(table, 3)
    assert "\n" not in str(error.value)


def test_limits_are_allowed_on_both_sides() -> None:
    for edge in (-1e3, 1e3):
        assert effect_of({"effect": "vortex", "strength": edge}, 1) == Vortex(strength=edge)
