"""Obstacle `mesh`: a closed surface of triangles from a file."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from pydantic import ValidationInfo, field_serializer, field_validator, model_validator

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Quaternion
from stiffopt.errors import InputError
from stiffopt.files import folder_of
from stiffopt.model.description import RobotDescription
from stiffopt.model.distance_grid import (
    DistanceGrid,
    Surface,
    distance_of,
    grids_about,
    read_surface,
    usual_spacing,
)
from stiffopt.model.obstacle import Obstacle, Point, Radius, norm
from stiffopt.schema import BadKeyError

_PLAUSIBLE = (0.02, 50.0)  # range of a mesh's extent over the arm's length


class Mesh(Obstacle):
    """A closed surface of triangles from an STL or OBJ file.

    Its distance is interpolated in a grid and reduced by the largest possible excess: at most
    `grid_error`, and at a distance v about ``resolution^2 / (4 v)``.
    Farther from the mesh than 150 mm and than its own size, a lower bound replaces its distance.

    Attributes
    ----------
    file : path of the file; in files relative to these.
    scale : length of one unit of the file, in m.
    centre : position of the file's origin, in m.
    orientation : unit quaternion (w, x, y, z) of the file's axes in the base frame.
    resolution : edge of the grid's cubes, in m, or None for the default.
    """

    key = "mesh"
    along = "any"
    n_parameters = 27
    is_interpolated = True

    file: Path
    scale: Radius
    centre: Point = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    resolution: Radius | None = None

    @field_validator("file", mode="after")
    @classmethod
    def _from_its_folder(cls, file: Path, info: ValidationInfo) -> Path:
        return folder_of(info) / file

    @field_serializer("file", when_used="json")
    def _write_file(self, file: Path) -> str:
        return str(file.absolute())

    @model_validator(mode="after")
    def _check(self) -> Mesh:
        try:
            _ = self.surface
        except InputError as error:
            raise BadKeyError("file", str(error)) from None
        return self

    @cached_property
    def surface(self) -> Surface:
        """The triangles, in the file's axes and in m."""
        try:
            changed = self.file.stat().st_mtime_ns
        except (OSError, ValueError):
            raise InputError(f"there is no file '{self.file}'") from None
        return read_surface(self.file.absolute(), changed, self.scale)

    @property
    def spacing(self) -> float:
        """Edge of the cubes of the finer grid, in m."""
        return self.resolution or usual_spacing(self.surface)

    @property
    def grid_error(self) -> float:
        """Largest error of the interpolated distance, in m."""
        return _share_of_cube * self.spacing

    def error_at(self, distance: float) -> float:
        """Return the amount subtracted from interpolated distances; see `Obstacle.error_at`."""
        return float(_excess_bound(ca.DM(distance), self.spacing))

    @cached_property
    def grids(self) -> tuple[DistanceGrid, ...]:
        """The distances, a grid for each piece; cached in the cache folder."""
        return grids_about(self.surface, self.spacing)

    @cached_property
    def _axes(self) -> Array:
        return np.asarray(lie.rotation_from_quaternion(np.array(self.orientation)))

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return a lower bound of the distance from the corners of the grid's cube.

        Outside the grid, the whole mesh is beyond the nearest point b of the grid's box and at
        least ``d(b)`` from it: ``|x - y|^2 >= |x - b|^2 + |b - y|^2``.
        """
        seen, inside, cell = _located(point, parameters)
        spacing, corners = parameters[15], parameters[19:27]
        share = (inside - parameters[12:15]) / spacing - cell
        for axis in range(3):  # corners[4 i + 2 j + k]
            half = corners.numel() // 2
            corners = (1 - share[axis]) * corners[:half] + share[axis] * corners[half:]
        low = corners - _excess_bound(corners, spacing)
        beyond = norm(seen - inside)
        return low + ca.sqrt(beyond**2 + low**2 + 1e-24) - ca.sqrt(low**2 + 1e-24)

    @staticmethod
    def cell(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the grid's cube (3,) that contains a point or is nearest to it."""
        return _located(point, parameters)[2]

    @property
    def pieces(self) -> list[list[float]]:
        """Axes, centre, and for each grid origin, edge and numbers of cubes; corners are 0 here."""
        placed = [*self._axes.ravel(order="F").tolist(), *self.centre]
        return [
            [*placed, *grid.origin.tolist(), grid.spacing, *grid.cells, *[0.0] * 8]
            for grid in self.grids
        ]

    def distance_of(self, point: Any) -> float:
        """Return the signed distance of one point (3,) from the triangles themselves, in m."""
        seen = (np.asarray(point, dtype=float) - np.array(self.centre)) @ self._axes
        return distance_of(self.surface, tuple(seen.tolist()))

    def check_against(self, robot: RobotDescription, clearance: float) -> None:
        """Require a plausible size for this arm; see `Obstacle.check_against`."""
        extent = float(self.surface.extent.max())
        low, high = _PLAUSIBLE
        if not low * robot.length <= extent <= high * robot.length:
            raise BadKeyError(
                f"{self.key}.scale",
                f"the mesh is {extent * 1e3:.4g} mm across and the arm "
                f"{robot.length * 1e3:.4g} mm long; expected the length of one unit of the file: "
                "1 mm for files in millimetres, 1 m for files in metres",
            )
        try:
            self.grids  # noqa: B018 (compute them now)
        except InputError as error:
            raise BadKeyError(f"{self.key}.resolution", str(error)) from None
        super().check_against(robot, clearance)

    def outline(self, size: float) -> list[Array]:
        """Return its triangles, (3, m, 3); see `Obstacle.outline`."""
        corners = self.surface.vertices @ self._axes.T + np.array(self.centre)
        triangles: Array = corners[self.surface.faces]  # (m, 3, 3)
        return [np.moveaxis(triangles, 2, 0)]


_share_of_cube = float(np.sqrt(3) / 2)


def _located(point: ca.SX, parameters: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return a point in the file's axes, the grid's nearest point, and that point's cube."""
    seen = ca.reshape(parameters[:9], 3, 3).T @ (point - parameters[9:12])
    origin, spacing, cells = parameters[12:15], parameters[15], parameters[16:19]
    inside = ca.fmin(ca.fmax(seen, origin), origin + spacing * cells)
    cell = ca.fmin(ca.floor((inside - origin) / spacing), cells - 1)
    return seen, inside, cell


def _excess_bound(value: ca.SX, spacing: ca.SX) -> ca.SX:
    """Return an upper bound on the excess of an interpolated distance.

    Distances change by no more than the path between points: by half the diagonal of a cube.
    Outside, they are the least of distances |x - y| of points, each of which is convex, with second
    derivatives along the three axes that sum to 2 / |x - y|; linear interpolation over an edge h is
    too large by h^2 / 8 of these. Within the cube |x - y| is at least the value less the diagonal.
    The bound returned decreases by at most half the increase of the value.
    """
    away = value / spacing - 2 * _share_of_cube
    smallest = 1 / (4 * ca.fmax(away, 1 / (4 * _share_of_cube)))
    slope = _share_of_cube - 0.5 * (away - 1 / (4 * _share_of_cube))
    return spacing * ca.fmin(ca.fmax(smallest, slope), _share_of_cube)
