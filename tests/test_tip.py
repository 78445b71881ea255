"""The tip for control loops against the model, and against finite differences."""

import threading

import numpy as np
import pytest

import stiffopt as so
from independent.arms import ARMS, CROSS, FLOP, LOPSIDED, Arm, neo_hookean
from stiffopt import lie
from stiffopt.errors import EquilibriumError, PressureError
from stiffopt.optimise.tip import TipModel

HANGING = (0.0, 0.0, 9.81)
DEAD = {"force": (0.02, -0.03, 0.05), "moment": (1e-3, 0, 5e-4)}
FOLLOWER = {"force": (0.02, 0.01, 0.02), "frame": "tip"}

CASES = {
    "free, 1 segment": (Arm((FLOP,)), None),
    "free, 3 segments, connectors": (ARMS["3 segments, mixed"], None),
    "hanging": (Arm((FLOP, FLOP)).under(HANGING, 0.02), None),
    "hanging, neo-Hookean": (Arm((neo_hookean(FLOP),)).under(HANGING, 0.01), None),
    "dead load": (Arm((FLOP, FLOP)), DEAD),
    "follower": (Arm((FLOP,)).under((3, 0, 9), 0.01), FOLLOWER),
    "2 kinds, connectors, tilted, load": (
        Arm((LOPSIDED, CROSS)).under((2, 1, 9), 0.01),
        {"force": (0.01, 0.01, 0.0)},
    ),
    "more kinds of sections than fit": (ARMS["5 segments, mixed"].under(HANGING), None),
    "3 segments, connectors, tilted, load": (
        ARMS["3 segments, mixed"].under((2, 1, 9), 0.01),
        {"force": (0.01, 0.01, 0.0)},
    ),
}


def robot(case):
    arm, load = CASES[case]
    free = so.Manipulator(so.RobotDescription(**arm.mapping()))
    return free.with_load(**load) if load else free


def scaled_difference(found, expected):
    """Largest difference, as a share of the largest entry of linear and of angular rows."""
    return max(
        np.abs(found[rows] - expected[rows]).max() / np.abs(expected[rows]).max()
        for rows in (slice(0, 3), slice(3, None))
    )


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.long] if k % 2 or k == 8 else [])
        for k, case in enumerate(CASES)
    ],
)
def test_is_that_of_the_model(case, compiled):
    model = robot(case)
    tip = TipModel(model)
    assert tip.is_fast == (case != "more kinds of sections than fit")
    rng = np.random.default_rng(3)
    for _ in range(3):  # each far from the one before
        p = rng.uniform(0.0, 0.7e5, model.n_pressures)
        for _ in range(2):
            found = tip.at(p)
            expected = model.tip_pose(p), model.tip_jacobian(p), model.tip_compliance(p)
            for name, value, wanted in zip(found._fields, found, expected, strict=True):
                assert scaled_difference(value, wanted) < 1e-8, name
            p = p + rng.uniform(-500, 500, len(p))


@pytest.mark.parametrize(
    "case",
    [
        *("hanging", "2 kinds, connectors, tilted, load"),
        pytest.param("3 segments, connectors, tilted, load", marks=pytest.mark.long),
    ],
)
def test_jacobian_is_the_derivative_of_the_pose(case, compiled):
    model = robot(case)
    tip = TipModel(model)
    p = np.random.default_rng(1).uniform(0.1e5, 0.6e5, model.n_pressures)
    here = tip.at(p)
    columns = []
    for step in 50.0 * np.eye(model.n_pressures):
        ahead, behind = tip.at(p + step).pose, tip.at(p - step).pose
        columns.append(lie.log(lie.inverse(behind) @ ahead) / 100.0)
    # the integrator's own error, of micrometres, has no place in the derivative
    assert scaled_difference(np.array(columns).T, here.jacobian) < 1e-5


def test_compliance_is_the_derivative_by_a_load(compiled):
    model = robot("hanging")
    p = np.array([0.4, 0.9, 0.1, 0.8, 0.1, 0.5]) * 1e5
    here = TipModel(model).at(p)
    R = here.pose[:3, :3]
    for k in range(3):
        force = 1e-4 * R[:, k]  # along an axis of the tip
        ahead, behind = (TipModel(model.with_load(sign * force)).at(p).pose for sign in (1, -1))
        moved = lie.log(lie.inverse(behind) @ ahead) / 2e-4
        assert moved == pytest.approx(here.compliance[:, k], rel=1e-4, abs=1e-6)


def test_results_belong_to_the_caller(compiled):
    for case in ("hanging", "free, 1 segment"):
        model = robot(case)
        tip = TipModel(model)
        first = tip.at(np.full(model.n_pressures, 0.2e5))
        kept = [value.copy() for value in first]
        tip.at(np.linspace(0, 0.5e5, model.n_pressures))
        for value, before in zip(first, kept, strict=True):
            np.testing.assert_array_equal(value, before)


def test_without_a_compiler_it_is_the_model():
    model = robot("hanging")
    tip = TipModel(model)
    assert not tip.is_fast
    p = np.linspace(0, 0.5e5, 6)
    np.testing.assert_array_equal(tip.at(p).pose, model.tip_pose(p))


@pytest.mark.parametrize("case", ["hanging", "free, 1 segment"])
def test_refuses_pressures_that_are_none(case, compiled):
    model = robot(case)
    tip = TipModel(model)
    n = model.n_pressures
    for wrong in (np.zeros(n + 1), np.zeros((2, n)), np.full(n, np.nan), "high", 0.0):
        with pytest.raises(PressureError):
            tip.at(wrong)


def test_refuses_pressures_beyond_the_law(compiled):
    for gravity in ((0, 0, 0), HANGING):
        arm = Arm((neo_hookean(FLOP),), highest=0.2e5).under(gravity, 0.0)
        model = so.Manipulator(so.RobotDescription(**arm.mapping()))
        tip = TipModel(model)
        with pytest.raises(PressureError, match="segment 1"):
            tip.at(np.full(3, -50e5))
        p = np.array([0.1e5, 0, 0])
        assert tip.at(p).pose == pytest.approx(model.tip_pose(p), rel=1e-8)


def test_says_when_there_is_no_equilibrium_and_goes_on(compiled):
    model = so.load_robot("stiff-flop-2-hanging").with_load((0.0, 0.0, -2.0))
    with pytest.raises(EquilibriumError):
        model.tip_pose(np.zeros(6))
    tip = TipModel(model)
    with pytest.raises(EquilibriumError, match="bar"):
        tip.at(np.zeros(6))
    mild = model.with_load((0.0, 0.0, -0.05))
    tip, p = TipModel(mild), np.full(6, 0.2e5)
    assert tip.at(p).pose == pytest.approx(mild.tip_pose(p), abs=1e-9)


def test_pressures_without_an_equilibrium_do_not_lose_the_branch(compiled):
    description = so.load_robot("stiff-flop-2-hanging").description
    segments = []
    for segment in description.segments:
        modulus = 0.6 * segment.material.youngs_modulus
        soft = segment.material.model_copy(update={"youngs_modulus": modulus})
        segments.append(segment.model_copy(update={"material": soft}))
    tip = TipModel(so.Manipulator(description.model_copy(update={"segments": tuple(segments)})))
    tip.at(np.full(6, 0.2e5))
    followed = tip._code._state.copy()
    with pytest.raises(EquilibriumError):
        tip.at(np.array([1.43e5, 1.07e5, 1.37e5, 1.41e5, 1.2e5, 0.18e5]))
    assert np.isfinite(followed).all()
    assert (tip._code._state == followed).all()


def test_falls_over_at_rest(compiled):
    arm = Arm((FLOP, FLOP)).under((0.0, 0.0, -9.81), 0.3)
    with pytest.raises(EquilibriumError, match="falls over"):
        TipModel(so.Manipulator(so.RobotDescription(**arm.mapping())))


def test_copies_serve_threads_of_their_own(compiled):
    model = robot("hanging")
    tip = TipModel(model)
    walks = np.random.default_rng(2).uniform(0, 0.6e5, (4, 50, 6))
    expected = [[tip.at(p).pose for p in walk] for walk in walks]
    found = [[] for _ in walks]
    copies = [tip.copy() for _ in walks]

    def work(k):
        found[k] = [copies[k].at(p).pose for p in walks[k]]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(walks))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_allclose(found, expected, atol=1e-9)
