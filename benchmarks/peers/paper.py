"""The paper's equations, written afresh: what the general solvers are given.

Nothing here comes from stiffopt's symbolic code; the tests check that both agree.  An arm has equal
segments with the constants of Table II.  The compensated coefficients lambda are those of the text,
``lambda_E = E - 0.2 |p|``, ``lambda_A = 1.2 A``, ``lambda_I = 1.05 I``.  Pressures are in bar here,
so that variables are of order one; lengths in m, forces in N.
"""

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

BAR = 1e5
LENGTH = 0.09
OUTER, INNER, CHAMBER, OFFSET = 15e-3, 4.5e-3, 2.25e-3, 10.1e-3
E0, SLOPE, POISSON = 1e5, 0.2, 0.5
PRESSURE_MAX = 1.5  # bar
SMOOTHING = 1e-7  # bar; rounds the cone |p| at p = 0

_ANGLES = np.radians([-30, 30, 90, 150, 210, 270])
_HOLE = np.pi * CHAMBER**2
AREA = 1.2 * (np.pi * (OUTER**2 - INNER**2) - 6 * _HOLE)
INERTIA = 1.05 * (
    np.pi / 4 * (OUTER**4 - INNER**4)
    - 6 * np.pi / 4 * CHAMBER**4
    - _HOLE * OFFSET**2 * np.sum(np.sin(_ANGLES) ** 2)
)
FORCE = 2 * _HOLE * BAR * np.ones(3)  # N per bar in each pair of chambers
_CENTRES = OFFSET * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1).reshape(3, 2, 2).sum(1)
MOMENT = _HOLE * BAR * np.stack([_CENTRES[:, 1], -_CENTRES[:, 0]])  # (2, 3), N m per bar

GAUSS_POINTS = 8
"""Per segment; relative error of the compliance below 1e-10 (see the model's documentation)."""


# -- symbolic, for solvers that want derivatives -----------------------------------------------


def _hat(w: Any) -> Any:
    return ca.vertcat(
        ca.horzcat(0, -w[2], w[1]), ca.horzcat(w[2], 0, -w[0]), ca.horzcat(-w[1], w[0], 0)
    )


def _arc(kx: Any, ky: Any, s: Any) -> tuple[Any, Any]:
    """Rotation and position after an arc of length s: the exponential of eq. 7, closed form."""
    w = ca.vertcat(kx * s, ky * s, 0)
    square = kx**2 * s**2 + ky**2 * s**2 + 1e-16
    theta = ca.sqrt(square)
    a, b = ca.sin(theta) / theta, (1 - ca.cos(theta)) / square
    c = (1 - a) / square
    W = _hat(w)
    WW = W @ W
    R = ca.SX.eye(3) + a * W + b * WW
    V = ca.SX.eye(3) + b * W + c * WW
    return R, V[:, 2] * s


def _adjoint(R: Any, x: Any) -> Any:
    """6x6 map of twists (v; w) of a frame into the frame in which it has the pose (R, x)."""
    return ca.blockcat([[R, _hat(x) @ R], [ca.SX.zeros(3, 3), R]])


def _section(p: Any) -> tuple[Any, Any, Any, Any]:
    """Curvatures, stretch and modulus of a segment (eqs 8 to 10)."""
    E = E0 - SLOPE * BAR * (ca.sqrt(ca.sumsqr(p) + SMOOTHING**2) - SMOOTHING)
    stretch = 1 + ca.dot(ca.DM(FORCE), p) / (E * AREA)
    M = ca.DM(MOMENT) @ p
    return M[0] / (E * INERTIA), M[1] / (E * INERTIA), stretch, E


def symbolic(segments: int) -> tuple[Any, Any, Any, Any]:
    """Pressures (n,), tip position (3,), rotation (3, 3) and compliance (6, 6) in tip axes."""
    p = ca.SX.sym("p", 3 * segments)
    nodes, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    R, x, C = ca.SX.eye(3), ca.SX.zeros(3), ca.SX.zeros(6, 6)
    for i in range(segments):
        kx, ky, stretch, E = _section(p[3 * i : 3 * i + 3])
        G = E / (2 * (1 + POISSON))
        C0 = ca.diag(
            1 / ca.vertcat(
                G * AREA, G * AREA, E * AREA, E * INERTIA, E * INERTIA, 2 * G * INERTIA
            )
        )  # fmt: skip
        length = LENGTH * stretch
        R_i, x_i = _arc(kx, ky, length)
        back = _adjoint(R_i.T, -R_i.T @ x_i)
        C = back @ C @ back.T
        for node, weight in zip((1 - nodes) / 2, weights / 2, strict=True):
            R_s, x_s = _arc(kx, ky, length * node)  # from the section to the segment's end
            X = _adjoint(R_s.T, -R_s.T @ x_s)
            C += weight * length * (X @ C0 @ X.T)
        x = x + R @ x_i
        R = R @ R_i
    return p, x, R, C


def energy_form(segments: int, d: Any, points: int = 4) -> tuple[Any, Any, Any]:
    """Pressures, tip position and compliance along d (base axes): ``d'C_vv d`` as one integral.

    Twice the strain energy of a unit tip force; cheaper than `symbolic`, for a user who sees it.
    """
    p = ca.SX.sym("p", 3 * segments)
    nodes, weights = np.polynomial.legendre.leggauss(points)
    stations = []  # rotation, position, weight, modulus
    R, x = ca.SX.eye(3), ca.SX.zeros(3)
    for i in range(segments):
        kx, ky, stretch, E = _section(p[3 * i : 3 * i + 3])
        length = LENGTH * stretch
        for node, weight in zip((1 + nodes) / 2, weights / 2, strict=True):
            R_s, x_s = _arc(kx, ky, length * node)
            stations.append((R @ R_s, x + R @ x_s, weight * length, E))
        R_i, x_i = _arc(kx, ky, length)
        R, x = R @ R_i, x + R @ x_i
    total = ca.SX(0)
    for R_s, x_s, weight, E in stations:
        f = R_s.T @ d
        m = R_s.T @ ca.cross(x - x_s, d)
        G = E / (2 * (1 + POISSON))
        shear = (f[0] ** 2 + f[1] ** 2) / (G * AREA) + f[2] ** 2 / (E * AREA)
        total += weight * (
            shear + (m[0] ** 2 + m[1] ** 2) / (E * INERTIA) + m[2] ** 2 / (2 * G * INERTIA)
        )
    return p, x, total
