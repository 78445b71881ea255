"""Hold braced poses in the loop, on the simulated rig, and push until a contact is lost.

    python benchmarks/brace_hold.py --arms 1 2 --keep out/calibrated --out out/brace_hold.json

Arms, calibrated files and tasks are those of `brace_rig.py`, with other seeds for the tasks. The
controller gets the calibrated file; it goes into contact, holds for 20 s, and a push at the tip
then grows until the plant loses contact. The push is along the direction in which it should lift
off first, and grows to twice the foretold push in a second, or as `--grows` says. The arm then lets
go by itself. Every second arm that leans lets go without a push, by a task at rest.

Metrics: the estimated contact force (`brace_force`) over that of the plant after the hold; what
the contacts were pressed with at most; how late a lost contact is reported, and how late or early
the warning that it may be lost (`brace-weak`); whether anything was reported without a loss; and
whether the arm ends at rest, clear of the object.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import stiffopt
from brace_rig import WORTH, Arm, draw_task
from control_cases import calibrated_file, draw_case
from report import table
from stiffopt.control import planning
from stiffopt.control.controller import TipController
from stiffopt.optimise.solver import PressureSolver
from stiffopt.plant.settings import PlantLoad
from stiffopt.registration import Registration
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import limits_of, slew_of

HOLD, APPROACH, RELEASE = 20.0, 60.0, 60.0  # s
CREEPS = 3.0  # s at rest, in which silicone that was bent goes back
FADES = 1.0  # s, of the push, when the loss is reported
LONGEST = 3.0  # times the foretold loss, at most


class Loop:
    """The controller of a calibrated file, and the rig that it knows."""

    def __init__(self, case: Any, believed: Any, task: stiffopt.Task, solution: Any) -> None:
        plant = Arm(case, believed, task.scene).plant.settings
        description = case.description.model_copy(update={"plant": plant, "scene": task.scene})
        self.rig: Any = make_rig(description, case.robot)
        tip = believed.recordings.registration.tip_in_sensor
        self.rig.tracker.registration = self.rig.tracker.registration.then(
            Registration(tip_in_sensor=tip)
        )
        robot = stiffopt.Manipulator(believed)

        def solver(robot: Any, asked: stiffopt.Task) -> Any:
            known = SimpleNamespace(solve=lambda: solution)  # what was found before
            return known if asked.brace is not None else PressureSolver(robot, asked)

        planning.PressureSolver = solver  # type: ignore[misc, assignment]
        self.period = 1 / description.rate
        self.controller = TipController(
            robot, limits_of(description, believed), slew_of(description, believed),
            period=self.period, control=description.control, safety=description.safety,
            scene=task.scene,
        )  # fmt: skip
        self.controller.check()
        self.command, self.told, self.most = np.zeros(6), [], 0.0
        self.rig.open()
        self.rig.supply.arm()
        self.controller.begin(self.rig.clock.now())

    @property
    def force(self) -> float:
        """Of the plant's contacts, in N."""
        forces = self.rig.world.plant.object_forces()
        return sum(float(np.linalg.norm(each.force)) for each in forces)

    def go(self, seconds: float, until: Any = None, push: Any = None) -> float:
        """Go on for so long, or until something is so; the time that passed, in s."""
        controller, clock = self.controller, self.rig.clock
        begin = now = clock.now()
        while now < begin + seconds:
            if push is not None:
                load = PlantLoad(force=tuple(push(now - begin)))
                self.rig.world.plant.set_load(load)
            controller.observe(now, self.command, self.rig.supply.read(), self.rig.tracker.read())
            self.command = controller.compute(now).pressures
            self.rig.supply.command(self.command)
            self.told += [
                (now, each.kind, each.text) for each in controller.notices() if not each.standing
            ]
            clock.sleep_until(now + self.period)
            now = clock.now()
            self.most = max(self.most, self.force)
            self.status = controller.status(now)
            if until is not None and until():
                break
        return float(now - begin)

    def told_since(self, begin: float, kind: str) -> float | None:
        """When something was first reported after a time, in s after it."""
        return next((at - begin for at, own, _ in self.told if own == kind and at >= begin), None)


def held(
    case: Any, believed: Any, seed: list[int], *, pushed: bool, grows: float
) -> dict[str, Any] | None:
    """What one task gives; None if its answer does not lean, or for little."""
    robot = stiffopt.Manipulator(believed)
    task = draw_task(robot, seed)
    found = stiffopt.solve_pressure(robot, task)
    if not found.contacts or found.stiffness < WORTH * (found.stiffness_free or np.inf):
        return None
    loop = Loop(case, believed, task, found)
    loop.go(1.0)
    row: dict[str, Any] = {"seed": seed, "promised": float(np.linalg.norm(found.contacts[0].force))}
    try:
        loop.controller.set_task(task)
    except stiffopt.StiffoptError as reason:
        return row | {"refused": str(reason)}
    row["approach"] = loop.go(APPROACH, lambda: loop.status.brace == "held")
    if loop.status.brace != "held":
        return row | {"refused": loop.status.brace, "told": [each[1:] for each in loop.told]}
    on_way, loop.most = loop.most, 0.0
    loop.go(HOLD)
    row |= {
        "estimated": loop.status.brace_force, "force": loop.force,
        "error": loop.status.position_error, "false": loop.told_since(0.0, "brace-lost"),
        "most": loop.most, "most_on_way": on_way, "max": found.contacts[0].max_force,
    }  # fmt: skip
    plant = loop.rig.world.plant
    lifting = [each for each in found.preloads if each.contacts == "sliding"]
    weakest = min(lifting, key=lambda each: each.loss.force)
    if pushed and loop.status.brace == "held" and np.isfinite(weakest.loss.force):
        rate = grows * weakest.loss.force
        begin, longest = loop.rig.clock.now(), LONGEST * weakest.loss.force / rate
        lost_after = loop.go(
            longest, lambda: loop.force == 0.0 or loop.status.brace == "releasing",
            lambda after: rate * after * weakest.direction,
        )  # fmt: skip
        lost = loop.rig.clock.now()
        was_lost, push = loop.force == 0.0, rate * lost_after
        if loop.status.brace != "releasing":
            loop.go(
                5.0, lambda: loop.status.brace == "releasing",
                lambda after: (push + rate * after) * weakest.direction,
            )  # fmt: skip
        late = loop.rig.clock.now() - lost if was_lost else 0.0
        row |= {
            "foretold": weakest.loss.force, "push": push, "contact_lost": was_lost, "late": late,
            "slips": loop.told_since(begin, "brace-slips"),
            "warned": _after(loop.told_since(begin, "brace-weak"), lost - begin),
            "reported": loop.status.brace == "releasing",
            "told": [each[1:] for each in loop.told][-3:],
        }  # fmt: skip
        most = rate * (loop.rig.clock.now() - begin) * weakest.direction
        loop.go(FADES, push=lambda after: max(0.0, 1 - after / FADES) * most)
        plant.set_load(None)
    if loop.status.brace == "held":
        rest = stiffopt.Target(position=tuple(robot.tip_pose(np.zeros(6))[:3, 3]))
        loop.controller.set_task(stiffopt.Task(robot=task.robot, target=rest))
    before = loop.most = loop.force
    row["release"] = loop.go(RELEASE, lambda: loop.status.brace not in ("held", "releasing"))
    loop.go(CREEPS)
    row |= {"ends": loop.status.brace, "left": loop.force, "most_in_release": loop.most - before}
    loop.controller.close()
    return row


def _after(told: float | None, lost: float) -> float | None:
    """How long after a loss something was reported, in s; negative if before."""
    return None if told is None else told - lost


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--keep", type=Path, default=Path("out/calibrated"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--grows", type=float, default=2.0, help="share of the loss per second")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arm in given.arms:
        case = draw_case(arm, ranked=False)
        believed = calibrated_file(case, given.keep)
        count = number = 0
        while count < given.tasks and number < 8 * given.tasks:
            began, number = time.process_time(), number + 1
            row = held(case, believed, [arm, number, 25], pushed=count % 2 == 0, grows=given.grows)
            if row is None:
                continue
            count += 1
            rows.append(row | {"arm": arm})
            print(json.dumps(rows[-1]), f"{time.process_time() - began:.0f} s", flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    good = [row for row in rows if "force" in row]
    head = ["arm", "force promised, estimated, met, mN", "push foretold, lost at, mN", "late, s"]
    lines = [
        [
            f"{row['arm']}",
            ", ".join(f"{1e3 * row[key]:.0f}" for key in ("promised", "estimated", "force")),
            f"{1e3 * row['foretold']:.0f}, {1e3 * row['push']:.0f}" if "push" in row else "",
            f"{row['late']:.2f}" if "push" in row else "",
        ]
        for row in good
    ]
    print("\n".join(table(head, lines)))
    pushed = [row for row in good if row.get("contact_lost")]
    print(
        f"reported within 0.3 s: {sum(row['late'] < 0.3 + 1e-6 for row in pushed)} of {len(pushed)}"
    )
    warned = sum(row["warned"] is not None and row["warned"] <= 0.3 for row in pushed)
    print(f"reported or warned of by 0.3 s after: {warned} of {len(pushed)}")
    print(f"reported without a loss: {sum(row['false'] is not None for row in good)}")
    print(f"let go, clear: {sum(row['left'] == 0 for row in good)} of {len(good)}")


if __name__ == "__main__":
    main()
