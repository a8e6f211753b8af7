"""Entropy coders of the native library by cffi, for tests that look at one kernel alone."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import ffi, library, pointer
from fhash_formats.support.values import Integers, Mask
from fhash_formats.transform.predict import CLASSES, Predictor, Tap
from fhash_formats.transform.spec import MaskLevels, checked

Buffer = npt.NDArray[np.uint8]
"""Room for the bytes of an encoder."""
Table = npt.NDArray[np.int32]
"""Bands in the order in which they are coded, int32 of shape (bands, COLUMNS)."""

LOW = 0
"""First of four columns: the lowest index of the band along t, z, y, x."""
HIGH = 4
"""First of four columns: one past the highest index of the band along t, z, y, x."""
REFERENCES = 9
"""First column of the references: the earlier bands from which a band takes contexts."""
REFERENCE_COUNT = 4
"""References of a band: its parent, the bands before it along t and along z, and its sibling."""
REFERENCE_COLUMNS = 5
"""Columns of one reference: BAND, then SHIFT along t, z, y, x."""
COLUMNS = REFERENCES + REFERENCE_COUNT * REFERENCE_COLUMNS
"""Columns of the table."""

NO_REFERENCE = [-1, 0, 0, 0, 0]
"""Columns of a reference to no band."""


def single_band(shape: Sequence[int]) -> Table:
    """The table of integers (t, z, y, x) that were not transformed: one band of kind 0."""
    row = [0, 0, 0, 0, *shape, 0, *NO_REFERENCE * REFERENCE_COUNT]
    return np.array([row], dtype=np.int32)


DECISIONS = 16
"""Decisions of a magnitude, each with estimates and weights of its own."""
LANES = 8
"""Weights of a set: two per estimate."""
KINDS = 64
"""Kinds of bands."""
LEVELS = 128
"""Levels of the expected magnitude."""
SIZES = (LEVELS, 729, 12 * 12 * 12, 7 * 7 * 7 * 7)
"""Contexts of a decision, for each of the four estimates that are mixed."""
SIGN_SIZES = tuple(KINDS * size for size in (27, 108, 81, 25))
"""Contexts of a sign, for each of the four estimates that are mixed."""
SIGN_SET = 16
"""Weights of a sign: two per estimate, then that of the linear logit."""
SIGN_INPUTS = 96
"""Weights of a linear predictor of signs, each with a mean square of its gradient."""
FIRST_SQUARE = 16
"""Mean square of a gradient before anything is known, 1 is 16384."""
SIMPLES = LEVELS * 64 + 8 + KINDS
"""Simple estimates: of the escape code, of empty rows and of empty bands."""
TRUST = 12
"""Count of an estimate of a prior; it is low, so that a tile soon follows its own statistics."""
LOGITS = 44
"""Numbers of an estimate in a file of a prior."""
WEIGHT_STEP = 512
"""Unit of weights in a file of a prior, as differences from those of the blank state."""

_NUMBERS = Path(native.__file__).with_name("prior_bytes.inc").read_text(encoding="utf-8")
"""The files of the priors as the library has them."""


def _prior_file(name: str) -> bytes:
    """The bytes of the file of a prior: PRIOR, MASK_PRIOR or FAST_PRIOR."""
    start = _NUMBERS.index(f" {name}[] = {{") + len(name) + 7
    return bytes(map(int, _NUMBERS[start : _NUMBERS.index("}", start)].replace(",", " ").split()))


@dataclass(frozen=True, kw_only=True)
class State:
    """Estimates and weights that a coder adapts.

    Attributes:
        slots: uint16 (n, 4), the estimates that are mixed: probability by a slow and by a fast
            rate, number of observations, 0. Probabilities are in 1/65536.
        weights: int32 (n,), of the mixing and of linear predictors, within 16 bits.
        simples: uint16 (n, 2), estimates that are used alone: probability, number of observations.
    """

    slots: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.int32]
    simples: npt.NDArray[np.uint16]

    @classmethod
    def even(cls, *, slots: int, weights: Sequence[tuple[int, int]], simples: int) -> State:
        """A state of even odds.

        Args:
            slots: number of slots.
            weights: runs of equal weights, each as its length and its value.
            simples: number of simple estimates.
        """
        counts, values = zip(*weights, strict=True)
        state = cls(
            slots=np.zeros((slots, 4), dtype=np.uint16),
            weights=np.repeat(np.array(values, dtype=np.int32), counts),
            simples=np.zeros((simples, 2), dtype=np.uint16),
        )
        state.slots[:, :2] = state.simples[:, 0] = 32768
        return state

    def copy(self) -> State:
        """A state with copies of the arrays."""
        return State(
            slots=self.slots.copy(), weights=self.weights.copy(), simples=self.simples.copy()
        )

    def frozen(self) -> State:
        """This state, after making its arrays read-only."""
        for array in (self.slots, self.weights, self.simples):
            array.setflags(write=False)
        return self


def blank_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates."""
    weights = [(KINDS * DECISIONS * LANES, 4423), (64 * DECISIONS * LANES, 0)]
    weights += [(8, 2048), (1, 8192), (SIGN_SET - 9, 0)] * KINDS
    weights += [(SIGN_INPUTS, 0), (SIGN_INPUTS, FIRST_SQUARE)] * KINDS
    slots = sum(SIZES) * DECISIONS + sum(SIGN_SIZES)
    return State.even(slots=slots, weights=weights, simples=SIMPLES)


@cache
def prior_state(trellis: bool) -> State:
    """The prior of the coder of integers, or of those of two quantisers; it is read-only."""
    if not trellis:
        state = unpack_state(_prior_file("PRIOR"), blank_state())
        squares = state.weights[-2 * KINDS * SIGN_INPUTS :].reshape(KINDS, 2, SIGN_INPUTS)[:, 1]
        # The file has the roots of mean squares.
        squares[:] = ((squares - FIRST_SQUARE) // WEIGHT_STEP) ** 2
        return state.frozen()
    state = prior_state(False).copy()
    # The decisions of class 1 of two quantisers, 14 and 15, begin as those of class 0.
    slots = state.slots[: sum(SIZES) * DECISIONS].reshape(-1, DECISIONS, 4)
    slots[:, 14:] = slots[:, :2]
    of_kinds = KINDS * DECISIONS * LANES
    for sets in (state.weights[:of_kinds], state.weights[of_kinds:][: 64 * DECISIONS * LANES]):
        by_decision = sets.reshape(DECISIONS, -1)
        by_decision[14:] = by_decision[:2]
    return state.frozen()


def unpack_state(data: bytes, blank: State) -> State:
    """A state from the bytes of a file.

    Args:
        data: deflated, a byte for each number: of the slots and then of the simple estimates n > 0
            for the logit (n - 22) / 2, seen TRUST times, and 0 for one that nothing is known of; of
            the weights the difference from the blank state, signed, in WEIGHT_STEP.
        blank: the state that has learned nothing.
    """
    state = blank.copy()
    ends = np.cumsum([len(state.slots), len(state.simples), len(state.weights)])
    slots, simples, steps, _ = np.split(np.frombuffer(zlib.decompress(data), np.uint8), ends)
    # Table look-ups of whole numbers, so that every machine has the same.
    state.slots[:, 0] = state.slots[:, 1] = _PROBABILITIES[slots]
    state.slots[:, 2] = TRUST * (slots > 0)
    state.simples[:, 0] = _PROBABILITIES[simples]
    state.simples[:, 1] = TRUST * (simples > 0)
    state.weights[:] += WEIGHT_STEP * steps.view(np.int8).astype(np.int32)
    return state


def _probabilities() -> npt.NDArray[np.uint16]:
    """Probability in 1/65536 of each number of a file, rounded; even odds for 0."""
    logits = (np.arange(LOGITS) - LOGITS // 2) / 2
    rounded = np.floor(65536 / (1 + np.exp(-logits)) + 0.5)
    rounded[0] = 32768
    return rounded.astype(np.uint16)


_PROBABILITIES = _probabilities()


MAX_INTEGER = 2**30 - 1
"""Largest magnitude of an integer."""

NO_TRELLIS = -3
"""Code of an encoder that met an integer which its quantiser does not have, as in
native/coder_contexts.hpp."""


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """Coded integers.

    Attributes:
        data: the bytes.
        integers: what the bytes decode to; other than the integers given where the rate-distortion
            optimisation changed some.
    """

    data: bytes
    integers: Integers


def encode_integers(
    integers: Integers,
    table: Table,
    *,
    scaled: npt.NDArray[np.float32] | None = None,
    weight: float = 0.0,
    trellis: bool = False,
    fast: bool = False,
) -> Encoded:
    """Code integers in the bands of a table; integers outside the bands count as 0.

    Args:
        integers: int32 (t, z, y, x), magnitudes up to MAX_INTEGER.
        table: the bands.
        scaled: coefficients / quantiser step, float32, same shape. With it each magnitude is chosen
            anew, from the nearest one, one less and zero: the one with the least squared error, in
            steps, plus `weight` per bit.
        weight: squared steps that a bit is worth.
        trellis: whether the integers are those of two quantisers. Raises InputError
            for integers that are not, and does not go with `scaled`; with `fast` it goes with
            `scaled` alone.
        fast: whether to code them by the fast coder (native/fast.cpp).
    """
    if fast:
        return _encode_fast(integers, table, scaled, weight, trellis=trellis)
    if trellis and scaled is not None:
        raise InputError("integers of a trellis are chosen before they are coded")
    given = np.ascontiguousarray(integers, dtype=np.int32)
    chosen = None if scaled is None else np.ascontiguousarray(scaled, dtype=np.float32)
    # The native coder writes to its integers only where it chooses them.
    integers = given if chosen is None else np.empty_like(given)

    def encode(buffer: Buffer) -> int:
        # Each time the original integers. Coding the chosen ones would give other bytes, because
        # rows that became empty are signalled differently.
        if chosen is not None:
            np.copyto(integers, given)
        code: int = library().fhash_encode(
            pointer(integers),
            pointer(chosen),
            weight,
            trellis,
            integers.shape,
            *array_arguments(table),
            *state_arguments(prior_state(trellis)),
            False,  # the state is not kept
            *array_arguments(buffer),
        )
        if code == NO_TRELLIS:
            raise InputError("an integer is not one of the quantiser whose turn it is")
        return code

    return Encoded(data=with_room(given.size // 2, encode), integers=integers)


NEXT = np.array([[0, 2], [5, 7], [1, 3], [6, 4], [2, 0], [4, 6], [3, 1], [7, 5]])
"""FORMAT.md, Two quantisers."""


def of_two_quantisers(indices: Integers, table: Table) -> Integers:
    """The integers whose indices these are, in the bands of a table; 0 elsewhere."""
    result, state = np.zeros_like(indices), 0
    for row in table:
        box = tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))
        band = indices[box]
        values = np.empty(band.size, np.int32)
        for at, k in enumerate(band.ravel().tolist()):
            values[at] = np.sign(k) * (2 * abs(k) - (state & 1))
            state = NEXT[state, k & 1]
        result[box] = values.reshape(band.shape)
    return result


def with_room(room: int, encode: Callable[[Buffer], int]) -> bytes:
    """The bytes of a native encoder, which is called again where they do not fit.

    room: bytes that are likely to be enough. encode: fills a buffer, and returns the size, or an
    error code. Raises MemoryError.
    """
    capacity = max(4096, room)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        size = checked(encode(buffer))
        if size <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_integers(
    data: bytes | memoryview,
    shape: tuple[int, ...],
    table: Table,
    *,
    trellis: bool = False,
    fast: bool = False,
) -> Integers:
    """The integers (t, z, y, x) of a shape, int32; `trellis` and `fast` as for the encoder.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    integers = np.zeros(shape, dtype=np.int32)
    source = np.frombuffer(data, dtype=np.uint8)
    where = (shape, *array_arguments(table))
    if fast:
        prior = fast_prior()
        code = library().fhash_fast_decode(
            pointer(integers),
            trellis,
            *where,
            pointer(prior.defaults),
            pointer(prior.lookup),
            *array_arguments(source),
        )
    else:
        code = library().fhash_decode(
            pointer(integers),
            trellis,
            *where,
            *state_arguments(prior_state(trellis)),
            *array_arguments(source),
        )
    if checked(code) < 0:
        raise DamagedFileError("the coded integers are damaged")
    return integers


CHOICES = 64
"""Distributions of the fast coder, of tokens and as many of signs, that a context may have."""
TOKENS = 16
"""Symbols of a distribution."""
FAST_CONTEXTS = 1744
"""Contexts of the fast coder that have a distribution."""
SLOTS = 2048
"""Slots of a distribution: the unit of its probabilities."""


@dataclass(frozen=True, kw_only=True)
class FastPrior:
    """The distributions of the fast coder.

    Attributes:
        slots: uint16 (2 CHOICES + 1, TOKENS), of the SLOTS those of each symbol: distributions of
            tokens, of signs, and that of nothing.
        defaults: uint8 (FAST_CONTEXTS,), the distribution of each context unless a tile names
            another.
        lookup: uint32 (2 CHOICES + 1, SLOTS), of each slot the symbol (4 bits), its place among the
            slots of that symbol (12 bits), and their number.
    """

    slots: npt.NDArray[np.uint16]
    defaults: npt.NDArray[np.uint8]
    lookup: npt.NDArray[np.uint32]


@cache
def fast_prior() -> FastPrior:
    """The prior of the fast coder; it is read-only."""
    data = _prior_file("FAST_PRIOR")
    count = CHOICES * TOKENS
    slots = np.zeros((2 * CHOICES + 1, TOKENS), np.uint16)
    slots[:CHOICES] = np.frombuffer(data, "<u2", count).reshape(CHOICES, TOKENS)
    # That a sign differs from what is foretold has a probability of (2 n + 1) / 256.
    slots[CHOICES:-1, 1] = SLOTS // (4 * CHOICES) * (2 * np.arange(CHOICES) + 1)
    slots[CHOICES:, 0] = SLOTS - slots[CHOICES:, 1]
    symbols = np.array([np.repeat(np.arange(TOKENS), row) for row in slots])
    of_symbol = np.take_along_axis(slots.astype(np.int64), symbols, 1)
    first = np.take_along_axis(np.cumsum(slots, axis=1, dtype=np.int64) - slots, symbols, 1)
    lookup = symbols | (np.arange(SLOTS) - first) << 4 | of_symbol << 16
    prior = FastPrior(
        slots=slots,
        defaults=np.frombuffer(data, np.uint8, FAST_CONTEXTS, 2 * count),
        lookup=lookup.astype(np.uint32),
    )
    for array in (prior.slots, prior.lookup):
        array.setflags(write=False)
    return prior


def _encode_fast(
    integers: Integers,
    table: Table,
    scaled: npt.NDArray[np.float32] | None,
    weight: float,
    *,
    trellis: bool,
) -> Encoded:
    """Code integers by the fast coder; the arguments are those of `encode_integers`."""
    assert scaled is not None or not trellis
    given = np.ascontiguousarray(integers, dtype=np.int32)
    chosen = None if scaled is None else np.ascontiguousarray(scaled, dtype=np.float32)
    result = given if chosen is None else np.empty_like(given)

    def encode(buffer: Buffer) -> int:
        if chosen is not None:
            result.fill(0)
        how = (trellis, 1.0, weight)
        return _fast(result, chosen, how, given.shape, table, buffer)[0]

    return Encoded(data=with_room(given.size // 2, encode), integers=result)


def _fast(
    integers: Integers | None,
    values: npt.NDArray[np.float32] | None,
    how: tuple[bool, float, float],
    shape: Sequence[int],
    table: Table,
    buffer: npt.NDArray[np.uint8],
) -> tuple[int, float, float]:
    """Call the fast coder; bytes, those that it foretold, and the error.

    how: whether integers are chosen on a trellis, factor of the values, weight of a bit.
    """
    prior, results = fast_prior(), ffi.new("double[2]")
    size = library().fhash_fast_encode(
        pointer(integers),
        pointer(values),
        *how,
        shape,
        *array_arguments(table),
        pointer(prior.slots),
        pointer(prior.defaults),
        *array_arguments(buffer),
        results,
    )
    return checked(size), results[0], results[1]


def array_arguments(array: npt.NDArray[Any]) -> tuple[Any, int]:
    """An array and its length along the first axis, as the native functions take them."""
    return pointer(array), len(array)


def state_arguments(state: State) -> list[Any]:
    """The arrays of a state, each with its length, as the native functions take them."""
    return [
        *array_arguments(state.slots),
        *array_arguments(state.weights),
        *array_arguments(state.simples),
    ]


Labels = npt.NDArray[np.uint16]


def encode_labels(labels: npt.NDArray[Any], count: int) -> bytes:
    """Code labels (t, z, y, x), each below `count`, of which there are 1 to MAX_LABELS."""
    # The coder writes to its labels, also in encoding, but does not change them.
    work = np.array(labels, dtype=np.uint16, order="C")
    shape = work.shape

    def encode(buffer: Buffer) -> int:
        code: int = library().fhash_encode_labels(
            pointer(work), count, shape, *array_arguments(buffer)
        )
        return code

    return with_room(work.size // 8, encode)


def decode_labels(data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> Labels:
    """The labels of a shape (t, z, y, x) that `encode_labels` coded.

    Any other bytes give some labels below `count`.
    """
    labels = np.zeros(shape, dtype=np.uint16)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library().fhash_decode_labels(pointer(labels), count, shape, *array_arguments(source))
    checked(code)
    return labels


Levels = npt.NDArray[np.uint8]


def mask_levels(mask: MaskLevels, values: npt.NDArray[Any]) -> tuple[Levels, Levels]:
    """The level, 0 to 31, and the second level, 0 to 15, of each vertex (t, z, y, x), uint8.

    values: the decoded values, finite, in the type in which the tile is transformed.
    """
    first, second = np.zeros(values.shape, np.uint8), np.zeros(values.shape, np.uint8)
    if not values.size or not (any(mask.scores) or any(mask.others)):
        return first, second
    with np.errstate(over="ignore"):
        edges = np.array(mask.edges, dtype=values.dtype)
    source = np.ascontiguousarray(values)
    scores = mask.scores
    others = mask.others or ffi.NULL
    function = getattr(library(), f"fhash_mask_levels_f{8 * values.dtype.itemsize}")
    code = function(
        pointer(source),
        values.shape,
        *array_arguments(edges),
        scores,
        others,
        mask.reach,
        pointer(first),
        pointer(second),
    )
    checked(code)
    return first, second


MASK_LEVELS = 32
"""Levels of a vertex; each has a set of mixing weights."""
MASK_CONTEXTS = 10
"""Estimates that are mixed for a bit."""
MASK_NEAR = 16
"""Patterns of the four nearest bits; each has a set of mixing weights."""
MASK_SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
"""Contexts of each estimate."""
MASK_LANES = 2 * MASK_CONTEXTS
"""Weights of a set."""
MASK_SIMPLES = 30
"""Simple estimates, those of the flags of segments: by the state around, the levels, and the number
of segments around."""


def blank_mask_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates."""
    return State.even(
        slots=sum(MASK_SIZES),
        weights=[(MASK_LEVELS * MASK_LANES, 3277), (MASK_NEAR * MASK_LANES, 0)],
        simples=MASK_SIMPLES,
    )


@cache
def mask_prior_state() -> State:
    """The prior of masks; its arrays are read-only."""
    return unpack_state(_prior_file("MASK_PRIOR"), blank_mask_state()).frozen()


def encode_mask(mask: Mask, levels: tuple[Levels, Levels]) -> bytes:
    """Code a mask.

    Args:
        mask: bool (t, z, y, x), at least one vertex.
        levels: two levels of each vertex, 0 to 31 and 0 to 15, uint8, from `MaskLevels.levels`.
    """
    bits, first, second = (np.ascontiguousarray(array, dtype=np.uint8) for array in (mask, *levels))

    def encode(buffer: Buffer) -> int:
        code: int = library().fhash_encode_mask(
            *map(pointer, (bits, first, second)),
            mask.shape,
            *state_arguments(mask_prior_state()),
            False,  # the state is not kept
            *array_arguments(buffer),
        )
        return code

    return with_room(mask.size // 8, encode)


def decode_mask(data: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask, bool (t, z, y, x), that `encode_mask` coded with the same levels.

    Any other bytes give some mask: the caller must check a digest.
    """
    shape = levels[0].shape
    mask = np.empty(shape, dtype=np.uint8)
    first, second = (np.ascontiguousarray(array, dtype=np.uint8) for array in levels)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library().fhash_decode_mask(
        *map(pointer, (mask, first, second)),
        shape,
        *state_arguments(mask_prior_state()),
        *array_arguments(source),
    )
    checked(code)
    return mask.view(np.bool_)


PREDICTED_DECISIONS = 16
"""Decisions of a difference, each with estimates and weights of its own."""
PREDICTED_LANES = 14
"""Weights of a set."""
PREDICTED_LEVELS = 48
"""Levels of the expected difference; each has a set of weights per decision."""
PREDICTED_SIZES = (
    PREDICTED_LEVELS * 5,
    32 * 27,
    CLASSES * 24 * 5,
    3125,
    81 * 5 * 8,
    81 * 24,
    32 * 24 * 5,
)
"""Contexts of each of the seven estimates that are mixed; each context has a slot per decision."""
PREDICTED_SIMPLES = 200
"""Simple estimates: of low bits, of the escape code and of rows without a difference."""


@cache
def blank_predicted_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates.

    The arrays are read-only.
    """
    sets = PREDICTED_DECISIONS * PREDICTED_LANES
    return State.even(
        slots=sum(PREDICTED_SIZES) * PREDICTED_DECISIONS,
        weights=[(CLASSES * sets, 4096), (PREDICTED_LEVELS * sets, 0)],
        simples=PREDICTED_SIMPLES,
    ).frozen()


def encode_predicted(
    integers: Integers, counted: Mask | None, predictor: Predictor
) -> tuple[bytes, Integers]:
    """Code integers: the bytes, and the integers that they decode to.

    Args:
        integers: (t, z, y, x), each within +-MAX_PREDICTED_INTEGER.
        counted: mask (bool, same shape) of the integers that must come back; the others become
            their predictions. None counts all.
        predictor: the passes and their weights.
    """
    marks = None if counted is None else np.ascontiguousarray(counted, dtype=np.uint8)
    result = np.empty(integers.shape, dtype=np.int32)

    def encode(buffer: Buffer) -> int:
        np.copyto(result, integers)
        code: int = library().fhash_encode_predicted(
            pointer(result),
            pointer(marks),
            *_geometry(integers.shape, predictor),
            *state_arguments(blank_predicted_state()),
            *array_arguments(buffer),
        )
        return code

    return with_room(integers.size, encode), result


def decode_predicted(
    data: bytes | memoryview, shape: tuple[int, ...], predictor: Predictor
) -> Integers:
    """The integers (t, z, y, x) of a shape, int32.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    integers = np.zeros(shape, dtype=np.int32)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library().fhash_decode_predicted(
        pointer(integers),
        *_geometry(shape, predictor),
        *state_arguments(blank_predicted_state()),
        *array_arguments(source),
    )
    if checked(code) < 0:
        raise DamagedFileError("the predicted integers of a tile are damaged")
    return integers


def _geometry(shape: tuple[int, ...], predictor: Predictor) -> list[Any]:
    """Shape, levels, passes, taps and weights as the native functions take them."""
    passes, taps, weights = pass_arrays(predictor)
    return [
        shape,
        predictor.levels,
        *array_arguments(passes),
        pointer(taps),
        pointer(weights),
    ]


def pass_arrays(
    predictor: Predictor,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.int16]]:
    """The passes as the native coder takes them.

    Returns:
        Passes, int32 (n, 4): axis, kind, number of the first tap, number of taps.
        Taps of all passes, int32 (m, 5), see `Tap`.
        Weights of the taps, int16 (m,).
    """
    rows: list[tuple[int, ...]] = []
    taps: list[Tap] = []
    for a_pass in predictor.passes:
        rows.append((a_pass.axis, a_pass.kind, len(taps), len(a_pass.taps)))
        taps += a_pass.taps
    return (
        np.array(rows, dtype=np.int32),
        np.array(taps, dtype=np.int32),
        np.array(predictor.weights, dtype=np.int16),
    )
