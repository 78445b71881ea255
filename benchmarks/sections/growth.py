"""How the cost grows: with segments, and with local searches."""

from time import perf_counter

import numpy as np

import settings as bars
import tasks
from peers.ipopt import Ipopt, IpoptEnergy
from peers.own import Stiffopt
from results import Section, milliseconds, percent, times
from sections.full_task import measure, stiffness_of
from settings import Settings
from stiffopt import solve_pressure

SEGMENTS_TEXT = """\
The full task on longer arms; *exponent*: slope of the logarithm of the time over that of the
number of segments, from the shortest to the longest arm."""
STARTS_TEXT = """\
Two segments, cold. stiffopt's stopping rule decides how many local searches a task needs; its
tasks are grouped by that number. IPOPT (energy form, which is the faster) is started from so
many random points, the best answer taken. *Ratio*: time over that of stiffopt's median over all
tasks in this table."""

STARTS = (1, 2, 4, 8)


def with_segments(sizes: Settings, full: Section) -> Section:
    """Times for 1 to 6 segments; those of the full task are not taken again."""
    out = Section(
        "Growth with segments", SEGMENTS_TEXT, ("solver", "segments", "cold, ms", "warm, ms")
    )
    records = dict(full.data)
    few = Settings(
        **{
            **vars(sizes), "tasks": max(2, sizes.tasks // 5),
            "warm_tasks": max(2, sizes.warm_tasks // 5), "reference_starts": 0,
        }
    )  # fmt: skip
    for segments in sizes.growth:
        found = measure([Stiffopt, Ipopt, IpoptEnergy], segments, few)
        records[str(segments)] = found.record()
    arms = sorted(int(key) for key in records)
    for name in (Stiffopt.name, Ipopt.name, IpoptEnergy.name):
        cold = [records[str(n)][name]["cold_s"] for n in arms]
        warm = [records[str(n)][name]["warm_s"] for n in arms]
        out.rows += [
            (name, str(n), milliseconds(c), milliseconds(w))
            for n, c, w in zip(arms, cold, warm, strict=True)
        ]
        span = np.log(arms[-1] / arms[0])
        exponents = [f"{np.log(t[-1] / t[0]) / span:.2f}" for t in (cold, warm)]
        out.rows.append((name, "exponent", *exponents))
        out.data[name] = {"segments": arms, "cold_s": cold, "warm_s": warm}
    return out


def with_starts(sizes: Settings) -> Section:
    """Time and quality over the number of local searches."""
    out = Section(
        "Growth with starts",
        STARTS_TEXT,
        ("solver", "starts", "time, ms", "ratio", "within 0.5 % of the best", "tasks"),
    )
    segments, count = 2, sizes.tasks
    robot = tasks.arm(segments)
    cases = [tasks.task_of("position", segments, sizes.seed, i)[1] for i in range(count)]
    ipopt = IpoptEnergy.of(segments)
    rng = np.random.default_rng([sizes.seed, segments, 2])
    solve_pressure(robot, cases[0])
    ipopt.cold(cases[0])
    own_time, own_value, own_starts = np.zeros(count), np.zeros(count), np.zeros(count, dtype=int)
    time, value = np.zeros((count, STARTS[-1])), np.zeros((count, STARTS[-1]))
    for item, task in enumerate(cases):
        taken = []
        for _ in range(sizes.repetitions):
            begin = perf_counter()
            solution = solve_pressure(robot, task)
            taken.append(perf_counter() - begin)
        own_time[item] = np.median(taken)
        own_value[item] = stiffness_of(task, solution.pressures, segments)
        counts = getattr(solution, "counts", None) or {}
        sure = solution.confidence
        own_starts[item] = counts.get("descents", sure.starts if sure else 0)
        for start in range(STARTS[-1]):
            x = 2 * ipopt.middle * rng.random(ipopt.n)
            begin = perf_counter()
            p = ipopt.from_start(task, x)
            time[item, start] = perf_counter() - begin
            value[item, start] = stiffness_of(task, p, segments)
    best = np.maximum(value.max(axis=1), own_value) * (1 - bars.NEAR_BEST)
    base = float(np.median(own_time))
    own_data = []
    for starts in np.unique(own_starts):
        group = own_starts == starts
        seconds = float(np.median(own_time[group]))
        share = float(np.mean(own_value[group] >= best[group]))
        own_data.append({"starts": int(starts), "seconds": seconds, "best": share})
        out.rows.append(_row(Stiffopt.name, int(starts), seconds, base, share, int(group.sum())))
    ipopt_data = []
    for starts in STARTS:
        seconds = float(np.median(time[:, :starts].sum(axis=1)))
        share = float(np.mean(value[:, :starts].max(axis=1) >= best))
        ipopt_data.append({"starts": starts, "seconds": seconds, "best": share})
        out.rows.append(_row(ipopt.name, starts, seconds, base, share, count))
    out.data = {Stiffopt.name: own_data, ipopt.name: ipopt_data}
    return out


def _row(
    name: str, starts: int, seconds: float, base: float, share: float, count: int
) -> tuple[str, ...]:
    relative = times(seconds / base)
    return name, str(starts), milliseconds(seconds), relative, percent(share), str(count)
