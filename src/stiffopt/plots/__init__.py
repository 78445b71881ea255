"""Figures: of solutions, paths, maps, experiments, calibrations and runs.

They need matplotlib, which the extra ``plot`` brings; it is imported when something is drawn, not
before. Without it every function that draws raises `MissingExtraError`.
"""

from stiffopt.plots.path import plot_motion, plot_path
from stiffopt.plots.solution import plot_pareto, plot_solution
from stiffopt.plots.style import require_matplotlib, save_figure

__all__ = [
    "plot_motion",
    "plot_pareto",
    "plot_path",
    "plot_solution",
    "require_matplotlib",
    "save_figure",
]
