"""Strain laws against independent formulas, roots and integrated stresses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from independent.arms import FLOP, LOPSIDED, Tube, neo_hookean
from independent.motions import derivative, shift, wrench_map
from independent.sections import RodSection, paper_section, rod_section, section, silicone
from stiffopt.model.actuation import NORM_SMOOTHING, SectionGeometry, smooth_norm
from stiffopt.model.laws.neo_hookean import neo_hookean_stretch
from stiffopt.model.segment import Segment
from tested_laws import (
    LAWS,
    TUBES,
    evaluated,
    fibres,
    function_of,
    resultant,
    segment_of,
    some_pressures,
    strain_and_compliance,
)

Vector = NDArray[np.float64]

# -- the paper's law ------------------------------------------------------------------------------


def expected_section(tube: Tube, p: Vector) -> RodSection:
    """Strain and compliance about the axis by formulas that know nothing of stiffopt."""
    if tube.law != "rest-length":
        return rod_section(tube, p, (0, 0, 0))
    found = paper_section(tube, p)  # the same numbers, but none is multiplied by the stretch
    (x, y), (kx, ky) = found.centroid, found.curvature
    inverse = np.linalg.inv(wrench_map(shift(x, y, 0)))
    return RodSection(
        strain=np.array([0, 0, found.stretch + ky * x - kx * y, kx, ky, 0]),
        compliance=inverse.T @ found.flexibility @ inverse,
        weight=np.zeros(3),
        centroid=np.append(found.centroid, 0.0),
    )


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", TUBES)
def test_sections_against_independent_formulas(name: str, law: str) -> None:
    tube = LAWS[law](TUBES[name])
    for seed in range(3):
        p = some_pressures(tube, seed)
        strain, C = strain_and_compliance(tube, p)
        expected = expected_section(tube, p)
        # the cone's rounding of 0.01 Pa shows in the eighth digit of the modulus
        assert strain == pytest.approx(expected.strain, rel=2e-7, abs=1e-12)
        size = np.sqrt(np.outer(np.diag(expected.compliance), np.diag(expected.compliance)))
        assert C / size == pytest.approx(expected.compliance / size, abs=2e-7)


def test_compliance_at_rest_is_the_diagonal_of_table_ii() -> None:
    _, C = strain_and_compliance(FLOP, np.zeros(3))
    E, A, I = 100e3, 1.2 * 547.8e-6, 1.05 * 3.445e-8  # noqa: E741
    G = E / 3  # slip 9: incompressible
    expected = [1 / (G * A), 1 / (G * A), 1 / (E * A), 1 / (E * I), 1 / (E * I), 1 / (G * 2 * I)]
    assert np.diag(C) == pytest.approx(expected, rel=2e-4)
    assert np.array_equal(C, np.diag(np.diag(C)))


def test_the_norm_is_a_cone_but_for_its_tip() -> None:
    p = ca.SX.sym("p", 3)
    f = ca.Function("n", [p], [smooth_norm(p), ca.gradient(smooth_norm(p), p)])
    assert NORM_SMOOTHING <= 0.01
    value, slope = f(np.zeros(3))
    assert float(value) == 0
    assert np.array_equal(slope.full(), np.zeros((3, 1)))
    q = np.array([3e4, 4e4, 0])
    value, slope = f(q)
    assert float(value) == pytest.approx(5e4, abs=NORM_SMOOTHING)
    assert slope.full()[:, 0] == pytest.approx(q / 5e4, abs=1e-12)


# -- the neo-Hookean law --------------------------------------------------------------------------


@pytest.mark.parametrize("load", [-1.79, -1.0, -1e-3, -1e-9, 0.0, 1e-9, 1e-3, 0.5, 3.0, 30.0])
def test_neo_hookean_stretch_against_root_finding(load: float) -> None:
    root = brentq(lambda L: L - L**-2 - load, 0.1, 100.0, xtol=1e-15, rtol=1e-15)
    symbol = ca.SX.sym("load")
    stretch = neo_hookean_stretch(symbol)
    f = ca.Function("s", [symbol], [stretch, ca.jacobian(stretch, symbol)])
    value, slope = f(load)
    assert float(value) == pytest.approx(root, rel=1e-14)
    assert float(slope) == pytest.approx(1 / (1 + 2 * root**-3), rel=1e-11)


@pytest.mark.parametrize("law", ["neo-hookean", "fibres"])
@pytest.mark.parametrize("name", TUBES)
def test_little_pressure_gives_the_linear_law_per_length_at_rest(name: str, law: str) -> None:
    """Both laws strain alike at first order, and agree in the compliance at rest."""
    linear = replace(TUBES[name], factors=None, poisson_ratio=0.5)
    hyper = LAWS[law](linear) if law in LAWS else fibres(linear)
    rest = np.zeros(len(linear.channels))
    strains, compliances = zip(
        *(strain_and_compliance(tube, rest) for tube in (linear, hyper)), strict=True
    )
    assert strains[1] == pytest.approx(strains[0], abs=1e-15)
    assert compliances[1] == pytest.approx(compliances[0], rel=1e-12)
    slopes = [
        derivative(lambda p, tube=tube: strain_and_compliance(tube, p)[0], rest, 10.0)
        for tube in (linear, hyper)
    ]
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-9, abs=1e-9 * np.abs(slopes[0]).max())


@pytest.mark.parametrize("name", TUBES)
def test_neo_hookean_stiffness_against_integrated_stresses(name: str) -> None:
    """Of the straight, stretched section: the law leaves out how curvature changes it."""
    tube = neo_hookean(TUBES[name])
    p = np.full(len(tube.channels), 0.6e5)
    _, C = strain_and_compliance(tube, p)
    stretch = section(tube, p).stretch
    straight = np.array([0, 0, stretch, 0, 0, 0])
    K = derivative(lambda xi: resultant(tube, stretch**-0.5, xi), straight, 1e-3)
    expected = np.linalg.inv(K)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert C / size == pytest.approx(expected / size, abs=1e-8)


@pytest.mark.parametrize("name", TUBES)
def test_neo_hookean_strain_balances_the_pressure_to_first_order_in_curvature(name: str) -> None:
    """What is left over falls with the square of the pressures, as the curvature's square."""
    tube = neo_hookean(TUBES[name])
    geometry = SectionGeometry.of(segment_of(tube))
    errors = []
    for share in (0.1, 0.05):
        p = share * some_pressures(tube)
        strain, _ = strain_and_compliance(tube, p)
        shrink = section(tube, p).stretch ** -0.5
        x, y = shrink * (geometry.channel_moment.T @ p)
        applied = np.array([0, 0, geometry.channel_force @ p, y, -x, 0])
        size = applied[2] / share * np.array([1, 1, 1, *[tube.outer_radius] * 3])
        errors.append(np.abs((resultant(tube, shrink, strain) - applied) / size).max())
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] < 1e-3


# -- fibres ---------------------------------------------------------------------------------------


def with_stiffening(tube: Tube, stiffening: float = 0.2, **keys: Any) -> Segment:
    """Segment of a tube with the law of fibres."""
    return Segment(**fibres(tube).mapping(), law={"stiffening": stiffening}, **keys)


def annulus(tube: Tube) -> tuple[Vector, Vector]:
    """Points (2, k) about the centroid, and weights, of an annulus stretched to an ellipse.

    It has the tube's outer radius, its area and its second moments.
    """
    solid, outer = silicone(tube), tube.outer_radius**2
    mean = np.trace(solid.about_centroid) / solid.area
    assert outer < 2 * mean  # the inner radius is not imaginary
    nodes, weights = np.polynomial.legendre.leggauss(12)
    t = 2 * np.pi * np.arange(48) / 48
    r = np.sqrt(mean + nodes * (outer - mean))[:, np.newaxis]
    values, axes = np.linalg.eigh(solid.about_centroid / solid.area)
    root = axes @ np.diag(np.sqrt(values / (mean / 2))) @ axes.T
    points = root @ np.array([r * np.cos(t), r * np.sin(t)]).reshape(2, -1)
    return points, np.repeat(weights / 2 / 48, 48) * solid.area


def pull(tube: Tube, stiffening: float, strain: Vector) -> Vector:
    """Force along and moments (3,) of Yeoh's stresses, for stretch and curvatures (3,)."""
    (x, y), weights = annulus(tube)
    L = strain[0] + strain[1] * y - strain[2] * x
    stress = (L - L**-2) * (1 + 2 * stiffening * (L**2 + 2 / L - 3))
    return tube.youngs_modulus / 3 * np.array([stress, y * stress, -x * stress]) @ weights


@pytest.mark.parametrize("tube", [FLOP, LOPSIDED], ids=["flop", "lopsided"])
def test_fibres_balance_the_pressure_however_far_they_bend(tube: Tube) -> None:
    geometry = SectionGeometry.of(segment_of(tube))
    one = 0.8e5 * np.eye(len(tube.channels))[0]
    c = geometry.centroid
    for p in (one, one + 0.5e5, some_pressures(tube)):
        strain, C = evaluated(with_stiffening(tube), p)
        stretch = strain[2] - strain[4] * c[0] + strain[3] * c[1]
        bent = np.array([stretch, *strain[3:5]])
        force = geometry.channel_force @ p
        x, y = geometry.channel_moment.T @ p - force * c
        scale = force * np.array([1, tube.offset, tube.offset])
        assert pull(tube, 0.2, bent) / scale == pytest.approx(
            np.array([force, y, -x]) / scale, abs=1e-6
        )
        K = derivative(lambda strain: pull(tube, 0.2, strain), bent, 1e-4)
        about = wrench_map(shift(*c, 0))
        found = (about.T @ C @ about)[2:5, 2:5]
        size = np.sqrt(np.outer(np.diag(found), np.diag(found)))
        assert found / size == pytest.approx(np.linalg.inv(K) / size, abs=1e-5)


@pytest.mark.parametrize("stiffening", [0.0, 0.1, 2.0])
def test_fibres_balance_high_pressures_or_refuse_them(stiffening: float) -> None:
    soft = fibres(replace(FLOP, youngs_modulus=8e3))
    geometry = SectionGeometry.of(segment_of(soft))
    law = function_of(with_stiffening(soft, stiffening))
    accepted = []
    for p in 1e5 * np.array([[0.1, 0, 0], [1, 1, 0], [2, 2, 2], [1, 0, 0], [4, 0, 0], [20, 0, 0]]):
        strain, _, margin = (each.full() for each in law(p))
        accepted.append(margin.item() > 0)
        if accepted[-1]:
            force = geometry.channel_force @ p
            x, y = geometry.channel_moment.T @ p
            found = pull(soft, stiffening, strain.ravel()[2:5])
            wanted = np.array([force, y, -x])
            scale = force * np.array([1, soft.offset, soft.offset])
            assert found / scale == pytest.approx(wanted / scale, abs=1e-4)
    assert accepted[0]
    assert not all(accepted)


def test_bent_fibres_are_longer_than_straight_ones_under_the_same_force() -> None:
    """The neo-Hookean law leaves this out."""
    bent, straight = np.array([1.2e5, 0, 0]), np.full(3, 0.4e5)
    soft = {tube.law: tube for tube in (neo_hookean(FLOP), fibres(FLOP))}
    longer = {
        law: strain_and_compliance(tube, bent)[0][2] - strain_and_compliance(tube, straight)[0][2]
        for law, tube in soft.items()
    }
    assert longer["neo-hookean"] == pytest.approx(0, abs=1e-12)
    assert longer["fibres"] > 0.005


def test_fibres_that_pressure_compresses_to_nothing_are_out_of_range() -> None:
    segment = with_stiffening(replace(FLOP, youngs_modulus=1.2e4), 0.0)
    law = function_of(segment)
    assert float(law(np.array([0.1e5, 0, 0]))[2]) > 0
    assert float(law(np.array([2.0e5, 0, 0]))[2]) < 0
    assert np.isfinite(law(np.array([2.0e5, 0, 0]))[0].full()).all()
