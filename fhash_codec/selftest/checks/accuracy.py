"""Properties of values: finite or missing where they must be, within the bound, the range and the
promise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.goal import promise
from fhash_codec.selftest.case import Finding, Run
from fhash_formats.support.values import is_wide_integer

__all__ = ["ACCURACY_CHECKS", "expected_coreset", "largest_difference"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]


def presence(run: Run) -> Iterator[Finding]:
    """Every vertex of the coreset is finite, every other one is NaN. Infinite values of the source
    are missing, just as NaN."""
    in_coreset = expected_coreset(run)
    yield Finding(
        name="finite in the coreset",
        worst=_count(in_coreset & ~np.isfinite(run.decoded)),
        limit=0.0,
        unit="values",
    )
    yield Finding(
        name="NaN outside of it",
        worst=_count(~in_coreset & ~np.isnan(run.decoded)),
        limit=0.0,
        unit="values",
    )


def bound(run: Run) -> Iterator[Finding]:
    """The strict bound holds in exact arithmetic. For a bound of 0, the number of differing values
    is counted."""
    error = _error_bound(run)
    if error is None:
        return
    worst = largest_difference(run.values, run.decoded, np.isfinite(run.decoded))
    if error == 0:
        yield Finding(name="lossless", worst=_differing(run), limit=0.0, unit="values")
    else:
        yield Finding(
            name="strict bound", worst=float(worst / error), limit=1.0, unit="of the bound"
        )


def quality(run: Run) -> Iterator[Finding]:
    """The promised PSNR is reached, and the figures in the file are no better than the measured
    ones."""
    where = np.isfinite(run.decoded)
    reached = _psnr(run, where)
    promised = (
        promise(run.config).get("psnr") if run.config.profile == "compact" else run.config.psnr
    )
    if promised is not None and reached > 0:
        yield Finding(
            name="promised PSNR", worst=promised / reached, limit=1.0, unit="of the dB reached"
        )
    stated = run.volume.container.header["quality"]
    worst = largest_difference(run.values, _own_values(run), where)
    if stated["max_abs_error"]:
        # The stated error is a difference of two float64, which is rounded.
        beyond = max(float(worst / Fraction(stated["max_abs_error"]) - 1), 0.0)
        yield Finding(
            name="beyond the stated error", worst=beyond, limit=1e-12, unit="of the stated error"
        )
    else:
        beyond = float(worst) if stated["max_abs_error"] == 0 else 0.0
        yield Finding(name="beyond the stated error", worst=beyond, limit=0.0, unit="in data units")
    if stated["psnr"] is not None and reached > 0:
        yield Finding(
            name="below the stated PSNR",
            worst=max(stated["psnr"] - reached, 0.0),
            limit=1e-6,
            unit="dB",
        )


def constants(run: Run) -> Iterator[Finding]:
    """A constant series comes back exactly, rounded to the dtype of the volume."""
    finite = run.values[np.isfinite(run.values)]
    if finite.min() == finite.max():
        yield Finding(name="exact constant", worst=_differing(run), limit=0.0, unit="values")


def within_range(run: Run) -> Iterator[Finding]:
    """Decoded values exceed the range of the series by no more than the bound."""
    finite = run.values[np.isfinite(run.values)]
    low, high = Fraction(finite.min().item()), Fraction(finite.max().item())
    decoded = run.decoded[np.isfinite(run.decoded)]
    if is_wide_integer(run.values.dtype):
        low, high = Fraction(float(low)), Fraction(float(high))
    excess = max(
        low - Fraction(decoded.min().item()), Fraction(decoded.max().item()) - high, Fraction(0)
    )
    allowed = _error_bound(run) or Fraction(0)
    span = high - low if high > low else Fraction(1)
    yield Finding(
        name="beyond the range",
        worst=float(excess / span),
        limit=float(allowed / span),
        unit="of the range",
    )


ACCURACY_CHECKS = (presence, bound, quality, constants, within_range)


def expected_coreset(run: Run) -> Mask:
    """The coreset as a mask (t, z, y, x).

    It is computed here anew for features of intervals. Other features depend on the encoder's
    choices, so the file's own occupancy is used for them.
    """
    finite: Mask = np.isfinite(run.values)
    if "all" in run.config.features:
        return finite
    if not all(feature.startswith("interval:") for feature in run.config.features):
        return np.asarray([run.volume.occupancy(step) for step in range(run.values.shape[0])])
    selected = np.zeros(run.values.shape, dtype=bool)
    for feature in run.config.features:
        low, high = (np.float64(end) for end in feature.split(":")[1:])
        if run.values.dtype.kind == "f":
            low, high = low.astype(run.values.dtype), high.astype(run.values.dtype)
        selected |= finite & (run.values >= low) & (run.values <= high)
    keys = run.volume.key_times.key_frames
    grown = [_grown(selected[step], run.config.dilation) & finite[step] for step in keys]
    mask = np.zeros(run.values.shape, dtype=bool)
    for step in range(len(mask)):
        # The coreset of a step between two key frames is the union of theirs.
        after = int(np.clip(np.searchsorted(keys, step), 0, len(keys) - 1))
        before = after if keys[after] == step or after == 0 or step > keys[-1] else after - 1
        mask[step] = grown[before] | grown[after]
    return np.asarray(mask & finite)


def _grown(mask: Mask, reach: int) -> Mask:
    """A mask (z, y, x) grown by `reach` vertices in the 26-neighbourhood, by sums over windows."""
    for axis, length in enumerate(mask.shape):
        sums = np.insert(np.cumsum(mask, axis=axis, dtype=np.int64), 0, 0, axis=axis)
        at = np.arange(length)
        high, low = np.minimum(at + reach + 1, length), np.maximum(at - reach, 0)
        mask = np.asarray(np.take(sums, high, axis=axis) > np.take(sums, low, axis=axis))
    return mask


def largest_difference(values: Values, decoded: Values, where: Mask) -> Fraction:
    """max |value - decoded| over the mask `where`, exactly."""
    given_values, decoded_values = values[where], decoded[where]
    if not given_values.size:
        return Fraction(0)
    if is_wide_integer(given_values.dtype):
        return max(
            abs(Fraction(a) - Fraction(b))
            for a, b in zip(given_values.tolist(), decoded_values.tolist(), strict=True)
        )
    # Halves do not overflow. The values that seem to differ most are compared exactly.
    rough = np.abs(given_values.astype(np.float64) / 2 - decoded_values.astype(np.float64) / 2)
    near = np.flatnonzero(rough >= rough.max() * (1 - 1e-12))[:8]
    return max(
        abs(Fraction(given_values[n].item()) - Fraction(decoded_values[n].item())) for n in near
    )


def _psnr(run: Run, where: Mask) -> float:
    """PSNR in dB over the mask `where`; infinite without an error, 0 for a constant series."""
    finite = run.values[np.isfinite(run.values)]
    span = Fraction(finite.max().item()) - Fraction(finite.min().item())
    if span == 0:
        return 0.0
    given_values, decoded_values = run.values[where], _own_values(run)[where]
    if is_wide_integer(given_values.dtype):
        shares = np.array(
            [
                float((a - Fraction(b)) / span)
                for a, b in zip(given_values.tolist(), decoded_values.tolist(), strict=True)
            ]
        )
    else:
        # Scaling by a power of two is exact and keeps differences from overflowing or vanishing.
        exponent = math.frexp(
            float(max(abs(Fraction(finite.max().item())), abs(Fraction(finite.min().item()))))
        )[1]
        scaled = np.ldexp(given_values.astype(np.float64), -exponent) - np.ldexp(
            decoded_values.astype(np.float64), -exponent
        )
        shares = scaled / float(span / Fraction(2) ** exponent)
    mean = float(np.mean(np.square(shares))) if shares.size else 0.0
    return -10 * math.log10(mean) if mean > 0 else math.inf


def _error_bound(run: Run) -> Fraction | None:
    """The strict bound in data units, None without one; finite even if the range overflows
    float64."""
    config = run.config
    if config.max_error is not None:
        return Fraction(config.max_error)
    if config.max_error_rel is None:
        return None
    if math.isfinite(run.data_range):
        return Fraction(config.max_error_rel * run.data_range)
    low, high = run.volume.value_range.low, run.volume.value_range.high
    return Fraction(config.max_error_rel) * (Fraction(high) - Fraction(low))


def _differing(run: Run) -> float:
    """The number of coreset values that differ from the original, rounded to the decoded dtype."""
    decoded = _own_values(run)
    same = run.values.astype(decoded.dtype) == decoded
    return _count(~same & np.isfinite(run.decoded))


def _own_values(run: Run) -> Values:
    """The decoded values in the source's type: floats cannot tell all integers of 64 bits apart."""
    volume = run.volume
    if volume.dtype.kind == "f" or volume.value_type.has_gaps:
        return run.decoded
    return np.stack([volume.values(step) for step in range(volume.shape[0])])


def _count(mask: Mask) -> float:
    return float(np.count_nonzero(mask))
