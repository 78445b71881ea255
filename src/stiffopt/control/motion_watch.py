"""Checks that the tip moves as the pressures imply; if not, the loop doubts tracker or arm.

The tracker measures the tip at y, the model predicts s, and the reference intends r. Five tests
look for what no push, payload or model error explains:

* response: r has moved, but y has not moved along with s, or has moved elsewhere;
* slip: the estimator's offset d has changed, but the orientation's offset has not turned as
  bending by d turns an arm: by about 3 d / (2 length), or at least two thirds of that; if d has
  changed along the motion of s, the arm is weaker or softer than modelled. A change that has begun
  with such a turn is a push. It may excite higher modes, in which the tip turns otherwise, so the
  test pauses. A tip at rest is judged sooner, by y - s and its own turn, vibration included;
* drift: y - s keeps moving, faster than the model's error can change while s moves;
* swing: y - r oscillates, and does not decay;
* still: the orientation of s turns, but y rests, and its orientation too (`StillWatch`).

A push or a payload moves y - s too, but then it rests. Drift is tested at three time scales, to
distinguish it from creep. The model may be wrong by a share of the motion that each segment causes,
even if segments move the tip in opposite directions. The response test learns this share: an arm
that has followed its model well so far must go on doing so.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import DriftScale, MotionTuning
from stiffopt.control.push_watch import PushWatch
from stiffopt.control.still_watch import StillWatch
from stiffopt.control.tip_errors import missed_turn, turn_of_a_push
from stiffopt.model.description import RobotDescription
from stiffopt.optimise.tip import TipAt

_TIME, _SEEN, _PREDICTED, _INTENDED = 0, slice(1, 4), slice(4, 7), slice(7, 10)  # columns of a row
_OFFSET, _TURN, _TURNED = slice(10, 13), slice(13, 16), slice(16, 19)
_DRIVEN, _FREE, _PRESSURES = 19, 20, slice(21, None)


@dataclass(frozen=True)
class Doubt:
    """A reason not to trust the measured motion.

    Attributes
    ----------
    kind : ``no-response``, ``slip``, ``weak``, ``drift`` or ``swing``.
    text : the likeliest causes and what to do, for people.
    undo : share of the latest motion that a hold should undo.
    is_of_arm : whether only the arm is doubted: the sensor shows where the tip is.
    """

    kind: str
    text: str
    undo: float = 1.0
    is_of_arm: bool = False


class _Miss(NamedTuple):
    """Motion that the model does not explain: beyond a share of 1."""

    share: float  # of the difference between the ways in what is explained; 0 if they fit
    way: float  # length of the model's way, in m
    seen: float  # of the seen one, in m
    error: float  # of the model, as a share of the motion by the segments


def _share_of(miss: _Miss) -> float:
    return miss.share


class MotionWatch:
    """Compares the tip's motion with that of the model and of the reference.

    Parameters
    ----------
    robot :
        The arm.
    tuning :
        Sizes and times of the tests.
    vibrates :
        Whether the arm has inertia.

    Attributes
    ----------
    doubt : the present doubt; it stays until `forgive` or `go_on`.
    pace : share of its speed that the reference may keep; less than 1 before a missing response is
        certain.
    waits : whether a push displaces the tip, so that the reference is to wait on its way to a
        target.
    """

    def __init__(
        self, robot: RobotDescription, tuning: MotionTuning, *, vibrates: bool = True
    ) -> None:
        self._tuning = tuning
        self._min_motion = max(tuning.least_motion, tuning.least_motion_share * robot.length)
        ends = np.cumsum([segment.n_channels for segment in robot.segments]).tolist()
        self._segments = [slice(a, b) for a, b in pairwise([0, *ends])]
        longest = max(scale.interval * scale.count for scale in tuning.scales)
        self._kept = round(longest / tuning.spacing) + 2
        width = _PRESSURES.start + ends[-1]  # of a row; see `_TIME` and the others
        self._rows: Array = np.empty((2 * self._kept, width))
        self._pushes = PushWatch(tuning.pushes, vibrates=vibrates)
        self._still = StillWatch(tuning.still_watch, tuning.scatter)
        self.begin()

    def begin(self) -> None:
        """Restart."""
        self._count = self._misses = 0
        # shares of the turn of a push that are missing in the latest samples, by both tests of it
        self._slips: deque[float] = deque(maxlen=self._tuning.slips)
        self._jumps: deque[float] = deque(maxlen=self._tuning.slips)
        self._bends_until = -math.inf  # end of the pause after a push, in s
        self._waits_until = -math.inf  # end of the latest wait of the reference, in s
        self._known_from = math.inf  # time from which the estimator knows the tip's offset, in s
        self._path = 0.0  # length of the way of r, in m
        self._intended: deque[tuple[float, Array]] = deque(maxlen=self._kept)
        self._swings = [_Swings(self._tuning) for _ in range(3)]
        self._pushes.begin()
        self._still.begin()
        self.doubt: Doubt | None = None
        self.pace, self.waits = 1.0, False
        # motion of the tip by each segment so far, in m; largest error of the model in it, as a
        # share of it; and times, errors and motions (segments,) that do not count yet
        self._unproven: deque[tuple[float, float, Array]] = deque()
        self._forget()

    def go_on(self) -> None:
        """Continue after a pause in which the arm was not controlled, or not seen."""
        self._intended.clear()
        self._unproven.clear()
        self._pushes.begin()
        self._still.begin()
        self._misses = 0
        self._slips.clear()
        self._jumps.clear()
        self.pace, self.waits = 1.0, False
        self._swings = [_Swings(self._tuning) for _ in range(3)]
        self.forgive()

    def forgive(self) -> None:
        """Drop the doubt: somebody has looked at it."""
        if self.doubt is not None:
            self.begin()

    def change_model(self, change: Array) -> None:
        """Adjust past samples to another model, for which the tip's offset changes by (6,)."""
        rows = self._rows[: self._count]
        rows[:, _PREDICTED] -= change[:3]
        rows[:, _OFFSET] += change[:3]
        rows[:, _TURN] += change[3:]
        rows[:, _TURNED] += change[3:]
        self._still.begin()

    def intend(self, now: float, position: Array) -> None:
        """Note the tip position (3,) that the reference intends; in each tick of control."""
        self._intended.append((now, position))

    def take(
        self,
        time: float,
        seen: Array,
        predicted: Array,
        offset: Array,
        pressures: Array,
        tip: TipAt,
        *,
        turned: Array | None,
        swings: tuple[float, float] = (0.0, 0.0),
        deviation: float = 0.0,
        omega: float = 0.0,
        rotations: tuple[Array, Array] | None = None,
    ) -> None:
        """Take in a sample of the tracker.

        Parameters
        ----------
        time :
            Time of capture, in s.
        seen, predicted :
            Position (3,) in the sample and as the model predicts it for that time, in m.
        offset :
            Estimated offset (6,) of the tip's pose from the model's, in m and rad.
        pressures :
            Effective pressures (n,) at that time, in Pa.
        tip :
            The model's tip now.
        turned :
            Rotation vector (3,) from the predicted orientation to that in the sample, in rad; None:
            not measured.
        swings :
            Amplitudes of the vibration that the pressures drive, and of the free one, in m.
        deviation :
            Standard deviation of the offset's position along an axis, in m.
        omega :
            Of the vibration, in rad/s.
        rotations :
            Axes (3, 3) of the tip in the sample, and as the model has them; None: not to be
            compared, as they are not measured, or something holds the tip.
        """
        intended = self._intended_at(time)
        if intended is None or self._is_early(time) or self.doubt is not None:
            return
        if not (np.isfinite(seen).all() and np.isfinite(predicted).all()):
            return
        if self._count == len(self._rows):
            self._rows[: self._kept] = self._rows[-self._kept :]
            self._count = self._kept
        turn = np.zeros(3) if turned is None else turned
        row = (time, *seen, *predicted, *intended, *offset, *turn, *swings, *pressures)
        self._rows[self._count] = row
        self._count += 1
        if self._is_pushed():
            self._forget()
        if self._count > 1:
            self._path += float(np.linalg.norm(intended - self._rows[self._count - 2, _INTENDED]))
        for axis, error in zip(self._swings, (seen - intended).tolist(), strict=True):
            axis.take(_Turn(time, error, self._path))
        jacobian = tip.pose[:3, :3] @ tip.jacobian[:3]
        turning = None if turned is None else tip
        self._pushes.omega = omega
        self.doubt = self._no_response(jacobian, tip.pose[:3, 2], turning)
        if turned is None:
            self._known_from = math.inf
            self._jumps.clear()
        elif 3 * deviation < self._min_motion / 2:  # the least displacement that is a slip
            self._known_from = min(self._known_from, time)
        if self._known_from <= time:
            self.doubt = self.doubt or self._slip(jacobian, tip)
        if turning is not None:
            self.doubt = self.doubt or self._jump(jacobian, turning)
        self.doubt = self.doubt or self._drift(jacobian, turning) or self._swing()
        self.doubt = self.doubt or self._lies_still(time, seen, predicted, tip, rotations)

    def _is_pushed(self) -> bool:
        """Return whether something has just displaced the tip while the reference rested."""
        tuning, now = self._tuning, self._rows[self._count - 1, _OFFSET]
        before = self._since(tuning.push_time)[0, _OFFSET]
        if not math.dist(before.tolist(), now.tolist()) > tuning.push:
            return False
        return self._rests(tuning.slip_window)

    def _rests(self, duration: float) -> bool:
        """Return whether the reference has rested for so many seconds."""
        intended = self._since(duration)[:, _INTENDED]
        return not np.ptp(intended, axis=0).max() > self._tuning.noise

    def _is_early(self, time: float) -> bool:
        last = self._rows[self._count - 1, _TIME] if self._count else -np.inf
        return bool(time < last + self._tuning.spacing)

    def _intended_at(self, time: float) -> Array | None:
        for moment, position in reversed(self._intended):
            if moment <= time:
                return position if time - moment < self._tuning.longest_pause else None
        return None

    def _since(self, duration: float) -> Array:
        """Return the samples (k, 21 + n) of the last so many seconds."""
        rows = self._rows[: self._count]
        times = rows[:, _TIME]
        return rows[times.searchsorted(times[-1] - duration) :]

    def _explained(self, changes: Array, jacobian: Array) -> Array:
        """Return the model errors (k,) to expect over changes between samples, in m.

        `changes` (k, 21 + n) are differences of samples; the Jacobian (3, n) is of the tip's
        position, base axes.
        """
        return self._tuning.model_error * self._by_segments(changes, jacobian).sum(axis=1)

    def _by_segments(self, changes: Array, jacobian: Array) -> Array:
        """Return the lengths (k, segments) by which each segment moves the tip, in m."""
        motions = [
            changes[:, _PRESSURES][:, channels] @ jacobian[:, channels].T
            for channels in self._segments
        ]
        return np.sqrt((np.stack(motions, axis=1) ** 2).sum(axis=2))

    @property
    def _shares(self) -> Array:
        """Permitted errors of the model (segments,), as shares of the motion by each segment."""
        tuning = self._tuning
        learned = min(max(2 * self._error, tuning.least_error), tuning.model_error)
        return np.where(self._verified > self._min_motion, learned, tuning.model_error)

    def _forget(self) -> None:
        """Forget the error of the model: under a load the arm may respond otherwise."""
        self._verified, self._error = np.zeros(len(self._segments)), 0.0
        self._unproven.clear()

    def _learn(self, time: float, error: float, moved: Array) -> None:
        """Take in an error as a share of the motion, and the motion (segments,) since the last one.

        It counts a while later: until then it may turn out to be a fault.
        """
        self._unproven.append((time, error, moved))
        while self._unproven and self._unproven[0][0] < time - self._tuning.proven_after:
            _, error, moved = self._unproven.popleft()
            self._error = max(self._error, error)
            self._verified += moved

    def _no_response(self, jacobian: Array, axis: Array, turning: TipAt | None) -> Doubt | None:
        """Test whether the tip has not moved although the model has, or has moved elsewhere.

        Motion is compared in space, and then without its part along the tip's axis (3,), so that a
        long elongation does not hide a wrong direction across it. After a push in motion it is
        compared again without what the push explains, as the turn shows it. A line that is kinked
        may turn the tip as a push does. So the reference waits until the push is over, and what is
        wrong with the pressures shows in the rest of the motion.
        """
        rows, missed = self._since(self._tuning.response_window), None
        now = float(rows[-1, _TIME])
        self._notice_push(jacobian, turning)
        ways = rows[-1, _PREDICTED] - rows[:-1, _PREDICTED]
        if ((ways**2).sum(axis=1) > self._min_motion**2).any():  # projections are no longer
            across = np.eye(3) - np.outer(axis, axis)
            steps = self._by_segments(np.diff(rows, axis=0), jacobian)
            found = [self._missed(rows, steps, P) for P in (np.eye(3), across)]
            missed = max(found, key=_share_of)
            self._learn(now, found[0].error, steps[-1])
            if turning is not None and self._pushes.acts(now):
                rest = self._without_push(rows, turning)
                left = [self._missed(rest, steps, P) for P in (np.eye(3), across)]
                missed = min(missed, max(left, key=_share_of), key=_share_of)
        share = 0.0 if missed is None else missed.share
        usual = self._tuning.usual_share
        self.pace = min(max((1 - share) / (1 - usual), 0.0), 1.0)
        self.waits = self._is_to_wait(now)
        self._misses = self._misses + 1 if share > 1 else 0
        if missed is None or self._misses < self._tuning.misses:
            return None
        most, moved = 1e3 * missed.way, 1e3 * missed.seen
        text = f"the tip should have moved by {most:.1f} mm and was seen to move by {moved:.1f} mm"
        if moved < most / 2:
            return Doubt(
                "no-response",
                f"{text}: its sensor has come off, the tracker is late, the arm is blocked, or it "
                "does not get its pressures; look at the sensor and the tubes",
                undo=0.0,  # it has probably moved as intended
            )
        return Doubt(
            "no-response",
            f"{text} in another direction: channels are swapped, one does not get its pressure, "
            "the tracker's frame is turned, the sensor has slipped, or something pushes the arm; "
            "run 'stiffopt commission'",
        )

    def _is_to_wait(self, now: float) -> bool:
        """Return whether the reference is to wait, so that no fault hides behind a push.

        An arm that is pushed again and again goes on for half of the time at least.
        """
        if not self._pushes.acts(now):
            return False
        longest = self._tuning.longest_wait
        if now >= self._waits_until + longest:
            self._waits_until = now + longest
        return now < self._waits_until

    def _notice_push(self, jacobian: Array, turning: TipAt | None) -> None:
        """Look for a push that begins or ends while the pressures change."""
        if turning is None:
            return
        acting = self._tuning.pushes.acting
        rows = self._since(acting)
        unseen = rows[0, _TIME] - (rows[-1, _TIME] - acting)
        if len(rows) < self._count and unseen > self._tuning.longest_pause:
            return  # pressures may have changed in a pause
        seen, turned = rows[:, _SEEN], rows[:, _TURNED]
        away, pressures = seen - rows[:, _PREDICTED], rows[:, _PRESSURES]
        swings, times = rows[:, _FREE], rows[:, _TIME]
        acted = self._pushes.acts(float(times[-1]))
        if self._pushes.take(times, seen, away, turned, pressures, swings, jacobian, turning):
            self._forget()
            if not acted:  # the arm swings anew
                self._swings = [_Swings(self._tuning) for _ in range(3)]

    def _without_push(self, rows: Array, turning: TipAt) -> Array:
        """Return samples (k, 21 + n) without the displacement by a push, as the turn shows it."""
        rest = rows.copy()
        away = rows[:, _SEEN] - rows[:, _PREDICTED]
        rest[:, _SEEN] += self._pushes.displacements(away, rows[:, _TURNED], turning)
        return rest

    def _missed(self, rows: Array, by_segments: Array, P: Array) -> _Miss:
        """Return where the model's way and the seen one, projected by P (3, 3), fit least.

        `by_segments` (k - 1, segments) is how far each segment moves the tip between samples, in m.
        """
        tuning = self._tuning
        ways = rows[-1] - rows[:-1]
        way, seen = ways[:, _PREDICTED] @ P, ways[:, _SEEN] @ P
        distance = np.sqrt((way**2).sum(axis=1))
        along = (seen * way).sum(axis=1) / np.maximum(distance, 1e-9)
        aside = np.sqrt(np.maximum((seen**2).sum(axis=1) - along**2, 0.0))
        short = np.maximum(distance - along, 0.0)  # a softer arm moves farther
        meant = (ways[:, _INTENDED] @ P * way).sum(axis=1) > distance**2 / 2
        # summed along the way, on which segments may have moved the tip in opposite directions
        moved = np.cumsum(by_segments[::-1], axis=0)[::-1]
        motion, own = moved.sum(axis=1), moved @ self._shares
        most = tuning.most_error * own / np.maximum(tuning.model_error * motion, 1e-9)
        far = meant & (distance > self._min_motion)
        if not far.any():
            return _Miss(0.0, 0.0, 0.0, 0.0)
        off = np.sqrt(((seen - way) ** 2).sum(axis=1))
        steps = np.diff(rows, axis=0)
        speeds = np.sqrt(((steps[:, _PREDICTED] @ P) ** 2).sum(axis=1)) / steps[:, _TIME]
        late = tuning.late * (speeds + speeds[-1])  # error by a delay of y, in m
        driven = rows[:-1, _DRIVEN] + rows[-1, _DRIVEN]
        other = tuning.swing_error * driven + rows[:-1, _FREE] + 6 * tuning.scatter
        # an arm that is late will be so again: its delay is a part of the error that is learned
        error = float(((off - other)[far] / np.maximum(motion, distance)[far]).max())
        suspects = np.flatnonzero(far & (aside**2 + short**2 > (most * distance) ** 2))
        if not len(suspects):
            return _Miss(0.0, 0.0, 0.0, error)
        length, model = ((ways[suspects, part] ** 2).sum(axis=1) for part in (_SEEN, _PREDICTED))
        own = own[suspects]
        own[length < tuning.still**2 * model] = 0.0  # a wrong model would move it somewhere
        explained = own + (late + other)[suspects] + tuning.noise
        worst = int(np.argmax(off[suspects] / explained))
        first = suspects[worst]
        share = float(off[first] / explained[worst])
        return _Miss(share, float(distance[first]), float(np.linalg.norm(seen[first])), error)

    def _slip(self, jacobian: Array, tip: TipAt) -> Doubt | None:
        """Test whether the offset has changed as no force, wherever it acts, changes it.

        In the first samples the estimator cannot tell an offset from a vibration; both change then.
        """
        tuning, known = self._tuning, float(self._rows[self._count - 1, _TIME]) - self._known_from
        rows = self._since(min(tuning.slip_window, known))
        way = rows[-1] - rows[0]
        moved, turned = way[_OFFSET], way[_TURN]
        least = self._min_motion / 2
        distance, wrong = float(np.linalg.norm(moved)), False
        if distance > least + 6 * tuning.scatter:
            own = float(self._explained(np.diff(rows, axis=0), jacobian).sum())
            rests = float(np.linalg.norm(way[_INTENDED])) < least  # then the offset moves the arm
            explained = math.hypot(least, own) if rests else least + own
            # a push displaces the arm farther at first
            explained += min(float(rows[-1, _FREE]), least / 2)
            wrong = distance > explained + 6 * tuning.scatter
        if wrong:
            bent = turn_of_a_push(tip) @ moved
            missing, size = self._missed_turn(bent, turned), float(np.linalg.norm(bent))
            least_turn = math.hypot(tuning.least_turn, size * own / distance)
            now = float(rows[-1, _TIME])
            if not self._slips and missing < tuning.bends * size and size > least_turn:
                self._bends_until = now + tuning.slip_window
            wrong = missing > max(tuning.slip * size, least_turn) and now > self._bends_until
            wrong = wrong and not self._turns_as_pushed(rows, tip, distance)
        if not wrong:
            self._slips.clear()
            return None
        self._slips.append(missing / size)
        if not self._lasts(self._slips):
            return None
        if share := self._share(moved, way[_PREDICTED]):
            return Doubt(
                "weak",
                f"the tip moves {1 + share:.2f} times as far as modelled: the modulus in the robot "
                f"file is too {'high' if share > 0 else 'low'}, the chambers do not get the "
                "pressures that the gauges read, or channels are swapped; run 'stiffopt "
                "commission'",
                is_of_arm=True,
            )
        return self._slipped(distance)

    def _turns_as_pushed(self, rows: Array, tip: TipAt, distance: float) -> bool:
        """Return whether some push by a distance, in m, or more is measured in samples (k, 21 + n).

        The estimated turn follows a push later than the estimated displacement if the arm is just
        becoming stiff.
        """
        ways, turn = rows[-1] - rows, turn_of_a_push(tip)
        moved = ways[:, _SEEN] - ways[:, _PREDICTED]
        far = np.flatnonzero((moved**2).sum(axis=1) > distance**2)
        most = self._tuning.slip_of_large
        return any(
            self._missed_turn(bent, turned) < most * float(np.linalg.norm(bent))
            for bent, turned in zip(moved[far] @ turn.T, ways[far, _TURNED], strict=True)
        )

    def _lasts(self, missing: deque[float]) -> bool:
        """Return True if enough successive samples lacked the rotation that a push causes.

        `missing` has the lacking share for each sample, which may hardly fall among them.
        """
        tuning = self._tuning
        return len(missing) == tuning.slips and missing[0] - missing[-1] <= tuning.catches_up

    def _jump(self, jacobian: Array, tip: TipAt) -> Doubt | None:
        """Test whether the tip, at rest until now, moves without the turn of a push.

        The vibration that a push excites turns the tip as the push does. So what is measured is
        compared, and no estimate must separate the two. As the tip swings on, higher modes and
        large turns make it differ.
        """
        tuning, rows = self._tuning, self._since(self._tuning.jump_window)
        ways, least = rows[-1] - rows, self._min_motion / 2 + 6 * tuning.scatter
        moved = ways[:, _SEEN] - ways[:, _PREDICTED]
        distances = np.sqrt((moved**2).sum(axis=1))
        worst = int(np.argmax(distances))
        distance, wrong = float(distances[worst]), False
        if distance > least and rows[worst, _FREE] < least / 2 and self._rests(tuning.jump_window):
            own = float(self._explained(np.diff(rows[worst:], axis=0), jacobian).sum())
            bent = turn_of_a_push(tip, along_stiff_axis=True) @ moved[worst]
            missing = self._missed_turn(bent, ways[worst, _TURNED])
            size, least_turn = float(np.linalg.norm(bent)), tuning.least_turn
            most = max(tuning.slip, own / distance) * size
            wrong = size > least_turn and missing > max(most, least_turn)
        if not wrong:
            self._jumps.clear()
            return None
        self._jumps.append(missing / size)
        return self._slipped(distance) if self._lasts(self._jumps) else None

    @staticmethod
    def _slipped(distance: float) -> Doubt:
        return Doubt(
            "slip",
            f"the tip seems to have been displaced by {1e3 * distance:.1f} mm without being "
            "turned, which no push or payload does: the sensor has slipped, tracker or base have "
            "been moved, or, after a motion, a line is kinked or the tracker late; run "
            "'stiffopt commission'",
        )

    def _missed_turn(self, bent: Array, turned: Array) -> float:
        return missed_turn(bent, turned, self._tuning.further)

    def _share(self, moved: Array, way: Array) -> float:
        """Return the change of the offset (3,) as a share of the model's way (3,).

        0 if it is not mostly along that way, or too large for an error of the model: feedback that
        makes up for a slip moves s by as much.
        """
        tuning, share = self._tuning, float(moved @ way) / max(float(way @ way), 1e-12)
        aside = float(np.linalg.norm(moved - share * way))
        is_along = aside < tuning.aside * float(np.linalg.norm(moved))
        return share if is_along and abs(share) < tuning.largest_error else 0.0

    def _lies_still(
        self,
        time: float,
        seen: Array,
        predicted: Array,
        tip: TipAt,
        rotations: tuple[Array, Array] | None,
    ) -> Doubt | None:
        """Test whether the pressures turn the tip, but neither motion nor turn is seen."""
        if rotations is None:
            self._still.begin()
            return None
        turn = self._still.take(time, seen, rotations[0], predicted, rotations[1], tip)
        if not turn:
            return None
        return Doubt(
            "no-response",
            f"the tip should have turned by {math.degrees(turn):.1f} degrees or more and is seen "
            "to lie still: its sensor has come off, the tracker repeats an old pose, or something "
            "holds the tip; look at the sensor",
            undo=0.0,  # it has probably moved as intended
        )

    def _drift(self, jacobian: Array, turning: TipAt | None) -> Doubt | None:
        """Test whether the tip keeps moving without a cause in the pressures.

        `turning` is the model's tip; None if the tracker measures no orientations.
        """
        for scale in self._tuning.scales:
            if speed := self._drift_speed(scale, jacobian, turning):
                return Doubt(
                    "drift",
                    f"the tip seems to move on at {1e3 * speed:.1f} mm/s although its pressures do "
                    "not explain it: the sensor slips or has come off, the tracker drifts, "
                    "something pushes the arm, or, after a motion, a line is kinked; look at it, "
                    "then set the task again",
                )
        return None

    def _drift_speed(self, scale: DriftScale, jacobian: Array, turning: TipAt | None) -> float:
        """Return the speed of a drift over all intervals of a scale, in m/s; 0 if there is none."""
        duration = scale.interval * scale.count
        first = self._rows[0, _TIME] if self._count else np.inf
        if self._rows[self._count - 1, _TIME] - duration < first:
            return 0.0
        rows = self._since(duration)
        whole = rows[-1] - rows[0]
        drift = whole[_SEEN] - whole[_PREDICTED]
        size = math.hypot(*drift.tolist())
        least = scale.least_speed * scale.interval + 2 * self._tuning.scatter
        if size < scale.count * least:  # the sum of the parts along it
            return 0.0
        ends = rows[-1, _TIME] - scale.interval * np.arange(scale.count, -1, -1)
        marks = rows[np.minimum(rows[:, _TIME].searchsorted(ends), len(rows) - 1)]
        offsets = marks[:, _SEEN] - marks[:, _PREDICTED]
        along = np.diff(offsets, axis=0) @ drift / max(size, 1e-9)
        explained = self._explained(np.diff(marks, axis=0), jacobian)
        if (along - explained < least).any() or self._is_push(marks[-1] - marks[0], turning):
            return 0.0
        return size / duration

    def _is_push(self, change: Array, turning: TipAt | None) -> bool:
        """Return whether a growing push explains the change: it turns the tip too.

        A tracker's frame that turns about the base does so as well, by somewhat less, so the turn
        by a large push must be about that which is expected. While an arm swings as slowly as it
        would drift, the estimate takes a push for a part of the swing, so what is measured counts
        too.
        """
        if turning is None:
            return False
        tuning, turn = self._tuning, turn_of_a_push(turning)
        measured = change[_SEEN] - change[_PREDICTED]
        for moved, turned in ((change[_OFFSET], change[_TURN]), (measured, change[_TURNED])):
            bent = turn @ moved
            size, missing = float(np.linalg.norm(bent)), self._missed_turn(bent, turned)
            is_large = float(np.linalg.norm(moved)) > tuning.largest_push
            share = tuning.slip_of_large if is_large else tuning.slip
            if size > tuning.least_turn and missing < share * size:
                return True
        return False

    def _swing(self) -> Doubt | None:
        for swings in self._swings:
            if size := swings.lasting():
                return Doubt(
                    "swing",
                    f"the tip swings by {1e3 * size:.1f} mm and does not come to rest: the tracker "
                    "is later than the rig file says, something shakes the arm or the sensor, or "
                    "the model's frequency is far off; run 'stiffopt commission'",
                )
        return None


class _Turn(NamedTuple):
    """A turning point: its time, in s, y - r of one axis, and the way of r until then, in m."""

    time: float
    error: float
    path: float


class _Swings:
    """Finds turning points of y - r along one axis, and swings that last."""

    def __init__(self, tuning: MotionTuning) -> None:
        self._tuning = tuning
        self._turns: deque[_Turn] = deque(maxlen=tuning.swings + 1)
        self._extreme = _Turn(-np.inf, 0.0, 0.0)
        self._rising = True

    def take(self, now: _Turn) -> None:
        """Take in the next value."""
        beyond = now.error - self._extreme.error
        if (beyond > 0) is self._rising:
            self._extreme = now
        elif abs(beyond) > self._tuning.turn + 6 * self._tuning.scatter:
            self._turns.append(self._extreme)
            self._extreme, self._rising = now, not self._rising

    def lasting(self) -> float:
        """Return the size of swings that do not decay, in m; 0 if there are none."""
        tuning, turns = self._tuning, self._turns
        if len(turns) <= tuning.swings or turns[-1].time - turns[0].time > tuning.swing_window:
            return 0.0
        sizes = [
            abs(after.error - before.error) - tuning.model_error * (after.path - before.path)
            for before, after in pairwise(turns)
        ]
        if min(sizes) < tuning.least_swing + 6 * tuning.scatter or sizes[-1] < tuning.decay * max(
            sizes
        ):
            return 0.0
        return sizes[-1]
