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
from numpy.typing import ArrayLike

__all__ = ["Estimate", "Line", "combine", "fit_line", "student_t"]

FEWEST = 3
"""Points without which a line is not fitted: two have no residual."""
_ALIKE = 0.9  # correlation of a trend with x from which on it is left out


@dataclass(frozen=True)
class Line:
    """A straight line by least squares.

    Attributes
    ----------
    slope : of the line.
    sigma : standard error of the slope, from the residuals.
    freedom : degrees of freedom of the residuals.
    points : number of points.
    """

    slope: float
    sigma: float
    freedom: int
    points: int


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


def fit_line(x: ArrayLike, y: ArrayLike, trend: ArrayLike | None = None) -> Line | None:
    """Fit y by a line in x, all (N,); None for too few points or all at one x.

    With a trend, such as time, y may also be linear in that: the slope is then that at a constant
    trend. One that can hardly be told from x is left out.
    """
    u, v = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    w = np.zeros_like(u) if trend is None else np.asarray(trend, dtype=float)
    known = np.isfinite(u) & np.isfinite(v) & np.isfinite(w)
    u, v, w = u[known], v[known], w[known]
    if len(u) < FEWEST:
        return None
    du, dv, dw = u - u.mean(), v - v.mean(), w - w.mean()
    freedom = len(u) - 2
    size = math.sqrt(float(dw @ dw) * float(du @ du))
    if freedom > 1 and size > 0 and abs(float(du @ dw)) < _ALIKE * size:
        du = du - dw * (float(du @ dw) / float(dw @ dw))
        dv = dv - dw * (float(dv @ dw) / float(dw @ dw))
        freedom -= 1
    width = float(du @ du)
    if width <= 0:
        return None
    slope = float(du @ dv) / width
    rest = dv - slope * du
    return Line(slope, math.sqrt(float(rest @ rest) / freedom / width), freedom, len(u))


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
