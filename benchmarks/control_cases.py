"""Draw arms, targets and paths for the closed loop from a seed; see `control.py`.

The arm differs from its robot file uniformly at random: modulus by up to 20 %, channels by up to
5 %, the base by 2 mm and 2 degrees in a random direction. Targets are positions at which that arm
settles, without remaining creep or hysteresis, so they are reachable.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from calibration import Sizes, recorded, with_true_values
from stiffopt import (
    CalibrationSettings,
    RobotDescription,
    StiffnessGoal,
    StiffnessMeasure,
    Target,
    Task,
    calibrate,
    lie,
    load_robot,
    save_robot,
)
from stiffopt.model.robot_files import load_description
from stiffopt.model.scene import Scene
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.tip import TipModel
from stiffopt.plant.devices import SimulatedRig
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Mismatch, PlantLoad, PlantSettings
from stiffopt.registration import Placement, Registration
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description

Array = NDArray[np.float64]

RIG = Path(__file__).resolve().parent.parent / "rig" / "sim-two-segment.yaml"
DYNAMICS = ("quasi-static", "full")
DEMANDS = ("at_least", "match", "both")  # both: maximised as well as at least
DIRECTIONS = {"axial": (0.0, 0.0, 1.0), "lateral": (1.0, 0.0, 0.0)}
MODULUS, CHANNELS, SHIFT, TILT = 0.20, 0.05, 2e-3, np.deg2rad(2.0)
UP_TO = 0.8  # of the highest pressures
STEPS = (0.010, 0.040)  # m between two targets
NEAR = 1e-3  # m; nearer than that for good is settled
CORRECTED = 1e-5  # m; how well the plant's own stiffest pressures reach a target
MOST_CORRECTIONS = 8
PUSH = 2e-4  # m
IDEAL_HOLD, IDEAL_TICK = 1.5, 0.005  # s
WIDTH, SPEED, WAYPOINTS = 0.040, 0.010, 0.2  # figure-eight: m, m/s, and s between waypoints
MARGIN = (0.10, 0.85)  # of the pressures: a path that the model of the plant reaches with these
TRIES = 300
BAR = 1e5
STARTS = 8  # of each search
NUDGE = 1e-4  # bar, for derivatives of the stiffness
REACHED = 2e-5  # m
STIFF, SOFT = -1.0, 1.0  # signs of the value that is made small


@dataclass(frozen=True)
class Aim:
    """A target of a case.

    Attributes
    ----------
    position : of the tip (3,), in m.
    kind : name of the direction to be stiff in, see `DIRECTIONS`.
    drawn, stiffest : the plant's own pressures (n,) for it: those it was drawn with, and the
        stiffest ones, in Pa.
    ideal : settling time of an open-loop step to the stiffest pressures from the aim before, on the
        plant without inertia, creep and hysteresis, in s.
    """

    position: Array
    kind: str
    drawn: Array
    stiffest: Array
    ideal: float


@dataclass(frozen=True)
class Case:
    """One arm and what is asked of it.

    Attributes
    ----------
    seed : that all was drawn from.
    description : of the rig; the dynamics are still open.
    robot : what the simulated arm was made from.
    truth : what the model says with the arm's true values.
    aims : targets, in order.
    believed : the robot file that the controller gets; it never knows of a payload.
    demand : what its tasks demand, of `DEMANDS`, with a share; None: they maximise.
    """

    seed: int
    description: RigDescription
    robot: RobotDescription
    truth: TrueModel
    aims: tuple[Aim, ...]
    believed: RobotDescription
    demand: tuple[str, float] | None = None

    @property
    def registration(self) -> Registration:
        """Where that file has the nominal base frame."""
        recordings = self.believed.recordings
        return Registration() if recordings is None else recordings.registration

    @property
    def point(self) -> Array:
        """What that file calls the tip, as a frame (4, 4) in that of the arm's true tip.

        A calibration of poses alone hardly tells where on the arm's end the sensor is; what it
        calls the tip is the point that is asked to go somewhere.
        """
        return self.registration.tip_in_sensor.transform()

    def target(self, position: Array) -> Target:
        """A place in the nominal base frame as a target in the base frame of that file."""
        here = self.registration.tracker_in_base.transform() @ [*position, 1.0]
        return Target(position=tuple(here[:3].tolist()))

    def arm(self) -> Arm:
        """The arm beside any rig."""
        return Arm(self.robot, self.description.plant, self.truth)

    def task(self, position: Array, kind: str) -> Task:
        """To go there and be stiff in a direction of the nominal base frame."""
        turn = self.registration.tracker_in_base.transform()[:3, :3]
        axis = tuple((turn @ DIRECTIONS[kind]).tolist())
        goal = StiffnessGoal(maximise=StiffnessMeasure(direction=axis))
        task = Task(robot=self.robot.name, target=self.target(position), stiffness=goal)
        if self.demand is None:
            return task
        what, share = self.demand
        best = PressureSolver(load_robot(self.believed), task).solve().stiffness
        value = {"direction": axis, "value": share * float(best or 0.0)}
        demanded = StiffnessGoal.model_validate({
            "maximise": {"direction": axis} if what == "both" else (),
            "at_least": () if what == "match" else value,
            "match": value if what == "match" else None,
        })  # fmt: skip
        return task.model_copy(update={"stiffness": demanded})

    def rig(self, dynamics: str) -> SimulatedRig:
        """The rig, not opened; its tracker is corrected as the controller's robot file says."""
        plant = self.description.plant.model_copy(update={"dynamics": dynamics})
        rig: Any = make_rig(self.description.model_copy(update={"plant": plant}), self.robot)
        rig.tracker.registration = rig.tracker.registration.then(self.registration)
        return rig


def with_true_file(case: Case) -> Case:
    """The case whose controller gets a robot file with the true values, where it has words."""
    update = {"tip_mass": case.robot.tip_mass}
    return replace(case, believed=case.truth.model.description.model_copy(update=update))


def at_tip_speed(case: Case, speed: float | None) -> Case:
    """The case whose rig file has a `control.tip_speed`, in m/s; None: as it is."""
    if speed is None:
        return case
    control = case.description.control.model_copy(update={"tip_speed": speed})
    return replace(case, description=case.description.model_copy(update={"control": control}))


def demanding(case: Case, demand: str | None, share: float) -> Case:
    """The case whose tasks demand a share of the best stiffness that its robot file has there."""
    return case if demand is None else replace(case, demand=(demand, share))


def beside(case: Case, scene: Scene) -> Case:
    """The case whose controller keeps clear of a scene."""
    return replace(case, description=case.description.model_copy(update={"scene": scene}))


def draw_case(
    seed: int,
    targets: int = 3,
    payload: float = 0.0,
    *,
    ranked: bool = True,
    robot_file: str | None = None,
    modulus: float | None = None,
    steps: tuple[float, float] = STEPS,
) -> Case:
    """Draw an arm and targets for it; the controller gets the nominal robot file.

    Parameters
    ----------
    seed : all is drawn from it, also noise.
    targets : how many; their directions take turns, the first one changes with the seed.
    payload : mass at the tip that nobody knows of, beside the 20 g of the robot file, in kg.
    ranked : whether to find each target's stiffest pressures and ideal time, which takes a minute.
    robot_file : nominal one, if not that of the rig.
    modulus : of all segments, over that of the file; None: drawn.
    steps : least and greatest distance between two targets, in m.
    """
    rig = load_rig_description(RIG)
    if robot_file is not None:
        rig = rig.model_copy(update={"robot": robot_file})
    robot = load_description(rig.robot)
    rng = np.random.default_rng([seed, 6])
    mismatch = _mismatch(robot, rng)
    if modulus is not None:
        mismatch = mismatch.model_copy(update={"modulus": (modulus,) * robot.n_segments})
    plant = PlantSettings(mismatch=mismatch, seed=seed, payload=payload)
    tracker = rig.tracker.model_copy(update={"noise": 5e-5})
    rig = rig.model_copy(update={"plant": plant, "tracker": tracker})
    truth = TrueModel(robot, mismatch, payload)
    arm = Arm(robot, plant, truth)
    kinds = list(DIRECTIONS)
    aims: list[Aim] = []
    for k, (position, drawn) in enumerate(places(arm, targets, rng, steps)):
        kind = kinds[(seed + k) % len(kinds)]
        stiffest = arm.stiffest(position, DIRECTIONS[kind], drawn, rng) if ranked else drawn
        aims.append(Aim(position, kind, drawn, stiffest, np.nan))
    case = Case(seed, rig, robot, truth, tuple(aims), robot)
    if not ranked:
        return case
    times = ideal_times(case, [aim.stiffest for aim in aims])
    timed = [replace(aim, ideal=time) for aim, time in zip(aims, times, strict=True)]
    return replace(case, aims=tuple(timed))


def places(
    arm: Arm, count: int, rng: np.random.Generator, steps: tuple[float, float] = STEPS
) -> list[tuple[Array, Array]]:
    """Positions (3,) at rest and their pressures, each a step from the last one."""
    last = arm.settled(np.zeros(len(arm.high)))
    found: list[tuple[Array, Array]] = []
    while len(found) < count:
        pressures = rng.uniform(0, UP_TO, len(arm.high)) * arm.high
        place = arm.settled(pressures)
        if steps[0] <= np.linalg.norm(place - last) <= steps[1]:
            found.append((place, pressures))
            last = place
    return found


def _mismatch(robot: RobotDescription, rng: np.random.Generator) -> Any:
    n, segments = robot.n_pressures, robot.n_segments
    axes = rng.standard_normal((2, 3))
    shift, turn = axes / np.linalg.norm(axes, axis=1)[:, None] * [[SHIFT], [TILT]]
    base = np.asarray(lie.exp(np.concatenate([np.zeros(3), turn])))
    base[:3, 3] = shift
    return Mismatch(
        gain=tuple((1 + rng.uniform(-CHANNELS, CHANNELS, n)).tolist()),
        offset=(0.0,) * n,
        angle=(0.0,) * n,
        modulus=tuple((1 + rng.uniform(-MODULUS, MODULUS, segments)).tolist()),
        length=(1.0,) * segments,
        base=Placement.of(base),
    )


class Arm:
    """The simulated arm beside any rig, at rest, without creep and hysteresis."""

    def __init__(self, robot: RobotDescription, plant: PlantSettings, truth: TrueModel) -> None:
        self.high = np.array(robot.pressure_max)
        self._plant = Plant(robot, without_memory(plant))
        self._truth = truth

    def settled(self, pressures: Array) -> Array:
        """Tip (3,) where it comes to rest."""
        self._plant.settle(pressures)
        return np.array(self._plant.tip_pose()[:3, 3])

    def stiffness(self, pressures: Array, direction: tuple[float, ...]) -> float:
        """Of the tip along a unit vector, in N/m, from small pushes and pulls."""
        d = np.array(direction)
        push = PUSH * self._truth.stiffness(pressures, direction)
        ends = []
        for sign in (1.0, -1.0):
            self._plant.settle(pressures, PlantLoad(force=tuple((sign * push * d).tolist())))
            ends.append(self._plant.tip_pose()[:3, 3] @ d)
        self._plant.set_load(None)
        return 2 * push / float(ends[0] - ends[1])

    def stiffest(
        self, position: Array, direction: tuple[float, ...], drawn: Array, rng: np.random.Generator
    ) -> Array:
        """Stiffest pressures that bring this arm there: those of the true model, corrected.

        `drawn` are pressures that are known to do so.
        """
        goal = position + self._truth.position(drawn) - self.settled(drawn)
        best = self._truth.choice(drawn, direction, rng, at=goal).stiffest
        return self._corrected(position, goal, best, direction, STIFF)

    def _corrected(
        self, place: Array, goal: Array, p: Array, direction: tuple[float, ...], sign: float
    ) -> Array:
        """Extreme pressures of the true model for a goal, moved until this arm is at the place."""
        for _ in range(MOST_CORRECTIONS):
            error = place - self.settled(p)
            if np.linalg.norm(error) < CORRECTED:
                break
            goal = goal + error
            moved = self._truth.extreme(goal, direction, p, sign)
            if moved is None:
                break
            p = moved
        return p

    def kept(self, pressures: Array, direction: tuple[float, ...], choice: Choice) -> float:
        """Share of the stiffness that this arm can choose, where these pressures hold it.

        Its softest and stiffest pressures are taken to be those of the true model, but for small
        corrections that bring the tip to the same place; then all three are tried on the arm.
        """
        place = self.settled(pressures)
        ends = []
        for extreme, sign in ((choice.softest, SOFT), (choice.stiffest, STIFF)):
            goal = self._truth.position(extreme)
            p = self._corrected(place, goal, extreme, direction, sign)
            ends.append(self.stiffness(p, direction))
        return (self.stiffness(pressures, direction) - ends[0]) / (ends[1] - ends[0])


def without_memory(plant: PlantSettings) -> PlantSettings:
    """The same arm without inertia, creep and hysteresis."""
    silicone = plant.silicone.model_copy(update={"creep": (), "hysteresis": ()})
    return plant.model_copy(update={"dynamics": "quasi-static", "silicone": silicone})


def ideal_times(case: Case, pressures: list[Array]) -> list[float]:
    """Settling times of steps to these pressures, commanded at once, from rest at 0 Pa, in s."""
    supply = case.description.supply.model_copy(update={"ripple": 0.0})
    update = {"plant": without_memory(case.description.plant), "supply": supply, "tracker": None}
    rig: Any = make_rig(case.description.model_copy(update=update), case.robot)
    times = []
    ticks = round(IDEAL_HOLD / IDEAL_TICK)
    with rig:
        rig.supply.arm()
        for p in pressures:
            rig.supply.command(p)
            tips = []
            for _ in range(ticks):
                rig.clock.sleep(IDEAL_TICK)
                tips.append(rig.world.plant.tip_pose()[:3, 3])
            errors = np.linalg.norm(np.array(tips) - tips[-1], axis=1)
            times.append(settling_time(IDEAL_TICK * (1 + np.arange(ticks)), errors, 0.1))
    return times


def settling_time(times: Array, errors: Array, stays: float) -> float:
    """When errors (T,) in m come below `NEAR` for good, in s; infinite if they do not.

    `stays` is the time in s at the end in which they must not leave that again.
    """
    outside = np.flatnonzero(errors >= NEAR)
    if not len(outside):
        return 0.0
    last = outside[-1]
    return float(times[last]) if times[last] <= times[-1] - stays else np.inf


@dataclass(frozen=True)
class Path8:
    """A figure-eight at constant speed.

    Attributes
    ----------
    times : since its beginning (k,), in s.
    positions : (k, 3), in m.
    """

    times: Array
    positions: Array

    def at(self, times: Array) -> Array:
        """Places (m, 3) at times (m,); before and after the path its ends."""
        return np.stack([np.interp(times, self.times, axis) for axis in self.positions.T], axis=1)


def draw_path(case: Case) -> Path8:
    """A horizontal figure-eight that the arm reaches, by its true model and with room to spare.

    Raises
    ------
    RuntimeError
        None was found; draw another case.
    """
    rng = np.random.default_rng([case.seed, 8])
    high = np.array(case.robot.pressure_max)
    turns = np.linspace(0, 2 * np.pi, 2001)
    shape = WIDTH / 2 * np.stack([np.sin(turns), np.sin(turns) * np.cos(turns)], axis=1)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(shape, axis=0), axis=1))])
    times = np.linspace(0, way[-1] / SPEED, round(way[-1] / SPEED / WAYPOINTS) + 1)
    plane = np.stack([np.interp(times * SPEED, way, axis) for axis in shape.T], axis=1)
    for _ in range(TRIES):
        angle = rng.uniform(0, 2 * np.pi)
        p = rng.uniform(*MARGIN, len(high)) * high
        axes = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0]])
        positions = case.truth.position(p) + plane @ axes
        for position in positions[::4]:
            reached = case.truth.reach(position, p, *(share * high for share in MARGIN))
            if reached is None:
                break
            p = reached
        else:
            return Path8(times, positions)
    raise RuntimeError(f"no figure-eight was found for seed {case.seed}")


# -- robot files as a user would make them -------------------------------------------------------

RECORDING_SEED = 10_000  # to the seed, so that the noise is not that of the control's run
RECORDED = Sizes(repetitions=1, structure="creep", rows=300, trial_rows=100)
"""Two and a half minutes of the paper's sequence and poses; the model is named to save time."""


def calibrated_file(case: Case, folder: Path) -> RobotDescription:
    """The calibrated robot file of a case's arm.

    Parameters
    ----------
    case : whose arm it is; what it carries beside the robot file's mass is put on afterwards.
    folder : gets the recording and the file, or has them from a run before.
    """
    path = folder / f"arm-{case.seed}.yaml"
    if not path.exists():
        plant = case.description.plant.model_copy(
            update={"dynamics": "full", "seed": case.seed + RECORDING_SEED, "payload": 0.0}
        )
        rig = case.description.model_copy(update={"plant": plant})
        folder.mkdir(parents=True, exist_ok=True)
        logs = recorded(rig, case.robot, RECORDED, folder / f"recording-{case.seed}")
        settings = CalibrationSettings(
            structure=RECORDED.structure, strain_law="keep", sequence=True,
            rows=RECORDED.rows, trial_rows=RECORDED.trial_rows,
        )  # fmt: skip
        save_robot(path, calibrate(case.robot, logs, settings=settings).robot)
    return load_description(path)


def believed_file(case: Case, folder: Path, *, true: bool) -> RobotDescription:
    """The robot file of a case's arm with its true values, or as `calibrated_file`."""
    if true:
        return with_true_values(case.robot, case.description.plant.mismatch)
    return calibrated_file(case, folder)


def with_calibrated_file(case: Case, folder: Path) -> Case:
    """The case whose controller gets that file."""
    return replace(case, believed=calibrated_file(case, folder))


# -- the true model -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Choice:
    """What can be chosen at a place of the tip.

    Attributes
    ----------
    least, most : stiffness, in N/m.
    softest, stiffest : pressures (n,) for them, in Pa.
    """

    least: float
    most: float
    softest: Array
    stiffest: Array


class TrueModel:
    """The model with the arm's true values, in the nominal base frame.

    Attributes
    ----------
    model : Manipulator
        In the arm's own, true base frame.
    base : that frame (4, 4) in the nominal one.
    """

    def __init__(self, robot: RobotDescription, mismatch: Mismatch, payload: float = 0.0) -> None:
        self.base: Array = mismatch.base.transform()
        update = {"tip_mass": robot.tip_mass + payload}
        self.model = load_robot(with_true_values(robot, mismatch).model_copy(update=update))
        # nobody needs the code of this very arm again
        cache = tempfile.TemporaryDirectory()
        with cache, patch.dict(os.environ, STIFFOPT_CACHE_DIR=cache.name):
            self._tip = TipModel(self.model)

    def position(self, pressures: Array) -> Array:
        """Tip (3,)."""
        return self._place(pressures)[0]

    def _place(self, pressures: Array) -> tuple[Array, Array]:
        """Tip (3,) and its derivative (3, n) by the pressures."""
        pose, jacobian, _ = self._tip.at(pressures)
        pose = self.base @ pose
        return pose[:3, 3], pose[:3, :3] @ jacobian[:3]

    def stiffness(self, pressures: Array, direction: tuple[float, ...]) -> float:
        """Of the free tip along a unit vector in the nominal base frame, in N/m."""
        pose, _, compliance = self._tip.at(pressures)
        d = (self.base[:3, :3] @ pose[:3, :3]).T @ np.array(direction)
        return float(1 / (d @ compliance[:3, :3] @ d))

    def reach(self, position: Array, start: Array, low: Array, high: Array) -> Array | None:
        """Pressures (n,) that bring the tip there, near to others; None where none were found."""
        x0 = np.clip(start, low + 1e-3 * (high - low), high - 1e-3 * (high - low)) / BAR
        found = least_squares(
            lambda x: 1e3 * (self._place(BAR * x)[0] - position),
            x0,
            lambda x: 1e3 * BAR * self._place(BAR * x)[1],
            bounds=(low / BAR, high / BAR),
            xtol=1e-6,
        )
        return BAR * found.x if np.linalg.norm(found.fun) < 1e3 * REACHED else None

    def choice(
        self,
        pressures: Array,
        direction: tuple[float, ...],
        rng: np.random.Generator,
        at: Array | None = None,
    ) -> Choice:
        """The softest and the stiffest way to hold the tip where these pressures hold it, or `at`.

        Raises
        ------
        RuntimeError
            The place cannot be reached.
        """
        low, high = (np.array(v) for v in (self.model.pressure_min, self.model.pressure_max))
        place = self.position(pressures) if at is None else at
        starts = [pressures]
        for _ in range(STARTS - 1):
            start = self.reach(place, rng.uniform(low, high), low, high)
            if start is not None:
                starts.append(start)
        found = [
            (self.stiffness(p, direction), p)
            for start in starts
            for sign in (STIFF, SOFT)
            if (p := self.extreme(place, direction, start, sign)) is not None
        ]
        if at is None:
            found.append((self.stiffness(pressures, direction), pressures))
        if not found:
            raise RuntimeError("the true model does not reach the place")
        (least, softest), (most, stiffest) = (
            f(found, key=lambda each: each[0]) for f in (min, max)
        )
        return Choice(least, most, softest, stiffest)

    def extreme(
        self, place: Array, direction: tuple[float, ...], start: Array, sign: float
    ) -> Array | None:
        """A local optimum (n,) of the stiffness at a place, for `STIFF` or `SOFT`."""
        low, high = (np.array(v) / BAR for v in (self.model.pressure_min, self.model.pressure_max))

        def value(x: Array) -> float:
            return sign * float(np.log(self.stiffness(BAR * x, direction)))

        def gradient(x: Array) -> Array:
            here, steps = value(x), np.where(x + NUDGE <= high, NUDGE, -NUDGE)
            return np.array([
                (value(x + step * unit) - here) / step
                for step, unit in zip(steps, np.eye(len(x)), strict=True)
            ])  # fmt: skip

        found = minimize(
            value, np.clip(start / BAR, low, high), jac=gradient, method="SLSQP",
            bounds=list(zip(low, high, strict=True)),
            constraints={
                "type": "eq",
                "fun": lambda x: 1e3 * (self._place(BAR * x)[0] - place),
                "jac": lambda x: 1e3 * BAR * self._place(BAR * x)[1],
            },
            options={"maxiter": 80, "ftol": 1e-7},
        )  # fmt: skip
        p = BAR * np.clip(found.x, low, high)
        return p if np.linalg.norm(self.position(p) - place) < REACHED else None
