"""The prior: it is read-only, and its file and its table are read alike on every machine."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from fhash_formats.transform.entropy import prior
from fhash_formats.transform.entropy.coder import decode_block, encode_block
from fhash_formats.transform.entropy.prior import State, blank_state, unpack_state

SHAPE = (3, 3, 20, 30)


def make() -> NDArray[np.int32]:
    """Integers of all magnitudes, in rows that differ."""
    random = np.random.default_rng(0)
    scale = np.exp2(random.uniform(-6, 14, (*SHAPE[:-1], 1)))
    return np.rint(random.standard_normal(SHAPE) * scale).astype(np.int32)


def test_the_prior_stays_as_it_is() -> None:
    integers = make()
    before = prior.prior_state(False).copy()
    first = encode_block(integers)
    assert encode_block(integers) == first
    decode_block(first, integers.shape)
    assert all(
        (left == right).all()
        for left, right in zip(
            vars(before).values(), vars(prior.prior_state(False)).values(), strict=True
        )
    )


def test_a_file_has_a_byte_for_each_number() -> None:
    blank = State.even(slots=3, weights=[(2, 100)], simples=2)
    numbers = bytes([0, 22, 43]) + bytes([1, 0]) + bytes([2, 256 - 3])
    state = unpack_state(zlib.compress(numbers), blank)
    assert state.slots.tolist() == [
        [32768, 32768, 0, 0],
        [32768, 32768, 12, 0],
        [65534, 65534, 12, 0],
    ]
    assert state.simples.tolist() == [[2, 12], [32768, 0]]
    assert state.weights.tolist() == [100 + 2 * 512, 100 - 3 * 512]
    assert not (blank.slots[:, 2]).any()


def test_the_prior_says_something_of_each_kind_of_number() -> None:
    blank, state = blank_state(), prior.prior_state(False)
    for name in ("slots", "weights", "simples"):
        shares = getattr(blank, name) != getattr(state, name)
        assert 0.05 < shares.mean() < 0.9, name
    squares = state.weights[-2 * prior.KINDS * prior.SIGN_INPUTS :].reshape(prior.KINDS, 2, -1)
    assert squares[:, 1].min() >= 1


def test_weights_of_the_prior_are_within_16_bits() -> None:
    weights = prior.prior_state(False).weights
    assert weights.min() >= -32767
    assert weights.max() <= 32767


def test_both_quantisers_begin_alike() -> None:
    contexts = sum(prior.SIZES) * prior.DECISIONS
    for trellis in (False, True):
        state = prior.prior_state(trellis)
        slots = state.slots[:contexts].reshape(-1, prior.DECISIONS, 4)
        assert (slots[:, 14:] == slots[:, :2]).all() == trellis
        assert state.slots.flags.writeable is False


def test_the_probabilities_do_not_depend_on_the_c_library() -> None:
    values = 65536 / (1 + np.exp(-(np.arange(1, 44) - 22) / 2)) + 0.5
    near = np.abs(values - np.rint(values))
    near[21] = 1  # even odds are exact
    assert near.min() > 1e-3
    assert np.array_equal(prior._PROBABILITIES[1:], np.floor(values))
