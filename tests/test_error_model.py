"""The error model of a calibration, against draws from the process that it describes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from conftest import is_long
from stiffopt.errors import FileError, InputError
from stiffopt.identify.error_model import (
    covariance_with,
    error_model,
    held_for,
    in_turn,
    is_moving,
    kept_unknowns,
    representatives,
)
from stiffopt.identify.fit import fit
from stiffopt.identify.folds import held_back
from stiffopt.identify.problem import CalibrationProblem
from stiffopt.identify.results import LEVELS, Comparison, coverage
from stiffopt.identify.settings import ERRORS, CalibrationSettings
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.structures import STRUCTURES, ModelStructure
from stiffopt.identify.validation import validate
from stiffopt.logs import Log
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter, RelativeErrors
from stiffopt.model.history import History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.model.uncertainty import (
    PositionErrors,
    ReadingSlopes,
    Uncertainty,
    levels,
    squared_radius,
)

Array = NDArray[np.float64]

ONE = load_description("stiff-flop-1")
CIRCLE = 0.5e5 + 0.4e5 * np.stack(
    [np.cos(np.linspace(0, 2 * np.pi, 60) + k * 2 * np.pi / 3) for k in range(3)], axis=1
)
KNOWN = ErrorModel(
    residual=5e-4, discrepancy=4e3, reach=3e4, gain=0.1, degrees_of_freedom=6.0,
    settled=(500.0,) * 3, moving=(3e3,) * 3,
    recorded=tuple(map(tuple, CIRCLE.tolist())), spacing=0.0,
)  # fmt: skip
ROUGH = KNOWN.model_copy(update={"gain": 0.0})


def problem_of(
    pressures: Array,
    rng: np.random.Generator,
    noise: float,
    structure: ModelStructure = STRUCTURES[0],
) -> CalibrationProblem:
    """An arm held at some pressures, seen with errors that are independent."""
    tips = Manipulator(ONE).tip_pose(pressures)[:, :3, 3]
    log = Log(np.arange(len(tips)) * 10.0, pressures, tips + noise * rng.normal(size=tips.shape))
    settings = CalibrationSettings()
    setup = Setup.of(ONE, recordings_of(ONE, [("log", log)], settings), [], settings)
    return setup.problem(structure, 400)


def test_logs_in_turn_have_their_pauses() -> None:
    first, soon, anew = np.array([5.0, 7.0]), np.array([10.0, 11.0]), np.array([0.0, 4.0])
    expected = [0, 2, 5, 6, 66, 70]  # a minute where a clock begins anew
    assert in_turn([first, soon, anew]) == pytest.approx(expected)
    assert in_turn([first]) == pytest.approx([0, 2])


# -- the distance from what was recorded ------------------------------------------------------


def test_what_was_recorded_is_near_and_known() -> None:
    assert KNOWN.distances([3], CIRCLE).max() == 0
    assert (KNOWN.variances([3], CIRCLE).max(axis=1) < (KNOWN.gain * 0.07 * 8e4) ** 2).all()
    calibration = Calibration(errors=KNOWN)
    assert calibration.covers([3], CIRCLE).all()
    assert calibration.extrapolation([3], CIRCLE[3]) == ""


def test_the_variance_of_the_discrepancy_grows_with_the_distance_as_is_said() -> None:
    away = np.array([[1.6e5, 1.4e5, 1.2e5]])
    distance = np.linalg.norm(away - CIRCLE, axis=1).min()
    assert KNOWN.distances([3], away)[0, 0] == pytest.approx(distance)
    out = np.linspace(0, 1, 6)[:, np.newaxis]
    variances = ROUGH.variances([3], CIRCLE[0] + out * (away - CIRCLE[0]))
    assert (np.diff(variances[:, 0]) > 0).all()
    expected = KNOWN.discrepancy**2 * (1 - np.exp(-2 * distance / KNOWN.reach))
    assert variances[-1] == pytest.approx(expected)
    smooth = KNOWN.gain**2 * RelativeErrors(CIRCLE, KNOWN.range).variances(away)[0]
    assert KNOWN.variances([3], away)[0] == pytest.approx(expected + smooth)


def test_relative_errors_are_those_of_drawn_functions_of_direction() -> None:
    """Forms of fourth degree are drawn, and regressed on noisy values at recorded pressures."""
    rng = np.random.default_rng(4)
    recorded = CIRCLE[::6]
    away = np.array([[0.5e5, 0.5e5, 0.5e5], [1e5, 0.0, 0.0], [1.0e5, 1.0e5, 0.2e5]])
    scale = float(np.ptp(recorded, axis=0).max())

    def features(p: Array) -> Array:  # |p| u u u u, over the direction u
        u = p / np.linalg.norm(p, axis=1)[:, np.newaxis]
        power = np.einsum("ni,nj,nk,nl->nijkl", u, u, u, u)
        return np.asarray(power.reshape(len(p), -1) * np.linalg.norm(p, axis=1)[:, np.newaxis])

    forms = rng.normal(size=(81, 4000))
    noisy = features(recorded) @ forms + 0.07 * scale * rng.normal(size=(len(recorded), 4000))
    known = features(recorded)
    normal = known.T @ known + (0.07 * scale) ** 2 * np.eye(81)
    error = features(away) @ (forms - np.linalg.solve(normal, known.T @ noisy))
    source = RelativeErrors(recorded, scale)
    covariance = source.covariance(away)
    np.testing.assert_allclose(np.diag(covariance), source.variances(away), rtol=1e-6)
    np.testing.assert_allclose(np.cov(error), covariance, atol=0.08 * covariance.max())
    # the middle of the circle in pressure space was not told by it, and is when it is recorded
    assert source.variances(away)[0] > 4 * source.variances(recorded).max()
    both = RelativeErrors(np.vstack([recorded, away[:1]]), scale)
    np.testing.assert_allclose(
        source.recorded(covariance, 0), both.covariance(away), atol=1e-6 * scale**2
    )


def test_pressures_far_from_all_that_were_recorded_are_told_with_their_distance() -> None:
    text = Calibration(errors=KNOWN).extrapolation([3], np.full(3, 1.5e5))
    away = np.linalg.norm(1.5e5 - CIRCLE, axis=1).min() * 1e-3
    assert text == (
        f"the calibration saw no such pressures, the nearest are {away:.0f} kPa away: "
        "the model extrapolates"
    )


def test_each_segment_has_its_own_distance() -> None:
    two = KNOWN.model_copy(update={"recorded": ((0.0,) * 6, (1e5,) * 3 + (0.0,) * 3)})
    p = np.array([[1e5, 1e5, 1e5, 3e4, 0.0, 0.0]])
    assert two.distances([3, 3], p)[0] == pytest.approx([0.0, 3e4])
    variance = two.variances([3, 3], p)[0]
    assert (variance[:3] < (0.07 * two.gain * 1e5) ** 2).all()
    assert (variance[3:] > variance[0]).all()


def test_few_pressures_stand_for_all() -> None:
    pressures = np.random.default_rng(1).uniform(0, 1e5, (3000, 6))
    kept, spacing = representatives([3, 3], pressures)
    assert len(kept) <= 2 * ERRORS.representatives
    for own in (slice(0, 3), slice(3, 6)):
        apart = np.linalg.norm(pressures[:, np.newaxis, own] - kept[:, own], axis=2).min(axis=1)
        assert apart.max() <= spacing + 1e-6


# -- regions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [4.5, 9.0, np.inf])
def test_regions_hold_what_they_say(freedom: float) -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    draws = rng.multivariate_normal(np.zeros(3), covariance, 40_000)
    if np.isfinite(freedom):
        draws *= np.sqrt((freedom - 2) / rng.chisquare(freedom, len(draws)))[:, np.newaxis]
    many = np.broadcast_to(covariance, (len(draws), 3, 3))
    found = levels(draws, many, freedom)
    squares = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(covariance), draws)
    for level in LEVELS:
        assert np.mean(found <= level) == pytest.approx(level, abs=0.01)
        assert np.mean(squares <= squared_radius(level, freedom)) == pytest.approx(level, abs=0.01)


def test_bad_probabilities_are_refused() -> None:
    known = Manipulator(
        ONE.model_copy(update={"calibration": Calibration(errors=KNOWN)})
    ).tip_uncertainty([1e4, 1e4, 1e4])
    assert (known.semi_axes_at(0.99) > known.semi_axes).all()
    assert known.semi_axes == pytest.approx(known.semi_axes_at(0.95))
    for level in (0.0, 1.0, np.nan):
        with pytest.raises(InputError, match="between 0 and 1"):
            known.semi_axes_at(level)


@pytest.mark.parametrize(
    ("p", "independent"),
    [((0.0, 0.0, 0.0), (0, 0, 0)), ((9e4, 0.0, 5e4), (0, 0, 0.5)), ((5e4,) * 3, (0.5,) * 3)],
)
def test_pressures_that_change_make_a_larger_region(
    p: tuple[float, ...], independent: tuple[float, ...]
) -> None:
    """The lag is along the ways on which the arm comes there; where they are short, there is more.

    That is `independent` of the other channels, in shares of what was recorded.
    """
    recorded = Calibration(errors=KNOWN, pressure_min=(0.0,) * 3, pressure_max=(1e5,) * 3)
    arm = Manipulator(ONE.model_copy(update={"calibration": recorded}))
    held, moving = (arm.tip_uncertainty(p, moving=each) for each in (False, True))
    grid = np.stack(np.meshgrid(*[1e5 * (np.arange(100) + 0.5) / 100] * 3), axis=-1).reshape(-1, 3)
    ways = (grid - p) * 3e3 / np.sqrt(1e5**2 / 6)  # two pressures drawn differ by that, RMS
    lag = ways.T @ ways / len(ways) + 3e3**2 * np.diag(independent)
    slopes = arm.tip_pose(p)[:3, :3] @ arm.tip_jacobian(p)[:3]
    expected = slopes @ lag @ slopes.T
    np.testing.assert_allclose(moving.hysteresis, expected, atol=1e-3 * expected.max())
    assert not held.hysteresis.any()  # this arm has no play
    assert held.discrepancy.any()
    np.testing.assert_allclose(held.discrepancy, 0.9 * moving.discrepancy, rtol=1e-9)


def test_a_channel_that_was_hardly_driven_does_not_lag_more_than_it_was_seen_to() -> None:
    errors = KNOWN.model_copy(update={"moving": (3e3, 3e3, 0.0)})
    recorded = Calibration(errors=errors, pressure_min=(0.0,) * 3, pressure_max=(1e5, 1e5, 0.0))
    robot = ONE.model_copy(update={"calibration": recorded})
    found, p = Uncertainty(robot), np.array([[0.0, 2e4, 6e4]])
    slopes = Manipulator(ONE).tip_pose(p[0])[:3, :3] @ Manipulator(ONE).tip_jacobian(p[0])[:3]
    moving = found.errors(p, moving=np.ones(1, dtype=bool)).hysteresis[0]
    by_pressure = np.linalg.solve(slopes, np.linalg.solve(slopes, moving).T)
    assert (np.abs(by_pressure[2]) < 1.0).all()
    assert by_pressure[0, 0] == pytest.approx(2 * 3e3**2, rel=1e-6)


def test_a_discrepancy_moves_the_tip_as_far_in_all_directions() -> None:
    """It does so by where the arm is, with its history, not by where it is commanded to be."""
    robot = ONE.model_copy(update={"calibration": Calibration(errors=ROUGH)})
    away, source = np.array([[1.6e5, 1.4e5, 1.2e5]]), Uncertainty(robot)
    slopes = Manipulator(ONE).tip_pose(away[0])[:3, :3] @ Manipulator(ONE).tip_jacobian(away[0])[:3]
    by_pressures = ROUGH.variances([3], away)[0, 0] * slopes @ slopes.T
    one = np.trace(by_pressures) / 3
    now = np.zeros(1)
    followed = source.errors(CIRCLE[:1], effective=away, time=now)
    # of an arm that stays, 7 % of the pressure acts independently through hysteresis
    stays = one * (0.93**2 + 0.07**2) * np.eye(3)
    np.testing.assert_allclose(followed.discrepancy[0], stays, rtol=1e-9)
    assert not source.errors(away, effective=CIRCLE[:1], time=now).discrepancy.any()


def test_an_arm_with_hysteresis_keeps_a_share_of_what_was_wrong_before() -> None:
    """At a recorded pressure it is uncertain by where it was, until it forgets."""
    history = History(play=(Play(width=2e4, share=0.1), Play(width=5e4, share=0.15)))
    segment = ONE.segments[0].model_copy(update={"history": history})
    update = {"segments": (segment,), "calibration": Calibration(errors=ROUGH)}
    source = Uncertainty(ONE.model_copy(update=update))
    away, back = np.array([1.6e5, 1.4e5, 1.2e5]), CIRCLE[0]
    commands = np.array([back, away, back, back])
    slopes = Manipulator(ONE).tip_pose(away)[:3, :3] @ Manipulator(ONE).tip_jacobian(away)[:3]
    far = ROUGH.variances([3], away[np.newaxis])[0, 0] * np.trace(slopes @ slopes.T) / 3
    time, forgotten = np.array([0.0, 30.0, 60.0, 90.0]), np.exp(-1)  # in 30 s
    found = source.errors(commands, effective=commands, time=time).discrepancy[:, 0, 0]
    share = 0.25 + 0.75 * 0.07  # the silicone has more hysteresis than any model
    # the present counts as if half of the first play followed, since 80 kPa were recorded
    kept = 0.1 * 4e4 / ROUGH.range + 0.15
    kept += (1 - kept) * 0.07
    before = far * (1 - forgotten) * np.array([0.0, 0.0, 1.0, forgotten])
    expected = share**2 * before + (1 - kept) ** 2 * far * np.array([0.0, 1.0, 0.0, 0.0])
    assert found == pytest.approx(expected, rel=1e-9)
    # an unknown history may have led anywhere within the limits
    levels = np.stack(np.meshgrid(*[(0.25, 0.75)] * 3), axis=-1).reshape(-1, 3)
    limits = np.array(ONE.pressure_max)
    elsewhere, here = (
        source.errors(p).discrepancy[:, 0, 0].mean() for p in (levels * limits, back[np.newaxis])
    )
    everywhere = (1 - kept) ** 2 / share**2 * here + here
    assert here > 0
    assert elsewhere == pytest.approx(everywhere, rel=1e-9)


def test_what_was_not_tested_is_as_wrong_as_a_multiple_of_what_was() -> None:
    rng = np.random.default_rng(2)
    found = []
    for wrong in (0.0, 4e3):
        p = np.tile(CIRCLE, (3, 1))
        problem = problem_of(p, rng, 2e-4)
        acting = p + wrong * np.sin(p / 1e4)  # a discrepancy that no parameter can express
        tips = Manipulator(ONE).tip_pose(acting)[:, :3, 3]
        sample = problem.samples[0]
        track = replace(sample.recording.tracks[0], position=tips)
        recording = replace(sample.recording, tracks=(track,))
        problem = CalibrationProblem(
            problem.description, problem.unknowns, [replace(sample, recording=recording)],
            problem.points, problem.base_in_tracker, problem.noise,
        )  # fmt: skip
        found.append(fit(problem, [np.zeros(problem.size)], rounds=1))
    right, wrong_one = (error_model(each, held_back(each, 2.0, lambda: None)) for each in found)
    assert wrong_one.gain > 3 * right.gain
    acting = found[0].predicted.per_pressure[0]
    slope = np.sqrt(np.mean((acting**2).sum(axis=(1, 2))))
    prior = ERRORS.unchecked * ERRORS.discrepancy * ONE.segments[0].length / slope
    expected = ERRORS.untested * prior / np.ptp(CIRCLE, axis=0).max()
    assert error_model(found[0], {}).gain == pytest.approx(expected, rel=0.03)


def test_a_tip_that_moves_at_another_time_is_wrong_along_its_way() -> None:
    source = Uncertainty(
        ONE.model_copy(
            update={"calibration": Calibration(errors=KNOWN.model_copy(update={"timing": 0.2}))}
        )
    )
    rates = np.array([[2e4, -1e4, 0.0]])
    now = {"effective": CIRCLE[:1], "time": np.zeros(1)}
    still, moving = source.errors(CIRCLE[:1], **now), source.errors(CIRCLE[:1], **now, rates=rates)
    ends = [Manipulator(ONE).tip_pose(CIRCLE[0] + step * rates[0])[:3, 3] for step in (-0.01, 0.01)]
    way = 0.2 * (ends[1] - ends[0]) / 0.02
    added = moving.covariance[0] - still.covariance[0]
    np.testing.assert_allclose(added, np.outer(way, way), atol=1e-3 * (way @ way))


def test_the_error_in_time_is_estimated() -> None:
    """Tips that are seen up to a second earlier or later, by a known deviation."""
    rng = np.random.default_rng(8)
    time = np.arange(0.0, 240.0, 0.5)
    seen = time + 0.3 * rng.normal(size=len(time))

    def commanded(t: Array) -> Array:
        phases = t[:, np.newaxis] * np.array([0.5, 0.31, 0.43])
        return np.asarray(4e4 + 3.5e4 * np.sin(phases))

    tips = Manipulator(ONE).tip_pose(commanded(seen))[:, :3, 3]
    settings = CalibrationSettings()
    log = Log(time, commanded(time), tips + 2e-4 * rng.normal(size=tips.shape))
    setup = Setup.of(ONE, recordings_of(ONE, [("log", log)], settings), [], settings)
    problem = setup.problem(STRUCTURES[0], 400)
    found = fit(problem, [np.zeros(problem.size)], rounds=1)
    known = error_model(found, held_back(found, 2.0, lambda: None))
    assert known.timing == pytest.approx(0.3, rel=0.35)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (3.0, 0.0, 9.3)], ids=["free", "hanging"])
def test_frames_move_what_the_tracker_reads(gravity: tuple[float, float, float]) -> None:
    """Slopes by the twists of base and sensor, against differences of the readings."""
    registration = {"tracker_in_base": {"position": [0.01, 0.02, 0.03]},
                    "tip_in_sensor": {"position": [0.004, -0.003, 0.006]}}  # fmt: skip
    robot = load_description("stiff-flop-1")
    robot = type(robot).model_validate(
        robot.model_dump()
        | {"recordings": {"registration": registration}, "gravity": gravity, "tip_mass": 0.05}
    )
    rng = np.random.default_rng(0)
    problem = problem_of(CIRCLE, rng, 1e-4)
    given = robot.recordings
    assert given is not None
    place = given.registration.tip_in_sensor.inverse()
    points = [replace(problem.points[0], sensor=place)]
    problem = CalibrationProblem(
        robot, problem.unknowns, problem.samples, points,
        given.registration.tracker_in_base.inverse(), problem.noise,
    )  # fmt: skip
    x = np.zeros(problem.size)
    base, *_ = problem.unknowns.slices()
    _, slopes = problem.with_slopes(x)
    _, found, acting = ReadingSlopes(robot, [], 6).at(problem.predict(x).effective)
    per_twist = slopes[:, :, base] / problem.scale[base]
    np.testing.assert_allclose(problem.base_in_tracker[:3, :3] @ found, per_twist, atol=1e-10)
    np.testing.assert_allclose(
        problem.base_in_tracker[:3, :3] @ acting, problem.predict(x).per_pressure[0], atol=1e-15
    )


@pytest.mark.parametrize(("deviation", "believed"), [(1e-4, True), (0.5, False)])
def test_a_first_reading_tells_the_history_only_if_the_model_is_certain(
    deviation: float, believed: bool
) -> None:
    """A log that begins in the middle, 3 mm off: by the side of its play, or by a wrong modulus."""
    history = History(play=(Play(width=4e4, share=0.4),))
    segment = ONE.segments[0].model_copy(update={"history": history})
    key = "segments[0].material.youngs_modulus"
    fitted = FittedParameter(key=key, deviation=deviation, prior=0.5)
    calibration = Calibration(
        parameters=(fitted,), correlation=((1.0,),), position_residual=2e-4, errors=ROUGH
    )
    robot = ONE.model_copy(update={"segments": (segment,), "calibration": calibration})
    pressures = np.tile([8e4, 0.0, 0.0], (60, 1))
    pressures[30:, 1] = 1e4
    pressures[50:, 0] = 1.6e5  # a fall from there may have led to the beginning as well
    acting = pressures - np.array([1.2e4, 0.0, 0.0])  # as after a rise
    tips = Manipulator(ONE).tip_pose(acting)[:, :3, 3]
    log = Log(np.arange(60.0) * 0.2, pressures, tips)
    found = validate(robot, [("log", log)])[0]
    rise = float(found.pressures[0, 0] - found.effective[0, 0])
    assert (rise > 9e3) if believed else (abs(rise) < 5e3)


def test_validation_knows_for_how_long_poses_were_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """From all rows of a log, though the regions of only few are compared; each log begins anew."""
    robot = ONE.model_copy(update={"calibration": Calibration(errors=ROUGH)})
    time = np.arange(0.0, 20.0, 0.2)
    pressures = np.tile([8e4, 0.0, 0.0], (len(time), 1))
    pressures[time > 5.9, 1] = 1e4
    log = Log(time, pressures, Manipulator(ONE).tip_pose(pressures)[:, :3, 3])
    seen, errors = {}, Uncertainty.errors

    def noted(self: Uncertainty, *arguments: Any, **given: Any) -> PositionErrors:
        seen.update(given)
        return errors(self, *arguments, **given)

    monkeypatch.setattr(Uncertainty, "errors", noted)
    monkeypatch.setattr("stiffopt.identify.validation.ERRORS", replace(ERRORS, compared=12))
    for names in (["log"], ["one", "other"]):
        logs = [(name, log) for name in names]
        validate(robot, logs, settings=CalibrationSettings(sequence=True))
        own = np.tile(time[np.linspace(0, len(time) - 1, 12).astype(int)], len(names))
        expected = np.where(own > 7, own - 6.0, np.nan)
        np.testing.assert_allclose(seen["held"], expected, atol=0.21)


# -- the fit ----------------------------------------------------------------------------------


def test_what_a_discrepancy_does_to_a_fit_is_that_of_draws() -> None:
    """Fits of arms whose pressures are wrong by drawn discrepancies, around one and the same."""
    rng = np.random.default_rng(5)
    reach, size = 3e4, 1.5e3
    p = rng.uniform(0.1e5, 0.9e5, (60, 3))
    alike = np.exp(-np.linalg.norm(p[:, np.newaxis] - p, axis=2) / reach)
    root = np.linalg.cholesky(alike + 1e-9 * np.eye(len(p)))
    plain = problem_of(p, rng, 0.0)
    begin = np.zeros(plain.size)
    true = fit(plain, [begin], rounds=0)
    moves = []
    for _ in range(80 if is_long() else 30):
        wrong = p + size * root @ rng.normal(size=p.shape)
        tips = Manipulator(ONE).tip_pose(wrong)[:, :3, 3]
        track = replace(plain.samples[0].recording.tracks[0], position=tips)
        recording = replace(plain.samples[0].recording, tracks=(track,))
        drawn = CalibrationProblem(
            plain.description, plain.unknowns, [replace(plain.samples[0], recording=recording)],
            plain.points, plain.base_in_tracker, plain.noise,
        )  # fmt: skip
        moves.append(fit(drawn, [true.x], rounds=0).x - true.x)
    known = KNOWN.model_copy(update={"discrepancy": size, "reach": reach})
    expected = covariance_with(true, known) - true.covariance
    values, axes = np.linalg.eigh(expected)
    found = np.var(np.array(moves) @ axes[:, -6:], axis=0)
    assert found == pytest.approx(values[-6:], rel=0.5 if is_long() else 0.7)


def test_an_arm_that_is_as_the_model_has_no_discrepancy_and_the_residual_of_its_noise() -> None:
    rng = np.random.default_rng(7)
    problem = problem_of(rng.uniform(0, 1e5, (300 if is_long() else 120, 3)), rng, 3e-4)
    found = fit(problem, [np.zeros(problem.size)], rounds=1)
    parts = held_back(found, 2.0, lambda: None)
    known = error_model(found, parts)
    session = 0.005 * problem.description.length  # differs between sessions
    assert known.residual == pytest.approx(np.hypot(3e-4, session), rel=0.1)
    slope = np.sqrt(np.mean(found.predicted.per_pressure[0] ** 2))
    assert known.discrepancy * slope < 2e-4
    assert known.moving == ()  # every row was held for 10 s
    assert known.settled == (0.0, 0.0, 0.0)


def test_a_model_with_creep_has_the_state_of_the_silicone() -> None:
    """Of what differs between sessions, the zero of the tracker is left."""
    squares = []
    for name in ("hysteresis", "creep"):
        (structure,) = (each for each in STRUCTURES if each.name == name)
        rng = np.random.default_rng(8)
        problem = problem_of(rng.uniform(0, 1e5, (30, 3)), rng, 3e-4, structure)
        found = fit(problem, [np.zeros(problem.size)], rounds=0, most=1)
        squares.append((error_model(found, {}).residual / problem.description.length) ** 2)
    assert squares[0] - squares[1] == pytest.approx(0.005**2 - 0.001**2, rel=0.01)


@pytest.mark.parametrize("together", [True, False])
def test_a_motion_counts_as_one_of_all_channels(together: bool) -> None:
    """Where channels move one at a time, each row has less error than where all of them do."""
    tooth = np.interp(np.arange(0, 8, 0.1), [0, 2, 4], [0, 8e4, 0])
    one = tooth[:, np.newaxis]
    moved = [np.ones(3)] * 3 if together else np.eye(3)
    pressures = np.concatenate([one * channels for channels in moved])
    time = 0.1 * np.arange(len(pressures))
    tips = Manipulator(ONE).tip_pose(np.roll(pressures, 3, axis=0))[:, :3, 3]  # 0.3 s late
    settings = CalibrationSettings()
    recordings = recordings_of(ONE, [("log", Log(time, pressures, tips))], settings)
    problem = Setup.of(ONE, recordings, [], settings).problem(STRUCTURES[1], 400)
    found = fit(problem, [np.zeros(problem.size)], rounds=0)
    known = error_model(found, {})
    rows = is_moving(time, pressures)
    late = found.predicted.effective[rows] - pressures[rows]
    assert np.abs(late).max() > 1e3
    share = 1.0 if together else 5 / 3  # of three channels, of one
    assert known.moving == pytest.approx(np.sqrt(np.mean(late**2, axis=0) * share), rel=1e-3)


def test_for_how_long_pressures_were_held() -> None:
    time = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.5, 6.0])
    moving = np.array([False, False, True, True, False, False, False, True])
    unknown = np.nan
    expected = [unknown, unknown, unknown, unknown, 1.5, 2.0, 3.0, unknown]  # moving for 1 s more
    np.testing.assert_array_equal(held_for(time, moving), expected)


def test_a_robot_file_keeps_its_error_model(tmp_path: object) -> None:
    from pathlib import Path

    path = Path(str(tmp_path)) / "arm.yaml"
    save_robot(path, ONE.model_copy(update={"calibration": Calibration(errors=KNOWN)}))
    read = load_description(path).calibration
    assert read is not None
    assert read.errors is not None
    assert np.array(read.errors.recorded) == pytest.approx(CIRCLE)
    assert read.errors.model_copy(update={"recorded": KNOWN.recorded}) == KNOWN
    text = path.read_text().replace("moving: [", "moving: [1 kPa, ")
    path.write_text(text)
    with pytest.raises(FileError, match=r"errors\.moving: has 4 values; expected 3, one for each"):
        load_description(path)


def test_unknowns_that_a_file_keeps_are_parameters_and_base() -> None:
    problem = problem_of(CIRCLE, np.random.default_rng(0), 1e-4)
    kept = kept_unknowns(problem)
    assert len(kept) == len(problem.unknowns.parameters) + 6
    assert len(set(kept.tolist())) == len(kept)


# -- coverage ---------------------------------------------------------------------------------


def test_rows_move_until_pressures_were_held() -> None:
    time = np.arange(0, 20, 0.5)
    pressures = np.where(time < 5, 0.0, 1e5)[:, np.newaxis]
    moving = is_moving(time, pressures)
    expected = (time >= 5) & (time < 5 + ERRORS.hold)
    assert moving[time < 5 + ERRORS.hold - 0.5].tolist() == (
        expected[time < 5 + ERRORS.hold - 0.5].tolist()
    )
    assert not moving[time > 5 + ERRORS.hold + 0.5].any()


def test_coverage_is_told_by_what_is_known() -> None:
    n = 100
    levels = (np.arange(n) + 0.5) / n
    moving = np.arange(n) % 2 == 0
    one = Comparison(
        "a", levels, *[np.zeros((n, 3))] * 5, None,
        inside=np.arange(n) < 60, moving=moving, levels=levels, unsettled_levels=levels**2,
        remarks=(),
    )  # fmt: skip
    found = coverage([one, replace(one, levels=None)])
    assert found["with history"].n == 100
    assert found["with history"].shares == pytest.approx(LEVELS, abs=0.006)
    assert found["settled"].n == 50
    assert found["with history, inside"].n == 60
    assert found["with history, outside"].shares[0] == 0
    assert found["moving"].by_level[0.5] == pytest.approx(np.sqrt(0.5), abs=0.02)


def test_the_interval_of_a_coverage_is_by_blocks() -> None:
    """Whole blocks are right or wrong: the interval is that of their number, not of the rows."""
    count, blocks = 2400, 20  # 1 row a second, in blocks of 2 min
    good = np.arange(blocks) % 2 == 0
    levels = np.where(np.repeat(good, count // blocks), 0.4, 0.995)
    one = Comparison(
        "a", np.arange(float(count)), *[np.zeros((count, 3))] * 5, None,
        inside=np.ones(count, dtype=bool), moving=np.ones(count, dtype=bool), levels=levels,
        unsettled_levels=levels, remarks=(),
    )  # fmt: skip
    found = coverage([one])["with history"]
    low, high = found.intervals[0]
    assert found.shares[0] == 0.5
    assert high - low == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(blocks), rel=0.15)
    short = coverage([one.rows(one.time < 100)])["with history"]
    assert np.isnan(short.intervals[0]).all()


def test_uncertainty_of_a_batch_is_that_of_each() -> None:
    robot = ONE.model_copy(update={"calibration": Calibration(errors=KNOWN)})
    source = Uncertainty(robot)
    p = np.array([[1e4, 2e4, 3e4], [9e4, 0.0, 0.0]])
    many = source.errors(p).covariance
    for row, own in zip(p, many, strict=True):
        np.testing.assert_allclose(source.at(row).covariance, own, rtol=1e-9)
