"""Hold braced poses in the loop, on the simulated rig, and push until a contact is lost.

    python benchmarks/brace_hold.py --arms 1 2 --keep out/calibrated --out out/brace_hold.json

Arms, calibrated files and tasks are those of `brace_rig.py`, with other seeds for the tasks. The
controller gets the calibrated file; it goes into contact and holds for 20 s. From there, each in a
copy of the process:

- Pushes at the tip grow from zero until a loss is certain, by `--grows` of the foretold loss in a
  second, along the direction in which the contact should lift off first. With `--slips`, `contacts`
  are `sticking`, and pushes are along or against the direction whose stiffness counts, in which it
  should slip first.
- A push in the same direction stays at 0.7 of the push that loses the contact, for 20 s.

Once a loss is certain the arm lets go by itself; otherwise a task at rest makes it.

The contact is lost by a lift-off where the plant's force becomes zero; by a slip where the point of
the body that touches has slid by 0.1 mm since the push began, and again by 0.3 and 0.5 mm: a
measured tip cannot show 0.1 mm (`docs/contact.md`), and in a push that stays, creep alone can slide
a contact by as much. If the loss is reported before, a copy of the plant that does not let go tells
when it would have come: the delay is then negative.

A loss is reported in two steps: that it may have come (`brace-uncertain`), and that it is certain
(`brace-lost`), when the arm lets go.

Metrics: the delays of both; the slide that is told within 0.3 s, which is the slide 0.3 s before
the first report (`slip_bound.py` has how small it can be); both reports without a loss, during the
hold or the push at 0.7; the error of the estimated contact force over its stated deviation at the
loss and under the push at 0.7; what the contacts were pressed with at most; and whether the arm
ends at rest, clear of the object. A slip that is reported during the push at 0.7 is a false one
only if the contact has not slid by then.
"""

from __future__ import annotations

import argparse
import copy
import json
import multiprocessing
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

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
SLIDES = (1e-4, 3e-4, 5e-4)  # m, from which a contact has slipped
KEPT, RAMP = 0.7, 3.0  # of the push that loses the contact, and time in which it is reached, in s
TICK = 0.01  # s
WITHIN = 0.3  # s, in which a loss is to be told
FORK = multiprocessing.get_context("fork")


class Slide:
    """How far the body has slid on an object, at one contact with a normal (3,)."""

    def __init__(self, plant: Any, normal: Any) -> None:
        self._normal = normal
        self._radius = plant.robot.segments[-1].outer_radius
        self._length = sum(each.length for each in plant.robot.segments)
        self._touched: Any = None
        self._slid = np.zeros(3)

    def update(self, plant: Any) -> float:
        """Return the distance so far, in m."""
        nodes = plant.poses()
        if self._touched is not None:
            node, share, lever, before = self._touched
            moved = self._skin(nodes, node, share, lever) - before
            self._slid = self._slid + moved - self._normal * (self._normal @ moved)
        forces = plant.object_forces()
        self._touched = None
        if forces:
            chords = np.linalg.norm(np.diff(nodes[:, :3, 3], axis=0), axis=1)
            along = np.concatenate([[0.0], np.cumsum(chords)]) / chords.sum()
            at = forces[0].at / self._length
            node = int(np.clip(np.searchsorted(along, at) - 1, 0, len(chords) - 1))
            share = (at - along[node]) / (along[node + 1] - along[node])
            lever = nodes[node, :3, :3].T @ (-self._radius * self._normal)
            self._touched = node, share, lever, self._skin(nodes, node, share, lever)
        return float(np.linalg.norm(self._slid))

    def _skin(self, nodes: Any, node: int, share: float, lever: Any) -> Any:
        centre = (1 - share) * nodes[node, :3, 3] + share * nodes[node + 1, :3, 3]
        return centre + nodes[node, :3, :3] @ lever


class Losses:
    """When a contact is lost: by a lift-off, or, if it slips, by each of `SLIDES` in turn.

    Attributes
    ----------
    times : in s, of those that have come.
    """

    def __init__(self, *, slips: bool) -> None:
        self._ways = SLIDES if slips else (np.inf,)
        self.times: list[float] = []

    @property
    def is_complete(self) -> bool:
        """Whether all have come."""
        return len(self.times) == len(self._ways)

    def take(self, time: float, force: float, slid: float) -> None:
        """Take in the contact force in N, and a slide in m."""
        while not self.is_complete and (force == 0.0 or slid > self._ways[len(self.times)]):
            self.times.append(time)

    def foresee(
        self, plant: Any, slide: Slide, pressures: Any, push: Any, begin: float, longest: float
    ) -> None:
        """Go on with a plant whose pressures stay, until all have come or so many s are over."""
        for tick in range(1, round(longest / TICK)):
            if self.is_complete:
                return
            time = begin + tick * TICK
            plant.set_load(PlantLoad(force=tuple(push(time))))
            plant.advance(TICK, pressures)
            slid = slide.update(plant)
            self.take(time, float(bool(plant.object_forces())), slid)


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
            scene=task.scene, slow_first_motion=False,
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


class Held(NamedTuple):
    """A braced pose that the loop holds.

    Attributes
    ----------
    loop, task :
    found : the answer to the task.
    first : the push at which a contact is lost first.
    row : what is known of it so far, for the table.
    """

    loop: Loop
    task: stiffopt.Task
    found: Any
    first: Any
    row: dict[str, Any]


def leant(
    case: Any, believed: Any, seed: list[int], *, slips: bool
) -> Held | dict[str, Any] | None:
    """Hold the pose of a task for 20 s; None if its answer does not lean, or for little.

    A row for the table says why a pose was not held.
    """
    robot = stiffopt.Manipulator(believed)
    task, contacts = draw_task(robot, seed), "sticking" if slips else "sliding"
    assert task.brace is not None
    brace = task.brace.model_copy(update={"contacts": contacts})
    task = task.model_copy(update={"brace": brace})
    found = stiffopt.solve_pressure(robot, task)
    if not found.contacts or found.stiffness < WORTH * (found.stiffness_free or np.inf):
        return None
    losses = [each for each in found.preloads if each.contacts == contacts]
    first = min(losses, key=lambda each: each.loss.force)
    if first.loss.how != ("slips" if slips else "lifts off"):
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
    begin = loop.rig.clock.now()
    loop.go(HOLD, lambda: loop.status.brace != "held")
    row |= {
        "estimated": loop.status.brace_force, "force": loop.force,
        "deviation": loop.status.brace_force_deviation,
        "error": loop.status.position_error, "most": loop.most, "most_on_way": on_way,
        "max": found.contacts[0].max_force, "foretold": first.loss.force,
    }  # fmt: skip
    row["false"] = loop.status.brace != "held"
    row["doubted"] = loop.told_since(begin, "brace-uncertain") is not None
    return Held(loop, task, found, first, row)


def held(
    case: Any, believed: Any, seed: list[int], grows: Sequence[float], *, slips: bool
) -> list[dict[str, Any]]:
    """What the pushes of a task give; none if its answer does not lean, or for little."""
    pose = leant(case, believed, seed, slips=slips)
    if not isinstance(pose, Held):
        return [] if pose is None else [pose]
    loop, task, found, first, row = pose
    robot = stiffopt.Manipulator(believed)
    normal, rest = found.contacts[0].normal, robot.tip_pose(np.zeros(6))[:3, 3]

    def pushed(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        own = work() if loop.status.brace == "held" else {}
        if loop.status.brace == "held":
            target = stiffopt.Target(position=tuple(rest))
            loop.controller.set_task(stiffopt.Task(robot=task.robot, target=target))
        before = loop.most = loop.force
        loop.go(RELEASE, lambda: loop.status.brace not in ("held", "releasing"))
        loop.go(CREEPS)
        return row | own | {
            "ends": loop.status.brace, "left": loop.force, "most_in_release": loop.most - before,
            "told": [each[1:] for each in loop.told][-4:],
        }  # fmt: skip

    works: list[Callable[[], dict[str, Any]]] = [
        lambda each=each: push_off(loop, first, normal, grows=each, slips=slips)  # type: ignore[misc]
        for each in grows
    ]
    works.append(lambda: keep_pushing(loop, first, normal, slips=slips))
    rows = [in_copy(lambda each=each: pushed(each)) for each in works]  # type: ignore[misc]
    loop.controller.close()
    return rows


def in_copy(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What some work returns in a copy of this process."""
    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=lambda: theirs.send(work()))
    process.start()
    theirs.close()
    found: dict[str, Any] = ours.recv()
    process.join()
    return found


def score(loop: Loop) -> float:
    """The error of the estimated contact force over its standard deviation."""
    status = loop.status
    return float((status.brace_force - loop.force) / status.brace_force_deviation)


def push_off(loop: Loop, first: Any, normal: Any, *, grows: float, slips: bool) -> dict[str, Any]:
    """What a push gives that grows until a loss is certain."""
    rate = grows * first.loss.force * np.array(first.direction)
    longest, plant, begin = LONGEST / grows, loop.rig.world.plant, loop.rig.clock.now()
    slide, losses = Slide(plant, normal), Losses(slips=slips)
    times_slid, scores = [(0.0, 0.0)], [0.0]

    def is_told() -> bool:
        slid, now = slide.update(plant), loop.rig.clock.now() - begin
        times_slid.append((now, slid))
        if not losses.times:
            scores[0] = score(loop)
        losses.take(now, loop.force, slid)
        return bool(loop.status.brace != "held")

    told = loop.go(longest, is_told, lambda after: rate * after)
    is_lost, doubted = loop.status.brace != "held", loop.told_since(begin, "brace-uncertain")
    first = told if doubted is None else doubted
    copied, pressures = copy.deepcopy((plant, slide)), loop.rig.supply.read().pressures
    losses.foresee(*copied, pressures, lambda after: rate * after, told, longest)
    times, is_reported = losses.times, is_lost or doubted is not None
    row = {
        "grows": grows, "reported": is_reported, "lost": times, "score": scores[0],
        "slide": float(np.interp(first - WITHIN, *np.array(times_slid).T)),
        "push": float(np.linalg.norm(rate)) * (times[0] if times else longest),
    }  # fmt: skip
    if times and is_reported:
        row |= {
            "late": [first - each for each in times],
            "at_share": first / times[0],
            "certain": told - times[0] if is_lost else None,
        }
    loop.go(FADES, push=lambda after: max(0.0, 1 - after / FADES) * told * rate)
    plant.set_load(None)
    return row


def keep_pushing(loop: Loop, first: Any, normal: Any, *, slips: bool) -> dict[str, Any]:
    """What a push gives that stays below the loss."""
    plant, pressures = loop.rig.world.plant, loop.rig.supply.read().pressures
    rate = first.loss.force * np.array(first.direction) / RAMP
    slide, losses = Slide(plant, normal), Losses(slips=slips)
    copied = copy.deepcopy((plant, slide))
    losses.foresee(*copied, pressures, lambda after: rate * after, 0.0, LONGEST * RAMP)
    if not losses.times:
        return {}
    most, slid, begin = KEPT * losses.times[0] * rate, [0.0], loop.rig.clock.now()
    scores: list[float] = []

    def is_told() -> bool:
        slid[0] = slide.update(plant)
        if loop.status.brace == "held" and loop.rig.clock.now() > begin + RAMP:
            scores.append(score(loop))
        return bool(loop.status.brace != "held")

    loop.go(RAMP + HOLD, is_told, lambda after: min(after / RAMP, 1.0) * most)
    kept = loop.status.brace == "held"
    row = {
        "kept": kept,
        "slid": slid[0],
        "doubted_pushed": loop.told_since(begin, "brace-uncertain") is not None,
        "score": float(np.mean(scores)) if scores else None,
        "estimated_pushed": loop.status.brace_force,
        "force_pushed": loop.force,
    }
    loop.go(FADES, push=lambda after: max(0.0, 1 - after / FADES) * most)
    plant.set_load(None)
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--keep", type=Path, default=Path("out/calibrated"))
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--grows", type=float, nargs="+", default=[1.0, 0.2, 0.1],
        help="shares of the foretold loss per second",
    )  # fmt: skip
    parser.add_argument("--slips", action="store_true", help="contacts that are to stick")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arm in given.arms:
        case = draw_case(arm, ranked=False)
        believed = calibrated_file(case, given.keep)
        count = number = 0
        while count < given.tasks and number < 8 * given.tasks:
            number += 1
            new = held(case, believed, [arm, number, 25], given.grows, slips=given.slips)
            count += bool(new)
            rows += [row | {"arm": arm} for row in new]
            for row in new:
                print(json.dumps(row), flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    report(rows, slips=given.slips)


def report(rows: list[dict[str, Any]], *, slips: bool) -> None:
    """Print the tables."""
    good = [row for row in rows if "force" in row]
    head = [
        "arm", "force promised, estimated, its deviation, met, mN", "push foretold, lost at, mN",
        "first report, s", "certain, s",
    ]  # fmt: skip
    lines = [
        [
            f"{row['arm']}",
            ", ".join(
                f"{1e3 * row[key]:.0f}" for key in ("promised", "estimated", "deviation", "force")
            ),
            f"{1e3 * row['foretold']:.0f}, {1e3 * row['push']:.0f}",
            ", ".join(f"{each:.2f}" for each in row.get("late", [])) or "not reported",
            "never" if row.get("certain") is None else f"{row['certain']:.2f}",
        ]
        for row in good
        if row.get("lost")
    ]
    print("\n".join(table(head, lines)))
    if slips:
        told = [row for row in good if row.get("reported")]
        head = ["arm", "grows, 1/s", "slide that is told within 0.3 s, mm"]
        lines = [[f"{row['arm']}", f"{row['grows']}", f"{1e3 * row['slide']:.2f}"] for row in told]
        print("\n".join(table(head, lines)))
    head = ["slid by, mm", "grows, 1/s", "pushes", "median, s", "first", "last", "by 0.3 s after",
            "within 0.3 s", "not reported"]  # fmt: skip
    lines = []
    pushed = [row for row in good if "grows" in row]
    most = max((len(row["lost"]) for row in pushed), default=0)
    rates = sorted({row["grows"] for row in pushed}, reverse=True)
    for way, grows in product(range(most), rates):
        lost = [row for row in pushed if row["grows"] == grows and len(row["lost"]) > way]
        late = np.array([row["late"][way] for row in lost if "late" in row])
        if not len(late):
            continue
        cells = [f"{each:.2f}" for each in (np.median(late), late.min(), late.max())]
        by, within = (late <= WITHIN + 1e-6).sum(), (abs(late) <= WITHIN + 1e-6).sum()
        missing, slid = len(lost) - len(late), f"{1e3 * SLIDES[way]}" if most > 1 else ""
        lines.append([slid, f"{grows}", f"{len(lost)}", *cells, f"{by}", f"{within}", f"{missing}"])
    print("\n".join(table(head, lines)))
    kept = [row["kept"] for row in good if "kept" in row]
    for what, key in (("lost", "false"), ("uncertain", "doubted")):
        print(f"{what} while nothing pushed: {sum(row[key] for row in good)} of {len(good)}")
    print(f"pushed with {KEPT} of the loss for {HOLD:.0f} s, and held: {sum(kept)} of {len(kept)}")
    doubted = sum(row.get("doubted_pushed", False) for row in good)
    print(f"  uncertain: {doubted}")
    scores = np.abs([row["score"] for row in good if row.get("score") is not None])
    if len(scores) and not slips:
        within = ", ".join(f"{(scores < most).mean():.0%} within {most}" for most in (1, 2))
        print(f"force off, over its deviation: {np.sqrt((scores**2).mean()):.2f} (RMS), {within}")
    if slips:
        slid = sum(row["slid"] > SLIDES[0] and not row["kept"] for row in good if "kept" in row)
        print(f"  not held, and had slid by {1e3 * SLIDES[0]} mm when it was reported: {slid}")
    print(f"let go, clear: {sum(row['left'] == 0 for row in good)} of {len(good)}")


if __name__ == "__main__":
    main()
