"""How well a calibrated arm is known, against arms that are built with other values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.errors import InputError, PressureError
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import Creep, History, Memory, Part, Play
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description
from stiffopt.model.segment import Corrections
from stiffopt.model.uncertainty import TipUncertainty, Uncertainty

Array = NDArray[np.float64]

KEYS = {
    "segments[0].length": 0.01,
    "segments[0].material.youngs_modulus": 0.03,
    "segments[0].compensation.modulus_per_pressure": 0.01,
    "segments[0].compensation.stiffness": 0.05,
    "segments[0].corrections.gain[0]": 0.02,
    "segments[0].corrections.gain[2]": 0.02,
    "segments[0].corrections.offset[1]": 500.0,
    "segments[0].corrections.azimuth[0]": 0.01,
}
P = np.array([0.7e5, 0.2e5, 0.5e5])
HYSTERESIS = History(
    memory=(1.0, 0.5, 1.5),
    play=(Play(width=3e3, share=0.1), Play(width=12e3, share=0.15), Play(width=40e3, share=0.05)),
)
DIRECTION = (0.6, 0.0, 0.8)


def correlation(n: int, seed: int = 3) -> Array:
    """Return a random matrix of correlations."""
    root = np.random.default_rng(seed).normal(size=(n, n + 3))
    matrix = root @ root.T
    scale = np.sqrt(np.diag(matrix))
    return matrix / np.outer(scale, scale)


def calibrated(
    name: str = "stiff-flop-1", history: History | None = None, **changes: Any
) -> RobotDescription:
    """Return a robot with a calibration of `KEYS`."""
    plain = load_description(name)
    robot = with_values(plain, {Parameter("segments[0].corrections.gain[1]"): 1.05})
    segment = robot.segments[0].model_copy(update={"history": history})
    n = len(plain.pressure_min)
    given: dict[str, Any] = {
        "parameters": [
            FittedParameter(key=key, deviation=deviation, prior=2 * deviation)
            for key, deviation in KEYS.items()
        ],
        "correlation": correlation(len(KEYS)).tolist(),
        "position_residual": 0.0,
        "pressure_min": [0.0] * n,
        "pressure_max": [1e5] * n,
        "pressure_norm": [1.2e5] * robot.n_segments,
        **changes,
    }
    return robot.model_copy(
        update={"segments": (segment, *robot.segments[1:]), "calibration": Calibration(**given)}
    )


def others(robot: RobotDescription, steps: Array) -> Iterator[Manipulator]:
    """Yield arms whose parameters have these coordinates (N, k); relative where positive."""
    for step in steps:
        values = {}
        for key, change in zip(KEYS, step, strict=True):
            nominal = Parameter(key).value(robot)
            additive = any(word in key for word in ("offset", "azimuth", "per_pressure"))
            values[Parameter(key)] = nominal + change if additive else nominal * np.exp(change)
        yield Manipulator(with_values(robot, values))


def covariance_of(robot: RobotDescription) -> Array:
    deviations = np.array(list(KEYS.values()))
    return np.asarray(correlation(len(KEYS)) * np.outer(deviations, deviations))


def spread(robot: RobotDescription, value: Callable[[Manipulator], Any]) -> Array:
    """Covariance of a value, from arms on both sides along each column of the root of theirs."""
    root = 0.3 * np.linalg.cholesky(covariance_of(robot)).T
    up = np.array([value(arm) for arm in others(robot, root)])
    down = np.array([value(arm) for arm in others(robot, -root)])
    half = np.atleast_2d((up - down).reshape(len(root), -1).T / 2 / 0.3)
    return np.asarray(half @ half.T)


# The parameters' part ----------------------------------------------------------------------------


def test_errors_of_the_parameters_move_the_tip_of_a_free_arm() -> None:
    robot = calibrated()
    found = Manipulator(robot).tip_uncertainty(P)
    expected = spread(robot, lambda arm: arm.tip_pose(P)[:3, 3])
    np.testing.assert_allclose(found.parameters, expected, rtol=2e-3, atol=2e-3 * expected.max())
    assert not found.hysteresis.any()
    assert not found.residual.any()
    np.testing.assert_array_equal(found.covariance, found.parameters)


def test_errors_of_the_parameters_move_the_tip_of_a_hanging_arm() -> None:
    robot = calibrated("stiff-flop-2-hanging")
    p = np.concatenate([P, [0.1e5, 0.6e5, 0.3e5]])
    found = Manipulator(robot).tip_uncertainty(p)
    expected = spread(robot, lambda arm: arm.tip_pose(p)[:3, 3])
    np.testing.assert_allclose(found.parameters, expected, rtol=5e-3, atol=5e-3 * expected.max())


def test_errors_of_the_parameters_move_the_tip_under_a_load() -> None:
    robot, force = calibrated(), (0.05, -0.1, 0.02)
    free = Manipulator(robot)
    before = free.tip_uncertainty(P).covariance
    found = free.with_load(force).tip_uncertainty(P)
    expected = spread(robot, lambda arm: arm.with_load(force).tip_pose(P)[:3, 3])
    np.testing.assert_allclose(found.parameters, expected, rtol=5e-3, atol=5e-3 * expected.max())
    assert np.abs(found.covariance - before).max() > 0.1 * before.max()
    np.testing.assert_array_equal(free.tip_uncertainty(P).covariance, before)  # each its own


@pytest.mark.one_in(2, "name")
@pytest.mark.parametrize(
    ("name", "load"), [("stiff-flop-1", None), ("stiff-flop-1", (0.05, 0.0, 0.1))]
)
def test_errors_of_the_parameters_change_the_stiffness(name: str, load: Any) -> None:
    robot = calibrated(name)

    def loaded(arm: Manipulator) -> Manipulator:
        return arm if load is None else arm.with_load(load)

    arm = loaded(Manipulator(robot))
    low, high = arm.tip_uncertainty(P).stiffness_interval(DIRECTION, boundary="guided")
    k = arm.stiffness(P, DIRECTION, boundary="guided")
    ((variance,),) = spread(
        robot, lambda arm: np.log(loaded(arm).stiffness(P, DIRECTION, boundary="guided"))
    )
    half = 1.959964 * np.sqrt(variance)
    assert [np.log(low / k), np.log(high / k)] == pytest.approx([-half, half], rel=5e-3)


def test_95_of_100_drawn_arms_are_inside_of_what_is_told() -> None:
    robot = calibrated()
    arm = Manipulator(robot)
    known = arm.tip_uncertainty(P)
    steps = np.random.default_rng(5).multivariate_normal(
        np.zeros(len(KEYS)), covariance_of(robot), size=200
    )
    drawn = list(others(robot, steps))
    tips = np.array([each.tip_pose(P)[:3, 3] for each in drawn]) - arm.tip_pose(P)[:3, 3]
    assert inside(known, tips) == pytest.approx(0.95, abs=0.03)
    low, high = known.stiffness_interval((1, 0, 0), frame="tip")
    k = np.array([each.stiffness(P, (1, 0, 0), frame="tip") for each in drawn])
    assert np.mean((k > low) & (k < high)) == pytest.approx(0.95, abs=0.03)
    assert np.mean(k <= low) == pytest.approx(np.mean(k >= high), abs=0.03)


def inside(known: TipUncertainty, errors: Array) -> float:
    """Share of errors (N, 3) within the ellipsoid."""
    return float(np.mean((((errors @ known.axes) / known.semi_axes) ** 2).sum(axis=1) <= 1))


def test_the_ellipsoid_holds_95_of_100_errors() -> None:
    known = Manipulator(calibrated(position_residual=3e-4)).tip_uncertainty(P)
    errors = np.random.default_rng(1).multivariate_normal(np.zeros(3), known.covariance, 40_000)
    assert inside(known, errors) == pytest.approx(0.95, abs=0.004)
    assert (np.diff(known.semi_axes) <= 0).all()


def test_a_stiffness_that_no_parameter_changes_is_known() -> None:
    robot = calibrated(parameters=(), correlation=())
    arm = Manipulator(robot)
    k = arm.stiffness(P, DIRECTION)
    assert arm.tip_uncertainty(P).stiffness_interval(DIRECTION) == pytest.approx((k, k))
    assert arm.tip_uncertainty(P).semi_axes.max() == 0


def test_digits_that_the_file_leaves_out_make_no_variance_negative() -> None:
    rounded = [[1.0, 0.9999, 0.9999], [0.9999, 1.0, 1.0], [0.9999, 1.0, 1.0]]
    assert np.linalg.eigvalsh([[1, 0.9995, 0.9995], [0.9995, 1, 1], [0.9995, 1, 1]])[0] < 1e-12
    rounded[0][2] = rounded[2][0] = 0.9995
    assert np.linalg.eigvalsh(rounded)[0] < -1e-6
    parameters = [
        FittedParameter(key=key, deviation=0.1, prior=0.2)
        for key in ("segments[0].length", "segments[0].compensation.area", list(KEYS)[1])
    ]
    robot = calibrated(parameters=parameters, correlation=rounded)
    assert robot.calibration is not None
    covariance = robot.calibration.covariance
    assert np.linalg.eigvalsh(covariance)[0] > -1e-12
    np.testing.assert_allclose(covariance, np.array(rounded) * 0.01, atol=1e-3 * 0.01)
    known = Manipulator(robot).tip_uncertainty(P)
    assert np.isfinite(known.semi_axes).all()
    assert np.isfinite(known.stiffness_interval(DIRECTION)).all()


# Hysteresis --------------------------------------------------------------------------------------


def after_ways(robot: RobotDescription, p: Array, count: int) -> Array:
    """Effective pressures (count, 3) after ways from rest to two recorded pressures, then to p."""
    assert robot.calibration is not None
    rng, found = np.random.default_rng(5), []
    memory = Memory([robot.segments[0].history] * 3, [0, 1, 2])
    for way in rng.uniform(0, robot.calibration.pressure_max, (count, 2, 3)):
        memory.start(np.zeros(3))
        found.append(memory.run(1.0, np.vstack([way, p]))[-1])
    return np.array(found)


@pytest.mark.parametrize(
    ("of", "softening"),
    [
        ("pressure", 0.0),
        ("elongation", 0.0),
        ("bending", 0.0),
        ("opposite", 0.0),
        ("opposite", -2e-6),
    ],
)
@pytest.mark.parametrize("p", [P, np.array([0.02e5, 0.0, 0.6e5]), np.array([1.5e5, 0.0, 0.3e5])])
def test_hysteresis_moves_the_tip_as_former_pressures_do(
    p: Array, of: Part, softening: float
) -> None:
    plays = [Play(width=w, share=0.02, of=of) for w in (3e3, 12e3, 40e3)]
    history = History(memory=(0.5, 1.0, 1.5), softening=softening, remembers="strain", play=plays)
    robot = calibrated(history=history, parameters=(), correlation=())
    arm = Manipulator(robot)
    found = arm.tip_uncertainty(p)
    errors = arm.tip_pose(after_ways(robot, p, 2000))[:, :3, 3] - arm.tip_pose(p)[:3, 3]
    expected = errors.T @ errors / len(errors)
    np.testing.assert_allclose(found.hysteresis, expected, atol=0.12 * expected.max())
    assert found.largest_part == "hysteresis"


@pytest.mark.parametrize("residual", [3e-4, 3e-3])
def test_regions_without_history_hold_what_they_say(residual: float) -> None:
    robot = calibrated(
        history=HYSTERESIS, parameters=(), correlation=(), position_residual=residual
    )
    arm, rng, levels = Manipulator(robot), np.random.default_rng(6), []
    for p in rng.uniform(0, 1e5, (20, 3)):
        known = Uncertainty(robot).errors(p[np.newaxis])
        slopes = arm.tip_pose(p)[:3, :3] @ arm.tip_jacobian(p)[:3]
        errors = (after_ways(robot, p, 100) - p) @ slopes.T
        errors += rng.normal(0, residual, errors.shape)
        levels.append(Uncertainty(robot).levels(errors, known))
        squares = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(known.covariance[0]), errors)
        region = arm.tip_uncertainty(p)
        size = region.semi_axes_at(0.5)[0] ** 2 / np.linalg.eigvalsh(region.covariance)[-1]
        assert np.mean(squares <= size) == pytest.approx(np.mean(levels[-1] <= 0.5))
    for level in (0.5, 0.68, 0.9, 0.95, 0.99):
        assert np.mean(np.concatenate(levels) <= level) == pytest.approx(level, abs=0.05)


def test_hysteresis_is_at_most_what_was_recorded() -> None:
    settled = (200.0, 1e6, 1e6)
    errors = ErrorModel(
        residual=1e-4, discrepancy=0.0, reach=1e4, gain=0.0, degrees_of_freedom=9.0,
        recorded=(tuple(P),),
    )  # fmt: skip
    free, held = (
        calibrated(
            history=HYSTERESIS,
            errors=errors.model_copy(update={"settled": each}),
            parameters=(),
            correlation=(),
        )
        for each in ((), settled)
    )
    slope = Manipulator(free).tip_pose(P)[:3, :3] @ Manipulator(free).tip_jacobian(P)[:3]
    inverse = np.linalg.inv(slope)
    acting = [
        inverse @ Manipulator(each).tip_uncertainty(P).hysteresis @ inverse.T
        for each in (free, held)
    ]
    assert acting[1][0, 0] == pytest.approx(0.9 * 200.0**2)
    np.testing.assert_allclose(acting[1][1:, 1:], acting[0][1:, 1:])


CREEP = History(
    creep=tuple(Creep(time=t, share=s) for t, s in zip((2.0, 20.0), (0.05, 0.08), strict=True))
)


def creeping(size: float, residual: float = 1e-4) -> RobotDescription:
    """A robot with creep, whose effective pressures were off by `size` in Pa in held poses."""
    errors = ErrorModel(
        residual=residual, discrepancy=0.0, reach=1e4, gain=0.0, degrees_of_freedom=6.0,
        recorded=(tuple(P), (0.2e5, 0.9e5, 0.4e5)), settled=(size,) * 3,
    )  # fmt: skip
    return calibrated(history=CREEP, errors=errors, parameters=(), correlation=())


def crept(p: Array, count: int, held: float | None = None) -> Array:
    """What creep leaves (count, 3) after three poses of 6 s from 0 to 1 bar and 1.5 to 6 s at p.

    If it is known for how long the last one has been `held`, half a motion of 1.6 s came before.

    Before, the arm had such poses for long, and was at rest for a seventh of the time.
    """
    rng, found = np.random.default_rng(7), []
    memory = Memory([CREEP] * 3, [0, 1, 2])
    ways, ages = rng.uniform(0, 1e5, (count, 3, 3)), rng.uniform(1.5, 6, count)
    if held is not None:
        ages[:] = 0.8 + held
    for way, age in zip(ways, ages, strict=True):
        memory.settle(np.full(3, 6 / 7 * 0.5e5))
        memory.run(6.0, way)
        found.append(memory.advance(age, p) - p)
    return np.array(found)


@pytest.mark.parametrize("size", [1e3, 2e3, 1e6])
def test_creep_is_left_as_far_as_was_recorded(size: float) -> None:
    robot = creeping(size)
    arm = Manipulator(robot)
    assert robot.calibration is not None
    assert robot.calibration.errors is not None
    recorded = np.array(robot.calibration.errors.recorded)
    ways = np.array([crept(p, 3000) for p in recorded])
    ways *= np.minimum(1.0, size / np.sqrt((ways**2).mean(axis=(0, 1))))
    for p, moves in zip(recorded, ways, strict=True):
        middle = p + moves.mean(axis=0) / 2
        slope = arm.tip_pose(middle)[:3, :3] @ arm.tip_jacobian(middle)[:3]
        expected = slope @ (moves.T @ moves / len(moves)) @ slope.T
        found = arm.tip_uncertainty(p).hysteresis
        assert np.trace(found) == pytest.approx(np.trace(expected), rel=0.03)
        atol = 0.08 * expected.max()  # channels of 256 ways are correlated by chance, by 1 / 16
        np.testing.assert_allclose(found, expected, atol=atol)


@pytest.mark.parametrize(
    ("creep", "remembers", "share"),
    [(CREEP.creep, "pressure", 0.1), (CREEP.creep, "strain", 0.05), ((), "pressure", 0.0)],
)
def test_with_creep_a_known_memory_is_wrong_by_a_share(
    creep: tuple[Creep, ...], remembers: Literal["pressure", "strain"], share: float
) -> None:
    play = (Play(width=3e3, share=0.02),)
    history = History(lag=0.2, dead_time=0.05, play=play, creep=creep, remembers=remembers)
    robot = calibrated(history=history)
    rates, remembered = np.array([1e4, -2e4, 0.0]), np.array([3e3, 1e3, -2e3])
    u = P - 0.25 * rates + remembered
    known = Uncertainty(robot).errors(P[None], effective=u[None], rates=rates[None])
    arm = Manipulator(robot)
    way = arm.tip_pose(u)[:3, :3] @ arm.tip_jacobian(u)[:3] @ remembered
    expected = (share * np.linalg.norm(way)) ** 2 / 3
    np.testing.assert_allclose(known.hysteresis[0], expected * np.eye(3), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("residual", [3e-4, 1e-3, 5e-3])
def test_regions_with_creep_hold_what_they_say(residual: float) -> None:
    """Creep is bounded; other errors have the tail of a t-distribution."""
    robot = creeping(1e6, residual)
    source, rng, levels = Uncertainty(robot), np.random.default_rng(8), []
    arm = Manipulator(robot)
    for p in rng.uniform(0, 1e5, (20, 3)):
        errors = arm.tip_pose(p + crept(p, 200))[:, :3, 3] - arm.tip_pose(p)[:3, 3]
        scale = residual * np.sqrt(4 / rng.chisquare(6.0, (len(errors), 1)))
        errors += scale * rng.normal(size=errors.shape)
        levels.append(source.levels(errors, source.errors(p[np.newaxis])))
    for level in (0.5, 0.68, 0.9, 0.95, 0.99):
        assert np.mean(np.concatenate(levels) <= level) == pytest.approx(level, abs=0.05)


@pytest.mark.parametrize("held", [0.5, 3.0, 20.0])
def test_regions_with_creep_know_for_how_long_pressures_were_held(held: float) -> None:
    robot = creeping(1e6)
    source, arm = Uncertainty(robot), Manipulator(robot)
    moves = crept(P, 3000, held)
    errors = arm.tip_pose(P + moves)[:, :3, 3] - arm.tip_pose(P)[:3, 3]
    errors += np.random.default_rng(9).normal(0, 1e-4, errors.shape)
    size = np.trace(arm.tip_uncertainty(P, held=held).hysteresis)
    assert size == pytest.approx(np.mean((errors**2).sum(axis=1)) - 3e-8, rel=0.05)
    many = source.errors(np.tile(P, (3, 1)), held=np.array([np.nan, held, 1e3]))
    unknown, known, long_held = np.trace(many.hysteresis, axis1=1, axis2=2)
    assert unknown == pytest.approx(np.trace(arm.tip_uncertainty(P).hysteresis))
    assert known == pytest.approx(size)
    assert long_held < 1e-6 * unknown


def test_only_held_pressures_have_been_held_for_a_time() -> None:
    arm = Manipulator(creeping(1e3))
    for held in (-1.0, np.nan):
        with pytest.raises(InputError, match=r"0 s or longer; got (-1\.0|nan)"):
            arm.tip_uncertainty(P, held=held)
    with pytest.raises(InputError, match=r"got 2\.0, and that they move"):
        arm.tip_uncertainty(P, moving=True, held=2.0)


def test_hysteresis_moves_the_tip_less_where_the_arm_is_soft() -> None:
    """As far as at recorded pressures, of which the first is the median, except in a dead band."""
    recorded = np.array([[4e4, 3e4, 2e4], [1e4, 0.0, 0.0], [1.2e5, 1.2e5, 0.0]])
    errors = ErrorModel(
        residual=1e-4, discrepancy=0.0, reach=1e4, gain=0.0, degrees_of_freedom=9.0,
        recorded=tuple(map(tuple, recorded.tolist())),
    )  # fmt: skip
    arms = []
    for each in (None, errors):
        robot = calibrated(history=HYSTERESIS, errors=each, parameters=(), correlation=())
        segment = robot.segments[0].model_copy(update={"corrections": Corrections(dead_band=2e4)})
        arms.append(Manipulator(robot.model_copy(update={"segments": (segment,)})))
    free, held = arms

    def softness(p: Array) -> float:
        slope = free.tip_pose(p)[:3, :3] @ free.tip_jacobian(p)[:3]
        return float((slope**2).sum())

    usual = np.median([softness(p) for p in recorded])
    for p, least in ((np.array([1.4e5, 0.2e5, 1e5]), 0.0), (np.array([2.1e4, 1e3, 2e3]), 0.25)):
        share = 0.9 / max(softness(p) / usual, least)
        assert (softness(p) < 0.25 * usual) == (least > 0)
        expected = share * free.tip_uncertainty(p).hysteresis
        np.testing.assert_allclose(held.tip_uncertainty(p).hysteresis, expected, rtol=1e-6)


def test_hysteresis_widens_the_interval_of_the_stiffness() -> None:
    robot = calibrated(history=HYSTERESIS, parameters=(), correlation=())
    arm = Manipulator(robot)
    k = arm.stiffness(P, DIRECTION)
    low, high = arm.tip_uncertainty(P).stiffness_interval(DIRECTION)
    slopes = []
    for step in 10.0 * np.eye(3):
        ends = [arm.stiffness(P + sign * step, DIRECTION) for sign in (1, -1)]
        slopes.append(np.log(ends[0] / ends[1]) / 20)
    deviation = np.sqrt(np.mean(((after_ways(robot, P, 1000) - P) @ slopes) ** 2))
    assert np.log(high / k) == pytest.approx(1.959964 * deviation, rel=0.06)
    assert np.log(k / low) == pytest.approx(np.log(high / k))


# The rest ----------------------------------------------------------------------------------------


def test_what_is_unexplained_is_the_same_in_all_directions() -> None:
    arm = Manipulator(calibrated(parameters=(), correlation=(), position_residual=5e-4))
    known = arm.tip_uncertainty(P)
    # 95 % of the lengths of vectors with three normal components are below 2.7955 deviations
    np.testing.assert_allclose(known.semi_axes, 2.7955 * 5e-4, rtol=1e-4)
    assert known.largest_part == "residual"
    np.testing.assert_allclose(known.axes.T @ known.axes, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("p", "expected"),
    [
        ((0.5e5, 0.5e5, 0.5e5), True),
        ((1.01e5, 0.0, 0.0), True),  # hardly beyond
        ((1.1e5, 0.0, 0.0), False),
        ((0.9e5, 0.9e5, 0.0), False),  # each, but not both at once
    ],
)
def test_pressures_that_were_recorded(p: tuple[float, ...], expected: bool) -> None:
    assert Manipulator(calibrated()).tip_uncertainty(p).inside is expected


def test_where_nothing_is_said_of_what_was_recorded_nothing_is_outside() -> None:
    robot = calibrated(pressure_min=(), pressure_max=(), pressure_norm=())
    assert Manipulator(robot).tip_uncertainty((1.4e5, 0.0, 1.4e5)).inside is True


def test_a_robot_that_was_not_calibrated_says_so() -> None:
    with pytest.raises(InputError, match="'stiff-flop-1' was not calibrated"):
        load_robot("stiff-flop-1").tip_uncertainty(P)


def test_one_set_of_pressures_at_a_time() -> None:
    with pytest.raises(PressureError, match=r"expected one set of pressures \(3,\), not a batch"):
        Manipulator(calibrated()).tip_uncertainty([P, P])


def test_a_bad_direction_is_refused() -> None:
    with pytest.raises(InputError):
        Manipulator(calibrated()).tip_uncertainty(P).stiffness_interval((0, 0, 0))
