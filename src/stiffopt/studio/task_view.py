"""The view of a robot and a task: handles to drag, the arm that follows, and the panel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import degrees, radians
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.errors import StiffoptError
from stiffopt.model.stopping import Cancel
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.plots import style
from stiffopt.plots.shapes import StiffnessEllipsoid
from stiffopt.plots.wording import stiffness_text
from stiffopt.studio import texts
from stiffopt.studio.cloud import StiffnessCloud
from stiffopt.studio.design import Angular, Design
from stiffopt.studio.drawing import (
    KEPT,
    NOWHERE,
    ArmTube,
    Vector,
    add_surroundings,
    place,
    rgb,
    turn,
)
from stiffopt.studio.scene_view import SceneView
from stiffopt.studio.workbench import NewestWins, StudioAnswer, Workbench
from stiffopt.workspace.map import WorkspaceMap

Change = Callable[[Design], Design]

_ARROW_SHARE = 0.25  # of the arm's length
_ELLIPSOID_SHARE = 0.22
_MILLI = 1e3
_ANGULAR: dict[str, Angular] = {
    "any direction": "any",
    "pointing": "pointing",
    "full orientation": "orientation",
}
_MAXIMISE, _LEAST, _FILE = "stiff along a direction", "least pressure", "as in the file"
_PREVIEW = "Preview (violet): the arm does not move until you send it."
_NO_MAP = "do not show"
_GRAVITY = {
    "none": (0.0, 0.0, 0.0),
    "standing": (0.0, 0.0, -9.81),
    "hanging": (0.0, 0.0, 9.81),
    "lying": (-9.81, 0.0, 0.0),
}


class TaskView:
    """Draws a workbench, and forwards what is done in the browser to it.

    Parameters
    ----------
    server : viser.ViserServer
    bench : Workbench
    found : WorkspaceMap, optional
        To show as a cloud; of the same arm.
    is_preview : bool
        Whether the arm is drawn as a ghost, before another one.
    """

    def __init__(
        self,
        server: Any,
        bench: Workbench,
        found: WorkspaceMap | None = None,
        *,
        is_preview: bool = False,
    ) -> None:
        self.server, self.bench, self._map = server, bench, found
        self._is_preview = is_preview
        self._length = bench.design.description.length
        self._dragged: Any = None
        self._kept: list[ArmTube] = []
        add_surroundings(server, bench.design.description)
        self._add_scene()
        self._scene = SceneView(server, lambda: bench.design, self._change)
        self._add_panel()
        self.worker = NewestWins(self._quickly, self._fully)
        self._show_design()
        self.worker.request()

    def close(self) -> None:
        """End the thread that searches."""
        self.worker.close()

    @property
    def target_position(self) -> Vector:
        """Where the handle of the target is (3,), in m."""
        return np.asarray(self._target.position)

    @property
    def arm_end(self) -> Vector:
        """Where the arm that is drawn ends (3,), in m."""
        return self._arm.end

    # -- what is there ------------------------------------------------------------------------

    def _add_scene(self) -> None:
        scene, length = self.server.scene, self._length
        description = self.bench.design.description
        look = (style.ELLIPSOID, 0.25) if self._is_preview else (None, None)
        self._arm = ArmTube(self.server, "/arm", description, *look)
        self._plain = ArmTube(self.server, "/plain", description, style.GREY, 0.3)
        self._ellipsoid = scene.add_icosphere(
            "/ellipsoid", radius=1.0, subdivisions=3, color=rgb(style.ELLIPSOID), opacity=0.3,
            visible=False,
        )  # fmt: skip
        self._arrows = scene.add_arrows(
            "/directions", NOWHERE, rgb(style.DIRECTIONS[0]), shaft_radius=0.006 * length,
            head_radius=0.016 * length, head_length=0.05 * length,
        )  # fmt: skip
        self._forces = scene.add_arrows(
            "/loads", NOWHERE, rgb(style.LOAD), shaft_radius=0.005 * length,
            head_radius=0.013 * length, head_length=0.04 * length,
        )  # fmt: skip
        self._miss = scene.add_line_segments(
            "/miss", NOWHERE, rgb(style.TARGET), thickness=3.0, thickness_units="screen"
        )
        self._label = scene.add_label("/stiffness", "", visible=False)
        self._target = scene.add_transform_controls(
            "/target", scale=0.24 * length, line_width=3.0, depth_test=False
        )
        scene.add_icosphere("/target/point", radius=0.018 * length, color=rgb(style.TARGET))
        scene.add_label("/target/name", "target", position=(0.0, -0.05 * length, 0.0))
        self._pull = scene.add_transform_controls(
            "/direction", scale=0.13 * length, line_width=2.0, disable_rotations=True,
            disable_sliders=True,
        )  # fmt: skip
        self._target.on_update(self._target_moved)
        self._pull.on_update(self._direction_moved)

    def _add_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.set_width(400)
        if self._is_preview:
            gui.add_html(texts.note_html(_PREVIEW))
        self._words = gui.add_html("")
        undo = gui.add_button("undo", hint="Take the last change back.")
        undo.on_click(self._undo)
        tabs = gui.add_tab_group()
        with tabs.add_tab("target"):
            self._add_target_inputs(gui)
        with tabs.add_tab("stiffness"):
            self._add_stiffness_inputs(gui)
        with tabs.add_tab("loads"):
            self._add_load_inputs(gui)
        with tabs.add_tab("scene"):
            self._scene.add_inputs(gui)
        if self._map is not None:
            with tabs.add_tab("map"):
                self._add_map_inputs(gui, self._map)
        with tabs.add_tab("compare"):
            self._add_compare_inputs(gui)
        with tabs.add_tab("copy"):
            self._add_copy_inputs(gui)
        self.tabs = tabs

    def _add_target_inputs(self, gui: Any) -> None:
        self._position = gui.add_vector3("position (mm)", (0.0, 0.0, 0.0), step=0.1)
        self._position.on_update(self._on("target", lambda d, v: d.at_pose(
            np.asarray(v) / _MILLI, self._target.wxyz)))  # fmt: skip
        self._free = [gui.add_checkbox(f"{axis} is free", False) for axis in "xyz"]
        for box in self._free:
            box.on_update(self._on("free", lambda d, _: d.with_free(
                [each.value for each in self._free], self._tip())))  # fmt: skip
        self._angular = gui.add_dropdown(
            "tip axis", tuple(_ANGULAR), hint="What is asked of the tip's direction."
        )
        self._angular.on_update(self._on("angular", lambda d, v: d.with_angular(
            _ANGULAR[v], self._tip_quaternion())))  # fmt: skip
        self._tolerance = gui.add_slider("tolerance (mm)", 0.05, 5.0, 0.05, 0.1)
        self._angle = gui.add_slider("tolerance (deg)", 0.1, 20.0, 0.1, 1.0)
        for slider in (self._tolerance, self._angle):
            slider.on_update(self._on("tolerance", lambda d, _: d.with_tolerance(
                self._tolerance.value / _MILLI, radians(self._angle.value))))  # fmt: skip

    def _add_stiffness_inputs(self, gui: Any) -> None:
        options: tuple[str, ...] = (_MAXIMISE, _LEAST)
        if self.bench.design.measure is None and self.bench.design.task.stiffness is not None:
            options = (*options, _FILE)
        self._given_goal = self.bench.design.task.stiffness
        self._goal = gui.add_dropdown("what is wanted", options)
        self._goal.on_update(self._on("goal", self._with_goal))
        self._direction = gui.add_vector3("direction", (1.0, 0.0, 0.0), step=0.01)
        self._direction.on_update(
            self._on("direction", lambda d, v: d.with_measure(direction=tuple(v)))
        )
        choices = (
            ("against", "kind", ("translation", "rotation"), "A push along it, or a turn about."),
            ("rest of the tip", "boundary", ("free", "guided", "clamped"),
             "free: it may move as it likes; guided: only along the direction; clamped: it may "
             "not turn either."),
            ("axes", "frame", ("base", "tip"), "In which the direction is given."),
        )  # fmt: skip
        self._choices = {}
        for label, key, allowed, hint in choices:
            box = self._choices[key] = gui.add_dropdown(label, allowed, hint=hint)
            box.on_update(self._on(key, partial(_with_choice, key)))

    def _add_load_inputs(self, gui: Any) -> None:
        description = self.bench.design.description
        self._weights = dict(_GRAVITY)
        if description.gravity not in self._weights.values():
            self._weights["as in the file"] = description.gravity
        self._gravity = gui.add_dropdown("gravity: the arm is", tuple(self._weights))
        heaviest = max(100.0, 2 * description.tip_mass * _MILLI)
        self._mass = gui.add_slider("tip mass (g)", 0.0, heaviest, 0.5, 0.0)
        for each in (self._gravity, self._mass):
            each.on_update(self._on("gravity", lambda d, _: d.with_gravity(
                self._weights[self._gravity.value], self._mass.value / _MILLI)))  # fmt: skip
        self._force = [gui.add_slider(f"force {a} (mN)", -200.0, 200.0, 1.0, 0.0) for a in "xyz"]
        for each in self._force:
            each.on_update(self._on("force", lambda d, _: d.with_force(
                [slider.value / _MILLI for slider in self._force])))  # fmt: skip
        highest = max(description.pressure_max) * 1e-5
        self._highest = gui.add_slider(
            "most pressure (bar)", 0.05 * highest, highest, 0.01, highest
        )
        self._highest.on_update(self._on("highest", lambda d, v: d.with_highest(v * 1e5)))

    def _add_compare_inputs(self, gui: Any) -> None:
        keep = gui.add_button("keep this answer", hint="Compare it with others.")
        keep.on_click(self._keep)
        clear = gui.add_button("clear", hint="Forget the answers that were kept.")
        clear.on_click(self._clear)
        self._compared = gui.add_html("")
        self._with_plain = gui.add_checkbox(
            "show the arm with plain pressures", False,
            hint="Those of least pressure that reach the target.",
        )  # fmt: skip
        self._with_plain.on_update(lambda _: self._show_answer())

    def _add_copy_inputs(self, gui: Any) -> None:
        makers: dict[str, Callable[[Design], str]] = {
            "copy as task file": texts.task_text,
            "copy as robot file": texts.robot_text,
            "copy as Python": texts.python_text,
        }
        for label, make in makers.items():
            button = gui.add_button(label)
            button.on_click(lambda _, make=make: self._show_copy(make))
        self._copied = gui.add_html("")

    def _add_map_inputs(self, gui: Any, found: WorkspaceMap) -> None:
        names = tuple(f"along {name}" for name in found.direction_names)
        self._shown_map = gui.add_dropdown("stiffness", (*names, _NO_MAP))
        low, high = (float(round(1e3 * each[1])) for each in (found.low, found.high))
        self._cut = gui.add_slider("cells beyond y (mm)", low, high, 0.5, min(max(0.0, low), high))
        self._legend = gui.add_html("")
        cloud = StiffnessCloud.of(found, 0, self._cut.value / _MILLI)
        self._cloud = self.server.scene.add_point_cloud(
            "/map", cloud.points, cloud.colours, point_size=cloud.size, point_shape="circle"
        )
        self._legend.content = texts.note_html(cloud.legend)
        for each in (self._shown_map, self._cut):
            each.on_update(lambda _: self._show_map(found, names))

    def _show_map(self, found: WorkspaceMap, names: tuple[str, ...]) -> None:
        chosen = self._shown_map.value
        self._cloud.visible = chosen in names
        if chosen in names:
            try:
                cloud = StiffnessCloud.of(found, names.index(chosen), self._cut.value / _MILLI)
            except StiffoptError as error:
                self._legend.content = texts.note_html(str(error))
                return
            with self.server.atomic():
                self._cloud.points, self._cloud.colors = cloud.points, cloud.colours
            self._legend.content = texts.note_html(cloud.legend)

    # -- what is done in the browser ----------------------------------------------------------

    def _on(self, kind: str, change: Callable[[Design, Any], Design]) -> Callable[[Any], None]:
        """Return what forwards an input of the panel as a change."""

        def changed(event: Any) -> None:
            if event.client is not None:  # else it was set here
                self._change(kind, lambda design: change(design, event.target.value))

        return changed

    def _change(self, kind: str, change: Change) -> None:
        try:
            if not self.bench.change(kind, change):
                return
            self.bench.trouble = ""
        except StiffoptError as error:
            self.bench.trouble = str(error)
            self._show_words()
            return
        self._show_design()
        self.worker.request()

    async def _target_moved(self, event: Any) -> None:
        self._note_drag(event)
        handle = self._target
        self._change("target", lambda design: design.at_pose(handle.position, handle.wxyz))

    async def _direction_moved(self, event: Any) -> None:
        self._note_drag(event)
        way = np.asarray(self._pull.position) - self._tip()
        if np.linalg.norm(way) < 0.02 * self._length or self.bench.design.measure is None:
            return
        if self.bench.design.measure.frame == "tip":
            way = self._tip_pose()[:3, :3].T @ way
        direction = tuple((way / np.linalg.norm(way)).round(4).tolist())
        self._change("direction", lambda design: design.with_measure(direction=direction))

    def _note_drag(self, event: Any) -> None:
        """Remember which handle is held, so that it is not moved under the hand."""
        self._dragged = None if event.phase == "end" else event.target
        if event.phase == "end":
            self.bench.end_step()
            self.worker.request()

    def _with_goal(self, design: Design, goal: str) -> Design:
        if goal == _LEAST:
            return design.with_least_pressure()
        if goal == _FILE:
            return design.with_task(stiffness=self._given_goal)
        return design.with_measure()

    def _undo(self, _: Any) -> None:
        if self.bench.undo():
            self.bench.trouble = ""
            self._show_design()
            self.worker.request()

    def _keep(self, _: Any) -> None:
        if self.bench.keep() and self.bench.answer is not None:
            answer, number = self.bench.answer, len(self._kept)
            arm = ArmTube(
                self.server, f"/kept/{number}", answer.design.description,
                KEPT[number % len(KEPT)], 0.35,
            )  # fmt: skip
            arm.show(answer.robot, answer.pressures)
            self._kept.append(arm)
        self._compared.content = texts.compared_html(self.bench, KEPT)

    def _clear(self, _: Any) -> None:
        self.bench.kept.clear()
        for arm in self._kept:
            arm.remove()
        self._kept.clear()
        self._compared.content = texts.compared_html(self.bench, KEPT)

    def _show_copy(self, make: Callable[[Design], str]) -> None:
        design = self.bench.design
        title = ""
        if design.has_own_robot and make is texts.task_text:
            title = f"The robot was changed: save its file as {texts.ROBOT_FILE} beside the task."
        self._copied.content = texts.copy_html(title, make(design))

    # -- answers ------------------------------------------------------------------------------

    def _quickly(self, cancel: Cancel) -> None:
        self._answer(self.bench.answer_quickly, cancel)

    def _fully(self, cancel: Cancel) -> None:
        if self._dragged is None and not self._scene.is_held:
            self.bench.end_step()
        self._answer(self.bench.answer_best, cancel)

    def _answer(self, search: Callable[[Cancel], bool], cancel: Cancel) -> None:
        try:
            found = search(cancel)
        except StiffoptError as error:
            self.bench.trouble, found = str(error), False
        if found:
            self._show_answer()
        else:
            self._show_words()

    # -- drawing ------------------------------------------------------------------------------

    def _show_design(self) -> None:
        """Draw what is asked for: the target, and the inputs of the panel."""
        design, target = self.bench.design, self.bench.design.task.target
        with self.server.atomic():
            if self._dragged is not self._target:
                self._show_target(design)
            self._pull.visible = design.measure is not None
            shown = np.asarray(self._target.position) * _MILLI
            _set(self._position, tuple(shown.round(2).tolist()))
            for box, free in zip(self._free, design.free, strict=True):
                _set(box, free)
            _set(self._angular, next(k for k, v in _ANGULAR.items() if v == design.angular))
            _set(self._tolerance, min(5.0, target.tolerance.position * _MILLI))
            _set(self._angle, min(20.0, degrees(target.tolerance.angle)))
            self._show_goal(design)
            self._show_loads(design)
            self._scene.show()

    def _show_target(self, design: Design) -> None:
        target = design.task.target
        given = target.position or (None, None, None)
        free = self._tip()
        pairs = zip(given, free, strict=True)
        place(self._target, [at if wanted is None else wanted for wanted, at in pairs])
        if target.orientation is not None:
            turn(self._target, target.orientation)
        elif target.pointing is not None:
            turn(self._target, _pointing_quaternion(np.array(target.pointing)))
        elif self._target.disable_rotations is False:
            turn(self._target, (1.0, 0.0, 0.0, 0.0))
        self._target.disable_rotations = design.angular == "any"

    def _show_goal(self, design: Design) -> None:
        goal = design.task.stiffness
        word = _LEAST if goal is None else _MAXIMISE if design.measure is not None else _FILE
        _set(self._goal, word)
        measure = design.measure
        if measure is not None:
            _set(self._direction, tuple(round(x, 4) for x in measure.direction))
            for key, box in self._choices.items():
                _set(box, getattr(measure, key))

    def _show_loads(self, design: Design) -> None:
        gravity = design.description.gravity
        _set(self._gravity, next(k for k, v in self._weights.items() if v == gravity))
        _set(self._mass, design.description.tip_mass * _MILLI)
        force = design.task.load.force if design.task.load is not None else (0.0, 0.0, 0.0)
        for slider, value in zip(self._force, force, strict=True):
            _set(slider, min(200.0, max(-200.0, value * _MILLI)))
        _set(self._highest, float(design.task.pressure_bounds(design.description)[1].max()) * 1e-5)

    def _show_answer(self) -> None:
        """Draw the answer: the arm, its stiffness, what it misses, and the panel."""
        answer = self.bench.answer
        if answer is None:
            return
        with self.server.atomic():
            self._arm.show(answer.robot, answer.pressures)
            self._show_plain(answer)
            self._show_stiffness(answer)
            self._show_miss(answer)
            if self._dragged is None and any(self.bench.design.free):
                self._show_target(self.bench.design)
            if self.bench.kept:
                self._compared.content = texts.compared_html(self.bench, KEPT)
        self._show_words()

    def _show_words(self) -> None:
        self._words.content = texts.answer_html(self.bench)

    def _show_plain(self, answer: StudioAnswer) -> None:
        plain = answer.plain
        if self._with_plain.value and plain is not None and plain.pressures is not None:
            self._plain.show(answer.robot, plain.pressures)
        else:
            self._plain.visible = False

    def _show_stiffness(self, answer: StudioAnswer) -> None:
        pose = np.asarray(answer.solution.tip_pose)
        tip, rotation = pose[:3, 3], pose[:3, :3]
        found = StiffnessEllipsoid.of(np.asarray(answer.solution.compliance), rotation)
        place(self._ellipsoid, tip)
        turn(self._ellipsoid, lie.quaternion_from_rotation(found.axes))
        self._ellipsoid.scale = tuple(found.radii(_ELLIPSOID_SHARE * self._length).tolist())
        self._ellipsoid.visible = True
        ways = [
            rotation @ each.direction if each.frame == "tip" else np.array(each.direction)
            for each in answer.design.task.measures
            if isinstance(each, StiffnessMeasure)
        ]
        reach = _ARROW_SHARE * self._length
        self._arrows.points = _arrows([(tip, tip + reach * way) for way in ways])
        self._label.visible = bool(ways)
        value, unit = answer.solution.stiffness, answer.solution.stiffness_unit
        if ways and value is not None:
            self._label.text = stiffness_text(value, unit)
            place(self._label, tip + 1.25 * reach * ways[0])
            if self._dragged is not self._pull:
                place(self._pull, tip + reach * ways[0])

    def _show_miss(self, answer: StudioAnswer) -> None:
        """The way from the tip to a target that it does not reach, and the force at the tip."""
        tip = np.asarray(answer.solution.tip_pose)[:3, 3]
        missed = answer.solution.position_error or 0.0
        target = np.asarray(self._target.position)
        far = missed > 0.004 * self._length
        self._miss.points = _arrows([(tip, target)] if far else [])
        load, forces = answer.design.task.load, []
        if load is not None and any(load.force):
            force = np.array(load.force)
            if load.frame == "tip":
                force = np.asarray(answer.solution.tip_pose)[:3, :3] @ force
            way = 0.2 * self._length * force / np.linalg.norm(force)
            forces.append((tip - way, tip))
        self._forces.points = _arrows(forces)

    # -- the tip ------------------------------------------------------------------------------

    def _tip_pose(self) -> Vector:
        answer = self.bench.answer
        if answer is None or answer.solution.tip_pose is None:
            pose = np.eye(4)
            pose[2, 3] = self._length
            return pose
        return np.asarray(answer.solution.tip_pose)

    def _tip(self) -> Vector:
        return self._tip_pose()[:3, 3]

    def _tip_quaternion(self) -> Vector:
        return np.asarray(lie.quaternion_from_rotation(self._tip_pose()[:3, :3]))


def _with_choice(key: str, design: Design, value: str) -> Design:
    return design.with_measure(**{key: value})


def _set(handle: Any, value: Any) -> None:
    """Show a value in an input of the panel, unless it is shown already."""
    if handle.value != value:
        handle.value = value


def _arrows(pairs: list[tuple[Vector, Vector]]) -> Any:
    return np.array(pairs, dtype=np.float32) if pairs else NOWHERE


def _pointing_quaternion(direction: Vector) -> Vector:
    """The least rotation (w first) of the z axis into a unit vector."""
    half = np.array([1.0 + direction[2], -direction[1], direction[0], 0.0])
    length = np.linalg.norm(half)
    return np.array([0.0, 1.0, 0.0, 0.0]) if length < 1e-9 else half / length
