"""Numbers, units and stiffness measures in words, the same in figures and in tables."""

from collections.abc import Iterable

from stiffopt.directions import direction_name
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.solution import PressureSolution

MM = 1e3
"""Millimetres per metre."""
BAR = 1e-5
"""Bar per pascal."""


def least_maximised(solution: PressureSolution) -> float | None:
    """Return the smallest of the stiffnesses that a task maximises: what its trade-off is about."""
    goal = solution.task.stiffness
    count = len(goal.maximise) if goal is not None else 0
    return min(solution.stiffnesses[:count], default=None)


def limit_of(solution: PressureSolution, channel: str) -> str:
    """Return at which limit a channel is: ``min``, ``max`` or, at none, an empty text."""
    sides = (s for s in ("min", "max") if f"{channel} {s}" in solution.active_bounds)
    return next(sides, "")


def unit_text(unit: str | None) -> str:
    """Return a unit as people write it."""
    return (unit or "").replace("*", " ")


def figures(value: float) -> str:
    """Return a number with four significant figures."""
    return f"{value:#.4g}".removesuffix(".")


def gain_text(value: float, plain: float) -> str:
    """Return by how many per cent a value is above a plain one."""
    return f"{(value / plain - 1) * 100:+.0f} %".replace("-0 %", "+0 %")


def bar_text(pressure: float) -> str:
    """Return a pressure in Pa as a number in bar, with three decimals."""
    return f"{pressure * BAR + 0.0:.3f}"


def vector_text(values: Iterable[float]) -> str:
    """Return a vector with at most three decimals."""
    return f"({', '.join(f'{round(float(value), 3) + 0.0:g}' for value in values)})"


def short_direction(measure: StiffnessMeasure) -> str:
    """Return along or about which direction a stiffness is meant, as short as can be."""
    way = "along" if measure.kind == "translation" else "about"
    tip = "the tip's " if measure.frame == "tip" else ""
    return f"{way} {tip}{direction_name(measure.direction)}"


def direction_text(measure: Measure) -> str:
    """Return along or about what a stiffness is meant, or what else it is of."""
    if not isinstance(measure, StiffnessMeasure):
        return measure.words()
    way = "along" if measure.kind == "translation" else "about"
    return f"{way} {vector_text(measure.direction)}"
