"""Estimate the prediction error of a calibrated arm from its errors on held-back data.

The arm is modelled as if the effective pressures of each segment were wrong by a discrepancy, a
Gaussian process in that segment's effective pressures with covariance ``s^2 exp(-|p - p'| / l)``
for each channel.  The discrepancy has two effects.  First, it correlates the errors of nearby rows,
so that a fit is less certain than their number suggests.  With the covariance C of the fit without
it, the gain N^-1 of the fit, its weighted slopes A (of all rows, by the unknowns), the slopes J_p
of positions by effective pressures and the correlation K of the rows, ::

    cov(x) = C + s^2 N^-1 (A' J_p) K (A' J_p)' N^-1.

Second, it acts on predictions: at a distance d from the nearest recorded pressure its variance is
``s^2 (1 - exp(-2 d / l))``, that of the process given its value there.  To this comes a relative
error ``g |p|`` in directions of pressure space that were not recorded, with ``g = 6.5 s / R`` over
the recorded range R (`ErrorModel`): where held-back data show that a model is more wrong, so it is
where none can show it.  Both move the tip as far as such pressures would, but equally in all
directions: a model of bending and elongation may be wrong in either, whatever a single pressure
does.  Besides, the tip moves at another time than predicted, by a standard deviation t.  What
differs from one recording session to another, as the zero of the tracker or the state of the
silicone, is not seen within one; the residual includes 0.5 % of the arm's length for it, but 0.1 %
where the model has creep, which is the state of the silicone.

s, l, t, the residual and the tail of the errors maximise the probability of the held-back
errors, with weak priors.  Rows are weighted so that many rows in one region of pressures count
little more than one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.identify.discrepancy import centres
from stiffopt.identify.fit import Fit
from stiffopt.identify.past import pause_between
from stiffopt.identify.problem import CalibrationProblem, Sample
from stiffopt.identify.results import Errors
from stiffopt.identify.settings import ERRORS, FIT
from stiffopt.model.calibration import (
    ErrorModel,
    RelativeErrors,
    distances_from,
    growth,
    recorded_range,
    squared_moves,
)
from stiffopt.model.remembered_errors import RememberedErrors

Rows = NDArray[np.bool_]

_MIN_FREEDOM = 4.0  # of a t-distribution; below, its covariance says little


@dataclass(frozen=True, eq=False)
class HeldBack:
    """A fold: the held-back rows (M,) of all samples, the fit to the others, its errors there."""

    rows: Rows
    fit: Fit
    errors: Errors


def error_model(
    found: Fit, held_back: Mapping[str, HeldBack], recorded: Array | None = None
) -> ErrorModel:
    """Fit the error model of a model structure to its errors on held-back data.

    Parameters
    ----------
    found : fit to all rows.
    held_back : folds of the same problem, by name; without any, the priors' values result.
    recorded : all recorded pressures (N, n), in Pa; by default those of the fitted rows.
    """
    pressures = commanded(found.problem.samples)
    reaches = np.array(ERRORS.reaches) * np.ptp(pressures, axis=0).max()
    folds = [_Fold.of(each, pressures, reaches, found.independent) for each in held_back.values()]
    best = min((_most_probable(folds, i, found) for i in range(len(reaches))), key=lambda b: b[0])
    _, index, (discrepancy, *_) = best
    gain = ERRORS.untested * discrepancy / recorded_range(pressures)
    _, _, (discrepancy, residual, tail, timing) = _most_probable(folds, index, found, gain)
    session = ERRORS.session_with_creep if found.robot.creeps else ERRORS.session
    residual = float(np.hypot(residual, session * found.problem.description.length))
    kept, spacing = representatives(_channels(found), pressures if recorded is None else recorded)
    settled, moving = _unsettled(found)
    return ErrorModel(
        residual=float(f"{residual:.4g}"),
        discrepancy=float(f"{discrepancy:.4g}"),
        reach=float(f"{reaches[index]:.4g}"),
        gain=float(f"{gain:.3g}"),
        timing=float(f"{timing:.3g}"),
        degrees_of_freedom=float(f"{_MIN_FREEDOM + tail:.3g}"),
        settled=settled,
        moving=moving,
        recorded=tuple(map(tuple, np.round(kept, -1).tolist())),
        spacing=float(f"{spacing:.3g}"),
    )


def covariance_with(found: Fit, errors: ErrorModel) -> Array:
    """Return the covariance (d, d) of a fit's scaled coordinates, discrepancy included."""
    added = _influence(found.problem, found.x, found.gain, np.array([errors.reach]))[0]
    return np.asarray(found.covariance + errors.discrepancy**2 * added)


def commanded(samples: Sequence[Sample]) -> Array:
    """Return the commanded pressures (M, n), in Pa, of the rows of all samples."""
    return np.concatenate([each.recording.pressures[each.rows] for each in samples])


def kept_unknowns(problem: CalibrationProblem) -> NDArray[np.intp]:
    """Return the indices of the unknowns that a robot file stores with their covariance.

    These are the numbers that affect the equilibrium, the base and the tip's sensor.
    """
    base, sensors, _, _ = problem.unknowns.slices()
    parameters = [
        i
        for i, unknown in enumerate(problem.unknowns.parameters)
        if unknown.parameter is not None and not unknown.parameter.is_history
    ]
    tip = range(sensors[0].start, sensors[0].stop) if sensors else ()
    return np.array([*parameters, *range(base.start, base.stop), *tip], dtype=np.intp)


def representatives(channels: Sequence[int], pressures: Array) -> tuple[Array, float]:
    """Return rows (K, n) that represent pressures (N, n), and the largest distance from one.

    `centres` chooses them by each segment's pressures in turn.
    """
    spacing = ERRORS.spacing * float(np.ptp(pressures, axis=0).max())
    chosen, limit = [0], ERRORS.representatives
    for begin, end in pairwise(np.cumsum([0, *channels])):
        chosen = centres(pressures[:, begin:end], spacing, limit, chosen)
        limit = len(chosen) + ERRORS.representatives
    kept = pressures[sorted(chosen)]
    return kept, float(distances_from(channels, pressures, kept).max())


# -- the likelihood of the held-back errors --------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Fold:
    """The N held-back rows of a fold in which the tip was measured.

    Attributes
    ----------
    errors : (N, 3), in the frame of the recordings, in m.
    parameters : covariance (N, 3, 3) of the errors due to uncertain parameters, in m^2, without
        discrepancy.
    through_fit : covariances (R, N, 3, 3) due to a discrepancy of variance 1 Pa^2, for each reach,
        through its effect on the fit.
    direct : variances (R, N) of each axis due to that discrepancy itself.
    relative : those (N,) due to relative errors with a gain of 1, in m^2.
    moving : covariance (N, 3, 3) due to an error of 1 s in time.
    weight : (R, N), of the rows, see `_weights`.
    """

    errors: Array
    parameters: Array
    through_fit: Array
    direct: Array
    relative: Array
    moving: Array
    weight: Array

    @classmethod
    def of(cls, held: HeldBack, pressures: Array, reaches: Array, independent: float) -> _Fold:
        fit, problem = held.fit, held.fit.problem
        predicted, slopes = problem.with_slopes(fit.x)
        rows = held.rows & np.isfinite(predicted.errors[0]).all(axis=1)
        counted = np.concatenate([sample.weight for sample in problem.samples]) > 0
        channels = _channels(fit)
        kept, spacing = representatives(channels, pressures[counted])  # as in a robot file
        distances = distances_from(channels, predicted.effective, kept) - spacing
        shares = growth(np.maximum(distances, 0.0), reaches[:, np.newaxis, np.newaxis])
        relative = [
            RelativeErrors(kept[:, a:b], recorded_range(kept)).variances(
                predicted.effective[:, a:b]
            )
            for a, b in pairwise(np.cumsum([0, *channels]))
        ]
        acting = predicted.per_pressure[0]
        *direct, untested = [
            _even_variance(squared_moves(acting, np.repeat(share, channels, axis=1)), fit)[rows]
            for share in (*shares, np.stack(relative, axis=1))
        ]
        velocity = (acting @ predicted.rates[..., np.newaxis])[rows]
        numbers = kept_unknowns(problem)
        slope = slopes[rows][:, :, numbers]
        added = _influence(problem, fit.x, fit.gain, reaches)[:, numbers[:, np.newaxis], numbers]
        return cls(
            errors=predicted.errors[0][rows],
            parameters=_spread(slope, fit.covariance[np.ix_(numbers, numbers)]),
            through_fit=np.stack([_spread(slope, each) for each in added]),
            direct=np.stack(direct),
            relative=untested,
            moving=velocity @ np.swapaxes(velocity, 1, 2),
            weight=np.stack([_weights(pressures[rows], reach, independent) for reach in reaches]),
        )

    def misfit(
        self,
        index: int,
        gain: float,
        discrepancy: float,
        residual: float,
        tail: float,
        timing: float,
    ) -> float:
        """Return the negative log density of the errors, up to a constant."""
        from scipy.special import gammaln

        even = discrepancy**2 * self.direct[index] + gain**2 * self.relative + residual**2
        covariance = (
            self.parameters
            + discrepancy**2 * self.through_fit[index]
            + timing**2 * self.moving
            + even[:, np.newaxis, np.newaxis] * np.eye(3)
        )
        v = _MIN_FREEDOM + tail
        squares = np.einsum(
            "ni,ni->n", self.errors,
            np.linalg.solve(covariance, self.errors[..., np.newaxis])[..., 0],
        )  # fmt: skip
        _, logarithm = np.linalg.slogdet(covariance)
        norm = gammaln((v + 3) / 2) - gammaln(v / 2) - 1.5 * np.log(v - 2)
        each = 0.5 * (v + 3) * np.log1p(squares / (v - 2)) + 0.5 * logarithm - norm
        return float(self.weight[index] @ each)


def _even_variance(moves: Array, fit: Fit) -> Array:
    """Return the variance (M,) of each axis of the tip, in m^2, by `squared_moves` (M, n)."""
    span = recorded_range(commanded(fit.problem.samples))
    samples, starts = fit.problem.samples, fit.problem.starts[:-1]
    breaks = [
        start for each, start in zip(samples, starts, strict=True) if each.begin != "previous"
    ]
    time = in_turn([each.recording.time[each.rows] for each in samples])
    runs = zip(np.split(time, breaks[1:]), np.split(moves, breaks[1:]), strict=True)
    memory = RememberedErrors.of(fit.robot, span)
    return memory.even_variance(moves, np.concatenate([memory.before(*run) for run in runs]))


def in_turn(times: Sequence[Array]) -> Array:
    """Return the times (N,) in s of logs that follow each other, from those of each (N_i,).

    At the beginning of a log it has been `pause_between` since the last row of the one before.
    """
    found = [times[0] - times[0][0]]
    for earlier, later in pairwise(times):
        found.append(later - later[0] + found[-1][-1] + pause_between(earlier, later))
    return np.concatenate(found)


def _spread(slope: Array, covariance: Array) -> Array:
    """Propagate a covariance (k, k) through slopes (N, 3, k) to positions (N, 3, 3)."""
    return np.asarray(slope @ covariance @ np.swapaxes(slope, 1, 2))


def _weights(pressures: Array, reach: float, independent: float) -> Array:
    """Return equal weights (N,) of rows at pressures (N, n).

    Together they count as many rows as they occupy cells of the size `reach`, but at most as many
    as are independent in time.
    """
    cells = len(np.unique(np.round(pressures / reach), axis=0))
    independent_rows = len(pressures) / independent
    return np.full(
        len(pressures),
        min(max(independent_rows, 1.0), ERRORS.per_cell * cells) / max(len(pressures), 1),
    )


def _most_probable(
    folds: Sequence[_Fold], index: int, found: Fit, gain: float = 0.0
) -> tuple[float, int, tuple[float, float, float, float]]:
    """Find discrepancy, residual, tail and timing at one reach and gain.

    Returns misfit, index and these values.
    """
    from scipy.optimize import minimize  # a large library; only fits need it

    acting = found.predicted.per_pressure[0]
    length = found.problem.description.length
    slope = np.sqrt(np.mean((acting**2).sum(axis=(1, 2))))
    steps = [np.median(np.diff(each.recording.time)) for each in found.problem.samples]
    typical = ERRORS.discrepancy * (1.0 if folds else ERRORS.unchecked)
    expected = np.log([
        typical * length / slope, ERRORS.residual * found.problem.noise.position,
        ERRORS.tail, ERRORS.timing * np.median(steps),
    ])  # fmt: skip

    def misfit(logarithms: Array) -> float:
        values = np.exp(np.clip(logarithms, expected - 5, expected + 5)).tolist()
        data = sum(fold.misfit(index, gain, *values) for fold in folds)
        return data + 0.5 * float((((logarithms - expected) / ERRORS.deviations) ** 2).sum())

    result: Any = minimize(
        misfit,
        expected,
        method="Nelder-Mead",
        options={"xatol": 0.01, "fatol": 0.01, "maxiter": 600},
    )
    discrepancy, residual, tail, timing = np.exp(result.x).tolist()
    reach_prior = 0.5 * float(np.log(ERRORS.reaches[index] / ERRORS.reach) ** 2)
    return float(result.fun) + reach_prior, index, (discrepancy, residual, tail, timing)


def _influence(problem: CalibrationProblem, x: Array, gain: Array, reaches: Array) -> Array:
    """Return covariances (R, d, d) of scaled x due to a discrepancy of 1 Pa^2, for each reach."""
    value, slope = problem.residuals(x)
    slope = slope / np.sqrt(1 + value**2 / FIT.loss_scale**2)[:, np.newaxis]
    predicted = problem.predict(x)
    pressures = commanded(problem.samples)
    count = len(pressures)
    weights = np.concatenate([each.weight for each in problem.samples]) / problem.noise.position
    pulls = np.zeros((count, pressures.shape[1], problem.size))
    begin = 0
    for read, acting in zip(predicted.read, predicted.per_pressure, strict=True):
        own = slope[begin : begin + 3 * count].reshape(count, 3, -1)
        pulls += np.swapaxes(acting * weights[:, np.newaxis, np.newaxis], 1, 2) @ own
        begin += 3 * count * (1 if read.turn is None else 2)
    stride = -(-count // ERRORS.rows)
    rows = np.flatnonzero(weights > 0)[::stride]
    pulls, pressures = stride * pulls[rows] @ gain, pressures[rows]
    ends = np.cumsum([0, *(segment.n_channels for segment in problem.description.segments)])
    found = np.zeros((len(reaches), problem.size, problem.size))
    for first, last in pairwise(ends):
        own = pressures[:, first:last]
        distances = np.sqrt(((own[:, np.newaxis] - own) ** 2).sum(axis=2))
        for r, reach in enumerate(reaches):
            alike = np.exp(-distances / reach)
            for channel in range(first, last):
                found[r] += pulls[:, channel].T @ alike @ pulls[:, channel]
    return found


def _channels(found: Fit) -> list[int]:
    return [segment.n_channels for segment in found.problem.description.segments]


# -- errors where the history is unknown -----------------------------------------------------


def _unsettled(found: Fit) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the RMS (n,) of effective minus commanded pressures in held and in moving rows.

    Each is empty where there are too few rows.  The RMS in moving rows is that of a motion of all n
    channels: if a slower channel has any speed up to that of the fastest, with a mean square of a
    third, then k moving channels together have (k + 2) / 3 times that of the fastest.
    """
    samples = found.problem.samples
    moves = np.concatenate([
        moving_channels(each.recording.time, each.recording.pressures)[each.rows]
        for each in samples
    ])  # fmt: skip
    difference = found.predicted.effective - commanded(samples)
    count, channels = moves.sum(axis=1), moves.shape[1]
    answer: list[tuple[float, ...]] = []
    for rows, together in ((count == 0, 0), (count > 0, channels)):
        if rows.sum() < ERRORS.least_rows:
            answer.append(())
        else:
            all_of_them = (together + 2) / (count[rows].mean() + 2)
            squares = np.sqrt(np.mean(difference[rows] ** 2, axis=0) * all_of_them)
            answer.append(tuple(float(f"{each:.4g}") for each in squares))
    return answer[0], answer[1]


def is_moving(time: Array, pressures: Array) -> Rows:
    """Return at which rows (N,) any of the `moving_channels` moves."""
    return np.asarray(moving_channels(time, pressures).any(axis=1))


def held_for(time: Array, moving: Rows) -> Array:
    """Return for how long pressures have been held, in s (N,), at times (N,) in s.

    That is since the last row in which they were `moving` (`is_moving`); NaN in moving rows, and
    before the first.
    """
    last = np.maximum.accumulate(np.where(moving, time, -np.inf))
    held = time - last + ERRORS.hold
    return np.where(moving | np.isinf(held), np.nan, held)


def moving_channels(time: Array, pressures: Array) -> Rows:
    """Return which pressures (N, n) changed within the last `ERRORS.hold` seconds."""
    step = ERRORS.still * max(float(np.ptp(pressures, axis=0).max()), 1.0)
    before = np.searchsorted(time, time - ERRORS.hold)
    lowest, highest = pressures.copy(), pressures.copy()
    for row, first in enumerate(before):
        lowest[row] = pressures[first : row + 1].min(axis=0)
        highest[row] = pressures[first : row + 1].max(axis=0)
    return np.asarray(highest - lowest > step)
