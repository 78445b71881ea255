"""Write the golden results of problems, after checking them against an independent reference.

    python problems/golden/update.py                       # all problems
    python problems/golden/update.py two_segment_stiff_x   # some of them
    python problems/golden/update.py --starts 200 ...      # a harder check

For each ``problems/NAME.yaml`` the task is solved as `solve-pressure` does, and ``NAME.json`` is
written here if the many-start reference of ``benchmarks/reference.py`` (SciPy; it shares nothing
with stiffopt's optimiser) finds nothing better by more than 0.5 %, or 0.01 mm for the closest
configuration of an unreachable target.  Otherwise the golden is left as it was, and the exit code
is 1.

`pressures_spread_bar` is the evidence for comparing pressures: how far the reference's equally
good ends (within 1e-6) lie apart; null where no two agree, or the pressures do not matter.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from stiffopt import (
    Manipulator,
    PressureSolution,
    StiffnessGoal,
    StiffnessMeasure,
    Task,
    load_robot,
    load_task,
    solve_pressure,
)

HERE = Path(__file__).parent
PROBLEMS = HERE.parent
sys.path.insert(0, str(PROBLEMS.parent / "benchmarks"))

from brace import Reference as BracedReference  # noqa: E402
from reference import Answer, Reference  # noqa: E402

NEAR_BEST = 5e-3  # relative
NEAR_CLOSEST = 1e-5  # m
NEAR_ANGLE = 2e-4  # rad


def golden(solution: PressureSolution) -> dict[str, object]:
    """What is kept of a solution; the keys are those of ``solve-pressure --json``."""

    def numbers(values: np.ndarray | None) -> list[float] | None:
        return None if values is None else [float(f"{value:.9g}") + 0.0 for value in values]

    def number(value: float | None) -> float | None:
        return None if value is None else float(f"{value:.9g}")

    return {
        "status": solution.status,
        "pressures_pa": numbers(solution.pressures),
        "tip_position_m": numbers(solution.tip_position),
        "tip_quaternion_wxyz": numbers(solution.tip_quaternion),
        "position_error_m": number(solution.position_error),
        "angle_error_rad": number(solution.angle_error),
        "stiffness": number(solution.stiffness),
        "stiffness_unit": solution.stiffness_unit,
        "matrix_distance": number(solution.matrix_distance),
        "active_bounds": list(solution.active_bounds),
    }


def check(
    robot: Manipulator, task: Task, solution: PressureSolution, starts: int, seed: int
) -> tuple[bool, str, float | None]:
    """Whether the reference finds nothing better, in words, and the spread of its pressures."""
    if task.brace is not None:
        return _check_braced(robot, task, solution, starts, seed)
    answer = Reference(robot, task).best(starts, seed)
    goal = task.stiffness
    floored = goal is not None and bool(goal.at_least)
    if answer is None and floored and Reference(robot, task).best(starts, seed, floors=False):
        return _check_floors(robot, task, solution, starts, seed)
    if answer is None:
        return _check_closest(robot, task, solution, starts, seed)
    if goal is not None and goal.match is not None:
        match = goal.match
        mine = (
            solution.matrix_distance
            if solution.matrix_distance is not None
            else abs((solution.stiffness or 0) / match.value - 1)  # type: ignore[union-attr]
        )
        wanted = "solved" if answer.value <= match.tolerance else "unreachable"
        good = solution.status == wanted
        good = good and (wanted == "solved" or mine <= answer.value * (1 + NEAR_BEST))
        return good, _words("relative distance", mine, answer), answer.spread
    if goal is not None and goal.maximise:
        mine = min(solution.stiffnesses[: len(goal.maximise)])
        good = solution.found and mine >= (1 - NEAR_BEST) * answer.value
        return good, _words("stiffness", mine, answer), answer.spread
    pressures = np.asarray(solution.pressures) / 1e5
    mine = float(pressures @ pressures) / len(pressures)
    good = solution.found and mine <= (1 + NEAR_BEST) * answer.value
    return good, _words("mean square pressure", mine, answer), answer.spread


def _check_braced(
    robot: Manipulator, task: Task, solution: PressureSolution, starts: int, seed: int
) -> tuple[bool, str, float | None]:
    """Leaning: the reference of ``benchmarks/brace.py`` finds nothing stiffer in contact."""
    found = BracedReference(robot, task).best(starts, seed)
    mine, best = solution.stiffness or 0.0, found["best"] or 0.0
    good = solution.found and bool(solution.contacts) and mine >= (1 - NEAR_BEST) * best > 0
    text = f"{found['agreeing']} of {found['ended']} ends of {found['starts']} starts agree"
    return good, f"stiffness {mine:.6g} (ref. {best:.6g}, {text})", None


def _check_floors(
    robot: Manipulator, task: Task, solution: PressureSolution, starts: int, seed: int
) -> tuple[bool, str, float | None]:
    """A floor that cannot be had: the reference maximises it instead."""
    floors = task.stiffness.at_least if task.stiffness else ()
    if len(floors) != 1:
        return False, "the check knows one floor out of reach, not several", None
    measure = StiffnessMeasure(**{key: getattr(floors[0], key) for key in
                                  ("direction", "frame", "kind", "boundary")})  # fmt: skip
    other = task.model_copy(update={"stiffness": StiffnessGoal(maximise=(measure,))})
    answer = Reference(robot, other).best(starts, seed)
    mine = solution.stiffnesses[-1]
    good = answer is not None and solution.status == "unreachable"
    good = good and answer.value * (1 - NEAR_BEST) <= mine < floors[0].value
    return good, _words("floor's stiffness", mine, answer), answer.spread if answer else None


def _check_closest(
    robot: Manipulator, task: Task, solution: PressureSolution, starts: int, seed: int
) -> tuple[bool, str, float | None]:
    reference = Reference(robot, task).closest(starts, seed)
    position, angle = reference.position, reference.angle
    good = solution.status == "unreachable"
    words = []
    if angle is not None and solution.angle_error is not None:
        least = max(angle, task.target.tolerance.angle)
        good = good and solution.angle_error <= least + NEAR_ANGLE
        words.append(f"{np.degrees(solution.angle_error):.4f} deg (ref. {np.degrees(angle):.4f})")
    if position is not None and solution.position_error is not None:
        good = good and solution.position_error <= position + NEAR_CLOSEST
        words.append(f"{solution.position_error * 1e3:.4f} mm (ref. {position * 1e3:.4f})")
    return good, " and ".join(words) + " off", reference.spread


def _words(name: str, mine: float, answer: Answer | None) -> str:
    if answer is None:
        return f"{name} {mine:.6g}; the reference finds none"
    return (
        f"{name} {mine:.6g} (ref. {answer.value:.6g}, {answer.agreeing} of {answer.reached} starts "
        f"agree)"
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="name")
    parser.add_argument("--starts", type=int, default=200, help="of the reference")
    parser.add_argument("--starts-loaded", type=int, default=10, help="the same under loads")
    parser.add_argument("--starts-braced", type=int, default=40, help="of tasks with a brace")
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    wrong = 0
    for name in given.names or sorted(path.stem for path in PROBLEMS.glob("*.yaml")):
        task = load_task(PROBLEMS / f"{name}.yaml")
        robot = load_robot(task.resolve_robot())
        solution = solve_pressure(robot, task)
        loaded = robot.is_loaded or task.tip_load is not None
        starts = given.starts_loaded if loaded else given.starts
        starts = given.starts_braced if task.brace is not None else starts
        good, text, spread = check(robot, task, solution, starts, given.seed)
        print(f"{'ok   ' if good else 'WRONG'} {name}: {solution.status}, {text}", flush=True)
        if not good:
            wrong += 1
            continue
        content = golden(solution) | {
            "pressures_spread_bar": None if spread is None else float(f"{spread:.2g}")
        }
        lines = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in content.items())
        (HERE / f"{name}.json").write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
