"""The simulated arm in motion, its memory and its mesh, against references without its code."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conftest import is_long
from independent.arms import FLOP, Arm, Tube
from independent.rods import planar_tip
from independent.sections import silicone
from made_plants import BAR, CONSTANT, DOWN, ONE, PLAIN, STIFF, TWO, make, material, settled
from references import (
    Column,
    Jenkin,
    beam,
    creep,
    loaded_tip,
    loop_area,
)
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    Discretisation,
    PlantLoad,
    PlantSettings,
    Silicone,
    SiliconeCreep,
    SiliconeHysteresis,
)

# -- vibration ------------------------------------------------------------------------------


FINE = Discretisation(bending_degree=5, shear_degree=3, sub_intervals=8)


@pytest.mark.parametrize("mass", [0.0, 0.02])
@pytest.mark.parametrize("tubes", [1, 2])
def test_natural_frequencies(tubes, mass):
    """Bending in each plane, stretching and twisting, within 1 %; more modes on a finer mesh."""
    arm = Arm((FLOP,) * tubes).under((0, 0, 0), mass)
    column = Column(beam(FLOP), arm.length, mass)
    for mesh, bendings, others, tolerance in (
        (Discretisation(), tubes, 1, 0.01),
        (FINE, 2, 2, 0.003),
    ):
        expected = [
            *np.repeat(column.bending_frequencies(bendings), 2),
            *column.axial_frequencies(others),
            *column.torsion_frequencies(others),
        ]
        found = make(arm, dynamics="full", discretisation=mesh).modes(20)[0] * 2 * np.pi
        assert found[:2] == pytest.approx(expected[:2], rel=tolerance)
        for omega in expected:  # each mode is taken once
            nearest = int(np.abs(found - omega).argmin())
            assert found[nearest] == pytest.approx(omega, rel=tolerance)
            found = np.delete(found, nearest)


def balance(plant: Plant) -> float:
    """Energy that is somewhere, less what came in."""
    e = plant.energies()
    return e.kinetic + e.elastic + e.gravity + e.dissipated - e.work


def released(
    plant: Plant, force: tuple[float, float, float], duration: float, axis: int, sample: float
) -> tuple[Any, Any]:
    """Times and the tip's motion along an axis after a pull is let go, every so many s."""
    zero = np.zeros(plant.robot.n_pressures)
    plant.settle(zero, PlantLoad())
    rest = plant.tip_pose()[axis, 3]
    plant.settle(zero, PlantLoad(force=force))
    plant.set_load(None)
    x = [plant.tip_pose()[axis, 3]]
    for _ in range(round(duration / sample)):
        plant.advance(sample, zero)
        x.append(plant.tip_pose()[axis, 3])
    return sample * np.arange(len(x)), np.array(x) - rest


def crossings(t: Any, x: Any) -> Any:
    """Where x goes up through zero, linearly interpolated."""
    k = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    return t[k] - x[k] * (t[k + 1] - t[k]) / (x[k + 1] - x[k])


def peaks(x: Any) -> Any:
    """Heights of the maxima of x, by parabolas."""
    k = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:]) & (x[1:-1] > 0)) + 1
    slope, bend = (x[k + 1] - x[k - 1]) / 2, x[k + 1] - 2 * x[k] + x[k - 1]
    return x[k] - slope**2 / (2 * bend)


@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_swinging_in_time(damping):
    plant = make(TWO, material(damping=damping), dynamics="full")
    t, x = released(plant, (0.01, 0, 0), 4.0, axis=0, sample=5e-3)
    ups = crossings(t, x)[1:]
    frequency = (len(ups) - 1) / (ups[-1] - ups[0])
    expected = Column(beam(FLOP), TWO.length).bending_frequencies(1)[0] / (2 * np.pi)
    assert frequency == pytest.approx(expected * np.sqrt(1 - damping**2), rel=0.01)


def test_stretching_in_time():
    plant = make(ONE.under((0, 0, 0), 0.02), dynamics="full")
    t, z = released(plant, (0, 0, 0.05), 1.0, axis=2, sample=1e-3)
    ups = crossings(t, z)
    frequency = (len(ups) - 1) / (ups[-1] - ups[0])
    expected = Column(beam(FLOP), ONE.length, 0.02).axial_frequencies(1)[0] / (2 * np.pi)
    assert frequency == pytest.approx(expected, rel=0.01)


@pytest.mark.one_in(2)
@pytest.mark.one_in(2)
@pytest.mark.parametrize("damping", [0.02, 0.1])
@pytest.mark.parametrize("step", [1e-3, 5e-4])
def test_free_decay(damping, step):
    """The logarithmic decrement is what was asked for, whatever the step."""
    plant = make(
        TWO, material(damping=damping), dynamics="full", discretisation=Discretisation(step=step)
    )
    assert plant.modes(2)[1] == pytest.approx([damping] * 2, rel=1e-3)
    tops = peaks(released(plant, (0.01, 0, 0), 2.5, axis=0, sample=5e-3)[1])[1:]
    decrement = np.log(tops[0] / tops[-1]) / (len(tops) - 1)
    assert decrement / np.hypot(2 * np.pi, decrement) == pytest.approx(damping, rel=0.01)


@pytest.mark.one_in(2)
@pytest.mark.one_in(2)
@pytest.mark.parametrize("step", [2e-3, 1e-3])
@pytest.mark.parametrize("size", [0.01, 1.0])
def test_nothing_damps_but_the_material(size, step):
    """Swings of 4 s without damping, large ones and small: no energy is lost, at any step."""
    plant = make(TWO, dynamics="full", discretisation=Discretisation(step=step))
    at_rest = balance(plant)
    plant.settle(np.zeros(6), PlantLoad(force=(0.1 * size, 0.05 * size, 0)))
    plant.set_load(None)
    energies = []
    for _ in range(40):
        plant.advance(0.1, np.zeros(6))
        energies.append(balance(plant) - at_rest)
    assert np.ptp(energies) < 1e-4 * np.mean(energies)
    assert plant.energies().dissipated < 1e-9 * np.mean(energies)


def disbalance(silicone: Silicone, step: float, arm: Arm) -> tuple[float, float]:
    """Greatest error of the energy balance under two steps of pressure, and the work done."""
    plant = make(arm, silicone, dynamics="full", discretisation=Discretisation(step=step))
    start, worst = balance(plant), 0.0
    for bar in ([0.6, 0, 0, 0, 0.4, 0], [0.1, 0.3, 0, 0, 0, 0]):
        for _ in range(20):
            plant.advance(0.04, BAR * np.array(bar))
            worst = max(worst, abs(balance(plant) - start))
    return worst, plant.energies().dissipated


BALANCED = Arm((CONSTANT, CONSTANT)).under(DOWN, 0.02)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("law", ["linear", "yeoh"])
def test_energy_balance_improves_with_the_square_of_the_step(law):
    rubber = material(law=law, damping=0.1, creep=(SiliconeCreep(share=0.1, time=0.5),))
    errors = [disbalance(rubber, step, BALANCED) for step in (4e-3, 2e-3, 1e-3)]
    for (coarse, _), (fine, lost) in itertools.pairwise(errors):
        assert fine < coarse / 3
        assert fine < 1e-3 * lost


def test_energy_balance_with_all_that_silicone_does():
    error, lost = disbalance(Silicone(), 1e-3, BALANCED)
    assert error < 1e-3 * lost


def test_weight_and_pressure_have_the_energies_of_textbooks():
    """Hanging straight: m g L / 2 and M g L; stretched by pressure: F^2 L / (2 E A)."""
    stiff = Arm((replace(STIFF),)).under(DOWN, 0.03)
    mass = beam(STIFF).mass * stiff.length
    expected = -9.81 * stiff.length * (mass / 2 + 0.03)
    assert make(stiff).energies().gravity == pytest.approx(expected, rel=1e-4)
    arm = Arm((CONSTANT,))
    plant = make(arm)
    before = plant.energies()
    plant.advance(0.01, BAR * np.ones(3))
    force = 6 * np.pi * FLOP.chamber_radius**2 * BAR
    stored = force**2 * arm.length / (2 * beam(CONSTANT).axial)
    after = plant.energies()
    assert after.elastic - before.elastic == pytest.approx(stored, rel=1e-6)
    assert after.work - before.work == pytest.approx(2 * stored, rel=1e-6)  # a sudden step


def test_a_closed_path_of_pressures_costs_nothing():
    """Without anything that dissipates, quasi-static: pressure is conjugate to swept volume."""
    plant = make(Arm((CONSTANT, CONSTANT)).under((6, 0, 7), 0.02))
    corners = BAR * np.array([[0] * 6, [0.8, 0, 0, 0, 0.3, 0], [0.8, 0.5, 0, 0.6, 0, 0], [0] * 6])
    plant.settle(corners[0])
    start, ups = plant.energies().work, []
    for a, b in itertools.pairwise(corners):
        for s in (np.arange(100) + 0.5) / 100:  # the middle of each step: the trapezium rule
            plant.advance(plant.step, a + s * (b - a))
        ups.append(plant.energies().work - start)
    assert abs(ups[-1]) < 0.02 * max(ups)


# -- hanging --------------------------------------------------------------------------------


def test_the_built_in_hanging_arm_rings_as_measured():
    robot = load_description("stiff-flop-2-hanging")
    omega, ratio = Column(beam(FLOP), 0.18, 0.02, 9.81).damped(0.1)
    linear = Plant(robot, PlantSettings(silicone=material(damping=0.1)))
    frequencies, damping = linear.modes(2)
    assert frequencies == pytest.approx([omega / (2 * np.pi)] * 2, rel=0.01)
    assert damping == pytest.approx([ratio] * 2, rel=0.02)
    assert 1.5 < frequencies[0] < 1.7
    assert damping[0] == pytest.approx(0.04, abs=0.01)
    tops = peaks(released(linear, (0.02, 0, 0), 4.0, axis=0, sample=5e-3)[1])[1:]
    decrement = np.log(tops[0] / tops[-1]) / (len(tops) - 1)
    assert decrement / np.hypot(2 * np.pi, decrement) == pytest.approx(ratio, rel=0.01)


# -- history --------------------------------------------------------------------------------

SLIP = (SiliconeHysteresis(share=0.1, strain=0.01), SiliconeHysteresis(share=0.2, strain=0.03))


def cycle(plant: Plant, top: Any, duration: float, cycles: int, samples: int = 40) -> Any:
    """Tip poses (cycles, 2 samples, 4, 4) while pressures go up to `top` and down to 0."""
    up = (np.arange(samples) + 1) / samples
    ramp = np.concatenate([up, 1 - up])
    tips = []
    for _ in range(cycles):
        for share in ramp:
            plant.advance(duration / len(ramp), share * np.asarray(top))
            tips.append(plant.tip_pose())
    return np.array(tips).reshape(cycles, len(ramp), 4, 4), ramp


def test_bending_loops_close_enclose_area_and_know_no_rate():
    top = BAR * np.array([1.0, 0, 0, 0, 0.6, 0])
    tips, slow = {}, 4.0 if is_long() else 2.0
    for duration in (0.8, slow):
        plant = make(TWO.under(DOWN, 0.02), material(law="yeoh", hysteresis=SLIP))
        tips[duration], ramp = cycle(plant, top, duration, 3)
    x = tips[0.8][..., 0, 3]
    assert np.ptp(x) > 0.02
    assert tips[slow] == pytest.approx(tips[0.8], abs=1e-6)
    for later in (1, 2):
        assert x[later, -1] == pytest.approx(x[0, -1], abs=1e-5)
    assert x[2] == pytest.approx(x[1], abs=1e-5)
    side = np.sign(x[1, 39])
    area = loop_area(side * x[1], ramp)
    assert 0.005 < area / np.ptp(x) < 0.5  # share of the box around the loop


def test_stretching_loops_are_jenkins():
    """Uniform stretch: each sample is that of a fibre under the same stress, to rounding."""
    arm, tall = Arm((PLAIN,)), 1.5 * BAR
    plant = make(arm, material(hysteresis=SLIP))
    stress = tall * 6 * np.pi * PLAIN.chamber_radius**2 / silicone(PLAIN).area
    fibre = Jenkin(
        PLAIN.youngs_modulus,
        np.array([part.share for part in SLIP]),
        np.array([part.strain for part in SLIP]),
    )
    tips, ramp = cycle(plant, [tall] * 3, 0.16, 3)
    strains = tips[..., 2, 3].ravel() / arm.length - 1
    expected = [fibre.strain(share * stress) for share in np.tile(ramp, 3)]
    assert max(expected) > 0.1
    assert strains == pytest.approx(expected, abs=1e-6)
    lost = arm.length * silicone(PLAIN).area * loop_area(expected[-80:], stress * ramp)
    before = plant.energies().dissipated
    cycle(plant, [tall] * 3, 0.16, 1)
    assert plant.energies().dissipated - before == pytest.approx(lost, rel=0.1)


@pytest.mark.parametrize("bar", [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]], ids=["stretch", "bend"])
def test_creep_is_maxwells(bar):
    shares, times = (0.2, 0.1), (2.0, 20.0)
    branches = tuple(SiliconeCreep(share=s, time=t) for s, t in zip(shares, times, strict=True))
    arm = Arm((CONSTANT,))
    plant = make(arm, material(creep=branches), discretisation=Discretisation(step=0.01))
    p = BAR * np.array(bar)

    def strain() -> float:
        T = plant.tip_pose()
        return T[2, 3] / arm.length - 1 if bar[1] else float(np.arctan2(T[0, 2], T[2, 2]))

    plant.settle(p)
    final = strain()
    plant.settle(np.zeros(3))
    marks, seen = np.array([0.01, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0]), []
    for wait in np.diff(marks, prepend=0.0):
        plant.advance(wait, p)
        seen.append(strain() / final)
    assert seen == pytest.approx(creep(shares, times, marks), abs=2e-3)


def drift(duration: float, step: float, dynamics: str) -> float:
    """How far the resting tip moves."""
    p = BAR * np.array([0.5, 0.1, 0.0, 0.0, 0.6, 0.2])
    discretisation = Discretisation(step=step)
    arm = TWO.under(DOWN, 0.02)
    plant = make(arm, Silicone(), dynamics=dynamics, discretisation=discretisation)
    plant.settle(p)
    before = plant.tip_pose()
    plant.advance(duration, p)
    assert plant.time == pytest.approx(duration)
    return float(np.abs(plant.tip_pose() - before).max())


def test_a_resting_arm_stays():
    share = 1.0 if is_long() else 0.4
    assert drift(30.0 * share, 0.02, "quasi-static") < 1e-6
    assert drift(2.0 * share, 1e-3, "full") < 1e-6


@pytest.mark.long
def test_a_resting_arm_stays_for_an_hour():
    assert drift(3600.0, 0.02, "quasi-static") < 1e-6
    assert drift(600.0, 1e-3, "full") < 1e-6


# -- discretisation -------------------------------------------------------------------------

MESHES = [(1, 0, 2), (3, 1, 4), (5, 3, 8)]


def test_refining_the_rod_converges():
    """Error of the elastica, F L^2 / (E I) = 4, with shear and stretch."""
    force = 4 * beam(FLOP).bending / ONE.length**2
    x, z, _ = planar_tip(ONE, np.zeros(3), (force, 0))
    errors = []
    for bending, shear, pieces in MESHES:
        mesh = Discretisation(bending_degree=bending, shear_degree=shear, sub_intervals=pieces)
        T = settled(ONE, load=PlantLoad(force=(force, 0, 0)), discretisation=mesh)
        errors.append(np.hypot(T[0, 3] - x, T[2, 3] - z))
    assert all(fine < coarse / 10 for coarse, fine in itertools.pairwise(errors))
    assert errors[1] < 1e-4
    assert errors[2] < 2e-6


def test_refining_a_twisted_arm_under_weight_converges():
    arm = TWO.under((6, 3, 4), 0.02)
    p = BAR * np.array([0.5, 0.1, 0.0, 0.0, 0.6, 0.2])
    expected = loaded_tip(arm, p, steps=8)[:3, 3]
    errors = []
    for bending, shear, pieces in MESHES:
        mesh = Discretisation(bending_degree=bending, shear_degree=shear, sub_intervals=pieces)
        errors.append(np.linalg.norm(settled(arm, p, discretisation=mesh)[:3, 3] - expected))
    assert all(fine < coarse / 10 for coarse, fine in itertools.pairwise(errors))
    assert errors[1] < 5e-5
    assert errors[2] < 2e-6


@pytest.mark.one_in(2)
@pytest.mark.parametrize("arm", [TWO, TWO.under(DOWN, 0.02)], ids=["weightless", "hanging"])
def test_refining_the_step_converges_with_its_square(arm):
    """A swing of 1 s, of 2 s in the long form, compared every 32 ms."""

    def swing(step: float) -> Any:
        grid = Discretisation(step=step)
        plant = make(arm, material(damping=0.1), dynamics="full", discretisation=grid)
        tips = []
        for _ in range(64 if is_long() else 32):
            plant.advance(0.032, BAR * np.array([0.3, 0, 0, 0, 0.2, 0]))
            tips.append(plant.tip_pose()[:3, 3])
        return np.array(tips)

    exact = swing(2.5e-4)
    errors = [
        np.abs(swing(step) - exact).max() for step in (4e-3, 2e-3, 1e-3)
    ]  # above 4 ms they are divided
    assert all(fine < coarse / 3 for coarse, fine in itertools.pairwise(errors))
    assert errors[-1] < 1e-4


def test_dynamics_come_to_rest_where_quasi_statics_are():
    arm = TWO.under((4, 0, 8), 0.02)
    p = BAR * np.array([0.6, 0, 0, 0, 0.3, 0])
    rubber = material(law="yeoh", damping=0.5)
    full = make(arm, rubber, dynamics="full")
    full.advance(8.0, p)
    assert full.tip_pose() == pytest.approx(settled(arm, p, silicone=rubber), abs=1e-5)


def test_a_heavy_tube_is_as_heavy_as_its_rest_section():
    """Compensation factors change stiffness, not weight."""

    def sag(tube: Tube) -> Any:
        arm = Arm((tube,)).under((9.81, 0, 0))
        return settled(arm)[:3, 3], loaded_tip(arm, np.zeros(3))[:3, 3]

    for tube in (PLAIN, replace(FLOP, factors=(0.0, 2.0, 1.5))):
        found, expected = sag(tube)
        assert found == pytest.approx(expected, abs=2e-5)
