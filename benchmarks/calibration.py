"""What a calibration is worth on the simulated rig, where the truth is known.

    python benchmarks/calibration.py [--quick] [--arms NAME ...] [--seeds N] [--structure NAME]

Each seed is another arm: it differs from its robot file by what the rig file's spread draws. One
kinematics experiment is recorded and `calibrate` fits the robot file to it. Then the file as it was
(nominal) and the fitted one (calibrated) are put side by side, and where it is cheap a third that
has the true values, as far as a robot file has words for them (true values): what it still misses
is not the fit's fault but that of the model, or of what judges:

- open loop: the tip at pressures that the calibration has not seen, held or along a log;
- stiffness: what the file predicts and what the probe measures;
- parameters: whether the intervals have the true values in them;
- targets: the tip at rest where `solve_pressure` sends it, alone and with feedback on top.

Prints a table in Markdown for each arm. `run.py --only calibration` makes a section of it. Nothing
here knows the truth but what judges: plant and mismatch are asked after, or beside, the rig's run.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from report import Section, Verdict, at_most, table
from settings import Settings

if TYPE_CHECKING:
    from stiffopt import CalibrationResult, Log, Manipulator, RobotDescription
    from stiffopt.plant.devices import SimulatedRig
    from stiffopt.registration import Registration
    from stiffopt.rig.config import RigDescription

Array = NDArray[np.float64]

RIGS = Path(__file__).resolve().parent.parent / "rig"
FILES = ("nominal", "calibrated")
COLUMNS = (*FILES, "true values")
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, -1.0)}
STEPS = (0.010, 0.040)  # m between two targets
TARGETS_UP_TO = 0.7  # of the highest pressures; an arm that is softer than drawn reaches them too
LAST = 2.0  # s at the end of a step over which the steady error is the mean
NEAR = 1e-3  # m; nearer than that for good is settled
STAYS = 1.0  # s at the end in which the tip must not leave that again

STATIC_BAR = 1.0  # % of length
STIFFNESS_BAR = 5.0  # %
INSIDE_BAR = (90.0, 99.0)  # %

TITLE = "Calibration on the simulated rig"
TEXT = """\
One kinematics experiment on each simulated arm, `calibrate` on its logs, and then the robot file as
it was beside the calibrated one, and beside one with the true mismatch in it, whose error is the
model's. All arms of a row together; the errors are those of the true tip,
which no file knows. Settled: held-out random pressures, creep done and no hysteresis. Log: other
held-out pressures, one after the other, as `validate` predicts them with their history. Stiffness:
predicted over measured by the probe, less 1. Parameters: share of true values (gains, offsets,
azimuths, moduli, their slope, lengths, the base frame; of the agreeing arm also the factors on area
and stiffness) inside their 95 % intervals. Targets: places of the true tip at rest, steps of 10 to
40 mm, each as a tracker with the file's registration shows it; the error is that of the last 2 s of
a step of 10 s (two-segment: 20 s). Feedback: at every frame p += gain pinv(J) (target - measured),
J of the file in use, from a moment after the step, the same gain for both files. The arm of two
segments rings for ten seconds: its steps are ramps and its gain is small. Settled is within 1 mm of
the target for good; a step that never settles counts as infinitely long in median and p90."""


@dataclass(frozen=True)
class Loop:
    """How targets are gone to, whatever the file; tuned by hand with the nominal one.

    Attributes
    ----------
    gain : of the feedback, per frame.
    slew : of the commands, in Pa/s.
    wait : after a step until feedback begins, in s: until then the arm is on its way.
    hold : time at each target, in s.
    """

    gain: float
    slew: float
    wait: float
    hold: float


@dataclass(frozen=True)
class Case:
    """An arm on a rig.

    Attributes
    ----------
    rig : name of the rig file.
    agrees : whether plant and model are of one kind: silicone linear, without creep and hysteresis,
        and a robot file whose strains are per rest length.
    loop : how targets are gone to.
    """

    rig: str
    agrees: bool
    loop: Loop


_QUIET = Loop(gain=0.05, slew=5e5, wait=0.5, hold=10.0)
_RINGING = Loop(gain=0.01, slew=5e4, wait=2.0, hold=20.0)  # 1.7 Hz, 3 % of critical damping
CASES = {
    "sim": Case("sim", False, _QUIET),
    "sim-agreeing": Case("sim", True, _QUIET),
    "two-segment": Case("sim-two-segment", False, _RINGING),
}


@dataclass(frozen=True)
class Sizes:
    """How much is done.

    Attributes
    ----------
    seeds : of the arms, one each.
    repetitions, poses : of the kinematics experiment.
    structure : to fit, see `CalibrationSettings`.
    rows, trial_rows : the same.
    held : held-out pressures, settled.
    along : held-out pressures of the log; 0 for none.
    probed : pressures at which the probe measures; 0 for none.
    targets : of the loop; 0 for none.
    """

    seeds: tuple[int, ...] = (0, 1)
    repetitions: int = 5
    poses: int = 24
    structure: str = "auto"
    rows: int = 2000
    trial_rows: int = 600
    held: int = 40
    along: int = 12
    probed: int = 4
    targets: int = 12


QUICK = Sizes(
    seeds=(0,), repetitions=1, poses=2, structure="static", rows=100, trial_rows=50,
    held=4, along=1, probed=1, targets=1,
)  # fmt: skip


@dataclass
class Found:
    """What one or several seeds of an arm have shown, by name of the file in use.

    Attributes
    ----------
    values : of each measure and file, one for each pressure, row, probing or step.
    inside : whether each true parameter is inside of its interval, by group.
    notes : what else to know.
    """

    values: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    inside: dict[str, list[bool]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, measure: str, file: str, values: Iterable[float]) -> None:
        """Put values of a measure to those that are there."""
        self.values.setdefault(measure, {}).setdefault(file, []).extend(map(float, values))

    def merge(self, other: Found) -> None:
        """Put all of another to it."""
        for measure, files in other.values.items():
            for file, values in files.items():
                self.add(measure, file, values)
        for group, flags in other.inside.items():
            self.inside.setdefault(group, []).extend(flags)
        self.notes += other.notes

    def data(self) -> dict[str, Any]:
        """All of it as JSON has it: None for what is infinite."""
        values = {
            measure: {
                file: [value if np.isfinite(value) else None for value in each]
                for file, each in files.items()
            }
            for measure, files in self.values.items()
        }
        return {"values": values, "inside": self.inside, "notes": self.notes}


@dataclass(frozen=True, eq=False)
class Known:
    """A robot file in use: its model, and what its registration makes of a tracker's poses."""

    model: Manipulator
    registration: Registration

    @classmethod
    def of(cls, description: RobotDescription) -> Known:
        """Make the model."""
        from stiffopt import load_robot
        from stiffopt.registration import Registration

        recordings = description.recordings
        known = recordings.registration if recordings is not None else Registration()
        return cls(load_robot(description), known)

    def tip(self, pressures: Array) -> Array:
        """Tips (N, 3) in the frame of the rig's registration at pressures (N, n)."""
        poses = self.model.tip_pose(pressures)
        return np.array([self.registration.sensor_in_tracker(pose)[:3, 3] for pose in poses])

    def seen(self, pose: Array) -> Array:
        """Tip (3,) in the file's base frame where the rig's registration has a pose (4, 4)."""
        registration = self.registration
        there = registration.tracker_in_base.transform() @ pose
        return np.asarray((there @ registration.tip_in_sensor.transform())[:3, 3])


class Truth:
    """The simulated arm itself, beside any rig that has it."""

    def __init__(self, description: RigDescription, robot: RobotDescription) -> None:
        from stiffopt.plant.plant import Plant

        self._plant = Plant(robot, description.plant)
        self.mismatch = self._plant.mismatch

    def settled(self, pressures: Array) -> Array:
        """Tip (4, 4) in the nominal base frame at rest, creep done, no hysteresis."""
        self._plant.settle(pressures)
        return self._plant.tip_pose()

    def registered(self, pose: Array) -> Array:
        """What a perfect tracker with the rig's registration says of a true pose (4, 4)."""
        return np.asarray(self.mismatch.registration.inverse() @ pose)


def described(case: Case, seed: int) -> tuple[RigDescription, RobotDescription]:
    """Rig and robot file of an arm."""
    from stiffopt.model.robot_files import load_description
    from stiffopt.plant.settings import PlantSettings, Silicone
    from stiffopt.rig.config import load_rig_description

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


@contextmanager
def opened(
    description: RigDescription, robot: RobotDescription, file: Known | None = None
) -> Iterator[SimulatedRig]:
    """Context with the rig in simulated time, its tracker corrected as a file says.

    `robot` is what the simulated arm is made from, so it is always the file as it was.
    """
    from stiffopt.safety.rigs import rig_for_programs

    rig: Any = rig_for_programs(description, robot)
    with rig:
        if file is not None:
            rig.tracker.registration = rig.tracker.registration.then(file.registration)
        yield rig


def recorded(
    description: RigDescription, robot: RobotDescription, sizes: Sizes, folder: Path
) -> list[tuple[str, Log]]:
    """Logs of one kinematics experiment, in order; what the folder has is not done again."""
    from stiffopt import InputError, read_log
    from stiffopt.experiments.coverage import round_count, round_name
    from stiffopt.experiments.folder import create_folder, open_folder
    from stiffopt.experiments.kinematics import (
        KinematicsSettings,
        recording_name,
        run_kinematics,
    )

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
    with opened(description, robot) as rig:
        run_kinematics(rig, folder, settings, rate=description.rate)
    names = [recording_name(k + 1) for k in range(sizes.repetitions)]
    names += [round_name(k + 1) for k in range(round_count(sizes.poses))]
    return [(name, read_log(folder / f"{name}.csv")) for name in names]


def fitted(
    robot: RobotDescription, logs: Sequence[tuple[str, Log]], sizes: Sizes
) -> CalibrationResult:
    """The calibration, with settings as a user would have them."""
    from stiffopt import CalibrationSettings, calibrate

    settings = CalibrationSettings(
        structure=sizes.structure, sequence=True, rows=sizes.rows, trial_rows=sizes.trial_rows
    )
    return calibrate(robot, logs, settings=settings)


def with_true_values(robot: RobotDescription, truth: Truth) -> RobotDescription:
    """The robot file with the arm's mismatch in it; silicone has no words there."""
    from stiffopt.model.description import Corrections, Recordings
    from stiffopt.registration import Placement, Registration

    m = truth.mismatch
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
    tracker = Placement.of(m.base.inverse() @ m.registration.transform())
    recordings = Recordings(registration=Registration(tracker_in_base=tracker))
    return robot.model_copy(update={"segments": tuple(segments), "recordings": recordings})


# -- open loop, stiffness, parameters ----------------------------------------------------------


def held_out(truth: Truth, files: dict[str, Known], pressures: Array, found: Found) -> None:
    """Error of the settled tip in % of length."""
    measured = np.array([truth.registered(truth.settled(p))[:3, 3] for p in pressures])
    for name, known in files.items():
        error = np.linalg.norm(known.tip(pressures) - measured, axis=1)
        found.add("settled", name, 100 * error / known.model.length)


def along_a_log(
    description: RigDescription,
    robots: dict[str, RobotDescription],
    pressures: Array,
    folder: Path,
    found: Found,
) -> None:
    """Error in % of length along a log of pressures (N, n) that are held one after the other."""
    from stiffopt import CalibrationSettings, read_log, validate
    from stiffopt.experiments.conductor import CONDUCTOR, Conductor
    from stiffopt.experiments.coverage import Coverage, round_name

    n = pressures.shape[1]
    with opened(description, robots["nominal"]) as rig:
        conductor = Conductor(rig, description.rate)
        conductor.start()
        coverage = Coverage(np.zeros(n), pressures, np.full(n, CONDUCTOR.gentle), 7.0)
        names = [round_name(k + 1) for k in range(len(coverage.rounds))]
        for number in range(1, len(names) + 1):
            coverage.record(conductor, folder, number, {}, lambda done, text: None)
    logs = [(name, read_log(folder / f"{name}.csv")) for name in names]
    for name, robot in robots.items():
        for each in validate(robot, logs, CalibrationSettings(sequence=True)):
            error = each.distance[np.isfinite(each.distance)]
            found.add("log", name, 100 * error / robots["nominal"].length)


def probed(
    description: RigDescription,
    robot: RobotDescription,
    files: dict[str, Known],
    pressures: Array,
    found: Found,
) -> None:
    """Predicted stiffness over what the probe measures, less 1, in %."""
    from stiffopt import DeviceError
    from stiffopt.experiments.conductor import Conductor, at_rest
    from stiffopt.experiments.probing import Probing, Series
    from stiffopt.experiments.slope import fit_lines
    from stiffopt.experiments.stiffness import HARD_STOP, StiffnessSettings

    usual = StiffnessSettings(channels=robot.n_pressures)
    with opened(description, robot) as rig:
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


def true_values(
    robot: RobotDescription, truth: Truth, agrees: bool
) -> dict[str, tuple[str, float]]:
    """Group and true value of what a calibration may fit: by key, for the base frame by name."""
    from stiffopt import lie
    from stiffopt.identify.unknowns import BASE

    m = truth.mismatch
    found: dict[str, tuple[str, float]] = {}
    channel = 0
    for s, segment in enumerate(robot.segments):
        key = f"segments[{s}]"
        factor = m.modulus[s]
        lamb = segment.compensation
        modulus = segment.material.youngs_modulus
        found[f"{key}.length"] = ("length", segment.length * m.length[s])
        found[f"{key}.material.youngs_modulus"] = ("modulus", modulus * factor)
        if lamb is not None:
            slope = lamb.modulus_per_pressure * factor
            found[f"{key}.compensation.modulus_per_pressure"] = ("slope of modulus", slope)
            if agrees:  # these factors are the plant's too
                found[f"{key}.compensation.area"] = ("area", lamb.area)
                found[f"{key}.compensation.stiffness"] = ("stiffness", lamb.stiffness)
        for c in range(segment.n_channels):
            corrections = f"{key}.corrections"
            found[f"{corrections}.gain[{c}]"] = ("gain", m.gain[channel])
            found[f"{corrections}.offset[{c}]"] = ("offset", m.offset[channel])
            found[f"{corrections}.azimuth[{c}]"] = ("azimuth", m.angle[channel])
            channel += 1
    base = np.asarray(lie.log(m.registration.inverse() @ m.base.transform()))
    moves = [f"{BASE}, {word}{axis}" for word in ("", "about ") for axis in "xyz"]
    for name, value in zip(moves, base, strict=True):
        found[name] = ("base", float(value))
    return found


def judged(result: CalibrationResult, true: dict[str, tuple[str, float]], found: Found) -> None:
    """Whether intervals have true values in them."""
    for estimate in result.estimates:
        group, value = true.get(estimate.key or estimate.name, ("", np.nan))
        if group:
            inside = bool(estimate.low <= value <= estimate.high)
            found.inside.setdefault(group, []).append(inside)


# -- targets -----------------------------------------------------------------------------------


def places(
    settled: Callable[[Array], Array],
    high: Array,
    count: int,
    up_to: float,
    rng: np.random.Generator,
) -> list[tuple[Array, Array]]:
    """Poses (4, 4) or positions (3,) at rest and their pressures, each a step from the last one.

    Parameters
    ----------
    settled : where an arm comes to rest at pressures (n,).
    high : highest pressures (n,), in Pa; up to this share of them are drawn.
    """  # fmt: skip

    def position(place: Array) -> Array:
        return place if place.ndim == 1 else place[:3, 3]

    last = settled(np.zeros(len(high)))
    found: list[tuple[Array, Array]] = []
    while len(found) < count:
        pressures = rng.uniform(0, up_to, len(high)) * high
        place = settled(pressures)
        if STEPS[0] <= np.linalg.norm(position(place) - position(last)) <= STEPS[1]:
            found.append((place, pressures))
            last = place
    return found


def steered(
    description: RigDescription,
    robot: RobotDescription,
    known: Known,
    wanted: Sequence[tuple[Array, Array]],
    loop: Loop,
) -> tuple[Array, Array, list[str]]:
    """Go from target to target; return times (T,), errors (N, T) in m, and what to know.

    Parameters
    ----------
    known : the robot file in use.
    wanted : true position of each target, for who judges, and where the file has it.
    loop : its gain may be 0, for none.
    """
    from stiffopt import PressureSolver, Target, Task
    from stiffopt.experiments.conductor import Conductor, TrackedFrame

    first = Target(position=tuple(wanted[0][1].tolist()))
    solver = PressureSolver(known.model, Task(robot=robot.name, target=first))
    notes: list[str] = []
    errors = []
    count = round(loop.hold * description.rate)
    with opened(description, robot, known) as rig:
        conductor = Conductor(rig, description.rate)
        conductor.start()
        limits = rig.supply.limits
        p = np.zeros(robot.n_pressures)
        for true, here in wanted:
            answer = solver.solve(Target(position=tuple(here.tolist())))
            if not answer.found:
                notes.append("beyond reach" if answer.pressures is not None else "no answer")
            if answer.pressures is not None:  # the nearest, where there is none that reaches
                p = np.array(answer.pressures)
            turn = known.model.tip_pose(p)[:3, :3]
            inverse = np.linalg.pinv(turn @ known.model.tip_jacobian(p)[:3])
            begins = conductor.clock.now() + loop.wait

            def correct(
                row: TrackedFrame,
                here: Array = here,
                inverse: Array = inverse,
                begins: float = begins,
            ) -> None:
                nonlocal p
                if row.visible and row.time >= begins:
                    p = limits.clamp(p + loop.gain * inverse @ (here - row.position))

            conductor.sink = correct if loop.gain else None
            distance = np.empty(count)
            for tick in range(count):
                conductor.approach(p, loop.slew)
                tip = rig.world.plant.tip_pose()[:3, 3]
                distance[tick] = np.linalg.norm(tip - true)
            errors.append(distance)
    return (1 + np.arange(count)) / description.rate, np.array(errors), notes


def settling_time(times: Array, errors: Array, near: float = NEAR, stays: float = STAYS) -> float:
    """When errors (T,) come below `near` for good, in s; infinite if they do not."""
    outside = np.flatnonzero(errors >= near)
    if not len(outside):
        return 0.0
    last = outside[-1]
    return float(times[last]) if times[last] <= times[-1] - stays else np.inf


def to_targets(
    description: RigDescription,
    robot: RobotDescription,
    truth: Truth,
    files: dict[str, Known],
    count: int,
    loop: Loop,
    rng: np.random.Generator,
    found: Found,
) -> None:
    """Steps from target to target, open loop and with feedback."""
    high = np.array(robot.pressure_max)
    poses = [pose for pose, _ in places(truth.settled, high, count, TARGETS_UP_TO, rng)]
    for name, known in files.items():
        wanted = [(pose[:3, 3], known.seen(truth.registered(pose))) for pose in poses]
        for what, own in (("open loop", replace(loop, gain=0.0)), ("feedback", loop)):
            times, errors, notes = steered(description, robot, known, wanted, own)
            last = times > times[-1] - LAST
            found.add(f"{what}: steady", name, 1e3 * errors[:, last].mean(axis=1))
            if own.gain:
                found.add("feedback: settling", name, [settling_time(times, e) for e in errors])
            else:
                found.notes += [f"{name}: a target is {note}" for note in notes]


# -- all of it ---------------------------------------------------------------------------------


def measure(case: Case, seed: int, sizes: Sizes, folder: Path) -> Found:
    """All measures on one arm."""
    found = Found()
    description, robot = described(case, seed)
    logs = recorded(description, robot, sizes, folder)
    result = fitted(robot, logs, sizes)
    robots = dict(zip(FILES, (robot, result.robot), strict=True))
    files = {name: Known.of(each) for name, each in robots.items()}
    truth = Truth(description, robot)
    high, n = np.array(robot.pressure_max), robot.n_pressures
    streams = [np.random.default_rng([seed, 5, k]) for k in range(4)]
    judges = {**files, "true values": Known.of(with_true_values(robot, truth))}
    held_out(truth, judges, streams[0].uniform(0, 1, (sizes.held, n)) * high, found)
    judged(result, true_values(robot, truth, case.agrees), found)
    if sizes.along:
        with tempfile.TemporaryDirectory() as other:
            pressures = streams[1].uniform(0, 1, (sizes.along, n)) * high
            along_a_log(description, robots, pressures, Path(other), found)
    if sizes.probed:
        pressures = streams[2].uniform(0, 1, (sizes.probed, n)) * high
        probed(description, robot, judges, pressures, found)
    if sizes.targets:
        to_targets(description, robot, truth, files, sizes.targets, case.loop, streams[3], found)
    found.notes.append(f"seed {seed}: {result.structure.name}")
    return found


def measured(
    names: Iterable[str],
    sizes: Sizes,
    folder: Path | None = None,
    tell: Callable[[str, Found], None] = lambda name, found: None,
) -> dict[str, Found]:
    """All measures on all arms; recordings are kept in a folder, if there is one."""
    every: dict[str, Found] = {}
    with tempfile.TemporaryDirectory() as passing:
        place = Path(passing) if folder is None else folder
        for name in names:
            every[name] = Found()
            for seed in sizes.seeds:
                own = place / f"{name}-{seed}"
                own.parent.mkdir(parents=True, exist_ok=True)
                every[name].merge(measure(CASES[name], seed, sizes, own))
                tell(name, every[name])
    return every


def middle_and(values: Sequence[float], share: float) -> tuple[float, float]:
    """Median and another quantile, of values that may be infinite."""
    middle, high = np.quantile(values, (0.5, share), method="inverted_cdf")
    return float(middle), float(high)


def rows(found: Found) -> list[tuple[str, ...]]:
    """What was measured and each of `COLUMNS`, in words."""

    def row(what: str, measure: str, words: Callable[[list[float]], str]) -> None:
        if measure in found.values:
            files = found.values[measure]
            listed.append(
                (what, *(words(files[name]) if name in files else "-" for name in COLUMNS))
            )

    listed: list[tuple[str, ...]] = []
    row("settled tip, % of length, mean / p95", "settled", _mean_and_p95)
    row("tip along a log, % of length, mean / p95", "log", _mean_and_p95)
    for axis in DIRECTIONS:
        row(f"stiffness {axis}, %, mean / mean of size", f"stiffness {axis}", _bias_and_size)
    if found.inside:
        listed.append(("parameters inside", "-", _share(found.inside), "-"))
    row("open loop to targets, steady error, mm, median / p90", "open loop: steady", _median_p90)
    row("feedback, steady error, mm, median / p90", "feedback: steady", _median_p90)
    row("feedback, settling to 1 mm, s, median / p90", "feedback: settling", _median_p90)
    row("steps that never settled", "feedback: settling", _unsettled)
    return listed


def _mean_and_p95(values: list[float]) -> str:
    return f"{np.mean(values):.2f} / {np.quantile(values, 0.95):.2f}"


def _bias_and_size(values: list[float]) -> str:
    return f"{np.mean(values):+.1f} / {np.mean(np.abs(values)):.1f}"


def _median_p90(values: list[float]) -> str:
    return " / ".join(f"{v:.2f}" if np.isfinite(v) else "never" for v in middle_and(values, 0.9))


def _unsettled(values: list[float]) -> str:
    return f"{int(np.isinf(values).sum())} of {len(values)}"


def _share(inside: dict[str, list[bool]]) -> str:
    flags = [flag for group in inside.values() for flag in group]
    return f"{100 * np.mean(flags):.0f} % of {len(flags)}"


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
    flags = [flag for group in found.inside.values() for flag in group]
    if flags:
        share, (low, high) = 100 * float(np.mean(flags)), INSIDE_BAR
        bar = f"{low:g} to {high:g} %"
        met = low <= share <= high
        words = f"{share:.3g} % of {len(flags)}"
        listed.append(Verdict(f"{name}: parameters inside", bar, words, met))
    return listed


def markdown(name: str, found: Found) -> str:
    """Table of an arm, and what to know of it."""
    lines = [f"### {name}", "", *table(("measure", *COLUMNS), rows(found))]
    if found.inside:
        groups = (f"{group} {sum(f)}/{len(f)}" for group, f in found.inside.items())
        lines += ["", "Inside their intervals: " + ", ".join(groups) + "."]
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


def section(sizes: Settings) -> Section:
    """The section of `run.py`."""
    own = QUICK if sizes.quick else Sizes(seeds=(sizes.seed, sizes.seed + 1))
    out = Section(TITLE, TEXT, ("arm", "measure", *COLUMNS))
    for name, found in measured(["sim"] if sizes.quick else CASES, own).items():
        out.rows += [(name, *row) for row in rows(found)]
        if not sizes.quick:
            out.verdicts += verdicts(name, found)
        out.data[name] = found.data()
    return out


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
        "--repetitions", type=int, default=usual.repetitions, help="of the kinematics experiment"
    )
    parser.add_argument("--targets", type=int, default=usual.targets, help="for each arm")
    parser.add_argument("--along", type=int, default=usual.along, help="pressures of the log")
    parser.add_argument("--probed", type=int, default=usual.probed, help="pressures to probe at")
    parser.add_argument("--quick", action="store_true", help="a minute; it proves nothing")
    parser.add_argument("--keep", type=Path, help="keep the recordings here and use them again")
    given = parser.parse_args()
    sizes = replace(
        usual,
        seeds=tuple(range(given.first, given.first + given.seeds)),
        structure=given.structure,
        repetitions=given.repetitions,
        targets=given.targets,
        along=given.along,
        probed=given.probed,
    )
    begin = perf_counter()

    def tell(name: str, found: Found) -> None:
        print(f"# {perf_counter() - begin:.0f} s", file=sys.stderr)
        print(markdown(name, found), flush=True)

    if given.quick:
        print("Quick form: it shows that everything runs; its figures mean little.\n")
    measured(given.arms, QUICK if given.quick else sizes, given.keep, tell)
    return 0


if __name__ == "__main__":
    sys.exit(main())
