"""Principal axes against LAPACK, also where compliances are equal, or differ by many decades."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.control.formula import Formula
from stiffopt.control.principal import principal_axes

Array = NDArray[np.float64]

MATRIX = ca.SX.sym("matrix", 3, 3)
FORMULA = Formula([MATRIX], principal_axes(MATRIX))
VALUES = {
    "different": (0.2, 3.0, 1.0),
    "a hanging arm's": (2e-4, 7.0, 7.0),
    "nearly equal": (1.0, 1.0 + 1e-13, 1.0 + 1e-7),
    "equal": (2.0, 2.0, 2.0),
    "decades apart": (1e-9, 4e-3, 1e3),
    "none": (0.0, 0.0, 0.0),
}


def check(matrix: Array) -> None:
    values, axes = FORMULA(matrix)
    size = max(float(np.abs(matrix).max()), 1e-300)
    assert np.all(np.diff(values) >= 0)
    assert values == pytest.approx(np.linalg.eigvalsh(matrix), abs=1e-14 * size)
    assert axes.T @ axes == pytest.approx(np.eye(3), abs=1e-14)
    assert axes * values @ axes.T == pytest.approx(matrix, abs=1e-14 * size)


@pytest.mark.parametrize("name", VALUES)
def test_values_and_axes_are_those_of_the_matrix(name: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix = turn * np.array(VALUES[name]) @ turn.T
        check((matrix + matrix.T) / 2)


def test_a_matrix_may_be_diagonal_already() -> None:
    for values in VALUES.values():
        for order in ([0, 1, 2], [1, 2, 0], [2, 1, 0]):
            check(np.diag(np.array(values)[order]))
