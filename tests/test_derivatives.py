"""First and second derivatives by the pressures against finite differences."""

import numpy as np
import pytest

import stiffopt as so
from conftest import is_long
from independent.motions import body_twists, derivative

ROBOTS = ["stiff-flop-1", "stiff-flop-3", "stiff-flop-2-hanging"]


def robots():
    for name in ROBOTS:
        yield pytest.param(so.load_robot(name), id=name)
    arm = so.load_robot("stiff-flop-2" if is_long() else "stiff-flop-1")
    yield pytest.param(arm.with_load((0.02, -0.01, 0.03), (1e-3, 0, 0)), id="dead load")
    yield pytest.param(arm.with_load((0.02, -0.01, 0.03), (1e-3, 0, 0), "tip"), id="follower")


ARMS = list(robots())  # once: their functions serve all tests


def points(n):
    rng = np.random.default_rng(1)
    return {
        "in general": rng.uniform(0.1e5, 1.3e5, n),
        "equal pressures": np.full(n, 0.7e5),  # straight
        "near zero": np.full(n, 50.0) + np.arange(n),
    }


@pytest.mark.one_in(3)
@pytest.mark.parametrize("where", ["in general", "equal pressures", "near zero"])
@pytest.mark.parametrize("arm", ARMS)
def test_first_derivative_of_the_pose(arm, where):
    p = points(arm.n_pressures)[where]
    step = 5.0 if where == "near zero" else 200.0
    expected = body_twists(arm.tip_pose(p), derivative(arm.tip_pose, p, step))
    J = arm.tip_jacobian(p)
    for half in (slice(0, 3), slice(3, 6)):
        assert J[half] == pytest.approx(expected[half], abs=2e-7 * np.abs(expected[half]).max())


@pytest.mark.one_in(3)
@pytest.mark.parametrize("where", ["in general", "equal pressures", "near zero"])
@pytest.mark.parametrize("arm", ARMS)
def test_second_derivative_of_the_pose(arm, where):
    p = points(arm.n_pressures)[where]
    step = 2.0 if where == "near zero" else 200.0
    expected = derivative(arm.tip_jacobian, p, step)
    H = arm.tip_jacobian_derivative(p)
    assert H.shape == (6, arm.n_pressures, arm.n_pressures)
    for half in (slice(0, 3), slice(3, 6)):
        assert H[half] == pytest.approx(expected[half], abs=1e-5 * np.abs(expected[half]).max())


@pytest.mark.one_in(3, "arm", "where", "kind")
@pytest.mark.parametrize("where", ["in general", "equal pressures"])
@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("kind", "boundary", "frame"),
    [
        ("translation", "free", "base"),
        ("translation", "clamped", "tip"),
        ("rotation", "guided", "base"),
    ],
)
def test_first_derivative_of_the_stiffness(arm, where, kind, boundary, frame):
    p = points(arm.n_pressures)[where]
    measure = ((0.3, -0.5, 0.8), kind, boundary, frame)
    expected = derivative(lambda x: arm.stiffness(x, *measure), p, 200.0)
    gradient = arm.stiffness_gradient(p, *measure)
    assert gradient == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
def test_at_exactly_no_pressure_the_pose_has_a_value_and_a_first_derivative(name):
    arm = so.load_robot(name)
    zero = np.zeros(arm.n_pressures)
    assert arm.tip_pose(zero)[:2, 3] == pytest.approx([0, 0], abs=1e-12)
    J = arm.tip_jacobian(zero)
    assert np.isfinite(J).all()
    one_sided = []
    for e in np.eye(arm.n_pressures):
        one_sided.append((arm.tip_pose(2 * e)[:3, 3] - arm.tip_pose(zero)[:3, 3]) / 2)
    # under weight the norm law's cone shows in the pose too: the softer arm hangs lower
    rows = 2 if arm.is_loaded else 3
    expected = np.array(one_sided).T[:rows]
    assert J[:rows] == pytest.approx(expected, abs=1e-4 * np.abs(J[:3]).max())
    assert np.isfinite(arm.tip_compliance(zero)).all()
