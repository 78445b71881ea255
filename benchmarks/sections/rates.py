"""Measure rates: of many tasks at once, and of the simulated arm relative to real time."""

from time import perf_counter

import numpy as np

import settings as bars
import stiffopt
import tasks
from report import Section, at_least, times
from settings import Settings
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription

BATCH_TEXT = """\
`solve_batch` on random two-segment tasks, cold, all cores, against `solve_pressure` in a loop
on the first of them; the answers must be equal bit by bit. Rates are tasks per second; both in
turn, median of three."""


def batch(sizes: Settings) -> Section:
    """The table of throughput."""
    out = Section("Many tasks", BATCH_TEXT, ("how", "tasks", "per second", "ratio"))
    robot = tasks.arm(2)
    count, few = sizes.batch_tasks, max(5, sizes.batch_tasks // 20)
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
        begin = perf_counter()
        many = stiffopt.solve_batch(robot, cases)
        batches.append((perf_counter() - begin) / count)
        pairs = zip(single, many, strict=False)
        same = same and all(np.array_equal(a.pressures, b.pressures) for a, b in pairs)
    loop, seconds = float(np.median(loops)), float(np.median(batches))
    out.rows = [
        ("solve_pressure in a loop", str(few), f"{1 / loop:.3g}", "1x"),
        ("solve_batch", str(count), f"{1 / seconds:.4g}", times(loop / seconds)),
    ]
    out.verdicts += [
        at_least("solve_batch, 2 segments", bars.BATCH_SOLVES, 1 / seconds, "tasks/s"),
        at_least("solve_batch, identical to one by one", 100, 100.0 * same, "%"),
    ]
    out.data = {"loop_per_s": 1 / loop, "batch_per_s": 1 / seconds, "identical": same}
    return out


ARM_TEXT = """\
Seconds simulated per second on one core: the simulated rig (regulators at 1 kHz, tracker at 40 Hz,
default silicone with creep and hysteresis) under commands at 100 Hz that follow slow sines, read
after every command. Median of repetitions; compiled before. Full: with inertia, a step of 1 ms."""


def simulated_arm(sizes: Settings) -> Section:
    """The table of the simulator."""
    out = Section("Simulated arm", ARM_TEXT, ("arm", "dynamics", "step", "times real time"))
    for name in ("stiff-flop-1", "stiff-flop-2-hanging", "stiff-flop-3"):
        for dynamics, step in (("full", 0.001), ("quasi-static", 0.001), ("quasi-static", 0.01)):
            speed = _speed(name, dynamics, step, sizes)
            out.rows.append((name, dynamics, f"{step * 1e3:g} ms", f"{speed:.3g}"))
            out.data[f"{name} {dynamics} {step}"] = speed
            if name == "stiff-flop-2-hanging" and dynamics == "full":
                bar = at_least(f"{name}, full dynamics", bars.TIMES_REAL_TIME, speed, "times")
                out.verdicts.append(bar)
    return out


def _speed(name: str, dynamics: str, step: float, sizes: Settings) -> float:
    description = RigDescription(
        robot=name,
        supply={"driver": "simulated"},
        tracker={"driver": "simulated"},
        plant={"dynamics": dynamics, "seed": sizes.seed, "discretisation": {"step": step}},
    )
    duration = 2.0 if sizes.quick else 10.0
    speeds = []
    with make_rig(description, load_description(name)) as rig:
        rig.supply.arm()
        phases = np.linspace(0, 2, rig.supply.n)
        for _ in range(min(5, sizes.repetitions)):
            begin = perf_counter()
            for tick in range(round(duration * 100)):
                rig.command(4e4 * (1 + np.sin(0.01 * tick * 2 + phases)))
                rig.clock.sleep(0.01)
                rig.observe()
            speeds.append(duration / (perf_counter() - begin))
    return float(np.median(speeds))
