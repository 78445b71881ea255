"""Calibrations of arms that are known: what is found, how well, and what is said about it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from made_logs import course, made_log, reddened
from stiffopt import lie
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.identify import calibration
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.discrepancy import smooth_functions
from stiffopt.identify.fit import Fit, _reweighted, fit
from stiffopt.identify.problem import CalibrationProblem
from stiffopt.identify.settings import FIT, CalibrationSettings
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.structures import STRUCTURES
from stiffopt.identify.validation import validate
from stiffopt.logs import Log, StiffnessTable
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description, save_robot

Array = NDArray[np.float64]

KPA = 1e3
ONE = load_description("stiff-flop-1")
HANGING = load_description("stiff-flop-2-hanging")
TRUE_VALUES = {
    "segments[0].length": 0.0925,
    "segments[0].material.youngs_modulus": 1.15e5,
    "segments[0].compensation.area": 1.1,
    "segments[0].corrections.gain[0]": 1.05,
    "segments[0].corrections.gain[2]": 0.96,
    "segments[0].corrections.azimuth[1]": 0.06,
}
HISTORIES = {
    "static": None,
    "lag": History(lag=0.5),
    "hysteresis": History(
        lag=0.5, play=(Play(width=5 * KPA, share=0.1), Play(width=20 * KPA, share=0.2))
    ),
}
BASE = np.asarray(lie.exp(np.array([2e-3, -3e-3, 4e-3, 0.03, -0.02, 0.08])))
BY_NAME = {structure.name: structure for structure in STRUCTURES}


def with_history(robot: RobotDescription, history: History | None) -> RobotDescription:
    segments = tuple(s.model_copy(update={"history": history}) for s in robot.segments)
    return robot.model_copy(update={"segments": segments})


def true_robot(kind: str) -> RobotDescription:
    values = {Parameter(key): value for key, value in TRUE_VALUES.items()}
    return with_history(with_values(ONE, values), HISTORIES[kind])


def settings(structure: str, **others: object) -> CalibrationSettings:
    usual: dict[str, object] = {
        "rows": 250,
        "trial_rows": 100,
        "strain_law": "keep",
        "holds_back": False,
    }
    return CalibrationSettings(structure=structure, **{**usual, **others})  # type: ignore[arg-type]


@cache
def log_of(kind: str, seed: int = 1, duration: float = 90.0, **others: object) -> Log:
    time, pressures = course(3, duration, seed)
    given = {"base": BASE, "noise": 3e-4, **others}
    return made_log(true_robot(kind), time, pressures, seed=seed, **given)  # type: ignore[arg-type]


@cache
def result_of(kind: str, structure: str) -> CalibrationResult:
    return calibrate(ONE, [("a.csv", log_of(kind))], settings=settings(structure))


def true_value(key: str, kind: str) -> float:
    return Parameter(key).value(true_robot(kind))


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


# -- how well it is known -------------------------------------------------------------------


def test_rows_in_which_pressures_change_count_less_if_they_are_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The tip swings aside whenever pressures change, which no model explains."""
    log = log_of("lag", seed=5)
    steps = np.abs(np.diff(log.commanded, axis=0, prepend=log.commanded[:1])).sum(axis=1)
    swing = np.convolve(steps, np.ones(5))[: len(steps)] / 4e4
    aside = swing[:, np.newaxis] * np.array([3e-3, -2e-3, 1e-3])
    log = replace(log, tip_position=log.tip_position + aside)
    held = np.random.default_rng(1).uniform(0, 1e5, (40, 3))
    true = (BASE @ Manipulator(true_robot("lag")).tip_pose(held))[:, :3, 3]

    def missed() -> float:
        robot = calibrate(ONE, [("a.csv", log)], settings=settings("lag")).robot
        assert robot.recordings is not None
        base = robot.recordings.registration.tracker_in_base.inverse()
        tips = (base @ Manipulator(robot).tip_pose(held))[:, :3, 3]
        return float(np.linalg.norm(tips - true, axis=1).mean())

    weighted = missed()
    monkeypatch.setattr("stiffopt.identify.fit.FIT", replace(FIT, uneven=np.inf))
    assert weighted < 0.7 * missed()


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_noise_is_found_beside_errors_that_rows_share(rho: float) -> None:
    """What the shared errors' fit takes from the noise is given back to size and correlation."""
    told, deviation = settings("static"), 4e-4
    found = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        time, pressures = course(3, 60.0, seed)
        functions = FIT.systematic * ONE.length * smooth_functions(pressures)
        errors = deviation * reddened(random, len(time), rho)
        errors += functions @ random.normal(size=(functions.shape[1], 3))
        log = made_log(ONE, time, pressures, noise=0.0)
        log = replace(log, tip_position=log.tip_position + errors)
        setup = Setup.of(ONE, recordings_of(ONE, [("a", log)], told), [], told)
        problem, independent = setup.problem(BY_NAME["static"], len(time)), 1.0
        for _ in range(15):
            problem, independent = _reweighted(problem, np.zeros(problem.size), independent)
        found.append((problem.noise.position / deviation, independent))
    noise, independent = np.transpose(found)
    assert np.mean(noise) == pytest.approx(1.0, abs=0.15)
    true = (1 + rho) / (1 - rho)  # variance of an independent row: noise by which rows are divided
    assert np.mean(noise**2 * independent) == pytest.approx(true, rel=0.2)


def test_an_undriven_channel_does_not_give_way_to_the_bound_on_the_modulus() -> None:
    """An arm that stiffens further than is allowed, of which one channel was never driven."""
    stiffening = {"modulus_per_pressure": 0.8, "modulus_law": "exponential", "area": 1.2}
    segment = ONE.segments[0]
    assert segment.compensation is not None
    compensation = segment.compensation.model_copy(update=stiffening)
    arm = ONE.model_copy(
        update={"segments": (segment.model_copy(update={"compensation": compensation}),)}
    )
    time, pressures = course(3, 60.0, 5, highest=1.4e5)
    pressures[:, 2] = 0.0
    log = made_log(arm, time, pressures, noise=1e-4)
    unknown = compensation.model_copy(update={"modulus_per_pressure": 0.0})
    begun = arm.model_copy(
        update={"segments": (segment.model_copy(update={"compensation": unknown}),)}
    )
    result = calibrate(begun, [("a.csv", log)], settings=settings("static"))
    found = result.robot.segments[0]
    assert found.corrections is not None
    assert found.compensation is not None
    change = found.compensation.modulus_per_pressure / found.material.youngs_modulus
    largest = change * np.linalg.norm(arm.pressure_max)
    assert largest == pytest.approx(FIT.most_stiffening, rel=0.05)  # the bound is at work
    assert found.corrections.gain[2] == pytest.approx(1.0, abs=0.01)


KNOWN = ONE.model_copy(
    update={"tolerances": Tolerances(modulus_per_pressure=0.03, youngs_modulus=0.15, share=0.05)}
)


def recovered(seed: int, structure: str, rho: float, turns: bool = False) -> tuple[Array, Fit]:
    """Errors (d,) of a fit over its own deviations; the truth is drawn from the prior."""
    random = np.random.default_rng(seed)
    time, pressures = course(3, 40.0, seed)
    told = settings(structure)

    def problem_of(log: Log) -> CalibrationProblem:
        setup = Setup.of(KNOWN, recordings_of(KNOWN, [("a", log)], told), [], told)
        return setup.problem(BY_NAME[structure], 240)

    problem = problem_of(made_log(KNOWN, time, pressures, turns=turns))
    x = np.clip(random.normal(0, 1, problem.size), problem.low, problem.high)
    coordinates = x * problem.scale
    base, sensors, _, _ = problem.unknowns.slices()
    sensor = np.zeros(6)
    sensor[: sensors[0].stop - sensors[0].start] = coordinates[sensors[0]]
    log = made_log(
        problem.robot(x), time, pressures, seed=seed, noise=5e-4, rho=rho, turns=turns,
        base=np.asarray(lie.exp(coordinates[base])), sensor=np.asarray(lie.exp(sensor)),
    )  # fmt: skip
    problem = problem_of(log)
    found = fit(problem, [np.zeros(problem.size)])
    return (found.x - x) / np.sqrt(np.diag(found.covariance)), found


def check_coverage(results: list[tuple[Array, Fit]]) -> None:
    errors = np.array([error for error, _ in results])
    learnt = np.array([np.diag(found.covariance) for _, found in results]) < 0.5
    inside = np.abs(errors) < 1.96
    assert 0.90 <= inside.mean() <= 0.99
    assert 0.90 <= inside[learnt].mean() <= 0.99
    assert 0.8 < np.sqrt(np.mean(errors[learnt] ** 2)) < 1.2
    assert learnt.mean() > 0.6


def test_true_values_lie_inside_the_intervals() -> None:
    white = [recovered(seed, "lag", 0.0) for seed in range(6)]
    red = [recovered(seed, "lag", 0.9) for seed in range(20, 26)]
    check_coverage(white + red)
    assert np.mean([found.independent for _, found in white]) < 1.2
    assert np.mean([found.independent for _, found in red]) > 5
    deviation = [np.median([np.diag(f.covariance) for _, f in each]) for each in (white, red)]
    assert deviation[1] > 1.2 * deviation[0]  # fewer independent rows say less


@pytest.mark.long
@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
@pytest.mark.parametrize(("structure", "turns"), [("lag", False), ("lag", True), ("hysteresis", 0)])
def test_true_values_lie_inside_the_intervals_of_every_kind(
    structure: str, turns: bool, rho: float
) -> None:
    check_coverage([recovered(seed, structure, rho, bool(turns)) for seed in range(100, 180)])


def test_what_was_not_learnt_keeps_its_prior_and_is_named() -> None:
    time, pressures = course(3, 40.0, 5)
    pressures[:, 2] = 0.0
    log = made_log(true_robot("lag"), time, pressures, base=BASE)
    result = calibrate(ONE, [("a.csv", log)], settings=settings("lag", rows=150, holds_back=True))
    by_key = {estimate.key: estimate for estimate in result.estimates if estimate.key}
    for name, deviation in (
        ("corrections.gain[2]", 0.05),
        ("corrections.azimuth[2]", 0.05),
        ("compensation.stiffness", 0.2),
    ):
        found = by_key[f"segments[0].{name}"]
        assert found.learnt < 0.05
        assert found.value == pytest.approx(found.before, abs=0.02)
        assert found.high == pytest.approx(
            found.before * np.exp(1.96 * deviation)
            if found.unit == "" and found.before
            else 1.96 * deviation,
            rel=0.03,
        )
        unlearnt = [r for r in result.remarks if r.startswith("not learnt") and found.name in r]
        assert len(unlearnt) == 1
    assert any("channel 3" in r and "nothing is learnt" in r for r in result.remarks)
    assert not any("lag, segment 1" in r for r in result.remarks if r.startswith("not learnt"))
    assert result.robot.calibration is not None
    priors = {p.key: p.deviation / p.prior for p in result.robot.calibration.parameters}
    assert priors["segments[0].corrections.gain[2]"] == pytest.approx(1.0, abs=0.02)
    assert priors["segments[0].compensation.area"] < 0.5


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
