"""The simulated arm at rest against exact results and references that share no code with it."""

from __future__ import annotations

import errno
import fcntl
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from independent.arms import ARMS, FLOP, Arm
from independent.rods import Load as Reference
from independent.rods import planar_tip, rod_tip
from independent.sections import silicone
from made_plants import BAR, ONE, PLAIN, STIFF, TWO, make, material, settled
from references import (
    beam,
    elastica_tip,
    fibre_bending,
    free_tip,
    loaded_tip,
    stretch_under,
    tip_compliance,
)
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.plant import jit
from stiffopt.plant.settings import (
    Discretisation,
    Mismatch,
    PlantLoad,
)
from stiffopt.registration import Placement


@pytest.mark.parametrize("tubes", [1, 2])
@pytest.mark.parametrize("share", [1.0, 5.0, 13.0])
def test_elastica(share, tubes):
    arm = Arm((STIFF,) * tubes)
    force = share * beam(STIFF).bending / arm.length**2
    T = settled(arm, load=PlantLoad(force=(force, 0, 0)))
    x, z, angle = elastica_tip(share)
    assert T[:3, 3] == pytest.approx([x * arm.length, 0, z * arm.length], abs=1e-4)
    assert np.arctan2(T[0, 2], T[2, 2]) == pytest.approx(angle, abs=5e-3)


@pytest.mark.one_in(2, "share")
@pytest.mark.parametrize(("tubes", "share"), [(1, 1.0), (1, 5.0), (2, 5.0), (2, 13.0)])
def test_elastica_that_shears_and_stretches(share, tubes):
    arm = Arm((FLOP,) * tubes)
    force = share * beam(FLOP).bending / arm.length**2
    T = settled(arm, load=PlantLoad(force=(0, force, 0)))
    expected = loaded_tip(arm, np.zeros(arm.n), [Reference((0, force, 0))], steps=8)
    assert T[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-4)


def test_a_stubby_elastica_on_a_finer_mesh():
    """One segment under 6 N across: it shears by a third of what it bends."""
    force = 13 * beam(FLOP).bending / ONE.length**2
    mesh = Discretisation(bending_degree=5, shear_degree=3, sub_intervals=8)
    T = settled(ONE, load=PlantLoad(force=(0, force, 0)), discretisation=mesh)
    x, z, _ = planar_tip(ONE, np.zeros(3), (force, 0))
    assert T[:3, 3] == pytest.approx([0, x, z], abs=1e-4)


@pytest.mark.parametrize("frame", ["base", "tip"])
@pytest.mark.parametrize("arm", [ONE, TWO], ids=["one segment", "two"])
def test_pure_moment_bends_to_a_full_circle(arm, frame):
    moment = 2 * np.pi * beam(FLOP).bending / arm.length
    T = settled(arm, load=PlantLoad(moment=(0, moment, 0), frame=frame))
    assert pytest.approx(np.eye(4), abs=1e-6) == T


@pytest.mark.parametrize("arm", [ONE, TWO], ids=["one segment", "two"])
def test_pressure_alone_bends_to_arcs(arm):
    p = BAR * np.array([0.9, 0.2, 0.1, 0.0, 0.6, 0.3])[: arm.n]
    assert settled(arm, p) == pytest.approx(free_tip(arm, p), abs=1e-6)


PRESSED = {
    "one segment, straight": (ONE, [0.0, 0.0, 0.0]),
    "one segment, bent": (ONE, [1.0, 0.2, 0.0]),
    "two segments, bent apart": (TWO, [0.9, 0.2, 0.0, 0.1, 0.8, 0.3]),
    "two segments, stretched": (TWO, [0.7, 0.7, 0.7, 0.5, 0.5, 0.5]),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", PRESSED)
def test_small_load_compliance(name):
    arm, bar = PRESSED[name]
    p = BAR * np.array(bar)
    plant, sizes = make(arm), [1e-3] * 3 + [2e-5] * 3
    plant.settle(p)
    T, columns = plant.tip_pose(), []
    for wrench in np.diag(sizes):
        ends = []
        for sign in (1, -1):
            f, m = sign * wrench[:3], sign * wrench[3:]
            plant.settle(p, PlantLoad(force=tuple(f), moment=tuple(m), frame="tip"))
            ends.append(plant.tip_pose())
        change = np.linalg.inv(T) @ (ends[0] - ends[1]) / (2 * wrench.max())
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    expected = tip_compliance(arm, p)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((np.array(columns).T - expected) / size).max() < 1e-3


LOADED = {
    "dead force": [Reference((0.06, -0.1, 0.05), (1e-3, 0, 5e-4))],
    "follower": [Reference((0.05, 0.1, 0), (0, 2e-3, 1e-3), follower=True)],
    "dead, along the arm": [Reference((0.1, -0.15, 0), (0, 1e-3, 0), at=0.05)],
    "follower, along the arm": [Reference((0.1, 0.2, 0.1), at=0.12, follower=True)],
    "beyond buckling": [Reference((0.03, 0.02, -0.35))],
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", LOADED)
def test_load_against_the_rod_shot_from_its_tip(name):
    (load,) = LOADED[name]
    p = np.zeros(6) if name == "beyond buckling" else BAR * np.array([0.5, 0.2, 0, 0.3, 0.8, 0.0])
    frame = "tip" if load.follower else "base"
    acting = PlantLoad(force=load.force, moment=load.moment, frame=frame, at=load.at)
    expected = loaded_tip(TWO, p, [load], steps=8)
    assert settled(TWO, p, acting) == pytest.approx(expected, abs=1e-3)  # rotations
    assert settled(TWO, p, acting)[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-4)


MOUNTINGS = {
    "hanging": (0.0, 0.0, 9.81),
    "horizontal": (9.81, 0.0, 0.0),
    "horizontal, about another axis": (0.0, -9.81, 0.0),
    "tilted": (5.0, 3.0, 7.0),
    "upright, on the moon": (0.1, 0.0, -1.62),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", MOUNTINGS)
def test_gravity_in_every_mounting(name):
    arm = TWO.under(MOUNTINGS[name], 0.02)
    p = BAR * np.array([0.4, 0.0, 0.1, 0.0, 0.5, 0.2])
    expected = loaded_tip(arm, p)[:3, 3]
    assert settled(arm, p)[:3, 3] == pytest.approx(expected, abs=1e-4)
    bare = TWO.under((0, 0, 0.1))  # the plant's settings overrule the robot file
    T = settled(bare, p, gravity=MOUNTINGS[name], payload=0.02)
    assert T[:3, 3] == pytest.approx(expected, abs=1e-4)


def test_sections_off_the_axis_and_connectors():
    """Three different segments, centroids beside the axis, against the rod from its base."""
    arm = ARMS["3 segments, mixed"].under((2.0, 1.0, 9.0), 0.01)
    load = Reference((0.05, -0.08, 0.02), (1e-3, 0, 5e-4))
    T = settled(arm, load=PlantLoad(force=load.force, moment=load.moment))
    expected = rod_tip(arm, np.zeros(arm.n), [load], steps=6)
    assert T[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-4)
    assert T[:3, :3] == pytest.approx(expected[:3, :3], abs=1e-3)


def test_a_mismatch_is_what_it_says():
    """Modulus, length, gain, offset, angle and base of the arm that there really is."""
    tube = replace(PLAIN, youngs_modulus=1.1 * PLAIN.youngs_modulus, length=1.02 * PLAIN.length)
    tilt = np.array([np.cos(0.05), np.sin(0.05), 0, 0])  # by 0.1 rad about x
    T_base = np.eye(4)
    T_base[1:3, 1:3] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
    T_base[:3, 3] = 0.001, 0.002, 0.003
    true = Arm((replace(tube, angles=tuple(angle + 10 for angle in tube.angles)),))
    true = true.under(T_base[:3, :3].T @ (3.0, 0.0, 9.0), 0.01)
    p = BAR * np.array([0.5, 0.1, 0.0])
    expected = T_base @ loaded_tip(true, 0.9 * p + 2000.0)
    mismatch = Mismatch(
        gain=(0.9,) * 3,
        offset=(2000.0,) * 3,
        angle=(np.radians(10.0),) * 3,
        modulus=(1.1,),
        length=(1.02,),
        base=Placement(position=(0.001, 0.002, 0.003), orientation=tuple(tilt)),
    )
    T = settled(Arm((PLAIN,)).under((3, 0, 9), 0.01), p, mismatch=mismatch)
    assert T[:3, 3] == pytest.approx(expected[:3, 3], abs=2e-5)
    assert T[:3, :3] == pytest.approx(expected[:3, :3], abs=1e-3)


def test_another_installation_or_a_new_one_compiles_its_own(monkeypatch, tmp_path):
    """Numba does not use the code of other files, so its folder says that it is empty."""
    found = [jit._folder.__wrapped__()]
    source = Path(jit.__file__).with_name("rod.py").read_bytes()
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rod.py").write_bytes(source + b"# @jit")
        monkeypatch.setattr(jit, "__file__", str(tmp_path / name / "jit.py"))
        found.append(jit._folder.__wrapped__())
    os.utime(tmp_path / "two" / "rod.py", (1e9, 1e9))
    found.append(jit._folder.__wrapped__())
    assert len(set(found)) == len(found)
    assert jit._folder.__wrapped__() == found[-1]


@pytest.mark.filterwarnings("ignore::stiffopt.errors.SlowWarning")
def test_a_file_system_without_locks_is_no_error(monkeypatch):
    def refuse(file, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(jit, "_done", False)
    monkeypatch.setattr(fcntl, "flock", refuse)
    with jit.compiling_once():
        pass


@pytest.mark.long
def test_random_arms_under_random_loads():
    rng = np.random.default_rng(11)
    for _ in range(15):
        tubes = int(rng.integers(1, 4))
        arm = Arm((replace(FLOP, connector=float(rng.choice([0.0, 0.01]))),) * tubes)
        arm = arm.under(np.array([0, 0, 9.0]) + rng.normal(0, 2.0, 3), rng.uniform(0, 0.02))
        p = rng.uniform(0, 0.5 * BAR, arm.n)
        load = Reference(
            rng.normal(0, 0.04, 3), rng.normal(0, 2e-3, 3), follower=bool(rng.integers(2))
        )
        frame = "tip" if load.follower else "base"
        acting = PlantLoad(force=tuple(load.force), moment=tuple(load.moment), frame=frame)
        expected = loaded_tip(arm, p, [load], steps=8)[:3, 3]
        assert settled(arm, p, acting)[:3, 3] == pytest.approx(expected, abs=1e-4)


def test_turning_the_world_turns_the_arm():
    """By 120 degrees: gravity, and each channel's pressure into the next channel."""
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    p = BAR * np.array([[0.4, 0.0, 0.1], [0.0, 0.5, 0.2]])
    here = settled(TWO.under((6, 0, 7), 0.02), p.ravel())
    there = settled(TWO.under(turn @ (6, 0, 7), 0.02), np.roll(p, 1, axis=1).ravel())
    assert there[:3, 3] == pytest.approx(turn @ here[:3, 3], abs=1e-7)


@pytest.mark.parametrize("law", ["neo-hookean", "yeoh"])
@pytest.mark.parametrize("stress", [-2e4, 1e4, 4e4])
def test_hyperelastic_stretch(law, stress):
    arm, area = Arm((PLAIN,)), silicone(PLAIN).area
    stretch = stretch_under(law, PLAIN.youngs_modulus, 0.2, stress)
    rubber = material(law=law, stiffening=0.2)
    T = settled(arm, load=PlantLoad(force=(0, 0, stress * area)), silicone=rubber)
    assert T[2, 3] == pytest.approx(arm.length * stretch, rel=1e-6)
    if stress > 0:  # the same by pressure
        bores = 6 * np.pi * PLAIN.chamber_radius**2
        T = settled(arm, [stress * area / bores] * 3, silicone=rubber)
        assert T[2, 3] == pytest.approx(arm.length * stretch, rel=1e-6)


@pytest.mark.parametrize("law", ["linear", "neo-hookean", "yeoh"])
def test_hyperelastic_bending(law):
    """A moment that bends a segment by about a right angle.

    The reference integrates over all fibres of the section; the plant has a few.
    """
    arm, moment = Arm((PLAIN,)), 0.06
    strain, curvature = fibre_bending(PLAIN, law, 0.3, (0.0, moment))
    rubber = material(law=law, stiffening=0.3)
    T = settled(arm, load=PlantLoad(moment=(0, moment, 0)), silicone=rubber)
    angle, radius = curvature * arm.length, (1 + strain) / curvature
    expected = [radius * (1 - np.cos(angle)), 0, radius * np.sin(angle)]
    assert angle > 1.4
    assert np.linalg.norm(T[:3, 3] - expected) < (1e-6 if law == "linear" else 1e-4)


@pytest.mark.parametrize("arm", [ONE, TWO], ids=["one segment", "two"])
@pytest.mark.parametrize("bar", [[1.2, 0.1, 0.0], [1.0, 1.0, 1.2]], ids=["bent", "stretched"])
def test_the_law_of_fibres_predicts_the_settled_arm(arm, bar):
    """The plant sums over a few fibres, under any load; the law is a formula of the section."""
    rubber, mapping = material(law="yeoh", stiffening=0.2), arm.mapping()
    for segment in mapping["segments"]:
        segment |= {"strain_law": "fibres", "law": {"stiffening": 0.2}}
    model = Manipulator(RobotDescription(**mapping))
    p = BAR * np.array([*bar, *bar[::-1]][: arm.n])
    T = settled(arm, p, silicone=rubber)
    assert np.linalg.norm(model.tip_pose(p)[:3, 3] - T[:3, 3]) < 1e-3 * arm.length
    for axis in np.eye(3):
        push = 1e-3 * axis
        there, back = (
            settled(arm, p, PlantLoad(force=tuple(sign * push)), silicone=rubber)[:3, 3] @ axis
            for sign in (1, -1)
        )
        assert model.stiffness(p, axis) == pytest.approx(2e-3 / (there - back), rel=5e-3)
