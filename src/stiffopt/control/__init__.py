"""Closed-loop control: estimator, planner, reference, feedback, supervision and the loop.

`ControlLoop` (loop.py) ticks and takes requests, its `Supervisor` keeps the arm safe, and the
`TipController` (controller.py) decides on pressures; docs/control.md and docs/touch.md explain how.
The package sees a rig only through `stiffopt.rig.interface`.
"""
