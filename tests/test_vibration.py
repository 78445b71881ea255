"""The first bending mode against finite elements, closed forms and the simulated arm."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

import stiffopt as so
from independent.arms import FLOP, Arm
from stiffopt.control.vibration import BendingMode, BentMode
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import PlantSettings, Silicone

TWO = "stiff-flop-2-hanging"
STILL = Silicone(law="linear", damping=0.0, creep=(), hysteresis=())


def drawn(*lengths: float, tip_mass: float = 0.0, **changes: Any) -> so.RobotDescription:
    """An arm of like segments of these lengths."""
    mapping = Arm((FLOP,) * len(lengths)).mapping()
    for segment, length in zip(mapping["segments"], lengths, strict=True):
        segment |= {"length": length, **changes}
    return so.RobotDescription(**{**mapping, "tip_mass": tip_mass})


def section_mass() -> float:
    """Mass per length of the arm's silicone, in kg/m."""
    tube = FLOP
    holes = len(tube.angles) * tube.chamber_radius**2
    return tube.density * np.pi * (tube.outer_radius**2 - tube.inner_radius**2 - holes)


class Beam:
    """Euler-Bernoulli elements with cubic shapes, clamped at the base; unit stiffness EI."""

    def __init__(self, length: float, density: float, tip_mass: float, n: int = 60) -> None:
        h = length / n
        stiff = np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h**2, -6 * h, 4 * h**2],
            ]
        ) / h**3  # fmt: skip
        heavy = density * h / 420 * np.array(
            [
                [156, 22 * h, 54, -13 * h],
                [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                [54, 13 * h, 156, -22 * h],
                [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
            ]
        )  # fmt: skip
        K, M = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 2 * n + 2))
        for e in range(n):
            at = slice(2 * e, 2 * e + 4)
            K[at, at] += stiff
            M[at, at] += heavy
        M[-2, -2] += tip_mass
        self.h, self.n = h, n
        self.K, self.M = K[2:, 2:], M[2:, 2:]
        squares, shapes = eigh(self.K, self.M)
        self.square, self.shape = squares[0], shapes[:, 0] / shapes[-2, 0]
        pushed = np.zeros(2 * n)
        pushed[-2] = 1.0
        self.pushed = np.linalg.solve(self.K, pushed)

    def bent(self, first: float, last: float) -> np.ndarray:
        """Displacements when only the part between two stations is curved, by 1."""
        load = np.zeros(2 * self.n + 2)
        for e in range(self.n):
            if first <= (e + 0.5) * self.h <= last:  # a pair of unit moments bends an element
                load[2 * e + 1] -= 1.0
                load[2 * e + 3] += 1.0
        result: np.ndarray = np.linalg.solve(self.K, load[2:])
        return result


def test_uniform_beam_without_tip_mass_has_33_of_140_of_its_mass():
    found = BendingMode.of(drawn(0.09))
    assert found.mass == pytest.approx(33 / 140 * section_mass() * 0.09, rel=0.015)


@pytest.mark.parametrize("tip_mass", [0.0, 0.005, 0.02, 0.1])
@pytest.mark.parametrize("lengths", [(0.09,), (0.09, 0.09), (0.06, 0.12)])
def test_mass_makes_the_frequency_of_a_beam_of_finite_elements(lengths, tip_mass):
    """With the static stiffness 3 EI / L^3, up to the static shape's error (1.5 %)."""
    beam = Beam(sum(lengths), section_mass(), tip_mass)
    found = BendingMode.of(drawn(*lengths, tip_mass=tip_mass))
    stiffness = 1 / beam.pushed[-2]
    assert stiffness == pytest.approx(3 / sum(lengths) ** 3, rel=1e-6)
    omega = found.frequency(stiffness)
    assert omega == pytest.approx(np.sqrt(beam.square), rel=0.02)
    assert omega >= np.sqrt(beam.square) * 0.995  # Rayleigh: never below, but for steps


@pytest.mark.parametrize("tip_mass", [0.0, 0.02])
def test_participation_is_what_the_true_mode_has_of_the_static_shape(tip_mass):
    """A pressure step excites the mode by phi M x / phi M phi of the finite-element beam."""
    beam = Beam(0.27, section_mass(), tip_mass)
    found = BendingMode.of(drawn(0.09, 0.09, 0.09, tip_mass=tip_mass))
    for index in range(3):
        x = beam.bent(0.09 * index, 0.09 * (index + 1))
        share = beam.shape @ beam.M @ x / (beam.shape @ beam.M @ beam.shape) / x[-2]
        assert found.participation[3 * index : 3 * index + 3] == pytest.approx(share, abs=0.035)


def test_participation_of_a_hanging_arm_is_that_of_the_modes_of_its_model():
    """Masses at stations, their compliances to each other and their Jacobians, under gravity."""
    robot = so.load_robot(TWO)
    description = robot.description
    ends = np.concatenate([[0], np.cumsum([s.length for s in description.segments])])
    at = np.concatenate([a + (b - a) * (np.arange(6) + 0.5) / 6 for a, b in pairwise(ends)])
    at = np.append(at, ends[-1])
    masses = np.append(np.full(12, section_mass() * 0.09 / 6), description.tip_mass)
    p, n = np.zeros(6), len(at)
    first, second = (each.ravel() for each in np.meshgrid(at, at, indexing="ij"))
    C = robot.compliance_between(p, first, second)[:, 0, 0].reshape(n, n)  # along x
    root = np.sqrt(masses)
    phi = eigh(root[:, None] * C * root)[1][:, -1] / root
    jacobian = np.array([robot.body_jacobian(p, s)[0] for s in at])  # straight: base axes
    eta = phi @ (masses[:, None] * jacobian) / (phi @ (masses * phi))
    strong = np.abs(jacobian[-1]) > 1e-7
    share = (phi[-1] * eta / np.where(strong, jacobian[-1], 1.0))[strong]
    assert BendingMode.of(description).participation[strong] == pytest.approx(share, abs=0.06)
    assert share.min() < 0.55 < 0.95 < share.max()


def test_mode_of_a_known_frequency():
    found = BendingMode.of(drawn(0.09)).at_frequency(12.0, 3.0)
    assert found.frequency(3.0) == pytest.approx(12.0)
    assert found.frequency(12.0) == pytest.approx(24.0)


def test_heavy_tip_takes_part_in_everything_fully():
    found = BendingMode.of(drawn(0.09, 0.09, tip_mass=10.0))
    assert found.mass == pytest.approx(10.0, rel=0.01)
    assert found.participation == pytest.approx(1.0, abs=0.01)


def test_connector_is_stiff_and_weightless():
    plain, joined = BendingMode.of(drawn(0.09)), BendingMode.of(drawn(0.09, connector=0.09))
    # at the end of a lever as long as the segment, phi of the segment is 2/5 at its end
    s = np.linspace(0, 1, 4001)
    bent = (2 * s**2 / 2 - s**3 / 6) / (1.0 - 1 / 6 + (2 - 0.5))  # curvature 2 - s, then straight
    mass = section_mass() * 0.09 * np.trapezoid(bent**2, s)
    assert joined.mass == pytest.approx(mass, rel=0.02)
    assert joined.mass < plain.mass


def test_material_without_a_weight_counts_as_silicone():
    heavy = drawn(0.09)
    segment = heavy.segments[0]
    light = segment.model_copy(
        update={"material": segment.material.model_copy(update={"density": None})}
    )
    unknown = heavy.model_copy(update={"segments": (light,)})
    assert BendingMode.of(unknown).mass == pytest.approx(BendingMode.of(heavy).mass, rel=1e-9)


def test_no_stiffness_no_frequency():
    found = BendingMode.of(drawn(0.09))
    assert found.frequency(-1.0) == 0.0
    assert found.frequency(4.0) == pytest.approx(2 * found.frequency(1.0))


@pytest.mark.parametrize(
    ("name", "share"), [(TWO, 0.06), ("stiff-flop-1", 0.06), ("stiff-flop-2", 0.1)]
)
def test_frequency_is_that_of_the_simulated_arm(name, share):
    """From the model's compliance, at rest and bent; the first two modes are nearly equal."""
    robot, model = load_description(name), so.load_robot(name)
    plant, vibration = Plant(robot, PlantSettings(dynamics="full")), BendingMode.of(robot)
    rng = np.random.default_rng(5)
    for k in range(4):
        p = rng.uniform(0, 0.9e5, robot.n_pressures) if k else np.zeros(robot.n_pressures)
        plant.settle(p)
        (first, second), _ = plant.modes(2)
        R = model.tip_pose(p)[:3, :3]
        softness = np.linalg.eigvalsh(R @ model.tip_compliance(p)[:3, :3] @ R.T)
        found = vibration.frequency(2 / float(softness[1] + softness[2])) / (2 * np.pi)
        assert found == pytest.approx(0.5 * (first + second), rel=share)


@pytest.mark.parametrize("name", [TWO, "stiff-flop-1", "stiff-flop-2"])
def test_modes_of_an_arm_that_hangs_straight_are_those_of_the_beam(name):
    model = so.load_robot(name)
    n, shares = model.n_pressures, BendingMode.of(model.description).participation
    found = BentMode.of(model, np.zeros(n))
    assert found.plane == pytest.approx(np.diag([1.0, 1.0, 0.0]), abs=1e-3)
    own = found.plane @ (found.linear * shares)
    assert np.abs(found.jacobian - own).max() < 0.08 * np.abs(own).max()
    assert found.excess(shares) == pytest.approx(found.jacobian - own, abs=1e-15)


@pytest.mark.parametrize(("channels", "share"), [((0, -1, 1), 1.4), ((-2, 1, 1), 1.0)])
def test_a_bent_arm_swings_as_its_own_modes_say(channels, share):
    """Where the upper segment stands out sideways, the lower one takes part by far more.

    The plant without damping swings about its new equilibrium, by the tip's displacement in the
    modes; that of higher modes is not compared.
    """
    name, p = TWO, np.array([0.81, 0.45, 0.49, 0.0, 1.5, 1.5]) * 1e5
    robot, model = load_description(name), so.load_robot(name)
    change = np.array([*channels, 0, 0, 0]) * 2e3
    plant = Plant(robot, PlantSettings(dynamics="full", silicone=STILL))
    plant.settle(p + change)
    rest = plant.tip_pose()[:3, 3].copy()
    plant.settle(p)
    (first, second), _ = plant.modes(2)
    steps = round(4.0 / plant.step)
    trace, tips = np.tile(p + change, (10, 1)), []
    for _ in range(steps // 10):
        plant.follow(trace)
        tips.append(plant.tip_pose()[:3, 3] - rest)
    found = BentMode.of(model, p)
    expected = found.jacobian @ change
    axis = expected / np.linalg.norm(expected)
    times = 10 * plant.step * np.arange(1, len(tips) + 1)
    angles = np.pi * (first + second) * times
    waves = np.stack([np.cos(angles), np.sin(angles), np.ones_like(times)], axis=1)
    fit, *_ = np.linalg.lstsq(waves, np.array(tips) @ axis, rcond=None)
    assert np.linalg.norm(expected) == pytest.approx(np.hypot(*fit[:2]), rel=0.1)
    straight = found.plane @ (found.linear * BendingMode.of(robot).participation) @ change
    assert axis @ expected == pytest.approx(share * (axis @ straight), rel=0.07)
