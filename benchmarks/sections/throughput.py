"""Many tasks at once."""

from time import perf_counter

import numpy as np

import settings as bars
import stiffopt
import tasks
from results import Section, at_least, times
from settings import Settings
from timing import median

TEXT = """\
`solve_batch` on random two-segment tasks, cold, all cores, against `solve_pressure` in a loop
on the first of them; the answers must be equal bit by bit. Rates are tasks per second; both in
turn, median of three."""


def section(sizes: Settings) -> Section:
    """The table of throughput."""
    out = Section("Many tasks", TEXT, ("how", "tasks", "per second", "ratio"))
    robot = tasks.arm(2)
    few = max(5, sizes.batch_tasks // 20)
    solve_batch = getattr(stiffopt, "solve_batch", None)
    count = sizes.batch_tasks if solve_batch else few
    cases = [tasks.task_of("position", 2, sizes.seed, i)[1] for i in range(count)]
    stiffopt.solve_pressure(robot, cases[0])
    loops, batches, same = [], [], True
    spent = perf_counter()
    for repetition in range(min(3, sizes.repetitions)):
        if repetition and perf_counter() - spent > 10 * sizes.most_seconds:
            break
        begin = perf_counter()
        single = [stiffopt.solve_pressure(robot, task) for task in cases[:few]]
        loops.append((perf_counter() - begin) / few)
        if solve_batch is None:
            continue
        begin = perf_counter()
        many = solve_batch(robot, cases)
        batches.append((perf_counter() - begin) / count)
        pairs = zip(single, many, strict=False)
        same = same and all(np.array_equal(a.pressures, b.pressures) for a, b in pairs)
    loop = median(np.array(loops)[:, np.newaxis])
    out.rows.append(("solve_pressure in a loop", str(few), f"{1 / loop:.3g}", "1x"))
    what = "solve_batch, 2 segments"
    if not batches:
        out.rows.append(("solve_batch", "-", "not in this version", "-"))
        out.verdicts.append(at_least(what, bars.BATCH_SOLVES, float("nan"), "tasks/s"))
        return out
    batch = median(np.array(batches)[:, np.newaxis])
    out.rows.append(("solve_batch", str(count), f"{1 / batch:.4g}", times(loop / batch)))
    out.verdicts += [
        at_least(what, bars.BATCH_SOLVES, 1 / batch, "tasks/s"),
        at_least("solve_batch, identical to one by one", 100, 100.0 * same, "%"),
    ]
    out.data = {"loop_per_s": 1 / loop, "batch_per_s": 1 / batch, "identical": same}
    return out
