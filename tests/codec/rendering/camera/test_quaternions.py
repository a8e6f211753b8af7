"""Rotations as quaternions, and curves through them."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.quaternions import from_matrix, spline, to_matrix


def turn(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """The quaternion of a turn about a unit axis."""
    half = np.radians(degrees) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


@pytest.mark.parametrize(
    "axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)]
)
@pytest.mark.parametrize("degrees", [0.0, 1e-9, 30.0, 179.0, 180.0])
def test_a_matrix_comes_back_from_its_quaternion(
    axis: tuple[float, float, float], degrees: float
) -> None:
    matrix = to_matrix(turn(axis, degrees))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(matrix @ axis, axis, atol=1e-12)
    np.testing.assert_allclose(to_matrix(from_matrix(matrix)), matrix, atol=1e-12)


def test_a_matrix_turns_vectors_anticlockwise() -> None:
    np.testing.assert_allclose(to_matrix(turn((0, 0, 1), 90)) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_two_rotations_are_joined_by_the_shorter_turn_at_one_speed() -> None:
    at, axis = np.array([0.0, 2.0]), (0.0, 0.6, 0.8)
    for sign in (1, -1):  # both quaternions of one rotation
        rotations = np.array([turn(axis, 20), sign * turn(axis, 80)])
        for share, degrees in ((0.0, 20), (0.5, 35), (1.0, 50), (2.0, 80)):
            np.testing.assert_allclose(
                to_matrix(spline(at, rotations, share)), to_matrix(turn(axis, degrees)), atol=1e-12
            )


def test_a_curve_passes_through_its_rotations_and_stays_of_unit_length() -> None:
    at = np.array([0.0, 0.3, 0.5, 1.0])
    rotations = np.array(
        [turn((1, 0, 0), 10), turn((0, 1, 0), 80), turn((0, 0, 1), 170), turn((0.6, 0, 0.8), 60)]
    )
    for share, rotation in zip(at, rotations, strict=True):
        np.testing.assert_allclose(
            to_matrix(spline(at, rotations, share)), to_matrix(rotation), atol=1e-9
        )
    lengths = [np.linalg.norm(spline(at, rotations, share)) for share in np.linspace(0, 1, 41)]
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-9)
