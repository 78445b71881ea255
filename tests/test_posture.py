"""Trajectories of pressures: followed as the posture, and clear of the rig's scene all the way.

The plant that plays them differs from the model in its gains, offsets, angles and modulus; what is
measured is the distance of its own body, not of the model's.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt as so
from running import patient_rig, wait_for
from simulated_loop import Lab
from stiffopt.control.loop import ControlLoop
from stiffopt.control.posture import PostureCourse, difference
from stiffopt.control.state import State
from stiffopt.control.ways import ClearanceWatch, Ways
from stiffopt.daemon.daemon import Daemon
from stiffopt.errors import InputError
from stiffopt.model.scene import Scene
from stiffopt.model.segment import Corrections
from stiffopt.optimise.target import Target
from stiffopt.paths.solution import PathSolution
from stiffopt.paths.trajectory import MAX_WAYPOINTS, Trajectory, Waypoint, without_straight
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


def beside(robot: so.Manipulator, way: np.ndarray, gap: float) -> Scene:
    """A ball beside the distal part of an arm, a gap from where it comes nearest on a way."""
    middle = (way[-2] + way[-1]) / 2 if len(way) > 1 else way[0]
    point = robot.backbone(middle, n=20)[15, :3, 3]
    outwards = np.array([point[0], point[1], 0.0]) / np.linalg.norm(point[:2])
    away = 0.02 + gap
    for _ in range(4):
        centre = tuple(map(float, point + outwards * away))
        ball = {"name": "post", "sphere": {"centre": centre, "radius": 0.005}}
        scene = Scene(clearance=ASKED, objects=[ball])
        away += gap - float(robot.clearance(dense(way, 201) if len(way) > 1 else way, scene).min())
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
@pytest.mark.parametrize("robot", [ONE, pytest.param(TWO, marks=pytest.mark.long)])
def test_ways_are_checked_between_their_corners(robot: str) -> None:
    arm = so.load_robot(robot)
    way = sideways(arm.n_pressures)
    for gap, clear in ((ASKED + 1e-3, True), (ASKED - 1e-3, False), (-0.01, False)):
        scene = beside(arm, way, gap)
        least = arm.clearance(dense(way, 801), scene).min()
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
    arm = so.load_robot(ONE)
    way = sideways(3)
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
    assert arm.clearance(snapshot.commanded, scene) >= ASKED / 2
    before = lab.ticks(10).commanded  # back to what the chambers have
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
        pytest.param(ONE, "full", True, marks=pytest.mark.long),
        pytest.param(HANGING, "full", False, marks=pytest.mark.long),
        (HANGING, "full", True),
    ],
)
def test_a_played_path_stays_within_the_clearance_that_was_checked(
    playing: Any, robot: str, dynamics: str, is_calibrated: bool
) -> None:
    model = calibrated(robot) if is_calibrated else so.load_robot(robot)
    way = sideways(model.n_pressures)
    scene = beside(model, way, ASKED + 5e-4)
    arm = playing(robot, dynamics, scene=scene, model=model)
    played = arm.play(trajectory(model, way))
    assert set(played["states"]) == {"active"}
    assert on_the_plant(arm, played["bodies"]) > 0.8 * ASKED
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


# -- refused, held, gone on with ------------------------------------------------------------------


REFUSED = (
    r"refused: on the way {} the body would (be|go) \d+\.\d mm (from|into) 'post', \d+\.\d mm "
    "short of the 6 mm that the rig's scene asks for"
)


def test_what_would_come_too_near_is_refused_and_changes_nothing(playing: Any) -> None:
    model, way = so.load_robot(ONE), sideways(3)
    arm = playing(ONE, scene=beside(model, way, 1e-3), model=model)
    loop = arm.loop
    with pytest.raises(InputError, match=f"^{REFUSED.format('to waypoint 3')}$"):
        loop.follow_trajectory(trajectory(model, way))
    assert not arm.run(0.1)["commanded"].any()
    arm.play(trajectory(model, way[:2], TIMES[:2]))
    here, there = (tuple(map(float, model.tip_pose(p)[:3, 3])) for p in way[1:])
    for ask in (
        lambda: loop.set_target(Target(position=there)),
        lambda: loop.set_task(so.Task(robot=ONE, target=Target(position=there))),
    ):
        with pytest.raises(InputError, match=f"^{REFUSED.format('there')}$"):
            ask()
    points = [Waypoint(time=t, target=Target(position=p)) for t, p in ((0, here), (2, there))]
    with pytest.raises(InputError, match=f"^{REFUSED.format('there')}$"):
        loop.follow_trajectory(Trajectory(waypoints=points))
    assert arm.run(0.2)["plan"] == pytest.approx(np.tile(way[1], (20, 1)))  # it stays there
    back = Target(position=tuple(map(float, model.tip_pose(way[1] / 2)[:3, 3])))
    loop.set_target(back)
    assert arm.run(1.5)["errors"][-1] < 1e-3
    loop.follow_trajectory(Trajectory(waypoints=[Waypoint(time=1, target=Target(position=here))]))
    assert arm.run(2.0)["errors"][-1] < 1e-3
    assert set(arm.run(0.1)["states"]) == {"active"}


def test_a_plan_whose_way_is_blocked_is_not_taken(playing: Any) -> None:
    """As where the offset has changed what is planned, after the request was accepted."""
    model, way = so.load_robot(ONE), sideways(3)
    arm = playing(ONE, scene=beside(model, way, 1e-3), model=model)
    arm.play(trajectory(model, way[:2], TIMES[:2]))
    there = tuple(map(float, model.tip_pose(way[2])[:3, 3]))
    arm.controller.check_ahead = lambda request: None
    before = arm.run(0.1)["commanded"][-1]
    arm.loop.set_target(Target(position=there))
    played = arm.run(1.0)
    assert np.abs(played["commanded"][-1] - before).max() < 0.1 * BAR
    (alarm,) = (each for each in arm.loop.snapshot().alarms if each.kind == "blocked")
    assert "'post'" in alarm.text
    with pytest.raises(InputError, match="has not been checked"):
        arm.loop.follow_trajectory(trajectory(model, way[1:], (0.0, 1.0)))


def test_a_trajectory_waits_while_the_arm_is_held_and_goes_on_where_it_was(playing: Any) -> None:
    model, way = so.load_robot(ONE), sideways(3)
    arm = playing(ONE, scene=beside(model, way, ASKED + 1e-3), model=model)
    arm.loop.follow_trajectory(trajectory(model, way))
    before = arm.run(1.3)["plan"][-1]
    arm.rig.world.inject("tracker", "missing")
    held = arm.run(0.3)
    assert held["states"][-1] == "holding"
    arm.rig.world.inject("tracker", "ok")
    rest = arm.run(3.0)
    active = rest["plan"][rest["states"] == "active"]
    assert np.abs(active[0] - before).max() < 0.1 * BAR
    on_the_way = dense(way, 2001)
    away = np.abs(rest["pressures"][:, None] - on_the_way[None]).max(axis=2).min(axis=1)
    assert away.max() < 0.2 * BAR
    assert rest["plan"][-1] == pytest.approx(way[-1], abs=1.0)


def test_held_or_vented_in_the_middle_it_begins_anew_from_where_it_is(playing: Any) -> None:
    model, way = so.load_robot(ONE), sideways(3)
    arm = playing(ONE, scene=beside(model, way, ASKED + 1e-3), model=model)
    arm.loop.follow_trajectory(trajectory(model, way))
    arm.run(1.5)
    arm.loop.hold()
    held = arm.run(0.5)
    assert set(held["states"]) == {"holding"}
    settled = held["commanded"][5:]  # after it went back to what the chambers have
    assert np.ptp(settled, axis=0).max() == 0
    now = held["commanded"][-1]
    with pytest.raises(
        InputError, match=r"waypoint 1 is at 0 s and has 0\.9 bar in channel 1, which"
    ):
        arm.loop.follow_trajectory(trajectory(model, way[1:], (0.0, 1.0)))
    with pytest.raises(InputError, match=r"on the way to waypoint 1, channel \d would change by"):
        arm.loop.follow_trajectory(trajectory(model, way[1:], (0.01, 1.0)))
    played = arm.play(trajectory(model, np.stack([now, way[2]]), (0.0, 1.0)))
    assert played["plan"][-1] == pytest.approx(way[2], abs=1.0)
    arm.loop.follow_trajectory(trajectory(model, way[::-1]))
    arm.run(0.5)
    arm.loop.vent()
    assert arm.run(1.0)["pressures"][-1] == pytest.approx(0, abs=1e3)
    arm.loop.arm()
    assert arm.play(trajectory(model, way))["plan"][-1] == pytest.approx(way[2], abs=1.0)


@pytest.mark.parametrize(
    ("pressures", "words"),
    [
        (((0, 0), (0, 0)), r"waypoints\[0\]\.pressures: expected 3, one for each channel, not 2"),
        (
            ((0, 0, 0), (0, 1.6e5, 0)),
            r"waypoints\[1\]\.pressures: 1\.6 bar is beyond the limits of channel 2, 0 to 1\.5 bar",
        ),
        (
            ((0, 0, 0), (0, 0, 1e5), (0, 0, 0.2e5)),
            "from waypoint 1 to 2, channel 3 would change by 10 bar/s; at most 5 bar/s",
        ),
    ],
)
def test_pressures_that_do_not_fit_the_arm_are_refused(pressures: Any, words: str) -> None:
    lab = Lab(safety={"max_slew": 5e5})
    given = [each.model_copy(update={"time": 0.1 * each.time}) for each in waypoints(*pressures)]
    with pytest.raises(InputError, match=words):
        lab.loop.follow_trajectory(Trajectory(waypoints=given))
    assert "follow" not in lab.controller.calls


# -- of a solution --------------------------------------------------------------------------------


def solution(robot: so.Manipulator, times: np.ndarray, pressures: np.ndarray) -> PathSolution:
    return PathSolution("solved", "", robot, times, pressures, robot.tip_pose(pressures))


def test_a_solution_s_trajectory_has_its_pressures_and_tips() -> None:
    robot = so.load_robot(ONE)
    found = solution(robot, np.array(TIMES), sideways(3)).trajectory(begin=0.5)
    assert found.waypoints == trajectory(robot, sideways(3), (0.5, 1.5, 2.5)).waypoints
    assert found.pressures == pytest.approx(sideways(3))
    with pytest.raises(InputError, match="nothing to follow"):
        solution(robot, np.zeros(0), np.zeros((0, 3))).trajectory()


def test_points_on_straight_lines_are_left_out_where_there_are_too_many() -> None:
    robot = so.load_robot(ONE)
    times = np.linspace(0, 3, 2 * MAX_WAYPOINTS)
    pressures = np.abs(np.sin(times[:, None] + [0, 1, 2])) * BAR
    found = solution(robot, times, pressures).trajectory()
    assert 20 < len(found.waypoints) < 300
    at = [each.time for each in found.waypoints]
    thinned = np.array([np.interp(times, at, row) for row in found.pressures.T]).T
    assert np.abs(thinned - pressures).max() <= 1.5e-3 * BAR
    assert list(without_straight(times, 0 * pressures, 1e-3)) == [0, len(times) - 1]


def test_over_the_daemon_a_way_is_refused_or_followed(tmp_path: Path, compiled: Path) -> None:
    """Plans and ways are made in processes of their own there, and the loop runs in real time."""
    model, way = so.load_robot(ONE), sideways(3)
    ball = beside(model, way, 1e-3).objects[0].sphere
    centre = [f"{1e3 * each:.2f} mm" for each in ball.centre]
    scene = {
        "clearance": "6 mm",
        "objects": [{"name": "post", "sphere": {"centre": centre, "radius": "5 mm"}}],
    }
    path = patient_rig(tmp_path, plant={"dynamics": "quasi-static"}, scene=scene)
    with Daemon(path) as daemon:
        daemon.arm()
        with so.Client(daemon.url, daemon.token) as client:
            client.take_control()
            with pytest.raises(InputError, match=REFUSED.format("to waypoint 3")) as caught:
                client.follow_trajectory(trajectory(model, way))
            assert "5.0 mm short" in str(caught.value)
            found = solution(model, np.array([0.0, 1.0]), way[:2])
            client.follow_trajectory(found.trajectory())
            wait_for(lambda: np.abs(client.state().plan - way[1]).max() < 1.0)
            there = model.tip_pose(way[2])[:3, 3]

            def refusal() -> str:
                with pytest.raises(InputError) as caught:
                    client.set_target(position=there.tolist())
                return "" if "try again" in str(caught.value) else str(caught.value)

            assert re.fullmatch(REFUSED.format("there"), wait_for(refusal, 200.0))
            with pytest.raises(InputError, match="expected 3, one for each channel, not 2"):
                client.follow_trajectory(Trajectory(waypoints=waypoints((0, 0), (0, 0))))
            assert client.state().state is State.ACTIVE
            client.hold()
            client.vent()
