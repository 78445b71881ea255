"""Measure which faults the control loop detects on simulated arms; pushes must not be detected.

    python benchmarks/disturbances.py --cases 4 --seed 500
    python benchmarks/disturbances.py --in-use --rows narrow kinked --cases 4 --seed 500 700
    python benchmarks/disturbances.py --commission --cases 4 --seed 500

Arms and targets are those of `control_cases.py`; the controller has the nominal robot file. In each
run the arm goes to a first target and rests there; then a fault begins, and four seconds later a
second target follows. Faults of the set-up are there from the beginning. Columns: number of runs
that detected the fault, and as what; longest time from its beginning to detection (for faults that
only show in motion, from the second target; negative if it was detected before; for leaks, from
the moment when the channel has pressure to lose, a command above 0.2 bar, or 0.03 bar for a burst);
two largest distances of the tip over all runs, in mm, until it is vented; and the state in the end.
The first distance is from the way that the tip takes without a fault (but with a push that the row
has too). The second is what the loop causes of it: the distance from that way and from the one on
which the fault alone takes the tip, with the commands frozen from its beginning. They differ where
a chamber bursts or leaks, or something pushes the arm; all that follows from commands after the
beginning of the fault counts, also before the fault is visible. A push or a payload must not be
detected as a fault. Below each row on the way, both distances of each run, and what was told.

With `--in-use`, motions are fast from the beginning, as of an arm that has moved since it was
armed. The table then has a line for each arm and a column for each row: what the loop causes, in
mm, and when it was told, as what; and last the time to the second target without a fault, until the
tip stays within 1 mm. With `--post`, the controller keeps clear of a post beside the arm, which
leaves room for every motion. `--robot` and `--steps` draw other arms and steps, and with `--demand`
tasks demand a share of the best stiffness. With `--commission`, `stiffopt commission --quick` looks
for the faults of the set-up instead: its first finding, whether it permits arming, and how far the
tip moved from rest.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from control_baselines import PERIOD
from control_cases import (
    DEMANDS,
    DYNAMICS,
    STEPS,
    Case,
    at_tip_speed,
    beside,
    demanding,
    draw_case,
    settling_time,
)
from control_runs import STAYS, LoopRun
from disturbance_rows import ROWS, Row
from report import table
from stiffopt import Scene, load_robot
from stiffopt.commissioning.commission import evaluate
from stiffopt.commissioning.expected import expected_steps
from stiffopt.commissioning.procedure import DangerError, run_steps
from stiffopt.control.controller import TipController
from stiffopt.control.state import State
from stiffopt.errors import CommandError, InputError
from stiffopt.safety.rigs import gated_rig

Array = NDArray[np.float64]

POST = Scene(
    clearance=1e-3,
    objects=[{"name": "post", "sphere": {"centre": (0.2, 0.2, 0.1), "radius": 0.008}}],
)
REST, BEFORE = 3.0, 4.0  # s: at the first target, and with the fault there
AFTER, END = 3.0, 16.0  # s: at the second target, and until a hold has ended
DOUBTS = (
    "no-response",
    "slip",
    "weak",
    "drift",
    "swing",
    "implausible",
    "leak",
    "lost-channel",
    "channel-opposed",
    "shortfall",
    "missing-motion",
    "slow-channel",
    "regulator-stuck",
    "pressure-reading",
    "tracker-jumps",
    "tracker-times",
    "tracker-lost",
    "unreachable",
)
SET_UP = ("uncommissioned", *DOUBTS)  # what is told of faults of the set-up, also at arming
FAULTS = ("leak", "regulator-stuck", "pressure-reading", "tracker-jumps", "guard", "device")


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    Attributes
    ----------
    told : when a fault was detected, in s since its beginning; infinite if it was not.
    kind : as what it was detected.
    tips : of the arm (T, 3), from the beginning of the fault, in m.
    end : state in the end.
    words : of what was told first.
    """

    told: float
    kind: str
    tips: Array
    end: str
    words: str = ""


def run_row(
    case: Case, row: Row, dynamics: str, *, in_use: bool = False, frozen: bool = False
) -> Outcome:
    """Run one row on one arm.

    `in_use`: no channel is slow at first; `frozen`: without the loop from the beginning of the
    fault.
    """
    plant = case.description.plant.model_copy(update={"faults": True})
    tracker = case.description.tracker.model_copy(update={"noise": row.noise})
    description = case.description.model_copy(update={"plant": plant, "tracker": tracker})
    case = replace(case, description=description)
    rig: Any = case.rig(dynamics)
    rig.next_goal = case.aims[1].position
    controller = TipController(
        load_robot(case.believed), rig.supply.limits, rig.slew, period=PERIOD,
        control=rig.settings.control, safety=rig.settings.safety, vibrates=dynamics == "full",
        slow_first_motion=not in_use, scene=case.description.scene,
    )  # fmt: skip
    run = LoopRun(rig, controller, case.point)
    try:
        if row.at_once:
            row.begin(rig)
        try:
            run.start()
        except InputError:
            return Outcome(0.0, "refused", np.empty((0, 3)), "refused")
        run.go(0.3)
        began = begin = rig.clock.now()
        _try_task(run, case, 0)
        traces = [run.go(REST)]
        if not row.at_once:
            began = begin = rig.clock.now()
            row.begin(rig)
            if frozen:
                before, _ = _tips_alone(rig, BEFORE), row.then(rig)
                alone = np.concatenate([before, _tips_alone(rig, AFTER)])
                return Outcome(np.inf, "", alone, "frozen")
            traces = [*traces[: row.name == "nothing"], run.go(BEFORE)]
        if run.loop.snapshot().state is State.ACTIVE:
            if row.shows_in_motion:
                begin = rig.clock.now()
            row.then(rig)
            _try_task(run, case, 1)
            traces.append(run.go(AFTER))
        if row.shows_above:
            high = np.concatenate([t.commands for t in traces])[:, 1] > row.shows_above
            begin = began + PERIOD * float(np.argmax(high))
        ended = rig.clock.now()
        for _ in range(round(END)):
            if run.loop.snapshot().state is State.HOLDING:
                run.go(1.0)
        events, _ = run.loop.events.since(0)
        kinds = DOUBTS if row.is_fault else DOUBTS[:-1]  # what is pushed may reach less
        if row.at_once:
            kinds, since = SET_UP, -np.inf
        else:
            since = began
        told = [event for event in events if event.kind in kinds and event.time >= since]
        ways = np.concatenate([trace.tips for trace in traces])
        if run.loop.snapshot().state is State.FAULT:  # venting takes the arm to rest
            after = ended - next(e.time for e in events if e.kind in FAULTS)
            ways = ways[: len(ways) - max(0, round(after / PERIOD))]
        return Outcome(
            told=told[0].time - begin if told else np.inf,
            kind=told[0].kind if told else "",
            tips=ways,
            end=run.loop.snapshot().state.value,
            words=told[0].text if told else "",
        )
    finally:
        run.close()


def _tips_alone(rig: Any, duration: float) -> Array:
    """Return the tips (T, 3) of an arm whose commands do not change."""
    commands, tips = rig.world.set_point.copy(), []
    for _ in range(round(duration / PERIOD)):
        rig.clock.sleep(PERIOD)
        rig.supply.exchange(commands)  # otherwise its watchdog vents
        tips.append(rig.world.plant.tip_pose()[:3, 3].copy())
    return np.array(tips)


def _try_task(run: LoopRun, case: Case, number: int) -> None:
    with suppress(CommandError):  # it is let down
        run.set_task(case.task(case.aims[number].position, case.aims[number].kind))


def run_commissioning(case: Case, row: Row) -> tuple[str, bool, float]:
    """First finding of a quick commissioning, whether it permits arming, and the way in m."""
    rig: Any = case.rig("quasi-static")
    gated_rig(rig, rig.settings.safety, PERIOD)
    with rig, tempfile.TemporaryDirectory() as folder:
        row.begin(rig)
        expected = expected_steps(rig.robot, rig.supply.limits)
        rest, tips = rig.world.plant.tip_pose()[:3, 3].copy(), []
        try:
            readings = run_steps(
                rig, expected, Path(folder), rate=1 / PERIOD, quick=True,
                check=lambda: tips.append(rig.world.plant.tip_pose()[:3, 3].copy()),
            )  # fmt: skip
            found = evaluate(rig, expected, readings, quick=True)
            first, fits = found.findings[0].text if found.findings else "nothing", found.fits
        except DangerError as error:
            first, fits = str(error), False
    return first, fits, float(np.linalg.norm(np.array(tips) - rest, axis=1).max())


def _commissioned(cases: list[Case], rows: list[Row]) -> list[list[str]]:
    """Lines of the table of commissioning."""
    lines = []
    for row in rows:
        found = [run_commissioning(case, row) for case in cases]
        refused = sum(not fits for _, fits, _ in found)
        way = 1e3 * max(way for _, _, way in found)
        lines.append([row.name, f"{refused} of {len(found)}", f"{way:.1f}", found[0][0]])
        print(lines[-1], flush=True)
    return lines


def _looped(cases: list[Case], rows: list[Row], dynamics: str) -> list[list[str]]:
    """Lines of the table of the control loop."""
    lines = []
    usual = [run_row(case, ROWS[-1], dynamics) for case in cases]
    for row in rows:
        pairs = zip(cases, usual, strict=True)
        judged = [_judged(case, row, dynamics, alone) for case, alone in pairs]
        found = [outcome for outcome, _, _ in judged]
        noticed = [outcome for outcome in found if outcome.kind]
        kinds = Counter(outcome.kind for outcome in noticed)
        ends = Counter(outcome.end for outcome in found)
        off = [each[1:] for each in judged]
        whole, caused = np.max(off, axis=0)
        lines.append([
            row.name,
            f"{len(noticed)} of {len(found)}{'' if row.is_fault else ' (none should)'}",
            ", ".join(f"{kind} {count}" for kind, count in kinds.most_common()),
            f"{max((o.told for o in noticed), default=np.nan):.2f}",
            f"{1e3 * whole:.1f}",
            f"{1e3 * caused:.1f}",
            ", ".join(f"{end} {count}" for end, count in ends.most_common()),
        ])  # fmt: skip
        each = ", ".join(f"{1e3 * a:.1f} ({1e3 * b:.1f})" for a, b in off)
        words = sorted({outcome.words[:160] for outcome in found})
        print(lines[-1], each, *words, sep="\n    ", flush=True)
    return lines


def _in_use(case: Case, rows: list[Row], dynamics: str) -> list[str]:
    """Line of the table of arms in use."""
    usual = run_row(case, ROWS[-1], dynamics, in_use=True)
    line = [str(case.seed)]
    for row in rows:
        found, _, caused = _judged(case, row, dynamics, usual, in_use=True)
        told = f"{found.told:.2f}, {found.kind}" if found.kind else "not told"
        line.append(f"{1e3 * caused:.1f} ({told})")
        print(case.seed, row.name, line[-1], found.end, found.words[:160], sep="; ", flush=True)
    ticks = round(AFTER / PERIOD)
    errors = np.linalg.norm(usual.tips[-ticks:] - case.aims[1].position, axis=1)
    settled = settling_time(PERIOD * (1 + np.arange(ticks)), errors, STAYS)
    return [*line, f"{settled:.2f}" if np.isfinite(settled) else "never"]


def _judged(
    case: Case, row: Row, dynamics: str, usual: Outcome, in_use: bool = False
) -> tuple[Outcome, float, float]:
    """Outcome of a row, the tip's largest distance from its way, and what the loop causes of it.

    `usual`: without a fault; the distances are in m.
    """
    outcome = run_row(case, row, dynamics, in_use=in_use)
    if not len(outcome.tips):
        return outcome, 0.0, 0.0
    if row.usual is not None:
        usual = run_row(case, replace(ROWS[-1], begin=row.usual), dynamics, in_use=in_use)
    alone = _with_fault(case, row, dynamics, usual.tips, in_use)
    return outcome, _farthest(outcome.tips, usual.tips), _farthest(outcome.tips, alone)


def _with_fault(case: Case, row: Row, dynamics: str, way: Array, in_use: bool) -> Array:
    """Return a way (T, 3) and the places to which a fault alone brings the tip."""
    if row.at_once:  # nothing is commanded yet
        return way
    alone = run_row(case, row, dynamics, in_use=in_use, frozen=True)
    return np.concatenate([way, alone.tips])


def _farthest(tips: Array, way: Array) -> float:
    """Return the greatest distance of tips (T, 3) from a way (k, 3), in m."""
    return float(cKDTree(way).query(tips)[0].max())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=2)
    parser.add_argument("--seed", type=int, nargs="+", default=[500], help="of the first arms")
    parser.add_argument("--dynamics", choices=DYNAMICS, nargs="+", default=list(DYNAMICS))
    parser.add_argument("--rows", nargs="+", help="only rows whose name has one of these words")
    parser.add_argument("--commission", action="store_true", help="look for faults of the set-up")
    parser.add_argument("--in-use", action="store_true", help="fast from the start; a line an arm")
    parser.add_argument("--tip-speed", type=float, help="`control.tip_speed` of the rig, in m/s")
    parser.add_argument("--robot", help="nominal robot file, if not that of the rig")
    parser.add_argument(
        "--steps", type=float, nargs=2, default=STEPS, help="between two targets, least and most, m"
    )
    parser.add_argument("--post", action="store_true", help="with a scene: a post beside the arm")
    parser.add_argument("--demand", choices=DEMANDS, help="of the tasks, instead of the stiffest")
    parser.add_argument("--share", type=float, default=0.8, help="of the best, that is demanded")
    arguments = parser.parse_args()
    seeds = [first + case for first in arguments.seed for case in range(arguments.cases)]
    drawn = [
        draw_case(seed, 2, ranked=False, robot_file=arguments.robot, steps=tuple(arguments.steps))
        for seed in seeds
    ]
    cases = [at_tip_speed(case, arguments.tip_speed) for case in drawn]
    cases = [demanding(case, arguments.demand, arguments.share) for case in cases]
    if arguments.post:
        cases = [beside(case, POST) for case in cases]
    words = arguments.rows or [""]
    n = min(case.robot.n_pressures for case in cases)
    rows = [row for row in ROWS if row.channels <= n and any(word in row.name for word in words)]
    if arguments.commission:
        lines = _commissioned(cases, [row for row in rows if row.at_once])
        print("\n".join(table(["what", "refused", "way, mm", "first finding"], lines)))
        return
    head = ["what", "noticed", "as", "told, s", "off its way, mm", "by the loop, mm", "ends"]
    if arguments.in_use:
        head = ["arm", *(row.name for row in rows), "settling, s"]
    for dynamics in arguments.dynamics:
        if arguments.in_use:
            lines = [_in_use(case, rows, dynamics) for case in cases]
        else:
            lines = _looped(cases, rows, dynamics)
        print(f"\n### plant: {dynamics}\n", *table(head, lines), sep="\n")


if __name__ == "__main__":
    main()
