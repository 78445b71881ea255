"""
A push with a tool, three segments
==================================

A blunt tool at a position and a pointing, as stiff as possible along its own axis. Three
segments have nine pressures. The pose takes five of them, four are left for stiffness.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/surgical_push_three_segments.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
figure = plot_solution(robot, stiffopt.solve_pressure(robot, task))
