"""`Bracing`: a brace under way. The arm goes to rest, leans on objects, holds, and lets go.

`stiffopt.paths.leaning` plans the approach. From rest, all pressures grow together at its pace, so
that the arm comes into contact slowly and at the planned equilibrium. The same way back releases
the contacts.

While the brace is held, the tracker measures the tip at y and the braced model predicts s. The slow
part of y - s is the error b of the model and creep. The rest is the effect of a push F at the tip;
its most likely value is taken. With the compliance C of the braced tip and the deviations
sigma of y - s - b and f of pushes,

    F = C (C C + (sigma / f)^2)^-1 (y - s - b).

The tip goes along an arc, so sigma grows with the square of what it is moved by.

With the model's normal forces N0 before the push, and their derivatives G by it, those under the
push are N = N0 + G F. What is wrong with N0, F and the model's response has the deviation s. Part
of s is the force that a push may have taken away which moves the tip as y - s has changed since the
arm settled, but for F. Nobody knows how much of that is creep. Then

- the contacts are *held* while N > 2 s, or while no push is felt and b has not drifted. A force
  that is badly known at rest is stated with its deviation, and is no reason to let go;
- they are *uncertain* otherwise, or if contacts that are to stick would slide under the push. This
  is reported, and the arm goes on holding;
- a contact is *lost* if N < -2 s under a push that is felt, with s without that part. It also is if
  the tip shows that it slides (`SlideEstimator`) or is where a free arm has it, or after a minute
  of uncertainty. Then the arm lets go.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.brace_concerns import SLIPS, UNCERTAIN, Concern, Concerns
from stiffopt.control.brace_correction import BraceCorrection
from stiffopt.control.brace_push import BracePushEstimator
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.friction import Friction
from stiffopt.control.interface import Notice
from stiffopt.control.sliding import SlideEstimator
from stiffopt.control.state import HeldContact, Severity
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.leaning import BraceApproach


class BracePhase(StrEnum):
    """The phase of a brace."""

    PLANNING = "planning"
    TO_REST = "going to rest"
    APPROACHING = "approaching"
    HELD = "held"
    RELEASING = "releasing"
    RELEASED = "released"


class _Parts(NamedTuple):
    """The planned approach of a brace, and the parts that are made from it."""

    approach: BraceApproach
    friction: Friction
    pushes: BracePushEstimator
    correction: BraceCorrection


class Bracing:
    """A brace under way: its pressures over time, and whether the contacts hold.

    Parameters
    ----------
    task : the task with the brace.
    tuning : times and limits.

    Attributes
    ----------
    phase : the present phase.
    is_steered : whether the pressures follow this course; if not, they are held or let down.
    is_let_down : whether the pressures have been let down, so that nothing is known of contacts.
    next : task to pursue after the release; None: the arm stays at rest.
    force : normal force of the least certain contact, as estimated, in N; NaN without contact.
    deviation : standard deviation of that force, in N.
    margin : further push at the tip that would break a contact, in N; NaN while nothing pushes.
    push : estimated push at the tip (3,), base axes, in N; zero while none is felt.
    displacement : of the tip by the push (3,), in m.
    covariance : of the push (3, 3), in N^2.
    """

    def __init__(self, task: Task, tuning: BracingTuning) -> None:
        self.task, self._tuning = task, tuning
        self.phase, self.is_steered, self.is_let_down = BracePhase.PLANNING, True, False
        self.next: Task | None = None
        self.force = self.deviation = self.margin = math.nan
        self.push, self.displacement = np.zeros(3), np.zeros(3)
        self.covariance: Array = tuning.usual_push**2 * np.eye(3)
        self._error: Array | None = None  # b (3,)
        self._settled: Array = np.zeros(3)  # y - s when the arm had settled
        self._residual: Array = np.zeros(3)  # y - s, smoothed over vibrations
        self._held = self._pushed = 0.0  # durations, in s
        self._parts: _Parts | None = None  # once the approach is planned
        self._slides: SlideEstimator | None = None
        self._slid = 0  # successive samples at which a contact has slid
        self._start: Array = np.zeros(0)  # pressures (n,) from which the arm goes to rest
        self._left = 1.0  # share of `_start` that is left
        self._time = 0.0  # along the approach, in s
        self._pace = 0.0  # of that time, from 0 to 1
        self._waited = 0.0  # at its end, in s
        self._free = 0  # successive samples at which the tip is nearer to a free arm's
        self._concerns = Concerns(tuning)
        self._estimated: Array = np.zeros((0, 2))  # forces of contacts and their deviations (k, 2)
        self._lost: frozenset[int] = frozenset()  # contacts
        self._why = ""
        self._notices: list[Notice] = []

    def at(self, now: float) -> Target:
        """Return the target, which is constant."""
        return self.task.target

    @property
    def approach(self) -> BraceApproach | None:
        """The way into contact; None until it is planned."""
        return None if self._parts is None else self._parts.approach

    @property
    def _planned(self) -> _Parts:
        """The approach and its parts; there must be a planned approach."""
        assert self._parts is not None
        return self._parts

    @property
    def leans(self) -> bool:
        """Whether the arm is in contact, approaches it, or lets go."""
        return self.phase in (BracePhase.APPROACHING, BracePhase.HELD, BracePhase.RELEASING)

    @property
    def contacts(self) -> str:
        """State of the contacts: `held`, `uncertain` or `lost`; empty if the arm does not lean."""
        if self.phase is BracePhase.HELD and not self.is_let_down:
            return "uncertain" if self._concerns.doubt else "held"
        return "lost" if self._why else ""

    @property
    def held(self) -> tuple[HeldContact, ...]:
        """The contacts while the brace is held; after a loss, those that were lost."""
        if self.approach is None or not self.contacts:
            return ()
        doubted, found = self._concerns.uncertain, []
        for number, each in enumerate(self.approach.contacts):
            if self.phase is BracePhase.HELD:
                state = "uncertain" if number in doubted else "held"
                force, deviation = self._estimated[number].tolist()
                found.append(HeldContact(each.object, each.at, state, force, deviation))
            elif number in self._lost:
                found.append(HeldContact(each.object, each.at, "lost"))
        return tuple(found)

    @property
    def pressures(self) -> Array:
        """Effective pressures (n,) now, in Pa."""
        if self._parts is None or self.phase is BracePhase.TO_REST:
            return self._left * self._start
        approach, rows = self._parts.approach, self._parts.approach.pressures
        on_way = np.array([np.interp(self._time, approach.times, row) for row in rows.T])
        share = min(self._time / approach.reached, 1.0)
        return on_way + share * self._parts.correction.change

    def begin(self, approach: BraceApproach, pressures: Array) -> None:
        """Go from pressures (n,) to rest, then along the approach."""
        friction = Friction(approach.hold, approach.pressures[-1])
        stuck = friction if self._sticks else None
        pushes = BracePushEstimator(self.task, approach, stuck, self._tuning)
        correction = BraceCorrection(approach.hold, stuck, len(pressures), self._tuning)
        self._parts, self._start = _Parts(approach, friction, pushes, correction), pressures
        self._left = float(bool(np.abs(pressures).max() > self._tuning.at_rest))
        self._estimated = np.full((len(approach.contacts), 2), np.nan)
        self.phase = BracePhase.TO_REST

    def follow(self, is_steered: bool, pressures: Array) -> None:
        """Take in, at a tick, whether the effective pressures (n,), in Pa, follow this course."""
        self.is_steered, self.is_let_down = is_steered, False
        if not is_steered and self.approach is not None:
            off = float(np.abs(pressures - self.pressures).max())
            self.is_let_down = off > self._tuning.let_down
        if self.is_let_down:
            self._concerns.clear()
            self._estimated[:] = self.force = self.deviation = self.margin = math.nan
            self.push = self.displacement = np.zeros(3)

    def release(self, then: Task | None = None, why: str = "", lost: Iterable[int] = ()) -> None:
        """Release the contacts, then pursue the task `then`.

        `why` is the reason for a failure, and `lost` are the contacts that were lost.
        """
        self.next = then or self.next
        if self.phase in (BracePhase.APPROACHING, BracePhase.HELD):
            self.phase, self._why, self._pace = BracePhase.RELEASING, why, 0.0
            if self.approach is not None:
                self._time = self.approach.time_back(self._time)
            self._lost = frozenset(lost)
            self.force = self.deviation = self.margin = math.nan
            self.push = self.displacement = np.zeros(3)
            text = "goes back on the way that it came"
            if why:
                text = f"{why}; the arm {text}, and stays at rest until there is a new task"
                self._notify("brace-lost", text, Severity.ERROR)
            else:
                self._notify("release", f"the arm lets go: it {text}")
        elif self.phase is not BracePhase.RELEASING:
            self.phase = BracePhase.RELEASED

    def advance(self, elapsed: float, is_there: bool) -> None:
        """Advance by a tick, in s; `is_there`: whether the reference has reached `pressures`."""
        t, approach = self._tuning, self.approach
        if approach is None:
            return
        if self.phase is BracePhase.TO_REST:
            self._left = max(0.0, self._left - elapsed / t.to_rest)
            if not self._left and is_there:
                self.phase = BracePhase.APPROACHING
        elif self.phase is BracePhase.APPROACHING:
            left = float(approach.times[-1]) - self._time
            self._time = float(approach.times[-1]) - max(0.0, left - self._moved(elapsed, left))
            done = is_there and self._time >= approach.times[-1]
            self._waited = self._waited + elapsed if done else 0.0
            if self._waited >= t.settle:
                self.phase = BracePhase.HELD
                self._notify("braced", self._words(approach))
        elif self.phase is BracePhase.RELEASING:
            self._time = max(0.0, self._time - self._moved(elapsed, self._time))
            if not self._time and is_there:
                self.phase = BracePhase.RELEASED

    def _moved(self, elapsed: float, left: float) -> float:
        """Return how far the way goes on in a tick, in s, of the time that is left.

        It begins and ends gradually, so that the arm does not swing into contact.
        """
        t = self._tuning
        slowing = math.sqrt(2 * max(left, 0.0) / t.gradual) + t.least_pace
        self._pace = min(self._pace + elapsed / t.gradual, slowing, 1.0)
        return elapsed * self._pace

    def _words(self, approach: BraceApproach) -> str:
        where = [
            f"'{each.object}' at {1e3 * each.at:.0f} mm with "
            f"{1e3 * float(np.linalg.norm(each.force)):.0f} mN"
            for each in approach.contacts
        ]
        return f"the arm leans on {' and '.join(where)}"

    def look(
        self,
        elapsed: float,
        seen: Array,
        tip: TipAt,
        pressures: Array,
        quaternion: Array | None = None,
    ) -> None:
        """Check at a sample of the tracker whether the contacts hold.

        If the tip is nearer to its place on a free arm, the contact is lost, whatever pushes it.
        Numbers that are not finite do not count.

        Parameters
        ----------
        elapsed : time since the last sample, in s.
        seen : measured position (3,) of the tip, in m.
        tip : model of the braced tip at the present pressures.
        pressures : effective pressures (n,), in Pa.
        quaternion : measured orientation (4,) of the tip, w first; None if it is not measured.
        """
        if not np.isfinite(seen).all() or not self._is_on_way(pressures):
            return
        if quaternion is not None and not np.isfinite(quaternion).all():
            quaternion = None
        self._residual = self._smoothed(elapsed, seen - tip.pose[:3, 3], pressures)
        if self._is_free(tip.pose[:3, 3]):
            self._let_go_astray(seen, tip.pose[:3, 3])
        elif self.phase is BracePhase.HELD:
            self._judge_held(elapsed, seen, tip, pressures, quaternion)

    def _is_on_way(self, pressures: Array) -> bool:
        """Return whether the arm leans, or comes to lean, with pressures (n,) near the way's."""
        if self.phase not in (BracePhase.APPROACHING, BracePhase.HELD) or self.is_let_down:
            return False
        return not float(np.abs(pressures - self.pressures).max()) > self._tuning.off_plan

    def _smoothed(self, elapsed: float, residual: Array, pressures: Array) -> Array:
        """Return y - s (3,) without what friction explains, smoothed over vibrations.

        See `look` for the other arguments; the first sample of a held brace stands as it is.
        """
        t, friction = self._tuning, self._planned.friction
        if self.phase is BracePhase.HELD:  # the plan has followed friction to there
            creep = t.creep * elapsed / (t.creep_time + self._held)
            friction.follow(pressures, min(elapsed / t.even_time, 1.0), creep)
            if self._sticks:
                residual = residual - friction.tip[:3] @ friction.forces
        if self._error is None:
            return residual
        return self._residual + min(elapsed / t.swing_time, 1.0) * (residual - self._residual)

    def _is_free(self, planned: Array) -> bool:
        """Return whether the tip has been nearer to a free arm's than to the planned one (3,)."""
        t = self._tuning
        to_free = self._free_tip() - planned
        distance = float(np.linalg.norm(to_free))
        share = float(self._residual @ to_free) / max(distance, 1e-9) ** 2
        enough = t.min_distance if self.phase is BracePhase.HELD else t.min_on_way
        is_free = distance > enough and share > t.free_share
        self._free = self._free + 1 if is_free else 0
        return self._free >= t.samples

    def _judge_held(
        self,
        elapsed: float,
        seen: Array,
        tip: TipAt,
        pressures: Array,
        quaternion: Array | None,
    ) -> None:
        """Take in what a sample tells of the model's error and of a push; judge the contacts.

        See `look` for the arguments.
        """
        t, residual = self._tuning, self._residual
        _, friction, pushes, correction = self._planned
        if self._error is None:
            self._error = residual
        raw, settles = residual - self._error, self._held < self._settling
        off = raw + correction.withheld(raw)
        correction.forget(elapsed)
        self._held += elapsed
        before = friction.normals(pressures) if self._sticks else friction.sliding(pressures)
        if not settles and self._has_slid(elapsed, seen, quaternion, pressures):
            return
        push, covariance = pushes.likely(tip, off)
        feels = not settles and pushes.feels(off, push, before)
        if settles:
            self._settled = residual
        # a push that lasts becomes part of b, and one that is not felt may be taken for a
        # correction that friction withholds; so all that the tip has moved since it settled, but
        # for what is felt, may be a push
        change = residual - self._settled - float(feels) * off
        drift = pushes.lost(tip, change, self._creep(tip, pressures))
        if not feels or (self._pushed > t.longest_push and not self._concerns.doubt):
            time = t.settling_time if settles else t.error_time
            self._error = self._error + min(elapsed / time, 1.0) * raw
            self._pushed = self._pushed * float(feels)
            self.push = self.displacement = np.zeros(3)
            self._rest(before, drift, elapsed)
            return
        self._pushed += elapsed
        if self._sticks and not self._concerns.doubt:  # what stays is creep in the end
            self._error = self._error + min(elapsed / t.push_creeps, 1.0) * raw
        self.push, self.displacement = push, off
        self.covariance[:] = covariance
        self._judge(before, drift, elapsed)

    def _creep(self, tip: TipAt, pressures: Array) -> float:
        """Return the deviation of the creep since the arm settled, in m.

        It is what the tip would move if the pressures (n,) grew. Where friction holds the body,
        creep may move the tip in any direction.
        """
        t, began = self._tuning, self._tuning.creep_time + self._settling
        folds = math.log(max((t.creep_time + self._held) / began, 1.0))
        return t.unknown_creep * folds * float(np.linalg.norm(tip.jacobian[:3] @ pressures))

    def _let_go_astray(self, seen: Array, planned: Array) -> None:
        """Release contacts with a tip (3,) that is not where the plan has it (3,).

        Where it is not at a free arm's place either, the arm still touches something.
        """
        t, contacts, free = self._tuning, self._planned.approach.contacts, self._free_tip()
        off, from_free, apart = (
            float(np.linalg.norm(each)) for each in (seen - planned, seen - free, free - planned)
        )
        if from_free <= max((1 - t.free_share) * apart, t.min_distance):
            held = self.phase is BracePhase.HELD
            lost = "the brace is lost" if held else "there is nothing where the scene has an object"
            where = "the tip is where an arm without contact has it"
            self.release(why=f"{where}: {lost}", lost=range(len(contacts)))
            return
        why = (
            f"the tip is {1e3 * off:.0f} mm from where the plan put it, and {1e3 * from_free:.0f} "
            "mm from where an arm without contact has it"
        )
        rough = {contacts[j].object for j in self._planned.approach.hold.sticking.own}
        names = " and ".join(f"'{each}'" for each in sorted(rough or {c.object for c in contacts}))
        if rough:
            why += f"; friction on {names} probably holds the body: give it a larger friction"
        else:
            why += f": check the place of {names}, and give it its friction if it has any"
        self.release(why=f"{why}, and solve again")

    def _has_slid(
        self, elapsed: float, seen: Array, quaternion: Array | None, pressures: Array
    ) -> bool:
        """Return whether place and turn of the tip tell that a contact has slid; then let go.

        Only contacts that are to stick count. See `look` for the arguments.
        """
        t, approach = self._tuning.sliding, self._planned.approach
        if not (self._sticks and approach.hold.sticking.own):
            return False
        if self._slides is None:
            usual = self._planned.pushes.usual(approach.tips[-1].pose[:3, :3])
            self._slides = SlideEstimator(approach, self._planned.friction, usual, t)
        self._slides.take(elapsed, self._held, seen, quaternion, pressures)
        sizes = np.linalg.norm(self._slides.slides, axis=1)
        slid = (sizes > t.told) & (self._slides.deviations() > t.surely)
        self._slid = self._slid + 1 if slid.any() else 0
        if self._slid < t.samples:
            return False
        most, own = int(np.where(slid, sizes, 0.0).argmax()), approach.hold.sticking.own
        why = f"{self._named(own[most])} has slid by {1e3 * sizes[most]:.1f} mm"
        self.release(why=why, lost=[own[int(i)] for i in np.flatnonzero(slid)])
        return True

    @property
    def _settling(self) -> float:
        """Time in which the tip goes to its target, and friction is relieved, in s."""
        t = self._tuning
        return t.settling + (t.relief if self._sticks else 0.0)

    @property
    def _sticks(self) -> bool:
        """True if a contact that slips counts as lost."""
        return self.task.brace is not None and self.task.brace.contacts == "sticking"

    def _free_tip(self) -> Array:
        """Return the position (3,) of the tip of a free arm at the present place of the way."""
        approach = self._planned.approach
        times, rows = approach.times, approach.free_tips
        return np.array([np.interp(self._time, times, row) for row in rows.T])

    def _rest_deviations(self, before: Array) -> Array:
        """Return the standard deviations (k,) of normal forces without a push, in N.

        `before`: these forces (k,). A robot that is not calibrated has none of its own.
        """
        least, own = self._tuning.least_deviation * before, self._planned.approach.hold.deviations
        return np.maximum(own, least)

    def _deviations(self, before: Array, change: Array) -> Array:
        """Return the standard deviations (k,) of the normal forces under the push, in N.

        They come from the forces without it, from the push, which the tip hardly shows where it is
        stiff, and from the response of the model. `before`: forces (k,) without the push; `change`:
        by it (k,).
        """
        G, response = self._planned.pushes.per_push, self._tuning.response * change
        pushed = np.einsum("ki,ij,kj->k", G, self.covariance, G)
        return np.sqrt(self._rest_deviations(before) ** 2 + pushed + response**2)

    def _rest(self, before: Array, drift: Array, elapsed: float) -> None:
        """Judge whether the contacts hold while no push is felt; see `_judge`."""
        t = self._tuning
        own = self._rest_deviations(before)
        left = self._estimate(before, np.hypot(own, drift))
        self.margin, found = math.nan, {}
        for each in map(int, np.flatnonzero((left < 0) & (drift > t.felt_share * before))):
            text = self._lifted(each, float(before[each] + t.certain * own[each]))
            why = "since the tip has moved away as by a slow push"
            found[Concern(UNCERTAIN, each, "drift")] = f"{text}, {why}"
        self._weigh(found, elapsed)

    def _judge(self, before: Array, drift: Array, elapsed: float) -> None:
        """Judge whether the contacts hold the estimated push.

        `before`: normal forces (k,) without it; `drift`: what they may have lost (k,).
        """
        t, size = self._tuning, float(np.linalg.norm(self.push))
        change = self._planned.pushes.per_push @ self.push
        forces, own = before + change, self._deviations(before, change)
        most, least = forces + t.certain * own, self._estimate(forces, np.hypot(own, drift))
        falls = change < 0
        left = size * float(np.min(before[falls] / -change[falls], initial=math.inf))
        if self._sticks:
            left = min(left, self._planned.friction.left(self.push / size, before))
        self.margin = max(left - size, 0.0)
        words = f"under a push of {1e3 * size:.0f} mN"
        if (most < 0).any():
            lifted = self._named(int(most.argmin()))
            lost = np.flatnonzero(most < 0).tolist()
            self.release(why=f"{lifted} lifts off {words}", lost=lost)
            return
        slid, found = self._planned.friction.slid(self.push, before), {}
        kind, how = (UNCERTAIN, "may slide") if self._sticks else (SLIPS, "slips")
        for i in np.flatnonzero(slid > t.slid):
            each = self._planned.approach.hold.sticking.own[int(i)]
            found[Concern(kind, each, "slide")] = f"{self._named(each)} {how} {words}"
        for each in map(int, np.flatnonzero(least < 0)):
            text, whole = self._lifted(each, float(most[each])), 1e3 * before[each]
            text = f"{text} {words}; without it, {whole:.0f} mN"
            found[Concern(UNCERTAIN, each, "lift")] = text
        self._weigh(found, elapsed)

    def _estimate(self, forces: Array, deviations: Array) -> Array:
        """Take in estimated forces (k,) and their deviations (k,); return their low ends (k,)."""
        least: Array = forces - self._tuning.certain * deviations
        self._estimated = np.column_stack([forces, deviations])
        self.force, self.deviation = self._estimated[int(least.argmin())].tolist()
        return least

    def _weigh(self, found: dict[Concern, str], elapsed: float) -> None:
        """Take in what is of concern at a sample.

        The arm lets go only at a sample that is itself doubtful.
        """
        longest, concerns = self._tuning.longest_push, self._concerns
        self._notices += concerns.take(found, elapsed)
        if concerns.doubted > longest and any(each.kind == UNCERTAIN for each in found):
            why = f"for {longest:.0f} s it was uncertain: {concerns.doubt}"
            self.release(why=why, lost=concerns.uncertain)

    def _lifted(self, contact: int, most: float) -> str:
        return f"{self._named(contact)} may have lifted off: it has 0 to {1e3 * most:.0f} mN"

    def _named(self, contact: int) -> str:
        return f"the contact on '{self._planned.approach.contacts[contact].object}'"

    def _notify(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        self._notices.append(Notice(kind, text, severity))

    def correct(
        self, elapsed: float, error: Array, jacobian: Array, limits: tuple[Array, Array]
    ) -> None:
        """Move the braced tip slowly to its target, with constant contact forces.

        See `BraceCorrection`. A push is not compensated.

        Parameters
        ----------
        elapsed : time since the last call, in s.
        error : of the tip (3,), in m; zero in components that the target leaves open.
        jacobian : of the position of a tip whose contacts slide, base axes (3, n), in m/Pa.
        limits : smallest and largest pressures (n,), in Pa.
        """
        if self._parts is None or self.displacement.any():
            return
        low, high = (each - self.pressures for each in limits)
        words = self._parts.correction.correct(elapsed, self._held, error, jacobian, low, high)
        if words:
            self._notify("brace-off-target", words, Severity.WARNING)

    def notices(self) -> tuple[Notice, ...]:
        """Return events since the last call, and alarms."""
        found, self._notices = tuple(self._notices), []
        if self._why and self.phase in (BracePhase.RELEASING, BracePhase.RELEASED):
            found = (*found, Notice("brace-lost", self._why, Severity.ERROR, standing=True))
        elif self.contacts == "uncertain":
            found = (*found, Notice(UNCERTAIN, self._concerns.doubt, standing=True))
        return found
