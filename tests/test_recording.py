"""Logs become recordings: what is not a measurement is found and said, the rest is untouched."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings import ASU, UCL, needs_asu, needs_ucl
from stiffopt.errors import InputError
from stiffopt.identify.recording import Recording, prepare
from stiffopt.identify.tracker_faults import CUBE, aligned
from stiffopt.logs import Body, Log, read_log
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

ONE = load_description("stiff-flop-1")  # three channels of 0 to 1.5 bar, 90 mm
TWO = load_description("stiff-flop-2")
QUICK = 600  # rows of a synthetic log


def matrices() -> Array:
    """The 24 proper rotations of the cube, as signed permutations with determinant 1."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(matrix) > 0:
            found.append(matrix)
    return np.array(found)


def quaternions(rotation: Array) -> Array:
    """(N, 4), w first, of rotations (N, 3, 3)."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def angles(one: Array, other: Array) -> Array:
    """Angles (N,) in rad between rotations (N, 3, 3)."""
    return np.asarray((Rotation.from_matrix(one).inv() * Rotation.from_matrix(other)).magnitude())


def placed(vector: tuple[float, ...]) -> Array:
    return Rotation.from_rotvec(vector).as_matrix()


BASE = (np.array([0.4, -0.3, 1.2]), placed((0.3, 2.0, -0.4)))


def synthetic(count: int = QUICK, seed: int = 0, rate: float = 15.0) -> tuple[Log, Array, Array]:
    """A log of tip, mid and base in a tracker's frame; tip (N, 3) and (N, 3, 3) in the base frame.

    The pressures are steps that are held for 2 s, and the arm answers with a lag of 0.3 s and a
    turn of up to 80 degrees.
    """
    random = np.random.default_rng(seed)
    t = np.cumsum(random.uniform(0.7, 1.3, count)) / rate
    pressures = random.uniform(0, 1.5e5, (int(t[-1] / 2) + 1, 3))[(t / 2).astype(int)]
    lagged = np.zeros(3)
    path = np.zeros((count, 3))
    for i in range(1, count):
        lagged = lagged + (1 - np.exp(-(t[i] - t[i - 1]) / 0.3)) * (pressures[i - 1] - lagged)
        path[i] = lagged / 1.5e5
    azimuths = np.radians([0.0, 120.0, 240.0])
    bend = 1.4 * np.column_stack([path @ np.cos(azimuths), path @ np.sin(azimuths)])
    turns = Rotation.from_rotvec(np.column_stack([-bend[:, 1], bend[:, 0], 0 * t]))
    half = Rotation.from_rotvec(np.column_stack([-bend[:, 1], bend[:, 0], 0 * t]) / 2)
    length = 0.09 * (1 + 0.2 * path.mean(axis=1))
    tip = length[:, None] * half.apply([0.0, 0.0, 1.0])
    noise = random.normal(0, 2e-5, (3, count, 3))
    origin, axes = BASE
    log = Log(
        time=t,
        commanded=pressures,
        tip_position=origin + (tip + noise[0]) @ axes.T,
        tip_quaternion=quaternions(axes @ turns.as_matrix()),
        bodies={
            "mid": Body(
                origin + (tip / 2 + noise[1]) @ axes.T, quaternions(axes @ half.as_matrix())
            ),
            "base": Body(origin + noise[2], np.tile(quaternions(axes[None]), (count, 1))),
        },
    )
    return log, tip, turns.as_matrix()


def changed(log: Log, body: str = "tip", **changes: Array) -> Log:
    """The log with other positions or quaternions of a body."""
    if body == "tip":
        return replace(log, **{f"tip_{key}": value for key, value in changes.items()})
    bodies = dict(log.bodies)
    bodies[body] = replace(bodies[body], **changes)
    return replace(log, bodies=bodies)


def prepared(log: Log, **options: Any) -> Recording:
    return prepare(log, "a.csv", ONE, **{"frame": "base", "bodies": ("mid",), **options})


def remark(recording: Recording, words: str) -> str:
    """The only remark that has these words."""
    found = [text for text in recording.remarks if words in text]
    assert len(found) == 1, recording.remarks
    return found[0]


def point_only(count: int = QUICK, **changes: Array) -> Log:
    """A log of positions alone, in the base frame."""
    log, tip, _ = synthetic(count)
    return replace(
        log, **{"tip_position": tip.round(5), "tip_quaternion": None, "bodies": {}, **changes}
    )


# -- what is as it should be ----------------------------------------------------------------------


def test_a_clean_log_is_taken_as_it_is() -> None:
    log, tip, turns = synthetic()
    recording = prepared(log)
    assert recording.remarks == ()
    assert [track.name for track in recording.tracks] == ["tip", "mid"]
    np.testing.assert_array_equal(recording.time, log.time)
    np.testing.assert_array_equal(recording.pressures, log.commanded)
    np.testing.assert_allclose(recording.track("tip").position, tip, atol=2e-4)
    assert recording.tracks[0].rotation is not None
    np.testing.assert_allclose(recording.tracks[0].rotation, turns, atol=1e-9)
    with pytest.raises(InputError, match="no track 'base'; the tracks are tip, mid"):
        recording.track("base")


def test_without_a_frame_positions_stay_in_the_trackers() -> None:
    log, _, _ = synthetic()
    np.testing.assert_array_equal(prepared(log, frame=None).tracks[0].position, log.tip_position)
    log = changed(log, "base", quaternion=None)  # type: ignore[arg-type]
    difference = prepared(log).tracks[0].position
    np.testing.assert_allclose(difference, log.tip_position - BASE[0], atol=1e-5)


def test_fast_steps_seen_at_any_rate_are_no_jumps() -> None:
    for rate in (1.0, 2.0, 4.0, 8.0, 15.0, 100.0):
        for seed in range(5):
            log, tip, turns = synthetic(seed=seed, rate=rate)
            recording = prepared(log)
            assert recording.remarks == (), (rate, seed)
            assert recording.tracks[0].rotation is not None
            assert np.max(np.abs(recording.tracks[0].rotation - turns)) < 1e-9
            np.testing.assert_allclose(recording.tracks[0].position, tip, atol=2e-4)


def test_a_pulse_of_pressure_is_no_jump() -> None:
    """The tip goes and comes back between two rows, as the pressure did."""
    log = point_only()
    position = np.tile([0.0, 0.0, 0.09], (QUICK, 1))
    pressures = np.zeros((QUICK, 3))
    position[100::50] = [0.04, 0.0, 0.08]
    pressures[100::50, 0] = 1e5
    recording = prepare(replace(log, commanded=pressures, tip_position=position), "a", ONE)
    assert [text for text in recording.remarks if "tip" in text] == []
    np.testing.assert_array_equal(recording.tracks[0].position, position)


# -- orientations ---------------------------------------------------------------------------------


def test_there_are_24_rotations_of_a_cube() -> None:
    ours = Rotation.from_quat(CUBE, scalar_first=True).as_matrix().round(9) + 0.0
    assert {tuple(m.ravel()) for m in ours} == {tuple(m.ravel()) for m in matrices() + 0.0}
    np.testing.assert_array_equal(CUBE[0], [1, 0, 0, 0])


@pytest.mark.parametrize("seed", range(4))
def test_flips_signs_and_lengths_of_quaternions_are_undone(seed: int) -> None:
    log, _, turns = synthetic(seed=seed)
    random = np.random.default_rng(seed)
    version = np.zeros(QUICK, dtype=int)
    for start in random.choice(np.arange(1, QUICK - 30), 15, replace=False):
        version[start : start + random.integers(1, 20)] = random.integers(24)
    flipped = BASE[1] @ turns @ matrices_identity_first()[version]
    scale = random.choice([-1.0, 1.0], (QUICK, 1)) * random.uniform(0.9, 1.1, (QUICK, 1))
    recording = prepared(changed(log, quaternion=scale * quaternions(flipped)))
    assert recording.tracks[0].rotation is not None
    assert angles(recording.tracks[0].rotation, turns).max() < 1e-6
    at = np.flatnonzero(np.diff(version)) + 1
    text = remark(recording, "flips about")
    assert f"orientation of tip flips about the body's own axes in {len(at)} rows" in text
    assert f"at {log.time[at[0]]:.6g}, " in text
    assert len(recording.remarks) == 1


def matrices_identity_first() -> Array:
    found = matrices()
    return found[np.argsort([-np.trace(m) for m in found], kind="stable")]


def test_signs_alone_are_no_remark() -> None:
    log, _, _ = synthetic()
    assert log.tip_quaternion is not None
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (QUICK, 1))
    assert prepared(changed(log, quaternion=signs * log.tip_quaternion)).remarks == ()


def test_flips_of_the_frame_do_not_spread() -> None:
    log, tip, _ = synthetic()
    cube = matrices_identity_first()
    version = np.where(np.arange(QUICK) % 7 < 3, 5, 0)
    base = changed(log, "base", quaternion=quaternions(BASE[1] @ cube[version]))
    position = base.bodies["base"].position.copy()
    position[200:240] = np.nan
    position[300] += 0.3
    recording = prepared(changed(base, "base", position=position))
    np.testing.assert_allclose(recording.tracks[0].position, tip, atol=2e-4)
    assert "position of base is missing in 40 rows" in remark(recording, "is missing")
    assert f"jumps and comes back in 1 row (at {log.time[300]:.6g} s)" in remark(recording, "jumps")


def test_orientations_that_agree_with_no_neighbour_are_not_used() -> None:
    log, _, turns = synthetic()
    strays = {50: 1, 200: 3, 400: 2}
    # 30 degrees about (1, 1, 1): the other 23 versions are farther away still
    wrong = BASE[1] @ turns
    for start, count in strays.items():
        wrong[start : start + count] = wrong[start : start + count] @ placed((0.3, 0.3, 0.3))
    assert angles(wrong, BASE[1] @ turns).max() == pytest.approx(np.sqrt(0.27))
    wrong[402:450] = wrong[402:450] @ matrices_identity_first()[7]
    recording = prepared(changed(log, quaternion=quaternions(wrong)))
    rotation = recording.tracks[0].rotation
    assert rotation is not None
    expected = np.zeros(QUICK, dtype=bool)
    for start, count in strays.items():
        expected[start : start + count] = True
    np.testing.assert_array_equal(np.isnan(rotation[:, 0, 0]), expected)
    assert angles(rotation[~expected], turns[~expected]).max() < 1e-6
    assert "in 2 rows" in remark(recording, "flips about")
    assert "agrees with no row near it in 6 rows" in remark(recording, "agrees with no")
    assert np.isfinite(recording.tracks[0].position).all()


def test_a_gap_in_which_the_body_turns_and_flips() -> None:
    log, _, turns = synthetic()
    reported = BASE[1] @ turns
    reported[300:] = reported[300:] @ matrices_identity_first()[7]
    q = quaternions(reported)
    q[295:305] = np.nan
    rotation = prepared(changed(log, quaternion=q)).tracks[0].rotation
    assert rotation is not None
    seen = np.isfinite(rotation[:, 0, 0])
    np.testing.assert_array_equal(seen, ~np.isnan(q[:, 0]))
    # which of both halves keeps the reported version is the choice of the longer one
    found = aligned(rotation, np.eye(3))[seen]
    assert angles(found, turns[seen]).max() < 1e-6


def test_alignment_of_a_whole_track() -> None:
    _, _, turns = synthetic()
    for g in matrices():
        track = turns @ g
        track[10] = np.nan
        found = aligned(track, turns[0])
        assert np.isnan(found[10]).all()
        np.testing.assert_allclose(np.delete(found, 10, 0), np.delete(turns, 10, 0), atol=1e-12)
    nothing = np.full((5, 3, 3), np.nan)
    np.testing.assert_array_equal(aligned(nothing, np.eye(3)), nothing)


# -- positions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_jumps_of_the_tracker_are_found_and_no_more(seed: int) -> None:
    log, tip, _ = synthetic(seed=seed)
    random = np.random.default_rng(seed)
    starts = np.arange(5, QUICK - 10, 10)
    # while the arm is fast a jump of some mm looks like motion
    starts = [s for s in starts if np.abs(tip[s - 4 : s + 7] - tip[s]).max() < 3e-3]
    assert len(starts) > 8
    position = log.tip_position.copy()
    expected = np.zeros(QUICK, dtype=bool)
    for start in starts:
        count = random.integers(1, 4)
        away = random.normal(size=3)
        position[start : start + count] += 0.015 * away / np.linalg.norm(away)
        expected[start : start + count] = True
    recording = prepared(changed(log, position=position))
    found = recording.tracks[0].position
    np.testing.assert_array_equal(np.isnan(found[:, 0]), expected)
    np.testing.assert_allclose(found[~expected], tip[~expected], atol=2e-4)
    assert recording.tracks[0].rotation is not None
    assert np.isnan(recording.tracks[0].rotation[expected]).all()
    text = remark(recording, "position of tip jumps and comes back")
    assert f"in {expected.sum()} row" in text
    assert f"(at {log.time[min(starts)]:.6g}" in text
    assert text.endswith("; these are not used")


def test_jumps_close_together() -> None:
    log = point_only()
    tip = log.tip_position.copy()
    still = next(i for i in range(50, QUICK) if np.ptp(tip[i - 8 : i + 9], axis=0).max() < 1e-3)
    tip[[still - 2, still, still + 3]] += [[0.02, 0, 0], [0.01, 0.01, 0], [0, 0, -0.02]]
    found = prepare(replace(log, tip_position=tip), "a", ONE).tracks[0].position
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == [still - 2, still, still + 3]


def test_zeros_and_impossible_positions_are_not_used() -> None:
    log, _, _ = synthetic()
    position = log.tip_position.copy()
    position[[40, 41, 42, 43, 44, 45, 46, 47]] = 0.0
    position[100] = -3.7e28
    position[0] = 50.0
    recording = prepared(changed(log, position=position))
    gone = np.flatnonzero(np.isnan(recording.tracks[0].position[:, 0]))
    assert gone.tolist() == [0, *range(40, 48), 100]
    assert "tip is zero or impossible in 10 rows" in remark(recording, "zero or")


def test_a_tracker_that_was_zeroed_where_the_tip_rests() -> None:
    log = point_only()
    position = log.tip_position - log.tip_position[0]
    position[:5] = 0.0
    position[5:8] = [[1e-5, 0, 0], [0, 0, 2e-5], [3e-5, 0, 0]]
    recording = prepare(replace(log, tip_position=position), "a", ONE)
    assert recording.remarks == ()
    assert np.isfinite(recording.tracks[0].position).all()


def test_repeated_rows_are_not_used_where_they_cannot_be_measured() -> None:
    log, _, _ = synthetic()
    rows = np.arange(QUICK)
    rows[[50, 51, 52, 300]] = [49, 49, 49, 299]
    assert log.tip_quaternion is not None
    stale = replace(
        log,
        tip_position=log.tip_position[rows],
        tip_quaternion=log.tip_quaternion[rows],
        bodies={
            name: Body(body.position[rows], body.quaternion[rows])  # type: ignore[index]
            for name, body in log.bodies.items()
        },
    )
    recording = prepared(stale)
    for track in recording.tracks:
        gone = np.flatnonzero(np.isnan(track.position[:, 0]))
        assert gone.tolist() == [50, 51, 52, 300]
        assert track.rotation is not None
        assert np.isnan(track.rotation[gone]).all()
    assert "repeats the row before in 4 rows" in remark(recording, "repeats")
    one = replace(stale, tip_quaternion=None, bodies={})
    assert np.isfinite(prepare(one, "a", ONE).tracks[0].position).all()
    moving = changed(stale, "mid", position=log.bodies["mid"].position)
    assert prepared(moving).remarks == ()


def test_missing_values_are_counted() -> None:
    log, tip, turns = synthetic()
    position, q = log.tip_position.copy(), log.tip_quaternion
    assert q is not None
    position[10:15, 1] = np.nan
    q = q.copy()
    q[20:22, 3] = np.nan
    q[23] = 0.0
    recording = prepared(changed(log, position=position, quaternion=q))
    track = recording.tracks[0]
    assert np.flatnonzero(np.isnan(track.position).any(axis=1)).tolist() == list(range(10, 15))
    assert track.rotation is not None
    assert np.flatnonzero(np.isnan(track.rotation[:, 0, 0])).tolist() == [20, 21, 23]
    assert np.isnan(track.rotation[23]).all()
    assert "missing in 5 rows" in remark(recording, "position of tip is")
    assert "missing in 3 rows" in remark(recording, "orientation of tip is")
    np.testing.assert_allclose(track.position[15:], tip[15:], atol=2e-4)
    np.testing.assert_allclose(track.rotation[24:], turns[24:], atol=1e-9)


# -- pressures ------------------------------------------------------------------------------------


def test_columns_are_put_into_the_robots_order() -> None:
    log, _, _ = synthetic()
    recording = prepared(log, channels=(3, 1, 2))
    np.testing.assert_array_equal(recording.pressures, log.commanded[:, [2, 0, 1]])
    wide = replace(log, commanded=np.column_stack([log.commanded * 0, log.commanded]))
    np.testing.assert_array_equal(prepared(wide, channels=(4, 5, 6)).pressures, log.commanded)


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ((1, 2), "2 columns of pressures are given for the 3 channels"),
        ((1, 2, 2), "column 2 is given for more than one"),
        ((0, 1, 2), "no pressure column 0; expected a number from 1 to 3"),
        ((1, 2, 4), "no pressure column 4"),
    ],
)
def test_wrong_columns(channels: tuple[int, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        prepared(synthetic()[0], channels=channels)


def test_another_number_of_channels() -> None:
    with pytest.raises(InputError, match="the log has 3 pressures and the robot 6 channels"):
        prepare(synthetic()[0], "a", TWO)


def test_missing_pressures_are_filled() -> None:
    log, _, _ = synthetic()
    gaps = log.commanded.copy()
    gaps[:3, 0] = np.nan
    gaps[100:150, 2] = np.nan
    recording = prepared(replace(log, commanded=gaps))
    assert np.all(recording.pressures[:3, 0] == gaps[3, 0])
    assert np.all(recording.pressures[100:150, 2] == gaps[99, 2])
    np.testing.assert_array_equal(recording.pressures[150:], gaps[150:])
    assert "commanded pressure is missing in 53 rows" in remark(recording, "pressure is")
    with pytest.raises(InputError, match="every commanded pressure of column 2 is missing"):
        prepared(replace(log, commanded=gaps * [1, np.nan, 1]))


def test_measured_pressures() -> None:
    log, _, _ = synthetic()
    with pytest.raises(InputError, match="no measured pressures"):
        prepared(log, pressures="measured")
    slope = np.column_stack([1e3 * log.time, 2e3 * log.time, 3e3 * log.time])
    gaps = slope.copy()
    gaps[100:110] = np.nan
    recording = prepared(replace(log, measured=gaps), pressures="measured")
    np.testing.assert_allclose(recording.pressures, slope)


# -- what cannot be -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "factor"), [("kPa", 1e3), ("bar", 1e5), ("psi", 6894.757), ("MPa", 1e6)]
)
def test_pressures_in_another_unit(unit: str, factor: float) -> None:
    log, _, _ = synthetic()
    with pytest.raises(InputError, match=f"^a.csv: .*look like {unit}, expected Pa"):
        prepared(replace(log, commanded=log.commanded / factor), keep_units=True)


def test_positions_in_mm() -> None:
    log, _, _ = synthetic()
    bodies = {name: replace(b, position=1e3 * b.position) for name, b in log.bodies.items()}
    mm = replace(log, tip_position=1e3 * log.tip_position, bodies=bodies)
    for frame in (None, "base"):
        with pytest.raises(InputError, match=r"look like mm, expected m$"):
            prepared(mm, frame=frame)
    little = replace(mm, tip_position=mm.tip_position.mean(axis=0) + 0.01 * log.tip_position)
    with pytest.raises(InputError, match=r"m away from base, .* look like mm"):
        prepared(little)


def test_times_in_ms() -> None:
    log, _, _ = synthetic()
    ms = np.round(1e3 * log.time)
    assert "must be divided by 1000" in remark(prepared(replace(log, time=ms)), "apart")
    assert prepared(replace(log, time=10 * log.time)).remarks == ()


def test_channels_that_are_not_used() -> None:
    log, _, _ = synthetic()
    recording = prepared(replace(log, commanded=log.commanded * [1, 0.01, 1]))
    assert "nothing is learnt about segment 1 channel 2, as" in remark(recording, "learnt")
    with pytest.raises(InputError, match="no pressure moves by more than 2 %"):
        prepared(replace(log, commanded=0.01 * log.commanded + 5e4))
    for constant in (0.0, 200.0):  # and not in mbar
        with pytest.raises(InputError, match="no pressure moves"):
            prepared(replace(log, commanded=0 * log.commanded + constant))


def test_pressures_beyond_the_limits() -> None:
    log, _, _ = synthetic()
    text = remark(prepared(replace(log, commanded=log.commanded * [1, 1, 3])), "beyond")
    assert re.match(r"segment 1 channel 3 is at 3\.9\d bar, beyond .* 0 to 1.5 bar", text)
    assert prepared(replace(log, commanded=1.05 * log.commanded)).remarks == ()


def test_a_tip_that_does_not_move() -> None:
    log, _, _ = synthetic()
    random = np.random.default_rng(0)
    for size in (0.0, 1e-5, 1e-3):
        noise = BASE[0] + random.normal(0, 1, (QUICK, 3)) * size
        with pytest.raises(InputError, match="the tip does not move"):
            prepared(changed(log, position=noise))


def test_a_row_for_each_settled_pressure_is_no_noise() -> None:
    """Rows are as far apart as the arm moves, but where the pressures say."""
    random = np.random.default_rng(0)
    p = random.uniform(0, 1.5e5, (40, 3))
    angle = np.radians([0, 120, 240])
    tip = np.column_stack([p @ np.cos(angle), p @ np.sin(angle), p.sum(axis=1)]) * 2e-7
    log = Log(time=20.0 * np.arange(40) + 0.5, commanded=p, tip_position=tip)
    recording = prepare(log, "a", ONE)
    assert recording.remarks == ()
    np.testing.assert_array_equal(recording.tracks[0].position, tip)
    with pytest.raises(InputError, match="does not move"):
        prepare(replace(log, commanded=random.permutation(p)), "a", ONE)


def test_too_few_rows() -> None:
    log = point_only(19)
    with pytest.raises(InputError, match="has 19 rows; expected at least 20"):
        prepare(log, "a", ONE)
    tip = point_only(100).tip_position.copy()
    tip[19:] = np.nan
    with pytest.raises(InputError, match="19 of 100 rows can be used; expected at least 20"):
        prepare(point_only(100, tip_position=tip), "a", ONE)
    with pytest.raises(InputError, match="missing in every row"):
        prepare(point_only(100, tip_position=tip * np.nan), "a", ONE)


def test_bodies_that_are_not_there() -> None:
    log, _, _ = synthetic()
    with pytest.raises(InputError, match="no body 'bse'; the bodies there are mid, base"):
        prepared(log, frame="bse")
    with pytest.raises(InputError, match="no body 'elbow'"):
        prepared(log, bodies=("elbow",))
    with pytest.raises(InputError, match="named twice"):
        prepared(log, bodies=("mid", "mid"))
    with pytest.raises(InputError, match="there is none but the tip"):
        prepare(point_only(), "a", ONE, frame="base")
    unseen = changed(log, "base", position=np.full((QUICK, 3), np.nan))
    with pytest.raises(InputError, match="no position of base, the frame, can be used"):
        prepared(unseen)
    unseen = changed(log, "mid", position=np.full((QUICK, 3), np.nan))
    assert np.isnan(prepared(unseen).track("mid").position).all()


def test_a_frame_that_moves() -> None:
    log, _, _ = synthetic()
    body = log.bodies["base"]
    moved = body.position + 0.004 * np.sin(log.time)[:, None] * [1, 0, 0]
    text = remark(prepared(changed(log, "base", position=moved)), "frame")
    assert re.search(r"moves by [34]\.\d mm and 0.0 degrees", text)
    tilt = Rotation.from_rotvec(np.outer(np.radians(5) * np.sin(log.time), [0, 1, 0])).as_matrix()
    turned = changed(log, "base", quaternion=quaternions(BASE[1] @ tilt))
    assert re.search(r"moves by 0\.\d mm and [45]\.\d degrees", remark(prepared(turned), "frame"))


# -- real ones ------------------------------------------------------------------------------------


@needs_ucl
@pytest.mark.parametrize("path", UCL, ids=lambda path: path.stem)
def test_recordings_of_one_module_are_used_whole(path: Any) -> None:
    """They have single jumps of about a millimetre, which are left to a robust loss."""
    log = read_log(path)
    recording = prepare(log, path.name, ONE)
    assert np.mean(np.isnan(recording.tracks[0].position[:, 0])) < 1e-3
    assert recording.tracks[0].rotation is None


def asu(path: Any) -> tuple[Log, Recording]:
    log = read_log(path)
    options = {"channels": (4, 5, 6, 1, 2, 3), "frame": "base", "bodies": ("mid",)}
    return log, prepare(log, path.name, longer(TWO), **options)  # type: ignore[arg-type]


def longer(description: RobotDescription) -> RobotDescription:
    """The arm of the recordings is 265 mm long."""
    segments = [s.model_copy(update={"length": 0.1325}) for s in description.segments]
    return description.model_copy(update={"segments": tuple(segments)})


@needs_asu
@pytest.mark.parametrize("path", ASU, ids=lambda path: path.stem)
def test_recordings_of_two_segments_are_smooth_afterwards(path: Any) -> None:
    log, recording = asu(path)
    np.testing.assert_array_equal(recording.pressures[:, :3], log.commanded[:, 3:])
    for track in recording.tracks:
        assert track.rotation is not None
        usable = np.isfinite(track.rotation[:, 0, 0])
        # only repeated rows are lost; the answer to the step is not
        assert np.mean(usable) > 0.87
        np.testing.assert_array_equal(usable, np.isfinite(track.position[:, 0]))
        seen = track.rotation[usable]
        assert np.degrees(angles(seen[1:], seen[:-1])).max() < 10
        # in a plane: the body's y axis stays across it
        upright = aligned(seen, np.eye(3))
        assert np.min(np.abs(upright[:, 1, 1])) > np.cos(np.radians(15))
    tip, mid = (track.position for track in recording.tracks)
    assert np.nanmax(tip[:, 2]) < np.nanmin(mid[:, 2]) < 0  # it hangs
    assert not any("jumps" in text or "frame" in text for text in recording.remarks)


@needs_asu
def test_flips_of_real_recordings_are_those_seen_between_rows() -> None:
    """Counted another way: rotations between rows of more than 60 degrees, stale rows aside."""
    for path in ASU:
        log, recording = asu(path)
        assert log.tip_quaternion is not None
        usable = np.isfinite(recording.tracks[0].position[:, 0])
        q = Rotation.from_quat(log.tip_quaternion[usable], scalar_first=True)
        count = int(np.sum((q[1:] * q[:-1].inv()).magnitude() > np.radians(60)))
        found = [text for text in recording.remarks if "orientation of tip flips" in text]
        assert len(found) == (count > 0), path.name
        assert not found or f" in {count} row" in found[0], (path.name, count)


def test_a_long_log_is_prepared_fast() -> None:
    """A twentieth of a million rows with everything that is wrong, in a twentieth of the time."""
    count = 50_000
    log, _, turns = synthetic(1000)
    rows = np.arange(count) % 1000
    random = np.random.default_rng(0)
    noise = random.normal(0, 1e-5, (3, count, 3))
    cube = matrices_identity_first()[np.where(random.random(count) < 0.02, 9, 0)]
    position = log.tip_position[rows] + noise[0]
    position[random.random(count) < 0.01] += 0.05
    mid, base = log.bodies["mid"], log.bodies["base"]
    assert mid.quaternion is not None
    assert base.quaternion is not None
    long = Log(
        time=0.07 * np.arange(count),
        commanded=log.commanded[rows],
        tip_position=position,
        tip_quaternion=quaternions(BASE[1] @ turns[rows] @ cube),
        bodies={
            "mid": Body(mid.position[rows] + noise[1], mid.quaternion[rows]),
            "base": Body(base.position[rows] + noise[2], base.quaternion[rows]),
        },
    )
    begin = time.process_time()
    recording = prepared(long)
    assert time.process_time() - begin < 2.0
    assert len(recording.time) == count
