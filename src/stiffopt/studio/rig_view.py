"""The view of a rig: its arm as it is now and, with the token, a preview and controls."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from stiffopt.model.manipulator import Manipulator
from stiffopt.studio import texts
from stiffopt.studio.drawing import ArmTube, add_force_arrows, add_surroundings, draw, place, rgb
from stiffopt.studio.leaning import force_arrows
from stiffopt.studio.rig_watch import RigWatch
from stiffopt.studio.scene_view import draw_object
from stiffopt.studio.task_view import TaskView
from stiffopt.studio.workbench import Workbench

_PERIOD = 0.1  # s, polling period of the daemon


class RigView:
    """Draws a daemon's arm; with the token, also a preview to drag, whose task *go* sends.

    `server`: viser.ViserServer.
    """

    def __init__(self, server: Any, watch: RigWatch) -> None:
        self.server, self.watch = server, watch
        description = watch.design.description
        self._robot = Manipulator(description)
        watch.poll()  # a preview begins where the arm is
        self.bench = Workbench(watch.present_design(self._robot))
        self._preview = TaskView(server, self.bench, is_preview=True) if watch.may_command else None
        if self._preview is None:
            add_surroundings(server, description)
            scene = watch.design.task.scene
            for number, item in enumerate(() if scene is None else scene.objects):
                draw_object(server, item, number, description.length)
        size = 0.02 * description.length
        self._arm = ArmTube(server, "/rig/arm", description)
        self._contacts = add_force_arrows(server, "/rig/contacts", description.length)
        self._balls = {
            name: server.scene.add_icosphere(
                f"/rig/{name}", radius=size, color=rgb(colour), visible=False
            )
            for name, colour in texts.BALLS.items()
        }
        self._add_panel()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="rig", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching, and release control."""
        self._over.set()
        self._thread.join()
        if self._preview is not None:
            self._preview.close()
        self.watch.close()

    def _add_panel(self) -> None:
        gui, watch = self.server.gui, self.watch
        if self._preview is None:
            self._words = gui.add_html("")
            return
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(360)
        with panel.add_tab("rig"):
            vent = gui.add_button("VENT", color="red", hint="Let all pressure out at once.")
            vent.on_click(lambda _: self._act(watch.vent))
            self._words = gui.add_html("")
            self._take = self._add_button("take control", watch.take_control)
            self._controls = [
                self._add_button("arm", watch.arm),
                self._add_button("go to the target of the preview", lambda: watch.go(self.bench)),
                self._add_button("hold", watch.hold),
                self._add_button("let the pressures down", watch.disarm),
                self._add_button("reset a fault", watch.reset),
                self._add_button("give control back", watch.release),
            ]

    def _add_button(self, label: str, action: Callable[[], None]) -> Any:
        button = self.server.gui.add_button(label)
        button.on_click(lambda _: self._act(action))
        return button

    def _act(self, action: Callable[[], None]) -> None:
        action()
        self._show_words()

    def _look(self) -> None:
        while not self._over.is_set():
            self.watch.poll()
            self._show()
            self._over.wait(_PERIOD)

    def _show(self) -> None:
        state = self.watch.state
        with self.server.atomic():
            if state is not None:
                pressures = state.pressures
                if pressures is not None:
                    leaning = self.watch.leaning(self._robot)
                    self._arm.show(self._robot, pressures, leaning)
                    draw(self._contacts, force_arrows(leaning, self._robot.length))
                self._show_ball("estimated", state.tip_position)
                self._show_ball("seen", state.seen_position)
                self._show_ball("target", state.target_position)
        self._show_words()

    def _show_ball(self, name: str, position: Any) -> None:
        ball = self._balls[name]
        is_known = position is not None and bool(np.isfinite(position).all())
        ball.visible = is_known
        if is_known:
            place(ball, position)

    def _show_words(self) -> None:
        self._words.content = texts.rig_html(self.watch)
        if self._preview is not None:
            self._take.disabled = self.watch.in_control
            for button in self._controls:
                button.disabled = not self.watch.in_control
