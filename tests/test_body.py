"""Stations along the arm against finite differences and an independent integration."""

import ctypes
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import stiffopt as so
from independent.arms import ARMS, FLOP, Arm, neo_hookean
from independent.motions import hat, wrench_map
from independent.rods import Load, rod_tip
from independent.sections import rod_section
from stiffopt import lie
from stiffopt.errors import EquilibriumError, InputError, PressureError
from stiffopt.model import body

HANGING = (0.0, 0.0, 9.81)
TILTED = (2.0, 1.0, 9.0)
WOUND = Arm((replace(neo_hookean(FLOP), connector=0.01), neo_hookean(FLOP)))
CASES = {
    "2 segments": (ARMS["2 segments"], None),
    "mixed": (ARMS["3 segments, mixed"], None),
    "neo-Hookean": (WOUND, None),
    "rest length": (Arm((replace(FLOP, law="rest-length"),)), None),
    "hanging": (Arm((FLOP, FLOP)).under(HANGING, 0.02), None),
    "hanging, mixed": (ARMS["3 segments, mixed"].under(TILTED, 0.01), None),
    "hanging, neo-Hookean": (WOUND.under(HANGING, 0.01), None),
    "follower": (Arm((FLOP,)).under(TILTED, 0.01), {"force": (0.02, 0.01, 0), "frame": "tip"}),
}
FREE = ["2 segments", "mixed", "neo-Hookean"]
INDEPENDENT_LOADED = ["hanging, mixed", "hanging, neo-Hookean"]


def made(case, **options):
    arm, load = CASES[case]
    free = so.Manipulator(so.RobotDescription(**arm.mapping()), **options)
    return free.with_load(**load) if load else free


robot = cache(made)


def pressures(model, seed=1, highest=0.7e5):
    return np.random.default_rng(seed).uniform(0.0, highest, model.n_pressures)


def stations(model, count=5):
    """In segments, in connectors, on joints and at both ends."""
    ends = np.cumsum([x for s in model.description.segments for x in (s.length, s.connector)])
    inside = np.random.default_rng(0).uniform(0.1, 0.9, count) * model.length
    return np.unique(np.round(np.concatenate([inside, ends, [ends[0] - 1e-3]]), 12))


def body_twists(T, change):
    """Twist of each pose in its own axes from the derivative of the pose."""
    found = []
    for pose, slope in zip(T, change, strict=True):
        R = pose[:3, :3]
        found.append(np.concatenate([R.T @ slope[:3, 3], lie.vee(R.T @ slope[:3, :3])]))
    return np.array(found)


def assert_close(found, expected, share):
    """Linear and angular rows, each by its largest entry."""
    for rows in (np.s_[..., :3, :], np.s_[..., 3:, :]):
        scale = np.abs(expected[rows]).max()
        assert np.abs(found[rows] - expected[rows]).max() <= share * scale


@pytest.mark.one_in(2)
@pytest.mark.parametrize("case", [*FREE, *INDEPENDENT_LOADED])
def test_poses_are_those_of_an_independent_integration(case):
    model, (arm, _) = robot(case), CASES[case]
    p, at = pressures(model, highest=2e4), stations(model, 4)
    at = at[1::4] if model.is_loaded else at
    for s, T in zip(at, model.pose(p, at), strict=True):
        assert pytest.approx(rod_tip(arm, p, steps=1, at=s), abs=5e-7) == T


def test_between_steps_poses_are_nearly_as_exact_as_at_their_ends():
    """A well bent arm in equilibrium on three times as many steps."""
    coarse, fine = robot("hanging"), robot("hanging", resolution=3)
    p = pressures(coarse, highest=1.4e5)
    off = np.abs(coarse.backbone(p, 61) - fine.backbone(p, 61))
    assert off[:, :3, 3].max() < 4e-7
    assert off[:, :3, :3].max() < 1e-5


@pytest.mark.one_in(2)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("size", [0.7e5, 0.0])
def test_jacobians_are_derivatives_of_poses(case, size):
    model = robot(case)
    p, at = pressures(model, highest=size), stations(model, 2)
    T, J = model.pose(p, at), model.body_jacobian(p, at)
    step = 20.0  # so small because of the rounded cone at p = 0
    for k in (0, len(p) - 2):
        by = step * np.eye(len(p))[k]
        change = (model.pose(p + by, at) - model.pose(p - by, at)) / (2 * step)
        assert_close(J[:, :, k, None], body_twists(T, change)[..., None], 1e-4 if size else 3e-4)


@pytest.mark.parametrize("case", CASES)
def test_ends_are_the_tip_and_the_base(case):
    model = robot(case)
    p, L = pressures(model), model.length
    assert model.pose(p, L) == pytest.approx(model.tip_pose(p), abs=1e-12)
    assert_close(model.body_jacobian(p, L), model.tip_jacobian(p), 1e-9)
    assert np.abs(model.body_jacobian(p, 0.0)).max() < 1e-18
    assert model.backbone(p, 3)[0] == pytest.approx(np.eye(4), abs=1e-12)
    assert np.abs(model.compliance_between(p, 0.0, L)).max() < 1e-10
    R = model.tip_pose(p)[:3, :3]
    X = np.kron(np.eye(2), R)
    assert_close(model.compliance_between(p, L, L), X @ model.tip_compliance(p) @ X.T, 2e-5)


@pytest.mark.parametrize("case", FREE)
def test_free_compliances_are_integrals_of_the_sections(case):
    model, (arm, _) = robot(case), CASES[case]
    p, (s, t) = pressures(model), (0.4 * model.length, 0.8 * model.length)
    expected = np.zeros((6, 6))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    far = {at: rod_tip(arm, p, steps=1, at=at)[:3, 3] for at in (s, t)}
    start = 0.0
    for tube, own in zip(arm.tubes, arm.split(p), strict=True):
        end = min(start + tube.length, s)
        law, half = rod_section(tube, own, (0, 0, 0)), (end - start) / 2
        for node, weight in zip(nodes, weights, strict=True) if half > 0 else ():
            T = rod_tip(arm, p, steps=1, at=start + half * (1 + node))
            X_s, X_t = (wrench_map(T.copy()) for _ in range(2))
            for X, at in ((X_s, s), (X_t, t)):
                away = far[at] - T[:3, 3]
                X[3:, :3] = -hat(away) @ T[:3, :3]  # a wrench here as one at the station
            own_twist = np.linalg.inv(X_s).T @ law.compliance @ np.linalg.inv(X_t)
            expected += weight * half * own_twist
        start += tube.length + tube.connector
    assert_close(model.compliance_between(p, s, t), expected, 1e-7)


@pytest.mark.parametrize("case", INDEPENDENT_LOADED)
def test_loaded_compliances_are_differences_of_independent_equilibria(case):
    model, (arm, _) = robot(case), CASES[case]
    p, L = pressures(model, highest=2e4), model.length
    wrench = np.array([2e-3, -1e-3, 3e-3, 1e-4, 2e-4, -1e-4])
    for s, t in ((0.3 * L, 0.7 * L), (0.9 * L, 0.5 * L)):
        T = model.pose(p, s)
        more, less = (
            rod_tip(arm, p, [Load(sign * wrench[:3], sign * wrench[3:], at=t)], steps=1, at=s)
            for sign in (1, -1)
        )
        change = (more - less) / 2
        twist = np.concatenate([change[:3, 3], lie.vee(change[:3, :3] @ T[:3, :3].T)])
        assert_close((model.compliance_between(p, s, t) @ wrench)[:, None], twist[:, None], 1e-4)


@pytest.mark.parametrize("case", ["mixed", "hanging"])
def test_compliances_are_reciprocal(case):
    model = robot(case)
    p, at = pressures(model), stations(model)
    s, t = (grid.ravel() for grid in np.meshgrid(at, at))
    C = model.compliance_between(p, s, t)
    back = np.swapaxes(model.compliance_between(p, t, s), -1, -2)
    assert_close(C, back, 1e-5 if model.is_loaded else 1e-12)


def test_the_radius_is_what_the_law_says():
    model, at = robot("neo-Hookean"), [0.0, 0.05, 0.095, 0.0999, 0.12]
    p = pressures(model, highest=1e5)
    one, two = (rod_section(tube, own, HANGING) for tube, own in zip(
        WOUND.tubes, WOUND.split(p), strict=True))  # fmt: skip
    expected = [0.015 / np.sqrt(law.strain[2]) for law in (one, one, one, one, two)]
    assert model.body_radius(p, at) == pytest.approx(expected, rel=1e-12)
    assert type(model.body_radius(p, 0.05)) is float
    linear = robot("mixed")
    radii = linear.body_radius(pressures(linear), [0.05, 0.13, 0.165])
    assert radii == pytest.approx([0.014, 0.012, 0.012], abs=0)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param("mixed", marks=pytest.mark.long),
        pytest.param("hanging, mixed", marks=pytest.mark.long),
        *("2 segments", "follower"),
    ],
)
def test_machine_code_gives_what_the_vm_gives(case, compiled, monkeypatch):
    monkeypatch.setattr(body, "LOOKED_UP_FROM", 10**9)
    model, rng = made(case), np.random.default_rng(5)
    p = rng.uniform(0.0, 0.7e5, (2, model.n_pressures))
    at = stations(model)
    asked = {
        "pose": lambda: model.pose(p, at),
        "body_jacobian": lambda: model.body_jacobian(p, at),
        "line": lambda: model._body.line(p, at),
        "compliance_between": lambda: model.compliance_between(p, at, at[::-1]),
    }
    expected = {name: ask() for name, ask in asked.items()}
    model._body._native = body.native_body(model)
    assert model._body._native is not None
    for name, ask in asked.items():
        scale = np.abs(expected[name]).max(axis=(0, 1))
        assert (np.abs(ask() - expected[name]) <= 1e-7 * scale + 1e-12).all(), name


def test_an_arm_of_more_kinds_of_sections_than_fit_has_no_machine_code(compiled):
    arm = ARMS["5 segments, mixed"].under(HANGING)
    assert body.native_body(so.Manipulator(so.RobotDescription(**arm.mapping()))) is None


@pytest.mark.one_in(2)
@pytest.mark.parametrize("case", ["neo-Hookean", "hanging, neo-Hookean"])
def test_the_header_serves_other_libraries(case, compiled):
    """Position, tangent and radius, and their derivatives by pressures."""
    model = robot(case)
    make = body._loaded_functions if model.is_loaded else body.free_body_functions
    source = str(Path(__file__).with_name("native_body.c"))
    content = ("tested", model.is_loaded, model.layout.skeleton)
    code = body.library(content, partial(make, model.layout), (source,))
    native = body.NativeBody(code, model)
    call, n = code.cdll.tested_station, model.n_pressures
    call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p]
    p, found = pressures(model), np.zeros(7 + 7 * n)
    for s in stations(model, 2):
        assert not call(native.address, p.ctypes.data, s, found.ctypes.data)
        T = model.pose(p, s)
        assert found[:3] == pytest.approx(T[:3, 3], abs=1e-10)
        assert found[6] == pytest.approx(model.body_radius(p, s), rel=1e-12)
        J = np.kron(np.eye(2), T[:3, :3]) @ model.body_jacobian(p, s)
        assert_close(found[7 : 7 + 6 * n].reshape(n, 6).T, J, 1e-7)
        slope = (model.pose(p, s + 1e-6) - model.pose(p, s - 1e-6)) if s < model.length else None
        if slope is not None and np.min(np.abs(model._body._pieces.ends - s)) > 1e-5:
            unit = slope[:3, 3] / np.linalg.norm(slope[:3, 3])
            assert found[3:6] == pytest.approx(unit, abs=1e-6)
        by = 10.0 * np.eye(n)
        radii = [model.body_radius(p + x, s) - model.body_radius(p - x, s) for x in by]
        assert found[-n:] == pytest.approx(np.array(radii) / 20, abs=1e-12)


@pytest.mark.parametrize("case", ["mixed", "hanging"])
def test_casadi_functions_are_what_the_methods_give(case):
    """With the implicit function theorem where the equilibrium is a constraint."""
    model = robot(case)
    p, L = pressures(model), model.length
    start = [lie.quaternion_from_rotation(model.tip_pose(p)[:3, :3])] if model.is_loaded else []
    for name, at in (
        ("pose", (0.7 * L,)),
        ("body_jacobian", (0.7 * L,)),
        ("compliance_between", (0.3 * L, 0.8 * L)),
        ("compliance_between", (L, 0.5 * L)),
    ):
        function = model.body_function(name, *at)
        value, *residual = (np.asarray(each) for each in function.call([p, *start]))
        expected = getattr(model, name)(p, *at)
        assert value == pytest.approx(expected, rel=1e-4, abs=2e-6 * np.abs(expected).max())
        assert all(np.abs(each).max() < 1e-7 for each in residual)
    pose = model.body_function("pose", 0.7 * L)
    x = ca.MX.sym("x", len(p) + 4 * len(start))
    value, *residual = pose.call([x[: len(p)], *([x[len(p) :]] if start else [])])
    rows = ca.vertcat(value[:3, 3], *residual, *([ca.sumsqr(x[len(p) :])] if start else []))
    slope = np.asarray(ca.Function("f", [x], [ca.jacobian(rows, x)])(np.concatenate([p, *start])))
    by_p, by_q = slope[:, : len(p)], slope[:, len(p) :]
    total = by_p[:3] - (by_q[:3] @ np.linalg.solve(by_q[3:], by_p[3:]) if start else 0)
    J = model.pose(p, 0.7 * L)[:3, :3] @ model.body_jacobian(p, 0.7 * L)[:3]
    assert total == pytest.approx(J, abs=1e-5 * np.abs(J).max())


def test_casadi_functions_have_checked_arguments():
    model = robot("2 segments")
    for name, at, problem in (
        ("pose", (), "takes 1 arc length; got 0"),
        ("compliance_between", (0.1,), "takes 2 arc lengths; got 1"),
        ("pose", (0.3,), "is not on the arm"),
        ("shape", (0.1,), "unknown name 'shape'; choose one of pose"),
    ):
        with pytest.raises(InputError, match=problem):
            model.body_function(name, *at)


@pytest.mark.parametrize("case", ["neo-Hookean", "hanging"])
def test_a_batch_is_its_rows_and_several_stations_are_each(case):
    model, at = robot(case), np.array([0.02, 0.1])
    batch = np.array([pressures(model, seed) for seed in range(3)])
    for ask in (
        model.pose,
        model.body_jacobian,
        model.body_radius,
        lambda p, s: model.compliance_between(p, s, 0.05),
        lambda p, s: model.compliance_between(p, 0.15, s),
    ):
        together = ask(batch, at)
        assert together.shape[:2] == (3, 2)
        for row, p in enumerate(batch):
            assert ask(p, at) == pytest.approx(together[row], rel=1e-12, abs=1e-15)
            for column, s in enumerate(at):
                assert ask(p, s) == pytest.approx(together[row, column], rel=1e-12, abs=1e-15)
        assert ask(batch, 0.1).shape == together[:, 0].shape
        assert ask(batch[:0], at).shape == (0, *together.shape[1:])


def test_bad_arguments_are_told():
    model = robot("2 segments")
    p = pressures(model)
    for ask in (model.pose, model.body_jacobian, model.body_radius):
        for at in (0.19, [0.1, 0.19], -0.01, [0.1, -0.01]):
            with pytest.raises(InputError, match="is not on the arm"):
                ask(p, at)
        with pytest.raises(InputError, match="must be a finite number"):
            ask(p, [0.1, np.nan])
        with pytest.raises(InputError, match="arc lengths must be"):
            ask(p, [[0.1]])
        with pytest.raises(InputError, match="arc length must be a number"):
            ask(p, ["x"])
        with pytest.raises(PressureError, match="finite"):
            ask(np.full(6, np.nan), 0.1)
        with pytest.raises(PressureError, match="shape"):
            ask(p[:3], 0.1)
    with pytest.raises(InputError, match="equally many; got 2 and 3"):
        model.compliance_between(p, [0.1, 0.1], [0.1] * 3)


@pytest.mark.parametrize("fast", [False, True])
def test_failures_are_those_of_the_tip(fast, request, monkeypatch):
    if fast:
        request.getfixturevalue("compiled")
        monkeypatch.setattr(body, "LOOKED_UP_FROM", 0)
        monkeypatch.setattr(body, "COMPILED_FREE_FROM", 0)
        monkeypatch.setattr(body, "COMPILED_LOADED_FROM", 0)
    model = made("2 segments")
    p = np.array([pressures(model), np.full(6, 4.99e5)])
    with pytest.raises(PressureError, match="drives the compensated modulus"):
        model.backbone(p)
    with pytest.raises(PressureError, match="drives the compensated modulus"):
        model.body_jacobian(p, 0.1)
    upright = so.Manipulator(
        so.RobotDescription(**Arm((FLOP, FLOP)).under((0, 0, -9.81), 0.2).mapping())
    )
    with pytest.raises(EquilibriumError, match="own weight"):
        upright.backbone(np.zeros(6))


def test_another_load_is_another_body():
    model = robot("2 segments")
    p = pressures(model)
    free = model.backbone(p, 5)
    pulled = model.with_load((0.05, 0.0, 0.0))
    assert pulled.backbone(p, 5)[-1] == pytest.approx(pulled.tip_pose(p), abs=1e-12)
    assert np.abs(pulled.backbone(p, 5) - free).max() > 1e-3
    assert np.array_equal(model.backbone(p, 5), free)
