"""
A path
======

The tip follows a line. The pressures of all points are chosen together, so that the smallest
stiffness on the line is as large as possible and no pressure exceeds its rate limit.
"""

import stiffopt
from stiffopt.plots import plot_path

path = stiffopt.load_path("../../problems/paths/path_line_stiff_x.yaml")
robot = stiffopt.load_robot(path.resolve_robot())
figure = plot_path(path, stiffopt.solve_path(robot, path))
