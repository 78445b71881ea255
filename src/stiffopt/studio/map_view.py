"""Show a workspace map in the studio, as a cloud of cells coloured by stiffness."""

from __future__ import annotations

from typing import Any

from stiffopt.display import display_units
from stiffopt.errors import StiffoptError
from stiffopt.studio import texts
from stiffopt.studio.cloud import StiffnessCloud
from stiffopt.studio.task_inputs import add_slider
from stiffopt.workspace.map import WorkspaceMap

_NO_MAP = "do not show"


class MapView:
    """Draws a map, with inputs that choose the direction and the cut.

    `server`: viser.ViserServer. `found`: of the drawn arm.
    """

    def __init__(self, server: Any, found: WorkspaceMap) -> None:
        self._server, self._found, gui = server, found, server.gui
        self._names = tuple(f"along {name}" for name in found.direction_names)
        self._chosen = gui.add_dropdown("stiffness", (*self._names, _NO_MAP))
        self._unit = display_units().length
        low, high = (round(float(each[1]), 3) for each in (found.low, found.high))
        begin = min(max(0.0, low), high)
        self._cut = add_slider(gui, "cells beyond y", self._unit, low, high, 5e-4, begin)
        self._legend = gui.add_html("")
        cloud = StiffnessCloud.of(found, 0, begin)
        self._cloud = server.scene.add_point_cloud(
            "/map", cloud.points, cloud.colours, point_size=cloud.size, point_shape="circle"
        )
        self._legend.content = texts.note_html(cloud.legend)
        for each in (self._chosen, self._cut):
            each.on_update(lambda _: self._show())

    def _show(self) -> None:
        chosen = self._chosen.value
        self._cloud.visible = chosen in self._names
        if chosen not in self._names:
            return
        try:
            cut = float(self._unit.to_si(self._cut.value))
            cloud = StiffnessCloud.of(self._found, self._names.index(chosen), cut)
        except StiffoptError as error:
            self._legend.content = texts.note_html(str(error))
            return
        with self._server.atomic():
            self._cloud.points, self._cloud.colors = cloud.points, cloud.colours
        self._legend.content = texts.note_html(cloud.legend)
