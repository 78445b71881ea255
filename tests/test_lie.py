"""SE(3) by its identities, in NumPy and in CasADi, with second derivatives through zero."""

from __future__ import annotations

from fractions import Fraction
from math import factorial

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from independent.motions import derivative, hat6
from stiffopt import lie

Vector = NDArray[np.float64]

ALIKE = settings(derandomize=True, max_examples=60, deadline=None)
lengths = st.floats(-0.5, 0.5)
vectors = st.tuples(lengths, lengths, lengths).map(np.array)
axes = vectors.filter(lambda a: np.linalg.norm(a) > 1e-3).map(lambda a: a / np.linalg.norm(a))
near_zero = st.sampled_from([0.0, 1e-200, 1e-16, 1e-9, 1e-7, 1e-4, 1e-2])
near_one = st.sampled_from([1 - 1e-9, 1.0, 1 + 1e-9])  # where series give way to closed forms
near_pi = st.sampled_from([0.0, 1e-12, 1e-9, 1e-6, 1e-3]).map(lambda gap: np.pi - gap)
angles = near_zero | near_one | near_pi | st.floats(0, np.pi)
turns = st.builds(lambda axis, angle: angle * axis, axes, angles)
twists = st.builds(lambda v, w: np.concatenate([v, w]), vectors, turns)


def as_casadi(function: object, *arguments: Vector) -> Vector:
    """Evaluate a function of lie.py with CasADi symbols."""
    symbols = [ca.SX.sym("x", *np.atleast_2d(a.T).T.shape) for a in arguments]
    result = ca.Function("f", symbols, [function(*symbols)])(*arguments)  # type: ignore[operator]
    return np.squeeze(result.full())


@ALIKE
@given(twists)
def test_exp_is_the_matrix_exponential(x: Vector) -> None:
    assert lie.exp(x) == pytest.approx(expm(hat6(x)), abs=2e-15)


@ALIKE
@given(twists)
def test_log_undoes_exp(x: Vector) -> None:
    T = lie.exp(x)
    back = lie.log(T)
    angle = np.linalg.norm(x[3:])
    assert np.linalg.norm(back[3:]) <= np.pi + 1e-15
    # the rotation is recovered to rounding; its axis near pi only as far as the matrix knows it
    assert lie.exp(back) == pytest.approx(T, abs=1e-14)
    if angle < np.pi - 1e-5:
        assert back == pytest.approx(x, abs=2e-15 / (1 - angle / np.pi))


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), np.ones(3) / np.sqrt(3)])
def test_log_of_half_a_turn(axis: Vector) -> None:
    x = np.concatenate([[0.1, -0.2, 0.3], np.pi * axis])
    back = lie.log(lie.exp(x))
    assert np.linalg.norm(back[3:]) == pytest.approx(np.pi, rel=1e-15)
    assert np.abs(back[3:] @ axis) == pytest.approx(np.pi, rel=1e-15)
    assert lie.exp(back) == pytest.approx(lie.exp(x), abs=1e-15)


@ALIKE
@given(twists, twists)
def test_adjoint_by_its_identity(x: Vector, y: Vector) -> None:
    T = lie.exp(x)
    expected = T @ lie.exp(y) @ lie.inverse(T)
    assert lie.exp(lie.adjoint(T) @ y) == pytest.approx(expected, abs=4e-14)


@ALIKE
@given(twists, twists, twists)
def test_coadjoint_keeps_the_power(x: Vector, twist: Vector, wrench: Vector) -> None:
    T = lie.exp(x)
    power = (lie.coadjoint(T) @ wrench) @ (lie.adjoint(T) @ twist)
    assert power == pytest.approx(wrench @ twist, abs=1e-13)
    assert lie.coadjoint(T) == pytest.approx(np.linalg.inv(lie.adjoint(T)).T, abs=1e-13)


@ALIKE
@given(twists, twists)
def test_both_maps_compose_as_motions_do(x: Vector, y: Vector) -> None:
    A, B = lie.exp(x), lie.exp(y)
    for f in (lie.adjoint, lie.coadjoint):
        assert f(A @ B) == pytest.approx(f(A) @ f(B), abs=1e-13)
        assert f(lie.inverse(A)) == pytest.approx(np.linalg.inv(f(A)), abs=1e-13)
    assert lie.inverse(A) == pytest.approx(np.linalg.inv(A), abs=1e-14)


def test_adjoint_and_coadjoint_differ() -> None:
    """One moves the origin of a velocity, the other that of a moment."""
    T = lie.transform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    spin, force = np.array([0, 0, 0, 1.0, 0, 0]), np.array([1.0, 0, 0, 0, 0, 0])
    assert lie.adjoint(T) @ spin == pytest.approx([0, 2, 0, 1, 0, 0])  # v = p x omega
    assert lie.coadjoint(T) @ force == pytest.approx([1, 0, 0, 0, 2, 0])  # M = p x F


@ALIKE
@given(vectors, vectors)
def test_hat_and_vee(a: Vector, b: Vector) -> None:
    assert lie.hat(a) @ b == pytest.approx(np.cross(a, b), abs=1e-15)
    assert np.array_equal(lie.vee(lie.hat(a)), a)
    assert lie.vee(np.outer(a, b)) == pytest.approx(-np.cross(a, b) / 2, abs=1e-15)


@ALIKE
@given(turns)
def test_quaternions_against_scipy(w: Vector) -> None:
    rotation = Rotation.from_rotvec(w)
    R = rotation.as_matrix()
    q = lie.quaternion_from_rotation(R)
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=2e-15)
    expected = np.roll(rotation.as_quat(), 1)
    assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 2e-15
    assert lie.rotation_from_quaternion(q) == pytest.approx(R, abs=4e-15)
    turn = lie.rotation_vector_from_quaternion(q)
    assert Rotation.from_rotvec(turn).as_matrix() == pytest.approx(R, abs=4e-15)


@ALIKE
@given(turns, turns)
def test_quaternions_multiply_as_rotations_do(a: Vector, b: Vector) -> None:
    p, q = (lie.quaternion_from_rotation(Rotation.from_rotvec(w).as_matrix()) for w in (a, b))
    both = lie.rotation_from_quaternion(lie.quaternion_product(p, q))
    apart = lie.rotation_from_quaternion(p) @ lie.rotation_from_quaternion(q)
    assert both == pytest.approx(apart, abs=4e-15)


@settings(ALIKE, max_examples=25)
@given(twists, twists)
def test_casadi_and_numpy_agree(x: Vector, y: Vector) -> None:
    T = lie.exp(x)
    q, r = (lie.quaternion_from_rotation(lie.exp(z)[:3, :3]) for z in (x, y))
    cases = [
        (lie.exp, x),
        (lie.log, T),
        (lie.inverse, T),
        (lie.adjoint, T),
        (lie.coadjoint, T),
        (lie.hat, x[3:]),
        (lie.vee, T[:3, :3]),
        (lie.rotate_blocks, T[:3, :3]),
        (lie.quaternion_from_rotation, T[:3, :3]),
        (lie.rotation_from_quaternion, q),
        (lie.rotation_vector_from_quaternion, q),
        (lie.quaternion_product, q, r),
    ]
    for function, *arguments in cases:
        expected = function(*arguments)
        assert as_casadi(function, *arguments) == pytest.approx(expected, abs=2e-15)


def test_numbers_of_casadi_work_too() -> None:
    x = np.array([0.1, 0.2, -0.3, 0.4, -0.5, 0.6])
    assert lie.exp(ca.DM(x)).full() == pytest.approx(lie.exp(x), abs=1e-16)
    assert lie.log(lie.exp(ca.DM(x))).full()[:, 0] == pytest.approx(x, abs=1e-15)


# -- derivatives ----------------------------------------------------------------------------


def exact_coefficient(offset: int, order: int, x: Fraction) -> float:
    """Derivative of ``sum (-x)^k / (2 k + offset)!`` in exact arithmetic."""
    total = Fraction(0)
    for k in range(order, 60):
        falling = Fraction(factorial(k), factorial(k - order))
        total += (-1) ** k * falling * x ** (k - order) / factorial(2 * k + offset)
    return float(total)


@pytest.mark.parametrize(
    "x", ["0", "1e-30", "1e-12", "0.3", "0.999999", "1", "1.000001", "9", "39"]
)
def test_coefficients_and_their_derivatives_against_exact_series(x: str) -> None:
    symbol = ca.SX.sym("x")
    values = ca.vertcat(*lie.exponential_coefficients(symbol))
    for order, tolerance in enumerate((1e-15, 4e-15, 2e-14)):
        result = ca.Function("c", [symbol], [values])(float(x)).full()[:, 0]
        for offset, value in zip((1, 2, 3), result, strict=True):
            exact = exact_coefficient(offset, order, Fraction(x))
            assert value == pytest.approx(exact, abs=tolerance), (offset, order)
        values = ca.jacobian(values, symbol)


def derivatives(function: object, size: int) -> tuple[ca.Function, ca.Function]:
    """First and second derivatives (entries, size) and (entries * size, size)."""
    x = ca.SX.sym("x", size)
    J = ca.jacobian(ca.vec(function(x)), x)  # type: ignore[operator]
    return ca.Function("J", [x], [J]), ca.Function("H", [x], [ca.jacobian(ca.vec(J), x)])


def test_second_derivative_of_exp_at_zero_is_exact() -> None:
    """``exp(x^) = 1 + X + X X / 2``: the second derivative is the symmetric product."""
    _, second = derivatives(lie.exp, 6)
    H = second(np.zeros(6)).full().reshape(6, 16, 6)  # (j, entry, i), entries by columns
    for i in range(6):
        for j in range(6):
            A, B = hat6(np.eye(6)[i]), hat6(np.eye(6)[j])
            assert H[j, :, i] == pytest.approx(((A @ B + B @ A) / 2).T.ravel(), abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 1.0, 2.0, 3.1])
def test_derivatives_of_exp_and_log_against_finite_differences(angle: float) -> None:
    x = np.array([0.3, -0.2, 0.5, *(angle * np.array([2, -1, 2]) / 3)])
    for function in (lie.exp, lambda y: lie.log(lie.exp(y))):
        first, second = derivatives(function, 6)
        value = derivative(lambda y, f=function: np.ravel(f(y), order="F"), x, 1e-3)
        change = first(x).full()
        assert change == pytest.approx(value, abs=1e-10)
        H = derivative(lambda y, f=first: np.ravel(f(y).full(), order="F"), x, 1e-3)
        assert second(x).full() == pytest.approx(H, abs=1e-9)
    assert change == pytest.approx(np.eye(6), abs=1e-12 / (np.pi - angle))  # of log after exp
