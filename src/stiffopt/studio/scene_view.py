"""The view of a scene: its objects, the handle of the chosen one, and their inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import StiffoptError
from stiffopt.model.scene import SceneObject
from stiffopt.plots import style
from stiffopt.plots.shapes import surface_mesh
from stiffopt.studio import objects, texts
from stiffopt.studio.design import Design
from stiffopt.studio.drawing import place, rgb
from stiffopt.studio.task_inputs import add_slider, show_on_slider

_NONE = "(none)"
_SHADES = {"inside_tube": 0.15, "half_space": 0.25}
_SHADE = 0.55


def draw_object(server: Any, item: SceneObject, number: int, length: float) -> tuple[Any, Any]:
    """Draw an object with its name; unbounded ones are cut off at about a length, in m."""
    vertices, faces = surface_mesh(item.shape, length)
    name = f"/scene/{number}-{item.shape.key}-{abs(hash(item.name))}"
    mesh = server.scene.add_mesh_simple(
        name, vertices, faces, color=rgb(style.OBSTACLE), side="double",
        opacity=_SHADES.get(item.shape.key, _SHADE), cast_shadow=False,
    )  # fmt: skip
    label = server.scene.add_label(f"{name}-name", item.name)
    place(label, _label_place(vertices))
    return mesh, label


def _label_place(vertices: Any) -> Any:
    return vertices.max(axis=0) * [0, 0, 1] + vertices.mean(axis=0) * [1, 1, 0]


class SceneView:
    """Draws the objects around an arm, and forwards changes of them.

    Parameters
    ----------
    server : viser.ViserServer
    design : returns the present design.
    change : called with the kind of a change and a function that changes the design.
    hold : called with whether to hold the pressures, so that the arm leans on objects.
    """

    def __init__(
        self,
        server: Any,
        design: Callable[[], Design],
        change: Callable[[str, Callable[[Design], Design]], None],
        hold: Callable[[bool], None],
    ) -> None:
        self._server, self._design, self._change, self._hold = server, design, change, hold
        self._drawn: dict[str, tuple[SceneObject, Any, Any]] = {}
        self.is_held = False
        self._length = design().description.length
        self._handle = server.scene.add_transform_controls(
            "/held", scale=0.2 * self._length, line_width=2.5, disable_rotations=True,
            depth_test=False, visible=False,
        )  # fmt: skip
        self._handle.on_update(self._moved)

    @property
    def handle_position(self) -> Array:
        """Position of the chosen object's handle (3,), in m."""
        return np.asarray(self._handle.position)

    def add_inputs(self, gui: Any) -> None:
        """Add the inputs to the panel."""
        self._chosen = gui.add_dropdown("object", (_NONE,), hint="It gets a handle to drag.")
        self._chosen.on_update(lambda event: self.show() if event.client is not None else None)
        unit = self._unit = display_units().length
        self._size = add_slider(gui, "size", unit, 1e-3, round(self._length, 3), 5e-4, 1e-2)
        self._size.on_update(self._resized)
        self._clearance = add_slider(gui, "clearance", unit, 0.0, 2e-2, 1e-4, 0.0)
        self._clearance.on_update(self._cleared)
        self._allowed = gui.add_checkbox(
            "may be leant on", False, hint="The arm may touch this object."
        )
        self._allowed.on_update(self._allowed_changed)
        hold = gui.add_checkbox(
            "lean: hold the pressures", False,
            hint="The pressures stay, and objects that may be leant on push the arm.",
        )  # fmt: skip
        hold.on_update(lambda event: self._hold(hold.value) if event.client is not None else None)
        remove = gui.add_button("remove this object")
        remove.on_click(self._removed)
        self._kind = gui.add_dropdown("new object", objects.NEW)
        add = gui.add_button("add an object")
        add.on_click(self._added)
        self._file = gui.add_text("scene file", "scene.yaml")
        save = gui.add_button("save scene file")
        save.on_click(self._saved)
        self._said = gui.add_html("")

    # -- events of the browser ----------------------------------------------------------------

    async def _moved(self, event: Any) -> None:
        self.is_held = event.phase != "end"
        item = self._item()
        if item is not None:
            new = objects.moved(item, self._handle.position)
            self._replace(new, f"move {item.name}")
        if not self.is_held:
            self.show()

    def _resized(self, event: Any) -> None:
        item = self._item()
        if event.client is not None and item is not None:
            size = float(self._unit.to_si(self._size.value))
            self._replace(objects.resized(item, size), f"size of {item.name}")

    def _cleared(self, event: Any) -> None:
        if event.client is not None:
            clearance = float(self._unit.to_si(self._clearance.value))
            self._change("clearance", lambda design: design.with_clearance(clearance))

    def _allowed_changed(self, event: Any) -> None:
        item = self._item()
        if event.client is not None and item is not None:
            new = objects.leant_on(item, allowed=self._allowed.value)
            self._replace(new, f"contact of {item.name}")

    def _removed(self, _: Any) -> None:
        item = self._item()
        if item is not None:
            self._change("remove", lambda design: design.with_objects(
                [each for each in design.objects if each.name != item.name]))  # fmt: skip

    def _added(self, _: Any) -> None:
        item = objects.new_object(self._kind.value, self._design().objects, self._length)
        self._change("add", lambda design: design.with_objects([*design.objects, item]))
        if any(each.name == item.name for each in self._design().objects):
            self._chosen.value = item.name
            self.show()

    def _saved(self, _: Any) -> None:
        scene = self._design().task.scene
        try:
            if scene is None:
                raise StiffoptError("there is no object to save; add one first")
            objects.save_scene(self._file.value, scene)
            said = f"saved as {self._file.value}, in the folder of the command"
        except StiffoptError as error:
            said = str(error)
        self._said.content = texts.note_html(said)

    def _replace(self, item: SceneObject, kind: str) -> None:
        self._change(
            kind, lambda design: design.with_objects(objects.replaced(design.objects, item))
        )

    def _item(self) -> SceneObject | None:
        chosen = self._chosen.value
        return next((each for each in self._design().objects if each.name == chosen), None)

    # -- drawing ------------------------------------------------------------------------------

    def show(self) -> None:
        """Draw the objects of the design; only changes are sent."""
        design = self._design()
        names = tuple(each.name for each in design.objects)
        for gone in [name for name in self._drawn if name not in names]:
            for node in self._drawn.pop(gone)[1:]:
                node.remove()
        for item in design.objects:
            self._draw(item)
        if self._chosen.options != (*names, _NONE):
            kept = self._chosen.value
            self._chosen.options = (*names, _NONE)
            self._chosen.value = kept if kept in names else _NONE
        clearance = 0.0 if design.task.scene is None else design.task.scene.clearance
        show_on_slider(self._clearance, self._unit, clearance)
        self._show_handle()

    def _show_handle(self) -> None:
        item = self._item()
        self._handle.visible = item is not None
        if item is None or self.is_held:
            return
        place(self._handle, objects.place_of(item.shape))
        self._allowed.value = item.may_be_leant_on
        size = objects.size_of(item.shape)
        if size is not None:
            show_on_slider(self._size, self._unit, size)

    def _draw(self, item: SceneObject) -> None:
        before = self._drawn.get(item.name)
        if before is not None and before[0] == item:
            return
        if before is not None and before[0].shape.key == item.shape.key:
            _, mesh, label = before
            vertices, faces = surface_mesh(item.shape, self._length)
            mesh.vertices = vertices
            if mesh.faces.shape != faces.shape:
                mesh.faces = faces
            place(label, _label_place(vertices))
        else:
            mesh, label = draw_object(self._server, item, len(self._drawn), self._length)
        self._drawn[item.name] = item, mesh, label
