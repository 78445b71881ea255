"""The process in which a `ProcessPlanner` plans; ends when the other end of its line does."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from multiprocessing.connection import Connection

from stiffopt.control.planner import Planning

__all__ = ["main"]

_HUMBLE = 5  # nice: the control loop comes first


def main(line: Connection) -> None:
    """Answer requests with plans, or with the reason why there is none, one after the other."""
    robot = line.recv()
    planning = Planning(robot)
    line.send(None)
    while True:
        request = line.recv()
        try:
            line.send(planning.plan(request))
        except Exception as error:  # whatever it is: the next request may be another
            line.send(f"{type(error).__name__}: {error}")
            planning = Planning(robot)


if __name__ == "__main__":
    os.nice(_HUMBLE)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        main(Connection(int(sys.argv[1])))
