"""Kinds of data for `fhash bench kinds`: small series that seeded NumPy code makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fhash_formats.support.values import Double, Single, Values

Settings = dict[str, Any]
Rng = np.random.Generator
Made = Values | tuple[Values, Settings]
"""Values (t, z, y, x), and settings of the encoding where they are not the defaults."""

EVERY_GOAL: tuple[Settings, ...] = ({"psnr": 45.0}, {"psnr": 60.0}, {"max_error_rel": 1e-3})
"""Settings of the further goals that some kinds are encoded for."""
ROUGHNESS = 2.5
"""Power with which amplitudes fall where nothing else is named: energy falls as k^-3, as in the
wind of weather models."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of data.

    Attributes:
        make: gives the series of a random generator and a scale, the factor of the lengths.
        chosen: whether the encoder's choices may be made on it; other kinds are only reported.
        every_goal: whether it is encoded for EVERY_GOAL, too.
        large: whether it takes minutes.
    """

    make: Callable[[Rng, float], Made]
    chosen: bool
    every_goal: bool = False
    large: bool = False

    def series(self, name: str, scale: float = 1.0) -> tuple[Values, Settings]:
        """Values (t, z, y, x) and settings, the same at each call. name: seed of the values."""
        made = self.make(np.random.default_rng(list(name.encode())), scale)
        return made if isinstance(made, tuple) else (made, {})


def _scaled(scale: float, *lengths: int) -> tuple[int, ...]:
    """Lengths of axes times a factor, at least 4; short axes stay as they are."""
    return tuple(n if n <= 4 else max(4, round(scale * n)) for n in lengths)


def _grid(lengths: Sequence[int]) -> list[Double]:
    """Positions of the vertices along each axis, 0 to 1, that broadcast together."""
    axes = ((np.arange(n) + 0.5) / n for n in lengths)
    return list(np.meshgrid(*axes, indexing="ij", sparse=True))


Point = Sequence[float] | Double
"""Three numbers (z, y, x)."""


def _away(lengths: Sequence[int], start: Point, way: Point = (0.0, 0.0, 0.0)) -> Double:
    """Squared distance (t, z, y, x) of vertices from a point that moves.

    start: its first position, 0 to 1. way: how far it moves in the whole series.
    """
    t, *space = _grid(lengths)
    z, y, x = (axis - at - far * t for axis, at, far in zip(space, start, way, strict=True))
    return np.asarray(z**2 + y**2 + x**2)


def _field(
    rng: Rng,
    lengths: Sequence[int],
    *,
    power: float = ROUGHNESS,
    span: float = 1.0,
    times: Double | None = None,
) -> Single:
    """A field (t, z, y, x) of waves of all lengths that drift and change; its deviation is 1.

    power: amplitudes fall as the wave number to it. span: duration of the series, in half turns of
    the longest waves. times: of the steps, 0 to 1; even ones if None.
    """
    steps, *space = lengths
    spacing = 1 / max(space)
    rates = [*(np.fft.fftfreq(n, spacing) for n in space[:-1]), np.fft.rfftfreq(space[-1], spacing)]
    z, y, x = np.meshgrid(*rates, indexing="ij", sparse=True)
    number = np.sqrt(z**2 + y**2 + x**2)
    number[0, 0, 0] = np.inf
    waves = rng.normal(size=(2, *number.shape))
    amplitudes = (waves[0] + 1j * waves[1]) * number**-power
    number[0, 0, 0] = 0.0
    turns = 0.5 * rng.normal(size=number.shape) * number ** (2 / 3) + 0.1 * x - 0.05 * y
    field = np.empty(tuple(lengths), np.float32)
    for step, time in enumerate(np.linspace(0, 1, steps) if times is None else times):
        turned = amplitudes * np.exp(2j * np.pi * span * time * turns)
        field[step] = np.fft.irfftn(turned, s=space, axes=(0, 1, 2))
    field /= field[0].std()
    return field


def _of_waves(*lengths: int, **options: Any) -> Callable[[Rng, float], Values]:
    """A kind that is a `_field` alone."""
    return lambda rng, scale: _field(rng, _scaled(scale, *lengths), **options)


def _shock(rng: Rng, scale: float) -> Made:
    """A plateau outside, a thin wrinkled shell that grows, a hollow inside."""
    lengths = _scaled(scale, 24, 48, 48, 48)
    t, z, y, x = _grid(lengths)
    wrinkles = 0.006 * np.cos(np.pi * (9 * z + 7 * y - 11 * x) + rng.uniform(0, 6))
    depth = 0.08 + 0.34 * np.sqrt(t) + wrinkles - np.sqrt(_away(lengths, (0.5, 0.45, 0.55)))
    inside = 0.5 + 0.5 * np.tanh(depth / 0.012)
    return np.asarray(1 + inside * (3 * np.exp(-np.abs(depth) / 0.04) - 0.8), np.float32)


def _mixing(rng: Rng, scale: float) -> Made:
    """Two layers with a sharp interface that billows roll up (Stuart's vortices)."""
    steps, *space = _scaled(scale, 20, 16, 96, 96)
    z, y, x = _grid(space)
    along = 4 * np.pi * x + 0.8 * np.sin(2 * np.pi * z + rng.uniform(0, 6)) + 0 * y
    across = 8 * (y - 0.5) + 0.1 * np.sin(6 * np.pi * z) + 0 * along
    frames = []
    for _ in range(steps):
        frames.append(np.tanh(across / 0.12) + 0.2 * np.sin(along) * np.exp(-(across**2)))
        for _ in range(4):  # back along the flow, to where the fluid of each vertex began
            swirl = np.cosh(across) - 0.6 * np.cos(along)
            moved = along - 0.1 * np.sinh(across) / swirl
            across = across + 0.1 * 0.6 * np.sin(along) / swirl
            along = moved
    return np.stack(frames).astype(np.float32)


def _noise(rng: Rng, scale: float) -> Made:
    """A smooth field, and white noise with a power 30 dB below the field's."""
    field = _field(rng, _scaled(scale, 8, 24, 48, 48), power=4.0)
    return (field + rng.normal(0, 10 ** (-30 / 20), field.shape)).astype(np.float32)


def _labels(rng: Rng, scale: float) -> Made:
    """Numbers of the nearest of 24 moving points, without loss."""
    lengths = _scaled(scale, 12, 16, 64, 64)
    points = zip(rng.uniform(0, 1, (24, 3)), rng.normal(0, 0.15, (24, 3)), strict=True)
    nearest = np.argmin([_away(lengths, *point).astype(np.float32) for point in points], axis=0)
    return rng.permutation(24).astype(np.uint8)[nearest], {"max_error": 0.0}


def _counts(rng: Rng, scale: float) -> Made:
    """Counts of particles: spots that move over a background of 4."""
    lengths = _scaled(scale, 12, 16, 48, 48)
    rates = np.full(lengths, 4.0)
    for bright in rng.uniform(50, 400, 6):
        start, way = rng.uniform(0, 1, 3), rng.normal(0, 0.2, 3)
        rates += bright * np.exp(-_away(lengths, start, way) / 0.01)
    return rng.poisson(rates).astype(np.uint16)


def _uneven(rng: Rng, scale: float) -> Made:
    """A field at random times: some steps differ much, some hardly."""
    lengths = _scaled(scale, 24, 16, 48, 48)
    times = np.cumsum(rng.exponential(size=lengths[0]) ** 2)
    return _field(rng, lengths, times=times / times[-1])


def _above(values: Values, share: float) -> tuple[Values, Settings]:
    """Values with the feature of the largest ones. share: of the vertices."""
    low = float(np.quantile(values, 1 - share))
    return values, {"features": [f"interval:{low:.6g}:inf"]}


def _moving(rng: Rng, lengths: tuple[int, ...], radius: float, width: float) -> Single:
    """A moving sphere's surface of some width, over a faint field. radius: 0 for a blob."""
    away = np.sqrt(_away(lengths, (0.5, 0.35, 0.3), (0.0, 0.3, 0.4)))
    grown = radius * (0.6 + 0.4 * _grid(lengths)[0])
    shell = 3 * np.exp(-(((away - grown) / width) ** 2))
    return np.asarray(shell + 0.2 * _field(rng, lengths), np.float32)


def _feature_shell(rng: Rng, scale: float) -> Made:
    """The feature is a thin shell that moves and grows, 2 % of the vertices."""
    return _above(_moving(rng, _scaled(scale, 12, 40, 48, 48), 0.25, 0.02), 0.02)


def _feature_blob(rng: Rng, scale: float) -> Made:
    """The feature is a compact blob that moves, 2 % of the vertices."""
    return _above(_moving(rng, _scaled(scale, 12, 40, 48, 48), 0.0, 0.15), 0.02)


def _feature_fifth(rng: Rng, scale: float) -> Made:
    """The feature is a fifth of the vertices, in ragged pieces."""
    return _above(_field(rng, _scaled(scale, 10, 24, 48, 48)), 0.2)


def _missing(rng: Rng, scale: float) -> Made:
    """An ocean: NaN over land, 30 % of the map."""
    values = _field(rng, _scaled(scale, 12, 10, 72, 72))
    height = _field(rng, (1, 1, *values.shape[2:]))
    return np.where(height > np.quantile(height, 0.7), np.float32(np.nan), values)


def _int16(rng: Rng, scale: float) -> Made:
    """A field that its source has packed as integers."""
    field = _field(rng, _scaled(scale, 12, 12, 64, 64))
    return np.rint(field * (32000 / np.abs(field).max())).astype(np.int16), {"max_error_rel": 1e-3}


def _offset(rng: Rng, scale: float) -> Made:
    """A field of range 1 about a million, in float64."""
    field = _field(rng, _scaled(scale, 8, 16, 48, 48)).astype(np.float64)
    return 1e6 + field / np.ptp(field)


KINDS: dict[str, Kind] = {
    "mixing": Kind(make=_mixing, chosen=False, every_goal=True),
    "noise": Kind(make=_noise, chosen=False, every_goal=True),
    "counts": Kind(make=_counts, chosen=False),
    "thin": Kind(make=_of_waves(40, 1, 128, 160, power=2.0), chosen=False),
    "thin-3": Kind(make=_of_waves(20, 3, 96, 112, power=2.0), chosen=False),
    "uneven": Kind(make=_uneven, chosen=False),
    "feature-shell": Kind(make=_feature_shell, chosen=False),
    "feature-fifth": Kind(make=_feature_fifth, chosen=False),
    "offset": Kind(make=_offset, chosen=False),
    "large": Kind(make=_of_waves(24, 128, 156, 160), chosen=False, large=True),
    "shock": Kind(make=_shock, chosen=True, every_goal=True),
    "wind": Kind(make=_of_waves(12, 20, 100, 100), chosen=True, every_goal=True),
    "labels": Kind(make=_labels, chosen=True),
    "many": Kind(make=_of_waves(600, 1, 24, 24, power=2.0, span=8.0), chosen=True),
    "feature-blob": Kind(make=_feature_blob, chosen=True),
    "missing": Kind(make=_missing, chosen=True),
    "single": Kind(make=_of_waves(4, 16, 32, 32, span=0.3), chosen=True),
    "int16": Kind(make=_int16, chosen=True),
}
"""Kinds by name, those that are only reported first."""
