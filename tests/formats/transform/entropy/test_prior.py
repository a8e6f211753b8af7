"""The prior: it is read-only, packing keeps it, and its table is the same on every machine."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fhash_formats.transform.entropy import prior
from fhash_formats.transform.entropy.coder import decode_block, encode_block, encode_integers
from fhash_formats.transform.entropy.prior import blank_state, pack_state, unpack_state
from fhash_formats.transform.entropy.table import single_band

SHAPE = (3, 3, 20, 30)


def make() -> NDArray[np.int32]:
    """Integers of all magnitudes, in rows that differ."""
    random = np.random.default_rng(0)
    scale = np.exp2(random.uniform(-6, 14, (*SHAPE[:-1], 1)))
    return np.rint(random.standard_normal(SHAPE) * scale).astype(np.int32)


def test_the_prior_stays_as_it_is() -> None:
    integers = make()
    before = prior.prior_state().copy()
    first = encode_block(integers)
    assert encode_block(integers) == first
    decode_block(first, integers.shape)
    assert all(
        (left == right).all()
        for left, right in zip(
            vars(before).values(), vars(prior.prior_state()).values(), strict=True
        )
    )


def test_a_packed_state_is_the_state() -> None:
    state = prior.prior_state().copy()
    encode_integers(make(), single_band(SHAPE), state=state)
    again = unpack_state(pack_state(state, blank_state()), blank_state())
    assert (again.weights == state.weights).all()
    assert (again.simples[:, 0] == state.simples[:, 0]).all()
    assert again.slots[:, 2].max() == again.simples[:, 1].max() == prior.TRUST
    seen = state.slots[:, 2] > 0
    assert (again.slots[~seen, 0] == 32768).all()
    exact = logit(state.slots[seen, 0].clip(2, 65534))
    off = np.abs(logit(again.slots[seen, 0]) - exact)
    assert off[np.abs(exact) < 10].max() < 1 / 12


def test_weights_of_the_prior_are_within_16_bits() -> None:
    weights = prior.prior_state().weights
    assert weights.min() >= -32767
    assert weights.max() <= 32767


def test_both_quantisers_begin_alike() -> None:
    contexts = sum(prior.SIZES) * prior.DECISIONS
    for trellis in (False, True):
        state = prior.prior_state(trellis)
        slots = state.slots[:contexts].reshape(-1, prior.DECISIONS, 4)
        assert (slots[:, 14:] == slots[:, :2]).all() == trellis
        assert state.slots.flags.writeable is False


def logit(p: NDArray[Any]) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.log(p / (65536.0 - p))
    return values


def test_the_probabilities_do_not_depend_on_the_c_library() -> None:
    values = 65536 / (1 + np.exp(-(np.arange(256) - 128) / 12)) + 0.5
    assert np.abs(values - np.rint(values)).min() > 1e-9
    assert np.array_equal(prior._PROBABILITIES, np.clip(np.floor(values), 1, 65535))
