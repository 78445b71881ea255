"""Compare the closed loop on the simulated rig with integral feedback and the model alone.

    python benchmarks/control.py --cases 20 --seed 1 --jobs 2 --out out/bench/control.json

Each case has its own arm (see `control_cases.py`), start and targets, the same for all controllers.
The controllers use the rig through its usual interface; only the evaluation uses the truth. Prints
a table with the controllers side by side. ``--robot-file`` chooses their robot file: the nominal
one; one that stiffopt's calibration made from a recording of that arm (some minutes per arm;
``--keep`` stores it, so that a run can be resumed); or one with the arm's true values, as far as it
has keys for them. With ``--payload`` the tip carries more than the robot file says; with ``--loop``
the whole control loop with its safety gate runs, not the controller alone; with ``--paths``
figures-of-eight are followed instead of targets. ``--robot``, ``--modulus`` and ``--steps`` draw
other arms and steps: another robot file, a certain error of the modulus, longer ways.

Metrics: settling to 1 mm, for good, over the ideal: the settling time of an open-loop step to the
arm's own stiffest pressures, without inertia, creep and hysteresis. Steady: mean error of the last
2 of 10 s. Kept: (k - k_min) / (k_max - k_min) of the stiffness k along the task's direction, where
k_min and k_max are over all pressures that hold the tip at its final place: by the true model
(linear silicone), and by pushing the simulated arm.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from control_baselines import CONTROLLERS
from control_cases import (
    DEMANDS,
    DYNAMICS,
    STEPS,
    Case,
    at_tip_speed,
    demanding,
    draw_case,
    draw_path,
    with_calibrated_file,
    with_true_file,
)
from control_runs import Follow, Step, run_case, run_path
from report import table

ROBOT_FILES = ("nominal", "calibrated", "true")
STEADY_BAR = {"quasi-static": 1e-4, "full": 3e-4}
PATH_BAR = {"quasi-static": 1.0, "full": 1.5}  # mm


def one_case(
    seed: int,
    *,
    controllers: Sequence[str],
    dynamics: Sequence[str],
    targets: int,
    payload: float,
    robot_file: str,
    keep: Path | None,
    paths: bool,
    in_loop: bool,
    tip_speed: float | None,
    demand: tuple[str | None, float],
    drawn: dict[str, Any],
) -> list[Step | Follow]:
    """All that one arm has to show."""
    case = draw_case(seed, 1 if paths else targets, payload, **drawn)
    case = with_file(case, robot_file, keep)
    case = demanding(at_tip_speed(case, tip_speed), *demand)
    found: list[Step | Follow] = []
    path = draw_path(case) if paths else None
    for kind in dynamics:
        for name in controllers:
            if path is not None:
                found.append(run_path(case, path, name, CONTROLLERS[name], kind, in_loop))
            else:
                found += run_case(case, name, CONTROLLERS[name], kind, in_loop)
    return found


def with_file(case: Case, robot_file: str, keep: Path | None) -> Case:
    """The case whose controller gets one of `ROBOT_FILES`; a calibrated one is kept in a folder."""
    if robot_file == "calibrated":
        with nullcontext(keep) if keep else TemporaryDirectory() as folder:
            return with_calibrated_file(case, Path(folder))
    return with_true_file(case) if robot_file == "true" else case


def in_processes(work: Any, seeds: Sequence[int], jobs: int) -> Iterable[Any]:
    """Results of the seeds, as they come."""
    if jobs <= 1:
        yield from map(work, seeds)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(work, seeds)


# -- tables ------------------------------------------------------------------------------------


def step_rows(steps: Sequence[Step], dynamics: str) -> list[tuple[str, str]]:
    """Measures and what was found for one controller and kind of plant."""

    def of(name: str, share: Sequence[Step] = steps) -> Any:
        return np.array([getattr(step, name) for step in share], float)

    settling, steady = of("settling"), of("steady")
    rows = [
        ("unstable steps", f"{_percent(of('unstable') > 0)}"),
        ("at a limit without saying so", f"{_percent(of('unsaid') > 0)}"),
        (
            "ticks that broke limits or slew; without an answer",
            f"{of('broken').sum():.0f}; {of('unsound').sum():.0f}",
        ),
        (
            f"steady error, mm, median / p90 / p95 (bar {1e3 * STEADY_BAR[dynamics]:g})",
            _quantiles(1e3 * steady, (0.5, 0.9, 0.95), 3),
        ),
        ("steady error below the bar", _percent(steady <= STEADY_BAR[dynamics])),
        ("settled", _percent(np.isfinite(settling))),
        ("settled within 3 s, 5 s", f"{_percent(settling <= 3)}, {_percent(settling <= 5)}"),
        ("settling, s, median / p90", _quantiles(settling, (0.5, 0.9), 2)),
        (
            "settling over ideal, median / p90",
            _quantiles(settling / of("ideal"), (0.5, 0.9), 2),
        ),
        ("overshoot, mm, median / p90", _quantiles(1e3 * of("overshoot"), (0.5, 0.9), 2)),
        ("motion after 6 s, mm, median / p90", _quantiles(1e3 * of("motion"), (0.5, 0.9), 2)),
    ]  # fmt: skip
    for kind in ("axial", "lateral"):
        mine = [step for step in steps if step.kind == kind]
        for name, judge in (("kept", "true model"), ("kept_by_arm", "arm itself")):
            if mine:
                kept = of(name, mine)
                words = f"{np.median(kept):.3f} / {_percent(kept >= 0.9)}"
                rows.append((f"stiffness kept, {kind} ({judge}), median / share from 0.9", words))
    rows += [
        ("ticks with a channel at a limit", _percent(of("at_limit"))),
        ("tick, us, median", f"{1e6 * np.median(of('tick_time')):.0f}"),
        ("steps", str(len(steps))),
    ]
    return rows


def path_rows(follows: Sequence[Follow], dynamics: str) -> list[tuple[str, str]]:
    """The same for figures-of-eight."""

    def of(name: str) -> Any:
        return np.array([getattr(follow, name) for follow in follows])

    bar = PATH_BAR[dynamics]
    return [
        ("RMS, mm, median / p90", _quantiles(1e3 * of("plain"), (0.5, 0.9), 2)),
        (
            f"RMS after the known delay, mm, median / p90 (bar {bar:g})",
            _quantiles(1e3 * of("known"), (0.5, 0.9), 2),
        ),
        ("RMS after the best latency, mm", _quantiles(1e3 * of("best"), (0.5, 0.9), 2)),
        ("best latency, ms", _quantiles(1e3 * of("latency"), (0.5, 0.9), 0)),
        ("below the bar", _percent(1e3 * of("known") <= bar)),
        ("paths", str(len(follows))),
    ]


def _quantiles(values: Any, shares: Sequence[float], digits: int) -> str:
    found = np.quantile(values, shares, method="inverted_cdf")
    return " / ".join(f"{v:.{digits}f}" if np.isfinite(v) else "never" for v in found)


def _percent(flags: Any) -> str:
    return f"{100 * np.mean(flags):.3g} %"


def tables(found: Sequence[Step | Follow]) -> str:
    """Markdown: one table for each kind of plant, a column for each controller."""
    lines = []
    for dynamics in DYNAMICS:
        own = [each for each in found if each.dynamics == dynamics]
        names = list(dict.fromkeys(each.controller for each in own))
        if not names:
            continue
        columns = []
        for name in names:
            mine = [each for each in own if each.controller == name]
            of: Any = path_rows if isinstance(mine[0], Follow) else step_rows
            columns.append(dict(of(mine, dynamics)))
        rows = [(what, *(column.get(what, "-") for column in columns)) for what in columns[0]]
        lines += [f"### plant: {dynamics}", "", *table(("measure", *names), rows), ""]
    return "\n".join(lines)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = list(CONTROLLERS)
    parser.add_argument("--cases", type=int, default=10, help="arms")
    parser.add_argument("--seed", type=int, default=1, help="of the first; the others follow")
    parser.add_argument("--targets", type=int, default=3, help="of each arm")
    parser.add_argument("--dynamics", nargs="+", choices=DYNAMICS, default=list(DYNAMICS))
    parser.add_argument("--controller", nargs="+", choices=names, default=names)
    parser.add_argument("--payload", type=float, default=0.0, help="unknown mass at the tip, kg")
    parser.add_argument("--robot-file", choices=ROBOT_FILES, default=ROBOT_FILES[0])
    parser.add_argument("--keep", type=Path, help="keep calibrated files here and use them again")
    parser.add_argument("--paths", action="store_true", help="figures-of-eight, not targets")
    parser.add_argument("--loop", action="store_true", help="in the whole control loop")
    parser.add_argument("--tip-speed", type=float, help="`control.tip_speed` of the rig, in m/s")
    parser.add_argument("--demand", choices=DEMANDS, help="of the tasks, instead of the stiffest")
    parser.add_argument("--share", type=float, default=0.8, help="of the best, that is demanded")
    parser.add_argument("--robot", help="nominal robot file, if not that of the rig")
    parser.add_argument("--modulus", type=float, help="of the arms, over that of the file")
    parser.add_argument(
        "--steps", type=float, nargs=2, default=STEPS, help="between two targets, least and most, m"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, help="JSON file for all that was measured")
    given = parser.parse_args()
    begin = perf_counter()
    seeds = range(given.seed, given.seed + given.cases)
    work = partial(
        one_case, dynamics=given.dynamics, targets=given.targets, controllers=given.controller,
        payload=given.payload, robot_file=given.robot_file, keep=given.keep, paths=given.paths,
        in_loop=given.loop, tip_speed=given.tip_speed, demand=(given.demand, given.share),
        drawn={"robot_file": given.robot, "modulus": given.modulus, "steps": given.steps},
    )  # fmt: skip
    found: list[Any] = []
    for part in in_processes(work, seeds, given.jobs):
        found += part
        print(f"# seed {part[0].seed} done, {perf_counter() - begin:.0f} s", file=sys.stderr)
        if given.out is not None:
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps([asdict(each) for each in found], default=float))
    print(tables(found))
    return 0


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    sys.exit(main())
