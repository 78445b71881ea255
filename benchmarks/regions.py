"""Measure how often the tips of calibrated simulated arms lie in the regions of their predictions.

    python benchmarks/regions.py [--first SEED] [--arms N] [--rig NAME] [--auto] [--undriven]
    python benchmarks/regions.py --recordings DIR

Each seed gives another arm: mismatch (of every second one as `Spread` says, of the others as the
rig file says), silicone (drawn for two of four), lag and dead time. It is simulated without inertia
and with simple regulators, at a second of processor time. Its logs are one sweep of each channel
and 15 rounds of six held poses, one after another: two as in `experiment kinematics`, then 13 of
poses that each arm draws. All readings of one pose say little more than one of them does, and a
round is simulated sooner than another arm is fitted. Robot files are fitted to the sweeps and two
rounds, and to the sweeps alone, so that all rounds are extrapolated. Prints the share of readings
of the other rounds within the regions of 50, 68, 90, 95 and 99 %, all arms together, with 95 %
intervals by a bootstrap over arms.

With `--undriven` the last channel has no pressure in the logs of a fit, so that what it does is
known by the robot file's tolerances alone. All rows of an arm share that one error, so each fit is
tested on five arms, whose last channels differ by gains and azimuths drawn from these tolerances.

With `--recordings` the arms are the real ones of `stiffopt bench recordings`, calibrated with their
strain law by default settings to each of their runs in turn (logs in sequence to the training logs
alone), and tested with the others. The intervals are by a bootstrap over these tests: a run goes
the same way again and again, so its blocks of two minutes, which `stiffopt validate` draws, have
nearly the same coverage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibration import CASES, described
from report import table
from stiffopt import CalibrationSettings, Log, RobotDescription, calibrate, validate
from stiffopt.experiments.coverage import spread_pressures
from stiffopt.identify.bench import load_bench
from stiffopt.identify.results import LEVELS, Comparison, coverage
from stiffopt.logs import read_log
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    Discretisation,
    PlantSettings,
    Silicone,
    SiliconeCreep,
    SiliconeHysteresis,
    Spread,
)

Array = NDArray[np.float64]

STEP = 0.02  # s, of the simulation
EVERY = 3  # steps per row of a log
PEAKS = (0.4e5, 0.8e5, 1.0e5)  # Pa, of the sweeps' teeth
HALF_TOOTH = 2.2  # s
ROUNDS, ROUND, DESIGNED = 15, 6, 2  # rounds, poses in each, rounds as in the experiment
NOISE, ANGLE_NOISE = 1e-4, 3e-3  # m, rad
DRAWS = 2000  # of the bootstrap over arms
UNDRIVEN = 5  # arms for each fit without the last channel
QUICK = CalibrationSettings(
    sequence=True, structure="hysteresis", strain_law="keep", rows=800, trial_rows=400,
    start_evaluations=10,
)  # fmt: skip


@dataclass
class Arm:
    """A simulated arm with its regulators, and what it draws its numbers from."""

    plant: Plant
    rng: np.random.Generator
    lag: float
    dead_time: float
    chambers: Array = field(init=False)
    now: float = 0.0  # s, at which the next log begins

    def __post_init__(self) -> None:
        self.chambers = np.zeros(self.plant.robot.n_pressures)

    def recorded(self, times: Array, pressures: Array) -> Log:
        """Log of commands that are linear between pressures (K, n) at times (K,)."""
        time = np.arange(STEP, times[-1], STEP)
        commands, late = (
            np.stack([np.interp(t, times, column) for column in pressures.T], axis=1)
            for t in (time, time - self.dead_time)
        )
        share = -np.expm1(-STEP / self.lag)
        rows = np.arange(EVERY - 1, len(time), EVERY)
        back = np.linalg.inv(self.plant.mismatch.registration.transform())
        poses = []
        for row in rows:
            inside = []
            for command in late[row - EVERY + 1 : row + 1]:
                self.chambers = self.chambers + share * (command - self.chambers)
                inside.append(self.chambers)
            self.plant.follow(np.array(inside))
            poses.append(back @ self.plant.tip_pose())
        turns = Rotation.from_matrix([pose[:3, :3] for pose in poses])
        turns *= Rotation.from_rotvec(self.rng.normal(0, ANGLE_NOISE, (len(rows), 3)))
        tips = np.array([pose[:3, 3] for pose in poses])
        begin, self.now = self.now, self.now + float(time[-1])
        return Log(
            time=begin + time[rows],
            commanded=np.round(commands[rows], -1),
            tip_position=tips + self.rng.normal(0, NOISE, tips.shape),
            tip_quaternion=turns.as_quat()[:, [3, 0, 1, 2]],
        )


def made(rig: str, seed: int) -> tuple[RobotDescription, Arm]:
    """The robot file of a rig, and an arm that differs from it."""
    description, robot = described(CASES[rig], seed)
    rng = np.random.default_rng([seed, 77])
    update: dict[str, object] = {
        "dynamics": "quasi-static",
        "discretisation": Discretisation(step=STEP),
    }
    if seed % 2:
        update["spread"] = Spread()
    if seed % 4 >= 2:
        creep = [SiliconeCreep(share=rng.uniform(0.02, 0.1), time=time) for time in (2.0, 20.0)]
        slip = [
            SiliconeHysteresis(share=rng.uniform(0.02, 0.1), strain=strain)
            for strain in (0.01, 0.04)
        ]
        update["silicone"] = Silicone(
            stiffening=rng.uniform(0.02, 0.3), creep=tuple(creep), hysteresis=tuple(slip)
        )
    settings = (description.plant or PlantSettings()).model_copy(update=update)
    return robot, Arm(Plant(robot, settings), rng, rng.uniform(0.1, 0.3), rng.uniform(0.02, 0.08))


def with_other_channels(rig: str, seed: int, fitted: RobotDescription) -> Iterator[Arm]:
    """Arms that differ from that of the seed by the tolerances of the last channel alone.

    Without pressure in that channel they move alike.
    """
    assert fitted.calibration is not None  # it was fitted
    priors = {each.key: each.prior for each in fitted.calibration.parameters}
    where = f"segments[{fitted.n_segments - 1}].corrections"
    last = fitted.segments[-1].n_channels - 1
    rng = np.random.default_rng([seed, 5])
    for _ in range(UNDRIVEN):
        robot, arm = made(rig, seed)
        gain, angle = (
            rng.normal(0, priors[f"{where}.{name}[{last}]"]) for name in ("gain", "azimuth")
        )
        own = arm.plant.mismatch
        other = {"gain": (*own.gain[:-1], np.exp(gain)), "angle": (*own.angle[:-1], angle)}
        settings = {"mismatch": own.model_copy(update=other), "spread": None}
        arm.plant = Plant(robot, arm.plant.settings.model_copy(update=settings))
        yield arm


def logs(robot: RobotDescription, arm: Arm, undriven: bool = False) -> Iterator[tuple[str, Log]]:
    """The sweeps of all channels, then the rounds of held poses.

    `undriven`: the last channel has no pressure in sweeps and designed rounds.
    """
    n = robot.n_pressures
    driven = np.where(np.arange(n) == n - 1, not undriven, 1.0)
    rest, teeth = np.zeros(n), [peak * own for own in np.eye(n) for peak in PEAKS]
    knots = np.array([rest, *(p for tooth in teeth for p in (tooth, rest))])
    yield "sweeps", arm.recorded(HALF_TOOTH * np.arange(len(knots)), knots * driven)
    designed = spread_pressures(DESIGNED * ROUND, rest, robot.pressure_max)
    for number in range(ROUNDS):
        poses = designed[number * ROUND : (number + 1) * ROUND]
        if number >= DESIGNED:
            poses = arm.rng.uniform(rest, robot.pressure_max, (ROUND, n))
        times, visited = [0.0], [rest]
        for pose in (*poses, rest):
            way = float(np.abs(pose - visited[-1]).max())
            times.append(times[-1] + way / arm.rng.uniform(2e4, 6e4))
            times.append(times[-1] + arm.rng.uniform(2.5, 6.0))
            visited += [pose, pose]
        own = driven if number < DESIGNED else 1.0
        yield f"round {number + 1}", arm.recorded(np.array(times), np.array(visited) * own)


def intervals(arms: list[list[Comparison]], kind: str) -> Array:
    """95 % intervals (2, levels) of the coverage of a kind of prediction, by drawing arms again.

    Or by drawing whatever else is independent of each other.
    """
    found = [coverage(arm).get(kind) for arm in arms]
    rows = np.array([0 if each is None else each.n for each in found])
    within = np.array([np.zeros(len(LEVELS)) if each is None else each.n * np.array(each.shares)
                       for each in found])  # fmt: skip
    drawn = np.random.default_rng(0).integers(len(arms), size=(DRAWS, len(arms)))
    among = rows[drawn].sum(axis=1)
    shares = within[drawn].sum(axis=1)[among > 0] / among[among > 0, np.newaxis]
    return np.asarray(np.quantile(shares, (0.025, 0.975), axis=0))


def of_recordings(folder: Path) -> Iterator[tuple[str, list[Comparison]]]:
    """Yield each real arm's name and its runs, compared with fits to others of its runs."""
    bench, base = load_bench()
    for arm in bench.arms:
        runs = (*arm.train, *arm.test)
        splits = [((run,), tuple(each for each in runs if each != run)) for run in runs]
        if arm.sequence or not arm.test:
            splits = [(arm.train, arm.test)] if arm.test else []
        settings = CalibrationSettings(sequence=arm.sequence, strain_law="keep")
        found: list[Comparison] = []
        for train, test in splits:
            fitted, tested = (
                [(name, read_log(folder / name)) for name in names] for names in (train, test)
            )
            robot = load_description(arm.robot, base=base)
            result = calibrate(robot, fitted, settings=settings)
            found += validate(result.robot, tested, settings)
        if found:
            yield arm.name, found


def markdown(title: str, arms: list[list[Comparison]]) -> str:
    """Table of the coverage of all arms together, or of one in all its tests."""
    found, rows = [each for arm in arms for each in arm], []
    for name, each in coverage(found).items():
        ends = 100 * intervals(arms, name).T
        cells = [f"{100 * share:.0f} ({low:.0f} to {high:.0f})"
                 for share, (low, high) in zip(each.shares, ends, strict=True)]  # fmt: skip
        rows.append((name, str(each.n), *cells))
    header = ("readings", "rows", *(f"{100 * level:.0f} %" for level in LEVELS))
    error = np.nanmean(np.concatenate([each.distance for each in found]))
    return "\n".join([f"### {title}, mean error {1e3 * error:.2f} mm", "", *table(header, rows)])


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=1000, help="the first of the seeds")
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--rig", choices=list(CASES), default="sim")
    parser.add_argument("--auto", action="store_true", help="default settings: models are compared")
    parser.add_argument("--undriven", action="store_true", help="the last channel is not recorded")
    parser.add_argument("--recordings", type=Path, metavar="DIR", help="of real arms instead")
    given = parser.parse_args()
    if given.recordings is not None:
        for name, runs in of_recordings(given.recordings):
            print(markdown(name, [[run] for run in runs]), end="\n\n", flush=True)
        return 0
    settings = CalibrationSettings(sequence=True) if given.auto else QUICK
    found: dict[str, list[list[Comparison]]] = {"sweeps and two rounds": [], "sweeps alone": []}
    for seed in range(given.first, given.first + given.arms):
        robot, arm = made(given.rig, seed)
        recorded = list(logs(robot, arm, given.undriven))
        for (_, arms), fitted in zip(found.items(), (3, 1), strict=True):
            fit = calibrate(robot, recorded[:fitted], settings=settings).robot
            tested = [recorded]
            if given.undriven:
                others = with_other_channels(given.rig, seed, fit)
                tested = [list(logs(robot, other, undriven=True)) for other in others]
            runs = (validate(fit, each, settings)[fitted:] for each in tested)
            arms.append([each for run in runs for each in run])
        print(f"arm {seed}: done", file=sys.stderr, flush=True)
    for title, arms in found.items():
        print(markdown(title, arms), end="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
