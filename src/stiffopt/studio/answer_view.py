"""Draw a solution in the studio: the arm, its stiffness, its loads, and the missed target."""

from __future__ import annotations

from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.plots import style
from stiffopt.plots.shapes import StiffnessEllipsoid
from stiffopt.plots.wording import stiffness_text
from stiffopt.studio.drawing import NOWHERE, ArmTube, add_force_arrows, draw, place, rgb, turn
from stiffopt.studio.leaning import force_arrows
from stiffopt.studio.workbench import StudioAnswer

_ARROW_SHARE = 0.25  # of the arm's length
_ELLIPSOID_SHARE = 0.22


class AnswerView:
    """Draws the solutions of one arm.

    Parameters
    ----------
    server : viser.ViserServer
    description : the robot.
    is_preview : whether to draw the arm translucently, as a preview over another one.
    """

    def __init__(self, server: Any, description: RobotDescription, *, is_preview: bool) -> None:
        scene, length = server.scene, description.length
        self._length = length
        look = (style.ELLIPSOID, 0.25) if is_preview else (None, None)
        self._arm = ArmTube(server, "/arm", description, *look)
        self._plain = ArmTube(server, "/plain", description, style.GREY, 0.3)
        self._ellipsoid = scene.add_icosphere(
            "/ellipsoid", radius=1.0, subdivisions=3, color=rgb(style.ELLIPSOID), opacity=0.3,
            visible=False,
        )  # fmt: skip
        self._arrows = scene.add_arrows(
            "/directions", NOWHERE, rgb(style.DIRECTIONS[0]), shaft_radius=0.006 * length,
            head_radius=0.016 * length, head_length=0.05 * length,
        )  # fmt: skip
        self._forces = add_force_arrows(server, "/loads", length)
        self._contacts = add_force_arrows(server, "/contacts", length)
        self._miss = scene.add_line_segments(
            "/miss", NOWHERE, rgb(style.TARGET), thickness=3.0, thickness_units="screen"
        )
        self._label = scene.add_label("/stiffness", "", visible=False)

    @property
    def arm_end(self) -> Array:
        """Position of the drawn arm's end (3,), in m."""
        return self._arm.end

    def show(self, answer: StudioAnswer, target: Array, *, with_plain: bool) -> None:
        """Draw a solution.

        `target`: (3,), position of the target, in m. `with_plain`: whether to draw the plain
        solution too.
        """
        leaning = answer.solution.equilibrium
        self._arm.show(answer.robot, answer.pressures, leaning)
        draw(self._contacts, force_arrows(leaning, self._length))
        self._show_plain(answer if with_plain else None)
        self._show_ellipsoid(answer)
        self._show_directions(answer)
        self._show_miss(answer, target)
        self._show_load(answer)

    def direction_end(self, answer: StudioAnswer) -> Array | None:
        """Return the end (3,), in m, of the first direction's arrow, or None."""
        ways = _directions(answer)
        if not ways or answer.solution.stiffness is None:
            return None
        return np.asarray(_pose(answer)[:3, 3] + _ARROW_SHARE * self._length * ways[0])

    def _show_plain(self, answer: StudioAnswer | None) -> None:
        plain = None if answer is None else answer.plain
        if answer is not None and plain is not None and plain.pressures is not None:
            self._plain.show(answer.robot, plain.pressures)
        else:
            self._plain.visible = False

    def _show_ellipsoid(self, answer: StudioAnswer) -> None:
        pose = _pose(answer)
        found = StiffnessEllipsoid.of(np.asarray(answer.solution.compliance), pose[:3, :3])
        place(self._ellipsoid, pose[:3, 3])
        turn(self._ellipsoid, lie.quaternion_from_rotation(found.axes))
        self._ellipsoid.scale = tuple(found.radii(_ELLIPSOID_SHARE * self._length).tolist())
        self._ellipsoid.visible = True

    def _show_directions(self, answer: StudioAnswer) -> None:
        """Draw arrows along the stiffnesses' directions, and the value at the first."""
        tip, ways = _pose(answer)[:3, 3], _directions(answer)
        reach = _ARROW_SHARE * self._length
        draw(self._arrows, _arrows([(tip, tip + reach * way) for way in ways]))
        self._label.visible = bool(ways)
        value, unit = answer.solution.stiffness, answer.solution.stiffness_unit
        if ways and value is not None:
            self._label.text = stiffness_text(value, unit)
            place(self._label, tip + 1.25 * reach * ways[0])

    def _show_miss(self, answer: StudioAnswer, target: Array) -> None:
        """Draw an arrow from the tip to a target that it does not reach."""
        far = (answer.solution.position_error or 0.0) > 0.004 * self._length
        draw(self._miss, _arrows([(_pose(answer)[:3, 3], target)] if far else []))

    def _show_load(self, answer: StudioAnswer) -> None:
        """Draw the force at the tip."""
        load, forces, pose = answer.design.task.tip_load, [], _pose(answer)
        if load is not None and any(load.force):
            force = np.array(load.force)
            if load.frame == "tip":
                force = pose[:3, :3] @ force
            way = 0.2 * self._length * force / np.linalg.norm(force)
            forces.append((pose[:3, 3] - way, pose[:3, 3]))
        draw(self._forces, _arrows(forces))


def _pose(answer: StudioAnswer) -> Array:
    return np.asarray(answer.solution.tip_pose)


def _directions(answer: StudioAnswer) -> list[Array]:
    """Return the directions of the task's stiffnesses as unit vectors, in base axes."""
    rotation = _pose(answer)[:3, :3]
    return [
        rotation @ each.direction if each.frame == "tip" else np.array(each.direction)
        for each in answer.design.task.measures
        if isinstance(each, StiffnessMeasure)
    ]


def _arrows(pairs: list[tuple[Array, Array]]) -> Any:
    return np.array(pairs, dtype=np.float32) if pairs else NOWHERE
