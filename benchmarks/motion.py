"""Compare controllers on arms with inertia: settling of the tip, and error along paths.

    python benchmarks/motion.py --cases 12 --seed 7100 --jobs 2 --out out/bench/motion.json

Arms, targets and the ideal step are those of `control.py`. *Settling* is the time until the tip
stays within 1 mm of its target to the end of the step; *ideal* is that of an open-loop step to the
arm's own stiffest pressures without inertia, creep and hysteresis: the regulators alone.
*Overshoot* is the distance of the tip beyond the target along the step; it is acceptable up to the
larger of 5 % of the step and 0.5 mm. *Doubts* are steps after which the motion watch doubts.

``commissioned`` is the loop after ``stiffopt commission --quick`` of that arm, with the measured
frequency and damping of its swing, and the moduli and gains that its steps imply. ``--speeds`` also
follows figures-of-eight of 40 mm at these speeds in m/s: root mean square error at the time,
for the known delay of a trajectory's beginning, and for the best latency.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

import control_runs
from control import in_processes
from control_baselines import PERIOD, MakeController, integral_controller
from control_cases import Case, Path8, draw_case, draw_path, settling_time
from control_runs import Follow, run_path, started
from report import table
from stiffopt import RobotDescription, load_robot
from stiffopt.commissioning.commission import evaluate, record_of
from stiffopt.commissioning.expected import expected_steps
from stiffopt.commissioning.procedure import run_steps
from stiffopt.commissioning.record import CommissioningRecord, with_measured_steps
from stiffopt.control.controller import TipController
from stiffopt.control.interface import Controller
from stiffopt.control.tuning import ControlTuning
from stiffopt.rig.interface import Rig
from stiffopt.safety.rigs import rig_for_programs

DYNAMICS = "full"
HOLD = 5.0  # s of a step
STAYS = 0.2  # s at the end in which the tip must not leave the target again
OVERSHOOT = (0.05, 5e-4)  # share of a step, and m


@dataclass(frozen=True)
class Motion:
    """What a step was worth; SI units."""

    seed: int
    number: int
    variant: str
    distance: float
    settling: float
    ideal: float
    overshoot: float
    doubted: bool
    tick_time: float

    @property
    def kept(self) -> bool:
        """Whether it did not go too far."""
        share, least = OVERSHOOT
        return self.overshoot <= max(share * self.distance, least)


def record_of_case(case: Case) -> CommissioningRecord:
    """Commission a case's arm."""
    plant = case.description.plant.model_copy(update={"dynamics": DYNAMICS})
    rig: Any = rig_for_programs(case.description.model_copy(update={"plant": plant}), case.robot)
    expected = expected_steps(rig.robot, rig.supply.limits)
    with TemporaryDirectory() as folder, rig:
        readings = run_steps(rig, expected, Path(folder), rate=100, quick=True)
        return record_of(rig, evaluate(rig, expected, readings, quick=True))


def controller_of(
    tuning: ControlTuning | None, record: CommissioningRecord | None
) -> MakeController:
    """Return how the loop's controller is made, with a tuning and what commissioning found."""

    def make(rig: Rig, robot: RobotDescription, dynamics: str) -> Controller:
        control = rig.settings.control
        if record is not None and record.swing is not None:
            swing = {"frequency": record.swing.frequency, "damping": record.swing.damping}
            control = control.model_copy(update=swing)
            robot = with_measured_steps(robot, record)
        return TipController(
            load_robot(robot), rig.supply.limits, rig.slew, period=PERIOD, control=control,
            safety=rig.settings.safety, vibrates=dynamics == DYNAMICS, slow_first_motion=False,
            tuning=tuning,
        )  # fmt: skip

    return make


def variants(record: CommissioningRecord) -> dict[str, MakeController]:
    """Controllers that are compared, by name."""
    usual = ControlTuning()

    def tuned(part: str, **numbers: float) -> ControlTuning:
        return replace(usual, **{part: replace(getattr(usual, part), **numbers)})

    return {
        "nominal": controller_of(None, None),
        "commissioned": controller_of(None, record),
        "commissioned, slower reference": controller_of(
            tuned("reference", vibrating_rate=1.2), record
        ),
        "commissioned, faster reference": controller_of(
            tuned("reference", vibrating_rate=1.8), record
        ),
        "commissioned, less damping": controller_of(tuned("feedback", effort=3.0), record),
        "integral": integral_controller,
    }


def steps_of(case: Case, variant: str, make: MakeController) -> list[Motion]:
    """Go from target to target."""
    found = []
    with started(case, make, DYNAMICS, False) as run:
        before = run.tip()
        for number, aim in enumerate(case.aims):
            run.set_task(case.task(aim.position, aim.kind))
            trace = run.go(HOLD)
            way = aim.position - before
            distance = float(np.linalg.norm(way))
            along = (trace.tips - aim.position) @ way / distance
            errors = np.linalg.norm(trace.tips - aim.position, axis=1)
            found.append(
                Motion(
                    case.seed, number, variant, distance,
                    settling_time(trace.times, errors, STAYS), aim.ideal,
                    float(max(along.max(), 0.0)), any(n.hold for n in run.notices()),
                    float(np.median(trace.took)),
                )
            )  # fmt: skip
            before = aim.position
    return found


def faster(path: Path8, speed: float) -> Path8:
    """The same figure-eight at another speed, in m/s, with waypoints a tenth of a second apart."""
    way = np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum()
    times = path.times * (way / speed) / path.times[-1]
    fine = np.linspace(0, times[-1], max(3, round(times[-1] / 0.1) + 1))
    return Path8(fine, np.stack([np.interp(fine, times, x) for x in path.positions.T], axis=1))


def one_case(seed: int, *, names: list[str], targets: int, speeds: list[float]) -> list[Any]:
    """All that one arm has to show."""
    case = draw_case(seed, targets)
    makers = {name: make for name, make in variants(record_of_case(case)).items() if name in names}
    found: list[Any] = []
    path = draw_path(case) if speeds else None
    for name, make in makers.items():
        found += steps_of(case, name, make)
        for speed in speeds:
            assert path is not None
            label = f"{name} at {1e3 * speed:g} mm/s"
            found.append(run_path(case, faster(path, speed), label, make, DYNAMICS))
    return found


def _quantiles(values: NDArray[np.float64], digits: int) -> str:
    found = np.quantile(values, (0.5, 0.9), method="inverted_cdf")
    return " / ".join(f"{v:.{digits}f}" if np.isfinite(v) else "never" for v in found)


def tables(found: list[Any]) -> str:
    """Markdown: a row for each variant, and for each variant and speed."""
    steps = [each for each in found if isinstance(each, Motion)]
    rows = []
    for name in dict.fromkeys(step.variant for step in steps):
        own = [step for step in steps if step.variant == name]
        settling = np.array([step.settling for step in own])
        ideal = np.array([step.ideal for step in own])
        beyond = np.array([step.overshoot for step in own])
        rows.append((
            name, _quantiles(settling / ideal, 2), _quantiles(settling, 2),
            f"{100 * np.mean([step.kept for step in own]):.0f} %", _quantiles(1e3 * beyond, 1),
            str(sum(step.doubted for step in own)),
            f"{1e6 * np.median([step.tick_time for step in own]):.0f}",
        ))  # fmt: skip
    titles = (
        "loop", "settling over ideal, median / p90", "settling, s", "overshoot kept",
        "overshoot, mm", "doubts", "tick with plans, us",
    )  # fmt: skip
    lines = list(table(titles, rows))
    follows = [each for each in found if isinstance(each, Follow)]
    rows = []
    for name in dict.fromkeys(each.controller for each in follows):
        own_follows = [each for each in follows if each.controller == name]
        rows.append((
            name,
            *(
                _quantiles(1e3 * np.array([getattr(each, key) for each in own_follows]), 2)
                for key in ("plain", "known", "best", "latency")
            ),
        ))  # fmt: skip
    if rows:
        titles_of_paths = (
            "loop",
            "RMS, mm",
            "after the known delay",
            "after the best",
            "best latency, ms",
        )
        lines += ["", *table(titles_of_paths, rows)]
    return "\n".join(lines)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=12, help="arms")
    parser.add_argument("--seed", type=int, default=7100, help="of the first; the others follow")
    parser.add_argument("--targets", type=int, default=3, help="of each arm")
    parser.add_argument("--variant", nargs="+", default=["nominal", "commissioned", "integral"])
    parser.add_argument("--speeds", nargs="*", type=float, default=[], help="of paths, m/s")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, help="JSON file for all that was measured")
    given = parser.parse_args()
    control_runs.SETTLE_FIRST = HOLD
    work = partial(one_case, names=given.variant, targets=given.targets, speeds=given.speeds)
    found: list[Any] = []
    for part in in_processes(work, range(given.seed, given.seed + given.cases), given.jobs):
        found += part
        print(f"# seed {part[0].seed} done", file=sys.stderr)
        if given.out is not None:
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps([asdict(each) for each in found], default=float))
    print(tables(found))
    return 0


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    sys.exit(main())
