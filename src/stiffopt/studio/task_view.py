"""The view of a robot and a task: handles to drag, the arm that follows, and the panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import StiffoptError
from stiffopt.model.stopping import Cancel
from stiffopt.plots import style
from stiffopt.studio import texts
from stiffopt.studio.answer_view import AnswerView
from stiffopt.studio.compare_view import CompareView, CopyView
from stiffopt.studio.design import Design
from stiffopt.studio.drawing import add_surroundings, place, rgb, turn
from stiffopt.studio.leaning import LeaningView
from stiffopt.studio.map_view import MapView
from stiffopt.studio.scene_view import SceneView
from stiffopt.studio.task_inputs import LoadInputs, StiffnessInputs, TargetInputs
from stiffopt.studio.workbench import NewestWins, Workbench
from stiffopt.workspace.map import WorkspaceMap

Change = Callable[[Design], Design]

_PREVIEW = "Preview (violet): the arm does not move until you send it."


class TaskView:
    """Draws a workbench, and forwards events of the browser to it.

    Parameters
    ----------
    server : viser.ViserServer
    found : a map of the same arm, to show as a cloud.
    is_preview : whether to draw the arm translucently, as a preview over another one.
    """

    def __init__(
        self,
        server: Any,
        bench: Workbench,
        found: WorkspaceMap | None = None,
        *,
        is_preview: bool = False,
    ) -> None:
        self.server, self.bench = server, bench
        self._length = bench.design.description.length
        self._dragged: Any = None
        add_surroundings(server, bench.design.description)
        self._drawn = AnswerView(server, bench.design.description, is_preview=is_preview)
        self._add_handles()
        self._leaning = LeaningView(server, bench.design.description)
        self._scene = SceneView(server, lambda: bench.design, self._change, self._hold)
        self._add_panel(found, is_preview=is_preview)
        self.worker = NewestWins(self._quickly, self._fully)
        self._show_design()
        self.worker.request()

    def close(self) -> None:
        """End the thread of the solver."""
        self.worker.close()

    @property
    def target_position(self) -> Array:
        """Position of the target's handle (3,), in m."""
        return np.array(self._target.position)

    @property
    def direction_position(self) -> Array:
        """Position of the direction's handle (3,), in m."""
        return np.asarray(self._pull.position)

    @property
    def object_position(self) -> Array:
        """Position of the handle of the scene's chosen object (3,), in m."""
        return self._scene.handle_position

    @property
    def arm_end(self) -> Array:
        """Position of the drawn arm's end (3,), in m."""
        return (self._leaning if self._leaning.visible else self._drawn).arm_end

    # -- handles and panel --------------------------------------------------------------------

    def _add_handles(self) -> None:
        scene, length = self.server.scene, self._length
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

    def _add_panel(self, found: WorkspaceMap | None, *, is_preview: bool) -> None:
        gui, design = self.server.gui, self.bench.design
        if is_preview:
            gui.add_html(texts.note_html(_PREVIEW))
        self._words = gui.add_html("")
        undo = gui.add_button("undo", hint="Take the last change back.")
        undo.on_click(self._undo)
        tabs = gui.add_tab_group()
        with tabs.add_tab("target"):
            self._target_inputs = TargetInputs(
                gui, self._on, self._tip_pose, lambda: self._target.wxyz
            )
        with tabs.add_tab("stiffness"):
            self._stiffness_inputs = StiffnessInputs(gui, self._on, design)
        with tabs.add_tab("loads"):
            self._load_inputs = LoadInputs(gui, self._on, design)
        with tabs.add_tab("scene"):
            self._scene.add_inputs(gui)
        if found is not None:
            with tabs.add_tab("map"):
                self._map = MapView(self.server, found)
        with tabs.add_tab("compare"):
            self._compared = CompareView(self.server, self.bench, self._show_answer)
        with tabs.add_tab("copy"):
            self._copies = CopyView(gui, lambda: self.bench.design)
        self.tabs = tabs

    # -- events of the browser ----------------------------------------------------------------

    def _on(self, kind: str, change: Callable[[Design, Any], Design]) -> Callable[[Any], None]:
        """Return the callback of an input of the panel, which forwards a change."""

        def changed(event: Any) -> None:
            if event.client is not None:  # else the program itself set the value
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
        pose, measure = self._tip_pose(), self.bench.design.measure
        way = np.asarray(self._pull.position) - pose[:3, 3]
        if np.linalg.norm(way) < 0.02 * self._length or measure is None:
            return
        if measure.frame == "tip":
            way = pose[:3, :3].T @ way
        direction = tuple((way / np.linalg.norm(way)).round(4).tolist())
        self._change("direction", lambda design: design.with_measure(direction=direction))

    def _note_drag(self, event: Any) -> None:
        """Remember the dragged handle, which must not be moved meanwhile."""
        self._dragged = None if event.phase == "end" else event.target
        if event.phase == "end":
            self.bench.end_step()
            self.worker.request()

    def _hold(self, held: bool) -> None:
        try:
            self.bench.hold(held=held)
        except StiffoptError as error:
            self.bench.trouble = str(error)
        self._show_leaning()
        self.worker.request()

    def _undo(self, _: Any) -> None:
        if self.bench.undo():
            self.bench.trouble = ""
            self._show_design()
            self.worker.request()

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
        with self.server.atomic():
            if found and self.bench.leaning is None:
                self._show_answer()
            self._show_leaning()

    # -- drawing ------------------------------------------------------------------------------

    def _show_design(self) -> None:
        """Draw the design: the target, and the inputs of the panel."""
        design = self.bench.design
        with self.server.atomic():
            if self._dragged is not self._target:
                self._show_target(design)
            self._pull.visible = design.measure is not None
            self._target_inputs.show(design, self.target_position)
            self._stiffness_inputs.show(design)
            self._load_inputs.show(design)
            self._scene.show()

    def _show_target(self, design: Design) -> None:
        target = design.task.target
        given = target.position or (None, None, None)
        pairs = zip(given, self._tip_pose()[:3, 3], strict=True)
        place(self._target, [at if wanted is None else wanted for wanted, at in pairs])
        if target.orientation is not None:
            turn(self._target, target.orientation)
        elif target.pointing is not None:
            turn(self._target, lie.quaternion_along(target.pointing))
        elif self._target.disable_rotations is False:
            turn(self._target, (1.0, 0.0, 0.0, 0.0))
        self._target.disable_rotations = design.angular == "any"

    def _show_answer(self) -> None:
        """Draw the solution: the arm, its stiffness, a missed target, and the panel."""
        answer = self.bench.answer
        if answer is None:
            return
        with self.server.atomic():
            self._drawn.show(answer, self.target_position, with_plain=self._compared.with_plain)
            end = self._drawn.direction_end(answer)
            if end is not None and self._dragged is not self._pull:
                place(self._pull, end)
            if self._dragged is None and any(self.bench.design.free):
                self._show_target(self.bench.design)
            self._compared.show()

    def _show_leaning(self) -> None:
        with self.server.atomic():
            self._leaning.show(self.bench.leaning)
            self._show_words()

    def _show_words(self) -> None:
        self._words.content = texts.answer_html(self.bench)

    def _tip_pose(self) -> Array:
        """Return the pose (4, 4) of the solution's tip; without one, that of the straight arm."""
        answer = self.bench.answer
        if answer is None or answer.solution.tip_pose is None:
            pose = np.eye(4)
            pose[2, 3] = self._length
            return pose
        return np.asarray(answer.solution.tip_pose)
