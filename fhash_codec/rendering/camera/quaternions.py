"""Unit quaternions (w, x, y, z) as rotations, and smooth curves through several of them."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

__all__ = ["from_matrix", "spline", "to_matrix"]

Floats = npt.NDArray[np.float64]

SMALL = 1e-12
"""Angle in radians below which the sine is taken for the angle."""


def spline(at: Floats, rotations: Floats, share: float) -> Floats:
    """Interpolate rotations smoothly, by the shorter turn between each two.

    The curve consists of cubic Bezier curves on the sphere of quaternions (Shoemake, Animating
    Rotation with Quaternion Curves, 1985).

    Args:
        at: shares (n,), strictly ascending, n >= 2.
        rotations: quaternions (n, 4) at these shares.
        share: between the first and the last of them.
    """
    rotations = rotations.copy()
    for number in range(1, len(rotations)):
        # A quaternion and its negative are one rotation; the nearer one is the shorter turn.
        if rotations[number] @ rotations[number - 1] < 0:
            rotations[number] *= -1
    width = np.diff(at)
    speeds = (
        np.array(
            [
                _log(_product(_inverse(first), second))
                for first, second in itertools.pairwise(rotations)
            ]
        )
        / width[:, None]
    )
    tangents = np.concatenate([speeds[:1], speeds])
    for number in range(1, len(speeds)):
        before, after = width[number - 1], width[number]
        tangents[number] = (after * speeds[number - 1] + before * speeds[number]) / (before + after)
    piece = int(np.clip(np.searchsorted(at, share, side="right") - 1, 0, len(speeds) - 1))
    h, (first, last) = width[piece], rotations[piece : piece + 2]
    points = [
        first,
        _product(first, _exp(tangents[piece] * h / 3)),
        _product(last, _exp(-tangents[piece + 1] * h / 3)),
        last,
    ]
    t = (share - float(at[piece])) / h
    # De Casteljau's algorithm, with arcs in place of lines.
    while len(points) > 1:
        points = [_between(start, end, t) for start, end in itertools.pairwise(points)]
    return np.asarray(points[0], dtype=np.float64)


def from_matrix(matrix: Floats) -> Floats:
    """Convert a rotation matrix (3, 3), by its largest component, which is never near 0.

    Source: Shepperd, Quaternion from Rotation Matrix, 1978.
    """
    trace = float(np.trace(matrix))
    candidates = np.array([trace, *np.diag(matrix)])
    largest = int(np.argmax(candidates))
    twice = (
        np.sqrt(max(1 - trace + 2 * candidates[largest], 0.0)) if largest else np.sqrt(1 + trace)
    )
    wx, wy, wz = (
        matrix[2, 1] - matrix[1, 2],
        matrix[0, 2] - matrix[2, 0],
        matrix[1, 0] - matrix[0, 1],
    )
    xy, xz, yz = (
        matrix[0, 1] + matrix[1, 0],
        matrix[0, 2] + matrix[2, 0],
        matrix[1, 2] + matrix[2, 1],
    )
    rows = ((0, wx, wy, wz), (wx, 0, xy, xz), (wy, xy, 0, yz), (wz, xz, yz, 0))
    rotation = np.array(rows[largest], dtype=np.float64) / (2 * twice)
    rotation[largest] = twice / 2
    return np.asarray(rotation / np.linalg.norm(rotation), dtype=np.float64)


def to_matrix(rotation: Floats) -> Floats:
    """Convert a quaternion to a rotation matrix (3, 3)."""
    w, x, y, z = rotation / np.linalg.norm(rotation)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _between(first: Floats, second: Floats, t: float) -> Floats:
    """The rotation at `t`, 0..1, of the turn from one rotation to another."""
    return _product(first, _exp(t * _log(_product(_inverse(first), second))))


def _product(a: Floats, b: Floats) -> Floats:
    return np.array(
        [a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))]
    )


def _inverse(a: Floats) -> Floats:
    return np.asarray(a * np.array([1.0, -1.0, -1.0, -1.0]), dtype=np.float64)


def _log(a: Floats) -> Floats:
    """Half the angle of a rotation, as a vector (3,) along its axis."""
    sine = float(np.linalg.norm(a[1:]))
    return np.asarray(
        a[1:] * (np.arctan2(sine, a[0]) / sine if sine > SMALL else 1.0), dtype=np.float64
    )


def _exp(half: Floats) -> Floats:
    """The rotation of twice the angle of a vector (3,) along its axis."""
    angle = float(np.linalg.norm(half))
    return np.array([np.cos(angle), *(half * (np.sin(angle) / angle if angle > SMALL else 1.0))])
