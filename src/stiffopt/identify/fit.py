"""Robust nonlinear least squares with priors, and the covariance of the result.

Residuals of real arms are not white noise.  Rows at nearby pressures share the model's systematic
error (`stiffopt.identify.discrepancy`), the remaining errors are correlated in time, and they are
larger where pressures have just changed.  The fit therefore alternates with an estimate of the
noise: it divides the remaining errors by the robust spread of rows with as much change, and weights
the rows by the number of independent ones among them, from the errors' autocorrelation.  Only then
are priors and covariance meaningful: numbers that a recorded curve in pressure space does not
determine stay near the robot file, however often the curve was repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.identify.problem import CalibrationProblem, Noise, Predicted, Sample
from stiffopt.identify.settings import FIT
from stiffopt.model.description import RobotDescription


@dataclass(frozen=True, eq=False)
class Fit:
    """The best minimum found, with its covariance.

    Attributes
    ----------
    problem : with the noise and weights of the last round.
    x : scaled coordinates (d,).
    cost : half the sum of the squared residuals, with the loss and the prior.
    covariance : of x, (d, d), from noise and prior; an unknown that the data do not determine keeps
        the prior's variance of one.
    gain : inverse (d, d) of the normal matrix: x moves by ``gain @ slopes.T @ residuals``.
    independent : number of rows per independent row.
    """

    problem: CalibrationProblem
    x: Array
    cost: float
    covariance: Array
    gain: Array
    independent: float

    @property
    def robot(self) -> RobotDescription:
        """The robot with the fitted parameters."""
        return self.problem.robot(self.x)

    @property
    def predicted(self) -> Predicted:
        """The fitted model's predictions for the rows of the samples."""
        return self.problem.predict(self.x)


def fit(
    problem: CalibrationProblem,
    starts: Sequence[Array],
    on_evaluation: Callable[[], None] = lambda: None,
    rounds: int = FIT.rounds,
    most: int = FIT.evaluations,
    tolerance: float = FIT.tolerance,
) -> Fit:
    """Fit from several starts and return the best minimum.

    Parameters
    ----------
    problem : CalibrationProblem
    starts : sequence of (d,)
        Scaled coordinates.
    on_evaluation : called at every evaluation of the problem; it may raise to stop the fit.
    rounds : how often noise and weights are estimated anew and the fit is repeated.
    most : largest number of evaluations of the problem from each start, and in each round.
    tolerance : relative, of cost, step and gradient.
    """
    different = {start.tobytes(): start for start in starts}.values()
    begun = [_minimum(problem, start, on_evaluation, most, tolerance) for start in different]
    x, cost = min(begun, key=lambda found: found[1])
    independent = 1.0
    for _ in range(rounds):
        problem, independent = _reweighted(problem, x, independent)
        x, cost = _minimum(problem, x, on_evaluation, most, tolerance)
    return Fit(problem, x, cost, *_covariance(problem, x), independent)


def _minimum(
    problem: CalibrationProblem,
    start: Array,
    on_evaluation: Callable[[], None],
    most: int,
    tolerance: float,
) -> tuple[Array, float]:
    """Return scaled coordinates (d,) of a minimum near a start, and its cost."""
    from scipy.optimize import least_squares  # a large library; only fits need it

    margin = 1e-9
    inside = np.clip(start, problem.low + margin, problem.high - margin)
    memory: dict[bytes, tuple[Array, Array]] = {}

    def both(x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in memory:
            on_evaluation()
            is_start = np.array_equal(x, inside)
            try:
                value, slope = problem.residuals(x)
            except EquilibriumError:
                if is_start:
                    raise
                ((value, slope),) = memory.values()  # of the last step
                value, slope = np.full(len(value) - problem.size, np.nan), slope[: -problem.size]
            # the solver takes back a step to where values fail, so they do where slopes fail
            fails = not (np.isfinite(value).all() and np.isfinite(slope).all())
            if fails and is_start:
                raise InputError(
                    f"the model of robot '{problem.description.name}' has values or slopes that "
                    "are not finite, so that it cannot be fitted; look at its limits of pressure "
                    "and its modulus"
                )
            value = np.full_like(value, np.nan) if fails else value
            memory.clear()
            memory[key] = np.concatenate([value, x]), np.vstack([slope, np.eye(problem.size)])
        return memory[key]

    found = least_squares(
        lambda x: both(x)[0],
        inside,
        lambda x: both(x)[1],
        bounds=(problem.low, problem.high),
        method="trf",
        loss=_loss(problem.size),
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=most,
    )
    return np.asarray(found.x), float(found.cost)


def _loss(n_prior: int) -> Callable[[Array], Array]:
    """Return the loss: soft L1 for the data, square for the prior, with two derivatives."""

    def loss(squared: Array) -> Array:
        z = squared / FIT.loss_scale**2
        root = np.sqrt(1 + z)
        rho = np.stack(
            [2 * FIT.loss_scale**2 * (root - 1), 1 / root, -0.5 / root**3 / FIT.loss_scale**2]
        )
        rho[:, -n_prior:] = np.stack([squared[-n_prior:], np.ones(n_prior), np.zeros(n_prior)])
        return rho

    return loss


def _reweighted(
    problem: CalibrationProblem, x: Array, independent: float
) -> tuple[CalibrationProblem, float]:
    """Return the problem with noise and weights estimated at x, and rows per independent row.

    The part that rows share follows the noise too, so what is left of the errors is less than the
    noise.  The expected covariance of the noise, given the errors, is that of what is left plus
    that of the shared part: a step of expectation maximisation (A. P. Dempster et al., 1977)
    towards the noise of greatest likelihood.  Without the second, less noise lets the shared part
    follow more of it, until nothing but its outliers is left.  One step in each of few rounds stops
    short of that: on recordings, noise of greatest likelihood predicts other runs less well.
    """
    if not problem.samples:
        return problem, 1.0
    predicted = problem.predict(x)
    moves = [problem.unshared(errors, "position") for errors in predicted.errors]
    position = _spread(*_stacked(moves), FIT.least_position)
    read = [read.turn for read in predicted.read if read.turn is not None]
    turns = [problem.unshared(turn, "angle") for turn in read]
    angle = _spread(*_stacked(turns), FIT.least_angle) if turns else problem.noise.angle
    spread = _spread_by_change(problem, *moves[0])
    found = _rows_per_independent(problem, *(each / spread for each in moves[0]))
    factor = np.sqrt(independent / found)
    parts = np.split(spread[:, 0], problem.starts[1:-1])
    samples = [
        replace(sample, weight=sample.weight * factor * sample.spread / own, spread=own)
        for sample, own in zip(problem.samples, parts, strict=True)
    ]
    return problem.with_samples(samples, Noise(position, angle, FIT.systematic)), found


def _stacked(pairs: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Stack errors, and roots of covariances, of several points."""
    errors, roots = zip(*pairs, strict=True)
    return np.concatenate(errors), np.concatenate(roots)


def _spread(errors: Array, root: Array, least: float) -> float:
    """Return the robust root mean square of errors' axes; at least `least`.

    Parameters
    ----------
    errors : (M, 3), without their shared part.
    root : U (M, m), of that part's covariance ``U U'``.
    """
    known = np.isfinite(errors).all(axis=1)
    if not known.any():
        return least
    middle = 1.4826 * float(np.median(np.abs(errors[known])))
    kept = np.clip(errors[known], -4 * middle, 4 * middle)
    squares = np.mean(kept**2) + np.mean((root[known] ** 2).sum(axis=1))
    return max(float(np.sqrt(squares)), least)


def _spread_by_change(problem: CalibrationProblem, errors: Array, root: Array) -> Array:
    """Return the `_spread` (M, 1) of errors, over that of all, by change of pressure.

    A tracker that is read a moment late, or a lag that is not quite so, is wrong only where the
    pressures have just changed. The rows are divided into classes of equal size by how much they
    did; more change never means a smaller spread. All have the same if the classes hardly differ,
    or contain too few independent rows to tell.
    """
    same = np.ones((len(errors), 1))
    counted = problem.counted & np.isfinite(errors).all(axis=1)
    independent = counted.sum() / _rows_per_independent(problem, errors, root)
    classes = min(FIT.classes, int(independent / FIT.class_rows))
    if classes < 2:
        return same
    change = np.concatenate([_recent_change(sample) for sample in problem.samples])
    shares = np.arange(1, classes) / classes
    edges = np.unique(np.quantile(change[counted], shares, method="lower"))
    edges = edges[edges < change[counted].max()]  # so that no class is empty
    own = np.searchsorted(edges, change)
    members = [counted & (own == each) for each in range(len(edges) + 1)]
    found = [_spread(errors[rows], root[rows], FIT.least_position) for rows in members]
    spreads = np.maximum.accumulate(found)
    if spreads[-1] < FIT.uneven * spreads[0]:
        return same
    return np.asarray(spreads[own][:, np.newaxis] / _spread(errors, root, FIT.least_position))


def _recent_change(sample: Sample) -> Array:
    """Return by how much the pressures changed, up and down, before each row (M,), in Pa."""
    time, pressures = sample.recording.time, sample.recording.pressures
    travelled = np.concatenate([[0.0], np.abs(np.diff(pressures, axis=0)).sum(axis=1).cumsum()])
    before = np.maximum(np.searchsorted(time, time - FIT.recent) - 1, 0)
    return np.asarray((travelled - travelled[before])[sample.rows])


def _rows_per_independent(problem: CalibrationProblem, errors: Array, root: Array) -> float:
    """Return the integrated autocorrelation of the tip's errors along rows; at least 1.

    `errors` and `root` as in `_spread`.
    """
    columns = np.hstack([errors, np.sqrt(errors.shape[1]) * root])
    starts = problem.starts
    longest = max(1, max(len(sample.rows) for sample in problem.samples) // 3)
    total: Array = np.zeros(longest)
    for begin, end in pairwise(starts):
        known = np.where(np.isfinite(columns[begin:end]), columns[begin:end], 0.0)
        size = len(known) + longest  # zero padding, against circular correlation
        spectrum = np.abs(np.fft.rfft(known, size, axis=0)) ** 2
        products: Array = np.fft.irfft(spectrum, size, axis=0)
        total += np.asarray(products[:longest].sum(axis=1), dtype=float)
    if total[0] <= 0:
        return 1.0
    correlation = total / total[0]
    negative = np.flatnonzero(correlation < 0.05)
    stop = negative[0] if len(negative) else longest
    return float(max(1.0, 1 + 2 * correlation[1:stop].sum()))


def _covariance(problem: CalibrationProblem, x: Array) -> tuple[Array, Array]:
    """Return the covariance of x and the inverse of the normal matrix N, both loss-weighted.

    The covariance is ``N^-1 (N - S'S) N^-1`` with the slopes S of the systematic errors'
    coefficients. It leaves out these errors: `stiffopt.identify.error_model` estimates their size
    from held-back data.
    """
    value, slope = problem.residuals(x)
    slope = slope / np.sqrt(np.sqrt(1 + value**2 / FIT.loss_scale**2))[:, np.newaxis]
    inverse = np.linalg.inv(slope.T @ slope + np.eye(problem.size))
    rows = slope[: len(slope) - problem.n_shared]
    found = inverse @ (rows.T @ rows + np.eye(problem.size)) @ inverse
    return np.asarray((found + found.T) / 2, dtype=float), np.asarray(inverse, dtype=float)
