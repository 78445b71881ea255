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
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.friction import Friction
from stiffopt.control.interface import Notice
from stiffopt.control.sliding import SlideEstimator
from stiffopt.control.state import HeldContact, Severity
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.configurations import maximised
from stiffopt.paths.leaning import BraceApproach

_UNCERTAIN, _SLIPS = "brace-uncertain", "brace-slips"


class BracePhase(StrEnum):
    """The phase of a brace."""

    PLANNING = "planning"
    TO_REST = "going to rest"
    APPROACHING = "approaching"
    HELD = "held"
    RELEASING = "releasing"
    RELEASED = "released"


class Concern(NamedTuple):
    """A reason to report a contact."""

    kind: str  # `brace-uncertain` or `brace-slips`
    contact: int  # its index
    cause: str  # `slide` or `lift` under a push, or `drift` of b


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
        self._corrected: Array = np.zeros(3)  # of late, by the model; friction may withhold it
        self._residual: Array = np.zeros(3)  # y - s, smoothed over vibrations
        self._held = self._pushed = 0.0  # durations, in s
        self.approach: BraceApproach | None = None
        self._friction: Friction | None = None
        self._slides: SlideEstimator | None = None
        self._slid = 0  # successive samples at which a contact has slid
        self._start: Array = np.zeros(0)  # pressures (n,) from which the arm goes to rest
        self._left = 1.0  # share of `_start` that is left
        self._time = 0.0  # along the approach, in s
        self._pace = 0.0  # of that time, from 0 to 1
        self._waited = 0.0  # at its end, in s
        self._change: Array = np.zeros(0)  # of the planned pressures (n,), to correct the tip
        self._free = 0  # successive samples at which the tip is nearer to a free arm's
        self._is_off = False  # the tip is known to stay off its target
        self._nearest = (math.inf, 0.0)  # distance of the tip from it, in m, and when it fell to it
        self._concerns: dict[Concern, str] = {}  # what is reported, with its text
        self._calm: dict[Concern, float] = {}  # how long it has not been seen, in s
        self._doubted = 0.0  # for how long contacts have been uncertain, in s
        self._estimated: Array = np.zeros((0, 2))  # forces of contacts and their deviations (k, 2)
        self._lost: frozenset[int] = frozenset()  # contacts
        self._why = ""
        self._notices: list[Notice] = []

    def at(self, now: float) -> Target:
        """Return the target, which is constant."""
        return self.task.target

    @property
    def leans(self) -> bool:
        """Whether the arm is in contact, approaches it, or lets go."""
        return self.phase in (BracePhase.APPROACHING, BracePhase.HELD, BracePhase.RELEASING)

    @property
    def contacts(self) -> str:
        """State of the contacts: `held`, `uncertain` or `lost`; empty if the arm does not lean."""
        if self.phase is BracePhase.HELD and not self.is_let_down:
            return "uncertain" if self._doubt else "held"
        return "lost" if self._why else ""

    @property
    def held(self) -> tuple[HeldContact, ...]:
        """The contacts while the brace is held; after a loss, those that were lost."""
        if self.approach is None or not self.contacts:
            return ()
        doubted = {each.contact for each in self._concerns if each.kind == _UNCERTAIN}
        found = []
        for number, each in enumerate(self.approach.contacts):
            if self.phase is BracePhase.HELD:
                state = "uncertain" if number in doubted else "held"
                force, deviation = self._estimated[number].tolist()
                found.append(HeldContact(each.object, each.at, state, force, deviation))
            elif number in self._lost:
                found.append(HeldContact(each.object, each.at, "lost"))
        return tuple(found)

    @property
    def _doubt(self) -> str:
        """Why contacts are uncertain; empty if they are not."""
        texts = [text for each, text in self._concerns.items() if each.kind == _UNCERTAIN]
        return "; also ".join(texts)

    @property
    def pressures(self) -> Array:
        """Effective pressures (n,) now, in Pa."""
        approach = self.approach
        if approach is None or self.phase is BracePhase.TO_REST:
            return self._left * self._start
        rows = approach.pressures
        on_way = np.array([np.interp(self._time, approach.times, row) for row in rows.T])
        share = min(self._time / approach.reached, 1.0)
        return on_way + share * self._change

    def begin(self, approach: BraceApproach, pressures: Array) -> None:
        """Go from pressures (n,) to rest, then along the approach."""
        self.approach, self._start = approach, pressures
        self._friction = Friction(approach.hold, approach.pressures[-1])
        self._left = float(bool(np.abs(pressures).max() > self._tuning.at_rest))
        self._change = np.zeros_like(pressures)
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
        t, held, friction = self._tuning, self.phase is BracePhase.HELD, self._friction
        if self.approach is None or friction is None:
            return
        if not np.isfinite(seen).all():
            return
        if quaternion is not None and not np.isfinite(quaternion).all():
            quaternion = None
        if not (held or self.phase is BracePhase.APPROACHING):
            return
        if self.is_let_down or float(np.abs(pressures - self.pressures).max()) > t.off_plan:
            return
        sticks = self._sticks
        residual = seen - tip.pose[:3, 3]
        if held:  # the plan has followed friction to there
            creep = t.creep * elapsed / (t.creep_time + self._held)
            friction.follow(pressures, min(elapsed / t.even_time, 1.0), creep)
            if sticks:
                residual = residual - friction.tip[:3] @ friction.forces
        if self._error is None:
            self._residual = residual
        self._residual = self._residual + min(elapsed / t.swing_time, 1.0) * (
            residual - self._residual
        )
        residual = self._residual
        to_free = self._free_tip() - tip.pose[:3, 3]
        distance = float(np.linalg.norm(to_free))
        share = float(residual @ to_free) / max(distance, 1e-9) ** 2
        enough = t.min_distance if held else t.min_on_way
        is_free = distance > enough and share > t.free_share
        self._free = self._free + 1 if is_free else 0
        if self._free >= t.samples:
            self._let_go_astray(seen, tip.pose[:3, 3])
            return
        if not held:
            return
        if self._error is None:
            self._error = residual
        raw, settles = residual - self._error, self._held < self._settling
        off = raw + self._withheld(raw)
        self._corrected *= 1 - min(elapsed / t.withheld_time, 1.0)
        self._held += elapsed
        R, before = tip.pose[:3, :3], friction.sliding(pressures)
        C = R @ tip.compliance[:3, :3] @ R.T
        if sticks:
            before = friction.normals(pressures)
            C = C + friction.tip[:3] @ self.approach.hold.sticking.per_push
            if not settles and self._has_slid(elapsed, seen, quaternion, pressures):
                return
        push, covariance = self._push(C, R, off)
        feels = not settles and self._feels(off, push, before)
        if settles:
            self._settled = residual
        drift = self._drift(C, R, residual - self._settled - float(feels) * off, tip, pressures)
        if not feels or (self._pushed > t.longest_push and not self._doubt):
            time = t.settling_time if settles else t.error_time
            self._error = self._error + min(elapsed / time, 1.0) * raw
            self._pushed = self._pushed * float(feels)
            self.push = self.displacement = np.zeros(3)
            self._rest(before, drift, elapsed)
            return
        self._pushed += elapsed
        if sticks and not self._doubt:  # what stays is creep in the end
            self._error = self._error + min(elapsed / t.push_creeps, 1.0) * raw
        self.push, self.displacement = push, off
        self.covariance[:] = covariance
        self._judge(before, drift, elapsed)

    def _let_go_astray(self, seen: Array, planned: Array) -> None:
        """Release contacts with a tip (3,) that is not where the plan has it (3,).

        Where it is not at a free arm's place either, the arm still touches something.
        """
        assert self.approach is not None
        t, contacts, free = self._tuning, self.approach.contacts, self._free_tip()
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
        rough = {contacts[j].object for j in self.approach.hold.sticking.own}
        names = " and ".join(f"'{each}'" for each in sorted(rough or {c.object for c in contacts}))
        if rough:
            why += f"; friction on {names} probably holds the body: give it a larger friction"
        else:
            why += f": check the place of {names}, and give it its friction if it has any"
        self.release(why=f"{why}, and solve again")

    def _push(
        self, C: Array, rotation: Array, off: Array, creep: float = 0.0
    ) -> tuple[Array, Array]:
        """Return the most likely push (3,) that moves the tip by `off` (3,), and its covariance.

        `C`: compliance (3, 3) of the tip, base axes; `creep`: deviation of what else moves the tip,
        in m.
        """
        usual, noise = self._usual(rotation), self._noise(off) + creep**2 * np.eye(3)
        gain = np.linalg.solve(C @ usual @ C.T + noise, C @ usual).T
        return gain @ off, usual - gain @ C @ usual

    def _drift(
        self, C: Array, rotation: Array, change: Array, tip: TipAt, pressures: Array
    ) -> Array:
        """Return the forces (k,) that contacts may have lost since settling, unknown to anybody.

        A push that lasts becomes part of b, and one that is not felt may be taken for a correction
        that friction withholds. Creep moves the tip too, in any direction where friction holds the
        body; its deviation is what the tip would move if the pressures grew. `change`: of y - s,
        without what is felt (3,); see `_push` for `C`.
        """
        t, began = self._tuning, self._tuning.creep_time + self._settling
        folds = math.log(max((t.creep_time + self._held) / began, 1.0))
        creep = t.unknown_creep * folds * float(np.linalg.norm(tip.jacobian[:3] @ pressures))
        push = self._push(C, rotation, change, creep)[0]
        return np.maximum(-(self._per_push @ push), 0.0)

    def _has_slid(
        self, elapsed: float, seen: Array, quaternion: Array | None, pressures: Array
    ) -> bool:
        """Return whether place and turn of the tip tell that a contact has slid; then let go.

        See `look` for the arguments.
        """
        assert self.approach is not None
        assert self._friction is not None
        t, approach = self._tuning.sliding, self.approach
        if not approach.hold.sticking.own:
            return False
        if self._slides is None:
            usual = self._usual(approach.tips[-1].pose[:3, :3])
            self._slides = SlideEstimator(approach, self._friction, usual, t)
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

    def _feels(self, off: Array, push: Array, before: Array) -> bool:
        """Return whether a displacement (3,) of the tip is more than the model's error.

        It is if it is large, or if its push uses up a share of what a contact holds: an arm that is
        stiff loses its contact before the tip has moved far. `before`: normal forces (k,).
        """
        assert self._friction is not None
        t, size = self._tuning, float(np.linalg.norm(off))
        uses = float((-(self._per_push @ push) / np.maximum(before, 1e-6)).max())
        if self._sticks and push.any():
            force = float(np.linalg.norm(push))
            uses = max(uses, force / max(self._friction.left(push / force, before), 1e-6))
        return size > t.felt or (size > t.least_felt and uses > t.felt_share)

    def _noise(self, off: Array) -> Array:
        """Return the covariance (3, 3) of a displacement (3,) of the tip that no push explains.

        A tip that is moved by y goes along an arc, so that its place is off the linear response by
        y^2 / (2 length).
        """
        assert self.approach is not None
        length = float(np.linalg.norm(self.approach.free_tips[0]))
        bent = float(off @ off) / (2 * length)
        return (self._tuning.deviation**2 + bent**2) * np.eye(3)

    def _usual(self, rotation: Array) -> Array:
        """Return the covariance (3, 3) of pushes before the tip is seen, in N^2; base axes.

        An arm whose contacts are to stick hardly moves along its axis. There, pushes are expected
        rather along the directions in which the task wants it to be stiff.
        """
        t, share = self._tuning, self._tuning.aside if self._sticks else 1.0
        turns = {"base": np.eye(3), "tip": rotation}
        ways = np.array([turns[m.frame] @ m.direction for m in maximised(self.task)]).T
        along = ways @ np.linalg.pinv(ways)
        return t.usual_push**2 * (share**2 * np.eye(3) + (1 - share**2) * along)

    @property
    def _per_push(self) -> Array:
        """Derivatives (k, 3) of the contacts' normal forces by a push."""
        assert self.approach is not None
        assert self._friction is not None
        return self._friction.per_push if self._sticks else self.approach.hold.per_push

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
        assert self.approach is not None
        times, rows = self.approach.times, self.approach.free_tips
        return np.array([np.interp(self._time, times, row) for row in rows.T])

    def _withheld(self, off: Array) -> Array:
        """Return the part of the recent correction (3,), in m, that explains a residual (3,) best.

        A contact with friction sticks at first and slips later, so the tip may lag behind the
        correction, or catch up, by up to all of it.
        """
        square = float(self._corrected @ self._corrected)
        share = -float(off @ self._corrected) / max(square, 1e-12)
        return float(np.clip(share, -1.0, 1.0)) * self._corrected

    def _rest_deviations(self, before: Array) -> Array:
        """Return the standard deviations (k,) of normal forces without a push, in N.

        `before`: these forces (k,). A robot that is not calibrated has none of its own.
        """
        assert self.approach is not None
        least, own = self._tuning.least_deviation * before, self.approach.hold.deviations
        return np.maximum(own, least)

    def _deviations(self, before: Array, change: Array) -> Array:
        """Return the standard deviations (k,) of the normal forces under the push, in N.

        They come from the forces without it, from the push, which the tip hardly shows where it is
        stiff, and from the response of the model. `before`: forces (k,) without the push; `change`:
        by it (k,).
        """
        assert self.approach is not None
        G, response = self._per_push, self._tuning.response * change
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
            found[Concern(_UNCERTAIN, each, "drift")] = f"{text}, {why}"
        self._weigh(found, elapsed)

    def _judge(self, before: Array, drift: Array, elapsed: float) -> None:
        """Judge whether the contacts hold the estimated push.

        `before`: normal forces (k,) without it; `drift`: what they may have lost (k,).
        """
        assert self.approach is not None
        assert self._friction is not None
        t, size = self._tuning, float(np.linalg.norm(self.push))
        change = self._per_push @ self.push
        forces, own = before + change, self._deviations(before, change)
        most, least = forces + t.certain * own, self._estimate(forces, np.hypot(own, drift))
        falls = change < 0
        left = size * float(np.min(before[falls] / -change[falls], initial=math.inf))
        if self._sticks:
            left = min(left, self._friction.left(self.push / size, before))
        self.margin = max(left - size, 0.0)
        words = f"under a push of {1e3 * size:.0f} mN"
        if (most < 0).any():
            lifted = self._named(int(most.argmin()))
            lost = np.flatnonzero(most < 0).tolist()
            self.release(why=f"{lifted} lifts off {words}", lost=lost)
            return
        slid, found = self._friction.slid(self.push, before), {}
        kind, how = (_UNCERTAIN, "may slide") if self._sticks else (_SLIPS, "slips")
        for i in np.flatnonzero(slid > t.slid):
            each = self.approach.hold.sticking.own[int(i)]
            found[Concern(kind, each, "slide")] = f"{self._named(each)} {how} {words}"
        for each in map(int, np.flatnonzero(least < 0)):
            text, whole = self._lifted(each, float(most[each])), 1e3 * before[each]
            text = f"{text} {words}; without it, {whole:.0f} mN"
            found[Concern(_UNCERTAIN, each, "lift")] = text
        self._weigh(found, elapsed)

    def _estimate(self, forces: Array, deviations: Array) -> Array:
        """Take in estimated forces (k,) and their deviations (k,); return their low ends (k,)."""
        least: Array = forces - self._tuning.certain * deviations
        self._estimated = np.column_stack([forces, deviations])
        self.force, self.deviation = self._estimated[int(least.argmin())].tolist()
        return least

    def _weigh(self, found: dict[Concern, str], elapsed: float) -> None:
        """Take in what is of concern at a sample.

        It is reported when it comes, and until it has not been seen for `again`. The arm lets go
        only at a sample that is itself doubtful.
        """
        t = self._tuning
        for each, text in found.items():
            if each not in self._concerns:
                self._notify(each.kind, text, Severity.WARNING)
                self._concerns[each] = text
        for each in list(self._concerns):
            self._calm[each] = 0.0 if each in found else self._calm[each] + elapsed
            if self._calm[each] >= t.again:
                del self._concerns[each]
        if not self._doubt:
            self._doubted = 0.0
        if any(each.kind == _UNCERTAIN for each in found):
            self._doubted += elapsed
            if self._doubted > t.longest_push:
                time = f"{t.longest_push:.0f} s"
                lost = [each.contact for each in self._concerns if each.kind == _UNCERTAIN]
                self.release(why=f"for {time} it was uncertain: {self._doubt}", lost=lost)

    def _lifted(self, contact: int, most: float) -> str:
        return f"{self._named(contact)} may have lifted off: it has 0 to {1e3 * most:.0f} mN"

    def _named(self, contact: int) -> str:
        assert self.approach is not None
        return f"the contact on '{self.approach.contacts[contact].object}'"

    def _notify(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        self._notices.append(Notice(kind, text, severity))

    def correct(
        self, elapsed: float, error: Array, jacobian: Array, limits: tuple[Array, Array]
    ) -> None:
        """Move the braced tip slowly to its target, with constant contact forces.

        Then also relieve contacts that are to stick of the friction that the way into contact left:
        the pressures change the tangential forces while the tip stays.

        Parameters
        ----------
        elapsed : time since the last call, in s.
        error : of the tip (3,), in m; zero in components that the target leaves open.
        jacobian : of the position of a tip whose contacts slide, base axes (3, n), in m/Pa.
        limits : smallest and largest pressures (n,), in Pa.
        """
        if self.displacement.any() or self.approach is None or self._friction is None:
            return  # a push is not compensated
        t = self._tuning
        off, (least, since) = float(np.linalg.norm(error)), self._nearest
        if off < (1 - t.progress) * least:
            self._nearest = off, self._held
        elif not self._is_off and least > t.off_target and self._held > since + t.patience:
            self._is_off = True
            text = f"the tip stays {1e3 * off:.1f} mm from its target while the arm leans"
            if self.approach.hold.sticking.own:
                text += "; friction may hold the body"
            self._notify("brace-off-target", text, Severity.WARNING)
        hold, friction = self.approach.hold, self._friction
        rows, wanted = [jacobian, t.force_weight * hold.per_pressure], [error]
        if self._sticks and self._held >= t.settling:  # the tip has come to its target
            rates = hold.sticking.per_pressure
            jacobian = jacobian + friction.tip[:3] @ rates
            rows = [jacobian, t.force_weight * friction.per_pressure, t.force_weight * rates]
            wanted = [error, np.zeros(len(hold.forces)), -t.force_weight * friction.forces]
        step = elapsed * self._step(np.vstack(rows), np.concatenate(wanted), limits)
        time, speed = t.first_time, t.first_speed
        if self._held >= t.settling:  # so slow that a push which is not felt yet is quicker
            time, speed = t.time, t.correction_speed
        step /= time
        step *= min(1.0, speed * elapsed / max(float(np.linalg.norm(jacobian @ step)), 1e-12))
        before = self._change
        self._change = np.clip(before + step, -t.most_change, t.most_change)
        self._corrected = self._corrected + jacobian @ (self._change - before)

    def _step(self, rows: Array, wanted: Array, limits: tuple[Array, Array]) -> Array:
        """Return the change (n,) of pressures that fits rows (m, n) @ it best.

        To relieve friction takes all channels, so those at their limits are known to stay there.
        `wanted` may lack zeros at its end. A channel that comes to its limit stays there for this
        step, even if the others could then do better without that: the next steps make it up.
        """
        t, n = self._tuning, len(self._change)
        A = np.vstack([rows, t.pressure_weight * np.eye(n)])
        b = np.concatenate([wanted, np.zeros(len(A) - len(wanted))])
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        if self._sticks:
            now, most = self.pressures, t.most_change
            low = np.clip(limits[0] - now, -most - self._change, 0.0)
            high = np.clip(limits[1] - now, 0.0, most - self._change)
        step, free = np.zeros(n), np.ones(n, dtype=bool)
        while free.any():
            B = A[:, free]
            step[free] = np.linalg.solve(B.T @ B, B.T @ (b - A[:, ~free] @ step[~free]))
            beyond = (step < low) | (step > high)
            if not beyond.any():
                break
            step, free = np.clip(step, low, high), free & ~beyond
        return step

    def notices(self) -> tuple[Notice, ...]:
        """Return events since the last call, and alarms."""
        found, self._notices = tuple(self._notices), []
        if self._why and self.phase in (BracePhase.RELEASING, BracePhase.RELEASED):
            found = (*found, Notice("brace-lost", self._why, Severity.ERROR, standing=True))
        elif self.contacts == "uncertain":
            found = (*found, Notice(_UNCERTAIN, self._doubt, standing=True))
        return found
