"""The simulated arm against PyElastica, which shares no code with it: where the tip rests.

Linear silicone without pressure, section constants matched; within 1 % of length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from conftest import is_long
from independent.arms import FLOP, Arm
from independent.rods import planar_tip
from pyelastica_peer import relax
from references import beam
from stiffopt.model.description import RobotDescription
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import PlantLoad, PlantSettings, Silicone

LINEAR = Silicone(law="linear", creep=(), hysteresis=())
NONE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    segments: int
    gravity: tuple[float, float, float] = NONE
    tip_mass: float = 0.0
    force: tuple[float, float, float] = NONE
    moment: tuple[float, float, float] = NONE


CASES = {
    "across": Case(1, force=(0.9, 0, 0)),
    "oblique": Case(2, force=(0.1, -0.15, 0.08)),
    "pushed down": Case(2, force=(0.1, 0.05, -0.12)),
    "moment": Case(2, moment=(0.06, 0.03, 0)),
    "force and moment": Case(1, force=(-0.2, 0.3, 0.1), moment=(0, 0.05, 0.01)),
    "horizontal": Case(2, gravity=(9.81, 0, 0), tip_mass=0.02),
    "horizontal, pushed sideways": Case(2, gravity=(0, -9.81, 0), tip_mass=0.01, force=(0.2, 0, 0)),
    "hanging, pulled": Case(2, gravity=(0, 0, 9.81), tip_mass=0.02, force=(0.4, 0.1, 0)),
    "upright": Case(1, gravity=(0, 0, -9.81), tip_mass=0.01, force=(0.25, 0.25, 0)),
    "tilted": Case(2, gravity=(6, 2, 7.5), tip_mass=0.03, moment=(0.01, 0, 0)),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", CASES)
def test_static_tip(name):
    case = CASES[name]
    arm = Arm((FLOP,) * case.segments).under(case.gravity, case.tip_mass)
    settings = PlantSettings(dynamics="quasi-static", silicone=LINEAR)
    plant = Plant(RobotDescription(**arm.mapping()), settings)
    plant.settle(np.zeros(arm.n), PlantLoad(force=case.force, moment=case.moment))
    peer = relax(
        beam(FLOP),
        arm.length,
        tip_mass=case.tip_mass,
        gravity=case.gravity,
        force=case.force,
        moment=case.moment,
    )
    moved = np.linalg.norm(peer.tip - [0, 0, arm.length])
    assert peer.drift < 5e-4 * arm.length
    assert moved > 0.2 * arm.length  # or nothing is tested
    assert np.linalg.norm(plant.tip_pose()[:3, 3] - peer.tip) < 0.01 * arm.length


def test_peer_against_collocation():
    """A rod that hardly stretches, where PyElastica's mechanics are the plant's."""
    tube = replace(FLOP, factors=(0.0, 12.0, 1.0))
    arm, section = Arm((tube,)), beam(tube)
    force = 3 * section.bending / arm.length**2
    x, z, _ = planar_tip(arm, np.zeros(3), (force, 0))
    for elements, tolerance in ((30, 2e-4), (60, 5e-5))[: 2 if is_long() else 1]:
        peer = relax(section, arm.length, force=(force, 0, 0), elements=elements)
        assert peer.tip == pytest.approx([x, 0, z], abs=tolerance)
