"""Draw an arm in 3-D axes: base, tube, scene, labels and view, in the display unit of lengths."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.display import DisplayUnit, display_units
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.plots import style
from stiffopt.plots.scene import draw_objects
from stiffopt.plots.shapes import segment_poses
from stiffopt.plots.view import View, ViewAngles, fill_panel

TUBE_STATIONS = 24
"""Number of stations of the tube, per segment."""
_SPOKES = 28  # points around the tube
_ALONG = 24  # points along an arrow, which labels avoid
_SMALL = 4.0  # inches, width below which a panel counts as small
_MIN_SIDES = (0.5, 0.3, 0.5)  # smallest sides of the box, as shares of the longest


def draw_arm(
    axes: Any,
    robot: Manipulator,
    pressures: ArrayLike,
    *,
    scene: Scene | None = None,
    view: View | None = None,
) -> list[Any]:
    """Draw an arm in space, in the display unit of lengths.

    Returns handles for a legend. Raises `InputError`: the pressures do not suit the arm, or the
    view is invalid.

    Parameters
    ----------
    axes : in 3-D: ``figure.add_subplot(projection="3d", computed_zorder=False)``. Their limits,
        labels and view are set.
    pressures : (n,), in Pa.
    scene : the objects around it.
    view : (elevation, azimuth), the viewpoint: the angle of the eye above the horizontal, and about
        the z axis of the base from its x axis; in rad, or as text with a unit:
        ``("20 deg", "-60 deg")``. By default x points to the right, and z up or, for a hanging arm,
        down.
    """
    drawing = ArmDrawing(axes, robot)
    drawing.draw_base()
    drawing.draw_tube(np.asarray(pressures, dtype=float))
    drawing.explain_segments()
    return drawing.finish(view, scene)


class Label(NamedTuple):
    """A text beside a point (3,) of the axes."""

    point: Array
    text: str
    colour: str


@dataclass
class ArmDrawing:
    """3-D axes and their contents, in the display unit of lengths."""

    axes: Any
    robot: Manipulator
    # points (k, 3) that must be visible
    corners: list[Array] = field(default_factory=list, kw_only=True)
    handles: list[Any] = field(default_factory=list, kw_only=True)  # for a legend
    # texts next to points, the most important first
    labels: list[Label] = field(default_factory=list, kw_only=True)
    # points (k, 3), close together, which labels avoid
    covered: list[Array] = field(default_factory=list, kw_only=True)
    # points (3,) with a marker, which labels avoid too
    marks: list[Array] = field(default_factory=list, kw_only=True)

    @property
    def size(self) -> float:
        """Length of the arm in the unit of the axes."""
        return float(self.unit.of(self.robot.length))

    @property
    def unit(self) -> DisplayUnit:
        """Unit of the axes."""
        return display_units().length

    def draw_base(self) -> None:
        """Draw the base plate, a disc."""
        radius = self.unit.of(1.7 * self.robot.description.segments[0].outer_radius)
        angle, share = np.meshgrid(np.linspace(0, 2 * np.pi, 49), [0.0, 1.0])
        x, y = radius * share * np.cos(angle), radius * share * np.sin(angle)
        self.axes.plot_surface(x, y, 0 * x, color="#8d99a6", alpha=0.55, linewidth=0, zorder=1)
        rim = np.stack([x[1], y[1], 0 * x[1]])
        self.axes.plot(*rim, color="#5c6670", linewidth=1.2, zorder=1)
        self.corners.append(rim.T)

    def draw_tube(self, pressures: Array, shade: float = 0.38, poses: Array | None = None) -> None:
        """Draw the tube with each segment in its colour, its backbone, and a ring at each end.

        Poses (segments, k, 4, 4), if given, replace those at the pressures.
        """
        description = self.robot.description
        poses = segment_poses(self.robot, pressures, TUBE_STATIONS) if poses is None else poses
        angle = np.linspace(0, 2 * np.pi, _SPOKES + 1)
        for number, segment in enumerate(description.segments):
            mine = poses[number]
            ring = segment.outer_radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle])
            tube = self.unit.of(mine[:, :3, 3, None] + mine[:, :3, :3] @ ring)  # (k, 3, spokes)
            x, y, z = tube.transpose(1, 0, 2)
            self.axes.plot_surface(
                x, y, z, color=style.segment_colour(number), alpha=shade, linewidth=0, rstride=1,
                cstride=1, shade=True, zorder=2,
            )  # fmt: skip
            for end in (tube[0], tube[-1]):
                self.axes.plot(
                    *end, color=style.segment_text_colour(number), linewidth=1.0, zorder=3
                )
            line = self.unit.of(mine[:, :3, 3].T)
            self.axes.plot(*line, color=style.segment_text_colour(number), linewidth=2.2, zorder=4)
            self.add_body(tube.transpose(0, 2, 1).reshape(-1, 3))

    def explain_segments(self) -> None:
        """Add the colours of the segments to the legend."""
        for number in range(self.robot.n_segments):
            self.add_patch(style.segment_colour(number), f"segment {number + 1}")

    def draw_objects(self, scene: Scene) -> None:
        """Draw the objects around the arm."""
        seen, middles = draw_objects(self.axes, scene, self.size, np.vstack(self.corners))
        self.corners.append(seen)
        for item, middle in zip(scene.objects, middles, strict=True):
            self.add_label(middle, item.name, style.DARK)
        self.add_patch(style.OBSTACLE, "scene")

    # -- parts ------------------------------------------------------------------------------

    def draw_arrow(
        self, start: Array, vector: Array, colour: str, zorder: int, linestyle: str = "-"
    ) -> None:
        """Draw a shaft with a conical head, in the units of the axes."""
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
        self.covered.append(start + np.linspace(0, 1, _ALONG)[:, None] * vector)

    def add_patch(self, colour: str, label: str) -> None:
        """Add a coloured field to the legend."""
        from matplotlib.patches import Patch

        self.handles.append(Patch(color=colour, alpha=0.6, label=label))

    def add_line(self, colour: str, label: str, linestyle: Any = "-", **look: Any) -> None:
        """Add a line to the legend."""
        from matplotlib.lines import Line2D

        look = {"color": colour, "linestyle": linestyle, "linewidth": 2, **look}
        self.handles.append(Line2D([], [], label=label, **look))

    def add_label(self, point: Array, text: str, colour: str) -> None:
        """Request a text beside a point of the axes; earlier requests take precedence."""
        self.labels.append(Label(np.asarray(point), text, colour))

    def add_body(self, points: Array) -> None:
        """Make points (k, 3) visible, and let labels avoid them."""
        self.corners.append(points)
        self.covered.append(points)

    def add_mark(self, point: Array) -> None:
        """Make a point with a marker visible, and let labels avoid it."""
        self.corners.append(point[None])
        self.marks.append(point)

    def finish(self, view: View | None = None, scene: Scene | None = None) -> list[Any]:
        """Draw a scene, set one scale for all axes and the view, and place the labels.

        Returns handles for a legend.
        """
        from matplotlib.ticker import MaxNLocator

        from stiffopt.plots.labels import place_labels

        if scene is not None:
            self.draw_objects(scene)
        points = np.vstack(self.corners)
        low, high = points.min(axis=0), points.max(axis=0)
        sides = (high - low) + 0.04 * self.size
        sides = np.maximum(
            sides, sides.max() * np.array(_MIN_SIDES)
        )  # room for the labels of a slender arm
        width = self.axes.get_position().width * self.axes.figure.get_figwidth()  # inches
        for name, start, side in zip("xyz", (low + high - sides) / 2, sides, strict=True):
            self.axes.set(**{f"{name}lim": (start, start + side)})
            self.axes.set(**{f"{name}label": f"{name} ({self.unit})"})
            axis = getattr(self.axes, f"{name}axis")
            prune = None if name == "z" else "both"  # numbers of two axes would meet in a corner
            most = max(3, round(7 * side / sides.max()))
            if name == "y" and width < _SMALL:  # the axis is seen nearly end on
                most = 1
            axis.set_major_locator(MaxNLocator(most, prune=prune, min_n_ticks=min(2, most)))
            axis.labelpad = 8 if name == "z" else -2
        self.axes.tick_params(labelsize=8, pad=0)
        self.axes.tick_params(axis="z", pad=3)
        self.axes.set_box_aspect(sides)
        self.axes.patch.set_visible(False)
        ViewAngles.of(self.robot, view).set(self.axes)
        fill_panel(self.axes)
        marks = np.array(self.marks).reshape(-1, 3)
        place_labels(self.axes, self.labels, np.vstack(self.covered), marks)
        return self.handles


def _cone(point: Array, way: Array, length: float) -> Array:
    """Return the surface (3, 2, k) of a cone with its apex at a point."""
    aside = np.eye(3)[np.abs(way).argmin()]
    across = np.cross(way, aside)
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, 13)
    ring = np.outer(across, np.cos(angle)) + np.outer(np.cross(way, across), np.sin(angle))
    base = (point - length * way)[:, None] + 0.35 * length * ring
    return np.stack([base, np.repeat(point[:, None], len(angle), axis=1)], axis=1)
