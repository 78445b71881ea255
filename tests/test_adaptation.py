"""The arm's numbers, adapted at rest: slopes, the estimate, its bounds, and the loop with it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

import stiffopt as so
from stiffopt.control.adaptation import Adaptation, Adapted, Window
from stiffopt.control.tuning import AdaptationTuning, WindowTuning
from stiffopt.control.windows import WindowWatch
from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_measure
from stiffopt.model.calibration import Calibration, FittedParameter
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.tip import TipModel
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import PlantLoad
from stiffopt.rig.settings import ControlSettings
from test_controller import Bench

Array = NDArray[np.float64]

BAR = 1e5
HANGING = load_description("stiff-flop-2-hanging")
FREE = load_description("stiff-flop-2")
TUNING = AdaptationTuning()
RNG = np.random.default_rng(5)
POSTURES = RNG.uniform(0, 0.8, (4, 6)) * 1.5 * BAR
LATERAL = checked_measure((1.0, 0.0, 0.0), "translation", "free", "base")
K = 2 + 6 + 6
"""Coordinates of the free arm: moduli and gains by segment, twist of the base."""
DEVIATION = 0.3  # of a modulus, before anything is seen
TRUTH = np.array([0.15, 0.02, -0.03, 0.03, -0.1, 0.01, -0.02, 0.0, *[1e-3] * 3, 0.01, -0.01, 0.0])


def arm_at(z: Array, own: RobotDescription = FREE, mass: float = 0.0) -> TipModel:
    """The arm with other moduli and gains, and a mass at its tip, by other code than is tested."""
    values = {}
    for segment in range(2):
        key = f"segments[{segment}]"
        modulus = Parameter(f"{key}.material.youngs_modulus")
        values[modulus] = modulus.value(own) * np.exp(z[4 * segment])
        for c in range(3):
            values[Parameter(f"{key}.corrections.gain[{c}]")] = np.exp(z[4 * segment + 1 + c])
    changed = with_values(own, values)
    return TipModel(so.load_robot(changed.model_copy(update={"tip_mass": own.tip_mass + mass})))


def pose_at(z: Array, p: Array, own: RobotDescription = FREE, mass: float = 0.0) -> Array:
    return np.asarray(so.lie.exp(z[-6:])) @ arm_at(z, own, mass).at(p).pose


def difference(after: Array, before: Array) -> Array:
    """Position and rotation vector (6,) of a pose relative to another, in base axes."""
    turn = so.lie.log(so.lie.transform(after[:3, :3] @ before[:3, :3].T, np.zeros(3)))
    return np.concatenate([after[:3, 3] - before[:3, 3], np.asarray(turn)[3:]])


def window(z: Array, p: Array, turned: bool = True) -> Window:
    pose = pose_at(z, p)
    return Window(0.0, p, pose[:3, 3], pose[:3, :3] if turned else None)


# -- the estimate -------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiled")
def test_slopes_are_those_of_the_arm() -> None:
    """Of a hanging arm, which has a mass too."""
    adaptation = Adaptation(HANGING, TUNING)
    p, step, none = POSTURES[0], 1e-3, np.zeros(K)
    before = pose_at(none, p, HANGING)
    seen = Window(0.0, p, before[:3, 3], before[:3, :3])
    errors, slopes = adaptation._linearised([seen], np.zeros(K + 1))
    assert errors == pytest.approx(np.zeros(6), abs=1e-6)
    for index in (0, 2, 4, 8, 9, 12, 14):
        z, mass = np.zeros(K + 1), 0.0
        z[index] = step
        if index == 8:
            mass, z[index] = step, 0.0
        z = np.delete(z, 8)
        ends = [pose_at(sign * z, p, HANGING, sign * mass) for sign in (1, -1)]
        slope = difference(*ends) / (2 * step)
        assert slopes[:, index] == pytest.approx(slope, abs=1e-3 * max(0.1, np.abs(slope).max()))


def test_the_estimate_is_the_most_likely_one() -> None:
    """Found by a least-squares program of its own, from the prior and the same discrepancy."""
    adaptation = Adaptation(FREE, AdaptationTuning(iterations=4))
    windows = [window(TRUTH, p) for p in POSTURES[:2]]
    adaptation.take(windows)
    whiten = np.linalg.inv(np.linalg.cholesky(adaptation._noise(windows)))
    prior = np.sqrt(np.diag(adaptation._prior))

    def residuals(x: Array) -> Array:
        rows = []
        for seen in windows:
            assert seen.rotation is not None
            there = so.lie.transform(seen.rotation, seen.position)
            rows.append(difference(np.asarray(there), pose_at(x * prior, seen.pressures)))
        return np.concatenate([whiten @ np.concatenate(rows), x])

    start = adaptation.estimate / prior
    found = least_squares(residuals, start, diff_step=1e-3, max_nfev=4)
    assert start == pytest.approx(found.x, abs=0.02)
    own = np.linalg.inv(found.jac.T @ found.jac) * np.outer(prior, prior)
    deviations = np.sqrt(np.diag(adaptation.covariance))
    assert deviations == pytest.approx(np.sqrt(np.diag(own)), rel=0.05)


def test_numbers_come_nearer_to_those_of_the_arm_and_their_intervals_hold_them() -> None:
    adaptation = Adaptation(FREE, TUNING)
    adaptation.take([window(TRUTH, p, turned=False) for p in POSTURES])
    # of an arm without weight only the ratio to the gains can be seen, and these are known better
    assert adaptation.estimate[[0, 4]] == pytest.approx(TRUTH[[0, 4]], abs=0.06)
    deviations = np.sqrt(np.diag(adaptation.covariance))
    assert np.all(np.abs(adaptation.estimate - TRUTH) < 2 * deviations)
    assert deviations[[0, 4]].max() < 0.3 * DEVIATION
    told = {number.key: number for number in adaptation.report()}
    modulus = told["segments[0].material.youngs_modulus"]
    before = FREE.segments[0].material.youngs_modulus
    assert modulus.value == pytest.approx(before * np.exp(adaptation.estimate[0]))
    assert modulus.deviation == pytest.approx(modulus.value * deviations[0])
    assert told["base.tilt_x"].deviation == pytest.approx(deviations[11])
    assert "tip_mass" not in told  # without gravity it is not seen
    there, true = adaptation._with(adaptation.estimate), arm_at(TRUTH)
    applied, p = adaptation.estimate, POSTURES[0]
    narrow = adaptation.deviation(p, LATERAL, applied)
    assert adaptation.deviation(p, LATERAL, 0.8 * applied) > narrow  # not applied yet
    for p in POSTURES:
        pose, _, compliance = true.at(p)
        k = so.load_robot(there).stiffness(p, LATERAL.direction)
        ratio = k * (pose[0, :3] @ compliance[:3, :3] @ pose[0, :3])
        assert ratio == pytest.approx(1, abs=0.1)
        assert abs(np.log(ratio)) < 2 * adaptation.deviation(p, LATERAL, applied)


def test_one_posture_tells_no_more_a_thousand_times() -> None:
    one, many = Adaptation(FREE, TUNING), Adaptation(FREE, TUNING)
    seen = window(TRUTH, POSTURES[0])
    one.take([seen])
    many.take([seen] * 30)
    assert many.estimate == pytest.approx(one.estimate, abs=3e-3)
    assert np.diag(many.covariance) == pytest.approx(np.diag(one.covariance), rel=0.03)


@pytest.mark.usefixtures("compiled")
def test_the_search_for_a_soft_arm_ends_at_its_numbers() -> None:
    """A full first step from the file's numbers leads to numbers that fit several times worse."""
    adaptation, truth = Adaptation(HANGING, TUNING), np.zeros(K)
    truth[[0, 4]] = np.log([0.74, 0.69])
    p = np.array([0.69, 1.14, 1.44, 1.5, 0.0, 0.0]) * BAR
    pose = pose_at(truth, p, HANGING)
    seen = [Window(0.0, p, pose[:3, 3], pose[:3, :3])]
    adaptation.take(seen)
    errors, _ = adaptation._linearised(seen, adaptation.estimate)
    assert np.abs(errors[:3]).max() < 1e-3
    deviations = np.sqrt(np.diag(adaptation.covariance))
    assert np.all(np.abs(adaptation.estimate[[0, 4]] - truth[[0, 4]]) < 2 * deviations[[0, 4]])


@pytest.mark.usefixtures("compiled")
def test_a_window_without_equilibrium_tells_nothing() -> None:
    own = HANGING.model_copy(update={"gravity": (0.0, 0.0, -9.81)})  # it stands
    heavy = own.model_copy(update={"tip_mass": 0.5})
    adaptation, p = Adaptation(heavy, TUNING), POSTURES[0]
    seen = Window(0.0, p, np.array([0.0, 0.0, 0.1]), np.eye(3))
    errors, _ = adaptation._linearised([seen], adaptation.estimate)
    assert np.isnan(errors).all()
    adaptation.take([seen])
    assert not adaptation.estimate.any()
    assert adaptation.covariance == pytest.approx(adaptation._prior)


def test_old_windows_are_forgotten_towards_the_prior() -> None:
    adaptation = Adaptation(FREE, TUNING)
    old = [window(TRUTH, p) for p in POSTURES[:2]]
    later = Window(20 * TUNING.memory, POSTURES[2], np.full(3, np.nan), None)
    adaptation.take([*old, later])
    assert adaptation.estimate == pytest.approx(np.zeros(K), abs=1e-3)
    assert adaptation.covariance == pytest.approx(adaptation._prior, rel=1e-3, abs=1e-9)


def test_numbers_stay_in_the_region_of_the_prior() -> None:
    adaptation = Adaptation(FREE, TUNING)
    wild = [Window(0.0, p, np.array([0.15, -0.1, 0.02]), None) for p in POSTURES]
    adaptation.take(wild)
    within = np.abs(adaptation.estimate) / np.sqrt(np.diag(adaptation._prior))
    assert within.max() <= TUNING.bound + 1e-9
    step = adaptation.step_from(adaptation.none_applied)
    assert step is None or np.abs(step.applied[[0, 4]]).max() <= TUNING.step * DEVIATION + 1e-9


def test_steps_lead_to_the_estimate_and_end_there() -> None:
    adaptation = Adaptation(FREE, TUNING)
    adaptation.estimate = TRUTH.copy()
    adaptation.estimate[0] = 2.2 * DEVIATION
    applied, count = adaptation.none_applied, 0
    while (step := adaptation.step_from(applied)) is not None:
        applied, count = step.applied, count + 1
    assert count == 3
    assert applied[0] == pytest.approx(2.2 * DEVIATION)
    assert not applied[1:4].any()  # gains: this robot file has none
    assert not applied[8:].any()  # nor frames: the offset has them


def test_after_a_model_without_equilibrium_steps_do_not_lead_there_again() -> None:
    adaptation = Adaptation(FREE, TUNING)
    good = Adapted(FREE, np.zeros(K))
    failed = Adapted(FREE, np.where(np.arange(K) == 4, -0.5, 0.0))
    good = good.short_of(failed)
    adaptation.estimate[[0, 4]] = -0.2, -0.7  # the second segment's modulus has failed, lower
    step = adaptation.step_from(good.applied, good.limits)
    assert step is not None
    assert step.applied[[0, 4]] == pytest.approx([-0.2, 0.0])
    assert step.limits is good.limits
    assert adaptation.is_beyond(good.limits)
    adaptation.estimate[[0, 4]] = -0.2, 0.2
    step = adaptation.step_from(step.applied, step.limits)
    assert step is not None
    assert step.applied[[0, 4]] == pytest.approx([-0.2, 0.2])
    assert not adaptation.is_beyond(step.limits)
    again = good.short_of(Adapted(FREE, good.applied + 0.1, good.limits)).limits
    assert again is not None
    assert again[0, 4] == again[1, 4] == 0.0  # neither lower nor higher


def test_the_prior_of_a_calibrated_file_is_its_covariance() -> None:
    keys = ("segments[0].material.youngs_modulus", "segments[1].material.youngs_modulus")
    fitted = [FittedParameter(key=key, deviation=0.02, prior=0.3) for key in keys]
    known = Calibration(
        parameters=fitted, correlation=[[1.0, -0.5], [-0.5, 1.0]], position_residual=1e-3
    )
    adaptation = Adaptation(FREE.model_copy(update={"calibration": known}), TUNING)
    own = adaptation._prior[:2, :2]
    assert own == pytest.approx(np.array([[4e-4, -2e-4], [-2e-4, 4e-4]]))
    adaptation.take([window(TRUTH, p) for p in POSTURES])
    assert np.abs(adaptation.estimate[:2]).max() <= 3 * 0.02 + 1e-9


# -- windows ------------------------------------------------------------------------------------


class Watched:
    """A watch that is told of a resting arm every 40 ms."""

    def __init__(self) -> None:
        self.watch, self.now = WindowWatch(WindowTuning()), 0.0
        self.tip: Any = SimpleNamespace(position=np.zeros(3), turn_known=False)

    def rest(
        self, seconds: float, pressure: float = 0.5 * BAR, x: float = 0.0, rate: float = 0.0
    ) -> Watched:
        self.tip.position = np.array([x, 0.0, 0.2])
        for _ in range(round(seconds * 25)):
            self.now += 0.04
            self.watch.look(self.now, np.full(2, pressure) + rate * self.now, self.tip)
        return self

    def move(self) -> Watched:
        self.watch.begin()
        return self

    @property
    def count(self) -> int:
        return len(self.watch.windows)


def test_a_window_needs_rest() -> None:
    watched = Watched().rest(1.3)
    assert watched.count == 0
    assert watched.rest(0.2).count == 1
    (seen,) = watched.watch.windows
    assert seen.pressures == pytest.approx([0.5 * BAR] * 2)
    assert seen.position == pytest.approx([0, 0, 0.2])
    assert Watched().rest(1.2).move().rest(1.2).count == 0
    assert Watched().rest(9.0, rate=8e3).count == 0  # it creeps on


def test_of_each_posture_the_newest_counts_and_a_load_makes_others_void() -> None:
    watched = Watched()
    for pressure in (0.5, 0.8, 0.5):
        watched.move().rest(1.6, pressure * BAR)
    assert watched.count == 2
    assert watched.watch.windows[-1].time == pytest.approx(watched.now, abs=0.3)
    assert watched.move().rest(1.6, 0.8 * BAR, x=1e-3).count == 2
    assert watched.move().rest(1.6, 0.8 * BAR, x=5e-3).count == 1
    for k in range(12):
        watched.move().rest(1.6, (1.0 + 0.1 * k) * BAR)
    assert watched.count == WindowTuning().most


# -- in the loop --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["stiff-flop-2-hanging", "stiff-flop-2"])
@pytest.mark.usefixtures("compiled")
def test_a_changed_model_is_that_of_the_other_arm(name: str) -> None:
    own = load_description(name)
    soft = with_values(own, {Parameter("segments[0].material.youngs_modulus"): 7e4})
    heavy = so.load_robot(soft.model_copy(update={"tip_mass": 0.03}))
    model, before = TipModel(so.load_robot(name)), so.load_robot(name).tip_pose(POSTURES[0])
    assert model.at(POSTURES[0]).pose == pytest.approx(before, abs=1e-6)
    model.change(heavy)
    other = TipModel(heavy).at(POSTURES[0])
    for found, expected in zip(model.at(POSTURES[0]), other, strict=True):
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert np.abs(other.pose - before).max() > 1e-3


@pytest.mark.usefixtures("compiled")
def test_a_change_of_the_model_moves_nothing() -> None:
    bench = Bench(HANGING.name, control=ControlSettings(adaptation="none"))
    position = bench.settled(duration=1.5)
    controller = bench.controller
    before = controller.status(bench.rig.clock.now())
    values = {
        Parameter(f"segments[{k}].material.youngs_modulus"): share * 1e5
        for k, share in enumerate((1.15, 0.9))
    }
    heavier = with_values(HANGING, values).model_copy(update={"tip_mass": 0.03})
    controller._go_on_with(Adapted(heavier, np.zeros(K)))
    after = controller.status(bench.rig.clock.now())
    assert after.tip_position == pytest.approx(before.tip_position, abs=1e-9)
    assert after.tip_quaternion == pytest.approx(before.tip_quaternion, abs=1e-9)
    assert np.linalg.norm(after.disturbance - before.disturbance) > 1e-3
    last = bench.command
    bench.run(bench.period, position)
    assert np.abs(bench.command - last).max() < 0.02 * BAR
    assert bench.run(1.5, position).max() < 1e-3
    assert [notice.kind for notice in controller.notices()] == []


SOFT = {f"segments[{k}].material.youngs_modulus": 1e5 * m for k, m in enumerate((0.782, 0.586))}
"""Moduli with which the hanging arm rests where it does in most postures, but not in this one:"""
TOO_MUCH = np.array([1.376, 0.286, 0.291, 0.014, 0.916, 1.467]) * BAR


def too_soft(pressures: Array) -> Bench:
    """A hanging arm at rest at the tip of some pressures, and a controller that has it too soft."""
    bench = Bench(HANGING.name, control=ControlSettings(adaptation="none"), spread=0.0)
    bench.settled(pressures / BAR, duration=1.5)
    soft = with_values(HANGING, {Parameter(key): value for key, value in SOFT.items()})
    applied = np.zeros(K + 1)
    applied[[0, 4]] = np.log([0.782, 0.586])
    bench.controller._go_on_with(Adapted(soft, applied))
    adapted = bench.controller.replanner.adapted
    assert adapted is not None
    assert adapted.limits is None
    return bench


@pytest.mark.usefixtures("compiled")
def test_an_arm_goes_on_where_its_adapted_model_has_no_equilibrium() -> None:
    bench = too_soft(0.6 * TOO_MUCH)
    position = tuple(map(float, bench.pose_at(TOO_MUCH)[:3, 3]))
    bench.controller.set_target(so.Target(position=position))
    assert bench.run(4.0, position)[-20:].max() < 1e-3
    adapted = bench.controller.replanner.adapted
    assert adapted is not None
    assert adapted.limits is not None
    assert not adapted.applied.any()
    assert adapted.limits[0, [0, 4]].tolist() == [0.0, 0.0]  # no softer
    (notice,) = bench.controller.notices()
    assert (notice.kind, notice.standing, notice.hold) == ("too-soft", True, False)
    assert "softer" in notice.text
    status = bench.controller.status(bench.rig.clock.now())
    own = so.load_robot(HANGING).tip_pose(bench.controller._arm.pressures.effective)
    assert status.model_position == pytest.approx(own[:3, 3], abs=2e-4)


@pytest.mark.usefixtures("compiled")
def test_going_back_to_an_earlier_model_moves_nothing() -> None:
    bench = too_soft(0.6 * TOO_MUCH)
    controller = bench.controller
    before = controller.status(bench.rig.clock.now())
    controller._arm.on_path(TOO_MUCH)
    after = controller.status(bench.rig.clock.now())
    assert after.tip_position == pytest.approx(before.tip_position, abs=1e-9)
    assert after.tip_quaternion == pytest.approx(before.tip_quaternion, abs=1e-9)
    assert np.linalg.norm(after.disturbance - before.disturbance) > 1e-3
    last = bench.command
    bench.run(bench.period)
    assert np.abs(bench.command - last).max() < 0.02 * BAR
    assert not controller._go_back(TOO_MUCH)  # the robot file's own model is all that is left


@pytest.mark.usefixtures("compiled")
def test_a_waypoint_without_an_equilibrium_of_the_adapted_model_is_refused() -> None:
    bench = too_soft(0.6 * TOO_MUCH)
    controller = bench.controller
    waypoints = []
    for time, p in enumerate((0.6 * TOO_MUCH, 0.8 * TOO_MUCH, TOO_MUCH)):
        target = so.Target(position=tuple(map(float, bench.pose_at(p)[:3, 3])))
        waypoints.append(Waypoint(time=2.0 * time, target=target, pressures=tuple(p)))
    words = r"^waypoints\[2\]\.pressures: by the adapted model the arm has no equilibrium there"
    with pytest.raises(InputError, match=words):
        controller.check_ahead(Trajectory(waypoints=waypoints))
    controller.check_ahead(Trajectory(waypoints=waypoints[:2]))
    adapted = controller.replanner.adapted
    controller._arm.at_waypoint(0.8 * TOO_MUCH)
    assert controller.replanner.adapted is adapted
    controller._arm.at_waypoint(TOO_MUCH)  # where a change of the model is later than that check
    assert controller.replanner.adapted is not adapted
    controller.check_ahead(Trajectory(waypoints=waypoints))  # the file's model has one


def true_stiffness(bench: Bench, force: float = 2e-3) -> float:
    """Of the simulated arm, along x, at rest without creep and hysteresis."""
    settings = bench.description.plant
    silicone = settings.silicone.model_copy(update={"creep": (), "hysteresis": ()})
    plant = Plant(bench.robot, settings.model_copy(update={"silicone": silicone}))
    ends = []
    for sign in (1.0, -1.0):
        plant.settle(bench.rig.world.pressures, PlantLoad(force=(sign * force, 0.0, 0.0)))
        ends.append(plant.tip_pose()[0, 3])
    return 2 * force / float(ends[0] - ends[1])


@pytest.mark.usefixtures("compiled")
def test_the_loop_knows_the_arms_stiffness_and_has_less_to_make_up_for() -> None:
    mismatch: dict[str, Any] = {"modulus": [0.8, 1.15], "base": {"position": [1e-3, -1e-3, 0.0]}}
    bench = Bench(HANGING.name, plant={"mismatch": mismatch})
    controller = bench.controller
    nominal = so.load_robot(HANGING)
    left = without = 0.0
    for pressures in ((0.9, 0.2, 0.3, 0.2, 0.8, 0.1), (0.1, 0.8, 0.4, 0.9, 0.3, 0.2)):
        position = bench.settled(pressures, duration=1.0)
        assert bench.run(4.0, position).max() < 1e-3
        assert bench.run(0.3, position).mean() < 2e-4
        status = controller.status(bench.rig.clock.now())
        modelled = nominal.tip_pose(bench.rig.world.pressures)[:3, 3]
        left += np.linalg.norm(status.disturbance)
        without += np.linalg.norm(status.tip_position - modelled)
    assert left < 0.6 * without  # where the arm rests among equally stiff postures is chance
    assert len(controller._windows.windows) >= 2
    true = true_stiffness(bench)
    assert status.stiffness == pytest.approx(true, rel=0.1)
    assert status.stiffness_low < true < status.stiffness_high
    assert status.stiffness_high < 1.5 * status.stiffness_low
    told = {number.key: number for number in status.adapted}
    for segment, share in enumerate(mismatch["modulus"]):
        number = told[f"segments[{segment}].material.youngs_modulus"]
        assert abs(number.value - share * 1e5) < 2 * number.deviation
        assert number.deviation < 0.5 * DEVIATION * 1e5
