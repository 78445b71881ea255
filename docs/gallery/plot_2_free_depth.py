"""
A free axis
===========

The same position, but with a free height. The optimiser chooses the height, and the arm is
stiffer. A free axis is often the cheapest way to gain stiffness.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/two_segment_free_depth.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
figure = plot_solution(robot, stiffopt.solve_pressure(robot, task))
