"""The viewpoint of 3-D axes with an arm, and their scale."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, radians
from typing import Any, NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import InputError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.units import finite_number, parse_quantity

View = Sequence[float | str]
"""Elevation and azimuth: numbers in rad, or text with a unit, such as ``"20 deg"``."""

_ELEVATION = radians(14.0)
_AZIMUTH = radians(-66.0)  # x to the right, y away from the eye
_ASIDE, _BELOW, _ABOVE = 40.0, 37.0, 4.0  # points, margins for the numbers at the axes


class ViewAngles(NamedTuple):
    """A view of a standing or a hanging arm, in rad."""

    elevation: float  # of the eye above the horizontal through the arm, as the page shows it
    azimuth: float  # of the eye about the z axis of the base, from the x axis
    hangs: bool  # whether z points down on the page

    @classmethod
    def of(cls, robot: Manipulator, view: View | None = None) -> ViewAngles:
        """Return the requested view, or the default one, with x to the right.

        Raises `InputError`: the view is not two angles, or its elevation exceeds 90 deg.
        """
        hangs = robot.description.gravity[2] > 0
        if view is None:
            return cls(_ELEVATION, -_AZIMUTH if hangs else _AZIMUTH, hangs)
        if isinstance(view, str) or len(view) != 2:
            raise InputError(
                f"view: expected an elevation and an azimuth, such as ('20 deg', '-60 deg'); "
                f"got {shown(view)}"
            )
        elevation, azimuth = (_angle(angle) for angle in view)
        if abs(elevation) > radians(90.0):
            raise InputError(f"view: the elevation is above 90 deg; got {degrees(elevation):g} deg")
        return cls(elevation, azimuth, hangs)

    def set(self, axes: Any) -> None:
        """Set the view of axes."""
        axes.view_init(
            elev=degrees(-self.elevation if self.hangs else self.elevation),
            azim=degrees(self.azimuth),
            roll=180 if self.hangs else 0,
        )


def _angle(angle: float | str) -> float:
    if isinstance(angle, str):
        return parse_quantity(angle, "rad", "angle of a view")
    return finite_number(angle)


def fill_panel(axes: Any) -> None:
    """Make the box of 3-D axes, whose limits and view are set, as large as possible.

    By default, matplotlib leaves enough room for any view.
    """
    x, y = projected(axes, box_corners(axes))
    axes.apply_aspect()
    size = axes.bbox.width / axes.get_figure(root=True).dpi * 72  # points
    aside, below, above = (min(share / size, 0.3) for share in (_ASIDE, _BELOW, _ABOVE))
    side = max(np.ptp(x) / (1 - 2 * aside), np.ptp(y) / (1 - below - above))
    left = (x.min() + x.max() - side) / 2
    low = (y.min() + y.max() - side * (1 + below - above)) / 2
    axes.viewLim.intervalx = (left, left + side)
    axes.viewLim.intervaly = (low, low + side)
    axes.stale = True


def move_to_the_right(axes: Any) -> None:
    """Move the box of 3-D axes from the middle to the right, to make room for a legend.

    `fill_panel` must have set their limits.
    """
    x, _ = projected(axes, box_corners(axes))
    left, right = axes.viewLim.intervalx
    size = axes.bbox.width / axes.get_figure(root=True).dpi * 72  # points
    end = min(right, x.max() + (right - left) * min(_ASIDE / size, 0.3))
    axes.viewLim.intervalx = (end - (right - left), end)
    axes.stale = True


def box_corners(axes: Any) -> Array:
    """Return the corners (8, 3) of the box of 3-D axes."""
    limits = axes.get_xlim(), axes.get_ylim(), axes.get_zlim()
    return np.stack(np.meshgrid(*limits, indexing="ij"), axis=-1).reshape(8, 3)


def projected(axes: Any, points: Array) -> Array:
    """Project points (k, 3) to the picture (2, k), in data units of its plane."""
    from mpl_toolkits.mplot3d import proj3d

    return np.asarray(proj3d.proj_transform(*points.T, axes.get_proj())[:2])
