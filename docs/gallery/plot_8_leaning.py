"""
Leaning on a wall
=================

The back of the arm is on the wall behind it. A task with a brace decides whether, where and how
hard to lean; beside the answer the stiffest one that keeps clear of the wall, whose ellipsoid is
the dotted one.
"""

import stiffopt
from stiffopt.plots import plot_solution

task = stiffopt.load_task("../../problems/leaning_on_a_wall.yaml")
robot = stiffopt.load_robot(task.resolve_robot())
solution = stiffopt.solve_pressure(robot, task)
for contact in solution.contacts:
    print(f"leans on '{contact.object}' {1e3 * contact.at:.0f} mm along the arm")
print(f"{solution.stiffness:.3g} N/m, {solution.stiffness_free:.3g} N/m clear of the wall")

figure = plot_solution(robot, solution)
