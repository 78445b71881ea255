"""Compensation: stiffness and softening, a least bending radius, and lengthening by bending."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from independent.arms import FLOP, Tube, neo_hookean
from independent.motions import derivative
from independent.sections import section
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description
from stiffopt.model.segment import Compensation, Segment
from tested_laws import LAWS, TUBES, evaluated, resultant, scaled, segment_of, some_pressures

Vector = NDArray[np.float64]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", TUBES)
def test_a_compensation_that_says_nothing_changes_nothing(name: str, law: str) -> None:
    tube = LAWS[law](replace(TUBES[name], factors=None))
    p = some_pressures(tube)
    for plain, spelled in zip(
        evaluated(segment_of(tube), p),
        evaluated(Segment(**tube.mapping() | {"compensation": Compensation()}), p),
        strict=True,
    ):
        assert np.array_equal(plain, spelled)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["flop", "lopsided"])
def test_free_shapes_know_nothing_of_stiffness_and_softening(name: str, law: str) -> None:
    """Loads meet ``stiffness (E + softening slope |p|)``; every flexibility is one over that."""
    tube = LAWS[law](TUBES[name])
    given = {"modulus_per_pressure": -0.3, "area": 1.1, "inertia": 0.9}
    for seed, softening in enumerate((0.0, 0.25, 1.0)):
        p = some_pressures(tube, seed)
        free, C = evaluated(segment_of(tube, **given), p)
        strain, loaded = evaluated(segment_of(tube, **given, stiffness=1.4, softening=softening), p)
        assert strain == pytest.approx(free, rel=1e-14, abs=1e-16)
        E, slope = tube.youngs_modulus, -0.3 * np.linalg.norm(p)
        ratio = (E + slope) / (1.4 * (E + softening * slope))
        assert scaled(loaded, C) == pytest.approx(ratio * scaled(C, C), abs=1e-6)


def test_stiffness_of_a_segment_that_pressure_does_not_soften() -> None:
    """Values of another implementation, in N/m."""
    mapping = load_description("stiff-flop-1").model_dump()
    mapping["segments"][0]["compensation"] |= {"stiffness": 1.396, "softening": 0.0}
    robot = Manipulator(RobotDescription(**mapping))
    for pressures, expected in {
        (0.4, 0, 0): (19.22, 18.40, 337.43),
        (0.8, 0, 0): (21.27, 17.03, 91.84),
        (1.0, 0, 0): (24.27, 16.28, 55.64),
        (1.5, 0, 0): (56.29, 14.44, 23.19),
        (0.5, 1.0, 0.2): (14.531, 18.047, 77.863),
    }.items():
        found = [robot.stiffness(1e5 * np.array(pressures), axis) for axis in np.eye(3)]
        assert found == pytest.approx(expected, rel=3e-4)


def moment_pressures(tube: Tube, p: Vector, moment: Vector) -> Vector:
    """Pressures that add a moment (M_x, M_y) to that of p, and no force."""
    geometry = SectionGeometry.of(segment_of(tube))
    first = np.array([moment[1], moment[0]]) * [-1, 1]  # int r P dA
    wanted = np.array([*first, 0.0])
    effect = np.vstack([geometry.channel_moment.T, geometry.channel_force])
    return p + np.linalg.pinv(effect) @ wanted


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["flop", "cross", "six"])
def test_loads_bend_by_the_derivative_of_the_limited_curvature(name: str, law: str) -> None:
    """A moment by added pressures without a force bends like one by a load; isotropic section."""
    tube = LAWS[law](replace(TUBES[name], factors=None))
    p = 0.8e5 * np.linspace(1, 0, len(tube.channels))
    free, _ = evaluated(segment_of(tube), p)
    segment = segment_of(tube, bending_radius=0.5 / float(np.linalg.norm(free[3:5])))
    strain, C = evaluated(segment, p)
    assert np.linalg.norm(strain[3:5]) < 0.97 * np.linalg.norm(free[3:5])

    def curvature(moment: Vector) -> Vector:
        return evaluated(segment, moment_pressures(tube, p, moment))[0][3:5]

    slope = derivative(curvature, np.zeros(2), 1e-5)
    # of chambers that shrink with the section, see the neo-Hookean law
    lever = section(tube, p).stretch ** -0.5 if law == "neo-hookean" else 1.0
    assert C[3:5, 3:5] == pytest.approx(slope / lever, rel=1e-7, abs=1e-7 * np.abs(slope).max())


@pytest.mark.parametrize("name", ["pair", "lopsided"])
def test_a_bending_radius_keeps_the_compliance_symmetric(name: str) -> None:
    """Where the section has a weak axis, the determinant is still that of the derivative."""
    tube = replace(TUBES[name], factors=None)
    radius = 0.4 * tube.length
    p = some_pressures(tube, 1)
    free, C = evaluated(segment_of(tube), p)
    strain, less = evaluated(segment_of(tube, bending_radius=radius), p)
    assert np.allclose(less, less.T, rtol=1e-12, atol=1e-15)
    stretch = section(tube, p).stretch
    kappa = free[3:5] / stretch
    limited = kappa / np.hypot(1, radius * np.linalg.norm(kappa))
    assert strain[3:5] == pytest.approx(stretch * limited, rel=1e-12)
    slope = derivative(lambda k: k / np.hypot(1, radius * np.linalg.norm(k)), kappa, 1e-3 / radius)
    parts = [np.linalg.det(matrix[3:5, 3:5]) for matrix in (less, C)]
    assert parts[0] == pytest.approx(np.linalg.det(slope) * parts[1], rel=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_pressure_bends_ever_more_but_no_further_than_the_radius(law: str) -> None:
    tube = LAWS[law](replace(FLOP, factors=None))
    segment = segment_of(tube, bending_radius=0.03, area=1e7)  # hardly stretches
    curvatures = [
        float(np.linalg.norm(evaluated(segment, q * np.array([1, 0, 0.3]))[0][3:5]))
        for q in np.geomspace(1e2, 1e9, 50)
    ]
    assert (np.diff(curvatures) > 0).all()
    little = evaluated(segment_of(tube, area=1e7), np.array([1e2, 0, 30]))[0][3:5]
    assert curvatures[0] == pytest.approx(np.linalg.norm(little), rel=1e-4)
    assert curvatures[-1] * 0.03 == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("law", LAWS)
def test_bending_lengthens_the_axis_by_the_squared_strain_of_the_wall(law: str) -> None:
    tube = LAWS[law](FLOP)
    p = np.array([1.2e5, 0.1e5, 0.4e5])
    free, C = evaluated(segment_of(tube, bending_radius=0.07), p)
    strain, longer = evaluated(segment_of(tube, bending_radius=0.07, lengthening=0.6), p)
    if law == "paper":  # curvature and compliance are per deformed length
        curvature = free[3:5] / free[2]
        assert strain[3:5] == pytest.approx(free[3:5] * strain[2] / free[2], rel=1e-12)
        assert longer == pytest.approx(C * strain[2] / free[2], rel=1e-12)
    else:
        curvature = free[3:5]
        assert strain[3:5] == pytest.approx(free[3:5], rel=1e-14)
        assert longer == pytest.approx(C, rel=1e-14)
    wall = 0.015 * np.linalg.norm(curvature)
    assert strain[2] - free[2] == pytest.approx(0.6 * wall**2, rel=1e-10)
    assert wall > 0.05


@pytest.mark.parametrize("name", TUBES)
def test_compensated_neo_hookean_section_by_integrated_stresses(name: str) -> None:
    """The stretch by a root, stiffnesses by differences of stresses over a scaled section."""
    tube = neo_hookean(TUBES[name])
    given = {"modulus_per_pressure": -0.25, "area": 1.2, "inertia": 1.05}
    segment = segment_of(tube, **given, stiffness=1.3, softening=0.4)
    geometry = SectionGeometry.of(segment)
    p = np.full(len(tube.channels), 0.6e5)
    norm = np.linalg.norm(p)
    pushed = replace(tube, youngs_modulus=tube.youngs_modulus - 0.25 * norm)
    met = replace(tube, youngs_modulus=1.3 * (tube.youngs_modulus - 0.25 * 0.4 * norm))

    def stress(of: Tube, shrink: float, xi: Vector) -> Vector:
        return resultant(of, shrink, xi, 1.2, 1.05)

    force = float(geometry.channel_force @ p)
    stretch = brentq(
        lambda L: stress(pushed, L**-0.5, np.array([0, 0, L, 0, 0, 0]))[2] - force, 1, 5
    )
    shrink = stretch**-0.5
    straight = np.array([0, 0, stretch, 0, 0, 0])
    strain, C = evaluated(segment, p)
    expected = np.linalg.inv(derivative(lambda xi: stress(met, shrink, xi), straight, 1e-3))
    assert scaled(C, expected) == pytest.approx(scaled(expected, expected), abs=1e-7)
    # the strain balances the pressures, linearised in curvature
    x, y = shrink * (geometry.channel_moment.T @ p)
    applied = np.array([0, 0, force, y, -x, 0])
    K = derivative(lambda xi: stress(pushed, shrink, xi), straight, 1e-3)
    balanced = straight + np.linalg.solve(K, applied - stress(pushed, shrink, straight))
    assert strain == pytest.approx(balanced, rel=1e-7, abs=1e-7)
