"""Slow changes to other pressures for the same target: to another configuration, or a stiffer one.

On the straight line to them the tip would leave its target by millimetres, and by more in a quick
change, as feedback needs time for an offset that differs between them. So each plan is near the
last one and at the target, and leads the offset, which changes steadily on the way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.nearest_search import NearestSearch
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.tuning import FeedbackTuning, PlanningTuning
from stiffopt.optimise.target import Target
from stiffopt.optimise.tip import TipModel


@dataclass(frozen=True)
class _ChangeUnderWay:
    """A change under way."""

    end: Array  # effective (n,), in Pa
    tip_first: tuple[float, ...] = ()  # see `Plan`
    plans: int = 0  # that have been made on it
    over: bool = False  # whether the end has been reached
    drift: Array = field(default_factory=lambda: np.zeros(6))  # of the offset from plan to plan
    stays: bool = True  # whether the target is that of the last plan
    left: float = math.inf  # least rest of the way so far, as the tip's motion by one channel, in m
    stalled: int = 0  # successive plans that came no nearer
    is_direct: bool = False  # whether it has no way but that of the reference to its end
    straight: bool = False  # whether plans lead straight to the end, as no other way was found


class PostureChanges:
    """The change of posture that a planner has under way, if there is one.

    Parameters
    ----------
    tip : the model of the tip.
    search : finds pressures at a target.
    tuning : speed of a change, and when it ends.
    """

    def __init__(self, tip: TipModel, search: NearestSearch, tuning: PlanningTuning) -> None:
        self._tuning = tuning
        self._change: _ChangeUnderWay | None = None
        self.use(tip, search)

    def use(self, tip: TipModel, search: NearestSearch) -> None:
        """Go on with another model."""
        self._tip, self._search = tip, search

    def begin(self, end: Array, tip_first: tuple[float, ...] = ()) -> None:
        """Begin a change to pressures (n,), in Pa; `tip_first` is that of its plans."""
        self._change = _ChangeUnderWay(end, tip_first, is_direct=tip_first == tuple(end.tolist()))

    def end(self) -> None:
        """End the change, wherever it is."""
        self._change = None

    @property
    def to(self) -> Array | None:
        """Pressures (n,), in Pa, to which the change leads; None without a change."""
        return None if self._change is None else self._change.end

    @property
    def leaves_target(self) -> bool:
        """Whether the change goes straight to its end, so that the tip may leave its target."""
        return self._change is not None and self._change.straight

    @property
    def tip_first(self) -> tuple[float, ...]:
        """Pressures of the change at which the tip was at its target first; empty otherwise."""
        return () if self._change is None else self._change.tip_first

    def way_on(
        self, target: Target, limits: tuple[Array, Array], begin: Array, end: Array
    ) -> list[Array]:
        """Return pressures (n,) on a way from some to others that stays at the target.

        The way is looked for in a few steps, each to the point of the target that is next to a
        share of the rest. If there is none, one of the steps is a jump; then nothing is returned.
        """
        count, way = self._tuning.change_looks, [begin]
        longest = self._tuning.change_jump * self._motion(begin, end - begin) / count
        for rest in range(count, 0, -1):
            here = way[-1]
            way.append(self._search.find(target, limits, here + (end - here) / rest)[0])
            if self._motion(here, way[-1] - here) > longest:
                return []
        return way[:-1]

    def _motion(self, here: Array, change: Array) -> float:
        """Return how far a change of pressures (n,) moves the tip by one channel at most, in m."""
        moved = self._tip.at(here).jacobian[:3] * change
        return float(np.linalg.norm(moved, axis=0).max())

    def note(self, request: PlanRequest, last: Plan) -> None:
        """Take in by how much the offset has changed since the last plan."""
        change = self._change
        if change is None:
            return
        stays = last.target == request.target
        moved = request.offset - last.offset if stays and not change.over else np.zeros(6)
        drift = change.drift + self._tuning.drift_share * (moved - change.drift)
        self._change = replace(change, drift=drift, stays=stays)

    @property
    def lead(self) -> Array:
        """By how much (6,) the offset changes until feedback has followed it.

        On the way it changes steadily, and feedback is late by some plans. The lead begins later
        than the way: at first, plans still follow the offset of the motion before. At the end of
        the way it fades, and there is none where the target has just moved.
        """
        change, tuning = self._change, self._tuning
        if change is None or not change.stays:
            return np.zeros(6)
        growth = min(1.0, max(0.0, change.plans / tuning.change_growth - 0.5))
        lead: Array = tuning.lead * growth * change.drift
        angle = FeedbackTuning().lever * np.linalg.norm(lead[3:])
        size = float(max(np.linalg.norm(lead[:3]), angle))
        return lead * min(1.0, tuning.longest_lead / max(size, 1e-9))

    def next(
        self,
        request: PlanRequest,
        last: Plan,
        end: Array,
        target: Target,
        limits: tuple[Array, Array],
    ) -> Array:
        """Return the next pressures (n,) on the way to others (n,), in Pa.

        The change is slower while the offset changes. If the way comes no nearer to its end, or
        the tip is not at its target there, the arm soon goes straight to the end, as slowly.
        """
        change, tuning, way = self._change, self._tuning, end - last.pressures
        assert change is not None  # there is a change under way
        left = self._motion(last.pressures, way)
        drift = float(np.linalg.norm((request.offset - last.offset)[:3]))
        step = tuning.change_step * min(1.0, (change.plans + 1) / tuning.change_growth)
        step *= min(1.0, tuning.at_rest / max(drift, 1e-9))
        straight_on = last.pressures + min(1.0, step / max(left, 1e-9)) * way
        is_moved, at_target, is_there = last.target != request.target, straight_on, True
        if left > step and (is_moved or not change.straight):
            at_target, is_there = self._search.reaches(target, limits, straight_on)
        goes_on = is_there and left < change.left - tuning.change_progress * step
        if is_there and (is_moved or left > change.left + step):  # another way
            goes_on, change = True, replace(change, straight=False)
        stalled = 0 if goes_on or left <= step else change.stalled + (drift <= tuning.at_rest)
        change = replace(
            change,
            end=end,
            plans=change.plans + 1,
            left=left if goes_on else change.left,
            stalled=stalled,
            straight=change.straight or stalled > tuning.patience,
            over=change.over or left <= step,
        )
        is_over = left <= step and float(np.linalg.norm(change.drift[:3])) < tuning.at_rest / 10
        if is_over and change.is_direct:
            is_over = self._motion(request.here, end - request.here) <= tuning.change_step
        self._change = None if is_over else change
        if left <= step:
            return end
        return np.asarray(np.clip(straight_on, *limits)) if self.leaves_target else at_target
