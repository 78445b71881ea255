"""From pressures to strains: sections, strain laws with compensation, corrections, the registry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

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
    Arm,
    RodSection,
    Tube,
    derivative,
    eq_9,
    neo_hookean,
    paper_section,
    rod_section,
    section,
    shift,
    silicone,
    wrench_map,
)
from stiffopt.errors import InputError
from stiffopt.model.actuation import (
    NORM_SMOOTHING,
    SectionGeometry,
    onset,
    smooth_norm,
)
from stiffopt.model.description import Compensation, Corrections, RobotDescription, Segment
from stiffopt.model.laws import strain_law, strain_laws
from stiffopt.model.laws.neo_hookean import neo_hookean_stretch
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description

Vector = NDArray[np.float64]

TUBES = {"flop": FLOP, "cross": CROSS, "pair": PAIR, "lopsided": LOPSIDED, "six": SIX}
LAWS = {
    "paper": lambda tube: tube,
    "rest-length": lambda tube: replace(tube, law="rest-length"),
    "neo-hookean": neo_hookean,
}


def segment_of(tube: Tube, **compensation: float) -> Segment:
    """Segment of a tube, with some of its compensation replaced."""
    mapping = tube.mapping()
    if compensation:
        mapping["compensation"] = (mapping["compensation"] or {}) | compensation
    return Segment(**mapping)


@cache
def function_of(segment: Segment) -> ca.Function:
    """Strain (6,), compliance (6, 6) and margin of a segment as a function of its pressures."""
    law = strain_law(segment)
    p = ca.SX.sym("p", segment.n_channels)
    part = law.section(p)
    outputs = [part.strain, ca.densify(part.compliance), law.margin(p)]
    return ca.Function("law", [p], outputs)


def law_of(tube: Tube) -> ca.Function:
    return function_of(segment_of(tube))


def evaluated(segment: Segment, p: Vector) -> tuple[Vector, Vector]:
    """Strain (6,) and compliance (6, 6) of a segment."""
    strain, compliance, _ = function_of(segment)(p)
    return strain.full()[:, 0], compliance.full()


def strain_and_compliance(tube: Tube, p: Vector) -> tuple[Vector, Vector]:
    return evaluated(segment_of(tube), p)


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
        expected = expected_section(tube, p)
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


# -- fibres ---------------------------------------------------------------------------------


def fibres(tube: Tube) -> Tube:
    """The same segment with the law of fibres, and stiffening."""
    return replace(tube, law="fibres", factors=None, poisson_ratio=0.5)


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


# -- compensation ---------------------------------------------------------------------------


def scaled(matrix: Vector, size: Vector) -> Vector:
    """A compliance in units of the diagonal of another."""
    return matrix / np.sqrt(np.outer(np.diag(size), np.diag(size)))


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
        return compensated_resultant(of, shrink, xi, 1.2, 1.05)

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


def compensated_resultant(
    tube: Tube, shrink: float, xi: Vector, area: float, inertia: float
) -> Vector:
    """`resultant` of a section with more area, and spread about its centroid to more inertia."""
    mu = tube.youngs_modulus / 3
    points, weights = solid_points(tube)
    centre = (points @ weights / weights.sum())[:, np.newaxis]
    x, y = shrink * (centre + np.sqrt(inertia / area) * (points - centre))
    gx, gy, L = xi[0] - xi[5] * y, xi[1] + xi[5] * x, xi[2] + xi[3] * y - xi[4] * x
    sx, sy, sz = mu * gx, mu * gy, mu * (L - L**-2)
    return area * np.array([sx, sy, sz, y * sz, -x * sz, x * sy - y * sx]) @ weights


def test_the_neo_hookean_margin_ends_where_the_modulus_does() -> None:
    segment = segment_of(neo_hookean(FLOP), modulus_per_pressure=-0.5)  # 100 kPa, gone at 2 bar
    for share, sign in ((0.0, 1), (0.998, 1), (0.9995, -1), (1.2, -1)):
        *_, margin = function_of(segment)(share * 2e5 * np.array([2, 2, 1]) / 3)
        assert np.sign(float(margin)) == sign


# -- corrections ----------------------------------------------------------------------------


@pytest.mark.parametrize("band", [1.0, 2e3, 3e4])
def test_the_onset_is_smooth_and_monotone(band: float) -> None:
    p = ca.SX.sym("p")
    value = onset(p, band)
    slope = ca.jacobian(value, p)
    f = ca.Function("onset", [p], [value, slope, ca.jacobian(slope, p)])
    w = band / 2
    places = [0.0, 1e-9, band / 3, band, band * (1 + 1e-12), 16 * band, 16.5 * band, 21 * band, 1e7]
    for place in places:
        z = (place - band) / w
        found = [float(part) for part in f(place)]
        rise = 1 / (1 + np.exp(-z))
        assert found[0] == pytest.approx(
            w * (np.logaddexp(0, z) - np.logaddexp(0, -2)), rel=1e-12, abs=1e-12 * band
        )
        assert found[1] == pytest.approx(rise, rel=1e-12)
        assert found[2] * w == pytest.approx(rise * (1 - rise), rel=1e-9, abs=1e-12)
    many = f(np.linspace(0, 30 * band, 4001)[np.newaxis])[0].full()[0]
    assert (np.diff(many) > 0).all()
    assert many[0] == 0


@pytest.mark.parametrize("law", LAWS)
def test_corrections_are_dead_band_then_gain_then_offset(law: str) -> None:
    tube = LAWS[law](FLOP)
    gain, offset = np.array([1.1, 0.9, 1.0]), np.array([2e3, -1e3, 0.0])
    corrections = Corrections(gain=gain, offset=offset, dead_band=8e3)
    corrected = Segment(**tube.mapping() | {"corrections": corrections})
    for seed in range(3):
        p = some_pressures(tube, seed)
        z = (p - 8e3) / 4e3
        acting = gain * 4e3 * (np.logaddexp(0, z) - np.logaddexp(0, -2)) + offset
        for found, expected in zip(
            evaluated(corrected, p), evaluated(segment_of(tube), acting), strict=True
        ):
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("law", LAWS)
def test_an_azimuth_turns_the_moment_of_its_channel(law: str) -> None:
    """In a law that is linear in the moment, those of channels add up."""
    tube = LAWS[law](replace(FLOP, factors=None))
    azimuth = np.array([0.1, -0.2, 0.3])
    segment = Segment(**tube.mapping() | {"corrections": Corrections(azimuth=azimuth)})
    p = some_pressures(tube)
    stretched = np.full(3, p.mean())  # the same force, and no moment
    rest, C = evaluated(segment_of(tube), stretched)
    expected = rest[3:5].copy()
    for channel, turn in enumerate(azimuth):
        alone = stretched + np.where(np.arange(3) == channel, p[channel], 0) - p[channel] / 3
        c, s = np.cos(turn), np.sin(turn)
        expected += np.array([[c, -s], [s, c]]) @ evaluated(segment_of(tube), alone)[0][3:5]
    strain, turned = evaluated(segment, p)
    assert strain[3:5] == pytest.approx(expected, rel=1e-10)
    assert strain[2] == pytest.approx(rest[2], rel=1e-12)
    assert turned == pytest.approx(C, rel=1e-12, abs=1e-15)


def test_a_dead_band_needs_pressures_that_are_never_negative() -> None:
    mapping = Arm((FLOP, FLOP)).mapping()
    mapping["segments"][1]["corrections"] = {"dead_band": 8e3}
    robot = RobotDescription(**mapping)
    assert robot.segments[1].corrections == Corrections(dead_band=8e3)
    lowest = [-1e3, -1e3, -1e3, 0.0, 0.0, 0.0]
    RobotDescription(**mapping | {"pressure": {"min": lowest, "max": 1e5}})
    lowest[4] = -1e3
    with pytest.raises(InputError, match=r"segments\[1\]\.corrections\.dead_band.*-0\.01 bar"):
        RobotDescription(**mapping | {"pressure": {"min": lowest, "max": 1e5}})


# -- every law ------------------------------------------------------------------------------


def tube_of(law: str, tube: Tube) -> Tube:
    """A tube under any registered law, those without a reference in these tests included."""
    return LAWS[law](tube) if law in LAWS else replace(tube, law=law, poisson_ratio=0.5)


@pytest.mark.parametrize("tube", TUBES.values(), ids=TUBES)
@pytest.mark.parametrize("law", strain_laws())
def test_contract_of_a_strain_law(law: str, tube: Tube) -> None:
    tube = tube_of(law, tube)
    n = len(tube.channels)
    try:
        segment = segment_of(tube)
    except InputError:
        assert law not in LAWS
        assert tube is not FLOP
        pytest.skip("the law cannot describe this segment, see `StrainLaw.check`")
    assert type(strain_law(segment)) is strain_laws()[law]
    assert strain_laws()[law].limit
    assert strain_laws()[law].words
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


@pytest.mark.parametrize("law", strain_laws())
def test_turning_the_pressures_by_120_degrees_turns_the_section(law: str) -> None:
    tube = tube_of(law, FLOP)
    p = np.array([1.2e5, 0.3e5, 0.6e5])
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    turn = np.kron(np.eye(2), [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    strain, C = strain_and_compliance(tube, p)
    turned_strain, turned_C = strain_and_compliance(tube, np.roll(p, 1))
    assert turned_strain == pytest.approx(turn @ strain, abs=1e-13)
    assert turned_C == pytest.approx(turn @ C @ turn.T, rel=1e-11, abs=1e-11 * np.abs(C).max())


@pytest.mark.parametrize("law", strain_laws())
def test_pressing_one_side_bends_away_and_lengthens(law: str) -> None:
    strain, _ = strain_and_compliance(tube_of(law, FLOP), np.array([1e5, 0, 0]))
    assert strain[2] > 1
    assert strain[3] == pytest.approx(0, abs=1e-12)
    assert strain[4] < 0  # about -y: towards -x


def test_each_arm_of_the_tests_has_a_law_in_range() -> None:
    for arm in ARMS.values():
        for tube, p in zip(arm.tubes, arm.split(np.full(arm.n, 1e5)), strict=True):
            assert float(law_of(tube)(p)[2]) > 0
