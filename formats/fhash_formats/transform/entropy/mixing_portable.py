"""Range coder and mixing of estimates for the portable coders.

This is the twin of native/range.hpp and native/mixing.hpp. The arithmetic is the same, step by
step, so the bytes are the same. The comments there give the reasons.

The same Python source runs in two ways. Where numba can be imported, it is compiled and a
`Sequence` is an int64 array. Elsewhere it is plain Python and a `Sequence` is a list, so that each
number is a Python integer: faster to read than numpy's, and without overflow. numba passes every
array of a NamedTuple one by one, so the functions called for each vertex take few of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.support.fork_lock import ForkLock
from fhash_formats.transform.entropy.prior import State

__all__ = [
    "ARRAYS",
    "LEARNING_RATE",
    "LISTS",
    "SLOW_LIMIT",
    "STRETCH_MAX",
    "Memory",
    "Sequence",
    "Stream",
    "Tables",
    "code_bit",
    "code_mixed",
    "code_simple",
    "compiled",
    "finish",
    "keep_memory",
    "learn",
    "learn_slots",
    "log16",
    "memory_of",
    "mix",
    "start_range",
    "stretched",
]

STRETCH_MAX = 2816
"""Largest logit, in 1/256: 11."""
SLOW_LIMIT = 400
"""Observations after which the slow rate of an estimate stays."""
FAST_LIMIT = 20
"""Observations after which the fast rate of an estimate stays."""
SIMPLE_LIMIT = 60
"""Observations after which the rate of a simple estimate stays."""
LEARNING_RATE = 6
"""Rate at which the mixing weights learn, in 1/16."""
ALL_TRUST = 13
"""Observations from which on an estimate is believed in full; fewer scale it down in 1/13."""

RANGE_LOW = 0
"""Entry of `Stream.span`: lower end of the range, 32 bits."""
RANGE_HIGH = 1
"""Entry of `Stream.span`: upper end of the range, 32 bits."""
VALUE = 2
"""Entry of `Stream.span`: the 32 bits that the decoder looks at."""
POSITION = 3
"""Entry of `Stream.span`: number of bytes that the decoder has read."""

Sequence = Any
"""A list of integers, or an int64 array where compiled."""


class Tables(NamedTuple):
    """Tabulated functions, as in `Tables` of mixing.hpp."""

    stretch: Sequence
    """Logit of a probability in 1/65536, in 1/256."""
    squash: Sequence
    """Probability in 1/65536 of a logit, from -STRETCH_MAX on."""
    cost: Sequence
    """Bits that a decision of a probability in 1/65536 takes, in 1/2048."""
    log: Sequence
    """16 log2 of a number below 4096."""
    rate: Sequence
    """Rate of an estimate by its number of observations, in 1/65536."""
    small: Sequence
    """Class of a magnitude below 38; `twelve` of coder.cpp."""


class Memory(NamedTuple):
    """Fields of a `State`, each as a sequence."""

    slow: Sequence
    fast: Sequence
    count: Sequence
    weights: Sequence
    chance: Sequence
    seen: Sequence


class Stream(NamedTuple):
    """Bytes that a run reads or writes.

    Attributes:
        decoding: whether the run decodes.
        span: state of the range coder, see RANGE_LOW, RANGE_HIGH, VALUE and POSITION.
        data: bytes to decode.
        out: list of the bytes that were encoded.
    """

    decoding: bool
    span: Sequence
    data: Sequence
    out: Sequence


def _tables() -> dict[str, npt.NDArray[np.int64]]:
    """The tables, the same on every machine: no value lies near a whole number before rounding.

    A test checks that distance.
    """
    p = (np.arange(65536) + 0.5) / 65536
    logits = np.arange(-STRETCH_MAX, STRETCH_MAX + 1)
    bounds = [3, 5, 7, 10, 15, 23, 37]
    tables = {
        "stretch": np.clip(np.floor(np.log(p / (1 - p)) * 256 + 0.5), -STRETCH_MAX, STRETCH_MAX),
        "squash": np.clip(np.floor(65536 / (1 + np.exp(-logits / 256)) + 0.5), 1, 65535),
        "cost": np.floor(-np.log2(np.maximum(np.arange(65537), 1) / 65536) * 2048 + 0.5),
        "log": np.floor(np.log2(np.maximum(np.arange(4096), 1)) * 16 + 0.5),
        "rate": 655360 // (10 * np.arange(SLOW_LIMIT + 1) + 16),
        "small": np.array(
            [v if v < 3 else 2 + sum(v >= bound for bound in bounds) for v in range(38)]
        ),
    }
    return {name: values.astype(np.int64) for name, values in tables.items()}


ARRAYS = Tables(**_tables())
"""Tables of compiled runs."""
LISTS = Tables(*(values.tolist() for values in ARRAYS))
"""Tables of runs in plain Python."""

_LOCK = ForkLock()
_JITABLE: set[Callable[..., Any]] = set()
_COMPILED: dict[Callable[..., Any], Callable[..., Any]] = {}


@cache
def _numba() -> tuple[Any, Any] | None:
    """The modules numba and numba.extending, or None where they cannot be imported."""
    try:
        return import_module("numba"), import_module("numba.extending")
    except ImportError:
        return None


def compiled(
    run: Callable[..., Any], helpers: tuple[Callable[..., Any], ...]
) -> Callable[..., Any] | None:
    """`run` compiled by numba, or None where numba cannot be imported.

    helpers: the functions of the module of `run` that it calls; those of this module are included.
    numba keeps the compiled code beside the module of `run`. It compiles anew only when that file
    changes, so a change of this file alone must not change bytes.
    """
    modules = _numba()
    if modules is None:
        return None
    numba, extending = modules
    shared: tuple[Callable[..., Any], ...]
    shared = (code_bit, code_simple, start_range, finish, log16, stretched, mix)
    shared += (learn, learn_slots, code_mixed)
    with _LOCK:
        if run not in _COMPILED:
            for helper in {*shared, *helpers} - _JITABLE:
                extending.register_jitable(helper)
                _JITABLE.add(helper)
            try:
                _COMPILED[run] = numba.njit(cache=True, nogil=True)(run)
            except RuntimeError:  # there is no writable folder for the compiled code
                _COMPILED[run] = numba.njit(nogil=True)(run)
        return _COMPILED[run]


def memory_of(state: State, arrays: bool) -> Memory:
    """Copies of the arrays of a state, as int64 arrays or as lists."""
    slots, simples = state.slots, state.simples
    columns: list[npt.NDArray[Any]] = [slots[:, 0], slots[:, 1], slots[:, 2], state.weights]
    columns += [simples[:, 0], simples[:, 1]]
    return Memory(*(column.astype(np.int64) if arrays else column.tolist() for column in columns))


def keep_memory(memory: Memory, state: State) -> None:
    """Write a memory back into the arrays of a state."""
    state.slots[:, 0], state.slots[:, 1], state.slots[:, 2] = memory.slow, memory.fast, memory.count
    state.weights[:] = memory.weights
    state.simples[:, 0], state.simples[:, 1] = memory.chance, memory.seen


def start_range(stream: Stream) -> None:
    """Begin with the full range; a decoder reads its first four bytes."""
    span, data = stream.span, stream.data
    span[RANGE_HIGH] = 0xFFFFFFFF
    if stream.decoding:
        for i in range(4):
            span[VALUE] = (span[VALUE] << 8) | (data[i] if i < len(data) else 0)
        span[POSITION] = 4


def code_bit(bit: int, p: int, stream: Stream) -> int:
    """Encode a bit, or decode and return it; p: the probability of a 1, 1 to 65535 in 1/65536."""
    decoding, span, data, out = stream
    low, high = span[RANGE_LOW], span[RANGE_HIGH]
    middle = low + (((high - low) * p) >> 16)
    if decoding:
        bit = 1 if span[VALUE] <= middle else 0
    if bit:
        high = middle
    else:
        low = middle + 1
    while ((low ^ high) & 0xFF000000) == 0:
        if decoding:
            at = span[POSITION]
            byte = data[at] if at < len(data) else 0
            span[VALUE] = ((span[VALUE] << 8) & 0xFFFFFFFF) | byte
            span[POSITION] = at + 1
        else:
            out.append(high >> 24)
        low = (low << 8) & 0xFFFFFFFF
        high = ((high << 8) & 0xFFFFFFFF) | 255
    span[RANGE_LOW], span[RANGE_HIGH] = low, high
    return bit


def code_simple(bit: int, at: int, stream: Stream, memory: Memory, rate: Sequence) -> int:
    """Code a bit that one simple estimate predicts; at: number of the estimate."""
    p, seen = memory.chance[at], memory.seen[at]
    bit = code_bit(bit, min(max(p, 32), 65504), stream)
    memory.chance[at] = p + ((((65535 if bit else 0) - p) * rate[seen]) >> 16)
    if seen < SIMPLE_LIMIT:
        memory.seen[at] = seen + 1
    return bit


def finish(stream: Stream) -> None:
    """Append the fewest bytes of a number in the range; a decoder reads zeros past the end."""
    low, high, out = stream.span[RANGE_LOW], stream.span[RANGE_HIGH], stream.out
    for keep in range(5):
        v = high & ~(0xFFFFFFFF >> (8 * keep)) & 0xFFFFFFFF if keep else 0
        if v < low:
            continue
        for i in range(keep):
            out.append((v >> (24 - 8 * i)) & 255)
        break
    while len(out) > 0 and out[-1] == 0:
        out.pop()


def log16(v: int, log: Sequence) -> int:
    """16 log2 of a whole number above 0, approximately."""
    shift = 0
    while (v >> shift) >= 4096:
        shift += 1
    return int(log[v >> shift]) + 16 * shift


def stretched(n: int, where: Sequence, inputs: Sequence, memory: Memory, tables: Tables) -> None:
    """Write the logits of n estimates to `inputs`, two for each; arguments as for `mix`."""
    for i in range(n):
        at = where[i]
        slow, fast = tables.stretch[memory.slow[at]], tables.stretch[memory.fast[at]]
        trust = memory.count[at] + 1
        if trust < ALL_TRUST:
            # Rounded towards 0.
            slow = slow * trust // ALL_TRUST if slow >= 0 else -(-slow * trust // ALL_TRUST)
            fast = fast * trust // ALL_TRUST if fast >= 0 else -(-fast * trust // ALL_TRUST)
        inputs[2 * i], inputs[2 * i + 1] = slow, fast


def mix(
    n: int,
    where: Sequence,
    inputs: Sequence,
    first: int,
    second: int,
    memory: Memory,
    tables: Tables,
    more: int = 0,
) -> int:
    """Probability of a 1, in 1/65536, mixed from n estimates.

    Args:
        n: number of estimates.
        where: their slots.
        inputs: receives two inputs of the mixer per estimate, for `learn`.
        first: where the first set of weights begins.
        second: where the second set of weights begins, or a negative number for none.
        memory: the estimates and weights.
        tables: ARRAYS or LISTS.
        more: a term of the sum that comes from elsewhere.
    """
    weights, dot = memory.weights, more
    stretched(n, where, inputs, memory, tables)
    for i in range(n):
        slow, fast = inputs[2 * i], inputs[2 * i + 1]
        w, v = weights[first + 2 * i], weights[first + 2 * i + 1]
        if second >= 0:
            w, v = w + weights[second + 2 * i], v + weights[second + 2 * i + 1]
        dot += ((w * slow) >> 2) + ((v * fast) >> 2)
    return int(tables.squash[min(max(dot >> 12, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX])


def learn(
    n: int,
    where: Sequence,
    inputs: Sequence,
    first: int,
    second: int,
    p: int,
    bit: int,
    limit: int,
    learning_rate: int,
    memory: Memory,
    rate: Sequence,
) -> None:
    """Adapt weights and estimates to the bit that came after `mix`.

    Args:
        n, where, inputs, first, second: as for `mix`.
        p: the probability that `mix` returned.
        bit: the bit that was coded.
        limit: observations after which the slow rate stays.
        learning_rate: rate of the weights, in 1/16.
        memory: the estimates and weights.
        rate: the table of rates.
    """
    weights = memory.weights
    target = 65535 if bit else 0
    error = ((target - p) * learning_rate) >> 4
    for i in range(2 * n):
        step = (error * inputs[i] + 32768) >> 16
        weights[first + i] = min(max(weights[first + i] + step, -32767), 32767)
        if second >= 0:
            weights[second + i] = min(max(weights[second + i] + step, -32767), 32767)
    learn_slots(n, where, bit, limit, memory, rate)


def learn_slots(
    n: int, where: Sequence, bit: int, limit: int, memory: Memory, rate: Sequence
) -> None:
    """Adapt n estimates alone; arguments as for `learn`."""
    target = 65535 if bit else 0
    for i in range(n):
        at = where[i]
        slow, fast, seen = memory.slow[at], memory.fast[at], memory.count[at]
        memory.slow[at] = slow + (((target - slow) * rate[seen]) >> 16)
        memory.fast[at] = fast + (((target - fast) * rate[min(seen, FAST_LIMIT)]) >> 16)
        if seen < limit:
            memory.count[at] = seen + 1


def code_mixed(
    n: int,
    bit: int,
    first: int,
    second: int,
    learning_rate: int,
    where: Sequence,
    inputs: Sequence,
    stream: Stream,
    memory: Memory,
    tables: Tables,
) -> int:
    """Code a bit that n estimates predict together, and adapt them; arguments as for `learn`."""
    p = mix(n, where, inputs, first, second, memory, tables)
    bit = code_bit(bit, p, stream)
    rate = tables.rate
    learn(n, where, inputs, first, second, p, bit, SLOW_LIMIT, learning_rate, memory, rate)
    return bit
