"""Choice of the transform along each axis, by trial on bytes.

Candidates are coded on a sample at one step. The cost J = bytes + squared error / (0.8 step^2)
decides, so that a transform of less error for the same bytes wins as well. The plane, time and z
are decided one after the other, and then whether time needs a transform at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from fhash_codec.compact.choices.bases import Bases, CountedBases, TileSample
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
"""Transforms along (t, z, y, x)."""
NONE = AxisTransform(kind="none")
"""Marks an axis without a transform."""
PLANE_WAVELETS = (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2))
"""Kinds and depths tried along y and x.

5/3 wins under tight bounds alone, and is never much better at another depth.
"""
LINE_WAVELETS = (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1))
"""Kinds and depths tried along t and along z."""
ROUGH_WAVELETS = (("haar", 2), ("9/7", 1), ("9/7", 3))
"""Kinds and depths tried beside the usual ones where tilings are compared."""
ERROR_PRICE = 0.8
"""Squared error in squared steps that is worth a byte."""
BASIS_TEXT = 1.03
"""Bytes in the file for each byte of a packed basis: it stands there as deflated base64."""


def wavelet(kind: str, depth: int, length: int) -> AxisTransform:
    """Return a wavelet of at most this depth for an axis of `length` vertices.

    It is less deep on a short axis; an axis of one vertex gets no transform.
    """
    depth = min(depth, max(0, (length - 1).bit_length()))
    return AxisTransform(kind=kind, depth=depth) if depth else NONE


def usual_transform(shape: Shape) -> TransformSpec:
    """Return a good guess without trial: 9/7 along all axes, deepest in the plane."""
    t, z, y, x = shape
    depth = min(4, max(1, max(y, x).bit_length() - 2))
    return TransformSpec(
        axes=(wavelet("9/7", 2, t), wavelet("9/7", 2, z), *_plane("9/7", depth, y, x))
    )


def choose_transform(
    sample: TileSample, settings: TileSettings, coding: Coding, *, quick: bool = False
) -> tuple[TileSettings, float]:
    """Return settings with the transform of the lowest J on the sample, and that J.

    quick: tries only the kinds of the settings, the usual ones, and the data's own bases in the
        plane and along z.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings)
    if quick:
        trials = _quick_trials(shape, settings.transform.axes, bases)
        costs = _costs(sample, settings, trials, coding)
        lowest = min(costs)
        axes = trials[costs.index(lowest)]
        return replace(settings, transform=TransformSpec(axes=axes)), lowest
    axes = settings.transform.axes
    lowest = math.inf
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
        _time_again(shape),
    )
    along_z = axes[1]
    for changes in groups:
        if changes is groups[-1] and axes[1] is along_z:
            break  # nothing is new since time was chosen
        changed = [_changed(axes, change) for change in changes]
        trials = [
            *([axes] if math.isinf(lowest) else []),
            *(candidate for candidate in changed if candidate != axes),
        ]
        costs = _costs(sample, settings, trials, coding)
        if trials and min(costs) < lowest:
            lowest = min(costs)
            axes = trials[costs.index(lowest)]
    return replace(settings, transform=TransformSpec(axes=axes)), lowest


def likely_transform(sample: TileSample, settings: TileSettings, coding: Coding) -> TileSettings:
    """Return settings with what `choose_transform` is likely to find, by few trials.

    The usual transform competes with the data's own bases along time, in space, and along both.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases, usual = Bases(sample, settings), usual_transform(shape).axes
    trials = [usual]
    in_space, in_time = bases.possible(*shape[1:]), bases.possible(shape[0])
    if in_space:
        trials.append((usual[0], bases.along(1), bases.along(2), bases.along(3)))
    if in_time:
        trials += [(bases.along(0), *axes[1:]) for axes in trials[:]]
    costs = _costs(sample, settings, trials, coding)
    return replace(settings, transform=TransformSpec(axes=trials[costs.index(min(costs))]))


def rough_transform(
    sample: TileSample,
    settings: TileSettings,
    coding: Coding,
    known: dict[int, AxisTransform],
    lines: int,
) -> tuple[TileSettings, Outcome | None]:
    """Return settings with a good transform by very few trials, to compare tilings with.

    Beside them is their outcome on the sample; None where nothing was tried.

    known: transforms of axes that need no trial, such as those of the same axis elsewhere.
    lines: of each tile, that the data's own bases are fitted on.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings, lines)
    axes = _changed(usual_transform(shape).axes, known)
    best: tuple[float, Axes, Outcome | None] = (math.inf, axes, None)
    for axis in (0, 1):
        if axis in known or shape[axis] == 1:
            continue
        tried = [wavelet(kind, depth, shape[axis]) for kind, depth in ROUGH_WAVELETS]
        kinds = list(dict.fromkeys([best[1][axis], *tried]))
        if axis == 0 and bases.possible(shape[0]):
            kinds.append(bases.along(0))
        trials = [_changed(best[1], {axis: kind}) for kind in kinds]
        fresh = [trial for trial in trials if best[2] is None or trial != best[1]]
        best = min([best, *_tried(sample, settings, fresh, coding)], key=lambda trial: trial[0])
    if bases.possible(*shape[1:]):
        own = (best[1][0], bases.along(1), bases.along(2), bases.along(3))
        trials = [own] if best[2] is not None else [axes, own]
        if 0 not in known and best[1][0].basis is None and bases.possible(shape[0]):
            # A basis along time may be good with bases in space alone.
            trials.append((bases.along(0), *own[1:]))
        best = min([best, *_tried(sample, settings, trials, coding)], key=lambda trial: trial[0])
    return replace(settings, transform=TransformSpec(axes=best[1])), best[2]


def own_or_found(
    sample: TileSample, settings: TileSettings, found: Axes, coding: Coding
) -> TileSettings:
    """Return settings with transforms that were found on a part, or with own bases in space.

    found: the transforms along (t, z, y, x); bases among them are made anew for the sample.
    """
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings)
    axes = _changed(
        found,
        {
            axis: (
                bases.along(axis)
                if transform.basis is not None and bases.possible(shape[axis])
                else _fitted(transform, shape[axis])
            )
            for axis, transform in enumerate(found)
        },
    )
    usual = usual_transform(shape).axes
    trials = [axes]
    if axes[3].basis is not None:
        trials.append((*axes[:2], *usual[2:]))
    elif bases.possible(*shape[1:]):
        trials.append((axes[0], bases.along(1), bases.along(2), bases.along(3)))
    costs = _costs(sample, settings, trials, coding) if len(trials) > 1 else [0.0]
    return replace(settings, transform=TransformSpec(axes=trials[costs.index(min(costs))]))


def count_trials(shape: Shape, *, in_memory: bool) -> tuple[int, int]:
    """Return the codings of a sample by `choose_transform`, and the bases that it fits.

    The second look at time, which few series have, is not counted.

    shape: of a tile.
    in_memory: whether the series is, so that bases are possible.
    """

    bases = CountedBases(in_memory)
    axes = usual_transform(shape).axes
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
    )
    trials = 1 + sum(_changed(axes, change) != axes for group in groups for change in group)
    return trials, len(bases.fitted)


def basis_bytes(transform: TransformSpec) -> float:
    """Return the bytes that the data's own bases take in the file."""
    packed = (axis.basis.to_bytes() for axis in transform.axes if axis.basis is not None)
    return BASIS_TEXT * sum(map(len, packed))


def refit(sample: TileSample, settings: TileSettings, coarser: float = 1.0) -> TileSettings:
    """Return settings with the data's own bases made anew for their step.

    Settings without such bases are returned themselves, the same object.

    coarser: factor of the step that the bases are as precise as.
    """
    axes = settings.transform.axes
    if not any(axis.basis is not None for axis in axes):
        return settings
    bases = Bases(sample, replace(settings, step=coarser * settings.step))
    fresh = {
        number: bases.along(number) for number, axis in enumerate(axes) if axis.basis is not None
    }
    return replace(settings, transform=TransformSpec(axes=_changed(axes, fresh)))


def _changed(axes: Axes, change: dict[int, AxisTransform]) -> Axes:
    """Return transforms with some replaced, by the number of the axis."""
    t, z, y, x = (change.get(number, axis) for number, axis in enumerate(axes))
    return t, z, y, x


def _quick_trials(shape: Shape, axes: Axes, bases: Bases) -> list[Axes]:
    """Return the usual transform, the kinds of `axes`, and bases where they are possible."""
    usual = usual_transform(shape).axes
    t, z, y, x = (_fitted(axis, length) for axis, length in zip(axes, shape, strict=True))
    trials = [usual, (t, z, y, x)]
    if bases.possible(*shape[1:]):
        trials.append((usual[0], bases.along(1), bases.along(2), bases.along(3)))
    return trials


def _fitted(axis: AxisTransform, length: int) -> AxisTransform:
    """Return the same kind for another length; 9/7 for a basis, which fits one length only."""
    if axis.basis is not None:
        return wavelet("9/7", 2, length)
    return wavelet(axis.kind, axis.depth, length) if axis.wavelet else axis


def _costs(
    sample: TileSample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[float]:
    """Return J of each trial."""
    return [cost for cost, _, _ in _tried(sample, settings, trials, coding)]


def _tried(
    sample: TileSample, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[tuple[float, Axes, Outcome]]:
    """Return J of each trial, beside the trial and its outcome."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        bases = basis_bytes(TransformSpec(axes=axes))
        # Under a bound, bytes of the residual correct the errors already.
        error = 0.0
        if coding.error is None:
            error = outcome.squares / (ERROR_PRICE * settings.step**2)
        return outcome.size + bases + error

    outcomes = sample.run_all(
        [(replace(settings, transform=TransformSpec(axes=axes)), coding) for axes in trials]
    )
    return [
        (cost(axes, outcome), axes, outcome) for axes, outcome in zip(trials, outcomes, strict=True)
    ]


def _plane(kind: str, depth: int, y: int, x: int) -> tuple[AxisTransform, AxisTransform]:
    """Return a wavelet along y and x, of one depth where both have more than one vertex."""
    if min(y, x) > 1:
        depth = min(depth, max(1, (max(y, x) - 1).bit_length()))
        return AxisTransform(kind=kind, depth=depth), AxisTransform(kind=kind, depth=depth)
    return wavelet(kind, depth, y), wavelet(kind, depth, x)


def _plane_trials(shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along y and x."""
    y, x = shape[2:]
    for kind, depth in PLANE_WAVELETS:
        if 2 ** (depth - 1) < max(y, x):
            along_y, along_x = _plane(kind, depth, y, x)
            yield {2: along_y, 3: along_x}
    if bases.possible(y, x):
        yield {2: bases.along(2), 3: bases.along(3)}


def _time_again(shape: Shape) -> Iterator[dict[int, AxisTransform]]:
    """Yield what is tried along time once more, after the choice along z.

    Of a thin shell that moves, steps have nothing in common; beside a wavelet along z that does no
    good either, this was not seen.
    """
    if shape[0] > 1:
        yield {0: NONE}


def _line_trials(axis: int, shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along one axis."""
    length = shape[axis]
    if length == 1:
        return
    yield {axis: NONE}
    for kind, depth in LINE_WAVELETS:
        if 2 ** (depth - 1) < length:
            yield {axis: AxisTransform(kind=kind, depth=depth)}
    if bases.possible(length):
        yield {axis: bases.along(axis)}
