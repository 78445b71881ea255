"""Measure which faults the control loop detects on simulated arms; pushes must not be detected.

    python benchmarks/disturbances.py --cases 4 --seed 500

Arms and targets are those of `control_cases.py`; the controller has the nominal robot file. In each
run the arm goes to a first target and rests there; then a fault begins, and four seconds later a
second target follows. Columns: number of runs that detected the fault, and as what; time from its
beginning to detection (for faults that only show in motion, from the second target); largest
distance of the tip from its way, until it was let down, over all runs, in mm; and number of arms
that were vented in the end. A push or a payload must not be detected as a fault.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from control_baselines import PERIOD
from control_cases import DYNAMICS, Case, draw_case
from control_runs import LoopRun
from report import table
from stiffopt import load_robot
from stiffopt.control.controller import TipController
from stiffopt.control.state import State
from stiffopt.errors import CommandError
from stiffopt.plant.settings import PlantLoad

Array = NDArray[np.float64]

REST, BEFORE, AFTER = 3.0, 4.0, 16.0  # s: at the first target, with the fault there, and after
DOUBTS = (
    "no-response",
    "slip",
    "drift",
    "swing",
    "implausible",
    "leak",
    "lost-channel",
    "shortfall",
    "regulator-stuck",
    "tracker-jumps",
)


@dataclass(frozen=True)
class Row:
    """Something that goes wrong, or only seems to.

    Attributes
    ----------
    name : for the table.
    begin : lets it begin on a run.
    at_once : whether it is there from the beginning, before anything moves.
    shows_in_motion : whether it can be noticed only while the tip is to move.
    is_fault : whether it is to be noticed.
    noise : of the tracker, in m, if not as usual.
    """

    name: str
    begin: Callable[[LoopRun], object]
    at_once: bool = False
    shows_in_motion: bool = False
    is_fault: bool = True
    noise: float = 5e-5


def _tracker(fault: str) -> Callable[[LoopRun], object]:
    return lambda run: run.rig.world.inject("tracker", fault)


def _push(*force: float) -> Callable[[LoopRun], object]:
    return lambda run: run.rig.world.plant.set_load(PlantLoad(force=force))


def _push_halfway(force: float) -> Callable[[LoopRun], object]:
    def push(run: LoopRun) -> None:
        at = run.rig.robot.length / 2
        run.rig.world.plant.set_load(PlantLoad(force=(force, 0.0, 0.0), at=at))

    return push


def _slipped(*way: float) -> Callable[[LoopRun], object]:
    """Move the sensor on the tip, in its own axes."""

    def slip(run: LoopRun) -> None:
        camera = run.rig.world.camera
        see = camera.sensor_in_tracker
        moved = np.eye(4)
        moved[:3, 3] = way
        camera.sensor_in_tracker = lambda: see() @ moved

    return slip


def _stuck(run: LoopRun) -> None:
    run.rig.world.inject("supply", "stuck", 1)


def _leaking(run: LoopRun) -> None:
    """A leak by which a regulator of 60 ms lag stays 6 % below its command."""
    run.rig.world._regulators.leak[1] = 1.0


def _nothing(run: LoopRun) -> None:
    pass


def _swapped(*order: int) -> Callable[[LoopRun], object]:
    """Feed the chambers from other regulators than the robot file says."""

    def swap(run: LoopRun) -> None:
        plant = run.rig.world.plant
        follow, n = plant.follow, len(run.rig.world.pressures)
        channels = [*order, *range(len(order), n)]
        plant.follow = lambda trace: follow(np.ascontiguousarray(trace[:, channels]))

    return swap


ROWS = (
    Row("channels 1 and 2 swapped", _swapped(1, 0), at_once=True),
    Row("channels 1 and 4 swapped", _swapped(3, 1, 2, 0), at_once=True),
    Row("sensor has come off, lies still", _tracker("loose"), shows_in_motion=True),
    Row("tracker drifts by 5 mm/s", _tracker("drifting")),
    Row("sensor slips by 10 mm", _slipped(0.006, -0.008, 0.0)),
    Row("tracker's frame turns by 3 deg/s", _tracker("turning")),
    Row("tracker is 0.1 s later every second", _tracker("lagging"), shows_in_motion=True),
    Row("tip shakes by 10 mm at 3 Hz", _tracker("shaking")),
    Row("a regulator keeps its pressure", _stuck, shows_in_motion=True),
    Row("a leak that the regulator feeds", _leaking),
    Row("a push of 20 mN", _push(0.02, 0.0, 0.0), is_fault=False),
    Row("a push of 30 mN halfway along", _push_halfway(0.03), is_fault=False),
    Row("a push of 50 mN", _push(0.0, -0.05, 0.0), is_fault=False),
    Row("a payload of 10 g", _push(0.0, 0.0, 0.0981), is_fault=False),
    Row("tracker noise of 0.15 mm", _nothing, is_fault=False, noise=1.5e-4),
    Row("nothing", _nothing, is_fault=False),
)


@dataclass(frozen=True)
class Outcome:
    """What came of a run: when it was told, in s (infinite: never), and as what; mm; the end."""

    told: float
    kind: str
    off: float
    vented: bool


def run_row(case: Case, row: Row, dynamics: str) -> Outcome:
    """Run one row on one arm."""
    plant = case.description.plant.model_copy(update={"faults": True})
    tracker = case.description.tracker.model_copy(update={"noise": row.noise})
    description = case.description.model_copy(update={"plant": plant, "tracker": tracker})
    case = replace(case, description=description)
    rig = case.rig(dynamics)
    controller = TipController(
        load_robot(case.believed), rig.supply.limits, rig.slew, period=PERIOD,
        control=rig.settings.control, safety=rig.settings.safety, vibrates=dynamics == "full",
    )  # fmt: skip
    run = LoopRun(rig, controller, case.point)
    aims = case.aims
    try:
        if row.at_once:
            row.begin(run)
        run.start()
        run.go(0.3)
        begin, way = rig.clock.now(), [run.tip(), aims[0].position]
        run.set_task(case.task(aims[0].position, aims[0].kind))
        parts = [run.go(REST)]
        if not row.at_once:
            begin, way, parts = rig.clock.now(), [aims[0].position] * 2, []
            row.begin(run)
            parts.append(run.go(BEFORE))
            off = [_off(parts[0].tips, way)]
            if run.loop.snapshot().state is State.ACTIVE:
                if row.shows_in_motion:
                    begin = rig.clock.now()
                way = [run.tip(), aims[1].position]
                _try_task(run, case, 1)
                parts = [run.go(2.0)]
        else:
            off = []
        parts.append(run.go(AFTER))
        off += [_off(part.tips, way) for part in parts[:1]]
        events, _ = run.loop.events.since(0)
        told = [event for event in events if event.kind in DOUBTS]
        return Outcome(
            told=told[0].time - begin if told else np.inf,
            kind=told[0].kind if told else "",
            off=1e3 * max(off),
            vented=run.loop.snapshot().state in (State.INACTIVE, State.FAULT),
        )
    finally:
        run.close()


def _try_task(run: LoopRun, case: Case, number: int) -> None:
    with suppress(CommandError):  # it is let down
        run.set_task(case.task(case.aims[number].position, case.aims[number].kind))


def _off(tips: Array, way: list[Array]) -> float:
    """Largest distance of the tip (T, 3) from the straight way between two places, in m."""
    start, direction = way[0], way[1] - way[0]
    length = float(direction @ direction)
    share = (
        np.clip((tips - start) @ direction / length, 0, 1) if length > 0 else np.zeros(len(tips))
    )
    return float(np.linalg.norm(tips - start - share[:, None] * direction, axis=1).max())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=2)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--dynamics", choices=DYNAMICS, nargs="+", default=list(DYNAMICS))
    parser.add_argument("--rows", nargs="+", help="only rows whose name has one of these words")
    arguments = parser.parse_args()
    cases = [draw_case(arguments.seed + k, 2, ranked=False) for k in range(arguments.cases)]
    for dynamics in arguments.dynamics:
        lines = []
        for row in ROWS:
            if arguments.rows and not any(word in row.name for word in arguments.rows):
                continue
            found = [run_row(case, row, dynamics) for case in cases]
            noticed = [outcome for outcome in found if outcome.kind]
            kinds = Counter(outcome.kind for outcome in noticed)
            lines.append([
                row.name,
                f"{len(noticed)} of {len(found)}{'' if row.is_fault else ' (none should)'}",
                ", ".join(f"{kind} {count}" for kind, count in kinds.most_common()),
                f"{max((o.told for o in noticed), default=np.nan):.2f}",
                f"{max(o.off for o in found):.1f}",
                f"{sum(o.vented for o in found)}",
            ])  # fmt: skip
            print(lines[-1], flush=True)
        print(f"\n### plant: {dynamics}\n")
        print(
            "\n".join(
                table(["what", "noticed", "as", "told, s", "off its way, mm", "vented"], lines)
            )
        )


if __name__ == "__main__":
    main()
