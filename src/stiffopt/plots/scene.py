"""Draw the objects of a scene in 3-D axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.model.scene import Scene
from stiffopt.plots import style

_SHADES = {"inside_tube": 0.12, "half_space": 0.2}
_SHADE = 0.45


def draw_objects(axes: Any, scene: Scene, size: float, seen: Array) -> tuple[Array, list[Array]]:
    """Draw a scene's objects, in the display unit of lengths.

    Parameters
    ----------
    axes : in 3-D.
    scene : the objects around the arm.
    size : length of the arm, in that unit; unbounded objects are cut off at about it.
    seen : (k, 3), points that the figure shows anyway, in that unit.

    Returns
    -------
    near : (j, 3)
        Points that the figure should show too: those of objects near the others.
    middles : list of (3,)
        For each object, a point for its name.
    """
    near, middles, unit = [seen], [], display_units().length
    low, high = seen.min(axis=0) - 0.6 * size, seen.max(axis=0) + 0.6 * size
    for item in scene.objects:
        shade = _SHADES.get(item.shape.key, _SHADE)
        for surface in item.shape.outline(unit.to_si(size)):
            _draw_surface(axes, unit.of(surface), shade, item.shape.key == "mesh")
            points = unit.of(surface.reshape(3, -1).T)
            near.append(points[((points > low) & (points < high)).all(axis=1)])
            middle = np.clip(points.mean(axis=0), low, high)
        middles.append(middle)
    return np.vstack(near), middles


def _draw_surface(axes: Any, surface: Array, shade: float, is_mesh: bool) -> None:
    if is_mesh:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        triangles = np.moveaxis(surface, 0, 2)  # (m, 3, 3)
        body = Poly3DCollection(triangles, facecolors=style.OBSTACLE, alpha=shade, shade=True)
        axes.add_collection3d(body)
        return
    axes.plot_surface(
        *surface, color=style.OBSTACLE, alpha=shade, linewidth=0, rstride=1, cstride=1, zorder=2
    )
