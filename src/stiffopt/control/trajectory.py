"""Trajectories: where the tip shall be, and when."""

from __future__ import annotations

import itertools
from typing import Annotated

from pydantic import Field, model_validator

from stiffopt.optimise.target import Target
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration

__all__ = ["Trajectory", "Waypoint"]


class Waypoint(Schema):
    """A target and when to be there.

    Attributes
    ----------
    time : since the beginning of the trajectory, in s.
    target : the pose.
    """

    time: Annotated[Duration, Field(ge=0)]
    target: Target


class Trajectory(Schema):
    """Waypoints, through which the tip goes smoothly.

    Attributes
    ----------
    waypoints : in order of time; all ask for the same kinds of things (the same axes).
    """

    waypoints: Items[Waypoint]

    @model_validator(mode="after")
    def _check(self) -> Trajectory:
        if not self.waypoints:
            raise ValueError("has no waypoints")
        times = [w.time for w in self.waypoints]
        for before, after in itertools.pairwise(times):
            if after <= before:
                raise ValueError(
                    f"waypoints must be in order of time; {after:g} s follows {before:g} s"
                )
        kinds = {_kind(w.target) for w in self.waypoints}
        if len(kinds) > 1:
            raise ValueError("all waypoints must ask for the same axes of the pose")
        return self

    @property
    def duration(self) -> float:
        """Time of the last waypoint, in s."""
        return self.waypoints[-1].time


def _kind(target: Target) -> tuple[object, ...]:
    axes = None if target.position is None else tuple(v is None for v in target.position)
    return axes, target.pointing is None, target.orientation is None
