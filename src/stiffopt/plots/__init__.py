"""Pictures of answers. They need matplotlib, which the extra ``plot`` brings.

matplotlib is imported when something is drawn, not before.
"""

from stiffopt.plots.figures import plot_pareto, plot_solution, require_matplotlib, save_figure

__all__ = ["plot_pareto", "plot_solution", "require_matplotlib", "save_figure"]
