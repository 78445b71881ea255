"""Draw an arm that leans on objects: its shape, the free arm, and the contact forces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.display import display_units
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.plots import style
from stiffopt.plots.arm import TUBE_STATIONS, ArmDrawing
from stiffopt.plots.shapes import segment_stations
from stiffopt.plots.view import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LONGEST = 0.35  # arrow, as a share of the arm's length


def plot_contact(
    robot: Manipulator, equilibrium: ContactEquilibrium, scene: Scene, *, view: View | None = None
) -> Figure:
    """Draw an arm that leans on objects, with its contact forces and the free arm as a line.

    `equilibrium`: of that arm in that scene. `view`: (elevation, azimuth), see `draw_arm`.
    """
    figure = style.new_figure(6.6, 6.6)
    axes = style.add_space(figure, (0.02, 0.02, 0.96, 0.94))
    style.legend_in_corner(axes, draw_contact(axes, robot, equilibrium, scene, view=view))
    return figure


def draw_contact(
    axes: Any,
    robot: Manipulator,
    equilibrium: ContactEquilibrium,
    scene: Scene,
    *,
    view: View | None = None,
) -> list[Any]:
    """Draw the same into 3-D axes; see `draw_arm` for the axes and the returned handles."""
    drawing = ArmDrawing(axes, robot)
    drawing.draw_base()
    draw_leaning_tube(drawing, equilibrium)
    drawing.explain_segments()
    free = drawing.unit.of(robot.backbone(equilibrium.pressures, 60)[:, :3, 3])
    axes.plot(*free.T, color=style.DARK, linewidth=1.2, linestyle="--", zorder=3)
    drawing.add_body(free)
    drawing.add_line(style.DARK, "without contact", "--")
    drawing.draw_objects(scene)
    draw_forces(drawing, equilibrium)
    return drawing.finish(view)


def draw_leaning_tube(
    drawing: ArmDrawing, equilibrium: ContactEquilibrium, shade: float = 0.38
) -> None:
    """Draw the arm at an equilibrium in contact."""
    stations = segment_stations(drawing.robot, TUBE_STATIONS)
    poses = equilibrium.poses(stations.ravel()).reshape(*stations.shape, 4, 4)
    drawing.draw_tube(equilibrium.pressures, shade, poses)


def draw_forces(drawing: ArmDrawing, equilibrium: ContactEquilibrium) -> None:
    """Draw the contact forces on the arm as arrows, each with the object that exerts it."""
    unit = drawing.unit
    largest = max((np.linalg.norm(each.force) for each in equilibrium.contacts), default=1.0)
    for each in equilibrium.contacts:
        arrow = _LONGEST * drawing.size * each.force / largest
        drawing.draw_arrow(unit.of(each.position), arrow, style.LOAD, 6)
        text = display_units().force.text(float(np.linalg.norm(each.force)), ".3g")
        drawing.add_label(unit.of(each.position) + arrow, f"{text} by '{each.object}'", style.LOAD)
    if equilibrium.contacts:
        drawing.add_line(style.LOAD, "force on the arm")
