"""The size of a model: resolutions of levels, and the number of parameters."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from readable_paper import FHash

from fhash_codec.paper import network as ranked
from fhash_codec.paper.model import decode_region, sample_points
from fhash_codec.paper.network import (
    Architecture,
    NumberType,
    RankedBits,
    SparseFrame,
    between,
    ceil_log,
    level_resolutions,
    parameter_count,
)
from fhash_formats.errors import DamagedFileError, InputError


@pytest.mark.parametrize(
    "settings", [{}, {"hidden_layers": 0, "embedding_size": 1}, {"hidden_layers": 3}]
)
def test_parameters_are_those_of_the_model(settings) -> None:
    architecture = Architecture.for_box((5, 9, 17), 4, width=16, **settings)
    size = architecture.embedding_size
    tables = [torch.zeros(t * z * y * x, size) for t, z, y, x in architecture.levels]
    layers = [(torch.zeros(o, i), torch.zeros(o)) for o, i in architecture.layer_shapes]
    model = FHash(architecture, tables, layers)
    assert sum(p.numel() for p in model.parameters()) == architecture.parameters
    assert architecture.parameters > parameter_count(architecture.levels, size)


@pytest.mark.parametrize("base", range(2, 12))
def test_ceil_log_is_exact_around_every_power(base):
    for exponent in range(1, 12):
        power = base**exponent
        assert (ceil_log(power, base), ceil_log(power + 1, base)) == (exponent, exponent + 1)
    assert ceil_log(1, base) == 0


@pytest.mark.parametrize("fold", [2, 3, 5])
@pytest.mark.parametrize(
    "box", [(1, 1, 1), (1, 7, 250), (128, 128, 128), (54, 110, 200), (2, 3, 4)]
)
@pytest.mark.parametrize("key_frames", [1, 2, 10, 600])
def test_levels_follow_the_papers_rule(fold, box, key_frames):
    levels = level_resolutions(box, key_frames, fold)
    assert levels[0] == (key_frames, *box)
    assert len(levels) == max(1, *(ceil_log(size, fold) for size in box))
    for finer, coarser in pairwise(levels):
        for before, after in zip(finer, coarser, strict=True):
            assert after == (1 if before == 1 else -(-before // fold) if before > fold else 2)


def test_a_network_whose_parts_do_not_fit_is_refused(networks) -> None:
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    weight, bias = net.layers[0]
    cases = [
        ({"tables": net.tables[:-1]}, "tables for"),
        ({"tables": [net.tables[1], *net.tables[1:]]}, "table of level 1 has shape"),
        ({"tables": [*net.tables[:2], net.tables[0]]}, "table of level 3 has shape"),
        ({"embedding_size": 3}, "table of level 1 has shape"),
        ({"key_frames": 0}, "at least 1"),
        ({"layers": net.layers[:1]}, "one output"),
        ({"layers": ()}, "one output"),
        ({"layers": ((weight[:, 1:], bias), net.layers[1])}, "layer 1 has weight"),
        ({"layers": ((weight, bias[1:]), net.layers[1])}, "layer 1 has weight"),
        ({"layers": (net.layers[0], net.layers[0])}, "layer 2 has weight"),
        ({"layers": ((weight * np.float32(np.nan), bias), net.layers[1])}, "not finite"),
    ]
    for change, message in cases:
        with pytest.raises(InputError, match=message):
            replace(net, **change)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_table_that_is_not_finite_is_refused_not_decoded(networks, bad) -> None:
    """Messages count levels from 1, as the arrays of the file do."""
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    net.tables[1].values[0, 0, 0, 0, 1] = bad
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        decode_region(net, 0, networks.box(net))
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        sample_points(net, 0, 0, 0, 0)


def test_unsigned_numbers_span_the_range_and_zero() -> None:
    values = np.array([2.0, 5.0], np.float32)
    kind = NumberType.of(values, "uint8")
    assert (kind.offset, kind.scale) == (0.0, 5.0 / 255)
    assert kind.stored(values).tolist() == [102, 255]
    assert kind.attributes == {"offset": 0.0, "scale": 5.0 / 255}


SHAPE = (5, 7, 13)


def mask_of(share: float, shape: tuple[int, ...] = SHAPE, seed: int = 0) -> npt.NDArray[np.bool_]:
    return np.random.default_rng(seed).random(shape) < share


def frame_of(
    share: float, dtype: str = "float32", seed: int = 0
) -> tuple[SparseFrame, npt.NDArray[np.floating[Any]]]:
    """A sparse frame and the same embeddings with 0 at the vertices that it does not hold."""
    mask = mask_of(share, seed=seed)
    held = np.random.default_rng(seed).normal(size=(int(mask.sum()), 3)).astype(dtype)
    dense = np.zeros((*SHAPE, 3), dtype)
    dense[mask] = held
    return SparseFrame.of(mask, held), dense


def bits_of(mask: npt.NDArray[np.bool_]) -> RankedBits:
    return RankedBits.of_octets(np.packbits(mask, bitorder="little"))


@pytest.mark.parametrize("size", [1, 63, 64, 65, 255, 256, 257, 1000, 4096])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 1.0])
def test_a_rank_is_the_number_of_ones_before(size: int, share: float) -> None:
    mask = mask_of(share, (size,))
    bits = bits_of(mask)
    expected = np.where(mask, np.cumsum(mask) - 1, mask.sum())
    np.testing.assert_array_equal(bits.lookup(np.arange(size)), expected)
    np.testing.assert_array_equal(bits.positions(), np.flatnonzero(mask))
    assert bits.count == mask.sum()


def test_more_ones_than_a_count_holds_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranked, "MAX_COUNT", 99)
    with pytest.raises(InputError, match="needs 100 vertices at one time; at most 99"):
        bits_of(np.ones(100, np.bool_))


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_a_frame_between_two_has_the_bits_of_dense_ones(dtype: str) -> None:
    (before, dense_before), (after, dense_after) = (
        frame_of(share, dtype, seed) for share, seed in ((0.2, 3), (0.3, 4))
    )
    weight = np.float32(0.3)
    mixed = between(before, after, weight)
    dense = dense_before * np.float32(1 - weight) + dense_after * weight
    whole = tuple(slice(0, n) for n in SHAPE)
    np.testing.assert_array_equal(mixed.read(whole), dense)
    assert mixed.values.dtype == np.float32
    assert mixed.bits.count < before.bits.count + after.bits.count
