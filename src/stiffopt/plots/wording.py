"""Format numbers, units and stiffness measures, the same in figures and in tables."""

from collections.abc import Iterable

from stiffopt.directions import direction_name
from stiffopt.display import FIGURES, PLAIN, DisplayUnit, display_units
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.solution import PressureSolution


def least_maximised(solution: PressureSolution) -> float | None:
    """Return the smallest of the stiffnesses that a task maximises, or None."""
    goal = solution.task.stiffness
    count = len(goal.maximise) if goal is not None else 0
    return min(solution.stiffnesses[:count], default=None)


def limit_of(solution: PressureSolution, channel: str) -> str:
    """Return the limit at which a channel is: ``min``, ``max`` or an empty text."""
    sides = (s for s in ("min", "max") if f"{channel} {s}" in solution.active_bounds)
    return next(sides, "")


def stiffness_text(value: float, unit: str | None) -> str:
    """Format a stiffness, given in an SI unit, in its display unit with four figures."""
    return display_units().of_si(unit).text(value, FIGURES)


def gain_text(value: float, plain: float) -> str:
    """Format the excess of a value over a plain one in per cent."""
    return f"{(value / plain - 1) * 100:+.0f} %".replace("-0 %", "+0 %")


def vector_text(values: Iterable[float], unit: DisplayUnit = PLAIN) -> str:
    """Format a vector in a unit, with at most three decimals (more for larger units)."""
    digits = 3 + unit.more_decimals
    return f"({', '.join(f'{round(unit.of(float(x)), digits) + 0.0:g}' for x in values)})"


def short_direction(measure: StiffnessMeasure) -> str:
    """Describe the direction of a stiffness briefly."""
    way = "along" if measure.kind == "translation" else "about"
    tip = "the tip's " if measure.frame == "tip" else ""
    return f"{way} {tip}{direction_name(measure.direction)}"


def direction_text(measure: Measure) -> str:
    """Describe the direction of a stiffness, or another measure in its own words."""
    if not isinstance(measure, StiffnessMeasure):
        return measure.words()
    way = "along" if measure.kind == "translation" else "about"
    return f"{way} {vector_text(measure.direction)}"
