"""Measure the loop's force estimates on simulated arms: pushes, false alarms, and presses.

    python benchmarks/touch.py --arms 4 --seed 700

Arms differ from their robot files at random (`control_cases.py`). Each goes to targets, rests for
three seconds, and is pushed at the tip with a step of 10 to 50 mN in a random lateral direction for
three seconds. An estimate is right if, one second after the push began, its error from the
observable part of the push is at most 20 % + 3 mN. False alarms are counted while nothing touches
the arm as it goes to targets, rests and follows circles. Presses of 15 to 40 mN, onto flat surfaces
of 100 to 1,000 N/m at 2 to 8 mm distance, are judged by the true force of the last three seconds.
They press away from the vented tip, since an arm that began beyond the surface would begin in it.
With ``--what inside`` the targets of such presses are 0.5 to 4 mm inside surfaces of 100 to 2,000
N/m instead. Then the loop must not press on: it has to go back, or to hold with a reason.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control_baselines import PERIOD
from control_cases import DYNAMICS, RIG, _mismatch, without_memory
from report import table
from stiffopt import Press, Target, Task, load_robot
from stiffopt.control.controller import TipController
from stiffopt.control.pressing import Phase
from stiffopt.control.state import ControllerStatus
from stiffopt.errors import InputError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.press import soft_directions
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    PlantLoad,
    PlantSettings,
    Silicone,
    SiliconeCreep,
    SoftSurface,
)
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import limits_of, load_rig_description, slew_of

Array = NDArray[np.float64]

ROBOTS = ("stiff-flop-1", "stiff-flop-2-hanging")
TARGETS, REST, PUSHED, AFTER = 4, 4.0, 3.0, 2.0  # s
ALLOWED, ALLOWED_FORCE = 0.2, 3e-3  # share, and N
REACH = 0.7  # of the pressures that targets are drawn from
FARTHEST = 8e-3  # m, of surfaces in front of a target
DEEPEST = 4e-3  # m, of targets inside a surface


@dataclass
class Found:
    """What was measured on arms of one kind."""

    errors: list[float] = field(default_factory=list)  # N, a second after a push
    right: list[bool] = field(default_factory=list)
    covered: list[bool] = field(default_factory=list)  # by the 95 % region that is told
    false_alarms: int = 0
    free_time: float = 0.0  # s in which nothing touched
    presses: list[float] = field(default_factory=list)  # N, mean true force at the end
    press_errors: list[float] = field(default_factory=list)  # over what is allowed
    most: list[float] = field(default_factory=list)  # largest true force over the wanted one
    on_way: list[float] = field(default_factory=list)  # the same on the way to the target
    aside: list[float] = field(default_factory=list)  # m, error across the direction at the end
    failed: list[str] = field(default_factory=list)
    # of targets inside an object: how it ended, largest and last true force over the wanted one
    inside: list[tuple[str, float, float]] = field(default_factory=list)


def drawn_creep(seed: int) -> tuple[SiliconeCreep, ...]:
    """Return an arm's creep: one term or two, of up to 8 % in all, within 1 to 40 s."""
    rng = np.random.default_rng([seed, 23])
    shares = rng.uniform(0, 0.08) * rng.dirichlet(np.ones(rng.integers(1, 3)))
    times = np.exp(rng.uniform(0, np.log(40), len(shares)))
    return tuple(
        SiliconeCreep(share=float(share), time=float(time))
        for share, time in zip(shares, times, strict=True)
    )


class Arm:
    """An arm under control, in simulated time."""

    draws_creep = False
    hold = 25.0  # s of a press

    def __init__(
        self, name: str, seed: int, dynamics: str, surface: SoftSurface | None = None
    ) -> None:
        description = load_rig_description(RIG)
        robot = load_description(name)
        rng = np.random.default_rng([seed, 21])
        silicone = Silicone(creep=drawn_creep(seed)) if self.draws_creep else Silicone()
        plant = PlantSettings(
            mismatch=_mismatch(robot, rng), silicone=silicone, seed=seed, dynamics=dynamics,
            surface=surface,
        )  # fmt: skip
        tracker = description.tracker.model_copy(update={"noise": 5e-5})
        update = {"robot": name, "plant": plant, "tracker": tracker}
        description = description.model_copy(update=update)
        self.rng, self.robot = rng, robot
        self.rig: Any = make_rig(description, robot)
        self.still = Plant(robot, without_memory(plant))
        self.controller = TipController(
            load_robot(robot), limits_of(description, robot), slew_of(description, robot),
            period=PERIOD, control=description.control, safety=description.safety,
            vibrates=dynamics == "full", slow_first_motion=False,
        )  # fmt: skip
        self.controller.check()
        self._command = np.zeros(robot.n_pressures)

    def __enter__(self) -> Arm:
        self.rig.__enter__()
        self.rig.supply.arm()
        self.controller.begin(self.rig.clock.now())
        return self

    def __exit__(self, *error: object) -> None:
        self.controller.close()
        self.rig.__exit__(*error)

    def place(self) -> Array:
        """Pose (4, 4) of a place that the arm can reach."""
        high = np.array(self.robot.pressure_max)
        self.still.settle(self.rng.uniform(0, REACH, len(high)) * high)
        return self.still.tip_pose()

    def go(self, seconds: float) -> list[ControllerStatus]:
        """Let time pass."""
        states = []
        for _ in range(round(seconds / PERIOD)):
            now = self.rig.clock.now()
            self.controller.observe(
                now, self._command, self.rig.supply.read(), self.rig.tracker.read()
            )
            self._command = self.controller.compute(now).pressures
            self.rig.supply.command(self._command)
            self.rig.clock.sleep_until(now + PERIOD)
            states.append(self.controller.status(now))
        return states

    def push(self, force: Array | None) -> None:
        """Push the tip, or not any more."""
        load = None if force is None else PlantLoad(force=tuple(force.tolist()))
        self.rig.world.plant.set_load(load)

    def felt_part(self, force: Array) -> Array:
        """The part (3,) of a force that acts where the tip is soft."""
        tip = self.controller._arm.modelled
        R = tip.pose[:3, :3]
        return soft_directions(R @ tip.compliance[:3, :3] @ R.T) @ force


def pushes(name: str, seed: int, dynamics: str, found: Found) -> None:
    """Push an arm at some targets, after it has moved there and rested."""
    with Arm(name, seed, dynamics) as arm:
        for _ in range(TARGETS):
            pose = arm.place()
            arm.controller.set_task(Task(target=Target(position=tuple(pose[:3, 3].tolist()))))
            states = arm.go(REST)
            found.false_alarms += _onsets(states)
            found.free_time += REST
            turn = arm.rng.uniform(0, 2 * np.pi)
            way = pose[:3, 0] * np.cos(turn) + pose[:3, 1] * np.sin(turn)
            force = arm.rng.uniform(0.01, 0.05) * way
            arm.push(force)
            state = arm.go(1.0)[-1]
            true = arm.felt_part(force)
            error = state.wrench[:3] - true
            size = float(np.linalg.norm(error))
            found.errors.append(size)
            found.right.append(size <= ALLOWED * np.linalg.norm(force) + ALLOWED_FORCE)
            covariance = state.wrench_covariance.reshape(3, 3)
            found.covered.append(float(error @ np.linalg.solve(covariance, error)) < 7.81)
            arm.go(PUSHED - 1.0)
            arm.push(None)
            arm.go(AFTER)


def free(name: str, seed: int, dynamics: str, found: Found) -> None:
    """Let an arm move, and count what it feels although nothing touches it."""
    with Arm(name, seed, dynamics) as arm:
        for number in range(TARGETS):
            pose = arm.place()
            centre = pose[:3, 3]
            arm.controller.set_task(Task(target=Target(position=tuple(centre.tolist()))))
            states = arm.go(10.0)
            if number % 2:
                angles = np.linspace(0, 2 * np.pi, 25)[1:]
                way = [
                    centre + 0.01 * (pose[:3, 0] * (np.cos(a) - 1) + pose[:3, 1] * np.sin(a))
                    for a in angles
                ]
                waypoints = [
                    Waypoint(time=0.25 * (k + 1), target=Target(position=tuple(place.tolist())))
                    for k, place in enumerate(way)
                ]
                arm.controller.follow(Trajectory(waypoints=waypoints), arm.rig.clock.now())
                states += arm.go(8.0)
            found.false_alarms += _onsets(states)
            found.free_time += len(states) * PERIOD


def _onsets(states: list[ControllerStatus]) -> int:
    touches = np.array([state.touches for state in states], dtype=int)
    return int((np.diff(touches, prepend=0) == 1).sum())


def drawn_press(
    name: str, seed: int, dynamics: str, rng: np.random.Generator
) -> tuple[Task, Array, Array] | None:
    """Return a press that an arm can do, with its target's pose (4, 4) and direction (3,)."""
    with Arm(name, seed, dynamics) as arm:
        arm.still.settle(np.zeros(arm.robot.n_pressures))
        vented = arm.still.tip_pose()[:3, 3]
        for _ in range(20):
            pose = arm.place()
            turn = rng.uniform(0, 2 * np.pi)
            way = pose[:3, 0] * np.cos(turn) + pose[:3, 1] * np.sin(turn)
            begins = float(way @ (vented - pose[:3, 3]))
            if abs(begins) < DEEPEST:
                continue
            way = -way if begins > 0 else way
            asked = Press(force=rng.uniform(0.015, 0.04), direction=tuple(way.tolist()))
            tasks = [
                Task(target=Target(position=tuple((pose[:3, 3] + far * way).tolist())), press=asked)
                for far in (0.0, FARTHEST)
            ]
            try:
                for task in tasks:
                    arm.controller.check_ahead(task)
            except InputError:
                continue  # it cannot press like that there
            return tasks[0], pose, way
    return None


def surface_at(pose: Array, way: Array, away: float, stiffness: float) -> SoftSurface:
    """Return a surface across `way` (3,), at a distance from the tip's pose (4, 4), in m."""
    return SoftSurface(
        point=tuple((pose[:3, 3] + away * way).tolist()), normal=tuple((-way).tolist()),
        stiffness=stiffness,
    )  # fmt: skip


def inside(name: str, seed: int, dynamics: str, found: Found) -> None:
    """Press from a target that lies inside an object."""
    rng = np.random.default_rng([seed, 24])
    drawn = drawn_press(name, seed, dynamics, rng)
    if drawn is None:
        return
    task, pose, way = drawn
    stiffness = float(np.exp(rng.uniform(np.log(100), np.log(2000))))
    deep = rng.uniform(5e-4, DEEPEST)
    with Arm(name, seed, dynamics, surface_at(pose, way, -deep, stiffness)) as arm:
        arm.controller.set_task(task)
        course, forces, why = arm.controller.replanner.pursuit.course, [], ""
        for _ in range(round(arm.hold / 0.05)):
            arm.go(0.05)
            forces.append(arm.rig.world.plant.contact_force())
            held = [n.kind for n in arm.controller.notices() if n.hold or n.kind == "implausible"]
            if held or course.phase is Phase.ENDED:
                why = f"held: {held[0]}" if held else "gone back"
                break
    wanted = task.press.force
    found.inside.append((why or course.phase.value, max(forces) / wanted, forces[-1] / wanted))


def press(name: str, seed: int, dynamics: str, found: Found) -> None:
    """Press on a surface beside the tip."""
    rng = np.random.default_rng([seed, 22])
    drawn = drawn_press(name, seed, dynamics, rng)
    if drawn is None:
        return
    task, pose, way = drawn
    wanted = task.press.force
    stiffness = float(np.exp(rng.uniform(np.log(100), np.log(1000))))
    away = rng.uniform(2e-3, FARTHEST)
    surface = surface_at(pose, way, away, stiffness)
    with Arm(name, seed, dynamics, surface) as arm:
        arm.controller.set_task(task)
        forces, on_way, course = [], [0.0], arm.controller.replanner.pursuit.course
        for _ in range(round(arm.hold / 0.05)):
            going = course.phase is Phase.GOING
            arm.go(0.05)
            force = arm.rig.world.plant.contact_force()
            (on_way if going else forces).append(force)
        found.failed += [n.text for n in arm.controller.notices() if n.kind == "press-failed"]
        tip = arm.rig.world.plant.tip_pose()[:3, 3] - pose[:3, 3]
        found.aside.append(float(np.linalg.norm(tip - way * float(way @ tip))))
    last = float(np.mean(forces[-60:] or [0.0]))
    found.presses.append(last)
    found.press_errors.append(abs(last - wanted) / (ALLOWED * wanted + ALLOWED_FORCE))
    found.most.append(max(forces, default=0.0) / wanted)
    found.on_way.append(max(on_way) / wanted)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", type=int, default=3)
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--dynamics", choices=DYNAMICS, nargs="+", default=list(DYNAMICS))
    parser.add_argument("--what", nargs="+", default=["pushes", "free", "press"])
    parser.add_argument("--draw-creep", action="store_true", help="another creep for each arm")
    parser.add_argument("--hold", type=float, default=Arm.hold, help="duration of a press, s")
    given = parser.parse_args()
    Arm.draws_creep, Arm.hold = given.draw_creep, given.hold
    rows = []
    for name in given.robots:
        for dynamics in given.dynamics:
            found = Found()
            for seed in range(given.seed, given.seed + given.arms):
                for what in given.what:
                    {"pushes": pushes, "free": free, "press": press, "inside": inside}[what](
                        name, seed, dynamics, found
                    )
            rows.append(row(f"{name}, {dynamics}", found))
            print(rows[-1], found.failed, flush=True)
            for why, most, last in found.inside:
                print(f"  {why}: at most {most:.1f}, at last {last:.1f} of the force", flush=True)
    head = [
        "arm", "pushes right", "error, mN, median / most", "in the 95 % region",
        "false alarms", "presses right", "worst, of what is allowed", "largest, of what is wanted",
        "touch on the way, most of what is wanted", "aside, mm, median / most",
    ]  # fmt: skip
    print("\n".join(table(head, rows)))


def row(name: str, found: Found) -> list[str]:
    """A line of the table."""
    errors, aside = (
        1e3 * np.array(found.errors or [np.nan]),
        1e3 * np.array(found.aside or [np.nan]),
    )
    presses = np.array(found.press_errors or [np.nan])
    return [
        name,
        f"{sum(found.right)} of {len(found.right)}",
        f"{np.median(errors):.1f} / {errors.max():.1f}",
        f"{sum(found.covered)} of {len(found.covered)}",
        f"{found.false_alarms} in {found.free_time:.0f} s",
        f"{int((presses <= 1).sum())} of {len(found.press_errors)}",
        f"{presses.max():.2f}",
        f"{max(found.most, default=np.nan):.2f}",
        f"{sum(most > 0.05 for most in found.on_way)}, {max(found.on_way, default=np.nan):.2f}",
        f"{np.median(aside):.2f} / {aside.max():.2f}",
    ]


if __name__ == "__main__":
    main()
