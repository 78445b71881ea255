"""Measure the closed loop with and without adaptation of the model, on simulated arms.

    python benchmarks/adaptation.py --arms 3 --seed 100 --out out/bench/adaptation.json

Each arm differs from its robot file at random (`control_cases.py`), and further by case: moduli far
beyond the tolerances, a noisy tracker, an unknown payload or side load, a single posture. The same
controller goes to the same targets with and without adaptation. Metrics: steady error (mean of the
last 2 s of each hold); time to settle within 1 mm for good; overshoot beyond the target; remaining
offset from the model; and reported stiffness over that of the arm (pushed and pulled, without creep
and hysteresis), with the share of reported intervals that contain it.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control_baselines import PERIOD
from control_cases import RIG, _mismatch, settling_time, without_memory
from report import table
from stiffopt import StiffnessGoal, StiffnessMeasure, Target, Task, load_robot
from stiffopt.control.controller import TipController
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Mismatch, PlantLoad, PlantSettings
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import limits_of, load_rig_description, slew_of
from stiffopt.rig.settings import ControlSettings

Array = NDArray[np.float64]

HOLD, LAST, STAYS, TARGETS = 8.0, 2.0, 0.2, 5
DIRECTION = (1.0, 0.0, 0.0)
PUSH = 2e-3  # N
ALONG = np.array(DIRECTION)


@dataclass(frozen=True)
class Variant:
    """How an arm differs beside its random mismatch."""

    modulus: float = 1.0
    noise: float = 5e-5
    payload: float = 0.0
    load: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float = 0.75  # of the pressures that targets are drawn from


CASES = {
    "as drawn": Variant(),
    "modulus 0.6 of the file's": Variant(modulus=0.6, reach=0.45),
    "modulus 1.6 of the file's": Variant(modulus=1.6),
    "tracker noise 0.2 mm": Variant(noise=2e-4),
    "payload 15 g": Variant(payload=0.015),
    "side load 30 mN": Variant(load=(0.03, 0.0, 0.0)),
    "small motions": Variant(reach=0.15),
}


def run(variant: Variant, seed: int, dynamics: str, adaptation: str) -> list[dict[str, Any]]:
    """What an arm shows at each target."""
    rng = np.random.default_rng([seed, 20])
    description = load_rig_description(RIG)
    robot = load_description(description.robot)
    drawn: Mismatch = _mismatch(robot, rng)
    mismatch = drawn.model_copy(
        update={"modulus": tuple(variant.modulus * m for m in drawn.modulus)}
    )
    load = PlantLoad(force=variant.load) if any(variant.load) else None
    plant = PlantSettings(
        mismatch=mismatch, seed=seed, payload=variant.payload, dynamics=dynamics, load=load
    )
    tracker = description.tracker.model_copy(update={"noise": variant.noise})
    description = description.model_copy(update={"plant": plant, "tracker": tracker})
    rig: Any = make_rig(description, robot)
    still = Plant(robot, without_memory(plant))
    controller = TipController(
        load_robot(robot), limits_of(description, robot), slew_of(description, robot),
        period=PERIOD, control=ControlSettings(adaptation=adaptation, tracker_noise=variant.noise),
        safety=description.safety, vibrates=dynamics == "full", slow_first_motion=False,
    )  # fmt: skip
    controller.check()
    found = []
    with rig:
        rig.supply.arm()
        controller.begin(rig.clock.now())
        command, before = np.zeros(robot.n_pressures), rig.world.plant.tip_pose()[:3, 3].copy()
        for number in range(TARGETS):
            still.settle(
                rng.uniform(0, variant.reach, robot.n_pressures) * np.array(robot.pressure_max)
            )
            goal = still.tip_pose()[:3, 3].copy()
            measure = StiffnessMeasure(direction=DIRECTION)
            controller.set_task(
                Task(
                    robot=robot.name,
                    target=Target(position=tuple(goal.tolist())),
                    stiffness=StiffnessGoal(maximise=measure),
                )
            )
            tips, times = [], PERIOD * (1 + np.arange(round(HOLD / PERIOD)))
            for _ in times:
                now = rig.clock.now()
                controller.observe(now, command, rig.supply.read(), rig.tracker.read())
                command = controller.compute(now).pressures
                rig.supply.command(command)
                rig.clock.sleep_until(now + PERIOD)
                tips.append(rig.world.plant.tip_pose()[:3, 3].copy())
            found.append(judged(controller, rig, still, (before, goal), np.array(tips), times))
            found[-1] |= {"seed": seed, "number": number}
            before = goal
    controller.close()
    return found


def judged(
    controller: TipController,
    rig: Any,
    still: Plant,
    way: tuple[Array, Array],
    tips: Array,
    times: Array,
) -> dict[str, Any]:
    """Figures of one hold."""
    status = controller.status(rig.clock.now())
    error = np.linalg.norm(tips - way[1], axis=1)
    along = (tips - way[1]) @ (way[1] - way[0]) / np.linalg.norm(way[1] - way[0])
    load = still.settings.load
    base = np.array(load.force) if load is not None else np.zeros(3)
    ends = []
    for sign in (1.0, -1.0):
        force = tuple((base + sign * PUSH * ALONG).tolist())
        still.settle(rig.world.pressures, PlantLoad(force=force))
        ends.append(float(still.tip_pose()[:3, 3] @ ALONG))
    still.set_load(load)
    true = 2 * PUSH / (ends[0] - ends[1])
    return {
        "steady": float(error[times > HOLD - LAST].mean()),
        "settling": settling_time(times, error, STAYS),
        "overshoot": float(max(along.max(), 0.0)),
        "offset": float(np.linalg.norm(status.disturbance)),
        "ratio": status.stiffness / true,
        "covered": bool(status.stiffness_low < true < status.stiffness_high),
    }


def row(name: str, found: list[dict[str, Any]]) -> tuple[str, ...]:
    """A line of the table; the stiffness is that of the targets after the first."""
    of = {key: np.array([each[key] for each in found], float) for key in found[0]}
    later = of["number"] > 0
    ratio = of["ratio"][later]
    return (
        name,
        f"{1e3 * np.median(of['steady']):.3f} / {1e3 * of['steady'].max():.3f}",
        f"{np.median(of['settling']):.2f} / {of['settling'].max():.2f}",
        f"{1e3 * np.median(of['overshoot']):.2f} / {1e3 * of['overshoot'].max():.2f}",
        f"{1e3 * np.median(of['offset'][later]):.1f}",
        f"{ratio.min():.2f} .. {ratio.max():.2f}",
        f"{100 * np.mean(np.abs(ratio - 1) < 0.1):.0f} %",
        f"{100 * of['covered'][later].mean():.0f} %",
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arms", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1, help="of the first arm")
    parser.add_argument("--case", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--dynamics", choices=("quasi-static", "full"), default="quasi-static")
    parser.add_argument("--out", type=Path, help="JSON file for all that was measured")
    given = parser.parse_args()
    rows, everything = [], {}
    for case in given.case:
        for adaptation in ("none", "auto"):
            found = []
            for seed in range(given.seed, given.seed + given.arms):
                found += run(CASES[case], seed, given.dynamics, adaptation)
            name = f"{case}, {'adapted' if adaptation == 'auto' else 'without'}"
            rows.append(row(name, found))
            everything[name] = found
            print(rows[-1], file=sys.stderr)
    head = (
        "arm", "steady, mm, median / most", "settling, s", "overshoot, mm", "offset, mm, median",
        "stiffness reported / true", "within 10 %", "in its interval",
    )  # fmt: skip
    print("\n".join(table(head, rows)))
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(everything, default=float))
    return 0


if __name__ == "__main__":
    sys.exit(main())
