"""Errors that all channels or all axes of recordings may have, and how well each explains them.

Turned axes of the tracker, a wrong order of channels, and dead or shared lines are hypotheses. Each
is scored by how well the robot file's arm then follows the tip, when it may be softer or stiffer,
scaled and moved a little. (A fit cannot judge this: with enough numbers it also follows a wrong
recording.) Where the evidence is not overwhelming, none is accepted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, FileError, PressureError
from stiffopt.identify.detection import lagged_pressures, weightless
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.settings import DETECTION, Finding
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS, whole
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.manipulator import Manipulator


@dataclass(frozen=True)
class Hypothesis:
    """A possible error in the recordings, and its correction.

    Attributes
    ----------
    kind : see `Finding`; None for "no error".
    words : the error of a line, in words.
    sources : (n,), for each channel, the channel (from 0) whose column has its pressures; -1 for a
        dead line.
    turns : for each recording, the index in `CUBE_ROTATIONS` by which its axes are turned.
    """

    kind: Finding | None
    words: str
    sources: tuple[int, ...]
    turns: tuple[int, ...]

    def applied(self, recordings: Sequence[Recording], low: Array) -> list[Recording]:
        """Return the corrected recordings; `low` (n,) is the pressure of a dead line."""
        found = []
        for each, turn in zip(recordings, self.turns, strict=True):
            pressures = self.driven(each.pressures, low)
            before = self.driven(each.before[np.newaxis], low)[0]
            tracks = moved(each.tracks, CUBE_ROTATIONS[turn], np.zeros(3))
            found.append(replace(each, pressures=pressures, before=before, tracks=tracks))
        return found

    def driven(self, recorded: Array, low: Array) -> Array:
        """Return the channels' pressures (N, n) from the recorded ones."""
        return _driven(recorded, self.sources, low)

    def with_turns(self, turn: int) -> Hypothesis:
        """Return the hypothesis with the same turn of the axes for all recordings."""
        return replace(self, turns=(turn,) * len(self.turns))

    @property
    def wrong(self) -> dict[int, int]:
        """Sources of the channels (from 0) that do not have their own column."""
        return {k: source for k, source in enumerate(self.sources) if source != k}

    def with_lines(self, other: Hypothesis) -> Hypothesis | None:
        """Return the hypothesis with the wrong lines of another one.

        None if they are about the same line, or if a line is shared with a wrong one.
        """
        own, others = self.wrong, other.wrong
        if own.keys() & {*others, *others.values()} or others.keys() & set(own.values()):
            return None
        sources = tuple({**own, **others}.get(k, k) for k in range(len(self.sources)))
        return replace(self, words=f"{self.words}, and {other.words}", sources=sources)

    def with_order(self, other: Hypothesis) -> Hypothesis | None:
        """Return the hypothesis with the order of another one after it; None if that is none."""
        sources = tuple(self.sources[k] for k in other.sources)
        return None if sources == tuple(range(len(sources))) else replace(self, sources=sources)

    def told(self, description: RobotDescription, names: Sequence[str]) -> str:
        """Describe the error, as the beginning of a sentence."""
        name = description.channel_name
        if self.kind == "channels":
            order = ", ".join(
                f"{name(k)} has the column of {name(source)}" for k, source in self.wrong.items()
            )
            return f"the channels are in another order: {order}"
        if self.kind == "lines":
            return self.words
        turned = {
            name: turn_text(CUBE_ROTATIONS[turn])
            for name, turn in zip(names, self.turns, strict=True)
            if turn
        }
        if len(set(self.turns)) == 1:
            return f"the tracker's axes are turned in all logs, {next(iter(turned.values()))}"
        return "the axes of the frame are turned: " + ", ".join(
            f"{name} {text}" for name, text in turned.items()
        )


def _driven(recorded: Array, sources: Sequence[int], low: Array) -> Array:
    """Return the channels' pressures (N, n) from the recorded ones, by `Hypothesis.sources`."""
    columns = [
        np.full(len(recorded), low[k]) if source < 0 else recorded[:, source]
        for k, source in enumerate(sources)
    ]
    return np.column_stack(columns)


def moved(tracks: Sequence[Track], rotation: Array, shift: Array) -> tuple[Track, ...]:
    """Rotate (3, 3) poses about the origin of their frame, and shift them (3,)."""
    return tuple(
        Track(
            track.name,
            track.position @ rotation.T + shift,
            None if track.rotation is None else rotation @ track.rotation,
        )
        for track in tracks
    )


def rows_with_all(
    recording: Recording, seen: Sequence[NDArray[np.bool_]], count: int
) -> NDArray[np.intp]:
    """Return about `count` evenly spread rows of a recording, in which each track is `seen` (N,).

    Raises
    ------
    FileError
        If there is none.
    """
    rows = np.flatnonzero(np.logical_and.reduce(seen))
    if not len(rows):
        names = ", ".join(track.name for track in recording.tracks)
        raise FileError(
            recording.name,
            f"no row has readings of all tracked points ({names}); leave out this log, or the body "
            "in the robot file",
        )
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).astype(int))]


class Comparer:
    """Scores hypotheses by the robot file's arm, with free softness, scale and turn about z.

    Parameters
    ----------
    description : RobotDescription
        Its history is ignored.
    base : pose (4, 4) of the base in the recordings' frame, according to the robot file.
    stations : arc lengths in m of the tracks, the tip first.
    recordings : sequence of Recording
    """

    def __init__(
        self,
        description: RobotDescription,
        base: Array,
        stations: Sequence[float],
        recordings: Sequence[Recording],
    ) -> None:
        self.nothing = _no_error(description, len(recordings))
        self._given = description, base, stations, recordings
        self._arm = Manipulator(description.model_copy(update={"calibration": None}))
        self._stations = np.array(stations)
        self.low = np.maximum(description.pressure_min, 0.0)
        tolerances = description.tolerances or Tolerances()
        self.any_turn = not tolerances.has_known_turn
        to_base = np.linalg.inv(base)
        self._pressures: list[Array] = []
        self._measured: list[Array] = []
        count = max(DETECTION.rows // len(recordings), 8)
        for each in recordings:
            rows = rows_with_all(each, [whole(t.position) for t in each.tracks], count)
            self._pressures.append(
                lagged_pressures(each.time, each.pressures, DETECTION.clock_lag)[rows]
            )
            self._measured.append(np.stack([t.position[rows] for t in each.tracks], axis=1))
        self._from_frame = to_base[:3, :3], to_base[:3, 3]
        self._kept: dict[tuple[int, ...], list[list[Array]]] = {}
        self._softness = self._possible()

    def score(self, hypothesis: Hypothesis) -> float:
        """Return the RMS distance in m between the tracks and the best matching arm.

        Infinite if the arm does not bear the pressures.
        """
        measured = [
            self._in_base(each, CUBE_ROTATIONS[turn])
            for each, turn in zip(self._measured, hypothesis.turns, strict=True)
        ]
        scores = (
            float(
                np.sqrt(np.mean([self._square(m, q) for m, q in zip(measured, each, strict=True)]))
            )
            for each in self._predicted(hypothesis.sources)
        )
        return min(scores, default=np.inf)

    def distinct(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the first of the hypotheses of a kind that give the arm the same pressures."""
        found: dict[object, Hypothesis] = {}
        for each in hypotheses:
            driven = [_driven(p, each.sources, self.low).tobytes() for p in self._pressures]
            found.setdefault((each.kind, *driven), each)
        return list(found.values())

    def shortlist(self, hypotheses: Sequence[Hypothesis]) -> Sequence[Hypothesis]:
        """Return the hypotheses that are best without weight, which takes far less time; else all.

        Without it, the right one of a heavy arm is among the best, though it leaves much.
        """
        if self._light is self:
            return hypotheses
        return self.ranked(hypotheses)[: DETECTION.shortlist]

    def ranked(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the hypotheses, the one first that is best without weight."""
        return sorted(hypotheses, key=self._light.score)

    @cached_property
    def _light(self) -> Comparer:
        """Compares with the arm without its weight."""
        description, base, stations, recordings = self._given
        if not any(description.gravity):
            return self
        return Comparer(weightless(description), base, stations, recordings)

    def of_turns(self, sources: tuple[int, ...]) -> Array:
        """Return the RMS distance (logs, 24) of each recording under each rotation of its axes."""
        turned = [
            [self._in_base(m, rotation) for rotation in CUBE_ROTATIONS] for m in self._measured
        ]
        found = [
            np.array(
                [[self._square(m, q) for m in log] for log, q in zip(turned, each, strict=True)]
            )
            for each in self._predicted(sources)
        ]
        return np.asarray(np.sqrt(min(found, key=lambda squares: float(squares.min(axis=1).sum()))))

    def _in_base(self, positions: Array, turn: Array) -> Array:
        rotation, origin = self._from_frame
        return np.asarray(positions @ turn.T @ rotation.T + origin)

    def _possible(self) -> list[float]:
        """Return the factors on pressures with which the arm does not move much farther than seen.

        Equilibria of an arm that is far too soft under its weight would take most of the time.
        """
        most = DETECTION.farther * _spread(self._measured)
        found: list[float] = []
        for factor in sorted(DETECTION.softness):
            predicted = self._positions([factor * each for each in self._pressures])
            if predicted is None or (found and _spread(predicted) > most):
                break
            found.append(factor)
        return found

    def _predicted(self, sources: tuple[int, ...]) -> list[list[Array]]:
        """Return predicted tracks (N, k, 3) of each recording, per softness that the law allows."""
        if sources not in self._kept:
            driven = [_driven(each, sources, self.low) for each in self._pressures]
            self._kept[sources] = [
                found
                for factor in self._softness
                if (found := self._positions([factor * each for each in driven])) is not None
            ]
        return self._kept[sources]

    def _positions(self, pressures: Sequence[Array]) -> list[Array] | None:
        try:
            return [self._arm.pose(p, self._stations)[:, :, :3, 3].copy() for p in pressures]
        except (EquilibriumError, PressureError):
            return None

    def _square(self, measured: Array, predicted: Array) -> float:
        """Return the mean square between tracks (N, k, 3) after scaling, turning and moving."""
        lateral = [
            (m[:, 0] + 1j * m[:, 1], q[:, 0] + 1j * q[:, 1])
            for m, q in zip(measured.swapaxes(0, 1), predicted.swapaxes(0, 1), strict=True)
        ]
        factor = _factor(lateral)
        factor = factor if self.any_turn else complex(max(factor.real, 0.0))
        total = 0.0
        for k, (m, q) in enumerate(lateral):
            rest = m - factor * q
            up, along = measured[:, k, 2], predicted[:, k, 2]
            slope = _slope(along, up)
            high = up - slope * (along - along.mean()) - along.mean()
            moved = np.array([rest.real.mean(), rest.imag.mean(), high.mean()])
            far = max(float(np.linalg.norm(moved)), 1e-9)
            moved *= min(1.0, DETECTION.moved * self._arm.length / far)
            total += float(np.mean(np.abs(rest - moved[0] - 1j * moved[1]) ** 2))
            total += float(np.mean((high - moved[2]) ** 2))
        return total / len(lateral)


def _spread(tracks: Sequence[Array]) -> float:
    """Return the RMS distance of tracks (N, k, 3) of several logs from their mean."""
    return float(np.linalg.norm(np.concatenate(tracks).std(axis=0)))


def _factor(pairs: Sequence[tuple[NDArray[np.complex128], NDArray[np.complex128]]]) -> complex:
    """Return the complex factor that best turns and scales the second of each pair to the first."""
    over = sum(np.vdot(q - q.mean(), m - m.mean()) for m, q in pairs)
    under = sum(float(np.vdot(q - q.mean(), q - q.mean()).real) for _, q in pairs)
    return complex(over / under) if under > 0 else 1.0 + 0j


def _slope(x: Array, y: Array) -> float:
    """Return the regression slope of y over x, at least zero."""
    centred = x - x.mean()
    under = float(centred @ centred)
    return max(float(centred @ y) / under, 0.0) if under > 0 else 0.0


@dataclass(frozen=True)
class Found:
    """The accepted hypothesis, with the scores in m without it (`as_is`) and with it (`then`)."""

    hypothesis: Hypothesis
    as_is: float
    then: float


def found_wrong(
    comparer: Comparer, description: RobotDescription, keep: Sequence[str]
) -> Found | None:
    """Return the error of a comparer's recordings; None if there is none or it is unclear which.

    A hypothesis must leave a small share of the misfit, and clearly less than any other kind. If
    none leaves so little, pairs of them are tried, since each alone may leave much. There are so
    many that one of them often fits better by chance: they are measured by the best single one.
    """
    nothing = comparer.nothing
    as_is = comparer.score(nothing)
    if not np.isfinite(as_is):
        return None

    def scored(tried: Sequence[Hypothesis]) -> list[tuple[float, Hypothesis]]:
        return [(comparer.score(each), each) for each in comparer.shortlist(tried)]

    single = comparer.distinct(of_channels(description, len(nothing.turns)))
    single = [each for each in single if each.kind not in keep]
    alone = scored(single)
    found = [pair for pair in alone if pair[0] <= DETECTION.overwhelming * as_is]
    if "axes" not in keep:
        turns = _turns(comparer.of_turns(nothing.sources))
        if any(turns):
            turned = replace(nothing, kind="axes", turns=turns)
            found.append((comparer.score(turned), turned))
    if not found:
        least = min([as_is, *(score for score, _ in alone)])
        two = scored(comparer.distinct(pairs(comparer.ranked(single), DETECTION.shortlist)))
        found = [pair for pair in two if pair[0] <= DETECTION.overwhelming * least]
    if not found:
        return None
    then, best = min(found, key=lambda pair: pair[0])
    rivals = [pair[0] for pair in found if not _alike(pair[1], best)]
    if any(then > DETECTION.tie * each for each in rivals):
        return None
    return Found(best, as_is, then)


def pairs(ranked: Sequence[Hypothesis], good: int) -> list[Hypothesis]:
    """Return two lines, or two orders one after the other, of which one is among the `good` best.

    `ranked` are single ones, the best first.
    """
    known, found = {each.sources for each in ranked}, []
    for kind in ("lines", "channels"):
        alone = [each for each in ranked if each.kind == kind]
        for one, other in product(alone[:good], alone):
            both = one.with_lines(other) if kind == "lines" else one.with_order(other)
            if both is not None and both.sources not in known:
                known.add(both.sources)
                found.append(both)
    return found


def best_lines(comparer: Comparer, description: RobotDescription, channel: int) -> str:
    """Name the two best hypotheses of the line of a channel, as the end of a sentence.

    Empty if the arm does not bear the pressures under its weight.
    """
    nothing = comparer.nothing
    as_is = comparer.score(nothing)
    if not np.isfinite(as_is):
        return ""
    ranked = sorted(
        (comparer.score(each) / as_is, each.words)
        for each in _lines(description, nothing)
        if each.sources[channel] != channel
    )
    best = " and ".join(f"{share * 100:.0f} % if {words}" for share, words in ranked[:2])
    return f"; the robot file's arm leaves {best}"


def _alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Return True if two hypotheses are the same one, or if both are orders of channels."""
    return one is other or one.kind == other.kind == "channels"


def _no_error(description: RobotDescription, logs: int) -> Hypothesis:
    return Hypothesis(None, "", tuple(range(description.n_pressures)), (0,) * logs)


def of_channels(description: RobotDescription, logs: int) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of wrong lines, and of wrong orders of channels, in all logs."""
    nothing = _no_error(description, logs)
    return *_lines(description, nothing), *_orders(description, nothing)


def _lines(description: RobotDescription, nothing: Hypothesis) -> Iterator[Hypothesis]:
    """Yield hypotheses of a line that is dead, or shared by two channels."""
    name, order = description.channel_name, nothing.sources
    for k in order:
        for source in (-1, *(j for j in order if j != k)):
            words = f"the line of {name(k)} is dead"
            if source >= 0:
                words = f"{name(k)} has the pressure of {name(source)}, as if they shared a line"
            sources = (*order[:k], source, *order[k + 1 :])
            yield replace(nothing, kind="lines", words=words, sources=sources)


def _orders(description: RobotDescription, nothing: Hypothesis) -> Iterator[Hypothesis]:
    """Yield orders with two channels exchanged, and those of a segment or of whole segments.

    Of many channels or segments there are too many orders; then only two are exchanged.
    """
    order, few = nothing.sources, DETECTION.few
    orders = {_exchanged(len(order), i, j) for i in order for j in range(i)}
    ends = np.cumsum([0, *(segment.n_channels for segment in description.segments)]).tolist()
    own = [order[begin:end] for begin, end in pairwise(ends)]
    places = permutations(own) if len(own) <= few else ()
    orders |= {tuple(c for each in place for c in each) for place in places}
    for each in own:
        for other in permutations(each) if len(each) <= few else ():
            orders.add((*order[: each[0]], *other, *order[each[-1] + 1 :]))
    for order in sorted(orders - {nothing.sources}):
        yield replace(nothing, kind="channels", sources=order)


def _exchanged(n: int, i: int, j: int) -> tuple[int, ...]:
    return tuple({i: j, j: i}.get(k, k) for k in range(n))


def _turns(scores: Array) -> tuple[int, ...]:
    """Choose the turn of each log by scores (logs, 24); 0, none, without overwhelming evidence.

    Among turns that explain a log about equally well, it takes the one that suits most logs.
    """
    clear = scores.min(axis=1) <= DETECTION.overwhelming * scores[:, 0]
    near = scores <= scores.min(axis=1, keepdims=True) / DETECTION.tie
    votes = near[clear].sum(axis=0)
    return tuple(
        int(np.argmax(np.where(row, votes, -1))) if is_clear else 0
        for row, is_clear in zip(near, clear, strict=True)
    )


def turn_text(rotation: Array) -> str:
    """Describe a rotation, as the end of a sentence."""
    vector = np.asarray(lie.log(lie.transform(rotation, np.zeros(3))))[3:]
    angle = float(np.linalg.norm(vector))
    axis = ", ".join(f"{each + 0.0:.2g}" for each in np.round(vector / max(angle, 1e-9), 2))
    return f"by {np.degrees(angle):.0f} deg about ({axis})"
