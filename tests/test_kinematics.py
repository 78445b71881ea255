"""Poses of the unloaded arm: arcs, chains, symmetries and derivatives."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from independent.arms import ARMS, LOPSIDED, Arm, Tube, neo_hookean
from independent.elements import discretise, five_exponentials
from independent.motions import body_twists, derivative
from independent.sections import rod_section
from stiffopt import lie
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.shape import FreeShape

Vector = NDArray[np.float64]

MIXED = ["2 channels, off axis", "3 segments, mixed", "5 segments, mixed"]


@cache
def robot(name: str, law: str = "paper") -> Manipulator:
    tubes = ARMS[name].tubes
    if law == "neo-hookean":
        tubes = tuple(neo_hookean(tube) for tube in tubes)
    return Manipulator(RobotDescription(**Arm(tubes).mapping()))


def some_pressures(arm: Manipulator, seed: int = 0, highest: float = 0.8e5) -> Vector:
    return np.random.default_rng(seed).uniform(0, highest, arm.n_pressures)


# -- arcs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [1e-12, 1e-7, 1e-3, 1.0, 20.0, 60.0, 100.0])
@pytest.mark.parametrize("direction", [0.0, 0.4, 2.0, -2.5])
def test_one_exponential_is_the_papers_product_of_five(kappa: float, direction: float) -> None:
    """Eqs 6 and 7, from nearly straight (where the paper's d_3 cancels) to beyond a full turn."""
    length, kx, ky = 0.09, kappa * np.cos(direction), kappa * np.sin(direction)
    T = lie.exp(length * np.array([0, 0, 1, kx, ky, 0]))
    assert pytest.approx(five_exponentials(kx, ky, length), abs=2e-14) == T


def test_a_straight_arm_is_exact() -> None:
    arm = load_robot("stiff-flop-3")
    T = arm.tip_pose(np.zeros(9))
    assert np.array_equal(T[:3, :3], np.eye(3))
    assert T[:3, 3] == pytest.approx([0, 0, 0.27], abs=1e-16)
    assert arm.tip_pose(np.full(9, 1e5))[:2, 3] == pytest.approx([0, 0], abs=1e-16)


# -- chains ---------------------------------------------------------------------------------


@pytest.mark.one_in(2)
@pytest.mark.parametrize("law", ["paper", "neo-hookean"])
@pytest.mark.parametrize("name", ARMS)
def test_points_on_the_way_against_an_arm_cut_there(name: str, law: str) -> None:
    """The discretised arm's tip, with the segment that the point is on made shorter."""
    arm = robot(name, law)
    p = some_pressures(arm)
    tubes: list[Tube] = []
    own = ARMS[name].split(p)
    start = 0.0
    for i, whole in enumerate(ARMS[name].tubes):
        tube = neo_hookean(whole) if law == "neo-hookean" else whole
        for at, length, connector in (
            (start + 0.3 * tube.length, 0.3 * tube.length, 0.0),
            (start + tube.length, tube.length, 0.0),
            (start + tube.length + 0.6 * tube.connector, tube.length, 0.6 * tube.connector),
        ):
            cut = Tube(**{**tube.__dict__, "length": length, "connector": connector})
            expected = discretise(Arm((*tubes, cut)), np.concatenate(own[: i + 1]), 1)
            assert arm.pose(p, at) == pytest.approx(expected.pose, abs=2e-7)
        tubes.append(tube)
        start += tube.length + tube.connector
    assert arm.length == pytest.approx(start)
    assert arm.pose(p, arm.length) == pytest.approx(arm.tip_pose(p), abs=1e-13)


@pytest.mark.parametrize("name", MIXED)
def test_the_backbone_runs_along_the_strain(name: str) -> None:
    """dT/dS = T strain^: the backbone's derivative is the section strain (or a connector's)."""
    arm = robot(name)
    p = some_pressures(arm)
    start = 0.0
    for tube, own in zip(ARMS[name].tubes, ARMS[name].split(p), strict=True):
        for at, strain in (
            (start + 0.4 * tube.length, rod_section(tube, own, (0, 0, 0)).strain),
            (start + tube.length + 0.5 * tube.connector, np.array([0, 0, 1.0, 0, 0, 0])),
        ):
            if at < start + tube.length or tube.connector:
                slope = derivative(lambda s: arm.pose(p, float(s[0])), [at], 5e-4)
                twist = body_twists(arm.pose(p, at), slope)[:, 0]
                assert twist == pytest.approx(strain, abs=1e-6)
        start += tube.length + tube.connector


def test_actuation_hands_each_segment_its_own_pressures() -> None:
    arm = robot("5 segments, mixed")
    actuation = Actuation.of(arm.description)
    assert actuation.pressures.numel() == 3 + 4 + 3 + 6 + 2
    assert actuation.margin.numel() == len(actuation.sections) == 5
    straight = arm.tip_pose(np.zeros(18))
    starts = np.cumsum([0, 3, 4, 3, 6, 2])
    for i, at in enumerate(np.cumsum([s.length + s.connector for s in arm.description.segments])):
        p = np.zeros(18)
        p[starts[i] : starts[i + 1]] = 0.5e5 * np.arange(1, starts[i + 1] - starts[i] + 1) / 3
        if i:  # nothing moves before the segment that is pressed
            before = at - sum(
                getattr(arm.description.segments[i], key) for key in ("length", "connector")
            )
            assert arm.pose(p, before) == pytest.approx(arm.pose(np.zeros(18), before), abs=1e-15)
        assert np.abs(arm.tip_pose(p) - straight).max() > 1e-3


def test_free_shape_of_a_station_and_of_the_tip() -> None:
    arm = robot("3 segments, mixed")
    actuation = Actuation.of(arm.description)
    tip = FreeShape.of(arm.description, actuation)
    same = FreeShape.of(arm.description, actuation, arm.length)
    assert tip.inputs == (actuation.pressures,)
    assert tip.transform.shape == same.transform.shape == (4, 4)
    assert tip.compliance.shape == (6, 6)
    assert tip.jacobian.shape == (6, arm.n_pressures)


# -- symmetry -------------------------------------------------------------------------------


def mirrored_pairs(p: Vector) -> Vector:
    """Pairs 2 and 3, at 120 and 240 degrees, swapped in every segment."""
    return p.reshape(-1, 3)[:, [0, 2, 1]].ravel()


@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-3", "stiff-flop-2-hanging"])
def test_a_mirrored_actuation_mirrors_pose_and_compliance(name: str) -> None:
    """The mirror is y -> -y; moments and rotations are axial vectors and take the other sign."""
    arm = load_robot(name)
    p = some_pressures(arm, 1, 1.2e5)
    mirror = np.diag([1.0, -1.0, 1.0])
    for_twists = np.kron(np.diag([1, -1]), mirror)
    T, image = arm.tip_pose(p), arm.tip_pose(mirrored_pairs(p))
    assert image[:3, :3] == pytest.approx(mirror @ T[:3, :3] @ mirror, abs=1e-11)
    assert image[:3, 3] == pytest.approx(mirror @ T[:3, 3], abs=1e-12)
    C, image = arm.tip_compliance(p), arm.tip_compliance(mirrored_pairs(p))
    expected = for_twists @ C @ for_twists.T
    assert image == pytest.approx(expected, abs=1e-10 * np.abs(C).max())
    columns = np.arange(arm.n_pressures).reshape(-1, 3)[:, [0, 2, 1]].ravel()
    jacobian, image = arm.tip_jacobian(p), arm.tip_jacobian(mirrored_pairs(p))
    expected = for_twists @ jacobian[:, columns]
    assert image == pytest.approx(expected, abs=1e-10 * np.abs(jacobian).max())


@pytest.mark.parametrize(
    "name",
    [
        "stiff-flop-1", "stiff-flop-3", "stiff-flop-1, hanging",
        pytest.param("stiff-flop-2-hanging", marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_a_turn_of_the_channels_turns_compliance_and_derivatives(name: str) -> None:
    """Tip axes turn along, R_z T R_z^T, so all that is meant in them turns by the same R_z."""
    arm = load_robot(name.removesuffix(", hanging"))
    if name.endswith(", hanging"):
        arm = Manipulator(arm.description.model_copy(update={"gravity": (0.0, 0.0, 9.81)}))
    p = some_pressures(arm, 2, 1.2e5)
    q = np.roll(p.reshape(-1, 3), 1, axis=1).ravel()
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    turn = np.kron(np.eye(2), [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    C = arm.tip_compliance(p)
    assert arm.tip_compliance(q) == pytest.approx(turn @ C @ turn.T, abs=1e-10 * np.abs(C).max())
    columns = np.roll(np.arange(arm.n_pressures).reshape(-1, 3), 1, axis=1).ravel()
    first, second = arm.tip_jacobian(p), arm.tip_jacobian_derivative(p)
    expected = (turn @ first)[:, columns]
    assert arm.tip_jacobian(q) == pytest.approx(expected, abs=1e-10 * np.abs(first).max())
    expected = np.einsum("ij,jkl->ikl", turn, second)[:, columns][:, :, columns]
    image = arm.tip_jacobian_derivative(q)
    assert image == pytest.approx(expected, abs=1e-8 * np.abs(second).max())


def test_turning_the_whole_layout_turns_the_arm() -> None:
    angle = 0.7
    turned = Tube(**{**LOPSIDED.__dict__, "angles": tuple(np.add(LOPSIDED.angles, 40.107045659))})
    assert np.radians(40.107045659) == pytest.approx(angle, abs=1e-10)
    arms = [Manipulator(RobotDescription(**Arm((tube,)).mapping())) for tube in (LOPSIDED, turned)]
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turn = np.kron(np.eye(2), R)
    p = some_pressures(arms[0])
    T, image = (arm.tip_pose(p) for arm in arms)
    assert image[:3, 3] == pytest.approx(R @ T[:3, 3], abs=1e-10)
    assert image[:3, :3] == pytest.approx(R @ T[:3, :3] @ R.T, abs=1e-9)
    C, image = (arm.tip_compliance(p) for arm in arms)
    assert image == pytest.approx(turn @ C @ turn.T, abs=1e-8 * np.abs(C).max())


# -- derivatives ----------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["paper", "neo-hookean"])
@pytest.mark.parametrize("name", MIXED)
def test_derivatives_of_the_pose_of_mixed_arms(name: str, law: str) -> None:
    arm = robot(name, law)
    for p in (some_pressures(arm), np.full(arm.n_pressures, 0.5e5)):
        expected = body_twists(arm.tip_pose(p), derivative(arm.tip_pose, p, 100.0))
        first = arm.tip_jacobian(p)
        size = np.repeat(np.abs([expected[:3], expected[3:]]).max(axis=(1, 2)), 3)[:, np.newaxis]
        assert first / size == pytest.approx(expected / size, abs=1e-8)
        expected = derivative(arm.tip_jacobian, p, 100.0)
        second = arm.tip_jacobian_derivative(p)
        size = np.repeat(np.abs([expected[:3], expected[3:]]).max(axis=(1, 2, 3)), 3)
        size = size[:, np.newaxis, np.newaxis]
        assert second / size == pytest.approx(expected / size, abs=1e-7)


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e-3, 1.0])
def test_derivatives_near_no_pressure_are_continuous(scale: float) -> None:
    """Below and above the rounding of the cone, 0.01 Pa, the first derivative of the pose holds."""
    for name in ("stiff-flop-2", "3 segments, mixed"):
        arm = robot(name) if name in ARMS else load_robot(name)
        p = scale * np.linspace(0.2, 1.0, arm.n_pressures)
        at_rest = arm.tip_jacobian(np.zeros(arm.n_pressures))
        assert arm.tip_jacobian(p) == pytest.approx(at_rest, abs=1e-4 * np.abs(at_rest).max())
        assert np.isfinite(arm.tip_jacobian_derivative(p)).all()


def test_neo_hookean_arms_are_smooth_at_no_pressure() -> None:
    """Without the cone there are second derivatives at exactly zero too."""
    arm = robot("3 segments, mixed", "neo-hookean")
    zero = np.zeros(arm.n_pressures)
    expected = derivative(arm.tip_jacobian, zero, 100.0)
    second = arm.tip_jacobian_derivative(zero)
    assert second == pytest.approx(expected, abs=1e-8 * np.abs(expected).max())
    # the body twist's derivative is symmetric up to the Lie bracket of the twists (eq. of motion)
    first = arm.tip_jacobian(zero)
    for i in range(arm.n_pressures):
        for k in range(i):
            a, b = first[:, i], first[:, k]
            bracket = np.concatenate(
                [np.cross(a[3:], b[:3]) - np.cross(b[3:], a[:3]), np.cross(a[3:], b[3:])]
            )
            difference = second[:, k, i] - second[:, i, k]
            assert difference == pytest.approx(-bracket, abs=1e-11 * np.abs(second).max() + 1e-20)
