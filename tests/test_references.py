"""The references for the simulated arm against each other and against textbook values."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from independent.arms import FLOP, Arm
from independent.rods import Load, planar_tip, rod_tip
from independent.sections import silicone
from references import (
    Beam,
    Column,
    Jenkin,
    beam,
    creep,
    elastica_tip,
    fibre_bending,
    fibre_stress,
    free_tip,
    loaded_tip,
    loop_area,
    section_fibres,
    stretch_under,
    tip_compliance,
)

STIFF = replace(FLOP, factors=(0.0, 1e5, 1.0))  # neither shears nor stretches


@pytest.mark.parametrize("share", [0.5, 2.0, 5.0, 13.0])
def test_elastica_against_collocation(share):
    arm = Arm((STIFF,))
    x, z, angle = elastica_tip(share)
    force = share * beam(STIFF).bending / arm.length**2
    assert planar_tip(arm, np.zeros(3), (force, 0)) == pytest.approx(
        [x * arm.length, z * arm.length, angle], abs=2e-6
    )


def test_elastica_against_the_table_of_bisshopp_and_drucker():
    """P L^2 / (B) = 10: deflection 0.811 L, shortening 0.555 L."""
    x, z, _ = elastica_tip(10.0)
    assert x == pytest.approx(0.811, abs=5e-4)
    assert 1 - z == pytest.approx(0.555, abs=5e-4)


SPATIAL = {
    "weight": (Arm((FLOP, FLOP)).under((9.81, 0, 0), 0.02), []),
    "hanging, dead and follower": (
        Arm((replace(FLOP, connector=0.01), FLOP)).under((1, 2, 9), 0.01),
        [Load((0.02, -0.05, 0.03), (1e-3, 0, 5e-4)), Load((0.05, 0.01, 0), at=0.06, follower=True)],
    ),
}


@pytest.mark.parametrize("name", SPATIAL)
def test_rod_from_its_tip_against_the_rod_from_its_base(name):
    arm, loads = SPATIAL[name]
    expected = rod_tip(arm, np.zeros(arm.n), loads, steps=12)
    assert loaded_tip(arm, np.zeros(arm.n), loads) == pytest.approx(expected, abs=1e-7)


def test_rod_under_pressure_alone_is_a_product_of_exponentials():
    arm = Arm((FLOP, replace(FLOP, connector=0.012)))
    p = np.array([0.9, 0.2, 0.0, 0.1, 0.8, 0.3]) * 1e5
    assert loaded_tip(arm, p) == pytest.approx(free_tip(arm, p), abs=1e-9)


def test_compliance_is_the_rods_response():
    arm, p = Arm((FLOP, FLOP)), np.array([0.9, 0.2, 0.0, 0.1, 0.8, 0.3]) * 1e5
    C, T = tip_compliance(arm, p), free_tip(arm, p)
    for i, size in enumerate([3e-4] * 3 + [1e-5] * 3):
        wrench = size * np.eye(6)[i]
        ends = [
            loaded_tip(arm, p, [Load(sign * wrench[:3], sign * wrench[3:], follower=True)], 1)
            for sign in (1, -1)
        ]
        change = np.linalg.inv(T) @ (ends[0] - ends[1]) / (2 * size)
        twist = [*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]]
        assert twist == pytest.approx(C[:, i], abs=2e-6 * np.abs(C[:, i]).max())


# -- vibration ------------------------------------------------------------------------------


def test_slender_rods_are_euler_and_bernoullis():
    slender = Beam(shear=1e9, axial=1e9, bending=2.0, torsion=1.0, mass=3.0, inertia=1e-12)
    unit = np.sqrt(2.0 / 3.0)
    free = Column(slender, 1.0).bending_frequencies(3) / unit
    assert free == pytest.approx(np.array([1.8751041, 4.6940911, 7.8547574]) ** 2, rel=1e-6)
    loaded = Column(slender, 1.0, tip_mass=3.0).bending_frequencies(1) / unit
    assert loaded == pytest.approx([1.2479174**2], rel=1e-6)  # a tip as heavy as the rod


@pytest.mark.parametrize("gravity", [0.0, 9.81, -1.0])
@pytest.mark.parametrize("mass", [0.0, 0.02])
def test_frequencies_against_finite_elements(gravity, mass):
    column = Column(beam(FLOP), 0.18, mass, gravity)
    found, _ = column.finite_elements()
    assert column.bending_frequencies(3) == pytest.approx(found[:3], rel=5e-4)


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_damping_of_a_mode_is_the_materials_share_of_its_stiffness(gravity):
    column = Column(beam(FLOP), 0.18, 0.02, gravity)
    omega, ratio = column.damped(0.1)
    frequencies, shares = column.finite_elements()
    assert omega == pytest.approx(frequencies[0], rel=2e-4)
    assert ratio == pytest.approx(0.1 * shares[0], rel=1e-2 if gravity else 1e-9)


def test_the_hanging_arm_rings_as_the_issue_says():
    omega, ratio = Column(beam(FLOP), 0.18, 0.02, 9.81).damped(0.1)
    assert 1.5 < omega / (2 * np.pi) < 1.7
    assert ratio == pytest.approx(0.04, abs=0.005)


def test_stretching_against_a_spring_and_twisting_against_a_quarter_wave():
    section = beam(FLOP)
    heavy = Column(section, 0.09, tip_mass=10.0).axial_frequencies(1)
    assert heavy == pytest.approx([np.sqrt(section.axial / 0.09 / 10.0)], rel=1e-3)
    free = Column(section, 0.09).axial_frequencies(2)
    assert free * 0.09 == pytest.approx(
        np.array([0.5, 1.5]) * np.pi * np.sqrt(section.axial / section.mass)
    )
    E, density = FLOP.youngs_modulus, FLOP.density
    twist = Column(section, 0.09).torsion_frequencies(1)
    assert twist == pytest.approx([np.pi / 2 * np.sqrt(E / 3 * 1.05 / density) / 0.09])


# -- silicone -------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["linear", "neo-hookean", "yeoh"])
def test_laws_start_with_the_modulus_and_yeoh_derives_from_its_energy(law):
    assert (fibre_stress(law, 1e5, 0.1, 1 + 1e-6) / 1e-6) == pytest.approx(1e5, rel=1e-5)
    L = stretch_under(law, 1e5, 0.1, 2e4)
    assert fibre_stress(law, 1e5, 0.1, L) == pytest.approx(2e4)

    def energy(L):
        excess = L**2 + 2 / L - 3
        return 1e5 / 6 * (excess + (0.1 if law == "yeoh" else 0.0) * excess**2)

    if law != "linear":
        slope = (energy(1.3 + 1e-6) - energy(1.3 - 1e-6)) / 2e-6
        assert fibre_stress(law, 1e5, 0.1, 1.3) == pytest.approx(slope, rel=1e-6)


def test_fibres_fill_the_section_and_bend_as_a_beam():
    tube = replace(FLOP, factors=None)
    section, solid = beam(tube), silicone(tube)
    x, area = section_fibres(tube)
    assert [area.sum(), x**2 @ area] == pytest.approx([solid.area, solid.second[0, 0]], rel=1e-12)
    e, k = fibre_bending(tube, "linear", 0.0, (1.0, 0.01))
    assert [e, k] == pytest.approx([1 / section.axial, 0.01 / section.bending])
    e, k = fibre_bending(tube, "neo-hookean", 0.0, (0.0, 1e-5))
    assert k == pytest.approx(1e-5 / section.bending, rel=1e-4)


def test_creep_against_the_differential_equation():
    shares, times = np.array([0.3, 0.1]), np.array([2.0, 20.0])
    t = np.array([0.0, 0.5, 3.0, 30.0, 1e4])

    def slope(_, v):
        return ((1 + shares @ v) / (1 + shares.sum()) - v) / times

    v = solve_ivp(slope, (0, 1e4), np.zeros(2), t_eval=t, rtol=1e-9, atol=1e-11, method="LSODA").y
    expected = (1 + shares @ v) / (1 + shares.sum())
    assert creep(shares, times, t) == pytest.approx(expected, abs=1e-6)
    single = (1 + 0.3 * (1 - np.exp(-t / (2.0 * 1.3)))) / 1.3  # the standard linear solid
    assert creep(0.3, 2.0, t) == pytest.approx(single, abs=1e-12)


def test_area_of_an_elastic_plastic_loop():
    """``4 k d (a - d)`` for an element of stiffness k that slips at d, strained by +-a."""
    fibre = Jenkin(1e5, np.array([0.2, 0.1]), np.array([0.01, 0.03]))
    top = 1e5 * (0.08 + 0.2 * 0.01 + 0.1 * 0.03)  # brings a strain of 0.08
    assert fibre.strain(top) == pytest.approx(0.08)
    path = np.concatenate([np.linspace(top, -top, 2000), np.linspace(-top, top, 2000)])
    strains = [fibre.strain(stress) for stress in path]
    assert [strains[0], strains[1999], strains[-1]] == pytest.approx([0.08, -0.08, 0.08])
    expected = 4e5 * (0.2 * 0.01 * 0.07 + 0.1 * 0.03 * 0.05)
    assert loop_area(strains, path) == pytest.approx(expected, rel=1e-4)
