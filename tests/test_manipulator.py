"""Manipulator: shapes and batches, stiffness by its definitions, and the paper's load formulas."""

import itertools

import numpy as np
import pytest

import stiffopt as so
from independent.arms import ARMS
from independent.elements import discretise
from independent.motions import derivative, hat, wrench_map

FREE = so.load_robot("stiff-flop-2")
ROBOTS = {
    "free": FREE,
    "mixed": so.Manipulator(so.RobotDescription(**ARMS["3 segments, mixed"].mapping())),
    "hanging": so.load_robot("stiff-flop-2-hanging"),
    "loaded": FREE.with_load((0.01, -0.02, 0.03), (1e-4, 0, 2e-4), "tip"),
}
D = np.array([0.3, -0.7, 0.4])
METHODS = {
    "tip_pose": lambda arm, p: arm.tip_pose(p),
    "tip_jacobian": lambda arm, p: arm.tip_jacobian(p),
    "tip_jacobian_derivative": lambda arm, p: arm.tip_jacobian_derivative(p),
    "backbone": lambda arm, p: arm.backbone(p, 4),
    "pose": lambda arm, p: arm.pose(p, 0.05),
    "tip_compliance": lambda arm, p: arm.tip_compliance(p),
    "compliance": lambda arm, p: arm.compliance(p, 0.05),
    "stiffness": lambda arm, p: arm.stiffness(p, D),
    "stiffness at": lambda arm, p: arm.stiffness(p, D, at=0.05),
    "stiffness_gradient": lambda arm, p: arm.stiffness_gradient(p, D, boundary="clamped"),
}


def shape_of(method, n):
    return {
        "tip_pose": (4, 4),
        "tip_jacobian": (6, n),
        "tip_jacobian_derivative": (6, n, n),
        "backbone": (4, 4, 4),
        "pose": (4, 4),
        "tip_compliance": (6, 6),
        "compliance": (6, 6),
        "stiffness": (),
        "stiffness at": (),
        "stiffness_gradient": (n,),
    }[method]


def batch(arm, count=2, seed=0):
    return np.random.default_rng(seed).uniform(0.1e5, 0.9e5, (count, arm.n_pressures))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("method", METHODS)
def test_single_batch_and_empty(name, method):
    arm, call = ROBOTS[name], METHODS[method]
    ps, shape = batch(arm), shape_of(method, arm.n_pressures)
    together = call(arm, ps)
    assert together.shape == (2, *shape)
    for p, value in zip(ps, together, strict=True):
        single = call(arm, p)
        assert np.shape(single) == shape
        assert single == pytest.approx(value, rel=1e-9, abs=1e-12 * np.abs(value).max())
    empty = call(arm, np.zeros((0, arm.n_pressures)))
    assert empty.shape == (0, *shape)
    assert empty.dtype == float


@pytest.mark.parametrize("name", ROBOTS)
def test_the_backbone_runs_from_the_base_to_the_tip(name):
    arm = ROBOTS[name]
    p = batch(arm)[0]
    line = arm.backbone(p, 7)
    assert line[0] == pytest.approx(np.eye(4), abs=1e-9)
    assert line[-1] == pytest.approx(arm.tip_pose(p), abs=1e-9)
    for T, at in zip(line[1:], np.linspace(0, arm.length, 7)[1:], strict=True):
        assert arm.pose(p, at) == pytest.approx(T, abs=1e-6)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_end_of_the_arm_is_the_tip(name):
    arm = ROBOTS[name]
    p = batch(arm)[0]
    assert np.array_equal(arm.compliance(p, arm.length), arm.tip_compliance(p))
    assert arm.stiffness(p, D, at=arm.length) == arm.stiffness(p, D)
    assert arm.pose(p, arm.length) == pytest.approx(arm.tip_pose(p), abs=1e-9)


def defined_stiffness(C, R, kind, boundary, frame):
    """Stiffness along D from compliance and axes of the point, literally."""
    d = D / np.linalg.norm(D)
    if frame == "base":
        d = R.T @ d
    own = slice(0, 3) if kind == "translation" else slice(3, 6)
    if boundary == "free":
        return 1 / (d @ C[own, own] @ d)
    if boundary == "guided":
        return d @ np.linalg.inv(C[own, own]) @ d
    return d @ np.linalg.inv(C)[own, own] @ d


VARIANTS = list(
    itertools.product(("translation", "rotation"), ("free", "guided", "clamped"), ("base", "tip"))
)


@pytest.mark.one_in(3, "name", "kind")
@pytest.mark.parametrize(("kind", "boundary", "frame"), VARIANTS)
@pytest.mark.parametrize("name", ["free", "mixed", "hanging"])
def test_stiffness_by_its_definition(name, kind, boundary, frame):
    arm = ROBOTS[name]
    p = batch(arm)[0]
    tolerance = 1e-4 if arm.is_loaded else 1e-8  # the tangent is symmetric to the integrator's
    k = arm.stiffness(p, D, kind, boundary, frame)
    C, R = arm.tip_compliance(p), arm.tip_pose(p)[:3, :3]
    assert k == pytest.approx(defined_stiffness(C, R, kind, boundary, frame), rel=tolerance)
    k_at = arm.stiffness(p, D, kind, boundary, frame, at=0.07)
    C, R = arm.compliance(p, 0.07), arm.pose(p, 0.07)[:3, :3]
    assert k_at == pytest.approx(defined_stiffness(C, R, kind, boundary, frame), rel=tolerance)
    assert arm.stiffness(p, -5 * D, kind, boundary, frame) == pytest.approx(k, rel=1e-12)


@pytest.mark.parametrize(("kind", "boundary", "frame"), VARIANTS)
@pytest.mark.parametrize("name", ["free", "mixed"])
def test_stiffness_gradient_of_every_kind(name, kind, boundary, frame):
    arm = ROBOTS[name]
    p = batch(arm)[0]
    expected = derivative(lambda q: arm.stiffness(q, D, kind, boundary, frame), p, 50.0)
    found = arm.stiffness_gradient(p, D, kind, boundary, frame)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["2 segments", "3 segments, mixed"])
def test_the_strain_energy_of_a_unit_load(name):
    """The directional compliance is that of the 6x6 matrix, here and by sums over elements."""
    other = ARMS[name]
    arm = so.Manipulator(so.RobotDescription(**other.mapping()))
    p = batch(arm)[0]
    C, R = arm.tip_compliance(p), arm.tip_pose(p)[:3, :3]
    sums = discretise(other, p, 200)
    d = D / np.linalg.norm(D)
    for kind, block in (("translation", slice(0, 3)), ("rotation", slice(3, 6))):
        for frame, local in (("tip", d), ("base", R.T @ d)):
            k = arm.stiffness(p, D, kind, frame=frame)
            assert 1 / k == pytest.approx(local @ C[block, block] @ local, rel=1e-9)
            assert 1 / k == pytest.approx(local @ sums.compliance[block, block] @ local, rel=1e-4)


@pytest.mark.parametrize("name", ["mixed", "hanging"])
@pytest.mark.parametrize("boundary", ["free", "clamped"])
def test_several_directions(name, boundary):
    arm = ROBOTS[name]
    ps, directions = batch(arm), [[1, 0, 0], [0, 2, 0], [0.5, -1, 0.3]]
    expected = [arm.stiffness(ps, d, boundary=boundary) for d in directions]  # k of (N,)
    assert np.array_equal(arm.stiffness(ps, directions, boundary=boundary), np.transpose(expected))
    single = arm.stiffness(ps[0], np.array(directions), boundary=boundary)
    assert single == pytest.approx(np.array(expected)[:, 0], rel=1e-9)
    for wrong in ([], [[1, 0]], [[1, 0, 0], [0, 1]], [[0, 0, 0]], [[[1, 0, 0]]]):
        with pytest.raises(so.InputError, match="direction"):
            arm.stiffness(ps, wrong)


def test_a_remembered_direction_is_checked_as_any_other():
    p = batch(FREE)[0]
    k = FREE.stiffness(p, [1, 0, 0])
    assert FREE.stiffness(p, np.array([1.0, 0, 0])) == FREE.stiffness(p, (2.0, 0, 0)) == k
    for wrong in (["1", 0, 0], [1, 0, 0, 0], [np.nan, 0, 0], None):
        with pytest.raises(so.InputError, match="direction"):
            FREE.stiffness(p, wrong)
    with pytest.raises(so.InputError, match="unknown kind"):
        FREE.stiffness(p, [1, 0, 0], ["translation"])


def test_results_are_the_callers_own():
    p = batch(FREE)[0]
    first = FREE.tip_pose(p)
    first[:] = 0
    p[:] = 0
    assert FREE.tip_pose(batch(FREE)[0])[3, 3] == 1


@pytest.mark.parametrize("name", ["free", "mixed", "hanging"])
def test_held_tips_are_stiffer(name):
    arm = ROBOTS[name]
    p = batch(arm)[1]
    for kind in ("translation", "rotation"):
        free, guided, clamped = (
            arm.stiffness(p, D, kind, boundary) for boundary in ("free", "guided", "clamped")
        )
        assert 0 < free < guided < clamped


@pytest.mark.parametrize("name", ROBOTS)
def test_tip_twist_and_deflection(name):
    arm = ROBOTS[name]
    p = batch(arm)[0]
    J, C, T = arm.tip_jacobian(p), arm.tip_compliance(p), arm.tip_pose(p)
    for channel in range(arm.n_pressures):
        assert np.array_equal(arm.tip_twist(p, channel).coordinates, J[:, channel])
    W = np.array([0.01, 0.02, -0.03, 1e-3, 0, 2e-3])
    twist = arm.deflection(p, W, frame="tip")
    assert twist.coordinates == pytest.approx(C @ W, rel=1e-12)
    v, omega = (C @ W)[:3], (C @ W)[3:]
    assert np.cross(twist.axis_direction, omega) == pytest.approx(np.zeros(3), abs=1e-12)
    along = v + np.cross(omega, twist.axis_point)  # velocity of a point of the axis
    assert along == pytest.approx(twist.pitch * omega, abs=1e-12)
    R = T[:3, :3]
    local = np.concatenate([R.T @ W[:3], R.T @ W[3:]])
    assert arm.deflection(p, so.Wrench(W)).coordinates == pytest.approx(C @ local, rel=1e-9)


@pytest.mark.parametrize("name", ["free", "mixed", "hanging"])
@pytest.mark.parametrize("share", [0, 0.3, 0.8, 1])
def test_the_internal_wrench_balances_the_load(name, share):
    """Equation 11, with the force and the moment taken about the section by hand."""
    arm = ROBOTS[name]
    p, at = batch(arm)[0], share * arm.length
    F, M = np.array([0.1, -0.2, 0.3]), np.array([1e-3, 2e-3, -1e-3])
    tip = arm.tip_pose(p)
    section = np.eye(4) if share == 0 else arm.pose(p, at)
    R = section[:3, :3]
    about = M + hat(tip[:3, 3] - section[:3, 3]) @ F
    found = arm.internal_wrench(p, np.concatenate([F, M]), at)
    assert found.force == pytest.approx(R.T @ F, abs=1e-9)
    assert found.moment == pytest.approx(R.T @ about, abs=1e-9)
    W = np.concatenate([F, M])
    local = arm.internal_wrench(p, W, at, frame="tip")
    assert local.coordinates == pytest.approx(
        wrench_map(np.linalg.inv(section) @ tip) @ W, abs=1e-9
    )


@pytest.mark.parametrize("frame", ["base", "tip"])
@pytest.mark.parametrize("at", [None, 0.12])
@pytest.mark.parametrize("method", ["equilibrium", "elementwise"])
def test_load_formulas_agree_to_first_order(method, at, frame):
    """Half the load leaves a quarter of the difference of eqs 18 and 19 and the equilibrium."""
    p = batch(FREE)[0]
    W = np.array([4e-3, -3e-3, 5e-3, 1e-4, 2e-4, -1e-4])

    def difference(share):
        one, other = (
            FREE.loaded_tip_pose(p, share * W, at, frame, each) for each in (method, "first-order")
        )
        return np.linalg.norm(one[:3, 3] - other[:3, 3])

    moved = FREE.loaded_tip_pose(p, W, at, frame, "first-order") - FREE.tip_pose(p)
    assert np.linalg.norm(moved[:3, 3]) > 1e-3
    assert difference(1) < 0.3 * np.linalg.norm(moved[:3, 3])
    assert difference(1) / difference(0.5) == pytest.approx(4, abs=0.4)
    assert difference(0.5) / difference(0.25) == pytest.approx(4, abs=0.3)


def test_elementwise_is_refused_on_a_loaded_arm():
    arm = ROBOTS["hanging"]
    with pytest.raises(so.InputError, match="is for the arm without gravity and load"):
        arm.loaded_tip_pose(batch(arm)[0], np.zeros(6), method="elementwise")


def test_a_load_on_the_arm_is_a_load_in_the_call():
    p = batch(FREE)[0]
    F, M = (0.01, -0.02, 0.01), (1e-4, 0, 1e-4)
    for frame in ("base", "tip"):
        expected = FREE.loaded_tip_pose(p, (*F, *M), frame=frame)
        T = FREE.with_load(F, M, frame).tip_pose(p)
        assert T.ravel() == pytest.approx(expected.ravel(), abs=1e-7)
        built = so.Manipulator(FREE.description, force=F, moment=M, load_frame=frame)
        assert built.tip_pose(p) == pytest.approx(T, abs=1e-12)


def test_a_finer_resolution_changes_little():
    fine = so.load_robot("stiff-flop-2-hanging", resolution=2)
    p = batch(fine)[0]
    assert fine.tip_pose(p) == pytest.approx(ROBOTS["hanging"].tip_pose(p), abs=1e-5)


def test_a_batch_with_one_bad_row_is_refused():
    ps = batch(FREE)
    ps[1] = 4e5
    with pytest.raises(so.PressureError, match="segment 1 of robot 'stiff-flop-2' at"):
        FREE.tip_pose(ps)
