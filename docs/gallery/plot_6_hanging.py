"""
A hanging arm that lifts
========================

With gravity, a tip mass and a load every quantity is that of the loaded arm: its static
equilibrium, and the tangent stiffness there.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/hanging_retraction.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
figure = plot_solution(robot, stiffopt.solve_pressure(robot, task))
