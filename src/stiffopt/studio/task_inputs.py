"""The panel's inputs of a task: its target, its stiffness, its loads and limits.

Each input shows a design, and converts events of the browser to changes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import DisplayUnit, display_units
from stiffopt.studio.design import Angular, Design

On = Callable[[str, Callable[[Design, Any], Design]], Callable[[Any], None]]
"""Takes the kind of a change and a function of design and input; returns viser's callback."""

_GRAM, _MILLINEWTON = DisplayUnit("g", 1e3), DisplayUnit("mN", 1e3)
_MAX_FORCE = 0.2  # N
_ANGULAR: dict[str, Angular] = {
    "any direction": "any",
    "pointing": "pointing",
    "full orientation": "orientation",
}
_MAXIMISE, _LEAST_PRESSURE, _FILE = "stiff along a direction", "least pressure", "as in the file"
_GRAVITY = {
    "none": (0.0, 0.0, 0.0),
    "standing": (0.0, 0.0, -9.81),
    "hanging": (0.0, 0.0, 9.81),
    "lying": (-9.81, 0.0, 0.0),
}


class TargetInputs:
    """Inputs of position, free axes, direction of the tip, and tolerances.

    Parameters
    ----------
    gui : of viser.
    on : forwards changes.
    tip : pose (4, 4) of the tip now.
    turned : quaternion (w first) of the target's handle.
    """

    def __init__(
        self, gui: Any, on: On, tip: Callable[[], Array], turned: Callable[[], Any]
    ) -> None:
        self._lengths, self._angles = display_units().length, display_units().angle
        step = _rounded(self._lengths.of(1e-4))
        self._position = gui.add_vector3(f"position ({self._lengths})", (0.0, 0.0, 0.0), step=step)
        self._position.on_update(on("target", lambda d, v: d.at_pose(
            self._lengths.to_si(np.asarray(v)), turned())))  # fmt: skip
        self._free = [gui.add_checkbox(f"{axis} is free", False) for axis in "xyz"]
        for box in self._free:
            box.on_update(on("free", lambda d, _: d.with_free(
                [each.value for each in self._free], tip()[:3, 3])))  # fmt: skip
        self._angular = gui.add_dropdown(
            "tip axis", tuple(_ANGULAR), hint="What is asked of the tip's direction."
        )
        self._angular.on_update(on("angular", lambda d, v: d.with_angular(
            _ANGULAR[v], lie.quaternion_from_rotation(tip()[:3, :3]))))  # fmt: skip
        degree = np.radians(1.0)
        self._tolerance = add_slider(gui, "tolerance", self._lengths, 5e-5, 5e-3, 5e-5, 1e-4)
        self._angle = add_slider(
            gui, "tolerance", self._angles, 0.1 * degree, 20 * degree, 0.1 * degree, degree
        )
        for slider in (self._tolerance, self._angle):
            slider.on_update(on("tolerance", lambda d, _: d.with_tolerance(
                float(self._lengths.to_si(self._tolerance.value)),
                float(self._angles.to_si(self._angle.value)))))  # fmt: skip

    def show(self, design: Design, position: Array) -> None:
        """Show a design, and the position (3,) of the target's handle, in m."""
        decimals = 2 + self._lengths.more_decimals
        shown = np.asarray(self._lengths.of(position)).round(decimals)
        show_value(self._position, tuple(shown.tolist()))
        for box, free in zip(self._free, design.free, strict=True):
            show_value(box, free)
        show_value(self._angular, next(k for k, v in _ANGULAR.items() if v == design.angular))
        tolerance = design.task.target.tolerance
        show_on_slider(self._tolerance, self._lengths, tolerance.position)
        show_on_slider(self._angle, self._angles, tolerance.angle)


class StiffnessInputs:
    """Inputs of the stiffness goal.

    Parameters
    ----------
    gui : of viser.
    on : forwards changes.
    design : the initial design, whose goal can be chosen again.
    """

    def __init__(self, gui: Any, on: On, design: Design) -> None:
        options: tuple[str, ...] = (_MAXIMISE, _LEAST_PRESSURE)
        if design.measure is None and design.task.stiffness is not None:
            options = (*options, _FILE)
        self._given = design.task.stiffness
        self._goal = gui.add_dropdown("what is wanted", options)
        self._goal.on_update(on("goal", self._with_goal))
        self._direction = gui.add_vector3("direction", (1.0, 0.0, 0.0), step=0.01)
        self._direction.on_update(on("direction", lambda d, v: d.with_measure(direction=tuple(v))))
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
            box.on_update(on(key, partial(_with_choice, key)))

    def _with_goal(self, design: Design, goal: str) -> Design:
        if goal == _LEAST_PRESSURE:
            return design.with_least_pressure()
        if goal == _FILE:
            return design.with_task(stiffness=self._given)
        return design.with_measure()

    def show(self, design: Design) -> None:
        """Show a design."""
        goal, measure = design.task.stiffness, design.measure
        word = _LEAST_PRESSURE if goal is None else _MAXIMISE if measure is not None else _FILE
        show_value(self._goal, word)
        if measure is not None:
            show_value(self._direction, tuple(round(x, 4) for x in measure.direction))
            for key, box in self._choices.items():
                show_value(box, getattr(measure, key))


class LoadInputs:
    """Inputs of gravity, masses, the force at the tip and the highest pressure.

    Parameters
    ----------
    gui : of viser.
    on : forwards changes.
    design : the initial design, whose gravity can be chosen again.
    """

    def __init__(self, gui: Any, on: On, design: Design) -> None:
        description = design.description
        self._weights = dict(_GRAVITY)
        if description.gravity not in self._weights.values():
            self._weights["as in the file"] = description.gravity
        self._gravity = gui.add_dropdown("gravity: the arm is", tuple(self._weights))
        heaviest = max(0.1, 2 * description.tip_mass)
        self._mass = add_slider(gui, "tip mass", _GRAM, 0.0, heaviest, 5e-4, 0.0)
        for each in (self._gravity, self._mass):
            each.on_update(on("gravity", lambda d, _: d.with_gravity(
                self._weights[self._gravity.value],
                _GRAM.to_si(self._mass.value))))  # fmt: skip
        self._force = [
            add_slider(gui, f"force {a}", _MILLINEWTON, -_MAX_FORCE, _MAX_FORCE, 1e-3, 0.0)
            for a in "xyz"
        ]
        for each in self._force:
            each.on_update(on("force", lambda d, _: d.with_force(
                [_MILLINEWTON.to_si(slider.value) for slider in self._force])))  # fmt: skip
        self._pressures = display_units().pressure
        highest = max(description.pressure_max)
        self._highest = add_slider(
            gui, "most pressure", self._pressures, 0.05 * highest, highest, 1e3, highest
        )
        self._highest.on_update(on("highest", lambda d, v: d.with_highest(
            float(self._pressures.to_si(v)))))  # fmt: skip

    def show(self, design: Design) -> None:
        """Show a design."""
        gravity = design.description.gravity
        show_value(self._gravity, next(k for k, v in self._weights.items() if v == gravity))
        show_value(self._mass, _GRAM.of(design.description.tip_mass))
        force = design.task.load.force if design.task.load is not None else (0.0, 0.0, 0.0)
        for slider, value in zip(self._force, force, strict=True):
            show_on_slider(slider, _MILLINEWTON, value)
        highest = float(design.task.pressure_bounds(design.description)[1].max())
        show_on_slider(self._highest, self._pressures, highest)


def add_slider(
    gui: Any, label: str, unit: DisplayUnit, low: float, high: float, step: float, value: float
) -> Any:
    """Add a slider that shows SI values in a unit."""
    numbers = (_rounded(unit.of(each)) for each in (low, high, step, value))
    return gui.add_slider(f"{label} ({unit})", *numbers)


def show_on_slider(slider: Any, unit: DisplayUnit, value: float) -> None:
    """Show an SI value on a slider, clipped to its range."""
    show_value(slider, min(slider.max, max(slider.min, _rounded(unit.of(value)))))


def show_value(handle: Any, value: Any) -> None:
    """Show a value in an input of the panel if it changed."""
    if handle.value != value:
        handle.value = value


def _rounded(value: float) -> float:
    return float(f"{value:.9g}")


def _with_choice(key: str, design: Design, value: str) -> Design:
    return design.with_measure(**{key: value})
