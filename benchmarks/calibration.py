"""Measure the accuracy of calibrated robot files on the simulated rig, where the truth is known.

    python benchmarks/calibration.py [--quick] [--arms NAME ...] [--seeds N] [--structure NAME]
        [--strain-law keep]

Each seed gives another arm, which differs from its robot file by a draw from the rig file's spread.
One kinematics experiment is recorded, and `calibrate` fits the robot file to it. Three robot files
are compared: the original (nominal), the fitted one (calibrated), and one with the true values of
all its keys, whose remaining error is that of the model:

- settled tip: error in % of length at random pressures that were not recorded, held until creep has
  ended, without hysteresis;
- stiffness: prediction over measurement by the probe, minus 1.

Prints a table in Markdown for each arm, over all its seeds. ``control.py --robot-file`` measures
the effect of calibrated files on targets; tests/test_intervals.py checks whether true values lie
inside their intervals.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from report import Verdict, at_most, table
from stiffopt import (
    CalibrationSettings,
    DeviceError,
    InputError,
    Log,
    Manipulator,
    RobotDescription,
    calibrate,
    load_robot,
    read_log,
)
from stiffopt.experiments.conductor import Conductor, at_rest
from stiffopt.experiments.coverage import round_count, round_name
from stiffopt.experiments.folder import create_folder, open_folder
from stiffopt.experiments.kinematics import KinematicsSettings, recording_name, run_kinematics
from stiffopt.experiments.probing import Probing, Series
from stiffopt.experiments.slope import fit_lines
from stiffopt.experiments.stiffness import HARD_STOP, StiffnessSettings
from stiffopt.model.description import Recordings
from stiffopt.model.robot_files import load_description
from stiffopt.model.segment import Corrections
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Mismatch, PlantSettings, Silicone
from stiffopt.registration import Placement, Registration
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.safety.rigs import rig_for_programs

Array = NDArray[np.float64]

RIGS = Path(__file__).resolve().parent.parent / "rig"
COLUMNS = ("nominal", "calibrated", "true values")
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, -1.0)}
STATIC_BAR = 1.0  # % of length
STIFFNESS_BAR = 5.0  # %


@dataclass(frozen=True)
class Case:
    """An arm on a rig.

    Attributes
    ----------
    rig : name of the rig file.
    agrees : whether plant and model are of one kind: silicone linear, without creep and hysteresis,
        and a robot file whose strains are per rest length.
    """

    rig: str
    agrees: bool


CASES = {
    "sim": Case("sim", agrees=False),
    "sim-agreeing": Case("sim", agrees=True),
    "two-segment": Case("sim-two-segment", agrees=False),
}


@dataclass(frozen=True)
class Sizes:
    """How much is done.

    Attributes
    ----------
    seeds : of the arms, one each.
    repetitions, poses : of the kinematics experiment.
    structure, strain_law, rows, trial_rows : see `CalibrationSettings`.
    held : held-out pressures.
    probed : pressures at which the probe measures; 0 for none.
    """

    seeds: tuple[int, ...] = (0, 1)
    repetitions: int = 5
    poses: int = 24
    structure: str = "auto"
    strain_law: Literal["auto", "keep"] = "auto"
    rows: int = 2000
    trial_rows: int = 600
    held: int = 40
    probed: int = 4


QUICK = Sizes(
    seeds=(0,), repetitions=1, poses=2, structure="static", rows=100, trial_rows=50,
    held=4, probed=1,
)  # fmt: skip


@dataclass
class Found:
    """What one or several seeds of an arm have shown, by name of the file in use.

    Attributes
    ----------
    values : of each measure and file, one for each pressure or probing.
    notes : what else to know.
    """

    values: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, measure: str, file: str, values: Iterable[float]) -> None:
        """Put values of a measure to those that are there."""
        self.values.setdefault(measure, {}).setdefault(file, []).extend(map(float, values))

    def merge(self, other: Found) -> None:
        """Put all of another to it."""
        for measure, files in other.values.items():
            for file, values in files.items():
                self.add(measure, file, values)
        self.notes += other.notes


@dataclass(frozen=True, eq=False)
class Known:
    """A robot file in use: its model, and what its registration makes of a tracker's poses."""

    model: Manipulator
    registration: Registration

    @classmethod
    def of(cls, description: RobotDescription) -> Known:
        """Make the model."""
        recordings = description.recordings
        known = recordings.registration if recordings is not None else Registration()
        return cls(load_robot(description), known)

    def tip(self, pressures: Array) -> Array:
        """Tips (N, 3) in the frame of the rig's registration at pressures (N, n)."""
        poses = self.model.tip_pose(pressures)
        return np.array([self.registration.sensor_in_tracker(pose)[:3, 3] for pose in poses])


def described(case: Case, seed: int) -> tuple[RigDescription, RobotDescription]:
    """Rig and robot file of an arm."""
    path = RIGS / f"{case.rig}.yaml"
    rig = load_rig_description(path)
    robot = load_description(rig.robot, base=path.parent)
    plant: dict[str, Any] = {"seed": seed}
    if case.agrees:
        plant["silicone"] = Silicone(law="linear", creep=(), hysteresis=())
        segments = [s.model_copy(update={"strain_law": "rest-length"}) for s in robot.segments]
        robot = robot.model_copy(update={"segments": tuple(segments)})
    plant_settings = (rig.plant or PlantSettings()).model_copy(update=plant)
    return rig.model_copy(update={"plant": plant_settings}), robot


def recorded(
    description: RigDescription, robot: RobotDescription, sizes: Sizes, folder: Path
) -> list[tuple[str, Log]]:
    """Logs of one kinematics experiment, in order; what the folder has is not done again."""
    settings = KinematicsSettings(
        rig=description.name,
        robot=robot.name,
        channels=robot.n_pressures,
        repetitions=sizes.repetitions,
        poses=sizes.poses,
    )
    if not folder.exists():
        create_folder(folder, settings)
    elif open_folder(folder, KinematicsSettings) != settings:
        raise InputError(f"{folder} holds a recording with other settings; remove it")
    with rig_for_programs(description, robot) as rig:
        run_kinematics(rig, folder, settings, rate=description.rate)
    names = [recording_name(k + 1) for k in range(sizes.repetitions)]
    names += [round_name(k + 1) for k in range(round_count(sizes.poses))]
    return [(name, read_log(folder / f"{name}.csv")) for name in names]


def with_true_values(robot: RobotDescription, m: Mismatch) -> RobotDescription:
    """The robot file with an arm's mismatch in it; for silicone it has no keys."""
    segments = []
    first = 0
    for s, segment in enumerate(robot.segments):
        own = slice(first, first := first + segment.n_channels)
        material, lamb = segment.material, segment.compensation
        modulus = material.youngs_modulus * m.modulus[s]
        if lamb is not None:
            slope = lamb.modulus_per_pressure * m.modulus[s]
            lamb = lamb.model_copy(update={"modulus_per_pressure": slope})
        update = {
            "length": segment.length * m.length[s],
            "material": material.model_copy(update={"youngs_modulus": modulus}),
            "compensation": lamb,
            "corrections": Corrections(
                gain=m.gain[own], offset=m.offset[own], azimuth=m.angle[own]
            ),
        }
        segments.append(segment.model_copy(update=update))
    nominal_in_base = m.base.inverse()
    tracker = Placement.of(nominal_in_base @ m.registration.transform())
    update = {
        "segments": tuple(segments),
        "recordings": Recordings(registration=Registration(tracker_in_base=tracker)),
        "gravity": tuple((nominal_in_base[:3, :3] @ robot.gravity).tolist()),
    }
    return robot.model_copy(update=update)


# -- measures ----------------------------------------------------------------------------------


def held_out(plant: Plant, files: dict[str, Known], pressures: Array, found: Found) -> None:
    """Error of the settled tip in % of length, as a perfect tracker sees it."""
    tips = []
    for p in pressures:
        plant.settle(p)
        tips.append((plant.mismatch.registration.inverse() @ plant.tip_pose())[:3, 3])
    for name, known in files.items():
        error = np.linalg.norm(known.tip(pressures) - np.array(tips), axis=1)
        found.add("settled", name, 100 * error / known.model.length)


def probed(
    description: RigDescription,
    robot: RobotDescription,
    files: dict[str, Known],
    pressures: Array,
    found: Found,
) -> None:
    """Predicted stiffness over what the probe measures, less 1, in %."""
    usual = StiffnessSettings(channels=robot.n_pressures)
    with rig_for_programs(description, robot) as rig:
        conductor = Conductor(rig, description.rate)
        probing = Probing(conductor)
        conductor.start()
        for p in pressures:
            conductor.ramp(p)
            conductor.settle(p, lambda rows: at_rest(rows, window=4.0), usual.settle)
            for axis, direction in DIRECTIONS.items():
                d = np.array(direction)
                expected = float(files["nominal"].model.stiffness(p, d))
                far = min(usual.displacement, usual.force / expected)
                series = Series(d, far, usual.steps, usual.reach, HARD_STOP * usual.force)
                probing.probe.align(direction)
                try:
                    points = probing.run(p, series)
                except DeviceError as error:
                    found.notes.append(f"not probed along {axis}: {error}")
                    continue
                finally:
                    probing.probe.withdraw()
                rows = [(s.displacement, s.force, s.time) for s in points if s.touching]
                x, y, time = np.array(rows).reshape(-1, 3).T
                lines = fit_lines([(x, y, time)])
                if not lines:
                    found.notes.append(f"not probed along {axis}: too few points in contact")
                    continue
                for name, known in files.items():
                    turned = known.registration.tracker_in_base.transform()[:3, :3] @ d
                    ratio = float(known.model.stiffness(p, turned)) / lines[0].slope
                    found.add(f"stiffness {axis}", name, [100 * (ratio - 1)])


# -- all of it ---------------------------------------------------------------------------------


def measure(case: Case, seed: int, sizes: Sizes, folder: Path) -> Found:
    """All measures on one arm."""
    found = Found()
    description, robot = described(case, seed)
    logs = recorded(description, robot, sizes, folder)
    settings = CalibrationSettings(
        structure=sizes.structure, strain_law=sizes.strain_law, sequence=True,
        rows=sizes.rows, trial_rows=sizes.trial_rows,
    )  # fmt: skip
    result = calibrate(robot, logs, settings=settings)
    plant = Plant(robot, description.plant)
    best = with_true_values(robot, plant.mismatch)
    files = dict(zip(COLUMNS, map(Known.of, (robot, result.robot, best)), strict=True))
    high, n = np.array(robot.pressure_max), robot.n_pressures
    settled, probed_at = (np.random.default_rng([seed, 5, k]) for k in (0, 2))
    held_out(plant, files, settled.uniform(0, 1, (sizes.held, n)) * high, found)
    if sizes.probed:
        pressures = probed_at.uniform(0, 1, (sizes.probed, n)) * high
        probed(description, robot, files, pressures, found)
    found.notes.append(f"seed {seed}: {result.structure.name}")
    return found


def rows(found: Found) -> list[tuple[str, ...]]:
    """Each measure in words, for the files in order."""
    settled = found.values["settled"].values()
    words = (f"{np.mean(v):.2f} / {np.quantile(v, 0.95):.2f}" for v in settled)
    listed = [("settled tip, % of length, mean / p95", *words)]
    for axis in DIRECTIONS:
        errors = found.values.get(f"stiffness {axis}", {}).values()
        words = (f"{np.mean(v):+.1f} / {np.mean(np.abs(v)):.1f}" for v in errors)
        listed.append((f"stiffness {axis}, %, mean / mean of size", *words))
    return listed


def verdicts(name: str, found: Found) -> list[Verdict]:
    """The bars that are met, and those that are not."""
    values = {measure: files["calibrated"] for measure, files in found.values.items()}
    listed = [
        at_most(f"{name}: settled tip, mean", STATIC_BAR, float(np.mean(values["settled"])), "%")
    ]
    for axis in DIRECTIONS:
        if errors := values.get(f"stiffness {axis}"):
            size = float(np.mean(np.abs(errors)))
            listed.append(at_most(f"{name}: stiffness {axis}, mean size", STIFFNESS_BAR, size, "%"))
    return listed


def markdown(name: str, found: Found) -> str:
    """Table of an arm, and what to know of it."""
    lines = [f"### {name}", "", *table(("measure", *COLUMNS), rows(found))]
    lines += ["", *(f"- {note}" for note in _counted(found.notes)), ""]
    for verdict in verdicts(name, found):
        state = "met" if verdict.met else "NOT met"
        lines.append(f"- {verdict.what}: {verdict.measured}, bar {verdict.bar}: {state}")
    return "\n".join([*lines, ""])


def _counted(notes: Sequence[str]) -> list[str]:
    return [
        note if (count := notes.count(note)) == 1 else f"{note} ({count} times)"
        for note in dict.fromkeys(notes)
    ]


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    usual = Sizes()
    parser.add_argument("--arms", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, default=len(usual.seeds), help="how many arms of each")
    parser.add_argument("--first", type=int, default=0, help="the first of the seeds")
    parser.add_argument("--structure", default=usual.structure, help="model to fit, or auto")
    parser.add_argument(
        "--strain-law", choices=("auto", "keep"), default=usual.strain_law,
        help="compare strain laws, or keep that of the robot file",
    )  # fmt: skip
    parser.add_argument(
        "--repetitions", type=int, default=usual.repetitions, help="of the kinematics experiment"
    )
    parser.add_argument("--probed", type=int, default=usual.probed, help="pressures to probe at")
    parser.add_argument("--quick", action="store_true", help="a minute; it proves nothing")
    parser.add_argument("--keep", type=Path, help="keep the recordings here and use them again")
    given = parser.parse_args()
    seeds = tuple(range(given.first, given.first + given.seeds))
    sizes = replace(
        usual, seeds=seeds, structure=given.structure, strain_law=given.strain_law,
        repetitions=given.repetitions, probed=given.probed,
    )  # fmt: skip
    if given.quick:
        sizes = QUICK
        print("Quick form: it shows that everything runs; its figures mean little.\n")
    begin = perf_counter()
    with tempfile.TemporaryDirectory() as passing:
        folder = given.keep or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        for name in given.arms:
            found = Found()
            for seed in sizes.seeds:
                found.merge(measure(CASES[name], seed, sizes, folder / f"{name}-{seed}"))
                print(f"# {perf_counter() - begin:.0f} s", file=sys.stderr)
            print(markdown(name, found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
