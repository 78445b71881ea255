"""
A position, stiff along x
=========================

The first example: two segments bring the tip to a position and are as stiff as possible along
x. The grey percentage is the gain over the plain pressures, which ignore stiffness.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/two_segment_stiff_x.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
solution = stiffopt.solve_pressure(robot, task)
plain = stiffopt.solve_pressure(robot, task.model_copy(update={"stiffness": None}))

figure = plot_solution(robot, solution, plain=robot.stiffness(plain.pressures, [1, 0, 0]))
