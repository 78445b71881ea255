"""Pressing with a given force: approach, press, and go back if that fails.

A press starts at the task's target. From there the tip's position without contact, s(p) + d, is
shifted by v along the direction n. The offset d is corrected across n only; along n it keeps its
value from the beginning of the approach, plus the predicted creep since then. So the controller
does not compensate what holds the tip back: the arm presses like a spring with its own compliance c
along n. Until a force is felt, v grows with the speed of the approach. Then, with the wanted force
F and the estimated force f::

    v' = c (F - f) / T,    not faster than the speed of the approach

Against a rigid surface f = (v - v0) / c, and the force settles with the time constant T; against a
soft one of stiffness k it settles more slowly, by a factor 1 + 1 / (c k). The law has no overshoot.
The estimated force is about 0.1 s late, much less than T.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import PressingTuning
from stiffopt.control.creep import CreepEstimator
from stiffopt.control.interface import Notice
from stiffopt.control.obstruction import ObstructionWatch
from stiffopt.control.state import Severity
from stiffopt.control.touch import TipForce
from stiffopt.optimise.press import FELT_FORCE, FELT_SHARE, Feeling, Press
from stiffopt.optimise.target import Target


class Phase(StrEnum):
    """The phase of a press."""

    GOING = "going"  # to the target, where the approach begins
    APPROACHING = "approaching"
    PRESSING = "pressing"
    RETREATING = "retreating"
    ENDED = "ended"  # back at the target, without another attempt


class Pressing:
    """A press under way: a target at each time.

    Parameters
    ----------
    press, target : the press, and the target at which the approach begins.
    tuning : times and limits.

    Attributes
    ----------
    phase : the present phase.
    force : estimated force of the tip along the direction, in N; NaN before the approach.
    """

    def __init__(self, press: Press, target: Target, tuning: PressingTuning) -> None:
        self.press, self._target, self._tuning = press, target, tuning
        self.phase, self.force = Phase.GOING, math.nan
        self._direction: Array = np.zeros(3)  # n, base axes
        self._shift = 0.0  # v, in m
        self._start: Array = np.zeros(3)  # tip (3,) when the approach began
        self._offset: Array = np.zeros(6)  # d at that time
        self._crept: Array = np.zeros(3)  # creep (3,) at that time, and since then
        self._creep: Array = np.zeros(3)
        # durations, in s: at rest, without a force, within and outside the tolerance
        self._waited = self._felt_nothing = self._within = self._off = 0.0
        # how long something has pushed the tip before the approach, with pauses, and has not, in s
        self._pushed = self._calm = 0.0
        self._touched, self._why = False, ""
        self._told = False  # whether the tip comes from beyond the target
        self._watch = ObstructionWatch(tuning.obstruction)
        self._free = False  # the approach has shown if the tip was free when it began
        self._blocked = False  # it was not free, or an object keeps it from the target
        # ways of the tip and of the arm on the way back from it, and the way on which both were one
        self._before, self._clear = (0.0, 0.0), 0.0
        self._notices: list[Notice] = []

    def at(self, now: float) -> Target:
        """Return the present target of the arm without contact."""
        position = self._target.position
        if position is None or not self._shift:
            return self._target
        way = (self._shift * self._direction).tolist()
        moved = tuple(
            None if axis is None else axis + step for axis, step in zip(position, way, strict=True)
        )
        return self._target.model_copy(update={"position": moved})

    def shown(self, tip: Array) -> Target:
        """Return the target to report: across the direction; along it, the tip's position (3,)."""
        position = self._target.position
        if position is None or self.phase in (Phase.GOING, Phase.ENDED):
            return self._target
        along = float(self._direction @ (tip - self._start)) * self._direction
        moved = tuple(
            None if axis is None else axis + step
            for axis, step in zip(position, along.tolist(), strict=True)
        )
        return self._target.model_copy(update={"position": moved})

    @property
    def presses(self) -> bool:
        """Whether the tip presses on something now."""
        return self.phase is Phase.PRESSING and self._touched

    @property
    def touches(self) -> bool:
        """True while the tip is known to touch something."""
        return self.phase is Phase.PRESSING or self.is_blocked

    @property
    def is_blocked(self) -> bool:
        """True while the tip goes back from an object that is in front of its target."""
        return self._blocked and self.phase is Phase.RETREATING

    @property
    def begins_free(self) -> bool:
        """True while the arm rests before the approach; nothing may touch the tip then."""
        return self.phase is Phase.GOING and self._waited >= self._tuning.rest

    @property
    def direction(self) -> Array:
        """Direction (3,) of the approach, base axes."""
        return self._direction

    @property
    def touches_on_purpose(self) -> bool:
        """Whether the controller must not compensate what holds the tip back."""
        return self.phase in (Phase.APPROACHING, Phase.PRESSING, Phase.RETREATING)

    def corrected(self, offset: Array) -> Array:
        """Return the part of the estimated offset (6,) to compensate."""
        if not self.touches_on_purpose:
            return offset
        n, corrected = self._direction, offset.copy()
        corrected[:3] += n * float(n @ (self._offset[:3] + self._creep - offset[:3]))
        return corrected

    def change_model(self, change: Array) -> None:
        """Adjust to another model, for which the tip's offset changes by (6,)."""
        self._offset = self._offset + change
        self._watch.change_model(change)

    def change_posture(self, moved: float) -> None:
        """Take in by how much a change of posture has moved the tip by its channels, in m."""
        self._watch.change_posture(moved)

    def advance(
        self,
        elapsed: float,
        arrived: bool,
        known: bool,
        tip: Array,
        offset: Array,
        felt: TipForce,
        creep: CreepEstimator,
        rotation: Array,
        compliance: Array,
        short: Array,
    ) -> None:
        """Advance by a tick.

        Parameters
        ----------
        elapsed : time since the last tick, in s.
        arrived : whether the arm rests at its target, as stiff as planned.
        known : whether no better estimate of its stiffness is due soon.
        tip, offset : position (3,) of the tip, in m, and its offset (6,) from the model.
        felt : estimated force on the tip.
        creep : estimator of the tip's creep.
        rotation, compliance : rotation (3, 3) of the model's tip, and compliance (3, 3) of its
            position, in m/N, both in base axes.
        short : way (3,) from the nearest pose that the arm reaches by its model to the present
            target, in m.
        """
        t = self._tuning
        is_free = self.phase in (Phase.GOING, Phase.ENDED)
        aim = np.array(self._target.position, dtype=float)
        if is_free and self._watch.take(tip, offset, aim):
            self._leave(tip, offset, creep)
        if self.phase is Phase.ENDED:
            return
        if self.phase is Phase.GOING:
            self._waited = self._waited + elapsed if arrived else 0.0
            self._note_pushes(elapsed, felt.touches)
            n = self.press.direction_in_base(rotation)
            self._tell_from_where(float(n @ np.nan_to_num(tip - aim)))
            deviation = creep.deviation(n, t.foresight) / float(n @ compliance @ n)
            allowed = t.creep_share * (FELT_SHARE * self.press.force + FELT_FORCE)
            known = known and deviation <= allowed
            if self._waited >= (t.rest if known else t.longest_rest) and not felt.touches:
                self._direction, self._start = n, tip.copy()
                self._offset, self._crept = offset.copy(), creep.displacement.copy()
                self.phase = Phase.APPROACHING
            return
        n, self._creep = self._direction, creep.displacement - self._crept
        feeling = Feeling.of(n, compliance)
        self.force = -float(n @ felt.force) / max(feeling.share, 0.1)
        if self._blocked:
            self.force = math.nan  # what holds the tip may have begun long ago
        gone = float(n @ (tip - self._start))
        way = gone - float(n @ (offset - self._offset)[:3])  # of the arm without contact
        if self.touches_on_purpose and not self._blocked and not self._free:
            self._free = way > self._tuning.free_way
            if self._free and gone < self._tuning.free_share * way:
                self._block(gone, way)
        held_back = self._shift - float(n @ short) - gone  # needs no estimate of the force
        goes_on = self.phase in (Phase.APPROACHING, Phase.PRESSING)
        if goes_on and np.linalg.norm(short) > t.out_of_reach:
            self._retreat(self._out_of_reach(gone))
        elif self.phase is Phase.APPROACHING:
            self._approach(elapsed, gone, held_back, feeling.compliance)
        elif self.phase is Phase.PRESSING:
            self._keep_the_force(elapsed, gone, held_back, feeling.compliance)
        elif self.phase is Phase.RETREATING:
            self._shift -= self.press.speed * elapsed
            if self._blocked:
                self._go_clear(gone, way, tip)
            elif self._shift <= 0.0:
                self._end()

    def _note_pushes(self, elapsed: float, touches: bool) -> None:
        """Note how long something pushes the tip, also if it does so again and again."""
        self._calm = 0.0 if touches else self._calm + elapsed
        if touches:
            self._pushed += elapsed
        elif self._calm > self._tuning.patience:
            self._pushed = 0.0

    def _tell_from_where(self, beyond: float) -> None:
        """Tell at the beginning if the tip is beyond the target, in m, where the object may be."""
        if not self._told and beyond > self._tuning.beyond:
            text = (
                f"the tip begins {1e3 * beyond:.0f} mm beyond the target of its press; the object "
                "may be in its way, and would be hit at ordinary speed"
            )
            self._notify("press-beyond", text)
        self._told = True

    def _end(self) -> None:
        self._shift, self.phase, self.force = 0.0, Phase.ENDED, math.nan
        self._watch.begin()

    def _go_clear(self, gone: float, way: float, tip: Array) -> None:
        """End the retreat from an object once the tip follows the arm back; stay there.

        `gone` and `way` are the ways of the tip and of the arm without contact, in m.
        """
        t, (gone_before, way_before) = self._tuning, self._before
        back = way_before - way
        if back > t.free_way:
            follows = gone_before - gone > t.free_share * back
            self._clear = self._clear + back if follows else 0.0
            self._before = gone, way
        if self._clear >= t.clear or self._shift < -t.most_back:
            self._target = self._target.model_copy(update={"position": tuple(tip.tolist())})
            self._end()

    def _approach(self, elapsed: float, gone: float, held_back: float, compliance: float) -> None:
        press, t = self.press, self._tuning
        if self.force > t.touch_share * press.force:
            self.phase = Phase.PRESSING
        elif gone > press.travel:
            self._retreat(f"nothing was felt within {1e3 * press.travel:g} mm")
        elif held_back > press.force * compliance + t.held_back:
            self._retreat("the tip is held back, and no force is felt that explains it")
        else:
            self._shift += press.speed * elapsed

    def _keep_the_force(
        self, elapsed: float, gone: float, held_back: float, compliance: float
    ) -> None:
        press, t = self.press, self._tuning
        missing = press.force - self.force
        lost = self.force < t.touch_share / 2 * press.force
        self._felt_nothing = self._felt_nothing + elapsed if lost else 0.0
        self._off = 0.0 if abs(missing) <= press.tolerance else self._off + elapsed
        self._within = self._within + elapsed if abs(missing) <= press.tolerance else 0.0
        if self._felt_nothing > t.lost and self._why:
            self._retreat("the contact was lost")
        elif self._felt_nothing > t.lost:  # it was no contact
            self.phase, self._felt_nothing = Phase.APPROACHING, 0.0
        elif gone > press.travel:
            way = f"{1e3 * press.travel:g} mm"
            if self._why:
                self._retreat(f"the contact gave way, by more than the travel of {way}")
            else:
                self._retreat(f"{1e3 * press.force:g} mN were not reached within {way}")
        elif self.force > t.most_force * press.force + press.tolerance:
            self._retreat(f"it presses with {1e3 * self.force:.0f} mN")
        elif held_back > t.most_force * press.force * compliance + t.held_back:
            self._retreat("the tip is held back by more than the force that is felt explains")
        else:
            rate = compliance * missing / t.time
            limit = press.speed
            self._shift = max(0.0, self._shift + float(np.clip(rate, -limit, limit)) * elapsed)
        if self.force > press.force / 2 and not self._touched:
            self._touched = True
            self._notify("touch", f"something is felt, after {1e3 * gone:.1f} mm")
        if self._within >= t.settled and not self._why:
            self._why = "held"
            self._notify("pressing", f"presses with {1e3 * self.force:.0f} mN")

    def _out_of_reach(self, gone: float) -> str:
        """Return why a press ends whose tip has gone as far as it can, by a way in m."""
        felt = "nothing is felt there"
        if self.phase is Phase.PRESSING:
            felt = f"it presses with {1e3 * self.force:.0f} mN of {1e3 * self.press.force:g} mN"
        return (
            f"the arm reaches no farther than {1e3 * gone:.1f} mm along the direction, and {felt}"
        )

    def _leave(self, tip: Array, offset: Array, creep: CreepEstimator) -> None:
        """Begin to go back from an object at the target, or that has come there; nothing jumps."""
        withheld = self._watch.withheld
        self._shift = float(np.linalg.norm(withheld))
        self._direction, self._start = withheld / self._shift, tip.copy()
        self._offset, self._crept = offset.copy(), creep.displacement.copy()
        self._offset[:3] += withheld
        self._block(0.0, self._shift)

    def _block(self, gone: float, way: float) -> None:
        why = "something holds the tip at the target, where it must be free"
        self._retreat(self._why if self.phase is Phase.ENDED else why)
        self._blocked, self._before, self._clear = True, (gone, way), 0.0

    def _retreat(self, why: str) -> None:
        self.phase, self._why = Phase.RETREATING, why

    def _notify(self, kind: str, text: str) -> None:
        self._notices.append(Notice(kind, text, Severity.INFO))

    def notices(self) -> tuple[Notice, ...]:
        """Return events since the last call, and alarms."""
        found, self._notices = tuple(self._notices), []
        if self.phase in (Phase.RETREATING, Phase.ENDED):
            where = "until it is free" if self._blocked else "to where it began"
            text = f"{self._why}; the tip goes back {where}, and stays there until a new task"
            return (*found, Notice("press-failed", text, standing=True))
        if self.phase is Phase.GOING and self._pushed > self._tuning.patience:
            text = "something keeps touching the tip; it presses once nothing does"
            return (*found, Notice("press-waits", text, standing=True))
        if self.phase is Phase.PRESSING and self._off > self._tuning.patience:
            text = (
                f"the tip presses with {1e3 * self.force:.0f} mN instead of "
                f"{1e3 * self.press.force:g} mN"
            )
            return (*found, Notice("press-force", text, standing=True))
        return found
