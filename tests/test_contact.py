"""Arms that lean on objects: closed forms, an independent rod, differences, and what is lost."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from conftest import is_long
from independent import ARMS, FLOP, Arm, rod_section
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.stability import stiffness_left
from stiffopt.model.contact.surface import ContactSurface
from stiffopt.model.scene import Scene
from stiffopt.model.shooting import mass_per_length

TWO = Arm((FLOP, FLOP))
REST = np.zeros(6)
X = (1.0, 0.0, 0.0)
PROBLEMS = Path(__file__).parents[1] / "problems"
REFERENCES = json.loads((Path(__file__).parent / "contact_reference.json").read_text())
SLIPS = json.loads((Path(__file__).parent / "slip_reference.json").read_text())


@cache
def robot(arm: Arm = TWO) -> stiffopt.Manipulator:
    return stiffopt.Manipulator(stiffopt.RobotDescription(**arm.mapping()))


def scene(*shapes: dict[str, Any], **contact: Any) -> Scene:
    allowed = {"allowed": True, **contact}
    return Scene(
        objects=[{"name": f"{k}", "contact": allowed, **shape} for k, shape in enumerate(shapes)]
    )


def post(at: float, gap: float = 0.0, radius: float = 0.005) -> dict[str, Any]:
    """A post across the x axis, that far from a straight arm."""
    x = 0.015 + radius + gap
    return {"capsule": {"from": (x, -0.05, at), "to": (x, 0.05, at), "radius": radius}}


def push(force: float, *direction: float) -> np.ndarray:
    return np.array([*(force * np.array(direction or X)), 0.0, 0.0, 0.0])


def flexibilities(at: float) -> tuple[float, float, float]:
    """Of a straight arm across x: tip, between tip and a point, and of the point (m/N)."""
    law = rod_section(FLOP, np.zeros(3), TWO.gravity)
    bend, shear, length = law.compliance[4, 4], law.compliance[0, 0], TWO.length
    between = bend * (at**2 * length / 2 - at**3 / 6) + shear * at
    return bend * length**3 / 3 + shear * length, between, bend * at**3 / 3 + shear * at


def euler_load() -> float:
    """Of a straight arm that is free at the tip, in N: ``P (1 + P/GA - P/EA) = (pi / 2L)^2 EI``."""
    law, length = rod_section(FLOP, np.zeros(3), TWO.gravity), TWO.length
    bend, shear, stretch = law.compliance[3, 3], law.compliance[1, 1], law.compliance[2, 2]
    return float(np.roots([shear - stretch, 1.0, -((np.pi / (2 * length)) ** 2) / bend]).max())


# -- closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 0.65, 0.8])
def test_small_pushes_on_a_straight_arm_are_those_of_beam_theory(share):
    """``C_tt - C_ts C_ss^-1 C_st`` along the normal; the gap is closed by the first of the push."""
    at, gap, force = share * TWO.length, 1e-5, 1e-4
    tip, between, own = flexibilities(at)
    found = robot().contact_equilibrium(REST, scene(post(at, gap)), load=push(force))
    (contact,) = found.contacts
    expected = (between * force - gap) / own
    assert contact.force == pytest.approx([-expected, 0, 0], abs=1e-3 * expected)
    assert contact.at == pytest.approx(at, abs=1e-5)
    assert contact.position == pytest.approx([0.015 + gap, 0, at], abs=1e-5)
    assert found.tip_pose[0, 3] == pytest.approx(tip * force - between * expected, rel=1e-3)
    assert found.stiffness(X) == pytest.approx(1 / (tip - between**2 / own), rel=1e-3)
    lost = found.lift_off([-1, 0, 0])
    assert (lost.how, lost.object) == ("lifts off", "0")
    assert lost.force == pytest.approx(force - gap / between, rel=2e-3)
    assert lost.stiffness_after == pytest.approx(1 / tip, rel=1e-3)


def test_a_soft_object_is_a_spring():
    at, force, stiffness = 0.12, 1e-4, 20.0
    tip, between, own = flexibilities(at)
    found = robot().contact_equilibrium(
        REST, scene(post(at), stiffness=stiffness), load=push(force)
    )
    own += 1 / stiffness
    assert -found.contacts[0].force[0] == pytest.approx(between * force / own, rel=1e-3)
    assert found.stiffness(X) == pytest.approx(1 / (tip - between**2 / own), rel=1e-3)


def test_leaning_softens_across_the_normal():
    """A sphere's curvature times the force, with the arm's own stiffness where it touches."""
    at, radius = 0.12, 0.005
    tip, between, own = flexibilities(at)
    sphere = {"sphere": {"centre": (0.02, 0.0, at), "radius": radius}}
    found = robot().contact_equilibrium(REST, scene(sphere), load=push(0.01))
    force = np.linalg.norm(found.contacts[0].force)
    curvature = force / (0.015 + radius)
    expected = tip + between**2 * curvature / (1 - own * curvature)
    assert 1 / found.stiffness([0, 1, 0]) == pytest.approx(expected, rel=0.01)
    assert found.stiffness([0, 1, 0]) < 0.95 * robot().stiffness(REST, [0, 1, 0])
    assert found.stable


def test_the_tip_is_a_hemisphere():
    """A wall before the tip, pressed by an arm that lengthens."""
    p = np.full(6, 1.5e4)
    free, C = robot().tip_pose(p)[2, 3], robot().tip_compliance(p)[2, 2]
    wall = {"half_space": {"point": (0, 0, free + 0.015 - 0.1 * C), "normal": (0, 0, -1)}}
    found = robot().contact_equilibrium(p, scene(wall, friction=0.2))
    (contact,) = found.contacts
    # friction at the touched point is a wrench on the tip
    lever = contact.position - found.tip_pose[:3, 3]
    dragged = [
        robot().contact_equilibrium(
            p, scene(wall), load=1e-4 * np.array([*d, *np.cross(lever, d)]), nearby=found
        )
        for d in np.eye(3)[:2]
    ]
    moves = [1e4 * (each.tip_pose - found.tip_pose)[:2, 3] for each in dragged]
    expected = 0.2 * np.linalg.norm(contact.force) * np.linalg.norm(moves, 2)
    assert found.friction.tip == pytest.approx(expected, rel=1e-3)
    assert contact.at == TWO.length
    assert found.tip_pose[2, 3] == pytest.approx(free - 0.1 * C, abs=1e-5)
    assert contact.force == pytest.approx([0, 0, -0.1], abs=1e-3)


# -- no contact -----------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [TWO, ARMS["3 segments, mixed"], TWO.under((0, 0, 9.81), 0.02)])
def test_without_contact_it_is_the_free_arm(arm):
    p = np.random.default_rng(3).uniform(0, 0.8e5, arm.n)
    found = robot(arm).contact_equilibrium(p, scene(post(0.1, gap=0.3)))
    assert found.contacts == ()
    assert found.stable
    assert found.tip_pose == pytest.approx(robot(arm).tip_pose(p), abs=1e-5)
    scale = np.abs(robot(arm).tip_compliance(p)).max()
    assert found.tip_compliance == pytest.approx(robot(arm).tip_compliance(p), abs=1e-4 * scale)
    jacobian = robot(arm).tip_jacobian(p)
    assert found.tip_jacobian == pytest.approx(jacobian, abs=1e-4 * np.abs(jacobian).max())
    line = robot(arm).backbone(p, 20)[:, :3, 3]
    assert found.backbone(20) == pytest.approx(line, abs=2e-4)
    assert found.lift_off(X).how == "holds"


def test_objects_that_allow_no_contact_are_not_leant_on():
    found = robot().contact_equilibrium(REST, scene(post(0.1), allowed=False), load=push(0.01))
    assert found.contacts == ()


# -- an independent rod ---------------------------------------------------------------------------


@pytest.mark.parametrize("case", REFERENCES, ids=[str(case["seed"]) for case in REFERENCES])
def test_against_the_energy_of_a_discrete_rod(case):
    """One to three contacts, with and without weight."""
    arm = ARMS[case["arm"]].under(case["gravity"], case["tip_mass"])
    found = robot(arm).contact_equilibrium(
        np.array(case["pressures"]), scene(*case["objects"]), load=push(1, *case["force"])
    )
    forces = np.zeros(len(case["objects"]))
    for contact in found.contacts:
        forces[int(contact.object)] += np.linalg.norm(contact.force)
    tip = np.linalg.norm(found.tip_pose[:3, 3] - case["tip"])
    assert tip < 1e-3 * arm.length
    assert forces == pytest.approx(case["forces"], rel=0.01, abs=5e-4)
    assert found.stable
    R = found.tip_pose[:3, :3]
    flexibility = np.diag(R @ found.tip_compliance[:3, :3] @ R.T)
    assert flexibility == pytest.approx(case["flexibilities"], rel=0.05)


# -- lines of contact -----------------------------------------------------------------------------


def table(gap: float) -> dict[str, Any]:
    """A wall along the straight arm, on its x side."""
    return {"half_space": {"point": (0.015 + gap, 0, 0), "normal": (-1, 0, 0)}}


def _lying_beam(gap: float, g: float) -> float:
    """Return the force in N of a table on a clamped beam with shear that sags on it.

    The beam is free up to a and lies flat beyond, where bending and shear cancel: turn = -chi N,
    and decays over the length sqrt(EI chi).
    """
    law = rod_section(FLOP, np.zeros(3), TWO.gravity)
    bend, chi = law.compliance[4, 4], law.compliance[0, 0]
    weight = mass_per_length(robot().description.segments[0]) * g
    decay = np.sqrt(chi / bend)

    def end(a: float) -> tuple[float, float]:
        # turn(a) = bend (M a + N a^2/2 + w a^3/6) = -chi N, and M = chi N / (bend decay)
        per_force = bend * (chi * a / (bend * decay) + a**2 / 2) + chi
        N = -bend * weight * a**3 / 6 / per_force
        M = chi * N / (bend * decay)
        sag = bend * (M * a**2 / 2 + N * a**3 / 3 + weight * a**4 / 8)
        return N, sag + chi * (N * a + weight * a**2 / 2)

    low, high = 0.01, TWO.length
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if end(middle)[1] < gap else (low, middle)
    return weight * (TWO.length - low) - end(low)[0]


@pytest.mark.parametrize(("gap", "g"), [(0.0005, 3.0), (0.002, 9.81), (0.004, 9.81)])
def test_an_arm_that_lies_on_a_table_is_a_beam_with_shear(gap, g):
    model = robot(TWO.under((g, 0.0, 0.0)))
    found = model.contact_equilibrium(REST, scene(table(gap)))
    assert found.stable
    assert len(found.contacts) > 3
    assert found.normal_forces.min() > 0
    assert found.normal_forces.sum() == pytest.approx(_lying_beam(gap, g), rel=0.01)
    assert found.tip_pose[0, 3] == pytest.approx(gap, abs=1e-6)
    along = np.linspace(0.0, TWO.length, 200)
    assert found.poses(along)[:, 0, 3].max() < gap + 3e-5
    assert found.stiffness(X) == np.inf  # the table holds the tip


# Walls and gravity at random angles: gravity, pressures in kPa, a point of the wall and its normal.
# Then the total force in N, the tip in mm, and the stiffness in N/m across and along the wall, of a
# rod with elements of 1.5 mm whose energy IPOPT minimises.
# fmt: off
LYING = [
    ((-6.807766136, 1.604094725, -3.421536681), REST,
     (-0.013438797, 0.009229419, 0.0),
     (0.824321139549, -0.566122476937, 0.0), 0.4637, (-45.04, -63.281, 159.202), 1.9485, 5.772),
    ((1.878440091, 3.117260061, -4.32189693),
     (0.0, 6.574062453, 36.456403371, 16.710301289, 0.0, 0.0),
     (0.009156277, 0.020295228, 0.0),
     (-0.411239381202, -0.911527383762, 0.0), 0.2586, (39.572, -9.987, 176.762), 0.7439, 10.667),
    ((0.249396639, 4.850959351, -1.165488257),
     (0.0, 13.315921456, 23.27268183, 27.546185802, 0.0, 4.709789975),
     (0.002800618, 0.020680087, -0.000836082),
     (-0.134093205845, -0.990159831253, 0.040031496589),
     0.2378, (0.949, 13.183, 182.22), 1.4355, 297.161),
    ((4.818591475, 7.096658962, 0.075699822),
     (0.0, 0.0, 21.01258568, 39.838978595, 8.441534754, 29.642705704),
     (0.011046477, 0.021972668, 0.001317401),
     (-0.448525877933, -0.892167716683, -0.0534911407),
     0.5173, (17.148, -8.814, 183.221), 1.5369, 94.875),
    ((0.858763729, 3.851710115, -4.847339066), REST,
     (0.002700121, 0.014753088, -0.000236098),
     (-0.180008041519, -0.983539202274, 0.01573984046), 0.2935, (8.258, 1.355, 179.088),
     0.7803, 164.605),
]
# fmt: on


@pytest.mark.parametrize("case", LYING)
def test_an_arm_along_a_wall_is_that_of_an_energy_minimisation(case):
    gravity, pressures, point, normal, force, tip, across, along = case
    model = robot(TWO.under(gravity))
    wall = {"half_space": {"point": point, "normal": normal}}
    found = model.contact_equilibrium(np.array(pressures) * 1e3, scene(wall))
    assert found.stable
    assert found.normal_forces.sum() == pytest.approx(force, rel=0.05)
    assert np.linalg.norm(found.tip_pose[:3, 3] - np.array(tip) / 1e3) < 0.0005 * TWO.length
    side = np.cross((0, 0, 1), normal)
    assert found.stiffness(side) == pytest.approx(across, rel=0.02)
    assert found.stiffness(np.cross(normal, side)) == pytest.approx(along, rel=0.02)


@pytest.mark.parametrize(("share", "within"), [(0.9, False), (1.1, True)])
def test_the_forces_along_a_line_are_limited_together(share, within):
    model = robot(TWO.under((3.0, 0.0, 0.0)))
    total = model.contact_equilibrium(REST, scene(table(0.0005))).normal_forces.sum()
    limited = scene(table(0.0005), max_force=share * total)
    found = model.contact_equilibrium(REST, limited)
    assert found.normal_forces.max() < 0.5 * share * total
    ((own, force),) = found.pressed()
    assert own == list(range(len(found.contacts)))
    assert force == pytest.approx(total, rel=1e-6)
    assert found.within_limits is within


def test_pushes_on_an_arm_that_lies_on_a_table_end():
    model = robot(TWO.under((3.0, 0.0, 0.0)))
    found = model.contact_equilibrium(REST, scene(table(0.0005)))
    for way in np.concatenate([np.eye(3), -np.eye(3)]):
        loss = found.lift_off(way)
        along = way[2] < 0
        assert loss.how in (("buckles",) if along else ("lifts off", "holds"))
        if along:
            assert loss.force == pytest.approx(euler_load(), rel=0.015)
        assert loss.stiffness > 0
    lifted = found.lift_off((-1, 0, 0))
    assert (lifted.object, lifted.at) == ("0", pytest.approx(TWO.length))
    near = found.shifted(push=(0.0, 1e-4, 0.0))
    assert 1e-4 / (near.tip_pose[1, 3] - found.tip_pose[1, 3]) == pytest.approx(
        found.stiffness((0, 1, 0)), rel=1e-3
    )


@pytest.mark.parametrize("contacts", ["sliding", "sticking"])
@pytest.mark.parametrize("sideways", [0.0, 2e-4])
def test_a_push_along_the_arm_buckles_it_next_to_the_post(contacts, sideways):
    """Across the post's normal it is a free column."""
    found = robot().contact_equilibrium(REST, scene(post(0.12, 1e-5)), load=push(5e-4))
    lost = found.lift_off((sideways, 0.0, -1.0), contacts=contacts)
    assert (lost.how, lost.object, lost.stiffness_after) == ("buckles", None, 0.0)
    assert lost.force == pytest.approx(euler_load(), rel=0.015)


def test_contacts_that_become_a_line_or_come_to_the_tip_are_no_buckling():
    """An independent rod follows both pushes to 1.3 times of where these seemed to end."""
    lying = robot(TWO.under((6.0, 0.0, 3.0))).contact_equilibrium(REST, scene(table(0.0007)))
    for way in ([0.3, 1, 0], [0, 1, 0.5], [1, 0, 0]):
        assert lying.lift_off(way).how == "holds"
        assert lying.stiffness(way) > 0
    task = stiffopt.load_task(PROBLEMS / "leaning_in_a_tube.yaml")
    golden = json.loads((PROBLEMS / "golden/leaning_in_a_tube.json").read_text())
    found = robot().contact_equilibrium(golden["pressures_pa"], task.scene)
    for contacts in ("sliding", "sticking"):
        assert found.lift_off(X, 1.25, contacts).how == "holds"


def test_another_contact_takes_the_force_of_the_first_under_a_push():
    """The independent rod touches the second sphere at 27 mN, and leaves the first at 35 mN."""
    spheres = [
        {"sphere": {"centre": (0.03722, -0.01678, 0.11206), "radius": 0.00899}},
        {"sphere": {"centre": (0.0535, -0.01646, 0.13807), "radius": 0.0119}},
    ]
    p = [25290, 67850, 60490, 114050, 104500, 0]
    lost = robot().contact_equilibrium(p, scene(*spheres)).lift_off((0.427, 0.793, -0.435))
    assert (lost.how, lost.object) == ("lifts off", "0")
    assert lost.force == pytest.approx(0.035, rel=0.03)


def test_pushes_and_paths_have_a_greatest_number_of_steps(monkeypatch):
    found = robot().contact_equilibrium(REST, scene(post(0.12)), load=push(0.02))
    monkeypatch.setattr("stiffopt.model.contact.push._MOST_STEPS", 1)
    assert found.lift_off((0, 1, 0), limit=0.5).how == "stalls"
    monkeypatch.setattr("stiffopt.model.contact.solve._MOST_STEPS", 1)
    with pytest.raises(EquilibriumError, match="no equilibrium is reached continuously"):
        robot().contact_equilibrium(REST, scene(post(0.12)), load=push(0.5))


def test_the_second_derivative_of_the_gap_includes_the_shear_by_weight():
    model = robot(TWO.under((3.0, 0.0, 0.0)))
    sag = model.contact_equilibrium(REST, scene(post(0.12, gap=0.2))).backbone(181)[120, 0]
    left = model.clearance(REST, scene(post(0.12, gap=sag)))
    found = model.contact_equilibrium(REST, scene(post(0.12, gap=sag - left - 2e-5)))
    assert 0 < found.normal_forces[0] < 0.004
    arm, row, at = found._arm, found._arm.rows[0], found.contacts[0].at
    step = 0.006
    x = found._arm.shape.body(at + step * np.array([-2.0, -1.0, 1.0, 2.0]))[0]
    # differences on both sides, as the force makes a kink between them
    second = (x[0] - x[1] - x[2] + x[3]) / (3 * step**2)
    own = row.mean @ row.point.curvature @ row.mean
    assert arm.bend(0) - own == pytest.approx(row.point.normal @ second, rel=0.03)


@pytest.mark.parametrize("gap", [0.002, 0.006])
def test_machine_code_and_numpy_lie_on_a_table_alike(gap, compiled, monkeypatch):
    model = stiffopt.Manipulator(stiffopt.RobotDescription(**TWO.under((6.0, 0.0, 1.0)).mapping()))
    first = model.contact_equilibrium(REST, scene(table(gap)))
    with monkeypatch.context() as patch:
        patch.setattr(ContactProblem, "_native", None)
        second = model.contact_equilibrium(REST, scene(table(gap)))
    assert first.normal_forces.sum() == pytest.approx(second.normal_forces.sum(), rel=2e-3)
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=5e-6)


# -- derivatives ----------------------------------------------------------------------------------

BENT = np.array([0.9e5, 0.1e5, 0.0, 0.2e5, 0.7e5, 0.1e5])


@cache
def around(arm: Arm) -> Scene:
    """Two posts that the free arm at `BENT` would enter by millimetres."""
    T = robot(arm).pose(BENT, [0.11, 0.17])
    shapes = []
    for pose, depth, radius in zip(T, (0.006, 0.003), (0.005, 0.008), strict=True):
        centre = pose[:3, 3] - pose[:3, 0] * (0.015 + radius - depth)
        side = 0.05 * pose[:3, 1]
        ends = {"from": tuple(centre - side), "to": tuple(centre + side)}
        shapes.append({"capsule": {**ends, "radius": radius}})
    return scene(*shapes, friction=0.3)


@cache
def leaning(arm: Arm) -> stiffopt.ContactEquilibrium:
    return robot(arm).contact_equilibrium(BENT, around(arm))


WITH_AND_WITHOUT_WEIGHT = pytest.mark.parametrize("arm", [TWO, TWO.under((0, 0, 9.81), 0.01)])


@WITH_AND_WITHOUT_WEIGHT
def test_derivatives_are_those_of_equilibria_nearby(arm):
    found = leaning(arm)
    assert found.contacts
    step, n = 20.0, robot(arm).n_pressures
    moves, forces, stations = [], [], []
    for e in step * np.eye(n):
        a, b = (
            robot(arm).contact_equilibrium(BENT + sign * e, around(arm), nearby=found)
            for sign in (1, -1)
        )
        moves.append((a.tip_pose - b.tip_pose)[:3, 3] / (2 * step))
        pairs = list(zip(a.contacts, b.contacts, strict=True))
        norms = [[np.linalg.norm(each.force) for each in pair] for pair in pairs]
        forces.append([(x - y) / (2 * step) for x, y in norms])
        stations.append([(x.at - y.at) / (2 * step) for x, y in pairs])
    slope = found.tip_pose[:3, :3] @ found.tip_jacobian[:3]
    assert slope == pytest.approx(np.array(moves).T, abs=1e-6 * np.abs(slope).max())
    for gradients, rows in ((found.force_gradients, forces), (found.station_gradients, stations)):
        expected = np.array(rows).T
        assert gradients == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    gradient = found.stiffness_gradient(X, step=50.0)
    other = found.stiffness_gradient(X, step=200.0)
    assert gradient == pytest.approx(other, abs=1e-3 * np.abs(gradient).max())


@WITH_AND_WITHOUT_WEIGHT
def test_compliance_is_that_of_pushes_and_symmetric(arm):
    found = leaning(arm)
    raw, R = found._arm.tangent[:6], found.tip_pose[:3, :3]
    assert raw == pytest.approx(raw.T, abs=1e-3 * np.abs(raw).max())
    C = R @ found.tip_compliance[:3, :3] @ R.T
    for direction in np.eye(3):
        ends = [
            robot(arm).contact_equilibrium(
                BENT, around(arm), load=push(sign * 1e-5, *direction), nearby=found
            )
            for sign in (1, -1)
        ]
        move = (ends[0].tip_pose - ends[1].tip_pose)[:3, 3] / 2e-5
        assert move == pytest.approx(C @ direction, abs=1e-3 * np.abs(C).max())


def test_the_stiffness_of_the_nodes_has_the_same_compliance():
    """What decides on stability, turned round."""
    found = leaning(TWO)
    K = stiffness_left(found._arm)
    assert np.linalg.eigvalsh((K + K.T) / 2)[0] > 0
    assert pytest.approx(K.T, abs=1e-3 * np.abs(K).max()) == K


def test_sticking_is_stiffer_than_sliding():
    found = leaning(TWO)
    for direction in np.eye(3):
        sliding, sticking = (
            found.stiffness(direction, contacts=grip) for grip in ("sliding", "sticking")
        )
        assert sticking > 0.999 * sliding
    free = robot().stiffness(BENT, X)
    assert found.stiffness(X) > 2 * free


@pytest.mark.parametrize("friction", [0.05, 0.2])
def test_a_sticking_contact_slips_at_its_friction(friction):
    """A straight arm on a post: pushed along the post, which holds the touched point."""
    at, force = 0.12, 2e-3
    tip, between, own = flexibilities(at)
    found = robot().contact_equilibrium(REST, scene(post(at), friction=friction), load=push(force))
    normal = float(np.linalg.norm(found.contacts[0].force))
    # across, the touched point is held by turning the arm about its axis too
    law = rod_section(FLOP, np.zeros(3), TWO.gravity)
    held = own + 0.015**2 * law.compliance[5, 5] * at
    assert found.friction.tip == pytest.approx(friction * normal * between, rel=0.02)
    lost = found.lift_off([0, 1, 0], contacts="sticking")
    assert (lost.how, lost.object) == ("slips", "0")
    assert lost.force == pytest.approx(friction * normal / (between / held), rel=0.02)
    assert lost.stiffness == pytest.approx(1 / (tip - between**2 / held), rel=0.02)
    assert lost.stiffness_after == pytest.approx(1 / tip, rel=0.05)
    away = found.lift_off([-1, 0, 0], contacts="sticking")
    assert away.how in ("slips", "lifts off")
    assert away.force <= 1.01 * found.lift_off([-1, 0, 0]).force


def slipping(case: dict[str, Any]) -> stiffopt.ContactEquilibrium:
    arm = robot(ARMS[case["arm"]].under(tuple(case["gravity"]), case["tip_mass"]))
    around = scene(*case["objects"], friction=case["friction"])
    return arm.contact_equilibrium(case["pressures"], around, load=[*case["force"], 0.0, 0.0, 0.0])


SLIPPING = pytest.mark.parametrize("case", SLIPS, ids=[f"{case['seed']}" for case in SLIPS])


@SLIPPING
def test_a_sticking_arm_has_a_symmetric_compliance(case):
    """Contacts that carry no tangential force yet, on curved surfaces: there is an energy."""
    C = slipping(case).compliance("sticking")
    assert pytest.approx(C.T, abs=1e-3 * np.abs(C).max()) == C


@SLIPPING
def test_large_pushes_slip_where_an_independent_rod_does(case):
    """Numbers of `benchmarks/slips.py`; the tangent alone is up to 17 % off in these scenes."""
    lost = slipping(case).lift_off(case["direction"], contacts="sticking")
    assert (lost.how, lost.object) == ("slips", case["object"])
    assert lost.force == pytest.approx(case["push"], rel=0.02)


@SLIPPING
def test_the_foretold_slip_changes_as_the_exact_one(case):
    """To first order in the push: nearly so for pushes of some 30 mN, roughly for 0.1 N."""
    found, push = slipping(case), case["direction"]
    share = 0.1 if case["push"] < 0.05 else 0.5
    changes = 20.0 * np.eye(len(found.pressures))
    exact, foretold = (
        np.array([value(found.shifted(each)) / value(found) - 1 for each in changes])
        for value in (
            lambda eq: eq.lift_off(push, contacts="sticking").force,
            lambda eq: eq.foretold_slip(push),
        )
    )
    assert foretold == pytest.approx(exact, abs=share * np.abs(exact).max())


def test_a_contact_that_a_push_adds_may_slide():
    """A hanging arm leans on a ball; the push bends it on to a post, along which it slides."""
    hanging = TWO.under((0, 0, 9.81), 0.02)
    post = {"from": (-0.04887, -0.02223, 0.08921), "to": (0.04998, -0.0331, 0.07873)}
    around = scene(
        {"capsule": {**post, "radius": 0.0119}},
        {"sphere": {"centre": (0.00827, 0.02515, 0.09987), "radius": 0.0095}},
        friction=0.3,
    )
    pressures = 1e3 * np.array([12.441, 23.445, 145.64, 31.826, 22.003, 0.0])
    found = robot(hanging).contact_equilibrium(pressures, around)
    assert [each.object for each in found.contacts] == ["1"]
    direction = np.array([-0.19, 0.921, -0.339])
    lost = found.lift_off(direction, contacts="sticking")
    assert (lost.object, lost.how) == ("1", "slips")


# -- approach, and what cannot be -----------------------------------------------------------------


def test_overlaps_of_15_mm_are_reached_by_both_approaches():
    T = robot().pose(BENT, 0.15)
    centre, side = T[:3, 3] - T[:3, 0] * (0.02 - 0.015), 0.05 * T[:3, 1]
    ends = {"from": tuple(centre - side), "to": tuple(centre + side)}
    around = scene({"capsule": {**ends, "radius": 0.005}})
    assert robot().clearance(BENT, around) == pytest.approx(-0.015, abs=2e-4)
    first, second = (
        robot().contact_equilibrium(BENT, around, approach=way) for way in ("pressures", "objects")
    )
    assert first.contacts
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=2e-6)
    assert first.stable


@pytest.mark.parametrize("at", [0.11, 0.14, 0.17])
def test_long_steps_end_where_short_ones_do(at):
    """On a ball that the free arm enters by 8 mm, beside the plane in which it bends."""
    T = robot().pose(BENT, at)
    side = (T[:3, 0] + 0.4 * T[:3, 1]) / np.hypot(1, 0.4)
    ball = scene({"sphere": {"centre": tuple(T[:3, 3] - 0.013 * side), "radius": 0.006}})
    slowly = robot().contact_equilibrium(REST, ball)
    for share in np.linspace(0, 1, 31)[1:]:
        slowly = robot().contact_equilibrium(share * BENT, ball, nearby=slowly)
    found = robot().contact_equilibrium(BENT, ball)
    assert found.contacts
    assert found.tip_pose == pytest.approx(slowly.tip_pose, abs=1e-6)


def test_an_arm_that_is_swept_past_a_post_stays_on_its_side():
    """At the full pressures the free arm is beyond the post and clear of it."""
    p = np.array([1.5e5, 0, 0, 1.5e5, 0, 0])
    line = robot().backbone(0.35 * p, 50)[-8, :3, 3]
    post = {"capsule": {"from": (line[0] - 0.022, -0.08, line[2]), "radius": 0.004,
                        "to": (line[0] - 0.022, 0.08, line[2])}}  # fmt: skip
    assert robot().clearance(REST, scene(post)) > 0
    assert robot().clearance(p, scene(post)) > 0.002
    found = robot().contact_equilibrium(0.6 * p, scene(post))
    assert found.contacts
    assert found.tip_pose[0, 3] > robot().tip_pose(0.6 * p)[0, 3] + 0.005


def test_an_arm_that_is_pressed_on_a_wall_along_its_axis_buckles():
    """At Euler's load of a rod that is clamped at one end, less what shear takes of it."""
    wall = {"half_space": {"point": (0, 0, 0.2), "normal": (0, 0, -1)}}
    message = r"beyond \d+% of its pressures and load, leaning on 0: the arm slips off, snaps"
    with pytest.raises(EquilibriumError, match=message):
        robot().contact_equilibrium(np.full(6, 1.5e5), scene(wall))
    law = rod_section(FLOP, np.full(3, 2e4), TWO.gravity)
    euler = np.pi**2 / (4 * (1.01 * TWO.length) ** 2 * law.compliance[4, 4])
    euler /= 1 + euler * law.compliance[0, 0]
    forces = []
    for p in np.arange(1.9e4, 2.3e4, 200 if is_long() else 400):
        try:
            found = robot().contact_equilibrium(np.full(6, p), scene(wall))
        except EquilibriumError:
            break
        forces.append(float(np.linalg.norm(found.contacts[0].force)))
    assert len(forces) > 2
    assert forces[-1] == pytest.approx(euler, rel=0.1)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="expected a Scene"):
        robot().contact_equilibrium(REST, "post")
    with pytest.raises(InputError, match="approach"):
        robot().contact_equilibrium(REST, scene(post(0.1)), approach="sideways")
    found = robot().contact_equilibrium(REST, scene(post(0.1)))
    with pytest.raises(InputError, match="contacts"):
        found.compliance("glued")
    with pytest.raises(InputError, match="limit"):
        found.lift_off(X, limit=0)


# -- bent tubes -----------------------------------------------------------------------------------


def bent_tube(bend_deg: float, at: float, radius: float, side: float = 0.0) -> dict[str, Any]:
    """A tube along the straight arm, that turns in the plane at the angle `side` about z."""
    bend = np.radians(bend_deg)
    way = (np.sin(bend) * np.cos(side), np.sin(bend) * np.sin(side), np.cos(bend))
    end = (0.2 * way[0], 0.2 * way[1], at + 0.2 * way[2])
    return {"inside_tube": {"points": [(0, 0, -0.03), (0, 0, at), end], "radius": radius}}


@pytest.mark.parametrize("bend_deg", [5, 30, 90])
def test_the_wall_at_a_bend_is_as_far_as_its_points_are(bend_deg):
    """Against the nearest of many points of the wall, in the axes of a bend at the origin."""
    bend, radius, rng = np.radians(bend_deg), 0.02, np.random.default_rng(bend_deg)
    surface = ContactSurface(scene(bent_tube(bend_deg, 0.1, radius)).objects[0], 0.0)
    ways = np.array([[0, 0, -1], [np.sin(bend), 0, np.cos(bend)]])  # of both pieces, from the bend
    turned = np.linspace(0, 2 * np.pi, 721)
    ring = np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=1)
    wall = []
    for way, other in (ways, ways[::-1]):
        across = np.cross([0, 1, 0], way)
        frame = np.array([across, [0, 1, 0], way])
        lines = np.arange(0, 0.03, 3e-4)[:, None, None] * [0, 0, 1] + radius * ring
        points = lines.reshape(-1, 3) @ frame
        share = np.maximum(points @ other, 0)[:, None]
        wall.append(points[np.linalg.norm(points - share * other, axis=1) >= radius])
    along = ways[1] - ways[0]
    along /= np.linalg.norm(along)
    inwards = np.cross([0, 1, 0], along)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2001)[:, None]
    wall.append(radius * (np.cos(angle) / np.cos(bend / 2) * inwards + np.sin(angle) * [0, 1, 0]))
    for turn in np.linspace(-bend / 2, bend / 2, 100):  # the outer side is a part of a sphere
        outwards = np.sin(turn) * along - np.cos(turn) * inwards
        wall.append(radius * (np.cos(angle) * outwards + np.sin(angle) * [0, 1, 0]))
    wall = np.concatenate(wall)
    ridges, base = 0, np.array([0, 0, 0.1])
    for _ in range(40):
        flat = rng.uniform(0.001, 0.008) * np.array([np.cos(a := rng.uniform(-3, 3)), np.sin(a)])
        place = flat[0] * inwards + flat[1] * np.array([0, 1, 0])
        place += rng.uniform(-1, 1) * 0.02 * np.sin(bend / 2) * along
        found = surface.at(place + base)
        nearest = place - wall[np.linalg.norm(wall - place, axis=1).argmin()]
        assert found.distance == pytest.approx(np.linalg.norm(nearest), abs=2e-6)
        assert surface.distances(place[None] + base) == pytest.approx(found.distance)
        assert np.linalg.norm(found.normal) == pytest.approx(1, abs=1e-5)
        slope = [
            (surface.at(base + place + step).distance - surface.at(base + place - step).distance)
            / 2e-6
            for step in 1e-6 * np.eye(3)
        ]
        assert slope == pytest.approx(found.normal, abs=2e-4)
        ridges += np.linalg.eigvalsh(found.curvature)[-1] > 10
    assert ridges >= 3


@pytest.mark.parametrize("native", [True, False])
def test_an_arm_leans_on_the_inner_side_of_a_bend_as_on_a_wire(native, compiled, monkeypatch):
    """A wire along the ridge, if the arm bends in the plane of the bend."""
    model = stiffopt.Manipulator(stiffopt.RobotDescription(**TWO.mapping()))
    if not native:
        monkeypatch.setattr(ContactProblem, "_native", None)
    p = np.array([0.4e5, 0.0, 0.0, 0.4e5, 0.0, 0.0])
    tip = model.pose(p, TWO.length)[:3, 3]
    side = np.arctan2(tip[1], tip[0])
    towards, across = (np.array([np.cos(a), np.sin(a), 0]) for a in (side, side + np.pi / 2))
    bend, at, radius = np.radians(20), 0.14, 0.022
    edge = np.array([0, 0, at]) + radius * (towards - np.tan(bend / 2) * np.array([0, 0, 1]))
    wire = {"from": tuple(edge - 0.05 * across), "to": tuple(edge + 0.05 * across), "radius": 1e-9}
    in_tube = model.contact_equilibrium(p, scene(bent_tube(20, at, radius, side)))
    on_wire = model.contact_equilibrium(p, scene({"capsule": wire}))
    (one,), (other,) = in_tube.contacts, on_wire.contacts
    assert np.linalg.norm(one.force) > 0.05
    assert one.force == pytest.approx(other.force, abs=1e-6)
    assert one.at == pytest.approx(other.at, abs=1e-6)
    assert one.position == pytest.approx(edge, abs=1e-6)
    assert in_tube.tip_pose == pytest.approx(on_wire.tip_pose, abs=1e-7)
    assert in_tube.stiffness(towards) == pytest.approx(on_wire.stiffness(towards), rel=1e-4)


def test_an_arm_in_a_bent_tube_is_where_an_independent_rod_is():
    """The rod: elements of 0.12 mm by IPOPT, the nearest points of ridges by Newton's method."""
    points = [(0, 0, -0.02), (0, 0, 0.06), (0.00289, 0.00094, 0.12), (-0.00304, -0.00012, 0.24)]
    tube = {"inside_tube": {"points": points, "radius": 0.02}}
    found = robot().contact_equilibrium([26500.0, 0, 0, 0, 0, 0], scene(tube))
    (contact,) = found.contacts
    assert found.tip_pose[:3, 3] == pytest.approx([-4.8762e-3, 1.1548e-3, 181.1100e-3], abs=2e-6)
    assert np.linalg.norm(contact.force) == pytest.approx(71.453e-3, rel=2e-3)
    assert contact.at == pytest.approx(119.44e-3, abs=2e-4)
    assert found.stiffness(X) == pytest.approx(17.313, rel=0.02)


def test_a_line_in_a_tube_is_found_with_other_contacts_along_it(monkeypatch):
    """The way is lost with contacts one radius apart; the rod is the one above."""
    points = [(0, 0, -0.03), (0, 0, 0.16573), (0.03655, 0.00223, 0.36235)]
    tube = {"inside_tube": {"points": points, "radius": 0.02407}}
    p, model = [59170, 2470, 25290, 79940, 73380, 0], robot(TWO.under((6.0, 0, 5.0), 0.0))
    found = model.contact_equilibrium(p, scene(tube))
    assert found.tip_pose[:3, 3] == pytest.approx([3.4491e-3, -8.6904e-3, 191.3427e-3], abs=3e-5)
    assert found.normal_forces.sum() == pytest.approx(393.3e-3, rel=0.01)
    assert found.stiffness(X) == pytest.approx(19.23, rel=0.02)
    near = model.contact_equilibrium(np.add(p, 100.0), scene(tube), nearby=found)
    assert np.linalg.norm(near.tip_pose[:3, 3] - found.tip_pose[:3, 3]) < 2e-4
    monkeypatch.setattr("stiffopt.model.contact.equilibrium.SPACINGS", (1.0,))
    with pytest.raises(EquilibriumError, match="lying along"):
        model.contact_equilibrium(p, scene(tube))


def test_a_contact_in_a_tube_opens_while_another_one_holds():
    """Its force is then against that of the other contact, which must not seem to have turned."""
    points = [(0, 0, -0.03), (0, 0, 0.106), (0.0012, -0.0005, 0.166), (0.0382, 0.0176, 0.3615)]
    tube = {"inside_tube": {"points": points, "radius": 0.0203}}
    p = [15e3, 28e3, 43e3, 0, 29e3, 99e3]
    found = robot(TWO.under((6.0, 0, 5.0), 0.0)).contact_equilibrium(p, scene(tube))
    assert sorted(each.at for each in found.contacts) == pytest.approx([0.1163, 0.18], abs=1e-4)


# -- machine code ---------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [TWO, TWO.under((0, 0, 9.81), 0.02), ARMS["3 segments, mixed"]])
def test_machine_code_and_numpy_find_the_same(arm, compiled, monkeypatch):
    p = np.random.default_rng(5).uniform(0, 1e5, arm.n)
    model = stiffopt.Manipulator(stiffopt.RobotDescription(**arm.mapping()))
    T = model.pose(p, 0.7 * arm.length)
    ball = {"sphere": {"centre": tuple(T[:3, 3] - 0.02 * T[:3, 0]), "radius": 0.009}}
    free = model.clearance(p, scene(ball))
    assert free < -0.002
    first = model.contact_equilibrium(p, scene(ball))
    assert first._arm.problem._native is not None
    with monkeypatch.context() as patch:
        patch.setattr(ContactProblem, "_native", None)
        second = model.contact_equilibrium(p, scene(ball))
        assert second.stable == first.stable
        assert second.tip_compliance == pytest.approx(first.tip_compliance, rel=1e-5, abs=1e-6)
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=1e-7)
    for one, other in zip(first.contacts, second.contacts, strict=True):
        assert one.force == pytest.approx(other.force, abs=1e-6)
        assert one.at == pytest.approx(other.at, abs=1e-6)
    for push_by in (0.05, -0.05):
        near = model.contact_equilibrium(p, scene(ball), load=push(push_by))
        K = stiffness_left(near._arm)
        definite = np.linalg.eigvalsh((K + K.T) / 2)[0] > 0
        assert near._arm.is_stable == definite
