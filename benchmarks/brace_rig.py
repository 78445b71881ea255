"""Compare the predicted stiffness of braced arms with that measured on the simulated rig.

    python benchmarks/brace_rig.py --arms 1 2 3 --keep out/calibrated --out out/brace_rig.json

Arms of two hanging segments differ from their robot file at random (`control_cases.py`), each with
a robot file that `stiffopt calibrate` made of a recording of it (some minutes of simulated time,
kept in a folder). For each, tasks are drawn like those of `brace.py`: a target that bends the arm
by up to 60 degrees, a post, a ball or a wall beside the body, at most 0.3 N of contact force, a
margin of 20 mN and a random direction. `solve_pressure` solves them with the calibrated file; only
solutions that lean, and promise at least 1.5 times the free stiffness, count. The pressures are
then commanded along the approach (`stiffopt.paths.leaning`) in open loop. The plant has inertia,
creep, hysteresis and its own contact with friction.

The stiffness is that of a push and a pull at the tip, each settled without remaining creep,
hysteresis or friction (`Plant.settle`). Their force is half of what the solution says that the
contacts hold, at most 0.1 N. Unless `--settled`, the same pushes are also applied for two seconds
each with all effects of silicone and friction: then contacts stick, small pushes do not overcome
the hysteresis, and the arm is stiffer. The reference is the free solution for the same target, on
the same arm. Metrics: measured over predicted stiffness, and the same for the multiple of the free
stiffness; predictions are those for sliding contacts.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stiffopt
from brace import MARGIN, TOLERANCE, _object
from control_cases import believed_file, draw_case
from report import table
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.paths.configurations import Unsolved
from stiffopt.paths.leaning import approach_to
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import PlantLoad
from stiffopt.registration import Placement

Array = NDArray[np.float64]

WORTH = 1.5  # multiple from which an answer is looked at
PUSH, SHARE, FRICTION = 0.1, 0.5, 0.2  # N, of what the contacts hold
HELD, TURNS, SETTLE = 2.0, 3, 10.0  # s of a push, how often, and s before
ALLOWED = 0.15


def draw_task(robot: stiffopt.Manipulator, seed: list[int]) -> stiffopt.Task:
    """A random task of an arm whose object is clear of it at rest."""
    rng = np.random.default_rng(seed)
    while True:
        p = rng.uniform(0, 1.2e5, 6) * (rng.random(6) < 0.8)
        T = robot.backbone(p, 61)
        if not 10 < np.degrees(np.arccos(T[-1, 2, 2])) < 60:
            continue
        kind = str(rng.choice(["post", "ball", "wall"], p=[0.5, 0.2, 0.3]))
        item = _object(rng, kind, T[round(rng.uniform(0.35, 0.9) * 60)])
        item["contact"]["friction"] = FRICTION
        scene = stiffopt.Scene(objects=[stiffopt.SceneObject(**item)])
        if robot.clearance(np.zeros(6), scene) > 1e-3:
            break
    direction = rng.normal(size=3)
    return stiffopt.Task(
        robot=robot.description.name,
        target=stiffopt.Target(position=tuple(T[-1, :3, 3]), tolerance={"position": TOLERANCE}),
        stiffness={"maximise": {"direction": (direction / np.linalg.norm(direction)).tolist()}},
        scene=scene,
        brace={"objects": ["it"], "margin": MARGIN},
    )


class Arm:
    """A simulated arm that follows pressures, in the base frame of its calibrated file.

    That frame differs from the nominal one by the registration that the calibration found. Task,
    scene and pushes are meant in it, as on a rig whose objects were measured with its tracker.
    """

    def __init__(self, case: Any, believed: Any, scene: stiffopt.Scene | None) -> None:
        settings = case.description.plant
        frame = believed.recordings.registration.tracker_in_base.transform()
        base = Placement.of(frame @ settings.mismatch.base.transform())
        self.plant = Plant(case.robot, settings.model_copy(update={
            "dynamics": "full", "scene": scene,
            "mismatch": settings.mismatch.model_copy(update={"base": base}),
            "gravity": tuple((frame[:3, :3] @ case.robot.gravity).tolist()),
        }))  # fmt: skip

    def go(self, times: Array, pressures: Array) -> None:
        """Follow pressures (k, n) at times (k,) in s, and rest at the last."""
        step = self.plant.step
        at = np.arange(0.0, times[-1] + SETTLE, step)
        self.plant.follow(np.stack([np.interp(at, times, row) for row in pressures.T], axis=1))
        self._held = pressures[-1]

    def settled_stiffness(self, direction: Array, push: float) -> float:
        """Of a settled push and pull of so many N."""
        places = []
        for force in (push * direction, -push * direction):
            self.plant.settle(self._held, PlantLoad(force=tuple(force)))
            places.append(float(direction @ self.plant.tip_pose()[:3, 3]))
        return 2 * push / (places[0] - places[1])

    def stiffness(self, direction: Array, push: float) -> float:
        """Of pushes and pulls of so many N, as they come."""
        places = []
        for turn in range(2 * TURNS):
            force = push * direction * (-1) ** turn
            self.plant.set_load(PlantLoad(force=tuple(force)))
            self.plant.advance(HELD, self._held)
            places.append(float(direction @ self.plant.tip_pose()[:3, 3]))
        self.plant.set_load(None)
        self.plant.advance(HELD, self._held)
        return 2 * push / (places[-2] - places[-1])


def measured(
    case: Any, believed: Any, seed: list[int], *, settled: bool = False
) -> dict[str, Any] | None:
    """What one task gives; None if its answer does not lean, or for little."""
    robot = stiffopt.Manipulator(believed)
    task = draw_task(robot, seed)
    found = stiffopt.solve_pressure(robot, task)
    free = found.free
    if not found.contacts or free is None or not free.found:
        return None
    if found.stiffness < WORTH * free.stiffness:
        return None
    try:
        way = approach_to(robot, found)
    except Unsolved as reason:
        return {"seed": seed, "refused": str(reason)}
    direction = np.array(task.stiffness.maximise[0].direction)
    holds = min(each.loss.force for each in found.preloads)
    push = min(PUSH, SHARE * holds)
    arm, loose = Arm(case, believed, task.scene), Arm(case, believed, None)
    arm.go(way.times, way.pressures)
    on = arm.plant.object_forces()
    loose.go(np.array([0.0, 5.0]), np.stack([np.zeros(6), free.pressures]))
    quick = quick_free = np.nan
    if not settled:
        quick, quick_free = arm.stiffness(direction, push), loose.stiffness(direction, push)
    own = arm.settled_stiffness(direction, push)
    bare = loose.settled_stiffness(direction, push)
    known = BraceUncertainty(robot, found.equilibrium)
    return {
        "seed": seed, "push": push, "promised": found.stiffness, "promised_free": free.stiffness,
        "sticking": sticking(robot, found, direction),
        "quick": quick, "quick_free": quick_free, "measured": own, "measured_free": bare,
        "force": float(np.linalg.norm(found.contacts[0].force)),
        "doubt": float(known.forces.max()),
        "interval": known.stiffness_interval(task.stiffness.maximise[0], task),
        "force_measured": sum(float(np.linalg.norm(each.force)) for each in on),
        "at": found.contacts[0].at, "at_measured": on[0].at if on else None,
        "limited_by": list(found.limited_by),
    }  # fmt: skip


def sticking(robot: Any, found: Any, direction: Array) -> float:
    """The promise for contacts that stick."""
    eq = robot.contact_equilibrium(found.pressures, found.task.scene)
    return float(eq.stiffness(direction, contacts="sticking"))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--keep", type=Path, default=Path("out/calibrated"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--settled", action="store_true", help="no pushes as they come")
    parser.add_argument("--true", action="store_true", help="believe the true values instead")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arm in given.arms:
        case = draw_case(arm, ranked=False)
        believed = believed_file(case, given.keep, true=given.true)
        count = number = 0
        while count < given.tasks and number < 8 * given.tasks:
            began, number = time.perf_counter(), number + 1
            row = measured(case, believed, [arm, number, 24], settled=given.settled)
            if row is None:
                continue
            count += 1
            rows.append(row | {"arm": arm})
            print(json.dumps(rows[-1]), f"{time.perf_counter() - began:.0f} s", flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    good = [row for row in rows if "measured" in row]
    head = ["arm", "promised, N/m", "measured", "ratio", "multiple promised", "measured ", "quick"]
    lines = [
        [
            f"{row['arm']}", f"{row['promised']:.2f}", f"{row['measured']:.2f}",
            f"{row['measured'] / row['promised']:.2f}",
            f"{row['promised'] / row['promised_free']:.2f}",
            f"{row['measured'] / row['measured_free']:.2f}",
            f"{row['quick'] / row['quick_free']:.2f}",
        ]
        for row in good
    ]  # fmt: skip
    print("\n".join(table(head, lines)))
    off = [abs(row["measured"] / row["promised"] - 1) for row in good]
    print(f"within {ALLOWED:.0%}: {sum(each <= ALLOWED for each in off)} of {len(off)}")


if __name__ == "__main__":
    main()
