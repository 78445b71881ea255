"""Which models a calibration may choose from: what is fitted, and which history there is."""

from __future__ import annotations

from dataclasses import dataclass

from stiffopt.model.description import Compensation, Corrections, RobotDescription, Segment
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.laws import law_class

__all__ = ["STRUCTURES", "Structure"]

_LAG = 0.3  # s, where the robot file does not say
_DEAD_TIME = 0.05  # s
_WIDTHS = (0.05, 0.12, 0.24, 0.46)  # of plays, as shares of the highest pressure that was seen
_SHARE = 0.05  # of each play, to begin with
_CREEP_TIMES = (2.0, 20.0)  # s
_CREEP_SHARE = 0.02  # to begin with
_BENDS_TO = 0.6  # least bending radius over the length of a segment
_DEAD_BAND = 0.05  # of the highest pressure that was seen


@dataclass(frozen=True)
class Structure:
    """A model that a calibration may choose.

    Attributes
    ----------
    name : for people and the command line.
    words : what it has, in words.
    shape : names of the parameters of each segment's equilibrium that are fitted.
    lag, falling, play, memory, creep : whether its history has them; a lag comes with a dead time
        where the logs are fine enough to tell the two apart.
    strain_law : of all segments; empty for the robot file's.
    as_given : its history is that of the robot file.
    after : names of simpler ones; it is tried only if one of them is the best so far.
    """

    name: str
    words: str
    shape: tuple[str, ...]
    lag: bool = False
    falling: bool = False
    play: bool = False
    memory: bool = False
    creep: bool = False
    strain_law: str = ""
    as_given: bool = False
    after: tuple[str, ...] = ()

    def applied(
        self, description: RobotDescription, seen: float, fine: bool = True
    ) -> RobotDescription:
        """The robot from which the fit of this structure begins.

        Parameters
        ----------
        description : RobotDescription
            Where it already has what the structure has, that is where the fit begins.
        seen : float
            Highest pressure that was recorded, in Pa.
        fine : bool
            Whether the logs can tell a dead time from a lag.
        """
        segments = tuple(self._segment(segment, seen, fine) for segment in description.segments)
        return description.model_copy(update={"segments": segments, "calibration": None})

    def _segment(self, segment: Segment, seen: float, fine: bool) -> Segment:
        update: dict[str, object] = {"history": self._history(segment, seen, fine)}
        if self.strain_law and self.strain_law != segment.strain_law:
            keys = law_class(self.strain_law).Keys
            update |= {"strain_law": self.strain_law, "law": keys() if keys is not None else None}
        given = segment.compensation or Compensation()
        if not given.modulus_per_pressure:  # a robot file that softens says how
            given = given.model_copy(update={"modulus_law": "exponential"})
        if "compensation.bending_radius" in self.shape:
            radius = given.bending_radius or _BENDS_TO * segment.length
            given = given.model_copy(update={"bending_radius": radius})
        update["compensation"] = given
        corrections = segment.corrections or Corrections()
        if "corrections.dead_band" in self.shape:
            band = corrections.dead_band or _DEAD_BAND * seen
            corrections = corrections.model_copy(update={"dead_band": band})
        update["corrections"] = corrections
        return segment.model_copy(update=update)

    def _history(self, segment: Segment, seen: float, fine: bool) -> History | None:
        if self.as_given:
            return segment.history
        given = segment.history or History()
        if not (self.lag or self.play):
            return None
        plays = given.play or tuple(Play(width=w * seen, share=_SHARE) for w in _WIDTHS)
        creeps = given.creep or tuple(Creep(time=time, share=_CREEP_SHARE) for time in _CREEP_TIMES)
        return History(
            dead_time=(given.dead_time or _DEAD_TIME) if self.lag and fine else 0.0,
            lag=(given.lag or _LAG) if self.lag else 0.0,
            lag_falling=(given.lag_falling or given.lag or _LAG) if self.falling else 0.0,
            memory=(given.memory or (1.0,) * segment.n_channels) if self.memory else (),
            play=plays if self.play else (),
            creep=creeps if self.creep else (),
        )


_BASIC = (
    "length",
    "material.youngs_modulus",
    "compensation.area",
    "compensation.stiffness",
    "corrections.gain",
    "corrections.offset",
    "corrections.azimuth",
    "compensation.modulus_per_pressure",
)
_PROGRESSIVE = (
    *_BASIC,
    "corrections.dead_band",
    "compensation.bending_radius",
    "compensation.lengthening",
)

STRUCTURES = (
    Structure("static", "no history", _BASIC),
    Structure("lag", "a first-order lag", _BASIC, lag=True),
    Structure("hysteresis", "lag and play", _BASIC, lag=True, play=True),
    Structure("creep", "lag, play and creep", _BASIC, lag=True, play=True, creep=True),
    Structure(
        "progressive",
        "lag and play; a dead band, and bending that stiffens and lengthens",
        _PROGRESSIVE,
        lag=True,
        play=True,
    ),
    Structure(
        "progressive-creep",
        "lag, play and creep; a dead band, and bending that stiffens and lengthens",
        _PROGRESSIVE,
        lag=True,
        play=True,
        after=("creep", "progressive"),
        creep=True,
    ),
    Structure(
        "channel-hysteresis",
        "lags when rising and falling, and play of each channel's own",
        _BASIC,
        lag=True,
        falling=True,
        play=True,
        memory=True,
    ),
)
"""Those with the fewest numbers first."""
