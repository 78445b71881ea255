"""What a tracker reads: against products of matrices, and derivatives by differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stiffopt.identify.sensing import Readings, readings

Array = NDArray[np.float64]

COUNT = 7
RANDOM = np.random.default_rng(0)


def motion(twist: Array) -> Array:
    """Transform (4, 4) of a twist, linear part first."""
    v, (x, y, z) = twist[:3], twist[3:]
    generator = np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])
    return np.asarray(expm(generator))


def pose(size: float = 1.0) -> Array:
    return motion(RANDOM.normal(0, size, 6))


POINT = np.array([pose() for _ in range(COUNT)])
BASE, SENSOR = pose(), pose(0.3)
TWISTS = RANDOM.normal(0, 0.3, (2, 6))
POSES = np.array([BASE @ motion(TWISTS[0]) @ T @ motion(TWISTS[1]) @ SENSOR for T in POINT])
ERRORS = RANDOM.normal(0, 0.2, (COUNT, 3))  # of the measured orientations, in the sensor's axes
MEASURED = POSES[:, :3, :3] @ Rotation.from_rotvec(-ERRORS).as_matrix()


def read(change: Array | None = None, measured: Array | None = MEASURED) -> Readings:
    """Readings after a change (18,) of the point, the base and the sensor."""
    d = np.zeros(18) if change is None else change
    point = np.array([T @ motion(d[:6]) for T in POINT])
    # the derivatives are by the coordinates of the twists, not by further moves
    return readings(point, BASE, TWISTS[0] + d[6:12], SENSOR, TWISTS[1] + d[12:], measured)


def test_position_is_that_of_the_product() -> None:
    assert read().position == pytest.approx(POSES[:, :3, 3], rel=1e-12, abs=1e-12)


def test_turn_is_from_what_was_measured_to_what_is_read() -> None:
    turn = read().turn
    assert turn is not None
    angle = np.linalg.norm(ERRORS, axis=1)
    assert turn == pytest.approx(ERRORS * (np.sin(angle) / angle)[:, None], abs=1e-12)


@pytest.mark.parametrize("i", range(18))
def test_derivatives(i: int) -> None:
    step = 1e-6
    up, down = (read(sign * step * np.eye(18)[i]) for sign in (1, -1))
    found = read()
    assert found.turn_per_twist is not None
    assert up.turn is not None
    assert down.turn is not None
    moved = (up.position - down.position) / (2 * step)
    turned = (up.turn - down.turn) / (2 * step)
    assert found.per_twist[:, :, i] == pytest.approx(moved, abs=1e-8)
    assert found.turn_per_twist[:, :, i] == pytest.approx(turned, abs=1e-8)


def test_derivatives_where_nothing_has_moved_yet() -> None:
    still = np.zeros(6)
    found = readings(POINT, BASE, still, SENSOR, still, None)
    step = 1e-6
    for i in range(6):
        change = step * np.eye(6)[i]
        up, down = (readings(POINT, BASE, s * change, SENSOR, still, None) for s in (1, -1))
        expected = (up.position - down.position) / (2 * step)
        assert found.per_twist[:, :, 6 + i] == pytest.approx(expected, abs=1e-8)


def test_without_orientations() -> None:
    found = read(measured=None)
    assert found.turn is None
    assert found.turn_per_twist is None
    assert found.position == pytest.approx(read().position)


def test_a_missing_orientation_spoils_its_own_row_only() -> None:
    measured = MEASURED.copy()
    measured[2] = np.nan
    found, whole = read(measured=measured), read()
    assert found.turn is not None
    assert whole.turn is not None
    assert np.isnan(found.turn[2]).all()
    others = np.arange(COUNT) != 2
    assert found.turn[others] == pytest.approx(whole.turn[others])
    assert found.position == pytest.approx(whole.position)
    assert np.isfinite(found.per_twist).all()
