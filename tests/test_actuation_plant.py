"""Strain laws and their corrections against the simulated arm, whose rod is not the model's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from independent.arms import ARMS, FLOP, Arm
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

Vector = NDArray[np.float64]


def plant_of(description: RobotDescription, law: str = "linear") -> Any:
    """The simulated arm without creep and hysteresis."""
    pytest.importorskip("numba")
    from stiffopt.plant.plant import Plant
    from stiffopt.plant.settings import PlantSettings, Silicone

    silicone = Silicone(law=law, damping=0.0, creep=(), hysteresis=())
    return Plant(description, PlantSettings(silicone=silicone, dynamics="quasi-static"))


def described(arm: Arm, law: str = "rest-length", **compensation: float) -> RobotDescription:
    """An arm all of whose segments have a law, and some of their compensation replaced."""
    mapping = arm.mapping()
    for segment in mapping["segments"]:
        segment["strain_law"] = law
        segment["compensation"] = (segment["compensation"] or {}) | compensation
    return RobotDescription(**mapping)


def stiffness_of(plant: Any, p: Vector) -> Vector:
    """Stiffness (3,) of a simulated tip in the base axes, free, by forces of 0.2 mN."""
    from stiffopt.plant.settings import PlantLoad

    found = []
    for axis in np.eye(3):
        moved = []
        for force in (2e-4, -2e-4):
            plant.settle(p, PlantLoad(force=force * axis))
            moved.append(axis @ plant.tip_pose()[:3, 3])
        found.append(4e-4 / (moved[0] - moved[1]))
    return np.array(found)


@pytest.mark.filterwarnings("ignore:the simulator is compiled")
@pytest.mark.parametrize("name", ["1 segment", "3 segments, mixed"])
def test_the_rest_length_law_is_the_simulated_arm_of_linear_silicone(name: str) -> None:
    description = described(ARMS[name])
    plant, model = plant_of(description), Manipulator(description)
    rng = np.random.default_rng(5)
    for p in rng.uniform(0, 1e5, (6, description.n_pressures)):
        plant.settle(p)
        assert plant.tip_pose()[:3, 3] == pytest.approx(model.tip_pose(p)[:3, 3], abs=1e-6)


@pytest.mark.filterwarnings("ignore:the simulator is compiled")
@pytest.mark.parametrize("law", ["linear", "yeoh"])
def test_the_simulated_arm_is_stiff_without_bending_less(law: str) -> None:
    """Its free shapes are those of E and slope; what loads meet is what the model says."""
    p = np.array([1.1e5, 0.2e5, 0.5e5])
    plain, stiff = (
        described(ARMS["1 segment"]),
        described(ARMS["1 segment"], stiffness=1.4, softening=0.3),
    )
    plants = [plant_of(description, law) for description in (plain, stiff)]
    for plant in plants:
        plant.settle(p)
    assert plants[1].tip_pose() == pytest.approx(plants[0].tip_pose(), abs=1e-7)
    if law == "linear":
        expected = [Manipulator(stiff).stiffness(p, axis) for axis in np.eye(3)]
        assert stiffness_of(plants[1], p) == pytest.approx(expected, rel=1e-3)
    E, slope = 100e3, -0.2 * np.linalg.norm(p)
    ratio = 1.4 * (E + 0.3 * slope) / (E + slope)
    found = stiffness_of(plants[1], p) / stiffness_of(plants[0], p)
    assert found == pytest.approx(np.full(3, ratio), rel=2e-4)


@pytest.mark.filterwarnings("ignore:the simulator is compiled")
def test_a_simulated_arm_that_is_stiffer_takes_as_much_more_work() -> None:
    """The same shapes at the same pressures, which act more strongly."""
    trace = np.random.default_rng(7).uniform(0, 1e5, (50, 3))
    energies = []
    for stiffness in (1.0, 1.4):
        plant = plant_of(
            described(ARMS["1 segment"], modulus_per_pressure=0.0, stiffness=stiffness)
        )
        plant.follow(trace)
        energies.append(plant.energies())
    assert energies[0].elastic > 1e-4
    for name in ("elastic", "work"):
        plain, stiff = (getattr(energy, name) for energy in energies)
        assert stiff == pytest.approx(1.4 * plain, rel=1e-6)


@pytest.mark.filterwarnings("ignore:the simulator is compiled")
def test_the_simulated_arm_has_the_dead_band_of_the_model() -> None:
    """In one segment only, before gain and offset."""
    mapping = described(ARMS["2 segments"]).model_dump()
    mapping["segments"][1]["corrections"] = {
        "gain": (1.1, 0.9, 1.0),
        "offset": (1e3, 0.0, -500.0),
        "dead_band": 9e3,
    }
    description = RobotDescription(**mapping)
    plant, model = plant_of(description), Manipulator(description)
    for p in np.random.default_rng(8).uniform(0, 1e5, (4, 6)):
        plant.settle(p)
        assert plant.tip_pose() == pytest.approx(model.tip_pose(p), abs=1e-6)


@pytest.mark.parametrize("name", ["bending_radius", "lengthening"])
def test_the_simulated_arm_says_what_it_cannot_do(name: str) -> None:
    mapping = Arm((FLOP, FLOP)).mapping()
    mapping["segments"][1]["compensation"] = {name: 0.05}
    with pytest.raises(InputError, match=rf"has no segments\[1\]\.compensation\.{name}"):
        plant_of(RobotDescription(**mapping))
