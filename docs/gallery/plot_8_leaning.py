"""
Leaning on a wall
=================

The back of the arm rests on the wall behind it. For a task with a brace, the optimiser decides
whether, where and how hard to lean. The dotted ellipsoid is that of the stiffest answer that keeps
clear of the wall.
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
