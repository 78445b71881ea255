"""Time a tick of the control loop, and its quadratic program with DAQP and with OSQP.

    python benchmarks/tick.py --repeats 5

Runs two hanging segments on the simulator with a simulated clock, so that a tick does not include
the cost of the simulation. Plans are made in parallel, as in the daemon. The quadratic programs for
which the solver is asked are recorded, and solved again by both solvers in turn. On a shared
machine other programs slow a tick down by up to two times: with repeats, the least of all runs
counts for each tick.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from stiffopt import StiffnessGoal, StiffnessMeasure, Target, Task, load_robot
from stiffopt.control.allocation import SOLVERS
from stiffopt.control.controller import TipController
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import PressureCommand
from stiffopt.safety.gate import SafetyGate

RIG = Path(__file__).parent.parent / "rig" / "sim-two-segment.yaml"
TARGETS = ((0.01, 0.01, 0.195), (-0.015, 0.005, 0.2), (0.0, -0.02, 0.19), (0.01, 0.0, 0.205))
MOVES = 1.0  # s after a new target in which the arm is on its way


class Recorder:
    """Stands before a solver and keeps the problems."""

    def __init__(self, solver: Any) -> None:
        self.solver = solver
        self.problems: list[tuple[np.ndarray, ...]] = []

    def solve(self, *problem: np.ndarray) -> np.ndarray | None:
        """Keep the problem and pass it on."""
        self.problems.append(tuple(np.array(part) for part in problem))
        return self.solver.solve(*problem)


def wait_for_plan(controller: Any) -> None:
    """Until the planner, which compiles first, has an answer; a minute at most."""
    end = time.monotonic() + 60.0
    while controller.replanner.latest() is None:
        if time.monotonic() > end:
            raise RuntimeError("the planner has no answer")
        time.sleep(0.05)


def run(seconds: float, solver: str) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, ...]]]:
    """Times of ticks (k, 4) in us, flags (k,) of those on the way, and the quadratic programs."""
    description = load_rig_description(RIG)
    robot = load_robot(description.robot)
    rig = make_rig(description, robot.description)
    period = 1 / description.rate
    control = description.control.model_copy(update={"solver": solver})
    controller = TipController(
        robot, rig.supply.limits, rig.slew, period=period, control=control,
        safety=description.safety, plan_in_process=True,
    )  # fmt: skip
    gate = SafetyGate(
        rig.supply, slew=rig.slew, safety=description.safety,
        force_per_pressure=None, clock=rig.clock,
    )  # fmt: skip
    recorder = Recorder(controller._feedback._allocation._solver)
    controller._feedback._allocation._solver = recorder
    controller.check()
    gate.open()
    rig.tracker.open()
    gate.arm()
    controller.begin(rig.clock.now())
    goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(0.0, 0.0, 1.0)))
    task = Task(robot=description.robot, target=Target(position=TARGETS[0]), stiffness=goal)
    commanded, parts = np.zeros(robot.n_pressures), []
    reading = gate.read()
    per_target = seconds / len(TARGETS)
    for target in TARGETS:
        position = Target(position=target)
        if target == TARGETS[0]:
            controller.set_task(task)
            controller.compute(0.0)
            wait_for_plan(controller)
        else:
            controller.set_target(position)
        for _ in range(round(per_target / period)):
            now = rig.clock.now()
            a = time.thread_time()
            samples = rig.tracker.read()
            b = time.thread_time()
            controller.observe(now, commanded, reading, samples)
            c = time.thread_time()
            output = controller.compute(now)
            d = time.thread_time()
            applied = gate.apply(PressureCommand(output.pressures, now))
            e = time.thread_time()
            commanded, reading = applied.pressures, applied.reading
            parts.append((b - a + e - d, c - b, d - c, e - a))
            rig.clock.sleep_until(now + period)
    rig.close()
    controller.close()
    times = 1e6 * np.array(parts)
    moves = np.arange(len(times)) % round(per_target / period) < round(MOVES / period)
    return times, moves, recorder.problems


def summary(times: np.ndarray, moves: np.ndarray) -> dict[str, float]:
    """Quantiles of the times (k, 4) of ticks, in us."""
    names = ("input and output", "estimator and model", "plan, QP", "tick")
    result = {}
    for name, column in zip(names, times[50:].T, strict=True):
        result[f"{name}: median"] = float(np.median(column))
        result[f"{name}: p99"] = float(np.quantile(column, 0.99))
    result[f"tick in the first {MOVES:g} s of a step: median"] = float(np.median(times[moves, -1]))
    return result


def compare(problems: list[tuple[np.ndarray, ...]]) -> dict[str, float]:
    """Times in us of the solvers on the same problems, in turns, and how far apart they end."""
    n, m = problems[0][0].shape[0], problems[0][2].shape[0]
    solvers = {name: kind(n, m) for name, kind in SOLVERS.items()}
    times: dict[str, list[float]] = {name: [] for name in solvers}
    apart, lost = [], dict.fromkeys(solvers, 0)
    for problem in problems:
        answers = {}
        for name, solver in solvers.items():
            begin = time.thread_time()
            answers[name] = solver.solve(*problem)
            times[name].append(1e6 * (time.thread_time() - begin))
            lost[name] += answers[name] is None
        if all(answer is not None for answer in answers.values()):
            first, *others = answers.values()
            apart.append(max(float(np.abs(first - other).max()) for other in others))
    result = {}
    for name, values in times.items():
        result[f"{name}: median"] = float(np.median(values))
        result[f"{name}: p99"] = float(np.quantile(values, 0.99))
        result[f"{name}: without an answer"] = lost[name]
    result["apart, mbar, median"] = 1e3 * float(np.median(apart))
    result["apart, mbar, largest"] = 1e3 * float(np.max(apart))
    return result


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated")
    parser.add_argument("--solver", choices=("daqp", "osqp"), default="daqp")
    parser.add_argument("--repeats", type=int, default=1, help="runs; the least time counts")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    times, moves, problems = run(options.seconds, options.solver)
    for _ in range(options.repeats - 1):
        times = np.minimum(times, run(options.seconds, options.solver)[0])
    asked = {"ticks that ask the solver, %": 100 * len(problems) / len(times)}
    found = {"tick, us": summary(times, moves), "quadratic program, us": asked | compare(problems)}
    for title, values in found.items():
        print(title)
        for name, value in values.items():
            print(f"  {name:42s} {value:10.3g}")
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    main()
