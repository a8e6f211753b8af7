"""Records: checks of their fields, and their way to and from JSON."""

from __future__ import annotations

import json
from dataclasses import MISSING, FrozenInstanceError, dataclass
from pathlib import Path
from typing import Any

import pytest

from fhash_codec.records import Record, limits
from fhash_codec.rendering.scenes import Scene
from fhash_formats.errors import InputError, MissingInputError


@dataclass(frozen=True, kw_only=True)
class Lens(Record):
    """A record within another one."""

    kind: str = limits("wide", "kind of lens", choices=("wide", "long"))
    length: float = limits(35.0, "millimetres", low=1, high=1000)


@dataclass(frozen=True, kw_only=True)
class Shot(Record):
    """A record of every type of field."""

    count: int = limits(MISSING, "number of shots", low=1, high=9)
    blur: bool = limits(False, "whether it is blurred")
    note: str | None = limits(None, "any text")
    place: tuple[float, float] | None = limits(None, "x and y", low=-1, high=1)
    tags: tuple[str, ...] = limits((), "words", choices=("near", "far"))
    name: str | tuple[tuple[float, str], ...] = limits("auto", "a name or points")
    lens: Lens | None = None


def test_fields_take_what_loses_nothing() -> None:
    shot = Shot.from_dict(
        {"count": 2, "place": [1, 0.5], "tags": ["far"], "lens": True, "name": [[1, "red"]]}
    )
    assert shot.place == (1.0, 0.5)
    assert isinstance(shot.place[0], float)
    assert shot.tags == ("far",)
    assert shot.lens == Lens()
    assert shot.name == ((1.0, "red"),)
    assert Shot.from_dict({"count": 2, "lens": False}).lens is None
    assert Shot.from_dict({"count": 2, "lens": {"length": 50}}).lens == Lens(length=50.0)


@pytest.mark.parametrize(
    "values",
    [
        {"count": 1},
        {"count": 9, "blur": True, "note": "", "place": [0, -1], "tags": ["near", "near"]},
        {"count": 3, "lens": {"kind": "long"}, "name": [[0.5, "a"], [2, "b"]]},
        {"count": 3, "lens": {}},
    ],
)
def test_a_record_comes_back_from_its_json(values: dict[str, Any]) -> None:
    shot = Shot.from_dict(values)
    assert Shot.from_dict(json.loads(json.dumps(shot.to_dict()))) == shot


def test_defaults_are_left_out() -> None:
    assert Shot(count=1, blur=False, tags=()).to_dict() == {"count": 1}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "count is missing; a whole number from 1 to 9 is needed: number of shots"),
        ({"count": 0}, "count is 0; allowed: 1 to 9"),
        ({"count": 1.0}, "^count is 1.0; a whole number from 1 to 9 is needed: number of shots$"),
        ({"count": True}, "count is True"),
        ({"count": 1, "blur": 1}, "blur is 1"),
        ({"count": 1, "place": [0]}, "place is"),
        ({"count": 1, "place": [0, 2]}, "place is 2; allowed: -1 to 1"),
        ({"count": 1, "place": [0, float("nan")]}, "place is"),
        ({"count": 1, "place": [0, 10**400]}, "place is"),
        ({"count": 1, "tags": "far"}, "tags is 'far'"),
        ({"count": 1, "tags": ["fra"]}, "allowed: near, far; did you mean 'far'"),
        ({"count": 1, "lens": 3}, "lens is 3"),
        ({"count": 1, "lens": {"lenght": 3}}, "of lens; did you mean 'length'"),
        (
            {"count": 1, "lens": {"length": "x"}},
            r"^lens\.length is 'x'; a number from 1 to 1000 is needed",
        ),
        ({"count": 1, "lens": {"length": 0}}, r"^lens\.length is 0; allowed: 1 to 1000"),
        ({"count": 1, "bulr": True}, "unknown setting 'bulr' of shot; did you mean 'blur'"),
        ({"count": 1, "\n": True}, r"unknown setting '\\n' of shot"),
        ([], "shot is .*; a table of settings is needed"),
    ],
)
def test_what_a_field_may_not_be_is_refused_in_one_line(values: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Shot.from_dict(values)
    assert "\n" not in str(caught.value)


def test_records_are_checked_when_they_are_made_and_do_not_change() -> None:
    with pytest.raises(InputError, match="allowed"):
        Lens(length=0.0)
    with pytest.raises(FrozenInstanceError):
        Lens().length = 3.0  # type: ignore[misc]


def test_files_are_toml_or_json(tmp_path: Path) -> None:
    toml, other = tmp_path / "a.TOML", tmp_path / "a.txt"
    toml.write_text('count = 2\n[lens]\nkind = "long"\n')
    other.write_text('{"count": 2, "lens": {"kind": "long"}}')
    assert Shot.read(toml, "a shot", "no shot") == Shot.read(other, "a shot", "no shot")
    with pytest.raises(MissingInputError, match=r"none\.toml: no shot"):
        Shot.read(tmp_path / "none.toml", "a shot", "no shot")
    other.write_text("{")
    with pytest.raises(InputError, match=r"a\.txt: not a shot"):
        Shot.read(other, "a shot", "no shot")
    other.write_text('{"count": 0}')
    with pytest.raises(InputError, match=r"a\.txt: count is 0"):
        Shot.read(other, "a shot", "no shot")


def test_bytes_are_no_record(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"a.h5: not a scene: it holds no text") as caught:
        Scene.load(tmp_path / "a.h5")
    assert "codec" not in str(caught.value)
