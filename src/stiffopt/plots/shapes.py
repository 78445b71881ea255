"""Shapes to draw: poses along the segments, meshes of objects, and the stiffness ellipsoid."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.arrays import Array
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.obstacle import Obstacle


def segment_poses(robot: Manipulator, pressures: ArrayLike, count: int) -> Array:
    """Return poses (segments, count, 4, 4) along each segment with its connector, ends included.

    `pressures`: (n,), in Pa. `count`: number of stations of each segment, at least 2.
    """
    stations = segment_stations(robot, count).ravel()
    poses = np.concatenate([np.eye(4)[None], robot.pose(pressures, stations[1:])])
    return poses.reshape(robot.n_segments, count, 4, 4)


def segment_stations(robot: Manipulator, count: int) -> Array:
    """Return arc lengths (segments, count), in m, along each segment with its connector."""
    return robot.kept(("segment stations", count), lambda: _stations(robot, count))


def _stations(robot: Manipulator, count: int) -> Array:
    lengths = [each.length + each.connector for each in robot.description.segments]
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    ends[-1] = robot.length
    return np.array([np.linspace(*pair, count) for pair in pairwise(ends)])


def surface_mesh(shape: Obstacle, length: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices and triangles of a shape; an unbounded one is cut off at about a length."""
    vertices, faces, begin = [], [], 0
    for surface in shape.outline(length):
        rows, columns = surface.shape[1:]
        corners = np.arange(rows * columns).reshape(rows, columns) + begin
        vertices.append(surface.reshape(3, -1).T)
        if shape.key == "mesh":
            faces.append(corners)  # each row is a triangle
        else:
            a, b = corners[:-1, :-1].ravel(), corners[:-1, 1:].ravel()
            c, d = corners[1:, :-1].ravel(), corners[1:, 1:].ravel()
            faces += [np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]
        begin += rows * columns
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


class StiffnessEllipsoid(NamedTuple):
    """The ellipsoid of forces f with ``f'C_vv f = 1``, in base axes.

    The square of a semi-axis is the free stiffness along it; the square root keeps thin ellipsoids
    visible.

    `stiffnesses`: (3,), along its axes, in N/m, increasing. `axes`: (3, 3), the columns,
    right-handed.
    """

    stiffnesses: Array
    axes: Array

    @classmethod
    def of(cls, compliance: ArrayLike, rotation: ArrayLike) -> StiffnessEllipsoid:
        """Return the ellipsoid of a tip with compliance (6, 6) in tip axes, and rotation (3, 3)."""
        linear, turn = np.asarray(compliance)[:3, :3], np.asarray(rotation)
        stiffness = turn @ np.linalg.inv((linear + linear.T) / 2) @ turn.T
        values, axes = np.linalg.eigh(stiffness)
        return cls(np.abs(values), axes * np.sign(np.linalg.det(axes)))

    def radii(self, largest: float) -> Array:
        """Return the semi-axes (3,), scaled to a largest one."""
        return np.asarray(largest * np.sqrt(self.stiffnesses / self.stiffnesses.max()))
