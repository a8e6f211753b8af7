"""Transforms that are worth a trial for a chunk of a shape."""

from __future__ import annotations

from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec

__all__ = ["NO_TRANSFORM", "candidates"]

Shape = tuple[int, int, int, int]
MAX_DEPTHS = (1, 1, 5, 5)
"""Most levels of a 9/7 transform along (t, z, y, x)."""
NO_TRANSFORM = TransformSpec(axes=(AxisTransform(kind="none"),) * 4)
"""The shortest description of a transform."""


def candidates(shape: Shape) -> tuple[TransformSpec, ...]:
    """The transforms to try, each once.

    9/7 along all axes; then Haar, and then no transform, along the first axis longer than 1, which
    often is time; then Haar along all axes.
    """
    first = next((axis for axis, n in enumerate(shape) if n > 1), None)
    if first is None:
        return (NO_TRANSFORM,)
    depths = [
        0 if n < 2 else max(1, min(deepest, n.bit_length() - 3))
        for n, deepest in zip(shape, MAX_DEPTHS, strict=True)
    ]
    if min(shape[2:]) >= 16:
        depths[2:] = [min(depths[2:])] * 2
    # Few chunks are long in time: there, two levels of Haar are worth it.
    haar_depth = min(2, shape[first].bit_length() - 1) if first < 2 else depths[first]
    specs = (
        _spec("9/7", depths, first, "9/7", depths[first]),
        _spec("9/7", depths, first, "haar", haar_depth),
        _spec("9/7", depths, first, "none", 0),
        _spec("haar", depths, first, "haar", haar_depth),
    )
    return tuple(dict.fromkeys(specs))


def _spec(
    kind: str, depths: list[int], first: int, first_kind: str, first_depth: int
) -> TransformSpec:
    """A wavelet of one kind along all axes with a depth, but another kind along the first axis."""
    kinds = [(kind if depth else "none", depth) for depth in depths]
    kinds[first] = (first_kind, first_depth)
    t, z, y, x = (AxisTransform(kind=name, depth=depth) for name, depth in kinds)
    return TransformSpec(axes=(t, z, y, x))
