"""The model a second time, by other means: nothing here imports stiffopt.

Formulas are taken literally from the paper (its equation numbers are cited) and from rod theory,
in plain NumPy and SciPy: products of exponentials by Pade approximation, sums over elements,
boundary integrals over the section, a rod integrated from the base with rotation matrices, a
boundary value problem by collocation, and a discrete energy.  What is tested against it shares
neither code nor method.  SI units; twists and wrenches linear part first.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

Vector = NDArray[np.float64]

# -- what an arm is -------------------------------------------------------------------------


@dataclass(frozen=True)
class Tube:
    """One segment, by default the paper's (Table II with its lambda); angles in degrees."""

    length: float = 0.09
    outer_radius: float = 0.015
    inner_radius: float = 0.0045
    chamber_radius: float = 0.00225
    offset: float = 0.0101
    angles: tuple[float, ...] = (-30, 30, 90, 150, 210, 270)
    channels: tuple[tuple[int, ...], ...] = ((1, 2), (3, 4), (5, 6))
    youngs_modulus: float = 100e3
    poisson_ratio: float = 0.5
    density: float = 1070.0
    factors: tuple[float, float, float] | None = (-0.2, 1.2, 1.05)
    connector: float = 0.0
    law: str = "paper"

    def mapping(self) -> dict[str, Any]:
        """The segment as a robot file has it, but in SI."""
        compensation = None
        if self.factors is not None:
            keys = ("modulus_per_pressure", "area", "inertia")
            compensation = dict(zip(keys, self.factors, strict=True))
        return {
            "length": self.length,
            "outer_radius": self.outer_radius,
            "inner_radius": self.inner_radius,
            "chambers": {
                "radius": self.chamber_radius,
                "offset": self.offset,
                "angles": [float(angle) for angle in np.radians(self.angles)],
            },
            "channels": [list(channel) for channel in self.channels],
            "material": {
                "youngs_modulus": self.youngs_modulus,
                "poisson_ratio": self.poisson_ratio,
                "density": self.density,
            },
            "compensation": compensation,
            "connector": self.connector,
            "strain_law": self.law,
        }


@dataclass(frozen=True)
class Arm:
    """Segments in series, and what they carry."""

    tubes: tuple[Tube, ...]
    tip_mass: float = 0.0
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    highest: float = 1.5e5

    def mapping(self) -> dict[str, Any]:
        """The arm as a robot file has it, but in SI."""
        return {
            "name": "tested",
            "segments": [tube.mapping() for tube in self.tubes],
            "tip_mass": self.tip_mass,
            "gravity": list(self.gravity),
            "pressure": {"min": 0.0, "max": self.highest},
        }

    @property
    def n(self) -> int:
        """Number of channels."""
        return sum(len(tube.channels) for tube in self.tubes)

    @property
    def length(self) -> float:
        """Length at rest with the connectors."""
        return sum(tube.length + tube.connector for tube in self.tubes)

    def split(self, p: ArrayLike) -> list[Vector]:
        """Pressures of each segment."""
        ends = np.cumsum([len(tube.channels) for tube in self.tubes])[:-1]
        return np.split(np.asarray(p, dtype=float), ends)

    def under(self, gravity: Sequence[float], tip_mass: float = 0.0) -> Arm:
        """The same arm with weight."""
        x, y, z = gravity
        return replace(self, gravity=(x, y, z), tip_mass=tip_mass)


FLOP = Tube()
CROSS = Tube(
    length=0.06,
    outer_radius=0.012,
    inner_radius=0.003,
    chamber_radius=0.0015,
    offset=0.008,
    angles=(0, 90, 180, 270),
    channels=((1,), (2,), (3,), (4,)),
    youngs_modulus=150e3,
    poisson_ratio=0.45,
    factors=(-0.1, 1.1, 1.02),
    connector=0.012,
)
PAIR = Tube(  # two channels; chambers crowd on one side, so the centroid is off the axis
    length=0.075,
    chamber_radius=0.0025,
    offset=0.0095,
    angles=(0, 50, 200),
    channels=((1, 2), (3,)),
    factors=None,
    connector=0.004,
)
LOPSIDED = Tube(
    length=0.1,
    outer_radius=0.014,
    inner_radius=0.004,
    chamber_radius=0.003,
    offset=0.0105,
    angles=(10, 70, 130),
    channels=((1,), (2,), (3,)),
    poisson_ratio=0.4,
    factors=(-0.15, 1.1, 0.95),
)
SIX = Tube(
    length=0.05,
    outer_radius=0.01,
    inner_radius=0.0,
    chamber_radius=0.0012,
    offset=0.0072,
    angles=(0, 60, 120, 180, 240, 300),
    channels=((1,), (2,), (3,), (4,), (5,), (6,)),
    youngs_modulus=200e3,
    factors=(0.05, 1.0, 1.1),
    connector=0.006,
)
ARMS = {
    "1 segment": Arm((FLOP,)),
    "2 segments": Arm((FLOP, FLOP)),
    "2 channels, off axis": Arm((PAIR,)),
    "3 segments, mixed": Arm((LOPSIDED, CROSS, PAIR)),
    "5 segments, mixed": Arm((FLOP, CROSS, LOPSIDED, SIX, PAIR)),
}


def neo_hookean(tube: Tube) -> Tube:
    """The same segment with the neo-Hookean law."""
    return replace(tube, law="neo-hookean", factors=None, poisson_ratio=0.5)


def eq_9(i: int) -> float:
    """Angle of chamber i = 1..6 in degrees, literally."""
    alpha = 60
    return -alpha / 2 + (i - i % 2) / 2 * alpha + ((i - 1) - (i - 1) % 2) / 2 * (120 - alpha)


# -- sections -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Integrals:
    """``int dA``, ``int r dA`` (2,) and ``int r r^T dA`` (2, 2) about the axis."""

    area: float
    first: Vector
    second: Vector

    def __add__(self, other: Integrals) -> Integrals:
        return Integrals(
            self.area + other.area, self.first + other.first, self.second + other.second
        )

    def __neg__(self) -> Integrals:
        return Integrals(-self.area, -self.first, -self.second)

    @property
    def centroid(self) -> Vector:
        """Centroid (2,)."""
        return self.first / self.area

    @property
    def about_centroid(self) -> Vector:
        """``int (r - c)(r - c)^T dA`` (2, 2)."""
        return self.second - np.outer(self.first, self.first) / self.area


def disc(x: float, y: float, radius: float) -> Integrals:
    """Integrals over a disc by Green's theorem along its edge (exact with 16 points)."""
    t = 2 * np.pi * np.arange(16) / 16
    X, Y = x + radius * np.cos(t), y + radius * np.sin(t)
    dy = radius * np.cos(t) * 2 * np.pi / 16
    xx, xy, yy = X**3 / 3 @ dy, X**2 * Y / 2 @ dy, X * Y**2 @ dy
    return Integrals(
        float(X @ dy), np.array([X**2 / 2 @ dy, X * Y @ dy]), np.array([[xx, xy], [xy, yy]])
    )


def bores(tube: Tube) -> list[Integrals]:
    """Integrals over each chamber."""
    return [
        disc(tube.offset * np.cos(a), tube.offset * np.sin(a), tube.chamber_radius)
        for a in np.radians(tube.angles)
    ]


def silicone(tube: Tube) -> Integrals:
    """Integrals over the solid part of the section."""
    whole = disc(0, 0, tube.outer_radius)
    if tube.inner_radius:
        whole = whole + -disc(0, 0, tube.inner_radius)
    for bore in bores(tube):
        whole = whole + -bore
    return whole


def pressure_resultant(tube: Tube, p: Vector) -> tuple[float, Vector]:
    """Force ``sum P A_c`` and ``sum P int r dA`` (2,) of the pressures about the axis."""
    chambers = bores(tube)
    pairs = [
        (value, chambers[number - 1])
        for value, channel in zip(p, tube.channels, strict=True)
        for number in channel
    ]
    force = sum(value * bore.area for value, bore in pairs)
    return float(force), np.sum([value * bore.first for value, bore in pairs], axis=0)


@dataclass(frozen=True)
class CentroidSection:
    """A section as its centroid line sees it.

    Attributes
    ----------
    centroid : (2,) off the axis, in the deformed section.
    stretch : of the centroid line per length at rest.
    curvature : (kappa_x, kappa_y) per deformed length.
    flexibility : (6, 6) per deformed length, about the centroid.
    """

    centroid: Vector
    stretch: float
    curvature: Vector
    flexibility: Vector


def _bending(second: Vector) -> Vector:
    """Moments (M_x, M_y) / E of unit curvatures, from ``int r r^T dA``."""
    (xx, xy), (_, yy) = second
    return np.array([[yy, -xy], [-xy, xx]])


def _flexibility(shear: float, axial: float, bending: Vector, torsion: float) -> Vector:
    C = np.diag([1 / shear, 1 / shear, 1 / axial, 0.0, 0.0, 1 / torsion])
    C[3:5, 3:5] = np.linalg.inv(bending)
    return C


def paper_section(tube: Tube, p: Vector) -> CentroidSection:
    """Eqs 8-10 with lambda, about the centroid where force and moment do not mix."""
    slope, area_factor, inertia_factor = tube.factors or (0.0, 1.0, 1.0)
    solid = silicone(tube)
    E = tube.youngs_modulus + slope * float(np.sqrt(np.sum(p**2)))
    G = E / (2 * (1 + tube.poisson_ratio))
    A, second = area_factor * solid.area, inertia_factor * solid.about_centroid
    force, lever = pressure_resultant(tube, p)
    x, y = lever - force * solid.centroid
    bending = E * _bending(second)
    return CentroidSection(
        centroid=solid.centroid,
        stretch=1 + force / (E * A),
        curvature=np.linalg.solve(bending, [y, -x]),
        flexibility=_flexibility(G * A, E * A, bending, G * np.trace(second)),
    )


def neo_hookean_section(tube: Tube, p: Vector) -> CentroidSection:
    """The incompressible neo-Hookean section, its stretch found by bisection."""
    mu, solid = tube.youngs_modulus / 3, silicone(tube)
    force, lever = pressure_resultant(tube, p)
    load = force / (mu * solid.area)
    stretch = float(brentq(lambda L: L - L**-2 - load, 0.3, 50.0, xtol=1e-15, rtol=1e-15))
    shrink = stretch**-0.5
    tangent = mu * (1 + 2 * stretch**-3)
    x, y = shrink * (lever - force * solid.centroid)
    second = shrink**2 * solid.about_centroid
    bending = tangent * _bending(second)
    flexibility = _flexibility(
        mu * solid.area, tangent * solid.area, bending, mu * np.trace(second)
    )
    return CentroidSection(
        centroid=shrink * solid.centroid,
        stretch=stretch,
        curvature=np.linalg.solve(bending, [y, -x]) / stretch,
        flexibility=flexibility / stretch,
    )


def section(tube: Tube, p: Vector) -> CentroidSection:
    """Section by the segment's law."""
    return (paper_section if tube.law == "paper" else neo_hookean_section)(tube, p)


# -- the paper's discretisation -------------------------------------------------------------


def hat(w: ArrayLike) -> Vector:
    """Skew matrix of a 3-vector."""
    x, y, z = np.asarray(w)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def hat6(twist: ArrayLike) -> Vector:
    """Matrix (4, 4) of a twist (eq. 2)."""
    twist = np.asarray(twist)
    matrix = np.zeros((4, 4), dtype=twist.dtype)
    matrix[:3, :3] = hat(twist[3:])
    matrix[:3, 3] = twist[:3]
    return matrix


def shift(x: float, y: float, z: float) -> Vector:
    """Motion by a translation."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def turn_z(angle: float) -> Vector:
    """Rotation (4, 4) about z."""
    return expm(hat6([0, 0, 0, 0, 0, angle]))


def wrench_map(T: Vector) -> Vector:
    """``Ad`` of eq. 5: ``W_a = Ad_ab W_b``."""
    R, zero = T[:3, :3], np.zeros((3, 3))
    return np.block([[R, zero], [hat(T[:3, 3]) @ R, R]])


def five_exponentials(kappa_x: float, kappa_y: float, s: float) -> Vector:
    """One arc as the product of the five exponentials of eqs 6 and 7 and Table I."""
    kappa = np.hypot(kappa_x, kappa_y)
    phi = -np.arctan2(kappa_x, kappa_y)
    chord = 2 / kappa * np.sin(kappa * s / 2) if kappa else s
    z, y, slide = np.eye(6)[5], np.eye(6)[4], np.eye(6)[2]
    links = [(z, phi), (y, kappa * s / 2), (slide, chord), (y, kappa * s / 2), (z, -phi)]
    T = np.eye(4)
    for screw, amplitude in links:
        T = T @ expm(hat6(screw * amplitude))
    return T


def _element(segment: CentroidSection, s: float) -> Vector:
    """Motion of the axis along an element whose centroid line has length s."""
    x, y = segment.centroid
    return shift(x, y, 0) @ five_exponentials(*segment.curvature, s) @ shift(-x, -y, 0)


@dataclass
class Discretised:
    """Tip pose (4, 4) and compliance (6, 6) in tip axes by sums over elements."""

    pose: Vector = field(default_factory=lambda: np.eye(4))
    compliance: Vector = field(default_factory=lambda: np.zeros((6, 6)))


def discretise(arm: Arm, p: ArrayLike, n: int) -> Discretised:
    """The arm by n elements per segment (eqs 5-10, 16, 17), elements at their middle."""
    T = np.eye(4)
    middles: list[tuple[Vector, Vector]] = []  # pose and flexibility times length
    for tube, own in zip(arm.tubes, arm.split(p), strict=True):
        law = section(tube, own)
        s = tube.length * law.stretch / n
        whole, half = _element(law, s), _element(law, s / 2)
        to_axis = shift(*law.centroid, 0)
        for _ in range(n):
            middles.append((T @ half @ to_axis, law.flexibility * s))
            T = T @ whole
        T = T @ shift(0, 0, tube.connector)
    C = np.zeros((6, 6))
    for T_0i, flexibility in middles:
        inverse = np.linalg.inv(wrench_map(np.linalg.inv(T) @ T_0i))  # Ad_ti^-1
        C += inverse.T @ flexibility @ inverse
    return Discretised(T, C)


# -- a rod under load, from the base --------------------------------------------------------


@dataclass(frozen=True)
class RodSection:
    """Constitutive law of a segment per length at rest, about the axis."""

    strain: Vector  # (6,)
    compliance: Vector  # (6, 6)
    weight: Vector  # (3,) per length
    centroid: Vector  # (3,) where the weight acts, at rest


def rod_section(tube: Tube, p: Vector, gravity: ArrayLike) -> RodSection:
    """Move a section to the axis and to lengths at rest."""
    law = section(tube, p)
    x, y = law.centroid
    kx, ky = law.curvature
    inverse = np.linalg.inv(wrench_map(shift(x, y, 0)))
    strain = law.stretch * np.array([0, 0, 1 + ky * x - kx * y, kx, ky, 0])
    solid = silicone(tube)
    return RodSection(
        strain=strain,
        compliance=law.stretch * inverse.T @ law.flexibility @ inverse,
        weight=tube.density * solid.area * np.asarray(gravity, dtype=float),
        centroid=np.append(solid.centroid, 0.0),
    )


@dataclass(frozen=True)
class Load:
    """Force and moment at an arc length at rest; follower: in the axes of the loaded point."""

    force: ArrayLike = (0.0, 0.0, 0.0)
    moment: ArrayLike = (0.0, 0.0, 0.0)
    at: float | None = None
    follower: bool = False

    def scaled(self, share: float) -> Load:
        """A share of the load."""
        return replace(
            self, force=share * np.asarray(self.force), moment=share * np.asarray(self.moment)
        )


def rod_tip(
    arm: Arm,
    p: ArrayLike,
    loads: Sequence[Load] = (),
    steps: int = 2,
    at: float | None = None,
) -> Vector:
    """Pose (4, 4) of the tip, or of a station, of the arm in equilibrium: shot from the base.

    The unknown reaction (6,) at the base is found by Newton's method so that the tip is free,
    by continuation in `steps` from no load; integrated with rotation matrices by DOP853.
    """
    return _reaction(arm, p, loads, steps, at)[1]


def _reaction(
    arm: Arm, p: ArrayLike, loads: Sequence[Load], steps: int, at: float | None
) -> tuple[Vector, Vector]:
    """Wrench (6,) at the base that leaves the tip free, and the pose that `rod_tip` returns."""
    p = np.asarray(p, dtype=float)
    scale = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    reaction = np.zeros(6)
    for share in np.linspace(0, 1, steps + 1)[1:]:
        for _ in range(25):
            trials = reaction + np.vstack([np.zeros(6), 1e-6 * np.diag(scale)])
            T, missing = _shoot(arm, p, loads, trials, share, at)
            if np.abs(missing[0] / scale).max() < 1e-9:
                break
            change = (missing[1:] - missing[0]).T / 1e-6
            step = np.linalg.solve(change, missing[0])
            assert np.abs(step).max() < 5, "too far from the equilibrium: take more steps"
            reaction = reaction - scale * step
        else:
            raise AssertionError(f"no equilibrium found at {share:.0%} of the loads")
    return reaction, T[0]


def centre_line(arm: Arm, p: ArrayLike, count: int, steps: int = 6) -> Vector:
    """Positions (about count, 3) along the arm from base to tip, evenly spaced in each segment.

    Without weight products of exponentials; under weight the rod of `rod_tip`.
    """
    weighs = np.any(arm.gravity) and (arm.tip_mass or any(tube.density for tube in arm.tubes))
    base = _reaction(arm, p, (), steps, None)[0] if weighs else np.zeros(6)
    T, n, m = np.eye(4)[np.newaxis], base[np.newaxis, :3], base[np.newaxis, 3:]
    found = [T[0, :3, 3]]
    for tube, own in zip(arm.tubes, arm.split(p), strict=True):
        law = rod_section(tube, own, arm.gravity)
        pieces = max(1, round(count * tube.length / arm.length))
        step = expm(hat6(law.strain * tube.length / pieces))
        for _ in range(pieces):
            if weighs:
                T, n, m = _integrate(law, tube.length / pieces, T, n, m)
            else:
                T = T @ step
            found.append(T[0, :3, 3])
        if tube.connector:
            T, n, m = _carry(law, tube.connector, T, n, m)
            found.append(T[0, :3, 3])
    return np.array(found)


def _shoot(
    arm: Arm,
    p: Vector,
    loads: Sequence[Load],
    reaction: Vector,
    share: float,
    station: float | None = None,
) -> tuple[Vector, Vector]:
    """Poses (b, 4, 4), and wrenches (b, 6) missing at the tip, for reactions (b, 6) at the base."""
    gravity = share * np.asarray(arm.gravity)
    T = found = np.tile(np.eye(4), (len(reaction), 1, 1))
    n, m = reaction[:, :3], reaction[:, 3:]
    start = 0.0
    for tube, own in zip(arm.tubes, arm.split(p), strict=True):
        law = rod_section(tube, own, gravity)
        for length, rigid in ((tube.length, False), (tube.connector, True)):
            end = start + length
            marks = [load.at for load in loads if load.at is not None]
            marks += [] if station is None else [station]
            cuts = [start, *sorted(s for s in marks if start < s < end - 1e-12), end]
            for near, far in itertools.pairwise(cuts):
                T, n, m = (_carry if rigid else _integrate)(law, far - near, T, n, m)
                if station is None or abs(far - station) < 1e-12:
                    found = T
                for load in loads:
                    at = arm.length if load.at is None else load.at
                    if near + 1e-12 < at <= far + 1e-12:
                        force, moment = _in_space(load.scaled(share), T[:, :3, :3])
                        n, m = n - force, m - moment
            start = end
    return found, np.hstack([n - arm.tip_mass * gravity, m])


def _in_space(load: Load, R: Vector) -> tuple[Vector, Vector]:
    force, moment = np.asarray(load.force, dtype=float), np.asarray(load.moment, dtype=float)
    return (R @ force, R @ moment) if load.follower else (force, moment)


def _carry(
    _: RodSection, length: float, T: Vector, n: Vector, m: Vector
) -> tuple[Vector, Vector, Vector]:
    """Cross a rigid, weightless connector."""
    return T @ shift(0, 0, length), n, m - np.cross(length * T[:, :3, 2], n)


def _cross(a: Vector, b: Vector) -> Vector:
    """Cross products of the rows (b, 3): `np.cross`, which spends its time on axes."""
    x, y, z = a.T
    u, v, w = b.T
    return np.column_stack([y * w - z * v, z * u - x * w, x * v - y * u])


def _integrate(
    law: RodSection, length: float, T: Vector, n: Vector, m: Vector
) -> tuple[Vector, Vector, Vector]:
    """``r' = R v, R' = R u^, n' = -f, m' = -r' x n - R c x f``."""
    b = len(T)

    def slope(_: float, flat: Vector) -> Vector:
        y = flat.reshape(b, 18)
        R, n, m = y[:, 3:12].reshape(b, 3, 3), y[:, 12:15], y[:, 15:]
        local = np.hstack([np.einsum("bij,bi->bj", R, n), np.einsum("bij,bi->bj", R, m)])
        xi = law.strain + local @ law.compliance.T
        tangent = np.einsum("bij,bj->bi", R, xi[:, :3])
        weight = np.broadcast_to(law.weight, (b, 3))
        couple = _cross(tangent, n) + _cross(R @ law.centroid, weight)
        turning = R @ np.array([hat(w) for w in xi[:, 3:]])
        return np.hstack([tangent, turning.reshape(b, 9), -weight, -couple]).ravel()

    start = np.hstack([T[:, :3, 3], T[:, :3, :3].reshape(b, 9), n, m]).ravel()
    flat = solve_ivp(slope, (0, length), start, method="DOP853", rtol=1e-10, atol=1e-13).y
    y = flat[:, -1].reshape(b, 18)
    end = np.tile(np.eye(4), (b, 1, 1))
    end[:, :3, :3], end[:, :3, 3] = y[:, 3:12].reshape(b, 3, 3), y[:, :3]
    return end, y[:, 12:15], y[:, 15:]


def planar_tip(
    arm: Arm, p: ArrayLike, force: tuple[float, float] = (0.0, 0.0), moment: float = 0.0
) -> Vector:
    """Tip (x, z, angle) of one uniform symmetric segment bent in the x-z plane, by collocation.

    Weight from the arm, a dead force (x, z) and a moment about y at the tip.  Angles turn z
    towards x.
    """
    (tube,) = arm.tubes
    law = rod_section(tube, np.asarray(p, dtype=float), arm.gravity)
    shear, axial, bend = (law.compliance[i, i] for i in (0, 2, 4))
    weight = law.weight[[0, 2]]
    tip_force = np.asarray(force) + arm.tip_mass * np.asarray(arm.gravity)[[0, 2]]

    def slope(s: Vector, y: Vector) -> Vector:
        _, _, theta, m = y
        sine, cosine = np.sin(theta), np.cos(theta)
        nx, nz = tip_force[:, np.newaxis] + weight[:, np.newaxis] * (tube.length - s)
        across = shear * (nx * cosine - nz * sine)
        along = law.strain[2] + axial * (nx * sine + nz * cosine)
        dx, dz = across * cosine + along * sine, -across * sine + along * cosine
        return np.vstack([dx, dz, law.strain[4] + bend * m, -(dz * nx - dx * nz)])

    def ends(base: Vector, tip: Vector) -> Vector:
        return np.array([base[0], base[1], base[2], tip[3] - moment])

    s = np.linspace(0, tube.length, 21)
    guess = np.zeros((4, s.size))
    guess[1] = s
    total = np.hypot(*(tip_force + weight * tube.length)) + abs(moment) / tube.length
    steps = max(1, int(np.ceil(4 * total * bend * tube.length**2)))
    whole = (weight, tip_force, moment)
    for share in np.linspace(0, 1, min(steps, 12) + 1)[1:]:
        weight, tip_force, moment = (share * part for part in whole)
        found = solve_bvp(slope, ends, s, guess, tol=1e-9, max_nodes=20000)
        assert found.success, found.message
        s, guess = found.x, found.y
    return found.y[:3, -1]


# -- a discrete energy ----------------------------------------------------------------------


class DiscreteRod:
    """An arm of elements of constant strain and its potential energy, dead loads only.

    The unknowns are the strains (k, 6) of the elements; derivatives by complex steps.
    """

    def __init__(self, arm: Arm, p: ArrayLike, n: int, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        gravity = np.asarray(arm.gravity)
        self.force = np.asarray(force, dtype=float) + arm.tip_mass * gravity
        sections = [
            rod_section(tube, own, gravity)
            for tube, own in zip(arm.tubes, arm.split(p), strict=True)
        ]
        self.h = np.repeat([tube.length / n for tube in arm.tubes], n)
        self.connector = np.zeros(n * len(arm.tubes))
        self.connector[n - 1 :: n] = [tube.connector for tube in arm.tubes]
        self.free = np.repeat([law.strain for law in sections], n, axis=0)
        self.stiffness = np.repeat([np.linalg.inv(law.compliance) for law in sections], n, axis=0)
        self.weight = np.repeat([law.weight for law in sections], n, axis=0)
        self.centroid = np.repeat([law.centroid for law in sections], n, axis=0)
        # strains in units of which the elastic energy is a sum of squares
        self.scale = np.repeat([np.linalg.cholesky(law.compliance) for law in sections], n, axis=0)
        self.scale = self.scale / np.sqrt(self.h)[:, np.newaxis, np.newaxis]

    def _energy(self, x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Energy (b,) and tip position (b, 3) for unknowns (b, 6 k)."""
        y = x.reshape(len(x), -1, 6)
        extra = np.einsum("kij,bkj->bki", self.scale, y)
        half = _exp_series((self.free + extra) * self.h[:, np.newaxis] / 2)
        T = np.broadcast_to(np.eye(4), (len(x), 4, 4))
        energy = 0.5 * np.sum(y**2, axis=(1, 2))
        for k in range(len(self.h)):
            middle = T @ half[:, k]
            place = middle[:, :3, 3] + middle[:, :3, :3] @ self.centroid[k]
            energy = energy - self.h[k] * place @ self.weight[k]
            T = middle @ half[:, k]
            if self.connector[k]:
                T = T @ shift(0, 0, self.connector[k])
        tip = T[:, :3, 3]
        return energy - tip @ self.force, tip

    def gradient(self, x: Vector) -> Vector:
        """Derivative (6 k,) of the energy."""
        step = 1e-30
        return self._energy(x + 1j * step * np.eye(x.size))[0].imag / step

    def hessian(self, x: Vector) -> Vector:
        """Second derivative (6 k, 6 k), by central differences of the gradient."""
        step = 1e-4 * np.sqrt(self.unit)
        columns = [
            (self.gradient(x + e) - self.gradient(x - e)) / (2 * step)
            for e in step * np.eye(x.size)
        ]
        H = np.array(columns)
        return (H + H.T) / 2

    @property
    def unit(self) -> float:
        """An energy that is typical of the rod: half a radian over its whole length."""
        return float(np.min(self.stiffness[:, 4, 4]) / self.h.sum() / 8)

    def minimum(self, x: Vector | None = None) -> tuple[Vector, Vector]:
        """Unknowns and tip position (3,) where the gradient vanishes, by damped Newton."""
        x = np.zeros(self.free.size) if x is None else x
        for _ in range(60):
            step = np.linalg.solve(self.hessian(x), -self.gradient(x))
            x = x + step * min(1.0, np.sqrt(self.unit) / np.linalg.norm(step))
            if np.linalg.norm(step) < 1e-9 * np.sqrt(self.unit):
                return x, self._energy(x[np.newaxis])[1][0]
        raise AssertionError("the discrete rod's energy has no minimum near")


def _exp_series(twist: NDArray[Any]) -> NDArray[Any]:
    """Exponentials (..., 4, 4) of small twists (..., 6), real or complex, by power series."""
    v, w = twist[..., :3], twist[..., 3:]
    W = np.zeros((*w.shape, 3), dtype=twist.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        W[..., k, j], W[..., j, k] = w[..., i], -w[..., i]
    x = np.sum(w**2, axis=-1)[..., np.newaxis, np.newaxis]
    first = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    second = (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90 * (1 - x / 132))))) / 2
    third = (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156))))) / 6
    T = np.zeros((*w.shape[:-1], 4, 4), dtype=twist.dtype)
    W2 = W @ W
    T[..., :3, :3] = np.eye(3) + first * W + second * W2
    T[..., :3, 3] = ((np.eye(3) + second * W + third * W2) @ v[..., np.newaxis])[..., 0]
    T[..., 3, 3] = 1
    return T


# -- derivatives ----------------------------------------------------------------------------


def derivative(f: Callable[[Vector], Any], x: ArrayLike, step: float) -> Vector:
    """Derivative (..., k) of f at x (k,) by central differences of fourth order."""
    x = np.asarray(x, dtype=float)
    columns = []
    for e in step * np.eye(x.size):
        near = np.asarray(f(x + e)) - np.asarray(f(x - e))
        far = np.asarray(f(x + 2 * e)) - np.asarray(f(x - 2 * e))
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def body_twists(T: Vector, dT: Vector) -> Vector:
    """Body twists (6, k) of the changes dT (4, 4, k) of a pose."""
    change = np.einsum("ij,jlk->ilk", np.linalg.inv(T), dT)
    return np.array(
        [change[0, 3], change[1, 3], change[2, 3], change[2, 1], change[0, 2], change[1, 0]]
    )
