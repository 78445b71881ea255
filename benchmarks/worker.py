"""Measurements that need a process of their own; started by `sections.processes`."""

import json
import os
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

import tasks
from peers.ipopt import Ipopt
from peers.own import Stiffopt
from sections.full_task import measure
from settings import Settings
from stiffopt import solve_pressure


def first(segments: int, sizes: Settings) -> dict[str, float]:
    """Time of the first solution in this process, of later ones, and size of the code it left."""
    robot = tasks.arm(segments)
    cases = [tasks.task_of("position", segments, sizes.seed, i)[1] for i in range(6)]
    seconds = []
    for task in cases:
        begin = perf_counter()
        solve_pressure(robot, task)
        seconds.append(perf_counter() - begin)
    cache = Path(os.environ["STIFFOPT_CACHE_DIR"])
    code = sum(file.stat().st_size for file in cache.rglob("*.so"))
    return {"first_s": seconds[0], "later_s": float(np.median(seconds[1:])), "code_bytes": code}


def full(segments: int, sizes: Settings) -> dict[str, dict[str, float]]:
    """The full task on fewer tasks, beside IPOPT."""
    few = {"tasks": max(2, sizes.tasks // 4), "warm_tasks": max(2, sizes.warm_tasks // 4)}
    small = Settings(**{**vars(sizes), **few, "reference_starts": 0})
    return measure([Stiffopt, Ipopt], segments, small).record()


def main() -> None:
    """Print one measurement as JSON in the last line: WORK SEGMENTS SETTINGS."""
    work, segments, given = sys.argv[1:]
    fields = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(given).items()}
    answer = {"first": first, "full": full}[work](int(segments), Settings(**fields))
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
