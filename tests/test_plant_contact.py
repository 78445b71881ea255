"""The simulated arm among objects: its own contact against formulas and the model's equilibria."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import stiffopt
from independent.arms import FLOP, Arm
from references import beam
from stiffopt.errors import FileError, InputError
from stiffopt.plant import contact
from stiffopt.plant.build import make_rod
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    TOUCHABLE,
    Discretisation,
    Mismatch,
    PlantLoad,
    PlantSettings,
    Silicone,
    plant_of,
)
from stiffopt.rig.config import load_rig_description

LINEAR = Silicone(law="linear", damping=0.0, creep=(), hysteresis=())
TWO = Arm((FLOP, FLOP))
STIFF = Arm((replace(FLOP, factors=(0.0, 1e5, 1.0)),) * 2)  # neither shears nor stretches
RADIUS, LENGTH = FLOP.outer_radius, TWO.length
NOTHING = np.zeros(6)


def scene(*shapes: dict[str, Any], **given: Any) -> stiffopt.Scene:
    touched = {"allowed": True, **given}
    objects = [{"name": str(i), "contact": touched, **each} for i, each in enumerate(shapes)]
    return stiffopt.Scene(objects=objects)


def post(at: float, away: float = 0.0, radius: float = 0.005) -> dict[str, Any]:
    """A post across the arm at a height, on its side x."""
    x = RADIUS + radius + away
    return {"capsule": {"from": (x, -0.05, at), "to": (x, 0.05, at), "radius": radius}}


WALL = {"half_space": {"point": (0.025, 0, 0.1), "normal": (-1, 0, 0)}}
TURNED = (float(np.cos(0.3)), 0.0, float(np.sin(0.3)), 0.0)
SHAPES = {
    "sphere": {"sphere": {"centre": (0.03, 0.004, 0.15), "radius": 0.008}},
    "capsule": post(0.13, 0.004),
    "inside_tube": {"inside_tube": {"points": [(0, 0, -0.03), (0, 0, 0.1), (0.01, 0, 0.25)],
                                    "radius": 0.022}},
    "half_space": WALL,
    "cylinder": {"cylinder": {"from": (0.026, -0.02, 0.14), "to": (0.026, 0.005, 0.14),
                              "radius": 0.006}},
    "box": {"box": {"centre": (0.043, 0.002, 0.15), "size": (0.04, 0.02, 0.03),
                    "orientation": TURNED}},
}  # fmt: skip


def make(arm: Arm, around: stiffopt.Scene | None, **settings: Any) -> Plant:
    settings = {"dynamics": "quasi-static", "silicone": LINEAR, "scene": around} | settings
    return Plant(stiffopt.RobotDescription(**arm.mapping()), PlantSettings(**settings))


def surroundings(around: stiffopt.Scene) -> contact.Surroundings:
    robot = stiffopt.RobotDescription(**TWO.mapping())
    rod = make_rod(robot, PlantSettings(), Mismatch(), None)
    return contact.make_surroundings(around, robot, rod)


@pytest.mark.parametrize("kind", TOUCHABLE)
def test_distances_are_those_of_the_shapes(kind):
    """Of the formulas that tasks use, which are written in CasADi; gradients by differences."""
    (item,) = scene(SHAPES[kind]).objects
    around, normal = surroundings(scene(SHAPES[kind])), np.empty(3)
    for x in np.random.default_rng(4).uniform((-0.03, -0.03, -0.01), (0.06, 0.03, 0.26), (60, 3)):
        value = contact.distance(around, 0, x, normal)
        assert value == pytest.approx(item.shape.distance_of(x), abs=1e-9)
        slopes = [
            (item.shape.distance_of(x + step) - item.shape.distance_of(x - step)) / 2e-7
            for step in 1e-7 * np.eye(3)
        ]
        assert normal == pytest.approx(slopes, abs=1e-4)


@pytest.mark.parametrize(("share", "times"), [(0.5, 4.57), (0.65, 9.75), (0.8, 31.25)])
def test_a_straight_arm_against_a_post(share, times):
    """A cantilever on a roller: its tip is stiffer by ``1 / (1 - C_ts^2 / (C_tt C_ss))``."""
    length = STIFF.length
    mesh = Discretisation(bending_degree=5, sub_intervals=6)
    plant, tips = make(STIFF, scene(post(share * length)), discretisation=mesh), []
    unit = 0.05 * beam(STIFF.tubes[0]).bending / length**2
    for force in (unit, 2 * unit):
        plant.settle(NOTHING, PlantLoad(force=(force, 0, 0)))
        tips.append(plant.tip_pose()[0, 3])
    (pushed,) = plant.object_forces()
    assert pushed.at == pytest.approx(share * length, abs=0.03 * RADIUS)
    share = pushed.at / length
    ts, tt, ss = share**2 * (3 - share) / 6, 1 / 3, share**3 / 3
    assert 1 / (1 - ts**2 / (tt * ss)) == pytest.approx(times, rel=0.05)
    times = 1 / (1 - ts**2 / (tt * ss))
    assert np.linalg.norm(pushed.force) == pytest.approx(2 * unit * ts / ss, rel=0.02)
    free = 3 * beam(STIFF.tubes[0]).bending / length**3
    assert unit / (tips[1] - tips[0]) == pytest.approx(times * free, rel=0.03)


PRESSED = {
    **{kind: (scene(shape), 0.06) for kind, shape in SHAPES.items()},
    "two posts": (scene(post(0.06, 0.001), post(0.13, 0.004)), 0.08),
    "a soft post": (scene(post(0.12, 0.002), stiffness=100.0), 0.06),
    "a soft wall": (scene(WALL, stiffness=100.0), 0.06),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", PRESSED)
def test_against_the_models_equilibrium(name):
    """At rest and loaded, where model and plant are one arm: their contacts alone differ."""
    around, force = PRESSED[name]
    plant, load = make(TWO, around), (force, 0.0, 0.01)
    robot = stiffopt.Manipulator(plant.robot)
    expected = robot.contact_equilibrium(NOTHING, around, load=[*load, 0, 0, 0])
    for share in (0.3, 0.6, 1.0):
        plant.settle(NOTHING, PlantLoad(force=tuple(share * np.array(load))))
    off = plant.tip_pose()[:3, 3] - expected.tip_pose[:3, 3]
    assert np.linalg.norm(off) < 0.003 * LENGTH
    found = {each.object: each for each in plant.object_forces()}
    assert set(found) == {each.object for each in expected.contacts}
    for each in expected.contacts:
        mine = found[each.object]
        assert np.linalg.norm(mine.force - each.force) < 0.1 * np.linalg.norm(each.force) + 1e-3
        assert mine.at == pytest.approx(each.at, abs=0.15 * RADIUS)
        assert mine.depth < 1e-4


def test_it_sticks_and_then_slides():
    """The tip on a wall with friction, pushed along it: it stays, and then drags with mu N."""
    around = scene(WALL, friction=0.4)
    viscous = LINEAR.model_copy(update={"damping": 0.1})
    plant = make(TWO, around, silicone=viscous, discretisation=Discretisation(step=0.005))
    plant.settle(NOTHING, PlantLoad(force=(0.08, 0, 0)))
    (at_rest,) = plant.object_forces()
    assert abs(at_rest.force[1]) < 1e-9  # a settled arm has none
    tips, ratios = [plant.tip_pose()[1, 3]], []
    free = 0.005 / stiffopt.Manipulator(plant.robot).stiffness(NOTHING, [0, 1, 0])
    for push in (0.005, 0.08):
        plant.set_load(PlantLoad(force=(0.08, push, 0)))
        plant.advance(1.0, NOTHING)
        (on,) = plant.object_forces()
        tips.append(plant.tip_pose()[1, 3])
        ratios.append(np.linalg.norm(on.force[1:]) / abs(on.force[0]))
    assert tips[1] - tips[0] < 0.1 * free  # it rolls a little
    assert ratios[0] < 0.4 - 0.05
    assert tips[2] - tips[1] > free
    assert ratios[1] == pytest.approx(0.4, rel=0.01)
    assert on.force[1] < 0


def test_an_arm_with_inertia_hits_a_wall_and_comes_to_rest():
    around, p = scene(WALL, friction=0.2), 1e5 * np.array([0, 0.5, 0.5, 0, 0.6, 0.5])
    plant = make(TWO, around, dynamics="full", silicone=Silicone())
    lost, forces = 0.0, []
    for _ in range(60):
        plant.advance(0.02, p)
        energies = plant.energies()
        assert energies.dissipated >= lost - 1e-9
        lost = energies.dissipated
        forces += [np.linalg.norm(each.force) for each in plant.object_forces()]
        assert all(each.depth < 1e-4 for each in plant.object_forces())
    assert energies.kinetic < 1e-6
    assert max(forces) > forces[-1] > 0.05
    still = make(TWO, around, silicone=Silicone())
    still.advance(1.2, p)
    assert still.tip_pose()[:3, 3] == pytest.approx(plant.tip_pose()[:3, 3], abs=1e-3)


RIG = """
format: stiffopt-rig/1
robot: stiff-flop-2
supply: {driver: simulated}
"""
SCENE = """
  objects:
  - name: post
    sphere: {centre: [40 mm, 0 mm, 120 mm], radius: 5 mm}
    contact: {allowed: true, friction: 0.2}
  - {name: rib, sphere: {centre: [-40 mm, 0 mm, 120 mm], radius: 5 mm}}
"""


def test_it_meets_what_it_may_lean_on_or_what_it_is_told(tmp_path):
    file = tmp_path / "rig.yaml"
    file.write_text(RIG + "scene:" + SCENE)
    met = plant_of(load_rig_description(file)).scene
    assert [item.name for item in met.objects] == ["post"]
    file.write_text(RIG + "plant:\n  scene:" + SCENE.replace("\n", "\n  "))
    met = plant_of(load_rig_description(file)).scene
    assert [item.name for item in met.objects] == ["post", "rib"]
    file.write_text(RIG)
    assert plant_of(load_rig_description(file)).scene is None


def test_what_it_cannot_touch_is_refused(tmp_path):
    file = tmp_path / "rig.yaml"
    ring = "trocar: {centre: [0 mm, 0 mm, 50 mm], axis: [0, 0, 1], radius: 20 mm}"
    objects = f"  objects:\n  - {{name: ring, contact: {{allowed: true}}, {ring}}}\n"
    file.write_text(RIG + "scene:\n" + objects)
    with pytest.raises(InputError, match="cannot touch 'ring', a trocar; give what it"):
        plant_of(load_rig_description(file))
    file.write_text(RIG + "plant:\n  scene:\n" + objects.replace("  ", "    "))
    with pytest.raises(FileError, match="cannot touch 'ring'"):
        load_rig_description(file)
    inside = "\n  objects:\n  - {name: ball, sphere: {centre: [0 m, 0 m, 5 mm], radius: 9 mm}}\n"
    file.write_text(RIG + "plant:\n  scene:" + inside.replace("\n", "\n  "))
    with pytest.raises(FileError, match="ball"):
        load_rig_description(file)
