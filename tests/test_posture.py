"""Trajectories of pressures: followed as the posture, and clear of the rig's scene all the way.

The plant that plays them differs from the model in its gains, offsets, angles and modulus; what is
measured is the distance of its own body, not of the model's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt as so
from simulated_loop import Lab
from stiffopt.control.loop import ControlLoop
from stiffopt.control.posture import PostureCourse, difference
from stiffopt.control.state import State
from stiffopt.control.ways import ClearanceWatch, Ways
from stiffopt.errors import InputError
from stiffopt.model.description import Corrections
from stiffopt.model.scene import Scene
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.config import RigDescription

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))
from simulated_rig import SimulatedArm

BAR = 1e5
ONE, TWO, HANGING = "stiff-flop-1", "stiff-flop-2", "stiff-flop-2-hanging"
TIMES = (0.0, 1.0, 2.0)
GAINS, OFFSETS, TURNS, STIFFER = (
    (0.97, 1.04, 1.02),
    (400.0, -600.0, 300.0),
    (0.02, -0.01, 0.0),
    1.06,
)
ASKED = 0.006  # m


def sideways(n: int) -> np.ndarray:
    """From nothing to one side, and over to another one: (3, n)."""
    way = np.full((3, n), 0.2 * BAR)
    way[0], way[1, 0], way[2, 1] = 0.0, 0.9 * BAR, 0.9 * BAR
    return way


def trajectory(robot: so.Manipulator, pressures: Any, times: Any = TIMES) -> Trajectory:
    tips = [robot.tip_pose(p)[:3, 3] for p in pressures]
    return Trajectory(
        waypoints=[
            Waypoint(time=t, target=Target(position=tuple(map(float, tip))), pressures=tuple(p))
            for t, tip, p in zip(times, tips, np.array(pressures).tolist(), strict=True)
        ]
    )


def dense(way: np.ndarray, count: int = 1001) -> np.ndarray:
    """States on the straight lines between the corners of a way, equally many on each."""
    times = np.linspace(0, len(way) - 1, count)
    return np.array([np.interp(times, np.arange(len(way)), row) for row in way.T]).T


def beside(robot: so.Manipulator, way: np.ndarray, gap: float, asked: float = ASKED) -> Scene:
    """A ball beside the distal part of an arm, a gap from where it comes nearest on a way."""
    middle = (way[-2] + way[-1]) / 2 if len(way) > 1 else way[0]
    point = robot.backbone(middle, n=20)[15, :3, 3]
    outwards = np.array([point[0], point[1], 0.0]) / np.linalg.norm(point[:2])
    away = 0.02 + gap
    for _ in range(4):
        centre = tuple(map(float, point + outwards * away))
        ball = {"name": "post", "sphere": {"centre": centre, "radius": 0.005}}
        scene = Scene(clearance=asked, objects=[ball])
        away += gap - float(robot.clearance(dense(way) if len(way) > 1 else way, scene).min())
    return scene


def rig(robot: str, dynamics: str = "quasi-static", scene: Scene | None = None) -> RigDescription:
    segments = so.load_robot(robot).description.n_segments
    mismatch = {
        "gain": GAINS * segments, "offset": OFFSETS * segments, "angle": TURNS * segments,
        "modulus": (STIFFER,) * segments,
    }  # fmt: skip
    return RigDescription(
        robot=robot,
        supply={"driver": "simulated"},
        tracker={"driver": "simulated"},
        plant={"dynamics": dynamics, "mismatch": mismatch, "faults": True},
        scene=scene,
    )


def on_the_plant(arm: SimulatedArm, bodies: np.ndarray) -> float:
    """Least distance of the true body's surface from the ball of a scene, in m."""
    assert arm.scene is not None
    ball = arm.scene.objects[0].sphere
    away = np.linalg.norm(bodies - np.array(ball.centre), axis=2).min()
    return float(away - arm.radii.max() - ball.radius)


# -- what a trajectory may say --------------------------------------------------------------------


def waypoints(*pressures: Any) -> list[Waypoint]:
    target = Target(position=(0.0, 0.0, 0.1))
    return [
        Waypoint(time=float(k), target=target, pressures=each) for k, each in enumerate(pressures)
    ]


@pytest.mark.parametrize(
    ("pressures", "words"),
    [
        (((0, 0, 0), None), "waypoint 1 has pressures and waypoint 2 has none"),
        ((None, None, (0, 0, 0)), "waypoint 3 has pressures and waypoint 1 has none"),
        (((0, 0, 0), (0, 0)), "waypoint 2 has 2 pressures, waypoint 1 has 3"),
        (((0, 0, np.nan),), "finite"),
    ],
)
def test_all_waypoints_have_equally_many_pressures_or_none_has(pressures: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Trajectory(waypoints=waypoints(*pressures))


def test_pressures_are_quantities_in_files() -> None:
    given = {"time": "0 s", "target": {"position": ["0 mm", "0 mm", "100 mm"]}}
    found = Waypoint.model_validate({**given, "pressures": ["0.5 bar", "20 kPa", "0 Pa"]})
    assert found.pressures == (5e4, 2e4, 0.0)


# -- the course -----------------------------------------------------------------------------------


def test_the_posture_goes_straight_from_waypoint_to_waypoint() -> None:
    robot, way = so.load_robot(ONE), sideways(3)
    course = PostureCourse(trajectory(robot, way), 10.0, np.zeros(9), robot.tip_pose)
    for t in np.linspace(-0.5, 2.5, 31):
        goal = course.goal(10.0 + t)
        assert goal[:3] == pytest.approx([np.interp(t, TIMES, row) for row in way.T])
        assert goal[3:] == pytest.approx(0.0, abs=1e-12)  # the tip is where the pressures take it
    course.wait(0.5)
    assert course.goal(11.5)[:3] == pytest.approx(way[1])


def test_a_later_first_waypoint_begins_where_the_arm_is() -> None:
    robot, way = so.load_robot(ONE), sideways(3)
    start = np.array([1e4, 0, 0, 1e-3, 0, 0, 0, 0, 0])
    late = trajectory(robot, way[1:], (1.0, 2.0))
    course = PostureCourse(late, 0.0, start, robot.tip_pose)
    assert course.goal(0.0) == pytest.approx(start)
    assert course.goal(0.5)[:3] == pytest.approx((start[:3] + way[1]) / 2)
    assert course.goal(0.5)[3] == pytest.approx(0.5e-3)


def test_targets_beside_the_pressures_are_differences_to_correct() -> None:
    robot, way = so.load_robot(ONE), sideways(3)
    aside = [
        each.model_copy(
            update={"target": Target(position=(each.target.position[0] + 1e-3, None, 0.1))}
        )
        for each in trajectory(robot, way).waypoints
    ]
    course = PostureCourse(Trajectory(waypoints=aside), 0.0, np.zeros(9), robot.tip_pose)
    found = course.goal(1.0)
    height = robot.tip_pose(way[1])[2, 3]
    assert found[3:] == pytest.approx([1e-3, 0, 0.1 - height, 0, 0, 0])
    target = course.target(robot.tip_pose(way[1]), found[3:])
    assert target.position == (pytest.approx(aside[1].target.position[0]), None, pytest.approx(0.1))


@pytest.mark.parametrize("kind", ["pointing", "orientation"])
def test_differences_of_directions_are_turns(kind: str) -> None:
    robot = so.load_robot(TWO)
    pose, other = robot.tip_pose(sideways(6)[1]), robot.tip_pose(sideways(6)[2])
    wanted = other[:3, 2] if kind == "pointing" else so.lie.quaternion_from_rotation(other[:3, :3])
    target = Target(**{kind: tuple(map(float, wanted))})
    turn = difference(target, pose)
    assert turn[:3] == pytest.approx(0)
    course = PostureCourse(
        Trajectory(waypoints=[Waypoint(time=0, target=target, pressures=(0.0,) * 6)]),
        0.0, np.zeros(12), robot.tip_pose,
    )  # fmt: skip
    assert getattr(course.target(pose, turn), kind) == pytest.approx(getattr(target, kind))


# -- ways and the watch ---------------------------------------------------------------------------


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("robot", [ONE, TWO])
def test_ways_are_checked_between_their_corners(robot: str) -> None:
    arm = so.load_robot(robot)
    way = sideways(arm.n_pressures)
    for gap, clear in ((ASKED + 1e-3, True), (ASKED - 1e-3, False), (-0.01, False)):
        scene = beside(arm, way, gap)
        least = arm.clearance(dense(way, 4001), scene).min()
        assert (least > ASKED) == clear
        reason = Ways(arm, scene).blocked(way, waypoints=True)
        assert (reason == "") == clear
        if not clear:
            assert reason.startswith("on the way to waypoint 2 the body would ")
            assert "'post'" in reason
            short = float(reason.split(" mm short")[0].split()[-1])
            assert short == pytest.approx(1e3 * (ASKED - least), abs=1.0)


@pytest.mark.usefixtures("compiled")
def test_a_body_that_is_too_near_may_get_away_and_not_come_nearer() -> None:
    arm = so.load_robot(ONE)
    way = sideways(3)
    near = (way[1] + way[2]) / 2
    scene = beside(arm, near[None], ASKED / 4)
    ways = Ways(arm, scene)
    assert ways.blocked(np.stack([near, way[1]])) == ""
    assert ways.blocked(np.stack([way[1], near])) != ""
    watch = ClearanceWatch(arm, scene)
    watch.prepare()
    assert watch.too_near(way[1]) == ""
    assert "'post'" in watch.too_near(near)
    assert watch.too_near(way[1]) == ""  # what was refused is not where the body is
    watch.begin()
    assert watch.too_near(near) == ""  # there it is already
    assert watch.too_near(0.9 * near + 0.1 * way[1]) == ""
    assert watch.too_near(near) != ""


@pytest.mark.usefixtures("compiled")
def test_the_watch_misses_nothing_where_it_does_not_look() -> None:
    arm = so.load_robot(TWO)
    way = sideways(6)
    scene = beside(arm, (way[1] + way[2])[None] / 2, ASKED / 4)
    watch = ClearanceWatch(arm, scene)
    watch.prepare()
    looked: list[float] = []
    clearance = arm.clearance
    arm.clearance = lambda p, scene: looked.append(0.0) or clearance(p, scene)  # type: ignore
    for share in np.linspace(0, 1, 400):
        p = (1 - share) * way[1] + share * way[2]
        refused, least = watch.too_near(p), clearance(p, scene)
        assert bool(refused) == bool(least < ASKED / 2)
        if refused:
            break
    assert 0.1 < share < 0.5
    assert 3 < len(looked) < 100


def test_the_loop_holds_when_the_watch_says_so_and_goes_on_with_a_new_request() -> None:
    lab, arm = Lab(ready=False), so.load_robot(ONE)
    way = sideways(3)
    scene = beside(arm, 1.1 * way[1:2], ASKED / 4)
    lab.loop = ControlLoop(
        lab.rig, lab.controller, lab.gate, safety=lab.rig.settings.safety, period=0.01,
        clearance=ClearanceWatch(arm, scene),
    )  # fmt: skip
    lab.arm()
    lab.controller.wanted = 1.1 * way[1]
    lab.until(State.HOLDING)
    snapshot = lab.loop.snapshot()
    assert "'post'" in snapshot.reason
    assert "hold-clearance" in lab.kinds
    before = snapshot.commanded
    assert arm.clearance(before, scene) >= ASKED / 2
    assert np.array_equal(lab.ticks(30).commanded, before)
    lab.controller.wanted = np.zeros(3)
    lab.loop.set_target(Target(position=(0.0, 0.0, 0.1)))
    assert lab.ticks(100).state is State.ACTIVE
    assert not lab.loop.snapshot().commanded.any()
    lab.controller.wanted = 1.1 * way[1]
    lab.until(State.HOLDING)
    lab.loop.hold()  # is never refused, nor is
    lab.loop.vent()
    assert lab.is_vented()


# -- played ---------------------------------------------------------------------------------------


@pytest.fixture
def playing(compiled: Path) -> Iterator[Any]:
    made: list[SimulatedArm] = []

    def make(*given: Any, model: so.Manipulator | None = None, **more: Any) -> SimulatedArm:
        made.append(SimulatedArm(rig(*given, **more), model))
        return made[-1]

    yield make
    for arm in made:
        arm.close()


def calibrated(robot: str, found: float = 0.8) -> so.Manipulator:
    """An arm of whose mismatch a calibration has found a share."""
    description = so.load_robot(robot).description
    corrections = {
        "gain": [1 + found * (gain - 1) for gain in GAINS],
        "offset": [found * offset for offset in OFFSETS],
        "azimuth": [found * turn for turn in TURNS],
    }
    segments = [
        segment.model_copy(
            update={
                "corrections": Corrections(**corrections),
                "material": segment.material.model_copy(
                    update={
                        "youngs_modulus": segment.material.youngs_modulus
                        * (1 + found * (STIFFER - 1))
                    }
                ),
            }
        )
        for segment in description.segments
    ]
    return so.Manipulator(description.model_copy(update={"segments": tuple(segments)}))


@pytest.mark.parametrize(
    ("robot", "dynamics", "is_calibrated"),
    [
        (ONE, "full", False),
        (ONE, "full", True),
        (TWO, "quasi-static", False),
        (TWO, "quasi-static", True),
        (HANGING, "full", False),
        (HANGING, "full", True),
    ],
)
def test_a_played_path_stays_within_the_clearance_that_was_checked(
    playing: Any, robot: str, dynamics: str, is_calibrated: bool
) -> None:
    model = calibrated(robot) if is_calibrated else so.load_robot(robot)
    way = sideways(model.n_pressures)
    asked = 2 * ASKED if robot == TWO else ASKED  # the longer arm, the farther from its model
    scene = beside(model, way, asked + 5e-4, asked)
    arm = playing(robot, dynamics, scene=scene, model=model)
    played = arm.play(trajectory(model, way))
    assert set(played["states"]) == {"active"}
    assert on_the_plant(arm, played["bodies"]) > 0.8 * asked
    on_the_way = dense(way, 2001)
    away = np.abs(played["pressures"][:, None] - on_the_way[None]).max(axis=2).min(axis=1)
    assert away.max() < 0.2 * BAR
    assert played["plan"][-1] == pytest.approx(way[-1], abs=1.0)
    assert played["errors"][-1] < 1e-3
    tip = model.tip_pose(way[-1])[:3, 3]
    assert np.linalg.norm(played["tips"][-1] - tip) < 1e-3  # the truth, not the estimate
    # what the loop goes through is what was checked, but for the smoothing at its corners
    steps = np.abs(played["plan"][:, None] - on_the_way[None]).max(axis=2).min(axis=1)
    assert np.nanmax(steps) < 0.01 * BAR
