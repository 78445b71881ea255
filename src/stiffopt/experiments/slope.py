"""Slopes with their uncertainty: of one series by least squares, of repetitions by their scatter.

What a user asks is how much the stiffness would differ if the whole measurement were done again:
probe aligned anew, arm pressurised anew. Only the scatter between repetitions tells that; the
residuals of one series know nothing of it. So the repetitions are what is counted, each with its
own slope. With few of them their scatter may be small by luck, so the uncertainty is never taken
to be less than what the residuals alone imply.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Estimate", "Line", "combine", "fit_line", "fit_lines", "student_t"]

Array = NDArray[np.float64]

FEWEST = 3
"""Points without which a line is not fitted: two have no residual."""
_DOUBT = 3.0  # standard errors by which a curvature must differ from none
_ALIKE = 0.9  # correlation of a trend with x from which on it is left out


@dataclass(frozen=True)
class Line:
    """A line by least squares.

    Attributes
    ----------
    slope : of the line, at x = 0.
    sigma : standard error of the slope, from the residuals.
    freedom : degrees of freedom of the residuals.
    points : number of points.
    bend : curvature at x = 0 over its standard error; 0 if none was fitted.
    """

    slope: float
    sigma: float
    freedom: int
    points: int
    bend: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """What several slopes say together.

    Attributes
    ----------
    value : their mean.
    sigma : standard error of the mean.
    half_width : of its confidence interval.
    spread : standard deviation of the slopes; NaN for one.
    count : number of slopes.
    """

    value: float
    sigma: float
    half_width: float
    spread: float
    count: int


def fit_line(
    x: ArrayLike, y: ArrayLike, trend: ArrayLike | None = None, *, curved: bool = False
) -> Line | None:
    """Fit y by a line in x, all (N,); None for too few points or all at one x.

    Parameters
    ----------
    x, y :
        What is not finite is left out.
    trend :
        Such as time, in which y may also be linear: the slope is then that at a constant trend.
        One that can hardly be told from x is left out.
    curved :
        Fit a parabola, whose slope at x = 0 is the result.
    """
    u, v = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    w = np.zeros_like(u) if trend is None else np.asarray(trend, dtype=float)
    known = np.isfinite(u) & np.isfinite(v) & np.isfinite(w)
    u, v, w = u[known], v[known], w[known]
    size = float(np.ptp(u)) if len(u) >= FEWEST else 0.0
    if size <= 0:
        return None
    columns = [np.ones_like(u), u / size]
    if curved and len(u) > len(columns) + 2:
        columns.append((u / size) ** 2)
    if len(u) > len(columns) + 1 and _can_be_told(u, w):
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
    return Line(float(found[1]) / size, math.sqrt(spread[1, 1]) / size, freedom, len(u), bend)


def _can_be_told(x: Array, trend: Array) -> bool:
    """Whether a trend differs from x by so much that both can be fitted."""
    dx, dt = x - x.mean(), trend - trend.mean()
    size = math.sqrt(float(dx @ dx) * float(dt @ dt))
    return size > 0 and abs(float(dx @ dt)) < _ALIKE * size


def fit_lines(
    series: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]],
) -> list[Line]:
    """Fit the slopes at x = 0 of repetitions, each (x, y, trend).

    They are straight lines, unless all repetitions together show beyond doubt that they bend:
    then all are parabolas.
    """
    bent = [fit_line(x, y, trend, curved=True) for x, y, trend in series]
    bends = [line.bend for line in bent if line is not None]
    curved = bool(bends) and abs(math.fsum(bends)) > _DOUBT * math.sqrt(len(bends))
    lines = bent if curved else [fit_line(x, y, trend) for x, y, trend in series]
    return [line for line in lines if line is not None]


def combine(lines: Sequence[Line], confidence: float = 0.95) -> Estimate | None:
    """Combine the slopes of repetitions; None if there are none."""
    if not lines:
        return None
    count = len(lines)
    value = math.fsum(line.slope for line in lines) / count
    within = math.sqrt(math.fsum(line.sigma**2 for line in lines)) / count
    within_width = within * student_t(confidence, sum(line.freedom for line in lines))
    if count == 1:
        return Estimate(value, within, within_width, math.nan, 1)
    spread = math.sqrt(math.fsum((line.slope - value) ** 2 for line in lines) / (count - 1))
    between = spread / math.sqrt(count)
    width = max(between * student_t(confidence, count - 1), within_width)
    return Estimate(value, max(between, within), width, spread, count)


def student_t(confidence: float, freedom: int) -> float:
    """Return the t that |T| of Student's distribution exceeds with chance 1 - confidence."""
    low, high = 0.0, 1.0
    while _within(high, freedom) < confidence:
        high *= 2
    for _ in range(200):
        middle = (low + high) / 2
        if _within(middle, freedom) < confidence:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def _within(t: float, freedom: int) -> float:
    """Chance of |T| < t, in closed form (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    angle = math.atan2(t, math.sqrt(freedom))
    cosine, sine = math.cos(angle), math.sin(angle)
    term = total = 1.0 if freedom % 2 == 0 else cosine
    for k in range(2 if freedom % 2 == 0 else 3, freedom, 2):
        term *= (k - 1) / k * cosine**2
        total += term
    if freedom % 2 == 0:
        return sine * total
    if freedom == 1:
        total = 0.0
    return 2 / math.pi * (angle + sine * total)
