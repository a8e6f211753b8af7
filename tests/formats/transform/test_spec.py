"""The data's own basis: what it loses, its bytes, its bits, and damage to them."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fhash_formats.errors import DamagedFileError, FhashError, InputError
from fhash_formats.transform.spec import (
    MAX_DEPTH,
    MAX_EXPONENT,
    MAX_LENGTH,
    AxisTransform,
    Basis,
    TransformSpec,
    _dct,
    fit_basis,
)


def smooth(n: int, count: int = 400) -> NDArray[np.float64]:
    """Columns of random walks."""
    return np.cumsum(np.random.default_rng(n).standard_normal((n, count)), axis=0)


@pytest.mark.parametrize("n", [1, 2, 3, 8, 61, 200])
@pytest.mark.parametrize("step", [1e-3, 0.5, 8.0])
def test_analysis_and_synthesis_lose_less_than_the_step(n: int, step: float) -> None:
    columns = smooth(n)
    basis = fit_basis(columns @ columns.T, step)
    assert 0 < basis.rank <= n
    assert basis.synthesis.shape == (n, basis.rank)
    again = basis.synthesis.astype(np.float64) @ (basis.analysis @ columns)
    # Each dropped vector had a total amplitude below the step; each kept one is off by at most
    # about a step per entry.
    assert np.sum((again - columns) ** 2) < 2 * n * n * step**2
    assert np.allclose(basis.analysis @ basis.synthesis, np.eye(basis.rank), atol=1e-10)


def test_the_vectors_are_the_eigenvectors() -> None:
    columns = smooth(32)
    gram = columns @ columns.T
    synthesis = fit_basis(gram, 1e-6).synthesis
    first = np.linalg.eigh(gram)[1][:, ::-1][:, :4]
    assert np.allclose(np.abs(np.sum(synthesis[:, :4] * first, axis=0)), 1.0, atol=1e-3)
    assert np.allclose(np.sum(synthesis.astype(float) ** 2, axis=0), 1.0, atol=0.02)


def test_nothing_to_keep_is_a_basis_of_rank_0() -> None:
    basis = fit_basis(np.zeros((5, 5)), 1.0)
    assert basis.rank == 0
    assert Basis.from_bytes(basis.to_bytes(), 5) == basis
    assert basis.synthesis.shape == (5, 0)


@pytest.mark.parametrize("n", [1, 2, 17, 64])
@pytest.mark.parametrize("step", [0.1, 10.0])
def test_bytes_there_and_back(n: int, step: float) -> None:
    columns = smooth(n)
    basis = fit_basis(columns @ columns.T, step)
    again = Basis.from_bytes(basis.to_bytes(), n)
    assert again == basis
    assert hash(again) == hash(basis)
    assert again.synthesis.tobytes() == basis.synthesis.tobytes()


@pytest.mark.parametrize("n", [1, 2, 3, 5, 64, 127, MAX_LENGTH])
def test_the_cosines_are_those_of_the_library(n: int) -> None:
    rows = np.array(_dct(n))
    exact = [
        [
            math.cos(math.pi * (2 * i + 1) * k / (2 * n)) * math.sqrt((2 if k else 1) / n)
            for i in range(n)
        ]
        for k in range(n)
    ]
    assert np.allclose(rows, exact, rtol=0, atol=2e-14)


def test_every_cut_and_many_flips_end_in_an_error_or_a_basis() -> None:
    columns = smooth(12)
    packed = fit_basis(columns @ columns.T, 2.0).to_bytes()
    for end in range(min(len(packed), 12)):
        with pytest.raises(DamagedFileError):
            Basis.from_bytes(packed[:end], 12)
    for place in range(len(packed)):
        for bit in (0, 3, 7):
            broken = bytearray(packed)
            broken[place] ^= 1 << bit
            try:
                basis = Basis.from_bytes(bytes(broken), 12)
            except DamagedFileError:
                continue
            assert np.isfinite(basis.synthesis).all()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01\x00\x01",
        b"\x00\x00\x00\x00",
        b"\x03\x00\x04\x00" + bytes(9),
        b"\xff\xff\x01\x00" + bytes(9),
        b"\x03\x00\x00\x00more",
        b"\x03\x00\x02\x00" + bytes(40),
    ],
)
def test_hostile_headers(data: bytes) -> None:
    with pytest.raises(DamagedFileError):
        Basis.from_bytes(data)


def test_a_basis_for_another_length_is_refused() -> None:
    with pytest.raises(DamagedFileError, match="of length 5 where 6"):
        Basis.from_bytes(fit_basis(np.eye(5), 0.1).to_bytes(), 6)


@pytest.mark.parametrize(
    ("integers", "exponents"),
    [
        (np.zeros((1, 3), np.int32), (2,)),
        (np.ones((1, 3), np.int64), (2,)),
        (np.ones((1, 3), np.int32), (MAX_EXPONENT + 1,)),
        (np.ones((1, 3), np.int32), (-1,)),
        (np.ones((2, 3), np.int32), (2, 3)),
        (np.ones((1, 3), np.int32), ()),
        (np.ones((4, 3), np.int32), (1, 1, 1, 1)),
        (np.full((1, 3), 100, np.int32), (2,)),
        (np.full((1, 3), -(2**31), np.int32), (2,)),
        (np.ones((1, MAX_LENGTH + 1), np.int32), (2,)),
    ],
)
def test_impossible_bases_are_refused(
    integers: NDArray[np.int32], exponents: tuple[int, ...]
) -> None:
    with pytest.raises(InputError):
        Basis(integers=integers, exponents=exponents)


@pytest.mark.parametrize(
    ("gram", "step"),
    [
        (np.eye(3)[:2], 1.0),
        (np.full((2, 2), np.nan), 1.0),
        (np.eye(2), 0.0),
        (np.eye(2), math.inf),
        (np.zeros((0, 0)), 1.0),
        (np.zeros((513, 513)), 1.0),
    ],
)
def test_impossible_fits_are_refused(gram: NDArray[np.float64], step: float) -> None:
    with pytest.raises(InputError):
        fit_basis(gram, step)


def test_dependent_vectors_can_be_decoded_but_not_encoded_with() -> None:
    basis = Basis(integers=np.array([[2, 0, 0], [2, 0, 0]], np.int32), exponents=(2, 2))
    assert basis.synthesis.shape == (3, 2)
    with pytest.raises(FhashError, match="depend on each other"):
        _ = basis.analysis


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
