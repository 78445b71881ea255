"""How well a calibration knows what it has found: noise, intervals, and what was not learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from known_arms import BASE, BY_NAME, ONE, log_of, settings, true_robot
from made_logs import course, made_log, reddened
from stiffopt import lie
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.discrepancy import smooth_functions
from stiffopt.identify.fit import Fit, _reweighted, fit
from stiffopt.identify.problem import CalibrationProblem
from stiffopt.identify.settings import FIT
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.logs import Log
from stiffopt.model.description import Tolerances
from stiffopt.model.manipulator import Manipulator

Array = NDArray[np.float64]


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
