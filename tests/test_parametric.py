"""An arm as a function of its parameters: derivatives by differences, and the robot built anew."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from independent.motions import body_twists, derivative
from stiffopt.model.arguments import DirectionalMeasure, checked_measure
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.parametric import ParametricArm
from stiffopt.model.robot_files import load_description
from stiffopt.model.segment import Corrections

Vector = NDArray[np.float64]

KEYS = (
    "segments[0].length",
    "segments[1].material.youngs_modulus",
    "segments[0].compensation.modulus_per_pressure",
    "segments[0].compensation.area",
    "segments[1].compensation.inertia",
    "segments[0].compensation.stiffness",
    "segments[1].compensation.softening",
    "segments[0].compensation.bending_radius",
    "segments[1].compensation.lengthening",
    "segments[0].corrections.gain[1]",
    "segments[1].corrections.offset[0]",
    "segments[0].corrections.dead_band",
    "segments[1].corrections.azimuth[2]",
    "segments[0].history.lag",
)
PARAMETERS = tuple(Parameter(key) for key in KEYS)
HEAVY_ONLY = {"segments[0].length"}  # see the test of weights
UNITS = np.array([100.0 if "offset" in key else 1.0 for key in KEYS])
MIDDLE = 0.5 * 0.09  # m
ARMS = ("stiff-flop-2", "stiff-flop-2-hanging")
MEASURES = {
    "along x": checked_measure([1, 0, 0], "translation", "free", "base"),
    "about z, clamped": checked_measure([0.2, 0.1, 1], "rotation", "clamped", "tip"),
}


@cache
def description_of(name: str, law: str = "rest-length") -> RobotDescription:
    """A built-in robot with all kinds of corrections."""
    mapping = load_description(name).model_dump()
    for segment in mapping["segments"]:
        segment["strain_law"] = law
        segment["compensation"] |= {
            "stiffness": 1.3,
            "softening": 0.4,
            "bending_radius": 0.05,
            "lengthening": 0.3,
        }
        segment["corrections"] = Corrections(
            gain=(1.05, 0.97, 1.0),
            offset=(300.0, 0.0, -200.0),
            dead_band=4e3,
            azimuth=(0.03, 0.0, -0.02),
        ).model_dump()
        segment["history"] = {"lag": 0.2}
    return RobotDescription(**mapping)


@cache
def arm_of(name: str, law: str = "rest-length") -> ParametricArm:
    return ParametricArm(description_of(name, law), PARAMETERS)


def some_pressures(count: int, seed: int = 0) -> Vector:
    return np.random.default_rng(seed).uniform(0.05e5, 1e5, (count, 6))


def rebuilt(name: str, law: str, coordinates: Vector) -> Manipulator:
    description = description_of(name, law)
    values = {
        p: p.at(p.value(description), c) for p, c in zip(PARAMETERS, coordinates, strict=True)
    }
    return Manipulator(with_values(description, values))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("law", ["paper", "rest-length", "neo-hookean", "fibres"])
@pytest.mark.parametrize("name", ARMS)
def test_it_is_the_robot_that_is_built_anew(name: str, law: str) -> None:
    """At its own values and at others; poses, their Jacobian, stiffnesses and their gradient."""
    arm, p = arm_of(name, law), some_pressures(4)
    changes = np.random.default_rng(1).uniform(-0.05, 0.05, len(KEYS)) * UNITS
    changes[[key in HEAVY_ONLY for key in KEYS]] = 0.0
    for coordinates in (np.zeros(len(KEYS)), changes):
        robot = rebuilt(name, law, coordinates)
        for at in (None, MIDDLE):
            poses = arm.poses(p, coordinates, at)
            expected = robot.tip_pose(p) if at is None else [robot.pose(q, at) for q in p]
            # under loads a robot interpolates between steps of its own
            interpolated = at is not None and robot.is_loaded
            within = 1e-6 if interpolated else 1e-9
            assert poses.transforms == pytest.approx(np.array(expected), abs=within)
        poses = arm.poses(p, coordinates)
        size = np.abs(poses.per_pressure).max()
        assert poses.per_pressure == pytest.approx(robot.tip_jacobian(p), abs=1e-7 * size)
        for measure in MEASURES.values():
            k, *_ = arm.stiffnesses(p, coordinates, measure)
            assert k == pytest.approx(stiffness_of(robot, p, measure), rel=1e-8)


def stiffness_of(robot: Manipulator, p: Vector, measure: DirectionalMeasure) -> Vector:
    direction, kind, boundary, frame = measure
    return np.array(
        [robot.stiffness(q, direction, kind=kind, boundary=boundary, frame=frame) for q in p]
    )


@pytest.mark.one_in(2)
@pytest.mark.parametrize("at", [None, MIDDLE], ids=["tip", "middle"])
@pytest.mark.parametrize("name", ARMS)
def test_poses_by_differences(name: str, at: float | None) -> None:
    arm, p = arm_of(name), some_pressures(3, 2)
    poses = arm.poses(p, np.zeros(len(KEYS)), at)
    by_coordinate = derivative(
        lambda c: arm.poses(p, c * UNITS, at).transforms, np.zeros(len(KEYS)), 1e-3
    )
    by_pressure = derivative(
        lambda change: arm.poses(p + 1e5 * change, np.zeros(len(KEYS)), at).transforms,
        np.zeros(6),
        1e-3,
    )
    for row in range(len(p)):
        twists = body_twists(poses.transforms[row], by_coordinate[row])
        assert matches(poses.per_coordinate[row] * UNITS, twists)
        twists = body_twists(poses.transforms[row], by_pressure[row])
        assert matches(poses.per_pressure[row] * 1e5, twists)
    moves = np.abs(poses.per_coordinate).max(axis=(0, 1)) > 1e-12 / UNITS
    still = {"segments[0].history.lag"}
    if at is not None and name == "stiff-flop-2":  # nothing beyond it matters
        still |= {key for key in KEYS if key.startswith("segments[1]")}
    if name == "stiff-flop-2":  # no load, and free shapes know nothing of these
        still |= {key for key in KEYS if key.endswith(("stiffness", "softening"))}
    assert {key for key, moved in zip(KEYS, moves, strict=True) if not moved} == still


@pytest.mark.one_in(2)
@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("name", ARMS)
def test_stiffnesses_by_differences(name: str, measure: str) -> None:
    arm, p, wanted = arm_of(name), some_pressures(3, 3), MEASURES[measure]
    zero = np.zeros(len(KEYS))
    _, per_pressure, per_coordinate, _ = arm.stiffnesses(p, zero, wanted)
    by_coordinate = derivative(lambda c: arm.stiffnesses(p, c * UNITS, wanted)[0], zero, 1e-3)
    by_pressure = derivative(
        lambda change: arm.stiffnesses(p + 1e5 * change, zero, wanted)[0], np.zeros(6), 1e-3
    )
    assert matches(per_coordinate * UNITS, by_coordinate)
    assert matches(per_pressure * 1e5, by_pressure)


def matches(found: Vector, expected: Vector) -> bool:
    """Whether derivatives agree, each column (..., k) in its own size.

    Equilibria are found to some 1e-12, which differences magnify.
    """
    size = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)))
    return bool((np.abs(found - expected) <= 1e-5 * size + 1e-7 * size.max()).all())


@pytest.mark.parametrize("name", ARMS)
def test_a_rest_length_varies_at_the_same_mass(name: str) -> None:
    """That of a robot whose silicone is lighter by what it is longer."""
    arm, p, ratio = arm_of(name), some_pressures(3, 4), 1.03
    coordinates = np.where([key == "segments[0].length" for key in KEYS], np.log(ratio), 0.0)
    mapping = description_of(name).model_dump()
    mapping["segments"][0]["length"] *= ratio
    mapping["segments"][0]["material"]["density"] /= ratio
    expected = Manipulator(RobotDescription(**mapping)).tip_pose(p)
    assert arm.poses(p, coordinates).transforms == pytest.approx(expected, abs=1e-9)


def test_a_load_at_the_tip() -> None:
    """A dead force and a moment that follows, on an arm without weight."""
    description = description_of("stiff-flop-2")
    force, moment = (0.02, -0.01, 0.03), (1e-4, 2e-4, -1e-4)
    dead = ParametricArm(description, PARAMETERS, tip_load=(*force, *(0.0,) * 9))
    follower = ParametricArm(description, PARAMETERS, tip_load=(*(0.0,) * 9, *moment))
    p, zero = some_pressures(2, 5), np.zeros(len(KEYS))
    for arm, robot in (
        (dead, Manipulator(description, force=force)),
        (follower, Manipulator(description, moment=moment, load_frame="tip")),
    ):
        assert arm.poses(p, zero).transforms == pytest.approx(robot.tip_pose(p), abs=1e-9)
    slopes = derivative(lambda c: dead.poses(p, c * UNITS).transforms, zero, 1e-3)
    poses = dead.poses(p, zero)
    for row in range(len(p)):
        twists = body_twists(poses.transforms[row], slopes[row])
        assert matches(poses.per_coordinate[row] * UNITS, twists)


def test_poses_do_not_depend_on_what_was_asked_before() -> None:
    """Equilibria are found from the last ones of the same row, but are the same."""
    p, zero = some_pressures(5, 6), np.zeros(len(KEYS))
    fresh = ParametricArm(description_of("stiff-flop-2-hanging"), PARAMETERS)
    first = fresh.poses(p, zero).transforms
    fresh.poses(p[::-1], 0.05 * UNITS)
    assert fresh.poses(p, zero).transforms == pytest.approx(first, abs=1e-9)
