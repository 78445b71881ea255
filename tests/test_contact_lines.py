"""Arms that lie along objects, and arms in bent tubes, whose contacts can be lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import stiffopt
from contact_scenes import REST, TWO, X, robot, scene, table
from independent.arms import FLOP
from independent.sections import rod_section
from stiffopt.errors import EquilibriumError
from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.surface import ContactSurface
from stiffopt.model.shooting import mass_per_length
from stiffopt.optimise.leaning import FORCE_ON, BracedProblem
from stiffopt.optimise.settings import BRACE


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


def test_the_search_limits_the_forces_along_a_line_together():
    model, objects = robot(TWO.under((3.0, 0.0, 0.0))), scene(table(0.0005))
    found = model.contact_equilibrium(REST, objects)
    (item,) = scene(table(0.0005), max_force=0.1).objects
    task = stiffopt.Task(
        robot="stiff-flop-2",
        target={"position": tuple(found.tip_pose[:3, 3])},
        stiffness={"maximise": {"direction": [0, 1, 0]}},
        scene={"objects": [item]},
        brace={"objects": [item.name]},
    )
    problem = BracedProblem(model, task)
    point = problem.pose(REST / problem.unit)
    row = next(c.first for c in point.constraints if c.name.startswith(FORCE_ON))
    limit = (1 - problem.spare) * 0.1
    expected = BRACE.force + found.normal_forces.sum() - limit
    assert point.residual[row] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(point.jacobian[row], point.force_gradient)


@pytest.mark.parametrize("gap", [0.002, 0.006])
def test_machine_code_and_numpy_lie_on_a_table_alike(gap, compiled, monkeypatch):
    model = stiffopt.Manipulator(stiffopt.RobotDescription(**TWO.under((6.0, 0.0, 1.0)).mapping()))
    first = model.contact_equilibrium(REST, scene(table(gap)))
    with monkeypatch.context() as patch:
        patch.setattr(ContactProblem, "_native", None)
        second = model.contact_equilibrium(REST, scene(table(gap)))
    assert first.normal_forces.sum() == pytest.approx(second.normal_forces.sum(), rel=2e-3)
    assert first.tip_pose == pytest.approx(second.tip_pose, abs=5e-6)


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
