"""Tasks among obstacles: is the clearance kept, is the stiffest found, what does a scene cost.

    python benchmarks/scenes --tasks 200 --compared 40 --starts 60 --seed 1
    python benchmarks/scenes --arm hanging --only 17 --starts 200   # one case again

Random tasks with 1 to 4 objects of all kinds, all of which can be done, for 1, 2 and 3 segments
and a hanging arm in turn.  Printed for each arm are

solved      how many of the tasks;
shortfall   the most by which a solved one is nearer to an object than the clearance asked, in mm,
            measured from the arm's independently computed centre line (`judge.py`);
stiffest    share of the compared tasks whose stiffness is not more than 0.5 % below the best of
            IPOPT's points (`ipopt.py`) that the judge confirms, of those tasks in which there is
            one; in how many of them that is 0.5 % below; and at how many points IPOPT ended;
cold        median CPU of a solution from the task alone, and its ratio to the same task's without
            the scene.

Each case that fails is printed with its number.  Limitations: objects lie where a random trial put
them, mostly next to the stiffest configuration without them; the best of IPOPT is no proof.
"""

import argparse
import os
import sys
import tempfile
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import thread_time

os.environ.setdefault("STIFFOPT_COMPILE", "wait")
HERE = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]

import numpy as np  # noqa: E402

from independent.rods import centre_line  # noqa: E402
from scenes.ipopt import Ipopt  # noqa: E402
from scenes.judge import clearances  # noqa: E402
from scenes.scene_tasks import ARMS, CLEARANCE, RADIUS, Case, random_case  # noqa: E402
from stiffopt import PressureSolution, Task, solve_pressure  # noqa: E402

NEAR_BEST = 5e-3  # relative
POINTS = {True: 150, False: 400}  # of a centre line, where the arm hangs and else
EXACT = 1e-5  # m, by which a point of the reference may lack clearance
REPETITIONS = 3


@dataclass
class Tally:
    """What became of the tasks on one arm."""

    solved: int = 0
    tasks: int = 0
    shortfall: float = -np.inf
    stiffest: int = 0
    compared: int = 0
    above: int = 0
    points: int = 0
    seconds: list[tuple[float, float]] = field(default_factory=list)  # without and with the scene

    def __str__(self) -> str:
        parts = [f"solved {self.solved}/{self.tasks}"]
        if self.solved:
            free, among = np.median(self.seconds, axis=0)
            parts.append(f"shortfall {1e3 * self.shortfall:.4f} mm")
            parts.append(f"cold {1e3 * among:.2f} ms, {among / free:.2f} of without a scene")
        if self.compared:
            parts.append(
                f"stiffest {self.stiffest}/{self.compared}, IPOPT below in {self.above} "
                f"({self.points} points)"
            )
        return ", ".join(parts)


def run(name: str, number: int, seed: int, starts: int, tally: Tally, folder: Path) -> str:
    """Solve one task, judge and compare it; words about what is amiss."""
    case = random_case(name, seed, number, folder)
    robot = ARMS[name][0]()
    times = []
    for with_scene in (False, True):
        tasks = [case.task(with_scene, 1 + variant) for variant in range(REPETITIONS)]
        solve = partial(solve_pressure, robot)
        timed = [_timed(solve, task) for task in tasks]
        times.append(min(seconds for seconds, _ in timed))
        answer = timed[-1][1]
    tally.tasks += 1
    if not answer.found:
        return f"{answer.status} ({1e3 * times[1]:.0f} ms): {answer.message}"
    tally.solved += 1
    tally.seconds.append((times[0], times[1]))
    lack = _lack(name, case, answer.pressures)
    tally.shortfall = max(tally.shortfall, lack)
    words = f"{1e3 * lack:.4f} mm short" if lack > 5e-5 else ""
    if starts:
        words += _compared(name, case, answer, starts, [seed, number], tally)
    return words


def _timed(solve: partial[PressureSolution], task: Task) -> tuple[float, PressureSolution]:
    begin = thread_time()
    answer = solve(task)
    return thread_time() - begin, answer


def _lack(name: str, case: Case, p: np.ndarray) -> float:
    """By how much the body lacks the clearance, in m."""
    line = centre_line(ARMS[name][1], p, POINTS[name == "hanging"])
    return CLEARANCE - min(clearances(case.objects, line, RADIUS, CLEARANCE))


def _compared(
    name: str, case: Case, answer: PressureSolution, starts: int, seed: list[int], tally: Tally
) -> str:
    robot = ARMS[name][0]()
    ends = sorted(
        Ipopt(robot, case).ends(starts, np.random.default_rng(seed)),
        key=lambda end: end[0],
        reverse=True,
    )
    assert answer.stiffness is not None
    tally.points += len(ends)
    best = next((end for end in ends if _lack(name, case, end[1]) < EXACT), None)
    if best is None:
        return f" none of {len(ends)} points of IPOPT is confirmed"
    tally.compared += 1
    tally.above += answer.stiffness > best[0] / (1 - NEAR_BEST)
    if answer.stiffness >= (1 - NEAR_BEST) * best[0]:
        tally.stiffest += 1
        return ""
    return (
        f" {answer.stiffness / best[0] - 1:+.2%} of IPOPT's {best[0]:.5g} at "
        f"{np.round(best[1] / 1e5, 4).tolist()} bar; {answer.confidence}"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", action="append", choices=list(ARMS))
    parser.add_argument("--tasks", type=int, default=40, help="in all, on all arms")
    parser.add_argument("--compared", type=int, default=8, help="of these with IPOPT")
    parser.add_argument("--starts", type=int, default=60, help="of IPOPT")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="number of the one case to run, on one --arm")
    parser.add_argument("--meshes", type=Path, help="folder of the meshes, instead of a new one")
    given = parser.parse_args()
    arms = given.arm or list(ARMS)
    tallies = {name: Tally() for name in arms}
    with tempfile.TemporaryDirectory() as new:
        folder = given.meshes or Path(new)
        folder.mkdir(exist_ok=True)
        numbers = range(given.tasks) if given.only is None else [given.only * len(arms)]
        for index in numbers:
            name, number = arms[index % len(arms)], index // len(arms)
            starts = given.starts if index < given.compared or given.only is not None else 0
            words = run(name, number, given.seed, starts, tallies[name], folder)
            if words or given.only is not None:
                case = random_case(name, given.seed, number, folder)
                print(f"  case {number} ({name}; {case.kinds}): {words}", flush=True)
    for name, tally in tallies.items():
        print(f"{name}: {tally}", flush=True)


if __name__ == "__main__":
    main()
