"""Cases of fronts: noise, spikes, steps on and between vertices, fronts that move less than one
vertex per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases.fields import SHAPE, lattice, noise, series
from fhash_codec.selftest.cases.settings import EXACT, MORE, QUICK, Settings

__all__ = ["FRONT_CASES"]

Values = npt.NDArray[Any]


def _front_case(
    name: str,
    about: str,
    make: Callable[[], Values],
    settings: Settings = QUICK,
    dtype: str = "float32",
    **rest: Any,
) -> Case:
    def made() -> Any:
        return series(make().astype(dtype))

    return Case(
        name=name, group="fronts", about=about, make=made, settings=settings, more=MORE, **rest
    )


def _checkerboard() -> Values:
    t, z, y, x = lattice()
    return np.asarray((t + z + y + x) % 2)


def _spike() -> Values:
    values = np.zeros(SHAPE)
    values[1, 4, 5, 6] = 1e6
    return values


def _spikes() -> Values:
    t, z, y, x = lattice()
    return np.where((z % 4 == 0) & (y % 4 == 1) & (x % 4 == 2) & (t % 2 == 0), 1e6, 0.0) * np.where(
        x > 5, 1, -1
    )


def _step(place: float) -> Callable[[], Values]:
    """A step along x: 0 before `place`, 1 behind it, 0.5 on it."""
    return lambda: np.heaviside(lattice()[3] - place, 0.5)


def _front(speed: float, width: float) -> Callable[[], Values]:
    """A plane front, oblique to all axes, that moves `speed` vertices per step and is `width`
    vertices wide."""

    def make() -> Values:
        t, z, y, x = lattice()
        return np.asarray(np.tanh(((x + 2 * y + 3 * z) / np.sqrt(14) - 7.3 - speed * t) / width))

    return make


def _shell() -> Values:
    t, z, y, x = lattice()
    radius = np.sqrt((z - 4) ** 2 + (y - 4.5) ** 2 + (x - 5) ** 2)
    return np.where(radius < 1.5 + 0.3 * t, 1e3, np.where(radius < 2.5 + 0.3 * t, -1e3, 0.0))


FRONT_CASES: tuple[Case, ...] = (
    _front_case(
        "checkerboard", "0 and 1 alternate along every axis", _checkerboard, {**QUICK, **EXACT}
    ),
    _front_case(
        "checkerboard-uint8",
        "0 and 1 alternate along every axis",
        _checkerboard,
        {**QUICK, **EXACT},
        dtype="uint8",
    ),
    _front_case(
        "flicker",
        "the sign changes with every step",
        lambda: (-1) ** lattice()[0] * (1 + lattice()[3]),
    ),
    _front_case("white-noise", "white noise: no value can be predicted", noise),
    _front_case(
        "white-noise-float64",
        "white noise: no value can be predicted",
        noise,
        dtype="float64",
        quick=False,
    ),
    _front_case(
        "white-noise-int16",
        "white noise: no value can be predicted",
        lambda: 1e4 * noise(),
        {**QUICK, **EXACT},
        dtype="int16",
    ),
    _front_case("spike", "one value of 1e6, all others 0", _spike),
    _front_case("spikes", "values of 1e6 and -1e6, four vertices apart", _spikes),
    _front_case("step-on-vertex", "a step whose middle is on a vertex", _step(5.0)),
    _front_case("step-between", "a step between two vertices", _step(5.5)),
    _front_case(
        "slow-front",
        "a front narrower than a vertex that moves 0.3 vertices a step",
        _front(0.3, 0.05),
    ),
    _front_case(
        "creeping-front",
        "a front that moves 0.001 vertices a step",
        _front(0.001, 0.05),
        quick=False,
    ),
    _front_case(
        "fast-front", "a front that moves 4 vertices a step", _front(4.0, 0.05), quick=False
    ),
    _front_case("thin-shell", "a shell one vertex thick that grows 0.3 vertices a step", _shell),
)
