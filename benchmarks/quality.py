"""Measure how often stiffopt finds the target pose, and the stiffest configuration for it.

    python benchmarks/quality.py --segments 2 --tasks 100 --starts 40 --seed 1
    python benchmarks/quality.py --segments 3 --kind pose-5 --tasks 20
    python benchmarks/quality.py --kind unreachable --tasks 20
    python benchmarks/quality.py --segments 2 --seed 1 --only 17 --starts 200   # one case again

Random tasks on the built-in arms are solved by `stiffopt.solve_pressure` and by the many-start
reference of `reference.py`, which shares no code with its optimiser.  Printed are the shares of
tasks for which

found       the solution says that every tolerance, limit and demand holds;
holds       of those found, the pose is within its tolerance and the pressures within their limits,
            recomputed with `Manipulator.tip_pose`;
stiffest    the smallest of the maximised stiffnesses is not more than 0.5 % below the best that
            the reference finds (kind least-pressure: the mean square of the pressures not more
            than 0.5 % above; kinds match: near enough);

or, of unreachable targets,

found       the solution says that the target cannot be reached;
closest     its position error is within 0.1 mm, and its angle error (if an orientation is
            prescribed) within 0.01 degrees, of the smallest that the reference finds.

Each failed case is printed with its number and its task.  Limitations: the reference is not a
proof, only the best of its starts; targets are poses of random pressures, three in ten of them with
some channels at their limits, so regions that few pressures reach are rare.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from reference import Reference, pose_errors
from stiffopt import (
    AtLeast,
    Manipulator,
    MatchMatrix,
    MatchValue,
    StiffnessGoal,
    StiffnessMeasure,
    Target,
    Task,
    load_robot,
    solve_pressure,
)
from stiffopt.lie import quaternion_from_rotation
from stiffopt.optimise.task import PressureRange

KINDS = (
    "position", "free-axis", "pointing", "orientation", "pose-5", "pose-6", "guided", "clamped",
    "rotation", "several", "tip-frame", "limited", "unreachable", "unreachable-pose-5",
    "unreachable-limited", "unreachable-pose-6", "floor", "least-pressure", "match",
    "match-matrix",
)  # fmt: skip
NEAR_BEST = 5e-3  # relative
NEAR_CLOSEST = 1e-4  # m
NEAR_ANGLE = np.radians(0.01)


@dataclass(frozen=True)
class Outcome:
    """What became of one task."""

    found: bool
    holds: bool
    best: bool
    counts: bool  # whether the reference knows an answer to compare with
    seconds: float
    text: str


def random_task(robot: Manipulator, kind: str, rng: np.random.Generator) -> Task:
    """Task of a kind; its target is the tip pose of random pressures unless it is unreachable."""
    n = robot.n_pressures
    stretch = 1.4 if rng.random() < 0.3 else 1.0  # some channels at their limits
    unit = np.clip(stretch * (rng.random(n) - 0.5) + 0.5, 0, 1)
    limit = 0.5 if kind.endswith("limited") else 1.0
    pressures = robot.pressure_min + limit * unit * (robot.pressure_max - robot.pressure_min)
    T = robot.tip_pose(pressures)
    position, z = T[:3, 3], T[:3, 2]
    quaternion = quaternion_from_rotation(T[:3, :3])
    if kind.startswith("unreachable"):
        position = position * rng.uniform(1.1, 1.7) + rng.normal(size=3) * 0.1 * robot.length
        z = z + 0.7 * rng.normal(size=3)
        quaternion = quaternion + 0.4 * rng.normal(size=4)
        quaternion = quaternion / np.linalg.norm(quaternion)
    asked: dict[str, object] = {"position": tuple(position.tolist())}
    if kind == "free-axis":
        free = rng.integers(3)
        asked["position"] = tuple(None if i == free else float(position[i]) for i in range(3))
    if kind in ("pointing", "orientation"):
        del asked["position"]
    if kind == "pointing" or kind.endswith("pose-5"):
        asked["pointing"] = tuple(z.tolist())
    if kind == "orientation" or kind.endswith("pose-6"):
        asked["orientation"] = tuple(quaternion.tolist())
    options: dict[str, str] = {}
    if kind in ("guided", "clamped"):
        options = {"boundary": kind, "kind": "rotation" if rng.random() < 0.3 else "translation"}
    if kind == "rotation":
        options = {"kind": "rotation"}
    if kind == "tip-frame":
        options = {"frame": "tip"}
    count = int(rng.integers(2, 4)) if kind == "several" else 1
    measures = tuple(
        StiffnessMeasure(direction=tuple(rng.normal(size=3).tolist()), **options)
        for _ in range(count)
    )
    goal: StiffnessGoal | None = StiffnessGoal(maximise=measures)
    d = tuple(rng.normal(size=3).tolist())
    there = float(robot.stiffness(pressures, d))  # can be had, at the pressures of the target
    if kind == "floor":
        goal = StiffnessGoal(maximise=measures, at_least=AtLeast(direction=d, value=there))
    if kind == "match":
        goal = StiffnessGoal(match=MatchValue(direction=d, value=there))
    if kind == "match-matrix":
        K = T[:3, :3] @ np.linalg.inv(robot.tip_compliance(pressures)[:3, :3]) @ T[:3, :3].T
        goal = StiffnessGoal(match=MatchMatrix(matrix=((K + K.T) / 2).tolist()))
    if kind == "least-pressure":
        goal = None
    return Task(
        robot=robot.description.name,
        target=Target(**asked),
        stiffness=goal,
        pressure=PressureRange(max=0.5 * 1.5e5) if limit < 1 else PressureRange(),
    )


def run(robot: Manipulator, task: Task, starts: int, seed: int) -> Outcome:
    """Solve a task that can be had, and compare."""
    begin = perf_counter()
    solution = solve_pressure(robot, task)
    seconds = perf_counter() - begin
    answer = Reference(robot, task).best(starts, seed)
    p = solution.pressures
    if p is None or not np.isfinite(p).all():
        return Outcome(False, False, False, True, seconds, f"failed: {solution.message}")
    lower, upper = task.pressure_bounds(robot.description)
    position, angle = pose_errors(task, robot.tip_pose(p))
    tolerance = task.target.tolerance
    holds = bool(
        (position is None or position <= tolerance.position * (1 + 1e-9))
        and (angle is None or angle <= tolerance.angle * (1 + 1e-9) + 1e-12)
        and (p >= lower - 0.1).all()
        and (p <= upper + 0.1).all()
    )
    goal = task.stiffness
    value = Reference(robot, task).value(p / 1e5)
    if answer is None:
        best = True
    elif goal is not None and goal.match is not None:
        best = value <= max(goal.match.tolerance, answer.value)
    elif goal is None:
        best = value <= (1 + NEAR_BEST) * answer.value
    else:
        best = value >= (1 - NEAR_BEST) * answer.value
        floors = zip(solution.stiffnesses[len(goal.maximise) :], goal.at_least, strict=True)
        holds = holds and all(there >= floor.value for there, floor in floors)
    text = f"{solution.status}, value {value:.6g}"
    if answer is not None:
        text += (
            f" ({value / max(answer.value, 1e-300) - 1:+.3%} of the reference's "
            f"{answer.value:.6g}, which {answer.agreeing} of {answer.reached} starts agree on); "
            f"{solution.confidence}"
        )
    return Outcome(solution.found, holds, best and solution.found, True, seconds, text)


def run_unreachable(robot: Manipulator, task: Task, starts: int, seed: int) -> Outcome:
    """Solve a task that cannot be had, and compare."""
    begin = perf_counter()
    solution = solve_pressure(robot, task)
    seconds = perf_counter() - begin
    reference = Reference(robot, task).closest(starts, seed)
    position, angle = reference.position, reference.angle
    tolerance = task.target.tolerance
    out_of_reach = bool(
        (position is not None and position > tolerance.position)
        or (angle is not None and angle > tolerance.angle * (1 + 1e-3))
    )
    if not out_of_reach:
        return Outcome(True, True, True, False, seconds, "")
    if solution.pressures is None:
        return Outcome(False, False, False, True, seconds, f"failed: {solution.message}")
    mine = pose_errors(task, robot.tip_pose(solution.pressures))
    text = (
        f"{solution.status}, {_text(mine)} off; reference {_text((position, angle))} off; "
        f"{solution.message}"
    )
    angle_best = angle is None or mine[1] is None or (
        mine[1] <= max(angle, tolerance.angle) + NEAR_ANGLE
    )  # fmt: skip
    position_best = position is None or mine[0] is None or mine[0] <= position + NEAR_CLOSEST
    says_so = solution.status == "unreachable"
    return Outcome(says_so, True, angle_best and position_best, True, seconds, text)


def _text(errors: tuple[float | None, float | None]) -> str:
    position, angle = errors
    parts = [] if position is None else [f"{position * 1e3:.4f} mm"]
    return ", ".join(parts + ([] if angle is None else [f"{np.degrees(angle):.4f} deg"]))


def case(robot: Manipulator, kind: str, seed: int, number: int) -> Task:
    """One of the random tasks of a seed."""
    rng = np.random.default_rng([seed, robot.n_segments, KINDS.index(kind), number])
    return random_task(robot, kind, rng)


def record(file: Path, robot: Manipulator, kind: str, tasks: int, starts: int, seed: int) -> None:
    """Keep the best values of the reference, for tests that cannot wait for it."""
    known = json.loads(file.read_text()) if file.exists() else {}
    values = []
    for number in range(tasks):
        answer = Reference(robot, case(robot, kind, seed, number)).best(starts, seed)
        values.append(None if answer is None else float(f"{answer.value:.7g}"))
    known[f"{robot.description.name} {kind}"] = {"seed": seed, "starts": starts, "best": values}
    file.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def measure(
    robot: Manipulator, kind: str, tasks: int, starts: int, seed: int, only: int | None = None
) -> list[Outcome]:
    """Run the tasks of a kind; failures are printed as they come."""
    outcomes = []
    for number in range(tasks) if only is None else [only]:
        task = case(robot, kind, seed, number)
        unreachable = kind.startswith("unreachable")
        outcome = (run_unreachable if unreachable else run)(robot, task, starts, seed)
        outcomes.append(outcome)
        if only is not None or not (outcome.found and outcome.holds and outcome.best):
            asked = task.model_dump(exclude_defaults=True)
            name = robot.description.name
            print(f"  case {number} ({kind}, {name}, seed {seed}): {outcome.text}\n    {asked}")
            sys.stdout.flush()
    return outcomes


def summary(kind: str, robot: str, outcomes: list[Outcome]) -> str:
    """One line of shares."""
    counted = [outcome for outcome in outcomes if outcome.counts]
    if not counted:
        return f"{robot}, {kind}: no task counts"
    found = [outcome for outcome in counted if outcome.found]
    times = sorted(outcome.seconds for outcome in counted)
    name = "closest" if kind.startswith("unreachable") else "stiffest"
    parts = [
        f"found {len(found)}/{len(counted)}",
        f"{name} {sum(outcome.best for outcome in counted)}/{len(counted)}",
    ]
    if name == "stiffest":
        parts.insert(1, f"holds {sum(outcome.holds for outcome in found)}/{len(found)}")
    return (
        f"{robot}, {kind}: {', '.join(parts)}; "
        f"solve time median {times[len(times) // 2]:.2f} s, longest {times[-1]:.2f} s"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--segments", type=int, default=2, choices=(1, 2, 3))
    parser.add_argument("--robot", help="built-in name or robot file, instead of --segments")
    parser.add_argument("--kind", action="append", choices=(*KINDS, "all"))
    parser.add_argument("--tasks", type=int, default=20)
    parser.add_argument("--starts", type=int, default=40, help="of the reference")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="number of the one case to run")
    parser.add_argument("--record", type=Path, help="only keep the reference's values in this file")
    given = parser.parse_args()
    robot = load_robot(given.robot or f"stiff-flop-{given.segments}")
    kinds = given.kind or ["position"]
    for kind in KINDS if "all" in kinds else kinds:
        if given.record:
            record(given.record, robot, kind, given.tasks, given.starts, given.seed)
            continue
        outcomes = measure(robot, kind, given.tasks, given.starts, given.seed, given.only)
        print(summary(kind, robot.description.name, outcomes), flush=True)


if __name__ == "__main__":
    main()
