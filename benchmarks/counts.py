"""Compare counts that do not depend on the machine with recorded ones.

    python benchmarks/counts.py            # compare; exit code 1 if something got worse
    python benchmarks/counts.py --update   # record the new counts

instructions   of the model's and the optimiser's functions (`Function.n_instructions`)
c source       bytes of C that CasADi generates for them
solutions      local searches of the optimiser, and the `counts` of solutions (iterations,
               evaluations, quadratic programs), summed over a few fixed tasks; only with a C
               compiler, since the optimiser takes other paths without one
compiled code  bytes of the shared libraries that a first solution leaves in the cache; counted only
               by `make bench`, since it needs separate processes

A count is worse if it exceeds the recorded one by more than the tolerance of its group, or if it is
recorded and no longer found.  Smaller and new counts are reported and are not failures.
"""

import argparse
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca

import tasks
from environment import compiler
from stiffopt import solve_pressure
from stiffopt.model.compliance import directional_stiffness
from stiffopt.model.kinematics import Actuation
from stiffopt.model.shape import FreeShape
from stiffopt.optimise.program import Program

RECORD = Path(__file__).with_name("results") / "counts.json"
TOLERANCE = {"instructions": 0.02, "c source": 0.05, "solutions": 0.10, "compiled code": 0.30}
"""Relative.  Paths of a solution may fork where rounding differs; compilers differ in code size."""

SEED = 1
SOLVED = (
    ("position", 1), ("position", 2), ("position", 3), ("pose-6", 2), ("several", 2), ("guided", 2),
)  # fmt: skip
TASKS = 4

Counts = dict[str, dict[str, int]]


@dataclass(frozen=True)
class Difference:
    """One count beside the one on record; None where there is none."""

    group: str
    name: str
    expected: int | None
    found: int | None

    @property
    def state(self) -> str:
        """`same`, `better`, `worse`, `gone` or `new`."""
        if self.found is None:
            return "gone"
        if self.expected is None:
            return "new"
        if abs(self.found - self.expected) <= TOLERANCE[self.group] * self.expected:
            return "same"
        return "worse" if self.found > self.expected else "better"

    @property
    def fails(self) -> bool:
        """Whether this is a regression."""
        return self.state in ("worse", "gone")

    def __str__(self) -> str:
        return f"{self.group}: {self.name}: {self.found}, on record {self.expected}: {self.state}"


def count() -> Counts:
    """Count everything anew."""
    found: Counts = {"instructions": {}, "c source": {}}
    for segments in (1, 2, 3):
        for name, function in _functions(segments).items():
            key = f"{name}, {tasks.arm_words(segments)}"
            found["instructions"][key] = function.n_instructions()
            found["c source"][key] = _c_bytes(function)
    if compiler() == "none":
        return found
    found["solutions"] = {}
    for kind, segments in SOLVED:
        for name, value in _solutions(kind, segments).items():
            found["solutions"][f"{name}, {kind}, {tasks.arm_words(segments)}"] = value
    return found


def compare(found: Counts, expected: Counts | None = None) -> list[Difference]:
    """All counts beside those on record."""
    expected = recorded() if expected is None else expected
    differences = []
    for group in (name for name in TOLERANCE if name in found):
        new, old = found.get(group, {}), expected.get(group, {})
        differences += [
            Difference(group, name, old.get(name), new.get(name)) for name in {**old, **new}
        ]
    return differences


def recorded() -> Counts:
    """What is on record; empty if nothing is."""
    return dict(json.loads(RECORD.read_text(encoding="utf-8"))) if RECORD.exists() else {}


def update(found: Counts) -> None:
    """Put counts on record; groups that were not counted stay."""
    found = {**recorded(), **found}
    RECORD.parent.mkdir(exist_ok=True)
    RECORD.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def _functions(segments: int) -> dict[str, ca.Function]:
    """The model's functions, and those of the optimiser's program where it has them."""
    robot = tasks.arm(segments)
    actuation = Actuation.of(robot.description)
    tip = FreeShape.of(robot.description, actuation, None)
    d = ca.SX.sym("d", 3)
    k = directional_stiffness(
        tip.compliance, tip.rotation, d, frame="base", kind="translation", boundary="free"
    )
    outputs: dict[str, tuple[list[Any], list[Any]]] = {
        "pose": ([], [tip.transform]),
        "pose and Jacobian": ([], [tip.transform, tip.jacobian]),
        "compliance": ([], [tip.compliance]),
        "stiffness": ([d], [k]),
        "stiffness and gradient": ([d], [k, tip.total_jacobian(k)]),
    }
    functions = {
        name: ca.Function("f", [*tip.inputs, *more], values)
        for name, (more, values) in outputs.items()
    }
    return {**functions, **_program(segments)}


def _program(segments: int) -> dict[str, ca.Function]:
    """Functions of the optimiser's nonlinear program for a position and one stiffness."""
    robot, task = tasks.task_of("position", segments, SEED, 0)
    program = Program.of(task, robot.description)
    return {
        f"program's {name}": robot.tip_function(name, getattr(program, name), program.n_parameters)
        for name in ("pose", "point", "judge")
    }


def _c_bytes(function: ca.Function) -> int:
    generator = ca.CodeGenerator("f.c")
    generator.add(function)
    return len(generator.dump())


def _solutions(kind: str, segments: int) -> dict[str, int]:
    """Sums over the tasks of a kind."""
    sums: dict[str, int] = {}
    for number in range(TASKS):
        robot, task = tasks.task_of(kind, segments, SEED, number)
        solution = solve_pressure(robot, task)
        for name, value in solution.counts.items():
            sums[name] = sums.get(name, 0) + value
    return sums


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--update", action="store_true", help="put what is counted on record")
    given = parser.parse_args()
    found = count()
    differences = compare(found)
    for difference in differences:
        if difference.state != "same":
            print(difference)
    if given.update:
        update(found)
        print(f"{RECORD.name}: {sum(map(len, found.values()))} counts on record")
        return 0
    failed = sum(difference.fails for difference in differences)
    print(f"{len(differences)} counts, {failed} worse than on record")
    return 1 if failed else 0


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # solutions are counted of compiled code
    sys.exit(main())
