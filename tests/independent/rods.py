"""A rod under load: shot from the base, or bent in a plane by collocation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import expm

from independent.arms import Arm
from independent.motions import Vector, hat, hat6, shift
from independent.sections import RodSection, rod_section


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
