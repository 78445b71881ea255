"""To press on something with a given force: approach, press, and go back where that fails.

From the target of the task on, the place s(p) + d where the tip would be if nothing touched it is
led along the direction n, by a shift v. The offset d is corrected across n only; along n it stays
as it was when the approach began. So nothing is made up for that holds the tip back: it presses
like a spring of the arm's own compliance c along n. Until something is felt, v grows with the speed
of the approach. Then, with F the force that is wanted and f the one that is felt::

    v' = c (F - f) / T,    not faster than the speed of the approach

Against a rigid surface f = (v - v0) / c, and the force settles with the time constant T; against a
soft one of stiffness k more slowly, by 1 + 1 / (c k), and never with an overshoot by this law. What
is felt comes late by some 0.1 s, much less than T.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.interface import Notice
from stiffopt.control.state import Severity
from stiffopt.control.touch import TipForce
from stiffopt.control.tuning import PressingTuning
from stiffopt.optimise.press import Feeling, Press
from stiffopt.optimise.target import Target

Array = NDArray[np.float64]


class Phase(StrEnum):
    """Where a press is."""

    GOING = "going"  # to the target, where the approach begins
    APPROACHING = "approaching"
    PRESSING = "pressing"
    RETREATING = "retreating"
    ENDED = "ended"  # back at the target, without another attempt


class Pressing:
    """A press under way: a target for each moment.

    Parameters
    ----------
    press, target :
        What is wanted, and where the approach begins.
    tuning :
        Times and limits.

    Attributes
    ----------
    phase : where it is.
    force : with which the tip presses along the direction, as it is felt, in N; NaN before.
    """

    def __init__(self, press: Press, target: Target, tuning: PressingTuning) -> None:
        self.press, self._target, self._tuning = press, target, tuning
        self.phase, self.force = Phase.GOING, math.nan
        self._direction: Array = np.zeros(3)  # n, base axes
        self._shift = 0.0  # v, in m
        self._start: Array = np.zeros(3)  # tip (3,) when the approach began
        self._offset: Array = np.zeros(6)  # d then
        self._waited = self._felt_nothing = self._within = self._off = 0.0  # times in s
        self._touched, self._why = False, ""
        self._told: list[Notice] = []

    def at(self, now: float) -> Target:
        """Return the target of the arm without contact, at any time."""
        position = self._target.position
        if position is None or not self._shift:
            return self._target
        way = (self._shift * self._direction).tolist()
        moved = tuple(
            None if axis is None else axis + step for axis, step in zip(position, way, strict=True)
        )
        return self._target.model_copy(update={"position": moved})

    def shown(self, tip: Array) -> Target:
        """Return the target across the direction; along it, that is where the tip (3,) is."""
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
        """Whether the tip presses on something by now."""
        return self.phase is Phase.PRESSING and self._touched

    @property
    def direction(self) -> Array:
        """Direction (3,) of the approach, base axes."""
        return self._direction

    @property
    def touches_on_purpose(self) -> bool:
        """Whether what holds the tip back is no error that has to be made up for."""
        return self.phase in (Phase.APPROACHING, Phase.PRESSING, Phase.RETREATING)

    def corrected(self, offset: Array) -> Array:
        """Return the offset (6,) that is made up for, of the one that is estimated."""
        if not self.touches_on_purpose:
            return offset
        n, corrected = self._direction, offset.copy()
        corrected[:3] += n * float(n @ (self._offset[:3] - offset[:3]))
        return corrected

    def change_model(self, change: Array) -> None:
        """Go on with another model, from which the tip is off by another offset (6,)."""
        self._offset = self._offset + change

    def advance(
        self,
        elapsed: float,
        arrived: bool,
        known: bool,
        tip: Array,
        offset: Array,
        felt: TipForce,
        rotation: Array,
        compliance: Array,
    ) -> None:
        """Go on by a tick.

        Parameters
        ----------
        elapsed :
            Since the tick before, in s.
        arrived :
            Whether the arm rests at its target.
        known :
            Whether its stiffness is known as well as it can be soon.
        tip, offset :
            Position (3,) of the tip, in m, and its offset (6,) from the model.
        felt :
            Force on the tip.
        rotation, compliance :
            Of the model's tip in base axes (3, 3), and of its position (3, 3) by forces, in m/N.
        """
        if self.phase is Phase.GOING:
            self._waited = self._waited + elapsed if arrived else 0.0
            if self._waited >= (self._tuning.rest if known else self._tuning.longest_rest):
                self._direction = self.press.direction_in_base(rotation)
                self._start, self._offset = tip.copy(), offset.copy()
                self.phase = Phase.APPROACHING
            return
        n = self._direction
        feeling = Feeling.of(n, compliance)
        self.force = -float(n @ felt.force) / max(feeling.share, 0.1)
        gone = float(n @ (tip - self._start))
        if self.phase is Phase.APPROACHING:
            self._approach(elapsed, gone, feeling.compliance)
        elif self.phase is Phase.PRESSING:
            self._keep_the_force(elapsed, gone, feeling.compliance)
        elif self.phase is Phase.RETREATING:
            self._shift = max(0.0, self._shift - self.press.speed * elapsed)
            if not self._shift:
                self.phase, self.force = Phase.ENDED, math.nan

    def _approach(self, elapsed: float, gone: float, compliance: float) -> None:
        press, t = self.press, self._tuning
        if self.force > t.touch_share * press.force:
            self.phase = Phase.PRESSING
        elif gone > press.travel:
            self._retreat(f"nothing was felt within {1e3 * press.travel:g} mm")
        elif self._held_back(gone) > press.force * compliance + t.held_back:
            self._retreat("the tip is held back, and no force is felt that explains it")
        else:
            self._shift += press.speed * elapsed

    def _keep_the_force(self, elapsed: float, gone: float, compliance: float) -> None:
        press, t = self.press, self._tuning
        missing = press.force - self.force
        lost = self.force < t.touch_share / 2 * press.force
        self._felt_nothing = self._felt_nothing + elapsed if lost else 0.0
        self._off = 0.0 if abs(missing) <= press.tolerance else self._off + elapsed
        self._within = self._within + elapsed if abs(missing) <= press.tolerance else 0.0
        if self._felt_nothing > t.lost and self._why:
            self._retreat("the contact was lost")
        elif self._felt_nothing > t.lost:  # it was none
            self.phase, self._felt_nothing = Phase.APPROACHING, 0.0
        elif gone > press.travel:
            self._retreat(
                f"{1e3 * press.force:g} mN were not reached within {1e3 * press.travel:g} mm"
            )
        elif self.force > t.most_force * press.force + press.tolerance:
            self._retreat(f"it presses with {1e3 * self.force:.0f} mN")
        elif self._held_back(gone) > t.most_force * press.force * compliance + t.held_back:
            self._retreat("the tip is held back by more than the force that is felt explains")
        else:
            rate = compliance * missing / t.time
            limit = press.speed
            self._shift = max(0.0, self._shift + float(np.clip(rate, -limit, limit)) * elapsed)
        if self.force > press.force / 2 and not self._touched:
            self._touched = True
            self._tell("touch", f"something is felt, after {1e3 * gone:.1f} mm")
        if self._within >= t.settled and not self._why:
            self._why = "held"
            self._tell("pressing", f"presses with {1e3 * self.force:.0f} mN")

    def _held_back(self, gone: float) -> float:
        """By how much the tip is held back, in m: a bound that needs no estimate of the force."""
        return self._shift - gone

    def _retreat(self, why: str) -> None:
        self.phase, self._why = Phase.RETREATING, why

    def _tell(self, kind: str, text: str) -> None:
        self._told.append(Notice(kind, text, Severity.INFO))

    def notices(self) -> tuple[Notice, ...]:
        """Return what has happened since the last call, and what is wrong."""
        told, self._told = tuple(self._told), []
        if self.phase in (Phase.RETREATING, Phase.ENDED):
            text = f"{self._why}; the tip goes back to where it began, until there is a new task"
            return (*told, Notice("press-failed", text, standing=True))
        if self.phase is Phase.PRESSING and self._off > self._tuning.patience:
            text = (
                f"the tip presses with {1e3 * self.force:.0f} mN instead of "
                f"{1e3 * self.press.force:g} mN"
            )
            return (*told, Notice("press-force", text, standing=True))
        return told
