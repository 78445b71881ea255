"""Find logs whose frame, or a body of whose tracker, was defined anew between logs.

The arm of the robot file, with its shape corrected a little, is fitted to the other logs. One
motion (see `motions`) has to bring the log, or several in a row, to where this arm is at their
pressures. Other channels in this log alone may explain it as well; these are told and not
corrected. Where the evidence is not overwhelming, nothing is told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, PressureError
from stiffopt.identify.detection import lagged_pressures, weightless
from stiffopt.identify.hypotheses import Hypothesis, moved, of_channels, rows_with_all
from stiffopt.identify.motions import (
    NOWHERE,
    Motion,
    MotionKind,
    Tracks,
    angles,
    apart,
    are_both_moved,
    best_motions,
    different_poses,
    distances,
    in_line,
    is_turning,
    joined,
    nearest_cube,
    nearest_rotation,
    of_rows,
    turned_like,
    turning,
)
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.settings import DETECTION
from stiffopt.identify.setup import Setup
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS, mean_rotation, whole
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

Logs = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Tried:
    """A motion, or none, with where the arm fitted to the other logs expects the poses.

    Attributes
    ----------
    logs : which were not fitted.
    motion : `NOWHERE` if they are left as they are.
    softness : factor on pressures.
    expected, recorded, after : poses in each log: by the arm, as recorded, and after the motion.
    misses : (logs,), RMS distance of points on the bodies after the motion, in m.
    far : mean distance by which the fit moves the tip of the robot file's arm, in m.
    """

    logs: Logs
    motion: Motion
    softness: float
    expected: list[Tracks]
    recorded: list[Tracks]
    after: list[Tracks]
    misses: Array
    far: float

    def score(self, logs: Logs | None = None) -> float:
        """Return the RMS miss of some logs, or of all, in m."""
        return _rms(self.misses if logs is None else self.misses[list(logs)])

    def mean(self, measure: Callable[[Tracks, Tracks], Array], poses: Sequence[Tracks]) -> float:
        """Return the mean of a measure between poses and the expected ones, over the logs."""
        found = [measure(poses[i], self.expected[i]) for i in self.logs]
        return float(np.concatenate(found).mean())

    def miss(self, i: int) -> float:
        """Return the mean miss of the tip in a log as it was recorded, in m."""
        return float(distances(self.recorded[i], self.expected[i]).mean())

    def share(self, i: int) -> float:
        """Return the same over the tip's mean distance from its middle in that log."""
        tips = self.recorded[i][0].position
        motion = float(np.linalg.norm(tips - tips.mean(axis=0), axis=1).mean())
        return self.miss(i) / max(motion, 1e-9)

    @property
    def measures(self) -> tuple[Callable[[Tracks, Tracks], Array], ...]:
        """Distances and angles of the body that was moved, or of the tip."""
        k = self.motion.kind if isinstance(self.motion.kind, int) else 0
        return partial(distances, k=k), partial(angles, k=k)


@dataclass(frozen=True, eq=False)
class MovedFrame:
    """An accepted motion.

    `as_is`, `then`: mean misses of the tip, or of the body that was defined anew, without it and
    with it, in m; `turned_as_is`, `turned_then`: of its orientation, in rad; `score`: see
    `FrameComparer.score`.
    """

    motion: Motion
    as_is: float
    then: float
    turned_as_is: float
    turned_then: float
    score: float

    def told(self, recordings: Sequence[Recording]) -> str:
        """Describe the motion and the evidence, as the beginning of a sentence."""
        kind = self.motion.kind
        body = "the tip"
        if isinstance(kind, int) and kind:
            body = f"'{recordings[0].tracks[kind].name}'"
        words = (
            f"{self.motion.told(recordings)}; the arm fitted to the other logs then misses "
            f"{body} by {self.then * 1e3:.1f} mm instead of {self.as_is * 1e3:.1f} mm"
        )
        if self.turned_as_is:
            then, as_is = np.degrees([self.turned_then, self.turned_as_is])
            words += f", its orientation by {then:.0f} instead of {as_is:.0f} deg"
        return words


@dataclass(frozen=True, eq=False)
class OtherChannels:
    """Logs that have other channels than the others do, or other lines, rather than a moved frame.

    `as_is`, `then`: mean misses of the tip without and with these; `left`: of its pose; `score`:
    see `FrameComparer.score`; in m.
    """

    logs: Logs
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


@dataclass(frozen=True, eq=False)
class Misfit:
    """Logs that do not fit the others, for no reason that was found.

    `left`: mean miss of the tip by the arm fitted to the others, in m. `turned`: what a quarter
    turn of the axes would leave, which is too uncertain to be corrected; infinite without one.
    """

    logs: Logs
    left: float
    turned: float = np.inf

    def told(self, recordings: Sequence[Recording]) -> str:
        """Describe it, as a sentence."""
        names = ", ".join(recordings[i].name for i in self.logs)
        one = len(self.logs) == 1
        words = (
            f"{names} {'does' if one else 'do'} not fit the other logs: the arm fitted to them "
            f"misses {'its' if one else 'their'} tip by {self.left * 1e3:.1f} mm"
        )
        if np.isfinite(self.turned):
            return words + (
                f"; axes turned by quarter turns leave {self.turned * 1e3:.1f} mm, or a mirror "
                "explains it as well, so that nothing was corrected; look at how the tracker's "
                "frame was defined"
            )
        return words + (
            ", and no single reason was found; look at whether it is of the same arm with the same "
            "channels, has pressures far beyond those of the others, or whether both its frame and "
            "a body were defined anew, or leave it out"
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
        self._arm = Manipulator(description.model_copy(update={"calibration": None}))
        stations = [description.length if each.at is None else each.at for each in setup.points]
        ends = np.cumsum([segment.length for segment in description.segments])
        self._stations, self._tracks = np.array([*stations, *ends]), len(stations)
        self._turns = [
            point.turns and all(is_turning(each.tracks[k]) for each in setup.recordings)
            for k, point in enumerate(setup.points)
        ]
        tracks = [track for each in setup.recordings for track in each.tracks]
        self._has_orientations = any(track.rotation is not None for track in tracks)
        self._pressures: list[Array] = []
        self._recorded: list[Tracks] = []
        count = max(DETECTION.rows // len(setup.recordings), 8)
        for each in setup.recordings:
            tracks = [
                t if turns else replace(t, rotation=None)
                for t, turns in zip(each.tracks, self._turns, strict=True)
            ]
            seen = [
                whole(t.position) & (turning(t) if turns else True)
                for t, turns in zip(tracks, self._turns, strict=True)
            ]
            rows = rows_with_all(each, seen, count)
            self._pressures.append(
                lagged_pressures(each.time, each.pressures, DETECTION.clock_lag)[rows]
            )
            self._recorded.append(of_rows(tuple(tracks), rows))

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

    def score(self, logs: Logs | None = None) -> float:
        """Return the RMS miss of some logs, or of all, by the arm fitted to all of them, in m."""
        return min((each.score(logs) for each in self._unmoved(())), default=np.inf)

    def turned(self, turns: Sequence[int]) -> FrameComparer:
        """Return the comparer of the logs whose axes are turned; see `Hypothesis.turns`."""
        self._predicted  # noqa: B018 - which is the same for both
        other = copy(self)
        other._recorded = [
            moved(own, CUBE_ROTATIONS[turn], np.zeros(3))
            for own, turn in zip(self._recorded, turns, strict=True)
        ]
        return other

    def left(self, logs: Logs) -> float:
        """Return the mean miss of some logs by the arm fitted to the others, in m."""
        best = min(self._unmoved(logs), key=_Tried.score)
        return best.mean(self._off, best.recorded)

    def left_of_mirror(self, logs: Logs) -> float:
        """Return the same after the best mirror of some logs; infinite if there is none."""
        tried = (each for each in self._moved(logs) if each.motion.kind == "mirror")
        return min((each.mean(self._off, each.after) for each in tried), default=np.inf)

    def misfit(self, logs: Logs) -> Misfit:
        """Return by how much some logs do not fit the others."""
        best = min(self._unmoved(logs), key=_Tried.score)
        return Misfit(logs, best.mean(distances, best.recorded))

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
            start = nearest_rotation(
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
                each @ nearest_cube(each, base @ own[i] @ sensor)
                for i, each in zip(fitted, measured, strict=True)
            ])  # fmt: skip
            sensor = mean_rotation(arm.swapaxes(1, 2) @ base.T @ known)
            base = mean_rotation(known @ (arm @ sensor).swapaxes(1, 2))
        return [base @ each @ sensor for each in own]

    # motions -----------------------------------------------------------------------------------

    def _rest(self, logs: Logs) -> Logs:
        return tuple(i for i in range(len(self._pressures)) if i not in logs)

    def _off(self, one: Tracks, other: Tracks) -> Array:
        return apart(one, other, self._length)

    def _unmoved(self, logs: Logs) -> list[_Tried]:
        """Return what the arm fitted to the other logs leaves, for each softness."""
        return [
            self._tried(softness, poses, logs, NOWHERE, self._expected(poses, self._rest(logs)))
            for softness, poses in self._predicted.items()
        ]

    def _moved(self, logs: Logs) -> list[_Tried]:
        """Return the best motion of each kind of some logs, by the arm fitted to the others."""
        found: dict[MotionKind, _Tried] = {}
        own = joined([self._recorded[i] for i in logs])
        for softness, poses in self._predicted.items():
            expected = self._expected(poses, self._rest(logs))
            wanted = joined([expected[i] for i in logs])
            for motion in best_motions(
                logs, own, wanted, self._length, has_orientations=self._has_orientations
            ):
                tried = self._tried(softness, poses, logs, motion, expected)
                if motion.kind not in found or tried.score() < found[motion.kind].score():
                    found[motion.kind] = tried
        return list(found.values())

    def _tried(
        self,
        softness: float,
        poses: list[Array],
        logs: Logs,
        motion: Motion,
        expected: list[Tracks],
    ) -> _Tried:
        """Return what a motion leaves."""
        recorded = [turned_like(*each) for each in zip(self._recorded, expected, strict=True)]
        after = list(recorded)
        for i in motion.logs:
            after[i] = turned_like(motion.of(self._recorded[i]), expected[i])
        misses = [
            np.sqrt(np.mean(self._off(*each) ** 2)) for each in zip(after, expected, strict=True)
        ]
        far = [
            np.linalg.norm(expected[i][0].position - poses[i][:, 0, :3, 3], axis=1).mean()
            for i in self._rest(logs)
        ]
        return _Tried(
            logs, motion, softness, expected, recorded, after, np.array(misses), float(np.mean(far))
        )

    def found(self) -> MovedFrame | OtherChannels | Misfit | None:
        """Return the motion that the evidence proves; None if there is none.

        Channels that explain the same logs as well are returned instead, and a misfit if no reason
        is clear.
        """
        alone = [each for i in range(len(self._pressures)) for each in self._moved((i,))]
        if not alone:
            return None
        best = self._widened(min(alone, key=_Tried.score))
        others = [each for each in self._moved(best.logs) if each.motion.kind != best.motion.kind]
        left = best.score(best.logs)
        is_clear = all(left <= DETECTION.tie * each.score(best.logs) for each in others)
        is_clear = is_clear and best.motion.kind != "scale" and not self._has_both(best)
        if not (is_clear and self._is_judged(best, best.misses) and self._explains(best)):
            return self.channels_alone() or self._unexplained()
        channels = self.other_channels(best.logs, best.softness)
        if channels is not None and best.score() > DETECTION.tie * channels.score:
            return channels
        miss, turn = best.measures
        as_is, then = (best.mean(miss, poses) for poses in (best.recorded, best.after))
        turned, left = (best.mean(turn, poses) for poses in (best.recorded, best.after))
        return MovedFrame(best.motion, as_is, then, turned, left, best.score())

    def _widened(self, best: _Tried) -> _Tried:
        """Return the same kind of motion, of more logs in a row as long as this fits better.

        Of two halves that differ the one is moved that agrees less with the robot file.
        """
        count = len(self._pressures)

        def alike(logs: Logs) -> list[_Tried]:
            return [each for each in self._moved(logs) if each.motion.kind == best.motion.kind]

        while len(best.logs) < count // 2:
            begin, end = best.logs[0], best.logs[-1] + 1
            wider = [(begin - 1, *best.logs)] if begin else []
            wider += [(*best.logs, end)] if end < count else []
            found = min((each for logs in wider for each in alike(logs)), key=_Tried.score)
            if found.score() >= best.score():
                break
            best = found
        if 2 * len(best.logs) == count:
            best = min([best, *alike(self._rest(best.logs))], key=lambda each: each.far)
        return best

    def _is_judged(self, tried: _Tried, misses: Array) -> bool:
        """Return True if most of the other logs agree, and an arm fitted to all logs does not.

        Those that do not agree may have a fault of their own.
        """
        rest = self._rest(tried.logs)
        tips = [tried.miss(i) for i in rest]
        agreeing = [
            i for i, tip in zip(rest, tips, strict=True) if tip <= DETECTION.off * self._length
        ]
        if 2 * len(agreeing) <= len(rest):
            return False
        judged = (*tried.logs, *agreeing)
        return _rms(misses[list(judged)]) <= DETECTION.tie * self.score(judged)

    def _has_both(self, tried: _Tried) -> bool:
        """Return True if frame and body were moved, so that each alone would be told wrongly."""
        expected = joined([tried.expected[i] for i in tried.logs])
        recorded = joined([self._recorded[i] for i in tried.logs])
        return are_both_moved(tried.motion, recorded, expected, self._length)

    def _explains(self, tried: _Tried) -> bool:
        """Return True if a motion is the reason why its logs are far off, at different poses."""
        logs = tried.logs
        rows = different_poses(
            np.concatenate([self._pressures[i] for i in logs]), self._setup.description
        )
        if not len(rows):
            return False
        before, after = (
            np.concatenate([self._off(poses[i], tried.expected[i]) for i in logs])
            for poses in (tried.recorded, tried.after)
        )
        _, measure = tried.measures
        turned, then = (tried.mean(measure, poses) for poses in (tried.recorded, tried.after))
        tips = np.concatenate([tried.expected[i][0].position for i in logs])[rows]
        off = DETECTION.off * self._length
        least = float((np.min if in_line(tips) else np.mean)(before[rows]))
        return bool(
            before.mean() > off
            and after.mean() < off
            and after.mean() <= DETECTION.frame * before.mean()
            and after[rows].mean() <= DETECTION.frame * least
            and then <= DETECTION.overwhelming * turned + DETECTION.frame_angle
        )

    # channels ----------------------------------------------------------------------------------

    def other_channels(self, logs: Logs, softness: float = 1.0) -> OtherChannels | None:
        """Return the other channels, or line, that some logs alone are most likely to have.

        `softness` is the factor on pressures. None if the arm does not bear them, or if these
        channels explain little.
        """
        if softness not in self._predicted:
            return None
        as_is = next(each for each in self._unmoved(logs) if each.softness == softness)
        tips = as_is.mean(distances, as_is.recorded)
        best: OtherChannels | None = None
        for hypothesis in self._possible(logs, softness):
            tried = self._driven(hypothesis, logs, softness)
            left = np.inf if tried is None else tried.mean(self._off, tried.recorded)
            if tried is not None and (best is None or left < best.left):
                then = tried.mean(distances, tried.recorded)
                best = OtherChannels(logs, hypothesis, tips, then, left, tried.score())
        return best if best and best.then < DETECTION.overwhelming * best.as_is else None

    def _driven(self, hypothesis: Hypothesis, logs: Logs, softness: float) -> _Tried | None:
        """Return what is left if some logs have other channels; None if the arm breaks by them."""
        low = np.maximum(self._setup.description.pressure_min, 0.0)
        found = self._poses(softness, [hypothesis.driven(self._pressures[i], low) for i in logs])
        if found is None:
            return None
        poses = list(self._predicted[softness])
        for i, each in zip(logs, found, strict=True):
            poses[i] = each
        expected = self._expected(poses, self._rest(logs))
        return self._tried(softness, poses, logs, NOWHERE, expected)

    def _possible(self, logs: Logs, softness: float) -> list[Hypothesis]:
        """Return hypotheses of other channels in some logs.

        Of a heavy arm these are the ones that are best without its weight, which takes far less
        time.
        """
        setup = self._setup
        found = [
            each
            for each in of_channels(setup.description, 1)
            if each.kind not in setup.settings.keep
        ]
        if not any(setup.description.gravity):
            return found
        light = FrameComparer(replace(setup, description=weightless(setup.description)))
        if softness not in light._predicted:
            return found

        def score(hypothesis: Hypothesis) -> float:
            tried = light._driven(hypothesis, logs, softness)
            return np.inf if tried is None else tried.score(logs)

        return sorted(found, key=score)[: DETECTION.shortlist]

    def _odd_one(self) -> _Tried:
        """Return the log without which the others agree best.

        Of two logs it is the one that agrees less with the robot file.
        """
        tried = [each for i in range(len(self._pressures)) for each in self._unmoved((i,))]
        if len(self._pressures) == 2:
            return min(tried, key=lambda each: each.far)
        return min(tried, key=lambda each: each.score(self._rest(each.logs)))

    def _unexplained(self) -> Misfit | None:
        """Return a log that does not fit the others, which agree, even by the arm fitted to all.

        None of two logs, as either may be the odd one. Others that hold a smaller part of the
        workspace are missed by less, so misses are compared as shares of a log's motion.
        """
        if len(self._pressures) < 3:
            return None
        odd, of_all = self._odd_one(), min(self._unmoved(()), key=_Tried.score)
        (i,) = odd.logs
        others = max(odd.share(k) for k in self._rest(odd.logs))
        is_far = of_all.miss(i) > DETECTION.off * self._length
        is_odd = others < DETECTION.frame * of_all.share(i)
        return self.misfit(odd.logs) if is_far and is_odd else None

    def channels_alone(self) -> OtherChannels | None:
        """Return other channels of the log without which the others agree best; None if unclear."""
        best = self._odd_one()
        if best.score(best.logs) <= DETECTION.off * self._length:
            return None
        channels = self.other_channels(best.logs, best.softness)
        if channels is None:
            return None
        misses = best.misses.copy()
        misses[list(best.logs)] = channels.left
        moved = min(each.score(best.logs) for each in self._moved(best.logs))
        if channels.left > DETECTION.tie * moved or not self._is_judged(best, misses):
            return None
        return channels


def _rms(misses: Array) -> float:
    return float(np.sqrt(np.mean(misses**2)))
