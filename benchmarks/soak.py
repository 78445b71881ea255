"""Run the control loop for a day on the simulated arm, with random targets and faults.

    python benchmarks/soak.py --hours 24 --out soak.jsonl
    python benchmarks/soak.py --report soak.jsonl

The real controller, loop and safety gate steer two hanging segments without inertia on a simulated
clock. Every ten seconds there is a new target, and about once a minute a temporary fault of a
device; then the loop is reset and armed again. One line is written for every ten simulated minutes:
errors, faults, their consequences, and the memory of the process. A stopped run resumes where its
file ends, with a new arm. The exit code is 1 if any of these occurred:

* a channel commanded above its limit, a state `fault` under pressure, or an arm that is let down
  without a fault;
* a fault of a device that should be detected and was not, or the other way round;
* an error of the tip, at rest and without a fault, that grew from the first to the last quarter;
* memory that grew likewise.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from control_baselines import PERIOD, stiffopt_controller
from control_runs import control_loop
from stiffopt import InputError, StiffnessGoal, StiffnessMeasure, Target, Task, load_robot
from stiffopt.control.state import State
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description

RIG = Path(__file__).parent.parent / "rig" / "sim-two-segment.yaml"
BLOCK = 600.0  # s
TARGET = 10.0  # s
SETTLED = 7.0  # s after which a target should have been reached
FAULT_EVERY, FAULT_LASTS = 60.0, 2.0  # s
LATCHED = {("supply", "high"), ("supply", "off"), ("supply", "garbage")}
"""Faults that the loop must take for one; the others it must ride out, or let the arm down."""
TOLD = {("supply", "leak")}
"""A leak of a sixth of the pressure: a fault, or an alarm, unless it takes next to nothing."""
NOTICED = 0.6  # of `max_pressure_error`; half of it is what the loop looks at
RIDDEN = {("tracker", "flip"), ("tracker", "missing"), ("tracker", "stuck"), ("tracker", "off")}
COARSE = {"bending_degree": 2, "shear_degree": 1, "sub_intervals": 3, "step": 0.01}


class Soak:
    """One arm and its loop."""

    def __init__(self, seed: int, fault_every: float = FAULT_EVERY) -> None:
        self.fault_every = fault_every
        told = load_rig_description(RIG).model_dump(exclude_unset=True)
        told["plant"].update(dynamics="quasi-static", faults=True, seed=seed, discretisation=COARSE)
        # what the tracker's registration is off by nobody could know
        told["plant"]["spread"].update(registration_position=0.0, registration_angle=0.0)
        description = RigDescription(**told)
        robot = load_robot(description.robot)
        self.rng = np.random.default_rng([seed, 6])
        self.rig: Any = make_rig(description, robot.description)
        self.period = PERIOD
        self.loop = control_loop(
            self.rig, stiffopt_controller(self.rig, robot.description, "quasi-static")
        )
        self.noticed = NOTICED * float(np.max(description.safety.max_pressure_error))
        self.robot, self.high = robot, self.rig.supply.limits.high
        goal = StiffnessGoal(maximise=StiffnessMeasure(direction=(0.0, 0.0, 1.0)))
        self.task = Task(
            robot=description.robot, target=Target(position=(0.0, 0.0, 0.2)), stiffness=goal
        )
        self.loop.configure()

    def target(self) -> Any:
        """A place that the model reaches, well within the limits."""
        p = self.rng.uniform(0.15, 0.7, len(self.high)) * self.high
        return Target(position=tuple(self.robot.tip_pose(p)[:3, 3].tolist()))

    def tick(self) -> Any:
        """Let a period pass; return the snapshot."""
        self.rig.clock.sleep(self.period)
        self.loop.tick()
        return self.loop.snapshot()

    def ready(self) -> None:
        """Reset and arm, as somebody would who has mended what was wrong."""
        for _ in range(3000):
            state = self.tick().state
            try:
                if state is State.FAULT:
                    self.loop.reset()
                elif state is State.INACTIVE and self.rig.clock.now() * 5 % 1 < 5 * self.period:
                    self.loop.arm()
                elif state in (State.ACTIVE, State.HOLDING):
                    self.loop.set_task(self.task)
                    return
            except InputError:
                continue
        raise RuntimeError(f"the loop could not be armed again: {self.loop.snapshot().reason}")

    def block(self, duration: float) -> dict[str, Any]:
        """Run for a time in s; return what was found."""
        rng, clock = self.rng, self.rig.clock
        self.ready()
        end, next_target = clock.now() + duration, clock.now()
        next_fault = clock.now() + rng.uniform(0.5, 1.5) * self.fault_every
        faults: dict[str, dict[str, int]] = {}
        errors: list[float] = []
        wrong: list[str] = []
        fault: tuple[str, str] | None = None
        since, fault_ends, disturbed, goal = clock.now(), 0.0, False, np.zeros(3)
        latched = alarmed = False
        leaking: int | None = None
        lost: list[float] = []
        while clock.now() < end or fault is not None:
            now = clock.now()
            if now >= next_target and fault is None:
                target = self.target()
                self.loop.set_target(target)
                goal, since, disturbed = np.array(target.position), now, False
                next_target = now + TARGET
            if now >= next_fault and fault is None:
                pairs = sorted(LATCHED | RIDDEN | TOLD)
                fault = pairs[int(rng.integers(len(pairs)))]
                channel = None
                if fault[0] == "supply" and fault[1] != "off":
                    channel = int(np.argmax(self.rig.world.pressures))
                self.rig.world.inject(*fault, channel)
                leaking, lost = (channel if fault in TOLD else None), []
                fault_ends, disturbed = now + FAULT_LASTS, True
                latched = alarmed = False
            snapshot = self.tick()
            if leaking is not None:
                lost.append(snapshot.commanded[leaking] - self.rig.world.pressures[leaking])
            latched = latched or snapshot.state is State.FAULT
            alarmed = alarmed or bool(snapshot.alarms)
            if (snapshot.commanded > self.high * (1 + 1e-9)).any():
                wrong.append(f"commanded above the limit at {now:.2f} s")
            if snapshot.state in {State.FAULT, State.INACTIVE} and fault is None:
                wrong.append(f"{snapshot.state} without a cause at {now:.2f} s: {snapshot.reason}")
                self.ready()
                disturbed = True
            if fault is not None and now >= fault_ends:
                seen = faults.setdefault("-".join(fault), {"times": 0, "faults": 0})
                seen["times"] += 1
                seen["faults"] += latched
                if fault in TOLD:
                    if not (latched or alarmed) and np.median(lost) > self.noticed:
                        wrong.append(f"{'-'.join(fault)} was not noticed")
                elif latched != (fault in LATCHED):
                    wrong.append(f"{'-'.join(fault)} was {'' if latched else 'not '}a fault")
                if latched and self.rig.world.set_point.any() and fault[1] != "off":
                    wrong.append(f"under pressure in fault after {'-'.join(fault)}")
                self.rig.world.inject(fault[0], "ok")
                fault = leaking = None
                self.ready()
                next_target, next_fault = (
                    clock.now(),
                    now + rng.uniform(0.5, 1.5) * self.fault_every,
                )
            if not disturbed and since + SETTLED < now < since + TARGET:
                tip = self.rig.world.plant.tip_pose()[:3, 3]
                errors.append(1e3 * float(np.linalg.norm(tip - goal)))
        gc.collect()
        return {
            "simulated_s": duration,
            "error_mm": {"mean": float(np.mean(errors)), "worst": float(np.max(errors))},
            "faults": faults,
            "wrong": wrong,
            "memory_mb": memory(),
            "objects": len(gc.get_objects()),
        }


def memory() -> float:
    """Resident memory of this process, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def judged(blocks: list[dict[str, Any]]) -> list[str]:
    """What is wrong with a run."""
    wrong = [f"block {i}: {text}" for i, block in enumerate(blocks) for text in block["wrong"]]
    if len(blocks) >= 8:
        quarter = len(blocks) // 4
        first, last = blocks[1 : 1 + quarter], blocks[-quarter:]
        for name, factor, slack in (("error_mm", 1.2, 0.01), ("memory_mb", 1.05, 10.0)):
            means = []
            for part in (first, last):
                values = [b[name]["mean"] if name == "error_mm" else b[name] for b in part]
                means.append(float(np.mean(values)))
            same = blocks[1].get("process") == blocks[-1].get("process")
            if means[1] > factor * means[0] + slack and (name != "memory_mb" or same):
                wrong.append(f"{name} has grown from {means[0]:.3g} to {means[1]:.3g}")
    return wrong


def report(blocks: list[dict[str, Any]]) -> None:
    """Print a run."""
    hours = sum(block["simulated_s"] for block in blocks) / 3600
    faults: dict[str, list[int]] = {}
    for block in blocks:
        for name, seen in block["faults"].items():
            total = faults.setdefault(name, [0, 0])
            total[0] += seen["times"]
            total[1] += seen["faults"]
    errors = [block["error_mm"]["mean"] for block in blocks]
    print(f"{hours:.2f} simulated hours in {len(blocks)} blocks")
    print(f"error at rest, mm: first {errors[0]:.4f}, last {errors[-1]:.4f}, "
          f"mean {np.mean(errors):.4f}, worst moment "
          f"{max(b['error_mm']['worst'] for b in blocks):.3f}")  # fmt: skip
    print(f"memory, MB: second block {blocks[min(1, len(blocks) - 1)]['memory_mb']:.1f}, "
          f"last {blocks[-1]['memory_mb']:.1f}")  # fmt: skip
    for name, (times, latched) in sorted(faults.items()):
        print(f"  {name:16s} {times:4d} times, a fault {latched:4d} times")


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--block", type=float, default=BLOCK, help="simulated seconds a line")
    parser.add_argument("--fault-every", type=float, default=FAULT_EVERY, help="s between faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="lines of JSON; a run goes on from what is there")
    parser.add_argument("--report", type=Path, help="only say what a file holds")
    options = parser.parse_args()
    path = options.report or options.out
    blocks = []
    if path is not None and path.exists():
        blocks = [json.loads(line) for line in path.read_text().splitlines()]
    if options.report is None:
        soak, wanted = None, round(options.hours * 3600 / options.block)
        while len(blocks) < wanted:
            soak = soak or Soak(options.seed + len(blocks), options.fault_every)
            block = soak.block(options.block) | {"process": os.getpid()}
            blocks.append(block)
            if options.out is not None:
                with options.out.open("a") as file:
                    file.write(json.dumps(block) + "\n")
            for text in block["wrong"]:
                print(text, file=sys.stderr, flush=True)
    report(blocks)
    wrong = judged(blocks)
    for text in wrong:
        print(f"WRONG: {text}")
    return 1 if wrong else 0


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    sys.exit(main())
