"""One chunk of anybody's array to bytes and back: settings are chosen in closed form, chunk by chunk, and stand in the stream.

Nothing is trained and nothing comes from a table of the data's own, so the same chunk gives the same bytes on every machine: what is
chosen depends on sizes in bytes and on arithmetic in a stated order only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.encoding import (
    CodedTile,
    Shape,
    decode_tile,
    encode_tile,
    exact_tile,
    transform_for,
    within,
)
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["Quality", "decode_chunk", "encode_chunk", "supported", "tile_shape"]

Values = npt.NDArray[Any]

_WEIGHT = 0.09
"""Squared steps that a bit is worth: measured, the same for all data."""
_RATIOS = (2.5, 4.0, 1.6)
"""Steps, in units of half the residual's, that are tried under a bound: small ones pay for loose bounds, large ones for tight bounds."""
_WINDOW = 1 << 16
"""Most values of the part on which transforms and ratios are tried."""
_SLACK = 1 - 1e-6
_SAFE = 2.5e8
"""Largest coefficient in steps, as estimated: the coder ends at four times as much."""
_LARGEST, _SMALLEST = 1e300, 1e-290
_LARGEST_SINGLE, _SMALLEST_SINGLE = 1e30, 1e-30


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What is asked of a chunk: exactly one of the three. Raises InputError.

    max_error: a bound on |decoded - value|, in units of the values, kept strictly; 0 is lossless. max_error_rel: the same as a fraction of
    the range of the chunk's finite values. step: of the quantiser, in units of the values, without a bound.
    """

    max_error: float | None = None
    max_error_rel: float | None = None
    step: float | None = None

    def __post_init__(self) -> None:
        given = self.to_dict()
        if len(given) != 1:
            named = " and ".join(given) if given else "none"
            raise InputError(
                f"fhash.transform needs one of max_error, max_error_rel and step; given: {named}"
            )
        for name, value in given.items():
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not 0 <= value < math.inf
            ):
                raise InputError(f"{name} is {value!r:.40}; a finite number, 0 or more, is needed")
        if self.step == 0:
            raise InputError("step is 0; a number above 0 is needed (max_error 0 is lossless)")

    def to_dict(self) -> dict[str, float]:
        """The one that is given."""
        every = {
            "max_error": self.max_error,
            "max_error_rel": self.max_error_rel,
            "step": self.step,
        }
        return {name: value for name, value in every.items() if value is not None}


def supported(dtype: npt.DTypeLike) -> np.dtype[Any]:
    """The type in this machine's byte order. Raises InputError unless it is float16 to float64 or an integer."""
    kind = np.dtype(dtype)
    if kind.kind not in "fiu" or kind.itemsize > 8:
        raise InputError(
            f"fhash.transform codes float16, float32, float64 and integers, not {kind.name}"
        )
    return kind.newbyteorder("=")


def tile_shape(shape: tuple[int, ...]) -> Shape:
    """Four axes (t, z, y, x): ones in front of fewer, and of more axes the leading ones as one."""
    t, z, y, x = (
        (*(1,) * (4 - len(shape)), *shape)
        if len(shape) <= 4
        else (math.prod(shape[:-3]), *shape[-3:])
    )
    return t, z, y, x


def encode_chunk(
    values: Values,
    *,
    max_error: float | None = None,
    max_error_rel: float | None = None,
    step: float | None = None,
    transform: TransformSpec | Mapping[str, Any] | None = None,
) -> bytes:
    """The stream of an array of float16 to float64 or integers; axes as in `tile_shape`.

    max_error, max_error_rel, step: exactly one, as in `Quality`. transform: along (t, z, y, x); None for what codes best in a trial. NaN
    and infinities come back where they were and take no part in range or bound. Raises InputError.
    """
    quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
    values = np.asarray(values)
    tile = np.ascontiguousarray(values, dtype=supported(values.dtype)).reshape(
        tile_shape(values.shape)
    )
    specs = _candidates(tile.shape) if transform is None else (_spec(transform),)
    return _encode(tile, quality, specs).data if tile.size else b""


def decode_chunk(data: bytes | memoryview, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Values:
    """The values of a stream, of the shape and type that was coded. Raises DamagedFileError for bytes that no encoder writes."""
    if not math.prod(shape):
        return np.empty(shape, dtype)
    return (
        decode_tile(data, tile_shape(shape), supported(dtype))
        .reshape(shape)
        .astype(dtype, copy=False)
    )


def _encode(tile: Values, quality: Quality, specs: tuple[TransformSpec, ...]) -> CodedTile:
    finite = np.isfinite(tile)
    every = bool(finite.all())
    counted = tile if every else tile[finite]
    plain = TileSettings(
        transform=_candidates((1, 1, 1, 1))[0], step=1.0, center=0.0, low=0.0, high=0.0, double=True
    )
    nothing = np.zeros(tile.shape, bool)
    if not counted.size:
        return encode_tile(tile, plain, care=nothing, own=True)
    # Whole numbers stay whole numbers of Python here: 64 bits do not fit into a float.
    low, high = counted.min().item(), counted.max().item()
    with_bound = quality.step is None
    error, reach = _bound(quality, low, high, tile.dtype)
    center = float(low) + (float(high) / 2 - float(low) / 2)
    if high == low or (with_bound and float(high) / 2 - float(low) / 2 <= reach):
        constant = encode_tile(
            tile, replace(plain, center=center, low=center, high=center), care=nothing, own=True
        )
        # Without loss zeros keep their signs, which the constant has not.
        signed = with_bound and error == 0 and low == 0 and bool(np.signbit(counted).any())
        if within(tile, constant.decoded, error, None if every else finite) and not signed:
            return constant
    if high == low:
        return exact_tile(tile)
    first = float(quality.step) if quality.step is not None else _RATIOS[0] * reach
    largest, span = max(abs(float(low)), abs(float(high))), float(high) / 2 - float(low) / 2
    too_fine = with_bound and reach < error / 2
    if too_fine or not (first >= _SMALLEST and largest <= _LARGEST and span / first < _SAFE):
        return exact_tile(tile)
    settings = TileSettings(
        transform=specs[0],
        step=first,
        center=center,
        low=float(low),
        high=float(high),
        double=_double(tile.dtype, largest, 2 * span, first),
        quantum=2 * reach * _SLACK if with_bound else 0.0,
    )
    bound = error if with_bound else None
    settings = _chosen(tile, settings, specs, bound, reach)
    gain = [float(norms.max()) for norms in transform_for(settings, _shape(tile)).norms]
    if span / settings.step * gain[0] * gain[1] > _SAFE:
        return exact_tile(tile)
    coded = encode_tile(tile, settings, weight=_WEIGHT, error=bound, own=True)
    if 2 * len(coded.data) < tile.nbytes:
        return coded
    exact = exact_tile(tile)
    return exact if len(exact.data) <= len(coded.data) else coded


def _bound(quality: Quality, low: Any, high: Any, dtype: np.dtype[Any]) -> tuple[float, float]:
    """The bound on decoded values, and the largest error before they are rounded to their type."""
    error = 0.0 if quality.max_error is None else float(quality.max_error)
    if quality.max_error_rel is not None:
        part, span = float(quality.max_error_rel), float(high) - float(low)
        error = part * span if math.isfinite(span) else part * float(high) - part * float(low)
    if dtype.kind != "f":
        whole = math.floor(error) if math.isfinite(error) else 1 << 64
        return error, whole + 0.5
    return error, error - max(abs(low), abs(high)) * float(np.finfo(dtype).eps)


def _double(dtype: np.dtype[Any], largest: float, span: float, step: float) -> bool:
    """Whether float32 would lose what the step keeps."""
    if max(largest, step) > _LARGEST_SINGLE or step < _SMALLEST_SINGLE:
        return True
    return dtype.itemsize >= 4 and (
        span / step > 1 << 18 or (dtype != np.float32 and largest / step > 1 << 20)
    )


def _chosen(
    tile: Values,
    settings: TileSettings,
    specs: tuple[TransformSpec, ...],
    bound: float | None,
    reach: float,
) -> TileSettings:
    """The settings with the transform, then the step, by which a window takes the fewest bytes; the first of equals."""
    trials = [replace(settings, transform=spec) for spec in specs]
    ratios = _RATIOS[1:] if bound is not None else ()
    if len(trials) + len(ratios) == 1:
        return trials[0]
    window = _window(tile)

    def size(trial: TileSettings) -> int:
        return len(encode_tile(window, trial, weight=_WEIGHT, error=bound).data)

    sizes = [size(trial) for trial in trials]
    best = min(sizes)
    settings = trials[sizes.index(best)]
    result = settings
    for ratio in ratios:
        trial = replace(settings, step=ratio * reach)
        if (found := size(trial)) < best:
            best, result = found, trial
    return result


def _window(tile: Values) -> Values:
    """A block in the middle, of few values."""
    lengths = list(tile.shape)
    while math.prod(lengths) > _WINDOW:
        longest = lengths.index(max(lengths))
        lengths[longest] = (lengths[longest] + 1) // 2
    return np.ascontiguousarray(
        tile[
            tuple(
                slice((n - k) // 2, (n - k) // 2 + k)
                for n, k in zip(tile.shape, lengths, strict=True)
            )
        ]
    )


def _candidates(shape: tuple[int, ...]) -> tuple[TransformSpec, ...]:
    """9/7 along all axes; then haar and nothing along the first that has a length, which often is time; then haar along all."""
    lead = next((axis for axis, n in enumerate(shape) if n > 1), None)
    if lead is None:
        return (TransformSpec(axes=(AxisTransform(kind="none"),) * 4),)
    depths = [
        0 if n < 2 else max(1, min(most, n.bit_length() - 3))
        for n, most in zip(shape, (1, 1, 5, 5), strict=True)
    ]
    if min(shape[2:]) >= 16:
        depths[2:] = [min(depths[2:])] * 2
    # Along time, which few chunks are long in, two levels of haar are worth it.
    times = min(2, shape[lead].bit_length() - 1) if lead < 2 else depths[lead]
    found = [
        _along("9/7", depths, lead, kind, depth)
        for kind, depth in (("9/7", depths[lead]), ("haar", times), ("none", 0))
    ]
    return tuple(dict.fromkeys([*found, _along("haar", depths, lead, "haar", times)]))


def _along(kind: str, depths: list[int], lead: int, leading: str, depth: int) -> TransformSpec:
    every = [(kind if n else "none", n) for n in depths]
    every[lead] = (leading, depth)
    t, z, y, x = (AxisTransform(kind=name, depth=levels) for name, levels in every)
    return TransformSpec(axes=(t, z, y, x))


def _spec(transform: TransformSpec | Mapping[str, Any]) -> TransformSpec:
    return transform if isinstance(transform, TransformSpec) else TransformSpec.from_dict(transform)


def _shape(tile: Values) -> Shape:
    t, z, y, x = tile.shape
    return t, z, y, x
