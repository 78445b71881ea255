"""From pressures to strains: sections, the paper's law, the neo-Hookean law, the registry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from independent import (
    ARMS,
    CROSS,
    FLOP,
    LOPSIDED,
    PAIR,
    SIX,
    Tube,
    derivative,
    eq_9,
    neo_hookean,
    rod_section,
    section,
)
from stiffopt.model.actuation import (
    NORM_SMOOTHING,
    STRAIN_LAWS,
    SectionGeometry,
    neo_hookean_stretch,
    smooth_norm,
    strain_law,
)
from stiffopt.model.description import Segment

Vector = NDArray[np.float64]

TUBES = {"flop": FLOP, "cross": CROSS, "pair": PAIR, "lopsided": LOPSIDED, "six": SIX}
LAWS = {"paper": lambda tube: tube, "neo-hookean": neo_hookean}


def segment_of(tube: Tube) -> Segment:
    return Segment(**tube.mapping())


@cache
def law_of(tube: Tube) -> ca.Function:
    """Strain (6,), compliance (6, 6) and margin of a segment as a function of its pressures."""
    law = strain_law(segment_of(tube))
    p = ca.SX.sym("p", len(tube.channels))
    part = law.section(p)
    outputs = [part.strain, ca.densify(part.compliance), law.margin(p)]
    return ca.Function("law", [p], outputs)


def strain_and_compliance(tube: Tube, p: Vector) -> tuple[Vector, Vector]:
    strain, compliance, _ = law_of(tube)(p)
    return strain.full()[:, 0], compliance.full()


def some_pressures(tube: Tube, seed: int = 0, highest: float = 1e5) -> Vector:
    return np.random.default_rng(seed).uniform(0, highest, len(tube.channels))


# -- sections -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TUBES)
def test_section_properties_by_counting_cells(name: str) -> None:
    """Crude, but it knows nothing of discs, signs or parallel axes: 4e6 cells, in or out."""
    tube, n = TUBES[name], 2000
    geometry = SectionGeometry.of(segment_of(tube))
    edge = np.linspace(-1, 1, n + 1) * tube.outer_radius
    x, y = np.meshgrid((edge[1:] + edge[:-1]) / 2, (edge[1:] + edge[:-1]) / 2)
    cell = (edge[1] - edge[0]) ** 2
    solid = (x**2 + y**2 < tube.outer_radius**2) & (x**2 + y**2 > tube.inner_radius**2)
    bores = []
    for angle in np.radians(tube.angles):
        cx, cy = tube.offset * np.cos(angle), tube.offset * np.sin(angle)
        bores.append((x - cx) ** 2 + (y - cy) ** 2 < tube.chamber_radius**2)
    for bore in bores:
        solid &= ~bore
    xs, ys = x[solid], y[solid]
    size = tube.outer_radius
    assert xs.size * cell == pytest.approx(geometry.area, rel=1e-3)
    assert geometry.centroid == pytest.approx([xs.mean(), ys.mean()], abs=1e-4 * size)
    moments = np.cov(xs, ys, bias=True) * xs.size * cell
    assert geometry.second_moment == pytest.approx(moments, abs=1e-3 * moments.max())
    for channel, members in enumerate(tube.channels):
        fed = np.logical_or.reduce([bores[number - 1] for number in members])
        area = fed.sum() * cell
        assert geometry.channel_force[channel] == pytest.approx(area, rel=3e-3)
        first = [x[fed].sum() * cell, y[fed].sum() * cell]
        assert geometry.channel_moment[channel] == pytest.approx(first, abs=3e-3 * area * size)


def test_chambers_and_moments_of_equations_8_and_9() -> None:
    """Six chambers at eq. 9's angles, each adding ``(0, 0, f; r x f)``, pair by pair."""
    p = np.array([0.3e5, 1.1e5, 0.7e5])
    wrench = np.zeros(6)
    for i in range(1, 7):
        turn = np.radians(eq_9(i))
        r = 0.0101 * np.array([np.cos(turn), np.sin(turn), 0])
        f = np.array([0, 0, p[(i - 1) // 2] * np.pi * 0.00225**2])
        wrench += np.concatenate([f, np.cross(r, f)])
    E = 100e3 - 0.2 * np.linalg.norm(p)
    strain, _ = strain_and_compliance(FLOP, p)
    stretch = 1 + wrench[2] / (E * 1.2 * 547.8e-6)
    kappa = wrench[3:5] / (E * 1.05 * 3.445e-8)
    # only as many digits as Table II has
    assert strain == pytest.approx([0, 0, stretch, *(stretch * kappa), 0], rel=2e-4, abs=1e-12)


# -- the paper's law ------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", TUBES)
def test_sections_against_independent_formulas(name: str, law: str) -> None:
    tube = LAWS[law](TUBES[name])
    for seed in range(3):
        p = some_pressures(tube, seed)
        strain, C = strain_and_compliance(tube, p)
        expected = rod_section(tube, p, (0, 0, 0))
        # the cone's rounding of 0.01 Pa shows in the eighth digit of the modulus
        assert strain == pytest.approx(expected.strain, rel=2e-7, abs=1e-12)
        size = np.sqrt(np.outer(np.diag(expected.compliance), np.diag(expected.compliance)))
        assert C / size == pytest.approx(expected.compliance / size, abs=2e-7)


@pytest.mark.parametrize("name", ["pair", "lopsided"])
def test_the_line_of_centroids_lengthens_by_force_over_stiffness_alone(name: str) -> None:
    """Eq. 10's elongation f l / (E A) is that of the centroids; bending does not change it."""
    tube = TUBES[name]
    for seed in range(3):
        p = some_pressures(tube, seed)
        strain, _ = strain_and_compliance(tube, p)
        c = SectionGeometry.of(segment_of(tube)).centroid
        stretch = strain[2] + (strain[3] * c[1] - strain[4] * c[0])
        assert stretch == pytest.approx(section(tube, p).stretch, abs=1e-8)


def test_compliance_at_rest_is_the_diagonal_of_table_ii() -> None:
    _, C = strain_and_compliance(FLOP, np.zeros(3))
    E, A, I = 100e3, 1.2 * 547.8e-6, 1.05 * 3.445e-8  # noqa: E741
    G = E / 3  # slip 9: incompressible
    expected = [1 / (G * A), 1 / (G * A), 1 / (E * A), 1 / (E * I), 1 / (E * I), 1 / (G * 2 * I)]
    assert np.diag(C) == pytest.approx(expected, rel=2e-4)
    assert np.array_equal(C, np.diag(np.diag(C)))


def test_poissons_ratio_sets_the_shear_modulus() -> None:
    _, C = strain_and_compliance(replace(FLOP, poisson_ratio=0.25), np.zeros(3))
    assert C[0, 0] / C[2, 2] == pytest.approx(2 * 1.25, rel=1e-12)
    assert C[5, 5] / C[3, 3] == pytest.approx(2 * 1.25 / 2, rel=1e-12)


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


def test_the_margin_ends_where_the_modulus_does() -> None:
    tube = replace(FLOP, factors=(-0.5, 1.0, 1.0))  # E = 100 kPa is gone at 2 bar
    for share, sign in ((0.0, 1), (0.998, 1), (0.9995, -1), (1.2, -1)):
        *_, margin = law_of(tube)(share * 2e5 * np.array([2, 2, 1]) / 3)
        assert np.sign(float(margin)) == sign


# -- the neo-Hookean law --------------------------------------------------------------------


@pytest.mark.parametrize("load", [-1.79, -1.0, -1e-3, -1e-9, 0.0, 1e-9, 1e-3, 0.5, 3.0, 30.0])
def test_neo_hookean_stretch_against_root_finding(load: float) -> None:
    root = brentq(lambda L: L - L**-2 - load, 0.1, 100.0, xtol=1e-15, rtol=1e-15)
    symbol = ca.SX.sym("load")
    stretch = neo_hookean_stretch(symbol)
    f = ca.Function("s", [symbol], [stretch, ca.jacobian(stretch, symbol)])
    value, slope = f(load)
    assert float(value) == pytest.approx(root, rel=1e-14)
    assert float(slope) == pytest.approx(1 / (1 + 2 * root**-3), rel=1e-11)


@pytest.mark.parametrize("name", TUBES)
def test_little_pressure_gives_the_linear_law_per_length_at_rest(name: str) -> None:
    """Both laws strain alike at first order, and agree in the compliance at rest."""
    linear = replace(TUBES[name], factors=None, poisson_ratio=0.5)
    hyper = neo_hookean(linear)
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


def disc_points(x: float, y: float, radius: float) -> tuple[Vector, Vector]:
    """Points (2, k) and weights (k,) that integrate polynomials over a disc."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    r, t = np.meshgrid(radius * (1 + nodes) / 2, 2 * np.pi * np.arange(24) / 24)
    w = np.outer(np.full(24, 2 * np.pi / 24), radius * weights / 2) * r
    return np.array([x + r * np.cos(t), y + r * np.sin(t)]).reshape(2, -1), w.ravel()


def solid_points(tube: Tube) -> tuple[Vector, Vector]:
    """Points and (signed) weights that integrate over the silicone."""
    discs = [(0.0, 0.0, tube.outer_radius, 1), (0.0, 0.0, tube.inner_radius, -1)]
    for a in np.radians(tube.angles):
        x, y = tube.offset * np.cos(a), tube.offset * np.sin(a)
        discs.append((x, y, tube.chamber_radius, -1))
    parts = [(disc_points(x, y, r), sign) for x, y, r, sign in discs]
    points = np.concatenate([points for (points, _), _ in parts], axis=1)
    return points, np.concatenate([sign * weights for (_, weights), sign in parts])


def resultant(tube: Tube, shrink: float, xi: Vector) -> Vector:
    """Force and moment (6,) of the stresses in a neo-Hookean section, strain xi about the axis.

    A fibre at rest at r sits at ``shrink r``.  It is stretched by L and sheared by g; its energy
    ``mu/2 (L^2 + 2 / L + g.g - 3)`` gives the axial stress ``mu (L - L^-2)``.
    """
    mu = tube.youngs_modulus / 3
    points, weights = solid_points(tube)
    x, y = shrink * points
    gx, gy, L = xi[0] - xi[5] * y, xi[1] + xi[5] * x, xi[2] + xi[3] * y - xi[4] * x
    sx, sy, sz = mu * gx, mu * gy, mu * (L - L**-2)
    return np.array([sx, sy, sz, y * sz, -x * sz, x * sy - y * sx]) @ weights


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


# -- every law ------------------------------------------------------------------------------


@pytest.mark.parametrize("tube", [FLOP, CROSS, LOPSIDED, PAIR, SIX], ids=list(TUBES))
@pytest.mark.parametrize("law", STRAIN_LAWS)
def test_contract_of_a_strain_law(law: str, tube: Tube) -> None:
    assert set(LAWS) == set(STRAIN_LAWS), "give a new law's segments here"
    tube = LAWS[law](tube)
    n = len(tube.channels)
    segment = segment_of(tube)
    assert type(strain_law(segment)) is STRAIN_LAWS[law]
    assert STRAIN_LAWS[law].limit
    function = law_of(tube)
    assert [function.size_out(i) for i in range(3)] == [(6, 1), (6, 6), (1, 1)]
    x = ca.SX.sym("x", n)
    strain, C, _ = function(x)
    slopes = ca.Function("d", [x], [ca.jacobian(strain, x), ca.jacobian(ca.vec(C), x)])
    for p in (np.zeros(n), np.full(n, 1e-6), np.full(n, 1e5), some_pressures(tube)):
        strain, C, margin = (part.full() for part in function(p))
        assert margin[0, 0] > 0
        assert np.isfinite(strain).all()
        assert strain[2, 0] > 0
        assert np.allclose(C, C.T, rtol=1e-12, atol=1e-12 * C.max())
        size = np.sqrt(np.diag(C))
        assert np.linalg.eigvalsh(C / np.outer(size, size))[0] > 1e-3
        assert all(np.isfinite(part.full()).all() for part in slopes(p))
    strain, C, _ = (part.full() for part in function(np.zeros(n)))
    assert strain[:, 0] == pytest.approx([0, 0, 1, 0, 0, 0], abs=1e-15)


@pytest.mark.parametrize("law", STRAIN_LAWS)
def test_turning_the_pressures_by_120_degrees_turns_the_section(law: str) -> None:
    tube = LAWS[law](FLOP)
    p = np.array([1.2e5, 0.3e5, 0.6e5])
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    turn = np.kron(np.eye(2), [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    strain, C = strain_and_compliance(tube, p)
    turned_strain, turned_C = strain_and_compliance(tube, np.roll(p, 1))
    assert turned_strain == pytest.approx(turn @ strain, abs=1e-13)
    assert turned_C == pytest.approx(turn @ C @ turn.T, rel=1e-11, abs=1e-11 * np.abs(C).max())


@pytest.mark.parametrize("law", STRAIN_LAWS)
def test_pressing_one_side_bends_away_and_lengthens(law: str) -> None:
    strain, _ = strain_and_compliance(LAWS[law](FLOP), np.array([1e5, 0, 0]))
    assert strain[2] > 1
    assert strain[3] == pytest.approx(0, abs=1e-12)
    assert strain[4] < 0  # about -y: towards -x


def test_each_arm_of_the_tests_has_a_law_in_range() -> None:
    for arm in ARMS.values():
        for tube, p in zip(arm.tubes, arm.split(np.full(arm.n, 1e5)), strict=True):
            assert float(law_of(tube)(p)[2]) > 0
