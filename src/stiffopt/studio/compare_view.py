"""Compare solutions side by side in the studio, and copy the design."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stiffopt.studio import texts
from stiffopt.studio.design import Design
from stiffopt.studio.drawing import KEPT, ArmTube
from stiffopt.studio.workbench import Workbench


class CompareView:
    """Draws the kept solutions, with inputs that keep and clear them.

    `server`: viser.ViserServer. `redraw`: called when the plain solution is switched on or off.
    """

    def __init__(self, server: Any, bench: Workbench, redraw: Callable[[], None]) -> None:
        self._server, self._bench, gui = server, bench, server.gui
        self._kept: list[ArmTube] = []
        keep = gui.add_button("keep this answer", hint="Compare it with others.")
        keep.on_click(self._keep)
        clear = gui.add_button("clear", hint="Forget the answers that were kept.")
        clear.on_click(self._clear)
        self._table = gui.add_html("")
        self._with_plain = gui.add_checkbox(
            "show the arm with plain pressures", False,
            hint="Those of least pressure that reach the target.",
        )  # fmt: skip
        self._with_plain.on_update(lambda _: redraw())

    @property
    def with_plain(self) -> bool:
        """Whether to draw the plain solution too."""
        return bool(self._with_plain.value)

    def show(self) -> None:
        """Compare the kept solutions with the present one."""
        if self._bench.kept:
            self._table.content = texts.compared_html(self._bench)

    def _keep(self, _: Any) -> None:
        bench = self._bench
        if bench.keep() and bench.answer is not None:
            answer, number = bench.answer, len(self._kept)
            arm = ArmTube(
                self._server, f"/kept/{number}", answer.design.description,
                KEPT[number % len(KEPT)], 0.35,
            )  # fmt: skip
            arm.show(answer.robot, answer.pressures)
            self._kept.append(arm)
        self._table.content = texts.compared_html(bench)

    def _clear(self, _: Any) -> None:
        self._bench.kept.clear()
        for arm in self._kept:
            arm.remove()
        self._kept.clear()
        self._table.content = texts.compared_html(self._bench)


class CopyView:
    """Shows the design as files and as Python, for copying.

    `gui`: of viser. `design`: returns the present design.
    """

    def __init__(self, gui: Any, design: Callable[[], Design]) -> None:
        self._design = design
        makers: dict[str, Callable[[Design], str]] = {
            "copy as task file": texts.task_text,
            "copy as robot file": texts.robot_text,
            "copy as Python": texts.python_text,
        }
        for label, make in makers.items():
            button = gui.add_button(label)
            button.on_click(lambda _, make=make: self._show(make))
        self._copied = gui.add_html("")

    def _show(self, make: Callable[[Design], str]) -> None:
        design, title = self._design(), ""
        if design.has_own_robot and make is texts.task_text:
            title = f"The robot was changed: save its file as {texts.ROBOT_FILE} beside the task."
        self._copied.content = texts.copy_html(title, make(design))
