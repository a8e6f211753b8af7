"""Cases of values: constants, extremes of every number type, denormals, missing and infinite
values."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Finding, Run
from fhash_codec.selftest.cases.fields import SHAPE, lattice, noise, series, waves
from fhash_codec.selftest.cases.settings import COMPACT, EXACT, MORE, PAPER, QUICK, Settings
from fhash_formats.series import ArraySeries, Series

__all__ = ["VALUE_CASES"]

Values = npt.NDArray[Any]
INTEGERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


def _case(
    name: str, about: str, make: Callable[[], Values], settings: Settings = QUICK, **rest: Any
) -> Case:
    return Case(
        name=name,
        group="values",
        about=about,
        make=lambda: series(make()),
        settings=settings,
        **{"more": MORE, **rest},
    )


def _constant(value: float, dtype: str) -> Callable[[], Values]:
    return lambda: np.full(SHAPE, value, dtype=dtype)


def _offset(low: float, extent: float, dtype: str) -> Callable[[], Values]:
    return lambda: (low + extent * waves()).astype(dtype)


def _one_ulp() -> Values:
    values = np.full(SHAPE, 1e8, dtype=np.float32)
    values[2, 3, 4, 5] = np.nextafter(np.float32(1e8), np.float32(np.inf))
    return values


def _magnitudes(exponent: float, dtype: str) -> Values:
    """Values of both signs, spread evenly over the exponents from -`exponent` to `exponent` (base
    10)."""
    sign = np.where(noise(seed=1) > 0, 1.0, -1.0)
    return np.asarray(sign * 10.0 ** (exponent * (2 * waves() - 1)), dtype=dtype)


def _denormals(dtype: str) -> Values:
    """Integer multiples of the smallest positive number of the dtype."""
    return np.asarray(np.rint(1000 * waves()) * np.finfo(dtype).smallest_subnormal, dtype=dtype)


def _denormals_beside_ordinary() -> Values:
    values = waves().astype(np.float32)
    values[:, ::2] = np.float32(1e-42)
    return values


def _signed_zero() -> Values:
    t, z, y, x = lattice()
    values = np.where((t + z + y + x) % 2 == 0, 0.0, -0.0)
    values[:, 4, 5, 6] = 1.0
    return values.astype(np.float32)


def _with(
    value: float, where: Callable[..., Values], dtype: str = "float32"
) -> Callable[[], Values]:
    def make() -> Values:
        values = waves().astype(dtype)
        values[where(*lattice())] = value
        return values

    return make


def _hole(t: Values, z: Values, y: Values, x: Values) -> Values:
    return np.asarray((x - 2 - 2 * t) ** 2 + (y - 5) ** 2 + (z - 4) ** 2 < 8)


def _isolated() -> Values:
    values = waves().astype(np.float32)
    for number, value in enumerate((np.nan, np.inf, -np.inf)):
        values[1, 2, 3, 2 * number] = value
        values[3, 8, 9, 8 + number] = value
    return values


def _one_finite() -> Values:
    values = np.full(SHAPE, np.nan, dtype=np.float32)
    values[2, 4, 5, 6] = 7.5
    return values


def _integers(dtype: str) -> Callable[[], Values]:
    """A smooth field over all values of the dtype, both ends included, with noise over all values
    in one corner."""

    def make() -> Values:
        limits = np.iinfo(dtype)
        shares = np.asarray(
            [round(share * 2**52) for share in waves().ravel().tolist()], dtype=object
        )
        values = np.asarray(
            limits.min + shares * (int(limits.max) - int(limits.min)) // 2**52, dtype=dtype
        ).reshape(SHAPE)
        values[:, :3, :3, :3] = np.random.default_rng(0).integers(
            limits.min, limits.max, (SHAPE[0], 3, 3, 3), dtype=dtype, endpoint=True
        )
        return values

    return make


def _largest_whole() -> Values:
    return np.full(SHAPE, 2**64 - 1, dtype=np.uint64)


def _beyond_floats() -> Values:
    """Integers near 2^62 that differ by less than float64 can represent."""
    return np.asarray(2**62 + np.rint(200 * waves()).astype(np.int64), dtype=np.int64)


DECLARED: dict[str, Any] = {"_FillValue": -999.0, "valid_range": [0.25, 0.5]}


def _declared() -> Values:
    values = waves().astype(np.float32)
    values[0, :, 0, 0] = -999.0
    return values


def _from_file() -> Series:
    """The series that a reader makes of a file whose attributes declare a fill value and a valid
    range."""
    import zarr

    from fhash_formats import open_series

    with tempfile.TemporaryDirectory(prefix="fhash-selftest-") as folder:
        path = Path(folder) / "declared.zarr"
        zarr.open_group(path, mode="w").create_array("hard", data=_declared()).attrs.update(
            DECLARED
        )
        with open_series(path) as read:
            return ArraySeries(
                np.stack(list(read.frames())), name=read.name, units=read.units, coords=read.coords
            )


def _declared_values(run: Run) -> Iterator[Finding]:
    """The fill value is missing; values outside `valid_range` are data, as in xarray."""
    expected = np.where(_declared() == -999, np.nan, _declared())
    wrong = np.count_nonzero(
        ~((run.values == expected) | (np.isnan(run.values) & np.isnan(expected)))
    )
    yield Finding(name="read as declared", worst=float(wrong), limit=0.0, unit="values")


DEFAULT: Settings = {"default": EncodeConfig()}
LOSSLESS: Settings = {**COMPACT, **EXACT}
COUNTED: Settings = {**LOSSLESS, "one": EncodeConfig(max_error=1.0, effort=2), **PAPER}
WIDE: Settings = {"wide": EncodeConfig(max_error=512.0, effort=2), **PAPER}
OF_64_BITS: Settings = {**COMPACT, "wide": EncodeConfig(max_error=1024.0, effort=2), **PAPER}
"""Settings for 64-bit integers. Volumes return them as float64, so the bound covers the rounding to
float64."""

VALUE_CASES: tuple[Case, ...] = (
    _case(
        "constant-zero",
        "a constant series comes back exactly",
        _constant(0.0, "float32"),
        {**QUICK, **DEFAULT},
    ),
    _case(
        "constant-float32", "a constant near 1e8 comes back exactly", _constant(1e8 + 8, "float32")
    ),
    _case(
        "constant-float64",
        "a constant that float32 cannot represent comes back exactly",
        _constant(1e8 + 1e-3, "float64"),
    ),
    _case(
        "constant-denormal", "the smallest number comes back exactly", _constant(5e-324, "float64")
    ),
    _case(
        "constant-largest",
        "the largest number comes back exactly",
        _constant(float(np.finfo("float64").max), "float64"),
    ),
    _case(
        "constant-uint64",
        "the largest 64-bit integer that float64 can represent",
        lambda: np.full(SHAPE, 2**64 - 2048, dtype=np.uint64),
    ),
    _case(
        "constant-uint64-beyond",
        "the largest 64-bit integer, which float64 cannot represent",
        _largest_whole,
        {**PAPER, **WIDE},
        more={},
    ),
    _case(
        "nearly-constant-float32",
        "1e8 everywhere but at one vertex, which has the next float32",
        _one_ulp,
    ),
    _case(
        "nearly-constant-float64",
        "1e8 + 1e-3: a range of 1e-11 of the offset",
        _offset(1e8, 1e-3, "float64"),
    ),
    _case(
        "offset-float32",
        "a range of a few float32 steps of the offset",
        _offset(1e8, 100.0, "float32"),
    ),
    _case(
        "range-float32",
        "magnitudes 1e-38 to 1e38 of both signs",
        lambda: _magnitudes(38, "float32"),
        {**QUICK, **EXACT},
    ),
    _case(
        "range-float64",
        "magnitudes 1e-307 to 1e307 of both signs",
        lambda: _magnitudes(307, "float64"),
        {**QUICK, **EXACT},
    ),
    _case(
        "range-float16",
        "all of float16, denormals too",
        lambda: _magnitudes(4.8, "float16"),
        {**QUICK, **EXACT},
    ),
    _case(
        "range-overflows",
        "a range that overflows float64: -1.7e308 to 1.7e308",
        lambda: 1.7e308 * (2 * waves() - 1),
    ),
    _case(
        "tiny-range",
        "values of 1e-30, a range of 1e-33",
        _offset(1e-30, 1e-33, "float64"),
        quick=False,
    ),
    _case(
        "denormals-float32",
        "denormal numbers only",
        lambda: _denormals("float32"),
        {**QUICK, **EXACT},
    ),
    _case(
        "denormals-float64",
        "denormal numbers only",
        lambda: _denormals("float64"),
        {**QUICK, **EXACT},
    ),
    _case(
        "denormals-and-ordinary", "denormals beside values of order 1", _denormals_beside_ordinary
    ),
    _case("signed-zero", "0 and -0 alternate, one vertex is 1", _signed_zero, {**QUICK, **EXACT}),
    _case(
        "isolated-missing",
        "single NaN, Inf and -Inf: NaN at these vertices only",
        _isolated,
    ),
    _case(
        "missing-frames",
        "first and last frame all NaN",
        _with(np.nan, lambda t, z, y, x: (t == 0) | (t == 3)),
    ),
    _case(
        "infinite-frame", "a frame all Inf", _with(np.inf, lambda t, z, y, x: t == 1), quick=False
    ),
    _case(
        "missing-columns",
        "columns that are NaN at all times and heights",
        _with(np.nan, lambda t, z, y, x: (x == 0) | (y == 4)),
    ),
    _case(
        "moving-mask",
        "a hole of NaN that moves in time",
        _with(np.nan, _hole, "float64"),
        {**QUICK, **DEFAULT},
    ),
    _case(
        "missing-checkerboard",
        "every second vertex is -Inf",
        _with(-np.inf, lambda t, z, y, x: (t + z + y + x) % 2 == 0),
    ),
    _case("one-finite-value", "a single value is finite", _one_finite),
    _case(
        "nothing-finite",
        "refused: there is nothing to encode",
        _constant(np.nan, "float32"),
        more={},
        refused="no finite value in any of",
    ),
    *(
        _case(
            f"all-of-{dtype}",
            "both ends of the type, smooth and noise",
            _integers(dtype),
            COUNTED,
            quick=dtype in ("int8", "uint32"),
        )
        for dtype in INTEGERS[:6]
    ),
    *(
        _case(
            f"all-of-{dtype}",
            "both ends of the type, smooth and noise",
            _integers(dtype),
            OF_64_BITS,
            more={},
        )
        for dtype in INTEGERS[6:]
    ),
    _case(
        "beyond-float64",
        "integers near 2^62 that differ by less than float64 can represent",
        _beyond_floats,
        WIDE,
        more={},
    ),
    _case(
        "beyond-float64-exactly",
        "integers near 2^62 with a bound of 0, which keeps them exactly",
        _beyond_floats,
        EXACT,
        more={},
    ),
    _case(
        "other-byte-order",
        "values in the other byte order",
        lambda: waves().astype(np.dtype("float32").newbyteorder("S")),
    ),
    Case(
        name="declared-range",
        group="values",
        about="a file with a fill value and values outside its valid_range, which are data",
        make=_from_file,
        settings=QUICK,
        more=MORE,
        checks=(_declared_values,),
    ),
)
