"""The model structures that calibration compares, and the choice of the one that predicts best.

Models are compared by their errors in logs, or parts of logs, to which they were not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.identify.error_model import HeldBack
from stiffopt.identify.fit import Fit
from stiffopt.identify.folds import is_region
from stiffopt.identify.recording import Recording
from stiffopt.identify.results import Errors
from stiffopt.identify.settings import CHOICE, START
from stiffopt.model.actuation import StrainLaw
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.laws import law_class, strain_laws
from stiffopt.model.segment import Compensation, Corrections, Segment


@dataclass(frozen=True)
class ModelStructure:
    """A model that calibration may choose: the numbers it fits and the history of its segments.

    Attributes
    ----------
    name : for reports and the command line.
    words : the model's description, for reports.
    shape : keys of a segment, without indices, that are fitted and affect its equilibria.
    lag, falling, play, elongation, memory, creep : which parts the history has. A lag comes with a
        dead time if the logs are sampled finely enough to distinguish them; `elongation` is play
        that acts on the mean pressure alone.
    strain : whether lag, play and creep follow strains, and play also that of opposite fibres.
    strain_law : of all segments; empty for that of the robot file.
    as_given : whether to take the history from the robot file.
    after : names of simpler models; this one is tried only if one of them is the best so far.
    """

    name: str
    words: str
    shape: tuple[str, ...]
    lag: bool = False
    falling: bool = False
    play: bool = False
    elongation: bool = False
    memory: bool = False
    creep: bool = False
    strain: bool = False
    strain_law: str = ""
    as_given: bool = False
    after: tuple[str, ...] = ()

    def applied(
        self, description: RobotDescription, seen: float, fine: bool = True
    ) -> RobotDescription:
        """Return the robot from which the fit of this structure begins.

        Parameters
        ----------
        description : parts of the structure that it already has keep their values.
        seen : highest recorded pressure, in Pa.
        fine : whether the logs can distinguish a dead time from a lag.
        """
        segments = tuple(self._segment(segment, seen, fine) for segment in description.segments)
        return description.model_copy(update={"segments": segments, "calibration": None})

    def of_strain(self) -> ModelStructure:
        """Return the same structure with a memory of strain."""
        name, words = f"{self.name}, strain", f"{self.words}; a memory of the fibres' strain"
        return replace(self, name=name, words=words, strain=True)

    def is_possible(self, description: RobotDescription) -> bool:
        """Whether the robot can have this structure: a dead band needs pressures above zero."""
        return "corrections.dead_band" not in self.shape or min(description.pressure_min) >= 0

    def can_be_told(self, recordings: Sequence[Recording]) -> bool:
        """Whether the recordings can identify this structure.

        Creep needs pressures that are held for a while. Where they always move, a fit confuses
        creep with amplitude, and predicts other logs worse than without it.
        """
        return not self.creep or _held(recordings) > CHOICE.held

    def _segment(self, segment: Segment, seen: float, fine: bool) -> Segment:
        update: dict[str, object] = {"history": self._history(segment, seen, fine)}
        if self.strain_law and self.strain_law != segment.strain_law:
            keys = law_class(self.strain_law).Keys
            update |= {"strain_law": self.strain_law, "law": keys() if keys is not None else None}
        given = segment.compensation or Compensation()
        if not given.modulus_per_pressure:  # a robot file with softening also names its law
            given = given.model_copy(update={"modulus_law": "exponential"})
        if "compensation.bending_radius" in self.shape:
            radius = given.bending_radius or START.bending_radius * segment.length
            given = given.model_copy(update={"bending_radius": radius})
        update["compensation"] = given
        corrections = segment.corrections or Corrections()
        if "corrections.dead_band" in self.shape:
            band = corrections.dead_band or START.dead_band * seen
            corrections = corrections.model_copy(update={"dead_band": band})
        update["corrections"] = corrections
        return segment.model_copy(update=update)

    def _history(self, segment: Segment, seen: float, fine: bool) -> History | None:
        if self.as_given:
            return segment.history
        given = segment.history or History()
        if not (self.lag or self.play):
            return None
        plays = given.play or tuple(
            Play(width=w * seen, share=START.play_share) for w in START.play_widths
        )
        if self.elongation and all(play.of == "pressure" for play in plays):
            width = START.elongation_width * seen
            plays += (Play(width=width, share=START.play_share, of="elongation"),)
        if self.strain and all(play.of != "opposite" for play in plays):
            own = (play for play in plays if play.of == "pressure")
            plays += tuple(play.model_copy(update={"of": "opposite"}) for play in own)
        creeps = given.creep or tuple(
            Creep(time=time, share=START.creep_share) for time in START.creep_times
        )
        return History(
            softening=_softening(segment) if self.creep else 0.0,  # else play stands for creep
            remembers="strain" if self.strain else given.remembers,
            dead_time=(given.dead_time or START.dead_time) if self.lag and fine else 0.0,
            lag=(given.lag or START.lag) if self.lag else 0.0,
            lag_falling=(given.lag_falling or given.lag or START.lag) if self.falling else 0.0,
            memory=(given.memory or (1.0,) * segment.n_channels) if self.memory else (),
            play=plays if self.play else (),
            creep=creeps if self.creep else (),
        )


def _softening(segment: Segment) -> float:
    """Return the modulus' relative change per pressure, in 1/Pa; at most 0, and 0 if not linear."""
    known = segment.compensation or Compensation()
    if known.modulus_law != "linear":
        return 0.0
    return min(known.modulus_per_pressure / segment.material.youngs_modulus, 0.0)


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
    ModelStructure("static", "no history", _BASIC),
    ModelStructure("lag", "a first-order lag", _BASIC, lag=True),
    ModelStructure("hysteresis", "lag and play", _BASIC, lag=True, play=True),
    ModelStructure("creep", "lag, play and creep", _BASIC, lag=True, play=True, creep=True),
    ModelStructure(
        "progressive",
        "lags when rising and falling, play; a dead band, and bending that stiffens and lengthens",
        _PROGRESSIVE,
        lag=True,
        falling=True,
        play=True,
    ),
    ModelStructure(
        "progressive-creep",
        "lags when rising and falling, play, creep; a dead band, and bending that stiffens and "
        "lengthens",
        _PROGRESSIVE,
        lag=True,
        falling=True,
        play=True,
        after=("creep", "progressive"),
        creep=True,
    ),
    ModelStructure(
        "channel-hysteresis",
        "lags when rising and falling, and play of each channel's own",
        _BASIC,
        lag=True,
        falling=True,
        play=True,
        memory=True,
    ),
    ModelStructure(
        "elongation-hysteresis",
        "lags when rising and falling, play, more of it in elongation, and creep",
        _BASIC,
        lag=True,
        falling=True,
        play=True,
        elongation=True,
        creep=True,
    ),
)
"""Those with the fewest numbers first."""


def other_laws(description: RobotDescription) -> list[type[StrainLaw]]:
    """Return the other strain laws that all segments of a robot could have, simplest first."""
    own = {segment.strain_law for segment in description.segments}
    if len(own) != 1:
        return []
    found = []
    for name, law in strain_laws().items():
        try:
            for segment in description.segments:
                Segment(**segment.model_dump() | {"strain_law": name, "law": None})
        except InputError:  # the law cannot describe such a segment
            continue
        if name not in own:
            found.append(law)
    return found


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fitted model with its errors on held-back data.

    Attributes
    ----------
    structure : ModelStructure
    fit : to all rows of the trial.
    held_back : results of each fold, by its name.
    """

    structure: ModelStructure
    fit: Fit
    held_back: dict[str, HeldBack] = field(default_factory=dict)

    @property
    def folds(self) -> dict[str, Errors]:
        """Errors of each fold, by its name."""
        return {name: each.errors for name, each in self.held_back.items()}

    @property
    def score(self) -> float:
        """Mean error over the folds, in m."""
        return float(np.mean([errors.mean for errors in self.folds.values()]))


def best(candidates: Sequence[Candidate]) -> Candidate:
    """Return the simplest model that predicts about as well as the best one.

    "About as well" means that the mean error is larger by at most one standard error of the
    difference over the folds, or by the share `ChoiceSettings.no_worse`. This must hold for the
    folds in time and, separately, for those in pressure, whose errors are larger and vary more.

    Parameters
    ----------
    candidates : the simplest first.
    """
    leader = min(candidates, key=lambda candidate: candidate.score)
    beyond = np.array([is_region(name) for name in leader.folds])
    groups = [rows for rows in (~beyond, beyond) if rows.any()]
    reference = _means(leader)
    for candidate in candidates:  # the simplest first
        means = _means(candidate)
        if all(_no_worse(means[rows], reference[rows]) for rows in groups):
            return candidate
    return leader


def _means(candidate: Candidate) -> Array:
    return np.array([errors.mean for errors in candidate.folds.values()])


def _no_worse(means: Array, reference: Array) -> bool:
    """Whether errors (k,) are not clearly larger than the reference (k,)."""
    worse = means - reference
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
    return bool(worse.mean() <= max(error, CHOICE.no_worse * reference.mean()))


def _held(recordings: Sequence[Recording]) -> float:
    """Return the share of the time in which no pressure had changed for `CHOICE.held_for`."""
    held = total = 0.0
    for recording in recordings:
        range_of = np.ptp(recording.pressures, axis=0).max() or 1.0
        change = (
            np.abs(np.diff(recording.pressures, axis=0)).max(axis=1) > CHOICE.held_still * range_of
        )
        moves = np.concatenate([[recording.time[0]], recording.time[1:][change]])
        last = moves[np.searchsorted(moves, recording.time, side="right") - 1]
        steps = np.diff(recording.time, append=recording.time[-1])
        held += float(steps[recording.time - last > CHOICE.held_for].sum())
        total += float(steps.sum())
    return held / total if total else 0.0
