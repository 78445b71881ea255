"""Which models a calibration may choose from: what is fitted, and which history there is."""

from __future__ import annotations

from dataclasses import dataclass

from stiffopt.model.description import RobotDescription, Segment
from stiffopt.model.history import History, Play

__all__ = ["STRUCTURES", "Structure"]

_LAG = 0.3  # s, where the robot file does not say
_DEAD_TIME = 0.1  # s
_WIDTHS = (0.05, 0.13, 0.27, 0.53)  # of plays, as shares of the range of pressures that was seen
_SHARE = 0.05  # of each play, to begin with


@dataclass(frozen=True)
class Structure:
    """A model that a calibration may choose.

    Attributes
    ----------
    name : for people and the command line.
    shape : names of the parameters of each segment's equilibrium that are fitted.
    lag, dead_time, play : whether its history has them.
    """

    name: str
    shape: tuple[str, ...]
    lag: bool = False
    dead_time: bool = False
    play: bool = False

    def applied(self, description: RobotDescription, seen: float) -> RobotDescription:
        """The robot with the history of this structure.

        Parameters
        ----------
        description : RobotDescription
            What its own histories say is where the fit begins.
        seen : float
            Highest pressure that was recorded, in Pa.
        """
        segments = tuple(self._segment(segment, seen) for segment in description.segments)
        return description.model_copy(update={"segments": segments, "calibration": None})

    def _segment(self, segment: Segment, seen: float) -> Segment:
        given = segment.history or History()
        plays = given.play or tuple(Play(width=w * seen, share=_SHARE) for w in _WIDTHS)
        history = History(
            dead_time=(given.dead_time or _DEAD_TIME) if self.dead_time else 0.0,
            lag=(given.lag or _LAG) if self.lag else 0.0,
            play=plays if self.play else (),
        )
        return segment.model_copy(update={"history": history if self.lag or self.play else None})


_BASIC = (
    "length",
    "material.youngs_modulus",
    "compensation.area",
    "corrections.gain",
    "corrections.azimuth",
)
_FULL = (*_BASIC, "compensation.modulus_per_pressure")

STRUCTURES = (
    Structure("static", _BASIC),
    Structure("lag", _BASIC, lag=True),
    Structure("dead-time", _BASIC, lag=True, dead_time=True),
    Structure("hysteresis", _FULL, lag=True, dead_time=True, play=True),
)
"""The simplest first."""
