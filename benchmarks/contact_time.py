"""Measure how long an equilibrium with one contact on two segments takes.

    python benchmarks/contact_time.py --first 2701 --cases 12

Objects are those of `brace.py`, pressures random, such that the arm touches its object once.
Metrics, CPU time in ms, each the median of 15 calls in a case: the equilibrium from rest; that from
one near it, some 20 mbar away, as in a search; and the latter with the Jacobian of its tip and the
stiffness in a direction.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import brace
import stiffopt
from report import table
from stiffopt.errors import EquilibriumError

CALLS, NEAR = 15, 2e3  # calls of a case, and Pa (RMS of a channel) to the equilibrium near by


def cpu_time(work: Callable[[], object]) -> float:
    """Median CPU time of calls, in ms."""
    times = []
    for _ in range(CALLS):
        began = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - began))
    return float(np.median(times))


def measured(robot: stiffopt.Manipulator, seed: int) -> list[float] | None:
    """The times of a case; None if no pressures of 20 touch its object once."""
    rng = np.random.default_rng([25, seed])
    scene = brace.task_of(brace.draw(seed)).scene
    assert scene is not None
    for p in rng.uniform(0, 1.2e5, (20, robot.n_pressures)):
        q = p + NEAR * rng.normal(size=len(p))
        try:
            eq = robot.contact_equilibrium(p, scene)
            if (
                len(eq.contacts)
                == len(robot.contact_equilibrium(q, scene, nearby=eq).contacts)
                == 1
            ):
                break
        except EquilibriumError:
            continue
    else:
        return None

    def with_slopes() -> object:
        near = robot.contact_equilibrium(q, scene, nearby=eq)
        return near.tip_jacobian, near.stiffness([1, 0, 0])

    return [
        cpu_time(lambda: robot.contact_equilibrium(p, scene)),
        cpu_time(lambda: robot.contact_equilibrium(q, scene, nearby=eq)),
        cpu_time(with_slopes),
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    given = parser.parse_args()
    robot = stiffopt.load_robot(brace.ROBOT)
    rows = [measured(robot, seed) for seed in range(given.first, given.first + given.cases)]
    times = np.array([row for row in rows if row is not None])
    named = zip(("from rest", "near by", "with slopes"), times.T, strict=True)
    lines = [
        [name, f"{np.median(own):.2f}", f"{own.min():.2f}", f"{own.max():.2f}"]
        for name, own in named
    ]
    print("\n".join(table(["equilibrium", "median, ms", "least", "most"], lines)))
    print(f"{len(times)} of {given.cases} cases touch their object once")


if __name__ == "__main__":
    main()
