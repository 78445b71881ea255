"""Trajectories: through every waypoint at its time, and at rest at both ends."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from stiffopt.control.course import Course
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory, Waypoint

HOME = np.array([0.0, 0.01, 0.17])
UPRIGHT = np.eye(3)
POINTS = [(0.01, 0.0, 0.18), (0.02, -0.01, 0.17), (0.0, 0.02, 0.175), (-0.01, 0.0, 0.18)]
TIMES = [1.0, 1.5, 3.0, 4.0]


def trajectory(times, **targets):
    """Waypoints with lists of positions, pointings or orientations."""
    rows = [dict(zip(targets, row, strict=True)) for row in zip(*targets.values(), strict=True)]
    return Trajectory(
        waypoints=tuple(
            Waypoint(time=t, target=Target(**row)) for t, row in zip(times, rows, strict=True)
        )
    )


def course(times, **targets):
    """Begun at 100 s, with the tip at home and upright."""
    return Course(trajectory(times, **targets), 100.0, HOME, UPRIGHT)


def positions(made, times):
    return np.array([made.at(t).position for t in times])


def quaternion(rotation):
    x, y, z, w = rotation.as_quat(canonical=True)
    return (float(w), float(x), float(y), float(z))


def rotation_of(target):
    w, x, y, z = target.orientation
    return Rotation.from_quat([x, y, z, w])


@pytest.mark.parametrize("times", [TIMES, [0.0, 1.5, 3.0, 4.0]])
def test_passes_through_every_waypoint_at_its_time(times):
    made = course(times, position=POINTS)
    for time, point in zip(times, POINTS, strict=True):
        assert made.at(100.0 + time).position == pytest.approx(point, abs=1e-12)
    assert made.begin == 100.0
    assert made.end == 104.0


@pytest.mark.parametrize("times", [TIMES, [0.0, 1.5, 3.0, 4.0]])
def test_at_rest_at_both_ends_and_smooth_between(times):
    made, h = course(times, position=POINTS), 1e-4
    for end in (made.begin, made.end):
        away = positions(made, [end - h, end, end + h])
        assert np.abs(np.diff(away, axis=0)).max() / h < 1e-4  # m/s
    t = np.arange(made.begin, made.end, 1e-3)
    speed = np.diff(positions(made, t), axis=0) / 1e-3
    assert np.abs(speed).max() > 0.02
    assert np.abs(np.diff(speed, axis=0)).max() < 2e-3  # no kink


def test_both_ends_are_held():
    made = course(TIMES, position=POINTS)
    assert made.at(0.0).position == pytest.approx(tuple(HOME))
    assert made.at(1e6).position == pytest.approx(POINTS[-1])


def test_smoothing_by_the_lags_gives_back_the_positions():
    times = np.linspace(0, 6, 61)
    ring = 0.02 * np.stack([np.cos(2 * times), np.sin(2 * times), 0 * times], axis=1)
    way, rate = course(times, position=[tuple(each) for each in ring.tolist()]), 10.0
    ages, errors = np.linspace(0, 3, 600), []
    lags = (rate * ages) ** 3 * np.exp(-rate * ages)
    for delay in (0.0, 4 / rate):
        led = np.array([way.at(103.0 + 4 / rate - age, delay).position for age in ages])
        smooth = lags / lags.sum() @ led
        errors.append(float(np.linalg.norm(smooth - np.array(way.at(103.0).position))))
    assert errors[0] > 1e-3
    assert errors[1] < 0.03 * errors[0]


def test_later_first_waypoint_begins_at_the_present_tip():
    made = course(TIMES, position=POINTS)
    assert made.at(100.0).position == pytest.approx(tuple(HOME), abs=1e-12)


def test_first_waypoint_at_once_begins_there():
    made = course([0.0, 1.0], position=POINTS[:2])
    assert made.at(100.0).position == pytest.approx(POINTS[0], abs=1e-12)


@pytest.mark.parametrize("time", [0.0, 2.0])
def test_one_waypoint(time):
    made = course([time], position=POINTS[:1])
    assert made.at(100.0 + time).position == pytest.approx(POINTS[0], abs=1e-12)
    assert made.at(200.0).position == pytest.approx(POINTS[0], abs=1e-12)
    start = POINTS[0] if time == 0 else tuple(HOME)
    assert made.at(100.0).position == pytest.approx(start, abs=1e-12)


@pytest.mark.parametrize("time", [0.0, 2.0])
def test_one_waypoint_of_an_orientation(time):
    goal = Rotation.from_rotvec([0.3, -0.2, 0.5])
    made = course([time], orientation=[quaternion(goal)])
    assert made.at(100.0 + time).position is None
    assert (rotation_of(made.at(200.0)) * goal.inv()).magnitude() < 1e-9
    start = goal if time == 0 else Rotation.identity()
    assert (rotation_of(made.at(100.0)) * start.inv()).magnitude() < 1e-9


def test_pointing_is_a_unit_vector_all_the_way():
    ways = [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)]
    made = course([1.0, 2.0, 3.0], pointing=ways)
    for time, way in zip([0.0, 1.0, 2.0, 3.0], [(0, 0, 1.0), *ways], strict=True):
        assert made.at(100.0 + time).pointing == pytest.approx(way, abs=1e-12)
    for t in np.linspace(100, 103, 61):
        assert np.linalg.norm(made.at(t).pointing) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "targets",
    [
        {"pointing": [(0.0, 0.0, -1.0)]},
        {"pointing": [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]},
        {"orientation": [(0.0, 1.0, 0.0, 0.0)]},
    ],
)
def test_the_other_way_round_has_no_way_and_is_refused(targets):
    times = [float(k + 1) for k in range(len(next(iter(targets.values()))))]
    with pytest.raises(InputError, match="put one between"):
        course(times, **targets)


def test_orientations_go_the_shortest_way():
    turns = [Rotation.from_rotvec([0, 0, angle]) for angle in np.radians([170, 190, 200])]
    made = course([0.0, 1.0, 2.0], orientation=[quaternion(turn) for turn in turns])
    before, total = rotation_of(made.at(100.0)), 0.0
    for t in np.linspace(100, 102, 201):
        now = rotation_of(made.at(t))
        assert made.at(t).orientation[0] >= 0
        total += (now * before.inv()).magnitude()
        before = now
    assert total == pytest.approx(np.radians(30), abs=0.02)
    for time, turn in zip([0, 1, 2], turns, strict=True):
        assert (rotation_of(made.at(100.0 + time)) * turn.inv()).magnitude() < 1e-9


def test_orientations_are_at_rest_at_both_ends():
    turns = [Rotation.from_rotvec([0.4 * k, 0, 0.1]) for k in range(3)]
    made, h = course([1.0, 2.0, 3.0], orientation=[quaternion(turn) for turn in turns]), 1e-3
    for at, step in ((100.0, h), (103.0, -h)):
        turned = rotation_of(made.at(at + step)) * rotation_of(made.at(at)).inv()
        assert turned.magnitude() / h < 0.02  # rad/s


def test_free_axes_stay_free():
    made = course([1.0, 2.0], position=[(0.01, None, 0.1), (0.02, None, 0.12)])
    x, y, z = made.at(101.5).position
    assert y is None
    assert 0.01 < x < 0.02
    assert 0.1 < z < 0.12
    x, y, z = made.at(100.0).position
    assert (x, y, z) == (pytest.approx(HOME[0]), None, pytest.approx(HOME[2]))


def test_tolerance_is_that_of_the_first_waypoint():
    target = Target(position=POINTS[0], tolerance={"position": "2 mm"})
    made = Course(Trajectory(waypoints=(Waypoint(time=1, target=target),)), 0.0, HOME, UPRIGHT)
    assert made.at(0.5).tolerance == target.tolerance


def test_duration_and_files():
    made = Trajectory.model_validate(
        {
            "waypoints": [
                {"time": "500 ms", "target": {"position": ["10 mm", "free", "0.1 m"]}},
                {"time": "2 s", "target": {"position": ["20 mm", "free", "0.1 m"]}},
            ]
        }
    )
    assert made.duration == 2.0
    assert made.waypoints[0].target.position == (0.01, None, 0.1)


@pytest.mark.parametrize(
    ("waypoints", "words"),
    [
        ([], "no waypoints"),
        ([(1.0, {"position": POINTS[0]}), (1.0, {"position": POINTS[1]})], "order of time"),
        ([(2.0, {"position": POINTS[0]}), (1.0, {"position": POINTS[1]})], "1 s follows 2 s"),
        ([(-1.0, {"position": POINTS[0]})], "at least 0"),
        ([(np.inf, {"position": POINTS[0]})], "finite"),
        ([(np.nan, {"position": POINTS[0]})], "finite"),
        (
            [(1.0, {"position": POINTS[0]}), (2.0, {"position": (None, 0.0, 0.1)})],
            "the same axes",
        ),
        ([(1.0, {"position": POINTS[0]}), (2.0, {"pointing": (0, 0, 1.0)})], "the same axes"),
    ],
)
def test_bad_trajectories_say_what_is_wrong(waypoints, words):
    with pytest.raises((ValidationError, ValueError), match=words):
        Trajectory(
            waypoints=tuple(
                Waypoint(time=time, target=Target(**target)) for time, target in waypoints
            )
        )
