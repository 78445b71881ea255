"""Formulas: what they return, what stays in their memory, and what they hand on."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from stiffopt.control.formula import Formula


def scaled() -> Formula:
    """A matrix (2, 3) times a number, and its row sums."""
    number, matrix = ca.SX.sym("number"), ca.SX.sym("matrix", 2, 3)
    return Formula([number, matrix], [number * matrix, number * ca.sum2(matrix)])


M = np.arange(6.0).reshape(2, 3)


def test_what_a_call_returns_belongs_to_the_caller() -> None:
    formula = scaled()
    product, sums = formula(2.0, M)
    formula(5.0, M)
    assert product.tolist() == (2 * M).tolist()
    assert sums.tolist() == [6.0, 24.0]


def test_a_view_is_overwritten_by_the_next_call() -> None:
    formula = scaled()
    product, _ = formula.view(2.0, M)
    assert product.tolist() == (2 * M).tolist()
    formula.view(5.0, M)
    assert product.tolist() == (5 * M).tolist()


def test_again_keeps_all_arguments_but_the_first() -> None:
    formula = scaled()
    formula.view(2.0, M)
    product, _ = formula.again(3.0)
    assert product.tolist() == (3 * M).tolist()


def test_a_formula_reads_the_outputs_of_the_one_before() -> None:
    first, product, sums = scaled(), ca.SX.sym("product", 2, 3), ca.SX.sym("sums", 2)
    factor = ca.SX.sym("factor", 3)
    second = Formula([product, sums, factor], [product @ factor - sums], before=first)
    for number in (1.0, -4.0):
        first.view(number, M)
        (found,) = second(np.array([1.0, 2.0, 3.0]))
        assert found == pytest.approx(number * (M @ [1, 2, 3] - M.sum(axis=1)))
