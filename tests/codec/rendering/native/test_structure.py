"""The structure of the native marcher is that of its header, field by field."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.rendering.native.structure import MAX_SURFACES, POWERS, TILE, March, numbers
from fhash_codec.rendering.task.bricks import SIDE

SOURCES = Path(native.__file__).parent


def constant(name: str, file: str) -> int:
    match = re.search(rf"\b{name} = (\d+)", (SOURCES / file).read_text(encoding="utf-8"))
    assert match is not None
    return int(match[1])


def test_the_fields_are_those_of_the_header_in_its_order() -> None:
    header = (SOURCES / "march.hpp").read_text(encoding="utf-8")
    body = header.split("struct FhashMarch {")[1].split("\n};")[0]
    declarations = re.sub(r"//.*", "", body).split(";")[:-1]
    names = [
        re.sub(r"\[.*|^.*[ *]", "", name.strip())
        for declaration in declarations
        for name in declaration.split(",")
    ]
    assert names == [name for name, _ in March._fields_]


def test_both_sides_have_the_same_constants() -> None:
    assert constant("FHASH_SURFACES", "march.hpp") == MAX_SURFACES
    assert constant("FHASH_POWERS", "march.hpp") == POWERS
    assert constant("FHASH_BRICK", "march.hpp") == SIDE
    assert constant("TILE", "march_packet.hpp") == TILE


def test_a_structure_keeps_its_arrays_and_refuses_those_of_another_type() -> None:
    structure = March(values=np.arange(1000, dtype=np.float32), depth=None, eye=numbers([1, 2, 3]))
    assert structure.values[999] == 999
    assert not structure.depth
    assert list(structure.eye) == [1.0, 2.0, 3.0]
    with pytest.raises(AssertionError, match="values is float64"):
        March(values=np.zeros(3))
    with pytest.raises(AssertionError, match="depth is not contiguous"):
        March(depth=np.zeros((4, 4), dtype=np.float32)[:, ::2])
