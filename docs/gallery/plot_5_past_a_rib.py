"""
Among obstacles
===============

A sideways push past a rib and a post, under a table and through a port. The whole body keeps
its clearance from every object, and the arm is as stiff as that permits.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/two_segment_past_a_rib.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
solution = stiffopt.solve_pressure(robot, task)
print(f"{1e3 * solution.clearance:.2f} mm from '{solution.nearest_object}'")

figure = plot_solution(robot, solution)
