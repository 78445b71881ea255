"""How well a calibrated arm is known, against arms that are built with other values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.errors import InputError, PressureError
from stiffopt.model.calibration import Calibration, FittedParameter
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History, Memory, Part, Play
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description
from stiffopt.model.uncertainty import TipUncertainty, settled_range

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
    known = Manipulator(calibrated(history=HYSTERESIS, position_residual=3e-4)).tip_uncertainty(P)
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


def of_channel(
    channel: int, pressure: float, low: float, high: float, history: History = HYSTERESIS
) -> tuple[float, float]:
    ends = settled_range(history, *np.array([[pressure], [low], [high]]), channel)
    return float(ends[0][0]), float(ends[1][0])


@pytest.mark.parametrize("of", ["elongation", "bending"])
def test_no_way_ends_beyond_what_elongation_or_bending_remembers(of: Part) -> None:
    plays = [Play(width=w, share=0.2, of=of) for w in (3e3, 12e3, 40e3)]
    history, rng = History(memory=(0.5, 1.0, 1.5), play=plays), np.random.default_rng(3)
    memory = Memory([history] * 3, [0, 1, 2])
    low, high = np.array([0.0, -2e4, 0.0]), np.array([1e5, 6e4, 8e4])
    for p in rng.uniform(low, high, (5, 3)):
        least, most = settled_range(history, p, low, high)
        reached = []
        for way in rng.uniform(low, high, (60, 5, 3)):
            corners = np.where(way > (low + high) / 2, high, low)
            memory.start(np.zeros(3))
            reached.append(memory.run(1.0, np.vstack([corners, p]))[-1])
        assert (least <= np.min(reached, axis=0) + 1e-6).all()
        assert (np.max(reached, axis=0) <= most + 1e-6).all()
        if of == "elongation":  # two of the corners reach the ends
            assert np.ptp(reached, axis=0) == pytest.approx(most - least)


@pytest.mark.parametrize("limits", [(0.0, 1e5), (0.2e5, 1e5), (-0.3e5, 1e5), (0.0, 0.15e5)])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_no_way_to_a_pressure_ends_beyond_what_is_possible(
    limits: tuple[float, float], channel: int
) -> None:
    rng = np.random.default_rng(channel)
    low, high = limits
    memory = Memory([HYSTERESIS], [channel])
    for share in (0.0, 0.05, 0.3, 0.8, 1.0):
        p = low + share * (high - low)
        least, most = of_channel(channel, p, low, high)
        assert least <= most
        ends = []
        for _ in range(60):
            memory.start([0.0])
            way = rng.uniform(low, high, size=rng.integers(0, 6))
            ends.append(memory.run(1.0, [[each] for each in (*way, p)])[-1, 0])
        assert least - 1e-6 <= min(ends)
        assert max(ends) <= most + 1e-6
        # the ends are where the shortest way leads, and the one by the other limit
        for way, end in (((min(low, 0.0), p), least), ((high, p), most)):
            memory.start([0.0])
            assert memory.run(1.0, [[each] for each in way])[-1, 0] == pytest.approx(end, abs=1e-6)


def test_hysteresis_is_one_sided_at_the_limits_and_whole_between_them() -> None:
    factor, total = 1.5, 0.1 * 3e3 + 0.15 * 12e3 + 0.05 * 40e3
    for p in (41e3, 69e3):  # a width from rest, and two from the upper limit
        ends = of_channel(2, p, 0.0, 1.5e5)
        assert ends == pytest.approx((p - factor * total, p + factor * total))
    assert of_channel(2, 0.0, 0.0, 1e5) == pytest.approx((0.0, factor * total))
    assert of_channel(2, 1e5, 0.0, 1e5) == pytest.approx((1e5 - factor * total,) * 2)
    assert of_channel(0, 3e4, 0.0, 1e5, History()) == (3e4, 3e4)


@pytest.mark.parametrize("p", [P, np.array([0.02e5, 0.0, 0.6e5]), np.array([1.5e5, 0.0, 0.3e5])])
def test_hysteresis_moves_the_tip_as_drawn_effective_pressures_do(p: Array) -> None:
    small = HYSTERESIS.model_copy(update={"memory": (0.1, 0.05, 0.15)})
    robot = calibrated(history=small, parameters=(), correlation=())
    arm = Manipulator(robot)
    found = arm.tip_uncertainty(p)
    rng = np.random.default_rng(2)
    low, high = robot.pressure_min, robot.pressure_max
    u = np.column_stack(
        [rng.uniform(*of_channel(c, p[c], low[c], high[c], small), 20_000) for c in range(3)]
    )
    # channel by channel: the part knows only each one's mean square, about the equilibrium
    expected = np.zeros((3, 3))
    for c in range(3):
        one = np.tile(p, (len(u), 1))
        one[:, c] = u[:, c]
        errors = arm.tip_pose(one)[:, :3, 3] - arm.tip_pose(p)[:3, 3]
        expected += errors.T @ errors / len(u)
    np.testing.assert_allclose(found.hysteresis, expected, atol=0.05 * expected.max())
    assert found.largest_part == "hysteresis"


def test_hysteresis_widens_the_interval_of_the_stiffness() -> None:
    arm = Manipulator(calibrated(history=HYSTERESIS, parameters=(), correlation=()))
    k = arm.stiffness(P, DIRECTION)
    low, high = arm.tip_uncertainty(P).stiffness_interval(DIRECTION)
    variance = 0.0
    for c in range(3):
        least, most = of_channel(c, P[c], 0.0, arm.description.pressure_max[c])
        step = np.eye(3)[c] * 10.0
        slope = np.log(arm.stiffness(P + step, DIRECTION) / arm.stiffness(P - step, DIRECTION)) / 20
        variance += slope**2 * np.mean((np.linspace(least, most, 10_001) - P[c]) ** 2)
    assert np.log(high / k) == pytest.approx(1.959964 * np.sqrt(variance), rel=1e-3)
    assert np.log(k / low) == pytest.approx(1.959964 * np.sqrt(variance), rel=1e-3)


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
