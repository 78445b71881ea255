"""Golden numbers of the paper's arm, and the model against a literal discretisation."""

import numpy as np
import pytest

import stiffopt as so
from independent.arms import ARMS, FLOP, PAIR, Arm, eq_9, neo_hookean
from independent.elements import discretise
from independent.sections import silicone
from stiffopt.model.actuation import SectionGeometry

GOLDEN = [  # bar, tip x and z in mm, k_x k_y k_z in N/cm
    (0.0, 0.0, 90.000, 0.1403, 0.1403, 7.3042),
    (0.4, -14.009, 90.454, 0.1267, 0.1213, 2.2238),
    (0.8, -31.198, 86.860, 0.1280, 0.1025, 0.5526),
    (1.0, -40.803, 82.602, 0.1391, 0.0933, 0.3189),
    (1.5, -64.697, 60.540, 0.2823, 0.0724, 0.1163),
]


def robot(arm):
    return so.Manipulator(so.RobotDescription(**arm.mapping()))


def pressures(arm, seed=0, share=0.6):
    return np.random.default_rng(seed).uniform(0, share * arm.highest, arm.n)


@pytest.mark.parametrize("row", GOLDEN, ids=lambda row: f"{row[0]} bar")
def test_one_segment(row):
    p1, x, z, *stiffness = row
    arm = so.load_robot("stiff-flop-1")
    p = np.array([p1 * 1e5, 0, 0])
    assert arm.tip_pose(p)[:3, 3] * 1e3 == pytest.approx([x, 0, z], abs=5.01e-4)
    k = [arm.stiffness(p, d) / 100 for d in np.eye(3)]
    assert k == pytest.approx(stiffness, abs=5.01e-5)


def test_two_segments():
    arm = so.load_robot("stiff-flop-2")
    p = np.array([0.5, 1.0, 0.2, 0.9, 0.1, 1.2]) * 1e5
    assert arm.tip_pose(p)[:3, 3] * 1e3 == pytest.approx([0.767, -46.755, 189.044], abs=5.01e-4)
    k = [arm.stiffness(p, d) / 100 for d in np.eye(3)]
    assert k == pytest.approx([0.010404, 0.011293, 0.176625], abs=5.01e-7)


def test_section_of_table_ii():
    segment = so.load_robot("stiff-flop-1").description.segments[0]
    geometry = SectionGeometry.of(segment)
    assert geometry.area == pytest.approx(547.8e-6, abs=0.05e-6)
    assert geometry.second_moment == pytest.approx(3.445e-8 * np.eye(2), abs=0.0005e-8)
    assert geometry.channel_force == pytest.approx(np.full(3, 31.81e-6), abs=0.005e-6)
    assert np.degrees(segment.chambers.angles) == pytest.approx([eq_9(i) for i in range(1, 7)])
    mass = 2 * geometry.area * segment.length * 1070
    assert mass == pytest.approx(0.105, abs=0.001)


@pytest.mark.parametrize("name", ARMS)
def test_section_properties_against_boundary_integrals(name):
    arm = ARMS[name]
    for tube, segment in zip(arm.tubes, robot(arm).description.segments, strict=True):
        geometry, solid = SectionGeometry.of(segment), silicone(tube)
        assert geometry.area == pytest.approx(solid.area, rel=1e-12)
        assert geometry.centroid == pytest.approx(solid.centroid, abs=1e-14)
        assert geometry.second_moment == pytest.approx(solid.about_centroid, rel=1e-9, abs=1e-20)


@pytest.mark.parametrize("law", ["paper", "neo-hookean"])
@pytest.mark.parametrize("name", ARMS)
def test_literal_discretisation_converges_to_the_model(name, law):
    arm = ARMS[name]
    if law == "neo-hookean":
        arm = Arm(tuple(neo_hookean(tube) for tube in arm.tubes))
    model, p = robot(arm), pressures(arm)
    T, C = model.tip_pose(p), model.tip_compliance(p)
    scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
    coarse, fine = discretise(arm, p, 10), discretise(arm, p, 20)
    # arcs are exact with any number; what is left is the rounding of the norm law's cone
    assert fine.pose == pytest.approx(T, abs=1e-7)
    errors = [np.abs((sums.compliance - C) / scale).max() for sums in (coarse, fine)]
    assert errors[1] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(4, abs=0.3)  # midpoint rule: second order
    extrapolated = (4 * fine.compliance - coarse.compliance) / 3
    assert np.abs((extrapolated - C) / scale).max() < 2e-5


@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-2", "stiff-flop-2-hanging"])
def test_turning_the_channels_by_120_degrees_turns_everything(name):
    arm = so.load_robot(name)
    p = np.random.default_rng(3).uniform(0, 1.2e5, arm.n_pressures)
    turned = np.roll(p.reshape(-1, 3), 1, axis=1).ravel()
    angle = np.radians(120)
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    T, T_turned = arm.tip_pose(p), arm.tip_pose(turned)
    assert T_turned[:3, 3] == pytest.approx(R @ T[:3, 3], abs=1e-9)
    assert T_turned[:3, :3] == pytest.approx(R @ T[:3, :3] @ R.T, abs=1e-8)
    d = np.array([0.3, -0.7, 0.4])
    for boundary in ("free", "guided", "clamped"):
        k = arm.stiffness(p, d, boundary=boundary)
        assert arm.stiffness(turned, R @ d, boundary=boundary) == pytest.approx(k, rel=1e-6)


def test_a_rotation_of_the_layout_is_a_rotation_of_the_arm():
    """An asymmetric section, turned by any angle, turns pose and compliance."""
    angle = 0.7
    turned_tube = so.RobotDescription(**Arm((PAIR,)).mapping())
    chambers = turned_tube.segments[0].chambers
    angles = tuple(a + angle for a in chambers.angles)
    segment = turned_tube.segments[0].model_copy(
        update={"chambers": chambers.model_copy(update={"angles": angles})}
    )
    turned = so.Manipulator(turned_tube.model_copy(update={"segments": (segment,)}))
    plain, p = robot(Arm((PAIR,))), np.array([0.8e5, 0.5e5])
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert turned.tip_pose(p)[:3, 3] == pytest.approx(R @ plain.tip_pose(p)[:3, 3], abs=1e-13)
    d = np.array([0.2, 0.5, 0.6])
    assert turned.stiffness(p, R @ d) == pytest.approx(plain.stiffness(p, d), rel=1e-10)


def test_pressing_pair_one_bends_towards_minus_x():
    assert so.load_robot("stiff-flop-1").tip_pose([1e5, 0, 0])[0, 3] < 0


def test_compensation_is_the_papers():
    plain = so.RobotDescription(**Arm((FLOP,)).mapping())
    segment = plain.segments[0].model_copy(update={"compensation": None})
    bare = so.Manipulator(plain.model_copy(update={"segments": (segment,)}))
    k, k_bare = (arm.stiffness(np.zeros(3), (0, 0, 1)) for arm in (robot(Arm((FLOP,))), bare))
    assert k / k_bare == pytest.approx(1.2, rel=1e-12)  # lambda_A at no pressure
