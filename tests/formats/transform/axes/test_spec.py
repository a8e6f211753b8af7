"""A transform's configuration: there and back, and everything that is refused."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.transform.axes.basis import Basis, fit_basis
from fhash_formats.transform.axes.spec import MAX_DEPTH, AxisTransform, TransformSpec

PLAIN: dict[str, Any] = {"t": ["haar", 2], "z": "none", "y": ["9/7", 4], "x": ["9/7", 4]}


def some_basis() -> Basis:
    columns = np.cumsum(np.random.default_rng(1).standard_normal((9, 50)), axis=0)
    return fit_basis(columns @ columns.T, 0.5)


def test_there_and_back() -> None:
    spec = TransformSpec.from_dict(PLAIN)
    assert spec.axes[0] == AxisTransform(kind="haar", depth=2)
    assert spec.to_dict() == PLAIN
    assert TransformSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


def test_a_basis_is_no_json() -> None:
    axis = AxisTransform(kind="klt", basis=some_basis())
    with pytest.raises(InputError, match="no JSON value"):
        axis.to_json()


@pytest.mark.parametrize(
    ("y", "x", "coupled"),
    [
        (["9/7", 3], ["9/7", 3], True),
        (["9/7", 3], ["9/7", 2], False),
        (["9/7", 3], ["5/3", 3], False),
        ("none", "none", False),
    ],
)
def test_the_plane_is_coupled_by_equal_wavelets(y: Any, x: Any, coupled: bool) -> None:
    assert TransformSpec.from_dict({**PLAIN, "y": y, "x": x}).coupled is coupled


@pytest.mark.parametrize(
    "value",
    [
        None,
        7,
        "dct",
        "9/7",
        "klt",
        "",
        [],
        ["9/7"],
        ["9/7", 0],
        ["9/7", -1],
        ["9/7", MAX_DEPTH + 1],
        ["9/7", 10**30],
        ["9/7", 2.0],
        ["9/7", True],
        ["9/7", "2"],
        ["none", 1],
        ["klt", 0],
        [["9/7"], 2],
        ["9/7", 2, 2],
        {},
        {"klt": 3},
        {"klt": ""},
        {"klt": "no base64!"},
        {"klt": "\u00e4"},
        {"klt": "AAAA"},
        {"klt": "A" * (1 << 22)},
        {"klt": base64.b64encode(b"\xff\xff\xff\xff" + bytes(100)).decode()},
        {"klt": base64.b64encode(b"\x04\x00\x02\x00").decode()},
        {"klt": "AAAA", "more": 1},
    ],
)
@pytest.mark.parametrize("key", ["t", "x"])
def test_a_bad_value_is_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"key '{key}'") as caught:
        TransformSpec.from_dict({**PLAIN, key: value})
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({**PLAIN, "w": "none"}, "unknown key 'w'"),
        ({key: PLAIN[key] for key in "tzy"}, "missing key 'x'"),
        ({}, "missing key 't'"),
        ([1, 2], "a mapping"),
        (None, "a mapping"),
        (dict[Any, Any](PLAIN) | {3: "none"}, "unknown key 3"),
    ],
)
def test_a_bad_set_of_keys_is_refused(values: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TransformSpec.from_dict(values)


def test_axes_hold_what_they_need() -> None:
    with pytest.raises(InputError, match="needs a basis"):
        AxisTransform(kind="klt")
    with pytest.raises(InputError, match="nothing else"):
        AxisTransform(kind="none", basis=some_basis())
    with pytest.raises(InputError, match="four axes"):
        TransformSpec(axes=(AxisTransform(kind="none"),) * 3)  # type: ignore[arg-type]
