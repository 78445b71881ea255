"""Estimate slopes with confidence intervals: least squares per series, scatter of repetitions.

The uncertainty of interest is the change of the stiffness if the whole measurement were repeated,
with the probe aligned and the arm pressurised anew. The scatter between repetitions shows it; the
residuals of one series do not. So each repetition counts as one measurement of the slope. Since a
few repetitions may agree by chance, the uncertainty is at least that which the residuals imply.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array

_FEWEST = 3  # points; a line through two has no residual
_BEND = 3.0  # significance of a curvature, in standard errors, from which a parabola is fitted
_CONFIDENCE = 0.95  # of the half width of an estimate
_ALIKE = 0.9  # correlation of a trend with x from which the trend is left out


@dataclass(frozen=True)
class LineFit:
    """A line fitted by least squares."""

    slope: float  # of the line, at x = 0
    sigma: float  # standard error of the slope, from the residuals
    freedom: int  # degrees of freedom of the residuals
    points: int  # number of points
    bend: float = 0.0  # curvature at x = 0 over its standard error; 0 if none was fitted


@dataclass(frozen=True)
class SlopeEstimate:
    """Mean of the slopes of several repetitions, with its uncertainty."""

    value: float  # mean of the slopes
    sigma: float  # standard error of the mean
    half_width: float  # half the width of its confidence interval
    spread: float  # standard deviation of the slopes; NaN for one
    count: int  # number of slopes


def fit_line(
    x: ArrayLike, y: ArrayLike, trend: ArrayLike | None = None, *, curved: bool = False
) -> LineFit | None:
    """Fit a line y(x) to N points; return None for too few points, or all at one x.

    Parameters
    ----------
    x, y : (N,), points; those that are not finite are left out.
    trend : (N,), another regressor, such as time; the slope is that at a constant trend. A trend
        that is strongly correlated with x is left out.
    curved : whether to fit a parabola and return its slope at x = 0.
    """
    u, v = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    w = np.zeros_like(u) if trend is None else np.asarray(trend, dtype=float)
    known = np.isfinite(u) & np.isfinite(v) & np.isfinite(w)
    u, v, w = u[known], v[known], w[known]
    size = float(np.ptp(u)) if len(u) >= _FEWEST else 0.0
    if size <= 0:
        return None
    columns = [np.ones_like(u), u / size]
    if curved and len(u) > len(columns) + 2:
        columns.append((u / size) ** 2)
    if len(u) > len(columns) + 1 and _is_independent(u, w):
        columns.append((w - w.mean()) / np.ptp(w))
    design = np.stack(columns, axis=1)
    found, _, rank, _ = np.linalg.lstsq(design, v)
    if rank < len(columns):
        return None if len(columns) == 2 else fit_line(u, v)
    rest = v - design @ found
    freedom = len(u) - len(columns)
    spread = np.linalg.inv(design.T @ design) * (float(rest @ rest) / freedom)
    bend = 0.0
    if curved and len(columns) > 2 and spread[2, 2] > 0:
        bend = float(found[2]) / math.sqrt(spread[2, 2])
    return LineFit(float(found[1]) / size, math.sqrt(spread[1, 1]) / size, freedom, len(u), bend)


def _is_independent(x: Array, trend: Array) -> bool:
    """Whether a trend's correlation with x is small enough to fit both."""
    dx, dt = x - x.mean(), trend - trend.mean()
    size = math.sqrt(float(dx @ dx) * float(dt @ dt))
    return size > 0 and abs(float(dx @ dt)) < _ALIKE * size


def fit_lines(
    series: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]],
) -> list[LineFit]:
    """Fit the slopes at x = 0 of repetitions, each (x, y, trend).

    All are straight lines, or all parabolas if the repetitions together show a significant
    curvature.
    """
    bent = [fit_line(x, y, trend, curved=True) for x, y, trend in series]
    bends = [line.bend for line in bent if line is not None]
    curved = bool(bends) and abs(math.fsum(bends)) > _BEND * math.sqrt(len(bends))
    lines = bent if curved else [fit_line(x, y, trend) for x, y, trend in series]
    return [line for line in lines if line is not None]


def combine(lines: Sequence[LineFit]) -> SlopeEstimate | None:
    """Combine the slopes of repetitions; None if there are none."""
    if not lines:
        return None
    count = len(lines)
    value = math.fsum(line.slope for line in lines) / count
    within = math.sqrt(math.fsum(line.sigma**2 for line in lines)) / count
    within_width = within * student_t(_CONFIDENCE, sum(line.freedom for line in lines))
    if count == 1:
        return SlopeEstimate(value, within, within_width, math.nan, 1)
    spread = math.sqrt(math.fsum((line.slope - value) ** 2 for line in lines) / (count - 1))
    between = spread / math.sqrt(count)
    width = max(between * student_t(_CONFIDENCE, count - 1), within_width)
    return SlopeEstimate(value, max(between, within), width, spread, count)


def student_t(confidence: float, freedom: int) -> float:
    """Return the t with P(|T| <= t) = `confidence` for Student's distribution."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 * (1 + confidence)))
