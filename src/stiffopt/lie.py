"""Rigid motions, twists and wrenches: SE(3) for CasADi and NumPy.

Conventions: a twist is ``(v, omega)`` and a wrench is ``(F, M)``, linear part first (eqs 1
and 4 of the paper).  ``T_ab`` maps coordinates of frame b into frame a.  Twists and wrenches
transform differently, and each map has its own name:

* ``adjoint(T_ab) @ twist_b = twist_a``, defined by ``exp(adjoint(T) x) = T exp(x) T^-1``;
* ``coadjoint(T_ab) @ wrench_b = wrench_a`` (``Ad`` of eq. 5), defined by equal power in
  both frames, that is ``coadjoint(T) = adjoint(T)^-T``.

Every function takes CasADi ``SX``/``MX``/``DM`` or NumPy arrays, without batches, and
returns the same type.  All are smooth at zero rotation, including their second derivatives.
"""

from math import factorial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = Any  # an ndarray, or a casadi SX, MX or DM

_CASADI = (ca.SX, ca.MX, ca.DM)
_SERIES_BELOW = 1.0  # squared angle below which the power series replace the closed forms
_TERMS = 11


def _is_casadi(x: Array) -> bool:
    return isinstance(x, _CASADI)


def _blocks(rows: list[list[Array]]) -> Array:
    """Assemble a matrix from blocks in either library."""
    if any(_is_casadi(block) for row in rows for block in row):
        return ca.vertcat(*[ca.horzcat(*row) for row in rows])
    if np.ndim(rows[0][0]) == 0:
        return np.array(rows, dtype=float)  # many times faster than np.block
    return np.block(rows)


def _column(entries: list[Array]) -> Array:
    if any(_is_casadi(entry) for entry in entries):
        return ca.vertcat(*entries)
    return np.array(entries, dtype=float)


def _where(condition: Array, if_true: Array, if_false: Array) -> Array:
    if _is_casadi(condition):
        return ca.if_else(condition, if_true, if_false)
    return if_true if condition else if_false


def _sqrt(x: Array) -> Array:
    return ca.sqrt(x) if _is_casadi(x) else np.sqrt(x)


def _series(x: Array, coefficients: list[float]) -> Array:
    """Evaluate a polynomial in x by Horner's rule."""
    value = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = coefficient + x * value
    return value


def _guarded(x: Array) -> tuple[Array, Array]:
    """Return whether the series applies, and a squared angle that is safe for the closed forms."""
    small = x < _SERIES_BELOW
    return small, _where(small, _SERIES_BELOW, x)


def exponential_coefficients(x: Array) -> tuple[Array, Array, Array]:
    """Return coefficients of the exponential map as entire functions of the squared angle.

    With ``x = theta^2``: ``sin(theta)/theta``, ``(1 - cos(theta))/theta^2`` and
    ``(theta - sin(theta))/theta^3``.
    """
    small, safe = _guarded(x)
    theta = _sqrt(safe)
    sine = ca.sin(theta) if _is_casadi(theta) else np.sin(theta)
    cosine = ca.cos(theta) if _is_casadi(theta) else np.cos(theta)
    closed = ((1 - cosine) / safe, (theta - sine) / (safe * theta))
    series = (
        _series(x, [(-1) ** k / factorial(2 * k + offset) for k in range(_TERMS)])
        for offset in (2, 3)
    )
    second, third = (_where(small, s, c) for s, c in zip(series, closed, strict=True))
    return 1 - x * third, second, third


def hat(w: Array) -> Array:
    """Return the skew matrix of a 3-vector: ``hat(w) @ x = w x x`` (eq. 2)."""
    zero = 0 * w[0]
    return _blocks([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def vee(matrix: Array) -> Array:
    """Return the 3-vector of a skew matrix, the inverse of `hat`, or of a matrix's skew part."""
    return 0.5 * _column(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )


def _identity_like(x: Array) -> Array:
    return type(x).eye(3) if _is_casadi(x) else np.eye(3)


def exp(twist: Array) -> Array:
    """Return the rigid motion ``T = exp(twist^)`` (eq. 3): (6,) -> (4, 4)."""
    v, w = twist[:3], twist[3:]
    first, second, third = exponential_coefficients(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    W = hat(w)
    W2 = W @ W
    rotation = _identity_like(twist) + first * W + second * W2
    position = v + second * (W @ v) + third * (W2 @ v)
    return transform(rotation, position)


def log(T: Array) -> Array:
    """Return the twist (6,) of a rigid motion (4, 4), its angle in [0, pi]: ``exp(log(T)) = T``."""
    q = quaternion_from_rotation(T[:3, :3])
    w = rotation_vector_from_quaternion(q)
    x = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    small, safe = _guarded(x)
    first, second, _ = exponential_coefficients(safe)
    closed = (1 - first / (2 * second)) / safe
    # Bernoulli numbers: 1/12 + x/720 + x^2/30240 + ...
    series = _series(
        x,
        [
            1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000,
            1 / 74724249600, 3617 / 10670622842880000, 43867 / 5109094217170944000,
            174611 / 802857662698291200000,
        ],
    )  # fmt: skip
    W = hat(w)
    position = T[:3, 3]
    v = position - 0.5 * (W @ position) + _where(small, series, closed) * (W @ (W @ position))
    return _stack(v, w)


def _stack(upper: Array, lower: Array) -> Array:
    if _is_casadi(upper) or _is_casadi(lower):
        return ca.vertcat(upper, lower)
    return np.concatenate([upper, lower])


def transform(rotation: Array, position: Array) -> Array:
    """Return the homogeneous matrix of a rotation (3, 3) and a position (3,)."""
    if _is_casadi(rotation) or _is_casadi(position):
        return ca.vertcat(ca.horzcat(rotation, position), ca.DM([[0, 0, 0, 1]]))
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def inverse(T: Array) -> Array:
    """Return the inverse of a rigid motion (4, 4)."""
    rotation = T[:3, :3].T
    return transform(rotation, -(rotation @ T[:3, 3]))


def adjoint(T: Array) -> Array:
    """Return the twist map of a motion, (6, 6): ``twist_a = adjoint(T_ab) @ twist_b``."""
    rotation = T[:3, :3]
    zero = 0 * rotation
    return _blocks([[rotation, hat(T[:3, 3]) @ rotation], [zero, rotation]])


def coadjoint(T: Array) -> Array:
    """Return a motion's (6, 6) wrench map (eq. 5): ``wrench_a = coadjoint(T_ab) @ wrench_b``."""
    rotation = T[:3, :3]
    zero = 0 * rotation
    return _blocks([[rotation, zero], [hat(T[:3, 3]) @ rotation, rotation]])


def rotate_blocks(rotation: Array) -> Array:
    """Return the map (6, 6) that rotates both halves of a twist or wrench but keeps its point."""
    zero = 0 * rotation
    return _blocks([[rotation, zero], [zero, rotation]])


def quaternion_product(a: Array, b: Array) -> Array:
    """Return the Hamilton product of two quaternions (w, x, y, z)."""
    return _column(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def rotation_from_quaternion(q: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return _blocks(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation (3, 3).

    Shepperd's method: compute four times each squared component and divide by the largest, so
    that no angle up to and including pi loses digits.
    """
    R = rotation
    squares = [
        1 + R[0, 0] + R[1, 1] + R[2, 2],
        1 + R[0, 0] - R[1, 1] - R[2, 2],
        1 - R[0, 0] + R[1, 1] - R[2, 2],
        1 - R[0, 0] - R[1, 1] + R[2, 2],
    ]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    candidates = [
        [squares[0], x, y, z],
        [x, squares[1], xy, xz],
        [y, xy, squares[2], yz],
        [z, xz, yz, squares[3]],
    ]
    best_square, best = squares[0], _column(candidates[0])
    for square, candidate in zip(squares[1:], candidates[1:], strict=True):
        larger = square > best_square
        best_square = _where(larger, square, best_square)
        best = _where(larger, _column(candidate), best)
    q = best / (2 * _sqrt(best_square))
    return _where(q[0] < 0, -q, q)


def quaternion_along(direction: ArrayLike) -> NDArray[np.float64]:
    """Return the quaternion (w first) of the smallest rotation from z to a direction (3,)."""
    x, y, z = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    half = np.array([1 + z, -y, x, 0.0])
    length = np.linalg.norm(half)
    return half / length if length > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def rotation_vector_from_quaternion(q: Array) -> Array:
    """Return the rotation vector (3,) in rad of a unit quaternion (w, x, y, z) with w >= 0."""
    w, v = q[0], q[1:]
    x = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    small = x < 1e-2
    safe = _where(small, 1e-2, x)
    sine = _sqrt(safe)
    angle = ca.atan2(sine, w) if _is_casadi(sine) or _is_casadi(w) else np.arctan2(sine, w)
    # asin(sqrt(x)) / sqrt(x) around zero, where w is the positive root of 1 - x
    series = _series(
        x,
        [1, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040, 135135 / 9676800],
    )
    return 2 * _where(small, series, angle / sine) * v
