"""What every strain law keeps: its range, smoothness, symmetry and sense."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from independent.arms import ARMS, FLOP, Tube
from stiffopt.errors import InputError
from stiffopt.model.laws import strain_law, strain_laws
from tested_laws import (
    LAWS,
    TUBES,
    function_of,
    law_of,
    segment_of,
    some_pressures,
    strain_and_compliance,
)


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


@pytest.mark.parametrize("law", LAWS)
def test_the_margin_ends_where_the_modulus_does(law: str) -> None:
    segment = segment_of(LAWS[law](FLOP), modulus_per_pressure=-0.5)  # 100 kPa, gone at 2 bar
    for share, sign in ((0.0, 1), (0.998, 1), (0.9995, -1), (1.2, -1)):
        *_, margin = function_of(segment)(share * 2e5 * np.array([2, 2, 1]) / 3)
        assert np.sign(float(margin)) == sign
