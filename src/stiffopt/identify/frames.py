"""Find logs whose frame, or a body of whose tracker, was defined anew between logs.

Tracking software defines a body by its markers, with an origin and axes as somebody chose them. If
the body that is the frame is defined anew, all poses of later logs are moved alike, ``T X``. If the
tip's body, or another tracked one, is, its poses are moved in its own axes, ``X G``.

The arm of the robot file, with its shape corrected a little, is fitted to the other logs. One rigid
motion has to bring the log, or several in a row, to where this arm is at their pressures. Where the
evidence is not overwhelming, nothing is moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, PressureError
from stiffopt.identify.detection import lagged_pressures
from stiffopt.identify.discrepancy import centres
from stiffopt.identify.hypotheses import Hypothesis, moved, of_channels, rows_with_all, turn_text
from stiffopt.identify.recording import FRAME, Recording, Track
from stiffopt.identify.settings import DETECTION
from stiffopt.identify.setup import Setup
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS, mean_rotation, whole
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

SHOWN = 5e-4
"""Shortest translation of a frame that is told, in m."""
Tracks = tuple[Track, ...]
"""Poses in the rows of a log, the tip's first, in the frame of the recordings."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion that undoes a new definition of the frame or of a body in some logs.

    Attributes
    ----------
    logs : indices of the logs.
    track : index of the track whose body was defined anew; None for the frame of all tracks.
    rotation : (3, 3), and
    shift : (3,), in m. A pose ``X, x`` of the frame becomes ``R X, R x + s``, that of a body
        ``X R, x + X s``.
    """

    logs: tuple[int, ...]
    track: int | None
    rotation: Array
    shift: Array

    def applied(self, recordings: Sequence[Recording]) -> list[Recording]:
        """Return the recordings, with those of the logs moved."""
        anew = FRAME if self.track is None else recordings[0].tracks[self.track].name
        return [
            replace(each, tracks=self.of(each.tracks), anew=anew) if i in self.logs else each
            for i, each in enumerate(recordings)
        ]

    def of(self, tracks: Tracks) -> Tracks:
        """Return the poses of a log after the motion."""
        if self.track is None:
            return moved(tracks, self.rotation, self.shift)
        own = tracks[self.track]
        assert own.rotation is not None
        turned = Track(
            own.name, own.position + own.rotation @ self.shift, own.rotation @ self.rotation
        )
        return (*tracks[: self.track], turned, *tracks[self.track + 1 :])

    def told(self, recordings: Sequence[Recording]) -> str:
        """Describe the motion, as the beginning of a sentence."""
        names = ", ".join(recordings[i].name for i in self.logs)
        words = motion_text(self.rotation, self.shift)
        if self.track is None:
            return f"the frame of {names} was defined anew: its poses are {words}"
        body = recordings[0].tracks[self.track].name
        return f"the body '{body}' was defined anew in {names}: it is {words} in its own axes"


def motion_text(rotation: Array, shift: Array) -> str:
    """Describe a rigid motion, as the end of a sentence."""
    words = f"turned {turn_text(rotation)}"
    if np.linalg.norm(shift) > SHOWN:
        words += f" and moved by {np.linalg.norm(shift) * 1e3:.0f} mm"
    return words


NOWHERE = Motion((), None, np.eye(3), np.zeros(3))
"""Moves no log."""


def _points(tracks: Sequence[Track], lever: float) -> Array:
    """Return the origins of the bodies, and points on their axes at a distance: (N, m, 3)."""
    found = []
    for each in tracks:
        origin = each.position[:, np.newaxis]
        found.append(origin)
        if each.rotation is not None:
            found.append(origin + lever * each.rotation.swapaxes(1, 2))
    return np.concatenate(found, axis=1)


def _turned_like(tracks: Tracks, expected: Tracks) -> Tracks:
    """Return poses with that rotation of the cube in each body's axes that is nearest."""
    return tuple(
        own
        if own.rotation is None or other.rotation is None
        else replace(own, rotation=own.rotation @ _nearest_cube(own.rotation, other.rotation))
        for own, other in zip(tracks, expected, strict=True)
    )


def _nearest_cube(own: Array, expected: Array) -> Array:
    """Return the rotation of the cube that brings rotations (N, 3, 3) nearest to others."""
    between = np.einsum("nji,njk->ik", expected, own)
    return CUBE_ROTATIONS[np.argmax(np.einsum("ij,gji->g", between, CUBE_ROTATIONS))]


def _tip_distances(one: Tracks, other: Tracks) -> Array:
    """Return the distances (N,) of the tips of two poses, in m."""
    return np.asarray(np.linalg.norm(one[0].position - other[0].position, axis=1))


def _angles(one: Tracks, other: Tracks) -> Array:
    """Return the angles (N,) between the tips of two poses, in rad; zero if they are not known."""
    own, expected = one[0].rotation, other[0].rotation
    if own is None or expected is None:
        return np.zeros(len(one[0].position))
    cosine = (np.einsum("nij,nij->n", own, expected) - 1) / 2
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


@dataclass(frozen=True, eq=False)
class _Tried:
    """A motion, or none, with where the arm fitted to the other logs expects the poses.

    Attributes
    ----------
    motion : `NOWHERE` if the logs are left as they are.
    logs : which were not fitted.
    softness : factor on pressures.
    expected, recorded, after : poses in each log: by the arm, as recorded, and after the motion.
    score : RMS distance of points on the bodies, as a mean over all logs, in m.
    far : mean distance by which the fit moves the tip of the robot file's arm, in m.
    """

    motion: Motion
    softness: float
    expected: list[Tracks]
    recorded: list[Tracks]
    after: list[Tracks]
    score: float
    far: float


@dataclass(frozen=True, eq=False)
class MovedFrame:
    """An accepted motion.

    `as_is`, `then`: mean misses of the tip without it and with it, in m; `turned_as_is`,
    `turned_then`: of its orientation, in rad; `score`: see `FrameComparer`.
    """

    motion: Motion
    as_is: float
    then: float
    turned_as_is: float
    turned_then: float
    score: float

    def told(self, recordings: Sequence[Recording]) -> str:
        """Describe the motion and the evidence, as the beginning of a sentence."""
        words = (
            f"{self.motion.told(recordings)}; the arm fitted to the other logs then misses the tip "
            f"by {self.then * 1e3:.1f} mm instead of {self.as_is * 1e3:.1f} mm"
        )
        if self.turned_as_is:
            then, as_is = np.degrees([self.turned_then, self.turned_as_is])
            words += f", its orientation by {then:.0f} instead of {as_is:.0f} deg"
        return words


@dataclass(frozen=True, eq=False)
class OtherChannels:
    """Logs that have other channels than the others do, or other lines, rather than a moved frame.

    `as_is`, `then`: mean misses of the tip without and with these; `left`: of its pose; `score`: as
    of `FrameComparer`; in m.
    """

    logs: tuple[int, ...]
    hypothesis: Hypothesis
    as_is: float
    then: float
    left: float
    score: float

    def told(self, description: RobotDescription, recordings: Sequence[Recording]) -> str:
        """Describe it, as a sentence."""
        names = ", ".join(recordings[i].name for i in self.logs)
        return (
            f"{names} differs from the other logs, as if {self.hypothesis.told(description, ())}; "
            f"the arm fitted to the others then misses the tip by {self.then * 1e3:.1f} mm instead "
            f"of {self.as_is * 1e3:.1f} mm. This is not corrected: look at the columns of this "
            "log, and at its frame, or leave it out"
        )


class FrameComparer:
    """Compares logs with each other, by the robot file's arm with a shape that is fitted to some.

    Parameters
    ----------
    setup : with at least two recordings.
    """

    def __init__(self, setup: Setup) -> None:
        description = setup.description
        self._setup, self._length = setup, description.length
        self._lever = DETECTION.frame_lever * description.length
        self._arm = Manipulator(description.model_copy(update={"calibration": None}))
        stations = [description.length if each.at is None else each.at for each in setup.points]
        ends = np.cumsum([segment.length for segment in description.segments])
        self._stations, self._tracks = np.array([*stations, *ends]), len(stations)
        self._turns = [
            point.turns and all(_is_turning(each.tracks[k]) for each in setup.recordings)
            for k, point in enumerate(setup.points)
        ]
        self._pressures: list[Array] = []
        self._recorded: list[Tracks] = []
        count = max(DETECTION.rows // len(setup.recordings), 8)
        for each in setup.recordings:
            tracks = [
                t if turns else replace(t, rotation=None)
                for t, turns in zip(each.tracks, self._turns, strict=True)
            ]
            seen = [
                whole(t.position) & (_turning(t) if turns else True)
                for t, turns in zip(tracks, self._turns, strict=True)
            ]
            rows = rows_with_all(each, seen, count)
            self._pressures.append(
                lagged_pressures(each.time, each.pressures, DETECTION.clock_lag)[rows]
            )
            self._recorded.append(tuple(
                replace(
                    t,
                    position=t.position[rows],
                    rotation=None if t.rotation is None else t.rotation[rows],
                )
                for t in tracks
            ))  # fmt: skip

    @cached_property
    def _predicted(self) -> dict[float, list[Array]]:
        """Return poses (N, stations, 4, 4) of the arm in each log, for each softness it bears.

        They are in the frame of the recordings.
        """
        found = {each: self._poses(each, self._pressures) for each in DETECTION.frame_softness}
        return {softness: poses for softness, poses in found.items() if poses is not None}

    def _poses(self, softness: float, pressures: Sequence[Array]) -> list[Array] | None:
        try:
            return [
                self._setup.base @ self._arm.pose(softness * p, self._stations) for p in pressures
            ]
        except (EquilibriumError, PressureError):
            return None

    def score(self) -> float:
        """Return the RMS miss of all logs by the arm fitted to them, in m."""
        everything = range(len(self._pressures))
        scores = [self._tried(each, everything, NOWHERE).score for each in self._predicted.values()]
        return min(scores, default=np.inf)

    def turned(self, turns: Sequence[int]) -> FrameComparer:
        """Return the comparer of the logs whose axes are turned; see `Hypothesis.turns`."""
        self._predicted  # noqa: B018 - which is the same for both
        other = copy(self)
        other._recorded = [
            moved(own, CUBE_ROTATIONS[turn], np.zeros(3))
            for own, turn in zip(self._recorded, turns, strict=True)
        ]
        return other

    def left(self, logs: tuple[int, ...]) -> float:
        """Return the mean miss of some logs by the arm fitted to the others, in m."""
        rest = [i for i in range(len(self._pressures)) if i not in logs]
        tried = [self._tried(each, rest, NOWHERE) for each in self._predicted.values()]
        best = min(tried, key=lambda each: each.score)
        return self._mean(best, best.recorded, self._off, logs)

    # the shape of the arm ----------------------------------------------------------------------

    def _expected(self, poses: list[Array], fitted: Sequence[int]) -> list[Tracks]:
        """Return the poses that an arm fitted to some logs has in all of them.

        Each track's position is that of the robot file's arm and a linear function of where its
        segments end; a ridge keeps the arm as it is in directions that were not recorded. Turns
        of base and sensor follow from the orientations.
        """
        ends = [
            (p[:, self._tracks :, :3, 3] - self._setup.base[:3, 3]) / self._length for p in poses
        ]
        known = [np.hstack([np.ones((len(each), 1)), each.reshape(len(each), -1)]) for each in ends]
        size = known[0].shape[1]
        ridge = DETECTION.frame_ridge * np.r_[0.01, np.ones(size - 1)]
        found = []  # of each track, its poses in each log
        for k in range(self._tracks):
            features = np.concatenate([known[i] for i in fitted])
            own = np.concatenate([poses[i][:, k, :3, 3] for i in fitted])
            off = np.concatenate([self._recorded[i][k].position for i in fitted]) - own
            weight, coefficients = np.ones(len(off)), np.zeros((size, 3))
            for _ in range(DETECTION.clock_rounds):
                weighted = features * weight[:, np.newaxis]
                normal = weighted.T @ features + len(off) * np.diag(ridge)
                coefficients = np.linalg.solve(normal, weighted.T @ off)
                distance = np.linalg.norm(off - features @ coefficients, axis=1)
                median = max(float(np.median(distance)), 1e-9)
                weight = 1 / np.sqrt(1 + (distance / median) ** 2)
            start = _nearest_rotation(
                own, own + features @ coefficients, DETECTION.known_turn * self._length
            )
            rotations = self._expected_rotations(poses, fitted, k, start)
            name = self._recorded[0][k].name
            found.append(
                [
                    Track(name, p[:, k, :3, 3] + each @ coefficients, rotation)
                    for p, each, rotation in zip(poses, known, rotations, strict=True)
                ]
            )
        return list(zip(*found, strict=True))

    def _expected_rotations(
        self, poses: list[Array], fitted: Sequence[int], k: int, base: Array
    ) -> list[Array | None]:
        """Return the orientations ``B Q S`` of a track in all logs, with Q those of the arm."""
        recorded = [self._recorded[i][k].rotation for i in fitted]
        own = [p[:, k, :3, :3] for p in poses]
        measured = [each for each in recorded if each is not None]
        if not measured:
            return [None] * len(poses)
        sensor = mean_rotation(own[fitted[0]].swapaxes(1, 2) @ base.T @ measured[0])
        arm = np.concatenate([own[i] for i in fitted])
        for _ in range(DETECTION.clock_rounds):
            known = np.concatenate([
                each @ _nearest_cube(each, base @ own[i] @ sensor)
                for i, each in zip(fitted, measured, strict=True)
            ])  # fmt: skip
            sensor = mean_rotation(arm.swapaxes(1, 2) @ base.T @ known)
            base = mean_rotation(known @ (arm @ sensor).swapaxes(1, 2))
        return [base @ each @ sensor for each in own]

    # motions -----------------------------------------------------------------------------------

    def _tried(
        self,
        poses: list[Array],
        fitted: Sequence[int],
        motion: Motion,
        expected: list[Tracks] | None = None,
    ) -> _Tried:
        """Return what a motion leaves."""
        expected = self._expected(poses, fitted) if expected is None else expected
        recorded = [_turned_like(*each) for each in zip(self._recorded, expected, strict=True)]
        after = list(recorded)
        for i in motion.logs:
            after[i] = _turned_like(motion.of(self._recorded[i]), expected[i])
        squares = [np.mean(self._off(a, e) ** 2) for a, e in zip(after, expected, strict=True)]
        tips = [
            np.linalg.norm(expected[i][0].position - poses[i][:, 0, :3, 3], axis=1).mean()
            for i in fitted
        ]
        score, far = float(np.sqrt(np.mean(squares))), float(np.mean(tips))
        return _Tried(motion, 1.0, expected, recorded, after, score, far)

    def _off(self, one: Tracks, other: Tracks) -> Array:
        """Return the RMS distances (N,) of points on the bodies between two poses, in m."""
        apart = _points(one, self._lever) - _points(other, self._lever)
        return np.asarray(np.sqrt((apart**2).sum(axis=2).mean(axis=1)))

    def _of_frame(self, logs: tuple[int, ...], expected: list[Tracks]) -> Motion:
        """Return the motion of all tracks that brings logs nearest to the expected poses.

        Flips of the bodies may leave all orientations of a log turned by one rotation of the cube.
        """
        known = DETECTION.known_turn * self._length
        target = np.concatenate([_points(expected[i], self._lever).reshape(-1, 3) for i in logs])
        best, least = (np.eye(3), np.zeros(3)), np.inf
        for cube in CUBE_ROTATIONS if any(self._turns) else CUBE_ROTATIONS[:1]:
            turned = [
                [t if t.rotation is None else replace(t, rotation=t.rotation @ cube) for t in own]
                for own in (self._recorded[i] for i in logs)
            ]
            source = np.concatenate([_points(own, self._lever).reshape(-1, 3) for own in turned])
            rotation = _nearest_rotation(source, target, known)
            shift = target.mean(axis=0) - rotation @ source.mean(axis=0)
            left = float(np.mean((source @ rotation.T + shift - target) ** 2))
            if left < least:
                best, least = (rotation, shift), left
        return Motion(logs, None, *best)

    def _of_body(self, logs: tuple[int, ...], k: int, expected: list[Tracks]) -> Motion:
        """Return the motion of a track in its own axes that brings it nearest to the expected."""
        own, wanted, off = [], [], []
        for i in logs:
            recorded, other = self._recorded[i][k], expected[i][k]
            assert recorded.rotation is not None
            assert other.rotation is not None
            own.append(recorded.rotation)
            wanted.append(other.rotation)
            off.append(other.position - recorded.position)
        rotation = np.concatenate(own)
        turn = mean_rotation(rotation.swapaxes(1, 2) @ np.concatenate(wanted))
        shift = np.einsum("nji,nj->i", rotation, np.concatenate(off)) / len(rotation)
        return Motion(logs, k, turn, shift)

    def _all_tried(self) -> Iterator[_Tried]:
        """Yield the best motion of each kind, of each log and of at most half of them in a row."""
        count = len(self._pressures)
        for begin in range(count):
            for end in range(begin + 1, min(count, begin + count // 2) + 1):
                logs = tuple(range(begin, end))
                rest = [i for i in range(count) if i not in logs]
                tried: dict[int | None, _Tried] = {}
                for softness, poses in self._predicted.items():
                    expected = self._expected(poses, rest)
                    motions = [self._of_frame(logs, expected)]
                    motions += [
                        self._of_body(logs, k, expected)
                        for k, turns in enumerate(self._turns)
                        if turns
                    ]
                    for motion in motions:
                        found = self._tried(poses, rest, motion, expected)
                        if motion.track not in tried or found.score < tried[motion.track].score:
                            tried[motion.track] = replace(found, softness=softness)
                yield from tried.values()

    def found(self) -> MovedFrame | OtherChannels | None:
        """Return the motion that the evidence proves; None if there is none or it is unclear.

        Channels that explain the same logs as well are returned instead.
        """
        ranked = sorted(self._all_tried(), key=lambda each: each.score)
        if not ranked or self.score() * DETECTION.tie < ranked[0].score:
            return None
        best = ranked[0]
        everything = set(range(len(self._pressures)))
        for each in ranked[1:]:
            same = each.motion.track == best.motion.track
            if same and set(each.motion.logs) == everything - set(best.motion.logs):
                best = min(best, each, key=lambda either: either.far)  # the file's frame stays
            elif each.motion.logs == best.motion.logs:
                left, other = (self._mean(one, one.after, self._off) for one in (best, each))
                if left > DETECTION.tie * other:
                    return None
            elif best.score > DETECTION.tie * each.score:
                return None
        if not self._explains(best):
            return None
        channels = self.other_channels(best.motion.logs, best.softness)
        if channels is not None and best.score > DETECTION.tie * channels.score:
            return channels
        tips = [self._mean(best, poses, _tip_distances) for poses in (best.recorded, best.after)]
        turned = [self._mean(best, poses, _angles) for poses in (best.recorded, best.after)]
        return MovedFrame(best.motion, tips[0], tips[1], turned[0], turned[1], best.score)

    @staticmethod
    def _mean(
        tried: _Tried,
        poses: Sequence[Tracks],
        measure: Callable[[Tracks, Tracks], Array],
        logs: Sequence[int] = (),
    ) -> float:
        """Return the mean of a measure between poses and the expected ones, over the moved logs."""
        logs = logs or tried.motion.logs
        return float(np.concatenate([measure(poses[i], tried.expected[i]) for i in logs]).mean())

    def _explains(self, tried: _Tried) -> bool:
        """Return True if a motion is the reason why its logs are far off, at different poses.

        As in `validation`: at least four, one of them near rest, where the pose of every arm is
        known; poses on a line could be turned to fit any other arm, so all have to be moved.
        """
        limits = np.subtract(
            self._setup.description.pressure_max, self._setup.description.pressure_min
        )
        span, logs = float(limits.max()), tried.motion.logs
        pressures = np.concatenate([self._pressures[i] for i in logs])
        if np.abs(pressures).max(axis=1).min() > DETECTION.rest * span:
            return False
        rows = centres(pressures, DETECTION.apart * span, DETECTION.rows)
        if len(rows) < DETECTION.poses:
            return False
        before, after = (
            np.concatenate([self._off(poses[i], tried.expected[i]) for i in logs])
            for poses in (tried.recorded, tried.after)
        )
        turned, then = (
            self._mean(tried, poses, _angles) for poses in (tried.recorded, tried.after)
        )
        tips = np.concatenate([tried.expected[i][0].position for i in logs])[rows]
        spread = np.linalg.svd(tips - tips.mean(axis=0), compute_uv=False)
        in_line = spread[1] < DETECTION.in_line * spread[0]
        off = DETECTION.off * self._length
        least = float((np.min if in_line else np.mean)(before[rows]))
        return bool(
            before.mean() > off
            and after.mean() < off
            and after.mean() <= DETECTION.frame * before.mean()
            and after[rows].mean() <= DETECTION.frame * least
            and then <= turned + DETECTION.frame_angle
        )

    def other_channels(self, logs: tuple[int, ...], softness: float = 1.0) -> OtherChannels | None:
        """Return the other channels, or line, that some logs alone are most likely to have.

        `softness` is the factor on pressures. None if the arm does not bear them, or if these
        channels explain little.
        """
        description, keep = self._setup.description, self._setup.settings.keep
        if softness not in self._predicted:
            return None
        low = np.maximum(description.pressure_min, 0.0)
        rest = [i for i in range(len(self._pressures)) if i not in logs]
        as_is = self._tried(self._predicted[softness], rest, NOWHERE)
        tips = self._mean(as_is, as_is.recorded, _tip_distances, logs)
        best: OtherChannels | None = None
        for hypothesis in of_channels(description, 1):
            driven = [hypothesis.driven(self._pressures[i], low) for i in logs]
            found = None if hypothesis.kind in keep else self._poses(softness, driven)
            if found is None:
                continue
            poses = list(self._predicted[softness])
            for i, each in zip(logs, found, strict=True):
                poses[i] = each
            tried = self._tried(poses, rest, NOWHERE)
            left = self._mean(tried, tried.recorded, self._off, logs)
            if best is None or left < best.left:
                then = self._mean(tried, tried.recorded, _tip_distances, logs)
                best = OtherChannels(logs, hypothesis, tips, then, left, tried.score)
        return best if best and best.then < DETECTION.overwhelming * best.as_is else None


def _turning(track: Track) -> NDArray[np.bool_]:
    """Return in which rows (N,) a track's orientation is known."""
    if track.rotation is None:
        return np.zeros(len(track.position), dtype=bool)
    return np.asarray(np.isfinite(track.rotation).all(axis=(1, 2)))


def _is_turning(track: Track) -> bool:
    """Return True if the orientation is known in most of the rows in which the position is."""
    seen = whole(track.position)
    return bool(np.sum(_turning(track)[seen]) > 0.8 * np.sum(seen))


def _nearest_rotation(source: Array, target: Array, known: float) -> Array:
    """Return the rotation (3, 3) that turns points (N, 3) to others about their means.

    Turns that spreads of less than `known`, in m, would determine stay small.
    """
    spread = (target - target.mean(axis=0)).T @ (source - source.mean(axis=0))
    u, _, vt = np.linalg.svd(spread + len(source) * known**2 * np.eye(3))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


# -- a tested log ----------------------------------------------------------------------------------


def replaced(
    recording: Recording, measured: Array, predicted: Array, length: float
) -> tuple[Recording, str, bool]:
    """Move a recording rigidly to where a calibrated model predicts its tip.

    Prefers a rotation of the cube without translation if it fits about as well.

    Parameters
    ----------
    recording : Recording
    measured, predicted : (N, 3), in m.
    length : of the arm, in m.

    Returns
    -------
    recording, words, is_shifted
        The words describe the motion, as the end of a sentence.
    """
    seen = whole(measured)
    x, y = measured[seen], predicted[seen]

    def miss(rotation: Array, shift: Array) -> float:
        return float(np.linalg.norm(x @ rotation.T + shift - y, axis=1).mean())

    quarter = min(CUBE_ROTATIONS, key=lambda rotation: miss(rotation, np.zeros(3)))
    rotation = _nearest_rotation(x @ quarter.T, y, DETECTION.known_turn * length) @ quarter
    shift = y.mean(axis=0) - rotation @ x.mean(axis=0)
    if DETECTION.overwhelming * miss(quarter, np.zeros(3)) < miss(rotation, shift):
        rotation, shift = quarter, np.zeros(3)
    is_shifted = bool(np.linalg.norm(shift) > SHOWN)
    tracks = moved(recording.tracks, rotation, shift)
    return replace(recording, tracks=tracks), motion_text(rotation, shift), is_shifted
