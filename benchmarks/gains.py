"""Measure the gain in stiffness over the plain solution, by arm, strain law, freedom and load.

    python benchmarks/gains.py                     # all rows, some minutes, to results/gains.json
    python benchmarks/gains.py --tasks 5 --only 'position, 2 segments' --out /tmp/gains.json
    python benchmarks/gains.py --table             # print the table of the recorded results

A task's target is the tip pose of random pressures (three in ten tasks with some channels at their
limits) and its direction is random (`quality.random_task`).  Each row solves the same number of
tasks for each seed.  For each task

plain   is the stiffness at the pressures of least norm that reach the target within its
        tolerances, found by the global search;
gain    is the stiffness of the solution over that, minus one.

Printed are the median of the gains, their 90th percentile and their largest value, the share of
tasks that gain less than 1 %, and, as the scatter between samples, the range of the medians of
the seeds.  `freed` is the median gain over the *stiffest* solution for the exact position or pose
that the row relaxes: the gain by freeing an axis or a tolerance alone.

Limitations: targets are poses of random pressures, so places that few pressures reach are rare;
the largest of n tasks grows with n; both solutions come from the same search.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from environment import environment
from quality import random_task
from stiffopt import Load, Manipulator, Task, Tolerance, load_robot, solve_pressure
from tasks import arm, hanging_arm

OUT = Path(__file__).parent / "results" / "gains.json"
PAYLOAD = Load(force=(0.0, 0.0, 0.2))
"""Weight of a further 20 g at the tip of the hanging arm, in N; its base z axis points down."""


@dataclass(frozen=True)
class Row:
    """One kind of task on one arm."""

    group: str
    name: str
    robot: Callable[[], Manipulator]
    kind: str = "position"
    tolerance: Tolerance | None = None
    load: Load | None = None
    relaxes: str = ""  # kind of the exact task of which this is a relaxed form


def two_with(**compensation: object) -> Manipulator:
    """Two segments with other values of the compensation."""
    return _two(lambda segment: {"compensation": {**segment["compensation"], **compensation}})


def two_of(law: str, **compensation: object) -> Manipulator:
    """Two segments of another strain law, with these values of the compensation alone."""
    return _two(lambda _: {"strain_law": law, "compensation": compensation or None})


def _two(changes: Callable[[dict], dict]) -> Manipulator:
    data = arm(2).description.model_dump(by_alias=True)
    data["segments"] = [segment | changes(segment) for segment in data["segments"]]
    return load_robot(type(arm(2).description).model_validate(data))


def rows() -> Iterator[Row]:
    """All rows of the table."""
    kinds = {
        "position": "position",
        "pose-5": "position and pointing",
        "pose-6": "position and orientation",
    }
    for segments in (1, 2, 3):
        for kind, words in kinds.items():
            if segments == 1 and kind != "position":
                continue  # three channels cannot reach such a pose to within 0.1 mm and 1 deg anew
            name = f"{words}, {segments} segment{'s' * (segments > 1)}"
            yield Row("arm and pose", name, lambda n=segments: arm(n), kind)
    for kind, words in {
        "pointing": "pointing alone",
        "free-axis": "position, one axis free",
    }.items():
        relaxes = "position" if kind == "free-axis" else "pose-5"
        yield Row("freedom", words, lambda: arm(2), kind, relaxes=relaxes)
    for size in (1e-3, 5e-3, 10e-3):
        yield Row(
            "freedom",
            f"position to {1e3 * size:g} mm",
            lambda: arm(2),
            "position",
            Tolerance(position=size),
            relaxes="position",
        )
    for angle in (5, 15):
        yield Row(
            "freedom",
            f"position and pointing to {angle} deg",
            lambda: arm(2),
            "pose-5",
            Tolerance(angle=np.radians(angle)),
            relaxes="pose-5",
        )
    yield Row(
        "freedom",
        "position and orientation to 5 mm, 15 deg",
        lambda: arm(2),
        "pose-6",
        Tolerance(position=5e-3, angle=np.radians(15)),
        relaxes="pose-6",
    )
    yield Row("law", "paper: modulus falls with pressure", lambda: arm(2))
    yield Row("law", "paper, modulus constant", lambda: two_with(modulus_per_pressure=0.0))
    yield Row(
        "law", "loads not softened by pressure", lambda: two_with(stiffness=1.4, softening=0.0)
    )
    yield Row(
        "law",
        "modulus rises with pressure",
        lambda: two_with(modulus_per_pressure=0.2),
    )
    yield Row("law", "neo-Hookean, no compensation", lambda: two_of("neo-hookean"))
    yield Row("boundary", "guided", lambda: arm(2), "guided")
    yield Row("boundary", "clamped", lambda: arm(2), "clamped")
    yield Row("boundary", "rotation", lambda: arm(2), "rotation")
    yield Row("load", "no gravity", lambda: arm(2))
    yield Row("load", "hanging, 20 g at the tip", hanging_arm)
    yield Row("load", "hanging, 20 g and 20 g payload", hanging_arm, load=PAYLOAD)


def tasks_of(row: Row, seed: int, count: int) -> Iterator[tuple[Manipulator, Task, Task]]:
    """Arm, task and exact task, of so many random ones."""
    robot = row.robot()
    bearer = robot.with_load(row.load.force) if row.load else robot
    for number in range(count):
        task, exact = (
            random_task(bearer, kind, np.random.default_rng([seed, number]))
            for kind in (row.kind, row.relaxes or row.kind)
        )
        exact = exact.model_copy(update={"stiffness": task.stiffness, "load": row.load})
        tolerance = row.tolerance or Tolerance()
        target = task.target.model_copy(update={"tolerance": tolerance})
        yield robot, task.model_copy(update={"target": target, "load": row.load}), exact


def stiffness(robot: Manipulator, task: Task) -> float | None:
    """Stiffness of the answer to a task, None if there is none."""
    solution = solve_pressure(robot, task)
    return solution.stiffness if solution.found else None


def plain_stiffness(robot: Manipulator, task: Task) -> float | None:
    """The task's stiffness at the pressures of least norm that reach its target."""
    plain = solve_pressure(robot, task.model_copy(update={"stiffness": None}))
    if not plain.found:
        return None
    (measure,) = task.measures
    load = task.load
    bearer = robot.with_load(load.force) if load else robot
    return float(
        bearer.stiffness(
            plain.pressures, measure.direction, measure.kind, measure.boundary, measure.frame
        )
    )


def measure(row: Row, seeds: list[int], count: int) -> dict[str, object]:
    """Gains over the tasks of a row, as shares."""
    gains: list[list[float]] = []
    freed: list[float] = []
    for seed in seeds:
        gains.append([])
        for robot, task, exact in tasks_of(row, seed, count):
            best, plain = stiffness(robot, task), plain_stiffness(robot, task)
            if best is None or plain is None:
                continue
            gains[-1].append(best / plain - 1)
            at_exact = stiffness(robot, exact) if row.relaxes else None
            if at_exact is not None:
                freed.append(best / at_exact - 1)
    together = np.concatenate(gains)
    medians = [float(np.median(of_seed)) for of_seed in gains]
    return {
        "group": row.group,
        "name": row.name,
        "tasks": len(together),
        "median": float(np.median(together)),
        "p90": float(np.quantile(together, 0.9)),
        "best": float(together.max()),
        "below_1_percent": float(np.mean(together < 0.01)),
        "medians_of_seeds": [min(medians), max(medians)],
        "freed": float(np.median(freed)) if freed else None,
    }


def percent(share: float | None) -> str:
    """A share in per cent, as the table has it."""
    if share is None:
        return ""
    return f"{100 * share:+.1f} %" if abs(share) < 0.1 else f"{100 * share:+.0f} %"


def table(measured: list[dict]) -> str:
    """The rows as a table in Markdown."""
    lines = [
        "| | tasks | median | of the seeds | 90th percentile | best | below 1 % | freed |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    group = ""
    for row in measured:
        if row["group"] != group:
            group = row["group"]
            lines.append(f"| **{group}** | | | | | | | |")
        low, high = row["medians_of_seeds"]
        cells = [
            row["name"],
            str(row["tasks"]),
            percent(row["median"]),
            f"{percent(low)} to {percent(high)}",
            percent(row["p90"]),
            percent(row["best"]),
            f"{100 * row['below_1_percent']:.0f} %",
            percent(row["freed"]),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Measure, or print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", type=int, default=50, help="of a row and a seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--only", help="rows whose name contains this")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--table", action="store_true", help="print what is in --out")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(json.loads(arguments.out.read_text())["rows"]))
        return 0
    measured = []
    for row in rows():
        if arguments.only and arguments.only not in row.name:
            continue
        measured.append(measure(row, arguments.seeds, arguments.tasks))
        print(json.dumps(measured[-1]), flush=True)
        settings = {"seeds": arguments.seeds, "tasks": arguments.tasks}
        record = {"settings": settings, "environment": environment(), "rows": measured}
        arguments.out.write_text(json.dumps(record, indent=1) + "\n")
    print(table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main())
