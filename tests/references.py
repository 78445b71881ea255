"""Rod mechanics a second time: what the simulated arm is proved against. No stiffopt here.

All of it is per reference length: a section's stiffness is that of its rest geometry, mass is
that of the rest section without the compensation factors, and a pressure is a force normal to
the section at the chamber's centre.  Elastica by elliptic integrals, a rod shot from its tip,
compliance as an integral of screws, frequencies and damping by transfer matrices, fibres of
rubber, Maxwell and Jenkin elements.  SI units; twists and wrenches linear part first.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from independent.arms import Arm, Tube
from independent.motions import hat, hat6, shift, wrench_map
from independent.rods import Load
from independent.sections import bores, pressure_resultant, silicone

Vector = NDArray[np.float64]

_GAUSS, _WEIGHTS = np.polynomial.legendre.leggauss(12)

# -- sections -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Beam:
    """A section, doubly symmetric about the axis, per reference length.

    Attributes
    ----------
    shear, axial, bending, torsion : G A, E A, E I and G J with the compensation factors.
    mass, inertia : density times geometric A and I.
    """

    shear: float
    axial: float
    bending: float
    torsion: float
    mass: float
    inertia: float

    @property
    def stiffness(self) -> Vector:
        """Section wrench per strain (6, 6)."""
        return np.diag(
            [self.shear, self.shear, self.axial, self.bending, self.bending, self.torsion]
        )


def beam(tube: Tube, pressures: ArrayLike = 0.0) -> Beam:
    """Section of a symmetric tube; its modulus follows the norm of its pressures."""
    slope, area_factor, inertia_factor = tube.factors or (0.0, 1.0, 1.0)
    solid = silicone(tube)
    (xx, xy), (_, yy) = solid.about_centroid
    assert np.abs(solid.centroid).max() < 1e-12
    assert abs(xy) + abs(xx - yy) < 1e-9 * xx
    E = tube.youngs_modulus + slope * float(np.linalg.norm(pressures))
    G = E / (2 * (1 + tube.poisson_ratio))
    A, second = area_factor * solid.area, inertia_factor * xx
    return Beam(
        shear=G * A,
        axial=E * A,
        bending=E * second,
        torsion=2 * G * second,
        mass=tube.density * solid.area,
        inertia=tube.density * xx,
    )


def pressure_wrench(tube: Tube, pressures: ArrayLike) -> Vector:
    """Wrench (6,) about the axis with which the pressures strain the section."""
    force, (x, y) = pressure_resultant(tube, np.asarray(pressures, dtype=float))
    return np.array([0, 0, force, y, -x, 0.0])


def free_strain(tube: Tube, pressures: ArrayLike) -> Vector:
    """Strain (6,) of a section on which only its pressures act, per reference length."""
    strain = np.linalg.solve(beam(tube, pressures).stiffness, pressure_wrench(tube, pressures))
    return strain + np.array([0, 0, 1.0, 0, 0, 0])


# -- statics --------------------------------------------------------------------------------


def elastica_tip(share: float) -> tuple[float, float, float]:
    """Tip (x / L, z / L, angle) of an inextensible rod along z, dead force share E I / L^2 in x.

    By elliptic integrals (Bisshopp and Drucker 1945).
    """

    def amplitude(k: float) -> float:
        return float(np.arcsin(1 / (k * np.sqrt(2))))

    def excess(k: float) -> float:
        return float(ellipk(k**2) - ellipkinc(amplitude(k), k**2) - np.sqrt(share))

    k = brentq(excess, np.sqrt(0.5) * (1 + 1e-15), 1 - 1e-15, xtol=1e-16, rtol=1e-15)
    sine = 2 * k**2 - 1
    x = 1 - 2 / np.sqrt(share) * (ellipe(k**2) - ellipeinc(amplitude(k), k**2))
    return float(x), float(np.sqrt(2 * sine / share)), float(np.arcsin(sine))


def loaded_tip(
    arm: Arm, pressures: ArrayLike, loads: Sequence[Load] = (), steps: int = 4
) -> Vector:
    """Tip pose (4, 4) of the arm in equilibrium, shot from the tip.

    The unknown rotation of the tip is found by Newton's method so that the base is upright, by
    continuation in `steps` from no weight and no loads, at full pressure.
    """
    R = free_tip(arm, pressures)[:3, :3]
    turns = np.array([np.eye(3), *(expm(hat(1e-6 * axis)) for axis in np.eye(3))])
    for share in np.linspace(0, 1, steps + 1)[1:]:
        for _ in range(30):
            bases, places = _shoot_from_tip(arm, pressures, loads, share, R @ turns)
            missing = np.array([_rotation_vector(base) for base in bases])
            if np.abs(missing[0]).max() < 1e-9:
                break
            turn = np.linalg.solve((missing[1:] - missing[0]).T / 1e-6, -missing[0])
            R = R @ expm(hat(turn * min(1.0, 0.5 / np.linalg.norm(turn))))
        else:
            raise AssertionError(f"no equilibrium found at {share:.0%} of the loads")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -places[0]
    return T


def _rotation_vector(R: Vector) -> Vector:
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, (np.trace(R) - 1) / 2)
    return axis * (angle / sine if sine > 1e-12 else 1.0)


def _shoot_from_tip(
    arm: Arm, pressures: ArrayLike, loads: Sequence[Load], share: float, R: Vector
) -> tuple[Vector, Vector]:
    """Rotations (b, 3, 3) of the base, and places (b, 3) from the tip, for those of the tip."""
    gravity = share * np.asarray(arm.gravity)

    def loaded(at: float, R: Vector, n: Vector, m: Vector) -> tuple[Vector, Vector]:
        for load in loads:
            place = arm.length if load.at is None else load.at
            if abs(place - at) < 1e-12:
                frame = share * (R if load.follower else np.eye(3))
                n, m = n + frame @ np.asarray(load.force), m + frame @ np.asarray(load.moment)
        return n, m

    r, m, end = np.zeros((len(R), 3)), np.zeros((len(R), 3)), arm.length
    n, m = loaded(end, R, arm.tip_mass * gravity + r, m)
    for tube, own in reversed(list(zip(arm.tubes, arm.split(pressures), strict=True))):
        if tube.connector:
            rigid = tube.connector * R[:, :, 2]
            r, m = r - rigid, m + np.cross(rigid, n)
            end -= tube.connector
            n, m = loaded(end, R, n, m)
        start = end - tube.length
        marks = [load.at for load in loads if load.at is not None]
        cuts = [end, *sorted((at for at in marks if start < at < end - 1e-12), reverse=True), start]
        for high, low in itertools.pairwise(cuts):
            r, R, n, m = _backwards(tube, own, gravity, high - low, r, R, n, m)
            n, m = loaded(low, R, n, m)
        end = start
    return R, r


def _backwards(
    tube: Tube, own: Vector, gravity: Vector, length: float, *state: Vector
) -> tuple[Vector, Vector, Vector, Vector]:
    """``r' = R v, R' = R u^, n' = -f, m' = -r' x n``, towards the base."""
    flexibility = np.linalg.inv(beam(tube, own).stiffness)
    free = free_strain(tube, own)
    b = len(state[0])
    lighter = np.broadcast_to(-tube.density * silicone(tube).area * gravity, (b, 3))

    def slope(_: float, flat: Vector) -> Vector:
        y = flat.reshape(b, 18)
        R, n, m = y[:, 3:12].reshape(b, 3, 3), y[:, 12:15], y[:, 15:]
        wrench = np.concatenate([n[:, np.newaxis] @ R, m[:, np.newaxis] @ R], axis=2)[:, 0]
        strain = free + wrench @ flexibility
        tangent = (R @ strain[:, :3, np.newaxis])[:, :, 0]
        turning = np.cross(R, strain[:, np.newaxis, 3:])  # R u^, row by row
        return -np.hstack([tangent, turning.reshape(b, 9), lighter, -np.cross(tangent, n)]).ravel()

    flat = np.hstack([part.reshape(b, -1) for part in state]).ravel()
    end = solve_ivp(slope, (0, length), flat, method="DOP853", rtol=1e-9, atol=1e-12).y[:, -1]
    y = end.reshape(b, 18)
    return y[:, :3], y[:, 3:12].reshape(b, 3, 3), y[:, 12:15], y[:, 15:]


def free_tip(arm: Arm, pressures: ArrayLike) -> Vector:
    """Tip pose (4, 4) under pressure alone."""
    T = np.eye(4)
    for tube, own in zip(arm.tubes, arm.split(pressures), strict=True):
        T = T @ expm(tube.length * hat6(free_strain(tube, own))) @ shift(0, 0, tube.connector)
    return T


def tip_compliance(arm: Arm, pressures: ArrayLike) -> Vector:
    """Twist of the tip per wrench on it (6, 6), in tip axes, of an arm under pressure alone.

    ``int Ad^T C Ad ds`` (eq. 17) over the reference length, by Gauss quadrature; `Ad` takes a
    wrench on the tip to the section.
    """
    T_tip = free_tip(arm, pressures)
    T = np.eye(4)
    C = np.zeros((6, 6))
    for tube, own in zip(arm.tubes, arm.split(pressures), strict=True):
        flexibility = np.linalg.inv(beam(tube, own).stiffness)
        twist = hat6(free_strain(tube, own))
        for x, weight in zip(_GAUSS, _WEIGHTS, strict=True):
            T_section = T @ expm(tube.length * (1 + x) / 2 * twist)
            Ad = wrench_map(np.linalg.inv(T_section) @ T_tip)
            C += tube.length * weight / 2 * Ad.T @ flexibility @ Ad
        T = T @ expm(tube.length * twist) @ shift(0, 0, tube.connector)
    return C


# -- vibration ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """A straight vertical rod, clamped at its base, with a point mass at its tip.

    Attributes
    ----------
    section : of the rod.
    length : at rest.
    tip_mass : a point: it has no moment of inertia.
    gravity : acceleration along the rod towards the tip: positive if it hangs.
    """

    section: Beam
    length: float
    tip_mass: float = 0.0
    gravity: float = 0.0

    def _tension(self, s: ArrayLike) -> Vector:
        below = self.section.mass * (self.length - np.asarray(s, dtype=float)) + self.tip_mass
        return below * self.gravity

    def _determinant(self, omega: complex, viscosity: float = 0.0, pieces: int = 24) -> complex:
        """Of the tip's conditions, for unit force and moment at the base.

        The tension is taken as constant over each piece.

        The state is (w, phi, n, m): deflection, rotation, force across the rod in space and
        moment.  Timoshenko's beam without a shear correction and with rotary inertia, on the
        stretched rod; the material's forces, not the static tension's, have the viscosity.
        """
        beam, loss = self.section, 1 + 1j * omega * viscosity
        pieces = pieces if self.gravity else 1
        h = self.length / pieces
        A = np.zeros((pieces, 4, 4), dtype=complex)
        tension = self._tension(h * (np.arange(pieces) + 0.5))
        stretch = 1 + tension / beam.axial
        slope = np.zeros((pieces, 4), dtype=complex)  # w' from the state
        slope[:, 1] = stretch - tension / (beam.shear * loss)
        slope[:, 2] = 1 / (beam.shear * loss)
        A[:, 0] = slope
        A[:, 1, 3] = 1 / (beam.bending * loss)
        A[:, 2, 0] = -(omega**2) * beam.mass
        A[:, 3] = tension[:, np.newaxis] * slope
        A[:, 3, 1] -= omega**2 * beam.inertia
        A[:, 3, 2] -= stretch
        state = np.eye(4, dtype=complex)[:, 2:]
        for piece in expm(h * A):
            state = piece @ state
        w, _, n, m = state
        force = n - omega**2 * self.tip_mass * w
        return complex(force[0] * m[1] - force[1] * m[0])

    def bending_frequencies(self, count: int = 3) -> Vector:
        """The lowest angular frequencies (count,) without damping."""

        def f(omega: float) -> float:
            return self._determinant(omega).real

        beam = self.section
        unit = np.sqrt(beam.bending / (beam.mass * self.length**4))
        found: list[float] = []
        low, ratio = 0.02 * unit, 1.15  # modes of a beam are further apart
        while len(found) < count:
            if f(low) * f(low * ratio) < 0:
                found.append(brentq(f, low, low * ratio, rtol=1e-12))
            low *= ratio
        return np.array(found)

    def damped(self, damping: float) -> tuple[float, float]:
        """First bending mode with viscosity ``tau = 2 damping / omega_1``: (omega_1, ratio).

        `omega_1` is the mode's frequency without damping; the ratio is less than `damping`
        where part of the stiffness is the tension's, which has no viscosity.
        """
        omega_1 = float(self.bending_frequencies(1)[0])
        viscosity = 2 * damping / omega_1
        a, b = complex(omega_1), omega_1 * (1 + 0.5j * damping)
        fa, fb = (self._determinant(x, viscosity) for x in (a, b))
        for _ in range(50):
            if abs(b - a) < 1e-11 * omega_1:
                break
            a, b, fa = b, b - fb * (b - a) / (fb - fa), fb
            fb = self._determinant(b, viscosity)
        return omega_1, float(b.imag / abs(b))

    def axial_frequencies(self, count: int = 2) -> Vector:
        """Angular frequencies (count,) of stretching: ``b tan b = rho A L / M``, no gravity."""
        beam = self.section
        speed = np.sqrt(beam.axial / beam.mass)
        ratio = self.tip_mass / (beam.mass * self.length)
        roots = [
            brentq(lambda b: np.cos(b) - ratio * b * np.sin(b), k * np.pi, (k + 0.5) * np.pi + 1e-9)
            for k in range(count)
        ]
        return np.array(roots) * speed / self.length

    def torsion_frequencies(self, count: int = 2) -> Vector:
        """Angular frequencies (count,) of twisting, free at the tip."""
        speed = np.sqrt(self.section.torsion / (2 * self.section.inertia))
        return (np.arange(count) + 0.5) * np.pi * speed / self.length

    def finite_elements(self, n: int = 120) -> tuple[Vector, Vector]:
        """Bending frequencies (2 n,) and the material's share (2 n,) of each mode's stiffness.

        Linear elements for w and phi, one integration point: a check of the determinant.
        """
        beam, h = self.section, self.length / n
        size = 2 * (n + 1)
        K, G, M = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
        for e in range(n):
            own = slice(2 * e, 2 * e + 4)
            tension = float(self._tension((e + 0.5) * h))
            stretch = 1 + tension / beam.axial
            slope, bend = np.array([-1, 0, 1, 0]) / h, np.array([0, -1, 0, 1]) / h
            turn = np.array([0, 0.5, 0, 0.5])
            shear = slope - stretch * turn
            K[own, own] += h * beam.shear * np.outer(shear, shear)
            K[own, own] += h * beam.bending * np.outer(bend, bend)
            # second order of (lambda - stretch) and of the shear strain's force along the rod
            pair = np.outer(slope, turn)
            G[own, own] += h * tension * (pair + pair.T - stretch * np.outer(turn, turn))
            for k, inertia in ((0, beam.mass), (1, beam.inertia)):
                at = [2 * e + k, 2 * e + 2 + k]
                M[np.ix_(at, at)] += h * inertia * np.array([[2, 1], [1, 2]]) / 6
        M[-2, -2] += self.tip_mass
        values, shapes = eigh((K + G)[2:, 2:], M[2:, 2:])
        material = np.einsum("ik,ij,jk->k", shapes, K[2:, 2:], shapes)
        return np.sqrt(values), material / values


# -- silicone -------------------------------------------------------------------------------


def fibre_stress(law: str, E: float, stiffening: float, stretch: ArrayLike) -> Vector:
    """Nominal stress of an incompressible fibre with initial modulus E = 6 C1.

    Yeoh: ``W = C1 (I1 - 3) + C2 (I1 - 3)^2``, C2 = `stiffening` C1, so that
    ``P = 2 (L - L^-2) (C1 + 2 C2 (I1 - 3))``; neo-Hookean without C2; or linear.
    """
    L = np.asarray(stretch, dtype=float)
    if law == "linear":
        return E * (L - 1)
    C1 = E / 6
    C2 = stiffening * C1 if law == "yeoh" else 0.0
    return 2 * (L - L**-2) * (C1 + 2 * C2 * (L**2 + 2 / L - 3))


def stretch_under(law: str, E: float, stiffening: float, stress: float) -> float:
    """Stretch of a fibre under a nominal stress."""
    f = lambda L: float(fibre_stress(law, E, stiffening, L)) - stress  # noqa: E731
    return float(brentq(f, 0.3, 5.0, xtol=1e-15))


def fibre_bending(
    tube: Tube, law: str, stiffening: float, wrench: tuple[float, float]
) -> tuple[float, float]:
    """Axial strain and curvature of a section of fibres under (force, moment about y).

    No compensation factors; a fibre at x has stretch ``1 + e + k x``.
    """
    x, area = section_fibres(tube)

    def missing(unknown: Vector) -> Vector:
        e, k = unknown
        stress = fibre_stress(law, tube.youngs_modulus, stiffening, 1 + e + k * x)
        return np.array([stress @ area, (stress * x) @ area]) - wrench

    unknown = np.array([0.0, wrench[1] / (tube.youngs_modulus * (x**2 @ area))])
    scale = np.array([1e-6, 1e-6 / tube.outer_radius])
    for _ in range(50):
        J = np.array(
            [(missing(unknown + d) - missing(unknown - d)) / (2 * d.max()) for d in np.diag(scale)]
        ).T
        step = np.linalg.solve(J, -missing(unknown))
        unknown = unknown + step
        if np.abs(step / scale).max() < 1e-6:
            return float(unknown[0]), float(unknown[1])
    raise AssertionError("no equilibrium of the section found")


def section_fibres(tube: Tube) -> tuple[Vector, Vector]:
    """Places x (k,) and areas (k,) of fibres that fill the section; those of bores are < 0."""

    def filled(x: float, radius: float, sign: float) -> tuple[Vector, Vector]:
        angle = 2 * np.pi * np.arange(48) / 48
        r = radius * (1 + _GAUSS) / 2
        places = x + np.outer(r, np.cos(angle))
        areas = np.outer(sign * radius * _WEIGHTS / 2 * r, np.full(48, 2 * np.pi / 48))
        return places.ravel(), areas.ravel()

    parts = [filled(0.0, tube.outer_radius, 1.0)]
    if tube.inner_radius:
        parts.append(filled(0.0, tube.inner_radius, -1.0))
    parts += [filled(float(b.centroid[0]), tube.chamber_radius, -1.0) for b in bores(tube)]
    return np.concatenate([x for x, _ in parts]), np.concatenate([a for _, a in parts])


def creep(shares: ArrayLike, times: ArrayLike, t: ArrayLike) -> Vector:
    """Strain over its final value, at times t (k,) after a step of stress.

    A spring beside Maxwell branches with `shares` of its stiffness and relaxation `times`; the
    dashpots' strains v obey ``v' = (e - v) / time``, with ``e (1 + sum shares) = 1 + shares v``.
    """
    a, tau = np.atleast_1d(shares).astype(float), np.atleast_1d(times).astype(float)
    whole = 1 + a.sum()
    A = (np.outer(np.ones(a.size), a / whole) - np.eye(a.size)) / tau[:, np.newaxis]
    lag = [1 - expm(A * time) @ np.ones(a.size) for time in np.atleast_1d(t)]  # of v, final is 1
    return np.array([(1 + a @ v) / whole for v in lag])


@dataclass
class Jenkin:
    """A linear fibre beside elastic, ideally plastic elements, driven by stress.

    Attributes
    ----------
    E : modulus of the fibre.
    shares, limits : stiffness of the elements over E, and the strain at which they slip.
    """

    E: float
    shares: Vector
    limits: Vector

    def __post_init__(self) -> None:
        self._slip = np.zeros(len(self.shares))

    def _stress(self, strain: float) -> float:
        held = np.clip(strain - self._slip, -self.limits, self.limits)
        return float(self.E * (strain + self.shares @ held))

    def strain(self, stress: float) -> float:
        """Strain that a stress brings, monotonically from the one before."""
        bound = abs(stress) / self.E + float(self.limits.sum()) + 1
        e = brentq(lambda e: self._stress(e) - stress, -bound, bound, xtol=1e-15)
        held = np.clip(e - self._slip, -self.limits, self.limits)
        self._slip = e - held
        return float(e)


def loop_area(x: ArrayLike, y: ArrayLike) -> float:
    """Area that a closed path (x, y) encloses; positive if y is higher on the way up."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    return float(-0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
