"""Detect errors in how an arm was recorded, and correct them if the evidence is overwhelming.

Each log is checked for its units of pressure and for different clocks of pressures and tracker.
Turned axes of the tracker, a wrong order of channels, and dead or shared lines are hypotheses about
all logs. A hypothesis is scored by how well the robot file's arm then follows the tip, when it may
be softer or stiffer, scaled and moved a little. (A fit cannot judge this: with enough numbers it
also follows a wrong recording.) Where the evidence is not overwhelming, recordings stay unchanged.
A channel that does nothing is told even then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, PressureError
from stiffopt.identify.discrepancy import smooth_functions
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.settings import DETECTION, SAMPLING, Finding
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS, whole
from stiffopt.model.calibration import distances_from
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.history import lagged
from stiffopt.model.manipulator import Manipulator

SHOWN = 5e-4
"""Shortest translation of a frame that is told, in m."""

# -- clocks ----------------------------------------------------------------------------------------


def on_one_clock(recording: Recording, span: Array) -> Recording:
    """Return the recording with its pressures shifted to the tracker's clock, if clocks differ.

    The tip is regressed on the lagged pressures and their products at many time shifts. Rows far
    from the regression count less, so that neither jumps nor hysteresis hide a wrong shift. The
    best shift is undone if an arm cannot have such a delay itself, and if its mean error is a small
    enough share of that at the best shift that an arm can have.

    Parameters
    ----------
    recording : Recording
    span : range (n,) of the pressures, in Pa.
    """
    time, tip = recording.time, recording.tracks[0].position
    seen = np.flatnonzero(whole(tip))
    rows = seen[np.linspace(0, len(seen) - 1, min(len(seen), DETECTION.clock_rows)).astype(int)]
    followed = lagged_pressures(time, recording.pressures / span, DETECTION.clock_lag)

    def misfits(shifts: Array) -> Array:
        moved = (
            [np.interp(time[rows] - shift, time, column) for column in followed.T]
            for shift in shifts
        )
        return np.array([_unexplained(np.column_stack(each), tip[rows]) for each in moved])

    longest = min(DETECTION.clock_most, DETECTION.clock_share * float(time[-1] - time[0]))
    step = max(2 * float(np.median(np.diff(time))), 0.2)
    usual = misfits(np.linspace(-step, DETECTION.clock_usual, 25)).min()
    coarse = np.linspace(-longest, longest, DETECTION.clock_shifts)
    near = coarse[np.argmin(misfits(coarse))]
    fine = np.linspace(near - coarse[1] + coarse[0], near + coarse[1] - coarse[0], 21)
    found = misfits(fine)
    best, share = float(fine[np.argmin(found)]), float(found.min() / max(usual, 1e-9))
    left = DETECTION.clock_early if best < 0 else DETECTION.clock_late
    if -step <= best <= DETECTION.clock_usual or share > left:
        return recording
    moved = [np.interp(time - best, time, column) for column in recording.pressures.T]
    remark = (
        f"the tip moves {abs(best):.2g} s {'after' if best > 0 else 'before'} its pressures, as if "
        f"they had two clocks: they are moved by that (a regression of the tip on them then misses "
        f"it by {share * 100:.0f} % of what it does otherwise); --keep clock leaves them"
    )
    return replace(
        recording,
        pressures=np.column_stack(moved),
        remarks=(*recording.remarks, remark),
    )


def lagged_pressures(time: Array, pressures: Array, lag: float) -> Array:
    """Return pressures (N, n) behind a lag in s; each acts from the time of the one before."""
    return lagged(time, np.roll(pressures, -1, axis=0), lag, pressures[0])


def _quadratics(pressures: Array) -> Array:
    """Return 1, the pressures (N, n) and their products, side by side."""
    n = pressures.shape[1]
    products = [pressures[:, i] * pressures[:, j] for i in range(n) for j in range(i, n)]
    return np.column_stack([np.ones(len(pressures)), pressures, *products])


def _unexplained(pressures: Array, tip: Array) -> float:
    """Return the mean error, in m, of positions (N, 3) regressed on quadratics of pressures."""
    distances, _ = _regressed(_quadratics(pressures), tip, DETECTION.clock_rounds)
    return float(distances.mean())


def _regressed(known: Array, tip: Array, rounds: int = 1) -> tuple[Array, Array]:
    """Return distances (N,) of positions (N, 3) from a ridge regression, and its coefficients.

    From the second round on, rows count the less the farther they were from the one before.
    """
    weight: Array = np.ones(len(tip))
    coefficients = distances = np.zeros(0)
    for _ in range(rounds):
        weighted = known * weight[:, np.newaxis]
        normal = weighted.T @ known + DETECTION.ridge * np.eye(known.shape[1])
        coefficients = np.asarray(np.linalg.solve(normal, weighted.T @ tip))
        distances = np.asarray(np.linalg.norm(tip - known @ coefficients, axis=1))
        weight = 1 / np.sqrt(1 + (distances / max(float(np.median(distances)), 1e-9)) ** 2)
    return distances, coefficients


# -- the beginning ---------------------------------------------------------------------------------


def begun(recording: Recording, span: Array) -> Recording:
    """Return the recording as one that begins at rest, if its tip is still there in the first row.

    A log without gauges may begin with a commanded step that the arm has yet to follow. The tip is
    regressed on the lagged pressures and their products after the first seconds, and predicted at
    rest and at the first pressures.

    Parameters
    ----------
    recording : Recording
    span : range (n,) of the pressures, in Pa.
    """
    tip, late = recording.tracks[0].position, recording.time > recording.time[0] + DETECTION.begins
    rows = np.flatnonzero(whole(tip) & late)
    at = _quadratics(np.vstack([np.zeros_like(span), recording.before]) / span)
    steps = (np.abs(recording.before) > SAMPLING.rest * span).any()
    if not steps or np.isnan(tip[0]).any() or len(rows) < 2 * at.shape[1]:
        return recording
    known = _quadratics(
        lagged_pressures(recording.time, recording.pressures / span, DETECTION.clock_lag)
    )
    distances, coefficients = _regressed(known[rows], tip[rows])
    rest, first = np.linalg.norm(at @ coefficients - tip[0], axis=1)
    usual = np.median(distances)
    if first < DETECTION.begins_apart * usual or rest > DETECTION.begins_near * usual:
        return recording
    return replace(recording, before=np.zeros_like(recording.before))


# -- a drift ---------------------------------------------------------------------------------------


def without_drift(recording: Recording) -> Recording:
    """Return the recording without a drift of the tip's positions, if it clearly has one.

    Where all parts of a log move through the same pressures, the tip is regressed on smooth
    functions of the lagged pressures, with and without a displacement that is piecewise linear in
    time. If that leaves a small enough share of the error, the displacement is removed. The part of
    the log whose displacement is most like that of the others stays where it is.
    """
    seen = np.flatnonzero(whole(recording.tracks[0].position))
    rows = seen[np.linspace(0, len(seen) - 1, min(len(seen), DETECTION.drift_rows)).astype(int)]
    time, tip = recording.time[rows], recording.tracks[0].position[rows]
    acting = lagged_pressures(recording.time, recording.pressures, DETECTION.clock_lag)[rows]
    ends = np.linspace(time[0], time[-1], DETECTION.drift_parts + 1)
    knots = (ends[1:] + ends[:-1]) / 2
    part = np.searchsorted(ends[1:-1], time)
    near = DETECTION.drift_near * np.ptp(acting, axis=0).max()
    parts = [acting[part == k] for k in np.unique(part)]
    spread = [float(np.linalg.norm(each.std(axis=0))) for each in (acting, *parts)]
    visits = [distances_from((acting.shape[1],), acting, each) <= near for each in parts]
    if min(spread) < DETECTION.drift_spread * spread[0] or (
        np.median(np.mean(visits, axis=0)) < DETECTION.drift_visits
    ):
        return recording
    smooth = np.column_stack([np.ones(len(rows)), smooth_functions(acting)])
    hats = np.column_stack([np.interp(time, knots, hat) for hat in np.eye(len(knots))[1:]])
    without, _ = _regressed(smooth, tip, DETECTION.drift_rounds)
    with_drift, found = _regressed(np.column_stack([smooth, hats]), tip, DETECTION.drift_rounds)
    fixed, left = float(np.median(without)), float(np.median(with_drift))
    if left > DETECTION.drift_left * fixed:
        return recording
    drift = np.vstack([np.zeros(3), found[smooth.shape[1] :]])
    apart = np.linalg.norm(drift[:, np.newaxis] - drift, axis=2)
    drift -= drift[np.median(apart, axis=1).argmin()]
    moved = np.column_stack([np.interp(recording.time, knots, each) for each in drift.T])
    far = np.linalg.norm(drift, axis=1)
    remark = (
        f"the tip's positions drift by up to {far.max() * 1e3:.1f} mm at the same pressures, most "
        f"at {knots[far.argmax()] - knots[0]:.0f} s, as if tracker or mount had moved: this is "
        f"removed (a regression of the tip on pressures then misses it by {left / fixed * 100:.0f} "
        "% of what it does otherwise); --keep drift leaves it"
    )
    tip_track, *others = recording.tracks
    return replace(
        recording,
        tracks=(replace(tip_track, position=tip_track.position - moved), *others),
        remarks=(*recording.remarks, remark),
    )


# -- axes, channels and lines ----------------------------------------------------------------------


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
            driven = replace(each, pressures=pressures, before=before)
            found.append(_moved(driven, CUBE_ROTATIONS[turn], np.zeros(3)))
        return found

    def driven(self, recorded: Array, low: Array) -> Array:
        """Return the channels' pressures (N, n) from the recorded ones."""
        return _driven(recorded, self.sources, low)

    def with_turns(self, turn: int) -> Hypothesis:
        """Return the hypothesis with the same turn of the axes for all recordings."""
        return replace(self, turns=(turn,) * len(self.turns))

    def told(self, description: RobotDescription, names: Sequence[str]) -> str:
        """Describe the error, as the beginning of a sentence."""
        name = description.channel_name
        if self.kind == "channels":
            order = ", ".join(
                f"{name(k)} has the column of {name(source)}"
                for k, source in enumerate(self.sources)
                if k != source
            )
            return f"the channels are in another order: {order}"
        if self.kind == "lines":
            return self.words
        turned = {
            name: _turn_text(CUBE_ROTATIONS[turn])
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


def _moved(recording: Recording, rotation: Array, shift: Array) -> Recording:
    """Rotate (3, 3) a recording's poses about the origin of its frame, and shift them (3,)."""
    tracks = tuple(
        Track(
            track.name,
            track.position @ rotation.T + shift,
            None if track.rotation is None else rotation @ track.rotation,
        )
        for track in recording.tracks
    )
    return replace(recording, tracks=tracks)


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
            seen = np.flatnonzero(np.logical_and.reduce([whole(t.position) for t in each.tracks]))
            rows = seen[np.unique(np.linspace(0, len(seen) - 1, count).astype(int))]
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

    def shortlist(self, hypotheses: Sequence[Hypothesis]) -> Sequence[Hypothesis]:
        """Return the hypotheses that are best without weight, which takes far less time; else all.

        Without it, the right one of a heavy arm is among the best, though it leaves much.
        """
        description, base, stations, recordings = self._given
        if not any(description.gravity):
            return hypotheses
        light = Comparer(_weightless(description), base, stations, recordings)
        return sorted(hypotheses, key=light.score)[: DETECTION.shortlist]

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


def _weightless(description: RobotDescription) -> RobotDescription:
    """Return the arm of a robot file without its weight, and without what it was calibrated to."""
    return description.model_copy(update={"gravity": (0.0, 0.0, 0.0), "calibration": None})


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

    A hypothesis must leave a small share of the misfit, and clearly less than any other kind.
    """
    nothing = comparer.nothing
    as_is = comparer.score(nothing)
    if not np.isfinite(as_is):
        return None
    tried = [each for each in of_channels(description, len(nothing.turns)) if each.kind not in keep]
    scored = [(comparer.score(each), each) for each in comparer.shortlist(tried)]
    worthy = [pair for pair in scored if pair[0] <= DETECTION.overwhelming * as_is]
    if "axes" not in keep:
        turns = _turns(comparer.of_turns(nothing.sources))
        if any(turns):
            turned = replace(nothing, kind="axes", turns=turns)
            worthy.append((comparer.score(turned), turned))
    if not worthy:
        return None
    then, best = min(worthy, key=lambda pair: pair[0])
    rivals = [pair[0] for pair in worthy if not _alike(pair[1], best)]
    if any(then > DETECTION.tie * each for each in rivals):
        return None
    return Found(best, as_is, then)


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
    """Whether two hypotheses are the same, or both orders (perhaps differing by a turn)."""
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


def _turn_text(rotation: Array) -> str:
    """Describe a rotation, as the end of a sentence."""
    vector = np.asarray(lie.log(lie.transform(rotation, np.zeros(3))))[3:]
    angle = float(np.linalg.norm(vector))
    axis = ", ".join(f"{each + 0.0:.2g}" for each in np.round(vector / max(angle, 1e-9), 2))
    return f"by {np.degrees(angle):.0f} deg about ({axis})"


# -- channels that do nothing ----------------------------------------------------------------------


def idle_channels(description: RobotDescription, recordings: Sequence[Recording]) -> dict[int, str]:
    """Return the channels (from 0) whose recorded pressure does not show in the tip, in words.

    Needs no model that fits: the tip is regressed on the lagged pressures and their products, with
    and without those of channel k, which leaves RMS distances d and d_k. The tips that the robot
    file's arm has at these pressures, regressed without channel k, are off by e_k: a channel that
    only follows the others has a small e_k and cannot be judged. With the share of this that shows,

        s_k = sqrt(max(d_k^2 - d^2, 0)) / e_k,

    and the median s of the other channels of its segment, channel k is idle if s_k is a small share
    of s, and if s e_k, what it should show, is clearly more than d. Rows far from the regression,
    as in fast motions, count less throughout.
    """
    span = np.subtract(description.pressure_max, description.pressure_min)
    pressures, tip = _evenly(recordings, DETECTION.idle_rows)
    try:
        expected = Manipulator(_weightless(description)).tip_pose(pressures)[:, :3, 3]
    except PressureError:
        return {}
    count = len(span)
    known = _quadratics(pressures / span)
    distances, _ = _regressed(known, tip, DETECTION.idle_rounds)
    weight = 1 / np.sqrt(1 + (distances / max(float(np.median(distances)), 1e-9)) ** 2)

    def off(known: Array, positions: Array) -> float:
        left, _ = _regressed(known * weight[:, np.newaxis], positions * weight[:, np.newaxis])
        return float(np.sqrt((left**2).sum() / (weight**2).sum()))

    everything = off(known, tip)
    others = [_quadratics(np.delete(pressures / span, k, axis=1)) for k in range(count)]
    without = np.array([off(each, tip) for each in others])
    should = np.array([max(off(each, expected), 1e-12) for each in others])
    shown = np.sqrt(np.maximum(without**2 - everything**2, 0)) / should
    found: dict[int, str] = {}
    first = 0
    for segment in description.segments:
        own = range(first, first := first + segment.n_channels)
        for k in own:
            usual = float(np.median([shown[j] for j in own if j != k] or [0.0]))
            visible = usual * should[k]
            is_known = visible >= DETECTION.idle_visible * everything
            if not is_known or shown[k] > DETECTION.idle_shows * usual:
                continue
            found[k] = (
                f"the pressure of {description.channel_name(k)} does not show in the tip, as if "
                "its line were dead or another channel's: a regression on the other pressures "
                f"misses the tip by {without[k] * 1e3:.1f} mm, with this one by "
                f"{everything * 1e3:.1f} mm; if it acted as the others of its segment, the first "
                f"would be {np.hypot(everything, visible) * 1e3:.1f} mm; look at its valve, its "
                "line and its column (--keep lines leaves this out)"
            )
    return found


def _evenly(recordings: Sequence[Recording], count: int) -> tuple[Array, Array]:
    """Return lagged pressures (N, n) and tips (N, 3) of rows spread evenly over each recording."""
    pressures, tips = [], []
    for each in recordings:
        seen = np.flatnonzero(whole(each.tracks[0].position))
        most = min(max(count // len(recordings), 8), len(seen))
        rows = seen[np.linspace(0, len(seen) - 1, most).astype(int)]
        pressures.append(lagged_pressures(each.time, each.pressures, DETECTION.clock_lag)[rows])
        tips.append(each.tracks[0].position[rows])
    return np.concatenate(pressures), np.concatenate(tips)


# -- a frame that was defined anew -----------------------------------------------------------------


def replaced(
    recording: Recording, measured: Array, predicted: Array, length: float
) -> tuple[Recording, str, bool]:
    """Move a recording rigidly to where a calibrated model predicts its tip.

    Prefers a rotation of the cube without translation if it fits about as well.

    Parameters
    ----------
    recording : Recording
    measured, predicted : (N, 3), in m.
    length : of the arm, in m.

    Returns
    -------
    recording, words, is_shifted
        The words describe the motion, as the end of a sentence.
    """
    seen = whole(measured)
    x, y = measured[seen], predicted[seen]

    def miss(rotation: Array, shift: Array) -> float:
        return float(np.linalg.norm(x @ rotation.T + shift - y, axis=1).mean())

    quarter = min(CUBE_ROTATIONS, key=lambda rotation: miss(rotation, np.zeros(3)))
    turned = x @ quarter.T
    centre = turned.mean(axis=0)
    spread = (y - y.mean(axis=0)).T @ (turned - centre)
    weight = len(x) * (DETECTION.known_turn * length) ** 2  # keeps undetermined turns at zero
    u, _, vt = np.linalg.svd(spread + weight * np.eye(3))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt @ quarter
    shift = y.mean(axis=0) - rotation @ x.mean(axis=0)
    if DETECTION.overwhelming * miss(quarter, np.zeros(3)) < miss(rotation, shift):
        rotation, shift = quarter, np.zeros(3)
    words = f"turned {_turn_text(rotation)}"
    is_shifted = bool(np.linalg.norm(shift) > SHOWN)
    if is_shifted:
        words += f" and moved by {np.linalg.norm(shift) * 1e3:.0f} mm"
    return _moved(recording, rotation, shift), words, is_shifted
