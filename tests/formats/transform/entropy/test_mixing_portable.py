"""The portable mixer: tables that are the same on every machine, and the range coder alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fhash_formats.transform.entropy.mixing_portable import (
    ARRAYS,
    LISTS,
    STRETCH_MAX,
    Stream,
    code_bit,
    finish,
    log16,
    start_range,
)


def before_rounding() -> dict[str, NDArray[np.float64]]:
    """The values that a table rounds down, as far as rounding can change the table."""
    p = (np.arange(65536) + 0.5) / 65536
    stretch = np.log(p / (1 - p)) * 256
    return {
        "stretch": stretch[np.abs(stretch) < STRETCH_MAX + 1] + 0.5,
        "squash": 65536 / (1 + np.exp(-np.arange(-STRETCH_MAX, STRETCH_MAX + 1) / 256)) + 0.5,
        "cost": -np.log2(np.arange(1, 65537) / 65536) * 2048 + 0.5,
        "log": np.log2(np.arange(1, 4096)) * 16 + 0.5,
    }


@pytest.mark.parametrize("name", ["stretch", "squash", "cost", "log"])
def test_no_table_depends_on_the_c_library(name: str) -> None:
    values = before_rounding()[name]
    assert np.abs(values - np.rint(values)).min() > 1e-9


def test_the_tables_are_those_values_rounded() -> None:
    rounded: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
        "squash": lambda v: np.clip(np.floor(v), 1, 65535),
        "cost": np.floor,
        "log": np.floor,
    }
    for name, rule in rounded.items():
        assert np.array_equal(
            getattr(ARRAYS, name)[-len(before_rounding()[name]) :],
            rule(before_rounding()[name]),
        )
    assert ARRAYS.stretch.min() == -ARRAYS.stretch.max() == -STRETCH_MAX


@pytest.mark.parametrize("p", [1, 700, 32768, 65535])
def test_the_range_coder_returns_the_bits_in_about_their_entropy(p: int) -> None:
    bits = (np.random.default_rng(p).random(3000) < p / 65536).astype(int).tolist()
    writer = Stream(False, [0] * 4, b"", [])
    start_range(writer)
    for bit in bits:
        code_bit(bit, p, writer)
    finish(writer)
    reader = Stream(True, [0] * 4, bytes(writer.out), [])
    start_range(reader)
    assert [code_bit(0, p, reader) for _ in bits] == bits
    entropy = sum(-np.log2(p / 65536 if bit else 1 - p / 65536) for bit in bits) / 8
    assert len(writer.out) <= 1.01 * entropy + 4


def test_the_logarithm_of_any_size_is_near() -> None:
    for number in (1, 2, 3, 4095, 4096, 70000, 2**31 - 1):
        assert abs(log16(number, LISTS.log) - 16 * np.log2(number)) < 1
