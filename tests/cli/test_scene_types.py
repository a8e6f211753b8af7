"""Types of the options of a scene: what they read and what they refuse."""

from __future__ import annotations

from typing import Any

import click
import pytest

from fhash_cli.scene_types import NumbersType, OpacityType, PlaneType, SizeType


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (NumbersType(2), "1,2.5", (1.0, 2.5)),
        (SizeType(), "800x600", (800, 600)),
        (SizeType(), "64", (64, 64)),
        (OpacityType(), "linear", "linear"),
        (OpacityType(), "0:0,2:1", [[0.0, 0.0], [2.0, 1.0]]),
        (OpacityType(named=False), "0.1:1", [[0.1, 1.0]]),
        (PlaneType(), "0,0,1,0.5", {"normal": [0.0, 0.0, 1.0], "offset": 0.5}),
        (PlaneType(), "1,2,3,0,0,-1", {"point": [1.0, 2.0, 3.0], "normal": [0.0, 0.0, -1.0]}),
    ],
)
def test_texts_are_read(kind: click.ParamType[Any], text: str, value: Any) -> None:
    assert kind.convert(text, None, None) == value


@pytest.mark.parametrize(
    ("kind", "text", "part"),
    [
        (NumbersType(3), "1,2", "not 3 numbers"),
        (SizeType(), "wide", "not a size"),
        (OpacityType(), "0:a", "neither the name of an opacity nor points"),
        (OpacityType(named=False), "linear", "not points"),
        (PlaneType(), "0,0,1", "neither a normal and an offset"),
        (PlaneType(), "a,b,c,d", "neither a normal and an offset"),
    ],
)
def test_other_texts_are_refused(kind: click.ParamType[Any], text: str, part: str) -> None:
    with pytest.raises(click.BadParameter, match=part):
        kind.convert(text, None, None)
