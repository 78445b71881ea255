"""Registration: poses of a tracker and its sensor relative to the arm.

A tracker measures its sensor in its own frame; this module converts that to the tip in the base
frame.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Quaternion
from stiffopt.schema import Schema, Vector
from stiffopt.units import Length


@lru_cache(maxsize=64)
def _transform(position: tuple[float, ...], orientation: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the transform (4, 4) and its inverse, cached and read-only."""
    rotation = lie.rotation_from_quaternion(np.array(orientation))
    transform = np.asarray(lie.transform(rotation, np.array(position)))
    inverse = np.linalg.inv(transform)
    for matrix in (transform, inverse):
        matrix.flags.writeable = False
    return transform, inverse


@lru_cache(maxsize=64)
def _between(first: tuple[float, ...], last: tuple[float, ...]) -> Array:
    """Return the matrix (4, 4) that maps a quaternion q to the product first q last; cached too."""
    products = [
        lie.quaternion_product(lie.quaternion_product(first, unit), last) for unit in np.eye(4)
    ]
    matrix = np.stack(products, axis=1)
    matrix.flags.writeable = False
    return matrix


def _turned(quaternion: list[float], vector: tuple[float, ...]) -> tuple[float, ...]:
    """Rotate a vector (3,) by a unit quaternion (w, u): v + 2 w u x v + 2 u x (u x v)."""
    w, x, y, z = quaternion
    a, b, c = vector
    d, e, f = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d


def _with_sign(quaternion: Array) -> Array:
    """Return the quaternion (4,) with w >= 0; for a half turn, always the same of the two."""
    w = quaternion[0]
    if w < 0 or (w == 0 and max(quaternion, key=abs) < 0):
        return -quaternion
    return quaternion


class Placement(Schema):
    """Pose of one frame in another.

    Attributes
    ----------
    position : of its origin, in m.
    orientation : its axes, as a unit quaternion, w first.
    """

    position: Vector[Length] = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def transform(self) -> Array:
        """Return the transform (4, 4) of coordinates in this frame to those in the other."""
        return _transform(self.position, self.orientation)[0]

    def inverse(self) -> Array:
        """Return the transform (4, 4) of coordinates in the other frame to those in this."""
        return _transform(self.position, self.orientation)[1]

    @classmethod
    def of(cls, transform: Array) -> Placement:
        """Return the placement that has this transform (4, 4)."""
        quaternion = np.asarray(lie.quaternion_from_rotation(transform[:3, :3]))
        return cls(
            position=tuple(transform[:3, 3].tolist()), orientation=tuple(quaternion.tolist())
        )


class Registration(Schema):
    """Transforms that convert a tracker's readings to the pose of the tip in the base frame.

    Attributes
    ----------
    tracker_in_base : the tracker's frame in the arm's base frame.
    tip_in_sensor : the tip frame in the frame of the tracked sensor.
    """

    tracker_in_base: Placement = Placement()
    tip_in_sensor: Placement = Placement()

    def tip_in_base(self, position: Array, quaternion: Array | None) -> tuple[Array, Array | None]:
        """Return position (3,) and quaternion (4,) or None of the tip in the base frame.

        `position`, `quaternion`: of the sensor in the tracker's frame, in m and w first; without a
        quaternion the sensor's position is used for the tip.
        """
        T = self.tracker_in_base.transform()
        if quaternion is None:
            return T[:3, :3] @ position + T[:3, 3], None
        # quaternions are four times faster than products of matrices, for each sample of a tick
        tip = self.tip_in_sensor
        lever = _turned(quaternion.tolist(), tip.position)
        turn = _between(self.tracker_in_base.orientation, tip.orientation) @ quaternion
        return T[:3, :3] @ (position + lever) + T[:3, 3], _with_sign(turn)

    def then(self, correction: Registration) -> Registration:
        """Return this registration followed by a correction of its poses."""
        return Registration(
            tracker_in_base=Placement.of(
                correction.tracker_in_base.transform() @ self.tracker_in_base.transform()
            ),
            tip_in_sensor=Placement.of(
                self.tip_in_sensor.transform() @ correction.tip_in_sensor.transform()
            ),
        )

    def sensor_in_tracker(self, tip: Array) -> Array:
        """Return a perfect tracker's reading (4, 4) of a tip pose (4, 4) in the base frame."""
        return self.tracker_in_base.inverse() @ tip @ self.tip_in_sensor.inverse()
