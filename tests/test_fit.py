"""Calibrations of arms that are known: what is found, what is chosen, what is refused."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from known_arms import (
    BASE,
    BY_NAME,
    HANGING,
    HISTORIES,
    KPA,
    ONE,
    TRUE_VALUES,
    log_of,
    result_of,
    settings,
    true_robot,
    true_value,
    with_history,
)
from made_logs import course, made_log, reddened
from stiffopt import lie
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.identify import calibration
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.fit import fit
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.validation import validate
from stiffopt.logs import Log, StiffnessTable
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description, save_robot

Array = NDArray[np.float64]


# -- what is found --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", HISTORIES)
def test_a_known_robot_is_found(kind: str) -> None:
    result = result_of(kind, kind)
    noise = 3e-4 * np.sqrt(8 / np.pi)  # mean norm of three normal errors
    assert result.nominal[0].errors.mean > 5e-3
    assert result.calibrated[0].errors.mean < 1.15 * noise
    listed = [e for e in result.estimates if e.key and ".play" not in e.key]
    inside = [e.low <= true_value(e.key, kind) <= e.high for e in listed]
    assert np.mean(inside) > 0.85
    for key in ("length", "material.youngs_modulus", "compensation.area"):
        (found,) = (e for e in listed if e.key == f"segments[0].{key}")
        assert found.value == pytest.approx(TRUE_VALUES[found.key], rel=0.04)
        assert found.value == pytest.approx(Parameter(found.key).value(result.robot), rel=1e-6)
        assert found.before == Parameter(found.key).value(ONE)


@pytest.mark.parametrize("kind", HISTORIES)
def test_it_predicts_another_day(kind: str) -> None:
    robot = result_of(kind, kind).robot
    (found,) = validate(robot, [("b.csv", log_of(kind, seed=2, duration=40.0))])
    assert found.errors.mean < 0.8e-3
    assert found.errors.n == 400
    (before,) = validate(ONE, [("b.csv", log_of(kind, seed=2, duration=40.0))])
    assert before.errors.mean > 5e-3


def test_play_of_elongation_is_found_and_chosen() -> None:
    """An arm that keeps more of its elongation than of its bending, and creeps."""
    plays = (Play(width=10 * KPA, share=0.15), Play(width=40 * KPA, share=0.4, of="elongation"))
    creep = (Creep(time=20.0, share=0.1),)
    history = History(lag=0.5, lag_falling=0.8, softening=-0.2 / 1e5, play=plays, creep=creep)
    robot = with_history(true_robot("static"), history)
    first, second = (
        ("log.csv", made_log(robot, *course(3, 60.0, seed, rate=5.0), base=BASE, noise=3e-4))
        for seed in (1, 2)
    )
    errors = []
    for name in ("creep", "elongation-hysteresis"):
        few = settings(name, holds_back=False, rows=150, start_rows=50, rounds=1)
        result = calibrate(ONE, [first], settings=few)
        errors.append(validate(result.robot, [second])[0].errors.mean)
    assert errors[1] < 0.8e-3
    assert errors[1] < 0.5 * errors[0]
    (found,) = (p for p in result.robot.segments[0].history.play if p.of == "elongation")
    assert found.share == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize("remembers", ["pressure", "strain"])
def test_what_an_arm_remembers_is_found(
    remembers: Literal["pressure", "strain"], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(calibration, "other_laws", lambda description: [])
    parts = ("pressure", "opposite") if remembers == "strain" else ("pressure",)
    plays = [Play(width=20 * KPA, share=0.3 / len(parts), of=of) for of in parts]
    creep = (Creep(time=20.0, share=0.1),)
    history = History(lag=0.5, softening=-0.2 / 1e5, remembers=remembers, play=plays, creep=creep)
    robot = with_history(true_robot("static"), history)
    first, second = (
        ("log.csv", made_log(robot, *course(3, 60.0, seed, rate=5.0), base=BASE, noise=3e-4))
        for seed in (1, 2)
    )
    few = settings("creep", strain_law="auto", holds_back=True, rows=150, start_rows=50, rounds=1)
    result = calibrate(ONE, [first], settings=few)
    assert [each.structure.name for each in result.candidates] == ["creep", "creep, strain"]
    found = result.robot.segments[0].history
    assert found is not None
    assert found.remembers == remembers
    save_robot(tmp_path / "arm.yaml", result.robot)
    assert load_description(tmp_path / "arm.yaml").segments[0].history == found
    assert validate(result.robot, [second])[0].errors.mean < 0.8e-3
    again = calibrate(result.robot, [("again.csv", second[1])], settings=few)
    others = {"creep", "creep, strain"} - ({"creep, strain"} if remembers == "strain" else set())
    assert {each.structure.name for each in again.candidates} == others  # none of them twice


@pytest.mark.parametrize(
    ("structure", "holds_back", "phases"), [("lag", False, 4), ("lag", True, 6), ("auto", True, 0)]
)
def test_progress_ends_where_it_says(
    structure: str, holds_back: bool, phases: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever models turn out not to be worth a fit."""
    monkeypatch.setattr(calibration, "other_laws", lambda description: [])
    log = made_log(true_robot("lag"), *course(3, 30.0, 1, rate=4.0), base=BASE, noise=3e-4)
    told: list[tuple[float, float, str]] = []
    few = settings(
        structure, strain_law="auto", holds_back=holds_back, rows=60, trial_rows=60, start_rows=40
    )
    calibrate(ONE, [("log.csv", log)], settings=few, progress=lambda *each: told.append(each))
    words = list(dict.fromkeys(text for _, _, text in told))
    assert len(words) == told[-1][1] == (phases or told[-1][1])
    assert next(done // 1 for done, _, text in told if text == words[-1]) == len(words) - 1
    shares = [done / total for done, total, _ in told]
    assert all(a <= b for a, b in pairwise(shares))


def test_registration_is_found_with_orientations() -> None:
    sensor = np.asarray(lie.exp(np.array([2e-3, -1e-3, 1e-3, 0.04, -0.05, 0.03])))
    time, pressures = course(3, 60.0, 1)
    log = made_log(true_robot("lag"), time, pressures, base=BASE, sensor=sensor, turns=True)
    result = calibrate(ONE, [("a.csv", log)], settings=settings("lag"))
    assert result.robot.recordings is not None
    registration = result.robot.recordings.registration
    T = Manipulator(true_robot("lag")).tip_pose([0.0, 5e4, 2e4])
    read = BASE @ T @ sensor
    own = Manipulator(result.robot).tip_pose([0.0, 5e4, 2e4])
    back = registration.tracker_in_base.transform() @ read @ registration.tip_in_sensor.transform()
    assert back[:3, 3] == pytest.approx(own[:3, 3], abs=3e-4)
    assert back[:3, :3] == pytest.approx(own[:3, :3], abs=0.01)
    assert result.calibrated[0].errors.angle is not None
    assert result.nominal[0].errors.angle is not None
    assert result.calibrated[0].errors.angle < 0.2 * result.nominal[0].errors.angle


def test_gross_outliers_change_little() -> None:
    clean, log = result_of("lag", "lag"), log_of("lag")
    random = np.random.default_rng(0)
    tip = log.tip_position.copy()
    # twenty rows long, so that they are not taken for jumps of the tracker and reach the fit
    for begin in random.choice(len(tip) // 20, 3, replace=False) * 20:
        tip[begin : begin + 20] += random.normal(0, 0.02, 3)
    single = random.choice(len(tip), len(tip) // 20, replace=False)
    tip[single] += random.normal(0, 0.02, (len(single), 3))
    spoilt = Log(log.time, log.commanded, tip)
    result = calibrate(ONE, [("a.csv", spoilt)], settings=settings("lag"))
    for before, after in zip(clean.estimates, result.estimates, strict=True):
        half = (after.high - after.low) / 2
        assert abs(after.value - before.value) < half, after.name
    robots = (Manipulator(clean.robot), Manipulator(result.robot))
    poses = [robot.tip_pose(log.commanded)[:, :3, 3] for robot in robots]
    assert np.linalg.norm(poses[0] - poses[1], axis=1).mean() < 2.5e-3  # of 9 before
    assert any("jumps" in remark for remark in result.remarks)


# -- what is chosen -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    [*(pytest.param(kind, marks=pytest.mark.long) for kind in ("static", "lag")), "hysteresis"],
)
def test_the_model_that_made_the_log_is_chosen(kind: str) -> None:
    few = settings("auto", rows=100, trial_rows=90, holds_back=True)
    result = calibrate(ONE, [("a.csv", log_of(kind))], settings=few)
    assert result.structure.name == kind
    scores = {each.structure.name: each.score for each in result.candidates}
    assert len(scores) >= 5
    simpler = list(HISTORIES)[: list(HISTORIES).index(kind)]
    assert all(scores[name] > 1.3 * scores[kind] for name in simpler)
    assert len(result.held_back) == 10


def test_another_strain_law_is_chosen_where_it_predicts_better() -> None:
    soft = with_values(ONE, {Parameter("segments[0].compensation.modulus_per_pressure"): 0.0})
    other = soft.model_copy(
        update={"segments": (soft.segments[0].model_copy(update={"strain_law": "neo-hookean"}),)}
    )
    time, pressures = course(3, 60.0, 3, highest=1.4e5)
    log = made_log(other, time, pressures, noise=1e-4)
    told = settings("static", strain_law="auto", rows=200, holds_back=True)
    result = calibrate(ONE, [("a.csv", log)], settings=told)
    assert result.robot.segments[0].strain_law == "neo-hookean"
    kept = calibrate(ONE, [("a.csv", log)], settings=settings("static", rows=200))
    assert kept.robot.segments[0].strain_law == "paper"
    assert result.calibrated[0].errors.mean < kept.calibrated[0].errors.mean


def test_what_is_fixed_stays() -> None:
    keys = ("segments[0].length", "segments[0].corrections.gain[0]")
    result = calibrate(ONE, [("a.csv", log_of("lag"))], settings=settings("lag", fixed=keys))
    for key in keys:
        assert Parameter(key).value(result.robot) == Parameter(key).value(ONE)
        assert key not in [estimate.key for estimate in result.estimates]
    assert result.calibrated[0].errors.mean < 1e-3


# -- several logs ---------------------------------------------------------------------------


def moved(log: Log, by: Array) -> Log:
    return Log(log.time, log.commanded, log.tip_position + by)


def test_positions_may_be_zeroed_anew_in_each_log() -> None:
    shift = np.array([2e-3, -1.5e-3, 1e-3])
    logs = [
        ("a", log_of("lag", seed=1, duration=30.0)),
        ("b", moved(log_of("lag", seed=2, duration=30.0), shift)),
    ]
    kept, result = (
        calibrate(ONE, logs, settings=settings("lag", rezero=rezero)) for rezero in (False, True)
    )
    worst = max(c.errors.mean for c in result.calibrated)
    assert worst < 0.7e-3
    assert max(c.errors.mean for c in kept.calibrated) > 1.5 * worst
    zeros = {e.name: e.value for e in result.estimates if e.name.startswith("zero of")}
    apart = [zeros[f"zero of b, {axis}"] - zeros[f"zero of a, {axis}"] for axis in "xyz"]
    assert apart == pytest.approx(shift, abs=3e-4)


def consecutive(kind: str, parts: int) -> list[tuple[str, Log]]:
    """One recording in parts; the later ones begin under pressure."""
    whole = log_of(kind, seed=4, duration=90.0)
    cuts = np.linspace(0, len(whole), parts + 1).astype(int)
    return [
        (f"part {i}", Log(whole.time[a:b], whole.commanded[a:b], whole.tip_position[a:b]))
        for i, (a, b) in enumerate(pairwise(cuts))
    ]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("sequence", [False, True])
def test_logs_in_sequence_or_with_unknown_beginnings(sequence: bool) -> None:
    logs = consecutive("hysteresis", 3)
    told = settings("hysteresis", sequence=sequence, rows=200, holds_back=True)
    result = calibrate(ONE, logs, settings=told)
    sides = [e for e in result.estimates if "at the beginning of" in e.name]
    assert len(sides) == (0 if sequence else 6)
    assert set(result.held_back) == {"part 0", "part 1", "part 2"}
    assert [c.errors.mean for c in result.calibrated] == pytest.approx([5e-4] * 3, abs=2e-4)
    shares = {e.key: e.value for e in result.estimates if ".play" in e.key}
    assert sum(shares.values()) == pytest.approx(0.3, abs=0.08)


# -- arms that hang, and stiffness ----------------------------------------------------------


HANGING_ONE = ONE.model_copy(update={"gravity": (3.0, 0.0, 9.3), "tip_mass": 0.05})
MODULUS = "segments[0].material.youngs_modulus"


def small_log() -> Log:
    """Poses of a hanging arm that is softer than its file says."""
    true = with_values(HANGING_ONE, {Parameter(MODULUS): 0.8e5})
    time, pressures = course(3, 12.0, 6, rate=2.0)
    return made_log(true, time, pressures, noise=2e-4)


def test_poses_alone_show_how_soft_a_hanging_arm_is() -> None:
    told = settings("static")
    setup = Setup.of(HANGING_ONE, recordings_of(HANGING_ONE, [("a", small_log())], told), [], told)
    problem = setup.problem(BY_NAME["static"], 60)
    robot = problem.robot(fit(problem, [np.zeros(problem.size)]).x)
    assert Parameter(MODULUS).value(HANGING_ONE) == 1e5
    assert Parameter(MODULUS).value(robot) == pytest.approx(0.8e5, rel=0.1)


@pytest.mark.long
def test_a_hanging_arm_from_a_small_log() -> None:
    """Where weight tells pressure from stiffness: poses alone show how soft an arm is."""
    told = settings("static", rows=60, trial_rows=50)
    result = calibrate(HANGING_ONE, [("a", small_log())], settings=told)
    assert result.calibrated[0].errors.mean < 0.5e-3
    assert result.nominal[0].errors.mean > 1.5e-3
    (found,) = (e for e in result.estimates if e.key == MODULUS)
    assert found.low < 0.8e5 < found.high
    assert found.learnt > 0.7


def test_a_tilted_base_turns_the_weight_of_the_arm() -> None:
    """The vertical is known in the tracker's frame, so the file's gravity turns with the tilt."""
    upright = {"gravity": (2.0, 0.0, -9.6), "tip_mass": 0.02}
    robot = ONE.model_copy(update={**upright, "tolerances": Tolerances(base_tilt=0.1)})
    base = np.asarray(lie.exp(np.array([1e-3, 0.0, 0.0, 0.06, -0.04, 0.0])))
    weight = base[:3, :3].T @ robot.gravity
    true = robot.model_copy(update={"gravity": tuple(weight.tolist())})
    time, pressures = course(3, 12.0, 6, rate=2.0)
    log = made_log(true, time, pressures, noise=1e-4, base=base, turns=True)
    result = calibrate(robot, [("a", log)], settings=settings("static", rows=60))
    assert result.robot.recordings is not None
    found = result.robot.recordings.registration.tracker_in_base.inverse()
    assert found[:3, 2] == pytest.approx(base[:3, 2], abs=8e-3)
    assert found[:3, :3] @ result.robot.gravity == pytest.approx(robot.gravity, abs=1e-5)
    assert result.calibrated[0].errors.mean < 0.4e-3


def stiffness_table(robot: RobotDescription, sigma: float = 0.02) -> StiffnessTable:
    """Stiffnesses of a robot, each with a relative error."""
    random = np.random.default_rng(7)
    pressures = random.uniform(0, 1e5, (12, 3))
    directions = np.eye(3)[np.arange(12) % 3]
    arm = Manipulator(robot)
    true = np.array(
        [float(arm.stiffness(p, d)) for p, d in zip(pressures, directions, strict=True)]
    )
    measured = true * (1 + sigma * random.normal(0, 1, 12))
    return StiffnessTable(pressures, directions, ("free",) * 12, measured, sigma * true)


def test_tables_alone() -> None:
    true = with_values(ONE, {Parameter("segments[0].compensation.stiffness"): 1.3})
    result = calibrate(ONE, [], [stiffness_table(true)])
    (found,) = result.estimates
    assert found.key == "segments[0].compensation.stiffness"
    assert found.low < 1.3 < found.high
    assert found.high / found.low < 1.06
    assert result.calibrated == ()
    assert result.robot.recordings == ONE.recordings
    assert result.robot.calibration is not None
    p = np.array([2e4, 6e4, 1e4])
    assert Manipulator(result.robot).tip_pose(p) == pytest.approx(Manipulator(ONE).tip_pose(p))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("softening", [0.01, 1.0])
def test_tables_with_logs_tell_stiffness_and_softening(softening: float) -> None:
    true = with_values(
        true_robot("static"),
        {
            Parameter("segments[0].compensation.stiffness"): 1.3,
            Parameter("segments[0].compensation.softening"): softening,
        },
    )
    time, pressures = course(3, 40.0, 8)
    log = made_log(true, time, pressures, base=BASE)
    table = stiffness_table(true)
    told = settings("static", rows=200, holds_back=True)
    result = calibrate(ONE, [("a", log)], [table], settings=told)
    arm = Manipulator(result.robot)
    pairs = zip(table.pressures, table.directions, strict=True)
    found = [float(arm.stiffness(p, d)) for p, d in pairs]
    assert found == pytest.approx(table.stiffness, rel=0.08)
    by_key = {e.key: e for e in result.estimates if e.key}
    stiffness = by_key["segments[0].compensation.stiffness"]
    assert stiffness.learnt > 0.9
    assert stiffness.value == pytest.approx(1.3, rel=0.08)
    assert result.calibrated[0].errors.mean < 0.6e-3
    poses_only = Manipulator(result_of("static", "static").robot)
    apart = [
        float(poses_only.stiffness(p, d)) / k - 1
        for p, d, k in zip(table.pressures, table.directions, table.stiffness, strict=True)
    ]
    assert np.abs(apart).mean() > 0.15


# -- what cannot be fitted ------------------------------------------------------------------


def test_logs_of_which_nothing_can_be_used() -> None:
    good = log_of("lag", duration=30.0)
    unseen = Log(good.time, good.commanded, np.full_like(good.tip_position, np.nan))
    still = Log(good.time, np.full_like(good.commanded, 3e4), good.tip_position)
    one = Log(good.time[:1], good.commanded[:1], good.tip_position[:1])
    two = Log(good.time, good.commanded[:, :2], good.tip_position)
    for log, said in (
        (unseen, "b: .*missing in every row"),
        (still, "b: .*no pressure moves"),
        (one, "b: "),
        (two, "2 pressures and the robot 3"),
    ):
        with pytest.raises(InputError, match=said):
            calibrate(ONE, [("a", good), ("b", log)], settings=settings("lag"))
    with pytest.raises(InputError, match="nothing to fit"):
        calibrate(ONE, [])
    with pytest.raises(InputError, match="no model 'spline'"):
        calibrate(ONE, [("a", good)], settings=settings("spline"))


def test_a_table_of_another_arm_is_refused() -> None:
    table = stiffness_table(ONE)
    other = StiffnessTable(
        np.zeros((12, 6)), table.directions, table.boundaries, table.stiffness, table.sigma
    )
    with pytest.raises(InputError, match="a table of stiffness has 6 pressures"):
        calibrate(ONE, [], [other])


def test_a_short_log_beside_a_long_one_does_not_hide_that_rows_hang_together() -> None:
    told = settings("lag")
    random = np.random.default_rng(3)
    long = log_of("lag", duration=60.0)
    red = Log(long.time, long.commanded, long.tip_position + 1e-3 * reddened(random, 600, 0.95))
    short = log_of("lag", seed=9, duration=2.2)
    found = []
    for logs in ([("a", red)], [("a", red), ("b", short)]):
        setup = Setup.of(ONE, recordings_of(ONE, logs, told), [], told)
        problem = setup.problem(BY_NAME["lag"], 600)
        found.append(fit(problem, [np.zeros(problem.size)]).independent)
    assert found[0] > 8
    assert found[1] > 0.85 * found[0]


def test_an_arm_that_buckles_during_the_fit_says_so() -> None:
    standing = HANGING.model_copy(update={"gravity": (0.0, 0.0, -9.81), "tip_mass": 0.3})
    time, pressures = course(6, 20.0, 6, rate=2.0)
    tip = made_log(load_description("stiff-flop-2"), time, pressures).tip_position
    with pytest.raises(EquilibriumError):
        calibrate(
            standing, [("a", Log(time, pressures, tip))],
            settings=settings("static", rows=50, trial_rows=50),
        )  # fmt: skip


class Broken:
    """A problem of one unknown that is a line; slopes, and perhaps values, fail beyond a limit."""

    size, low, high = 1, np.full(1, -np.inf), np.full(1, np.inf)
    description, n_shared = ONE, 0

    def __init__(self, limit: float, slope: float = 3.0, beyond: float | None = np.nan) -> None:
        self.limit, self.slope, self.beyond = limit, slope, beyond

    def residuals(self, x: Array) -> tuple[Array, Array]:
        if x[0] > self.limit:
            if self.beyond is None:
                raise EquilibriumError("no equilibrium was found")
            return self.beyond * (3 * x - 6), np.full((1, 1), np.nan)
        return 3 * x - 6, np.full((1, 1), self.slope)


def test_a_model_that_is_not_finite_cannot_be_fitted() -> None:
    def fitted(problem: Any, start: float) -> float:
        return float(fit(problem, [np.array([start])], rounds=0).x[0])

    assert fitted(Broken(10.0), 0.0) == pytest.approx(1.8, abs=0.1)
    for beyond in (np.nan, 1.0):  # steps to where slopes alone fail are taken back too
        assert fitted(Broken(1.0, beyond=beyond), 0.0) == pytest.approx(1.0, abs=0.1)
    falling = Broken(1.0, beyond=None)  # so are steps to where the arm has no equilibrium
    assert fitted(falling, 0.0) == pytest.approx(1.0, abs=0.1)
    with pytest.raises(EquilibriumError):
        fitted(falling, 2.0)
    with pytest.raises(InputError, match="not finite"):
        fitted(Broken(1.0), 2.0)
    with pytest.raises(InputError, match="not finite"):
        fitted(Broken(10.0, slope=np.nan), 0.0)
