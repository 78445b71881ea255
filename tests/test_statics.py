"""Equilibrium, stability and compliance under loads against independent rods and exact results."""

from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipk, ellipkinc

import stiffopt as so
from conftest import is_long
from independent.arms import ARMS, FLOP, LOPSIDED, Arm, Tube, neo_hookean
from independent.energies import DiscreteRod
from independent.rods import Load, planar_tip, rod_tip
from independent.sections import rod_section

HANGING = (0.0, 0.0, 9.81)
SLENDER = Tube(length=0.3, factors=None)
COLUMN = Arm((Tube(length=1.0, factors=None),))


def robot(arm, **options):
    return so.Manipulator(so.RobotDescription(**arm.mapping()), **options)


@cache
def column_robot():
    return robot(COLUMN)


def bending_compliance(arm):
    """1 / (E I) of a single unpressurised segment."""
    return rod_section(arm.tubes[0], np.zeros(3), arm.gravity).compliance[4, 4]


@pytest.mark.parametrize("share", [0.5, 2.0, 5.0, 10.0])
def test_large_deflection_against_collocation(share):
    """A dead force across the tip, F L^2 / (E I) up to 10, with shear and extension."""
    arm = Arm((FLOP,))
    force = share / (bending_compliance(arm) * arm.length**2)
    T = robot(arm).loaded_tip_pose(np.zeros(3), [force, 0, 0, 0, 0, 0])
    x, z, angle = planar_tip(arm, np.zeros(3), (force, 0))
    tolerance = 1e-5 if share <= 5 else 5e-5
    assert T[[0, 2], 3] == pytest.approx([x, z], abs=tolerance)
    assert np.arctan2(T[0, 2], T[2, 2]) == pytest.approx(angle, abs=1e-3)


def test_large_deflection_against_the_exact_elastica():
    """Inextensible elastica under an end force, by elliptic integrals (Bisshopp and Drucker).

    The arm is made so thick-walled and long that shear and extension hardly show.
    """
    alpha = 5.0  # F L^2 / (E I)
    force = alpha / (bending_compliance(COLUMN) * COLUMN.length**2)

    def length_of(k):
        return ellipk(k**2) - ellipkinc(np.arcsin(1 / (k * np.sqrt(2))), k**2) - np.sqrt(alpha)

    k = brentq(length_of, np.sqrt(0.5) + 1e-9, 1 - 1e-9)
    sine = 2 * k**2 - 1  # of the tip's angle
    along_force = np.sqrt(2 * sine / alpha)  # x / L in the direction of the undeformed arm
    T = column_robot().loaded_tip_pose(np.zeros(3), [force, 0, 0, 0, 0, 0])
    assert T[2, 3] / COLUMN.length == pytest.approx(along_force, abs=2e-4)
    assert np.sin(np.arctan2(T[0, 2], T[2, 2])) == pytest.approx(sine, abs=5e-4)


def test_pure_moment_bends_to_a_full_circle():
    tube = Tube(factors=None)
    arm = Arm((tube,))
    moment = 2 * np.pi / (bending_compliance(arm) * tube.length)
    T = robot(arm).loaded_tip_pose(np.zeros(3), [0, 0, 0, 0, moment, 0], frame="tip")
    assert pytest.approx(np.eye(4), abs=3e-4) == T
    fine = robot(arm, resolution=4)
    refined = fine.loaded_tip_pose(np.zeros(3), [0, 0, 0, 0, moment, 0], frame="tip")
    assert refined == pytest.approx(np.eye(4), abs=1e-8)


@pytest.mark.parametrize(
    ("gravity", "mass"),
    [((9.81, 0, 0), 0.02), ((0, 0, 9.81), 0.02), ((5.0, 0, 6.0), 0.05), ((3.0, 0, -3.0), 0.0)],
)
def test_weight_against_collocation(gravity, mass):
    arm = Arm((SLENDER,)).under(gravity, mass) if gravity[2] > 0 else Arm((FLOP,)).under(gravity)
    p = np.array([0.3e5, 0, 0]) if gravity[2] > 0 else np.zeros(3)
    T = robot(arm).tip_pose(p)
    x, z, angle = planar_tip(arm, p)
    assert T[[0, 2], 3] == pytest.approx([x, z], abs=1e-5)
    assert np.arctan2(T[0, 2], T[2, 2]) == pytest.approx(angle, abs=1e-3)


SPATIAL = {
    "hanging, pressures": (Arm((FLOP, FLOP)).under(HANGING, 0.02), []),
    "horizontal": (Arm((FLOP, FLOP)).under((9.81, 0, 0), 0.02), []),
    "dead and follower": (
        Arm((FLOP, FLOP)),
        [Load((0.01, -0.02, 0.03), (1e-3, 0, 5e-4)), Load((0.02, 0.01, 0), follower=True)],
    ),
    "off axis, connectors, weight": (ARMS["3 segments, mixed"].under((2, 1, 9), 0.01), []),
    "neo-Hookean": (
        Arm((neo_hookean(FLOP), neo_hookean(LOPSIDED))).under(HANGING, 0.01),
        [],
    ),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", SPATIAL)
def test_spatial_equilibrium_against_shooting_from_the_base(name):
    arm, loads = SPATIAL[name]
    p = np.random.default_rng(2).uniform(0, 0.6e5, arm.n)
    model = robot(arm)
    if loads:
        dead, follower = loads
        model = model.with_load(dead.force, dead.moment)
        wrench = np.concatenate([follower.force, follower.moment])
        T = model.loaded_tip_pose(p, wrench, frame="tip")
    else:
        T = model.tip_pose(p)
    expected = rod_tip(arm, p, loads, steps=12)
    assert T[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-5)
    assert T[:3, :3] == pytest.approx(expected[:3, :3], abs=5e-4)


def test_load_at_an_arc_length_against_shooting_from_the_base():
    arm = Arm((FLOP, FLOP))
    p = np.array([0.5, 0.2, 0.1, 0.3, 0.8, 0.0]) * 1e5
    model = robot(arm)
    for at in (0.05, 0.09, 0.13) if is_long() else (0.05, 0.09):
        for follower in (False, True):
            load = Load((0.05, -0.03, 0.02), (0, 1e-3, 0), at=at, follower=follower)
            wrench = np.concatenate([load.force, load.moment])
            T = model.loaded_tip_pose(p, wrench, at=at, frame="tip" if follower else "base")
            assert pytest.approx(rod_tip(arm, p, [load], steps=2), abs=2e-5) == T


def test_facts_of_the_hanging_arm():
    zero = np.zeros(6)
    hanging, free = so.load_robot("stiff-flop-2-hanging"), so.load_robot("stiff-flop-2")
    assert hanging.stiffness(zero, (1, 0, 0)) == pytest.approx(5.2, abs=0.05)
    assert free.stiffness(zero, (1, 0, 0)) == pytest.approx(1.83, abs=0.01)
    across = so.Manipulator(hanging.description.model_copy(update={"gravity": (9.81, 0.0, 0.0)}))
    assert across.tip_pose(zero)[0, 3] == pytest.approx(0.140, abs=0.001)
    bar = np.array([0.2e5, 0, 0, 0.2e5, 0, 0])
    assert np.abs(hanging.tip_pose(bar)[0, 3]) < 0.5 * np.abs(free.tip_pose(bar)[0, 3])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
@pytest.mark.parametrize("at", [None, 0.05, 0.13])
def test_compliance_is_the_derivative_of_the_equilibrium(name, at):
    """Small dead loads; the paper's law is per deformed length (slip 8), as the compliance is."""
    arm = so.load_robot(name)
    fine = so.Manipulator(arm.description, resolution=4)
    p = np.random.default_rng(4).uniform(0.1e5, 1e5, 6)
    scale = np.array([1e-5] * 3 + [1e-6] * 3)

    def measured(model):
        """Twist of the loaded point per dead wrench in its axes, by central differences."""
        T = model.tip_pose(p) if at is None else model.pose(p, at)
        columns = []
        for i in range(6):
            ends = []
            for sign in (1, -1):
                local = sign * scale[i] * np.eye(6)[i]
                dead = np.concatenate([T[:3, :3] @ local[:3], T[:3, :3] @ local[3:]])
                if at is None:
                    end = model.loaded_tip_pose(p, dead)
                else:
                    loads = model._loads._replace(station=np.concatenate([dead, np.zeros(6)]))
                    state = model._equilibrium(at).settle(p, loads)
                    end = model._equilibrium(at).shape(state, np.array([at]))[0]
                ends.append(so.lie.log(so.lie.inverse(T) @ end))
            columns.append((ends[0] - ends[1]) / (2 * scale[i]))
        return np.array(columns).T

    models = [(arm, 1e-3)]
    if at is None or is_long():
        models.append((fine, 1e-6))
    for model, tolerance in models:
        C = model.tip_compliance(p) if at is None else model.compliance(p, at)
        size = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert np.abs((measured(model) - C) / size).max() < tolerance


@pytest.mark.parametrize("name", ["stiff-flop-3", "stiff-flop-2-hanging"])
def test_compliance_is_symmetric_and_positive_definite(name):
    arm = so.load_robot(name)
    for p in np.random.default_rng(6).uniform(0, 1.2e5, (5, arm.n_pressures)):
        C = arm.tip_compliance(p)
        size = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert np.abs((C - C.T) / size).max() < 1e-12
        assert np.linalg.eigvalsh((C + C.T) / 2)[0] > 0


def test_equilibrium_without_loads_is_the_closed_form():
    arm = so.load_robot("stiff-flop-2")
    shot = arm.with_load((1e-12, 0, 0))
    p = np.random.default_rng(7).uniform(0, 1.5e5, 6)
    assert shot.tip_pose(p) == pytest.approx(arm.tip_pose(p), abs=1e-7)
    C, expected = shot.tip_compliance(p), arm.tip_compliance(p)
    assert pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(expected).max()) == C


# -- stability ------------------------------------------------------------------------------


def column(length, share):
    """A standing uniform column whose weight is a share of the unshearable critical one."""
    tube = Tube(length=length, factors=None)
    bare = Arm((tube,))
    weight = (
        tube.density
        * so.model.actuation.SectionGeometry.of(
            so.RobotDescription(**bare.mapping()).segments[0]
        ).area
    )
    critical = 7.837347 / (bending_compliance(bare) * weight * length**3)
    return robot(bare.under((0, 0, -share * critical)))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("length", [0.3, 1.0])
def test_a_standing_column_buckles_under_its_weight(length):
    # shear and shortening matter by (radius / length)^2: a few per cent at 0.3 m
    slack = 0.1 if length < 0.5 else 0.01
    assert column(length, 1 - slack).tip_pose(np.zeros(3))[0, 3] == pytest.approx(0, abs=1e-9)
    with pytest.raises(so.EquilibriumError, match="own weight"):
        column(length, 1 + slack).tip_pose(np.zeros(3))


def test_eulers_column_buckles_under_a_dead_force():
    arm, critical = column_robot(), np.pi**2 / 4 / bending_compliance(COLUMN)
    arm.loaded_tip_pose(np.zeros(3), [0, 0, -0.98 * critical, 0, 0, 0])
    with pytest.raises(so.EquilibriumError, match="buckles"):
        arm.loaded_tip_pose(np.zeros(3), [0, 0, -1.02 * critical, 0, 0, 0])


def test_becks_column_does_not_buckle_statically():
    arm, critical = column_robot(), np.pi**2 / 4 / bending_compliance(COLUMN)
    T = arm.loaded_tip_pose(np.zeros(3), [0, 0, -3 * critical, 0, 0, 0], frame="tip")
    assert T[:2, 3] == pytest.approx([0, 0], abs=1e-9)


def test_stable_equilibrium_is_the_minimum_of_a_discrete_energy():
    arm = Arm((FLOP,)).under((2.0, 1.0, 9.0), 0.03)
    p = np.array([0.6e5, 0.2e5, 0.0])
    rod = DiscreteRod(arm, p, 12)
    x, tip = rod.minimum()
    assert np.linalg.eigvalsh(rod.hessian(x))[0] > 0
    assert robot(arm).tip_pose(p)[:3, 3] == pytest.approx(tip, abs=2e-4)


def test_pressure_that_bends_a_standing_arm_over_is_reported():
    """A standing arm that is stable at rest falls over when pressure makes it lean."""
    arm = so.Manipulator(
        so.load_robot("stiff-flop-2-hanging").description.model_copy(
            update={"gravity": (0.0, 0.0, -4.5), "tip_mass": 0.005}
        )
    )
    assert arm.tip_pose(np.zeros(6))[2, 3] > 0.17
    with pytest.raises(so.EquilibriumError, match="pressures"):
        arm.tip_pose(np.full(6, 1.4e5))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("n_segments", [4, 5])
def test_long_hanging_arms_settle(n_segments):
    arm = Arm((FLOP,) * n_segments).under(HANGING, 0.02)
    p = np.random.default_rng(n_segments).uniform(0, 1.2e5, arm.n)
    T, fine = robot(arm).tip_pose(p), robot(arm, resolution=4 if is_long() else 2).tip_pose(p)
    assert T[:3, 3] == pytest.approx(fine[:3, 3], abs=1e-4)
