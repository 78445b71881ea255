"""An arm in axes in 3-D, in mm: its base, its tube, the scene around it, a legend and the view."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.plots import style
from stiffopt.plots.scene import draw_objects
from stiffopt.plots.shapes import segment_poses
from stiffopt.plots.wording import MM

Vector = NDArray[np.float64]

_STATIONS = 24  # of the tube, per segment
_SPOKES = 28  # of the tube, around


@dataclass
class ArmDrawing:
    """Axes in 3-D and what has been drawn in them, in mm."""

    axes: Any
    robot: Manipulator
    corners: list[Vector] = field(default_factory=list, kw_only=True)
    handles: list[Any] = field(default_factory=list, kw_only=True)

    @property
    def size(self) -> float:
        """Length of the arm in mm."""
        return self.robot.length * MM

    def draw_base(self) -> None:
        """Base plate: a disc on which the arm stands."""
        radius = 1.7 * self.robot.description.segments[0].outer_radius * MM
        angle, share = np.meshgrid(np.linspace(0, 2 * np.pi, 49), [0.0, 1.0])
        x, y = radius * share * np.cos(angle), radius * share * np.sin(angle)
        self.axes.plot_surface(x, y, 0 * x, color="#8d99a6", alpha=0.55, linewidth=0, zorder=1)
        rim = np.stack([x[1], y[1], 0 * x[1]])
        self.axes.plot(*rim, color="#5c6670", linewidth=1.2, zorder=1)
        self.corners.append(rim.T)

    def draw_tube(self, pressures: Vector, shade: float = 0.38) -> None:
        """Tube with each segment in its colour, its backbone, and a ring at each end."""
        description = self.robot.description
        poses = segment_poses(self.robot, pressures, _STATIONS)
        angle = np.linspace(0, 2 * np.pi, _SPOKES + 1)
        for number, segment in enumerate(description.segments):
            mine = poses[number]
            ring = segment.outer_radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle])
            tube = (mine[:, :3, 3, None] + mine[:, :3, :3] @ ring) * MM  # (k, 3, spokes)
            x, y, z = tube.transpose(1, 0, 2)
            self.axes.plot_surface(
                x, y, z, color=style.segment_colour(number), alpha=shade, linewidth=0, rstride=1,
                cstride=1, shade=True, zorder=2,
            )  # fmt: skip
            for end in (tube[0], tube[-1]):
                self.axes.plot(
                    *end, color=style.segment_text_colour(number), linewidth=1.0, zorder=3
                )
            line = mine[:, :3, 3].T * MM
            self.axes.plot(*line, color=style.segment_text_colour(number), linewidth=2.2, zorder=4)
            self.corners.append(tube.transpose(0, 2, 1).reshape(-1, 3))

    def explain_segments(self) -> None:
        """Add the colours of the segments to the legend."""
        for number in range(self.robot.n_segments):
            self.add_patch(style.segment_colour(number), f"segment {number + 1}")

    def draw_objects(self, scene: Scene) -> None:
        """What is around the arm."""
        self.corners.append(draw_objects(self.axes, scene, self.size, np.vstack(self.corners)))
        self.add_patch(style.OBSTACLE, "scene")

    # -- parts ------------------------------------------------------------------------------

    def draw_arrow(
        self, start: Vector, vector: Vector, colour: str, zorder: int, linestyle: str = "-"
    ) -> None:
        """Draw a shaft with a cone as its head, to the scale of the figure."""
        end = start + vector
        self.axes.plot(
            *np.stack([start, start + 0.82 * vector]).T, color=colour, linewidth=2.0,
            linestyle=linestyle, zorder=zorder,
        )  # fmt: skip
        length = float(np.linalg.norm(vector))
        if length > 0:
            x, y, z = _cone(end, vector / length, 0.2 * length)
            self.axes.plot_surface(x, y, z, color=colour, linewidth=0, shade=False, zorder=zorder)
        self.corners.append(np.stack([start, end]))

    def add_patch(self, colour: str, label: str) -> None:
        """Add a coloured field to the legend."""
        from matplotlib.patches import Patch

        self.handles.append(Patch(color=colour, alpha=0.6, label=label))

    def add_line(self, colour: str, label: str, linestyle: Any = "-", **look: Any) -> None:
        """Add a line to the legend."""
        from matplotlib.lines import Line2D

        look = {"color": colour, "linestyle": linestyle, "linewidth": 2, **look}
        self.handles.append(Line2D([], [], label=label, **look))

    def finish(self, tip: Vector) -> None:
        """One scale for all axes, a view across the bend to a tip (3,), labels and legend."""
        points = np.vstack(self.corners)
        low, high = points.min(axis=0), points.max(axis=0)
        middle, sides = (low + high) / 2, (high - low) + 0.06 * self.size
        sides = np.maximum(sides, 0.55 * sides.max())  # room for the labels of a slender arm
        for name, centre, side in zip("xyz", middle, sides, strict=True):
            start = 0.0 - 0.03 * self.size if name == "z" and low[2] > -1e-9 else centre - side / 2
            self.axes.set(**{f"{name}lim": (start, start + side), f"{name}label": f"{name} (mm)"})
        self.axes.set_box_aspect(sides, zoom=0.97)
        hangs = self.robot.description.gravity[2] > 0
        azimuth = _across(tip[:2])
        self.axes.view_init(elev=-18 if hangs else 18, azim=azimuth, roll=180 if hangs else 0)
        self.axes.tick_params(labelsize=8, pad=1)
        from matplotlib.ticker import MaxNLocator

        for axis, side in zip(
            (self.axes.xaxis, self.axes.yaxis, self.axes.zaxis), sides, strict=True
        ):
            axis.set_major_locator(MaxNLocator(max(2, round(6 * side / sides.max()))))
        self.axes.figure.legend(
            handles=self.handles, loc="upper left", bbox_to_anchor=(0.02, 0.84), fontsize=9,
            frameon=False,
        )  # fmt: skip


def _cone(point: Vector, way: Vector, length: float) -> Vector:
    """Surface (3, 2, k) of a cone that ends in a point."""
    aside = np.eye(3)[np.abs(way).argmin()]
    across = np.cross(way, aside)
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, 13)
    ring = np.outer(across, np.cos(angle)) + np.outer(np.cross(way, across), np.sin(angle))
    base = (point - length * way)[:, None] + 0.35 * length * ring
    return np.stack([base, np.repeat(point[:, None], len(angle), axis=1)], axis=1)


def _across(bend: Vector) -> float:
    """Azimuth in degrees from which a bend towards this side is seen from the side."""
    if np.linalg.norm(bend) < 1e-6:
        return -60.0
    return float(np.degrees(np.arctan2(bend[1], bend[0]))) - 65.0
