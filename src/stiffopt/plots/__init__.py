"""Draw figures of solutions, paths, maps, experiments, calibrations and runs.

They need matplotlib, from the extra ``plot``, which is imported only when something is drawn.
Without it, every function that makes a figure raises `MissingExtraError`. Functions whose names
begin with ``draw_`` draw into axes that the caller provides.
"""

from stiffopt.plots.arm import draw_arm
from stiffopt.plots.path import (
    draw_asked_path,
    draw_clearance_along,
    draw_path,
    draw_pressures_along,
    draw_stiffness_along,
    plot_motion,
    plot_path,
)
from stiffopt.plots.solution import (
    draw_pareto,
    draw_pressures,
    draw_solution,
    draw_task,
    plot_pareto,
    plot_solution,
)
from stiffopt.plots.style import require_matplotlib, save_figure

__all__ = [
    "draw_arm",
    "draw_asked_path",
    "draw_clearance_along",
    "draw_pareto",
    "draw_path",
    "draw_pressures",
    "draw_pressures_along",
    "draw_solution",
    "draw_stiffness_along",
    "draw_task",
    "plot_motion",
    "plot_pareto",
    "plot_path",
    "plot_solution",
    "require_matplotlib",
    "save_figure",
]
