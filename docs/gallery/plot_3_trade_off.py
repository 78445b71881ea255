"""
Stiffness against tip error
===========================

How much stiffness would a larger tolerance gain? The task is solved at several tolerances. Each
point is the stiffest answer at its error.
"""

import stiffopt
from stiffopt.plots import plot_pareto

task = stiffopt.load_task("../../problems/two_segment_stiff_x.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
figure = plot_pareto(stiffopt.pareto_front(robot, task, 10))
