"""How to get to a pose and stay there: estimator, planner, controller, safety and the loop.

Everything here sees a rig through `stiffopt.rig.interface` alone.
"""
