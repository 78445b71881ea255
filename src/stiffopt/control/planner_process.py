"""The process in which a `ProcessPlanner` plans; ends when the other end of its line does."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from stiffopt.control.planner_line import PlanningLine
from stiffopt.control.planning import Planning

__all__ = ["main"]

_HUMBLE = 5  # nice: the control loop comes first


def main(line: PlanningLine) -> None:
    """Answer requests with plans, or with the reason why there is none, one after the other."""
    robot = line.robot()
    planning = Planning(robot)
    line.answer(None)
    while True:
        request = line.request()
        try:
            line.answer(planning.plan(request))
        except Exception as error:  # whatever it is: the next request may be another
            line.answer(f"{type(error).__name__}: {error}")
            planning = Planning(robot)


if __name__ == "__main__":
    os.nice(_HUMBLE)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        main(PlanningLine(int(sys.argv[1])))
