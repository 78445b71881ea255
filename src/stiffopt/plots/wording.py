"""Numbers, units and stiffness measures in words, the same in figures and in tables."""

from collections.abc import Iterable

from stiffopt.directions import direction_name
from stiffopt.display import FIGURES, PLAIN, DisplayUnit, display_units
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.solution import PressureSolution


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
    """Return the unit in which values of an SI unit are shown."""
    return display_units().of_si(unit).name


def stiffness_text(value: float, unit: str | None) -> str:
    """Return a stiffness, in its SI unit, as people read it: with four significant figures."""
    return display_units().of_si(unit).text(value, FIGURES)


def gain_text(value: float, plain: float) -> str:
    """Return by how many per cent a value is above a plain one."""
    return f"{(value / plain - 1) * 100:+.0f} %".replace("-0 %", "+0 %")


def vector_text(values: Iterable[float], unit: DisplayUnit = PLAIN) -> str:
    """Return a vector as numbers of a unit, with at most three decimals of the usual one."""
    digits = 3 + unit.more_decimals
    return f"({', '.join(f'{round(unit.of(float(x)), digits) + 0.0:g}' for x in values)})"


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
