"""Estimate dynamics after steps: regulators' dead time and lag, the tip's swing and delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.procedure import StepReadings
from stiffopt.model.history import lagged

_CREEP = 1.5  # s, time constant of creep
_FREQUENCIES = np.geomspace(0.4, 12.0, 70)  # Hz, initial values of the search, as the next three
_DAMPINGS = (0.02, 0.1)
_LAGS = (0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)  # s
_DEAD_TIMES = (0.0, 0.02, 0.06, 0.15, 0.3)  # s
_LOOK = 1.5  # s after a step, used for the regulator's and the tip's delay
_FINE = 0.005  # s, resolution of the tip's delay
_TIP_DELAYS = np.arange(-0.05, 0.6, _FINE)  # s
_RISE = (0.1, 0.9)  # shares of a step between which its rate is taken


@dataclass(frozen=True)
class Swing:
    """The damped swing of the tip that the steps excite.

    Attributes
    ----------
    frequency : in Hz.
    damping : share of critical damping.
    amplitude : the largest, just after a step, in m.
    frequency_deviation, damping_deviation : standard deviations of these.
    """

    frequency: float
    damping: float
    amplitude: float
    frequency_deviation: float
    damping_deviation: float


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays of the regulators by their gauges, (n,) each; NaN without a measurement.

    `dead_time`, `lag_up`, `lag_down`: in s. `rate_up`, `rate_down`: mean rates between a tenth and
    nine tenths of a step, in Pa/s.
    """

    dead_time: Array
    lag_up: Array
    lag_down: Array
    rate_up: Array
    rate_down: Array


# -- swings ----------------------------------------------------------------------------------------


_SWINGS_FOR = (3.5, 1.2)  # s after a step; windows in which a swing is sought


def _shapes(time: Array, frequency: float, damping: float) -> Array:
    """Return basis functions (m, 4): a constant, creep, and two of a damped swing."""
    omega = 2 * np.pi * frequency
    decay, damped = np.exp(-damping * omega * time), omega * np.sqrt(1 - damping**2)
    return np.stack(
        [np.ones_like(time), np.exp(-time / _CREEP), decay * np.cos(damped * time),
         decay * np.sin(damped * time)], axis=1,
    )  # fmt: skip


def fit_swing(windows: Sequence[tuple[Array, Array]], noise: float) -> Swing | None:
    """Fit one damped swing to the motions after all steps.

    `windows`: times (m,) since a step in s, and positions (m, 3) in m. `noise`: of a position, in
    m. Returns None if no swing stands out from the noise, in neither a long nor a short window.
    """
    for duration in _SWINGS_FOR:
        used = [(t[t < duration], x[t < duration]) for t, x in windows]
        if (swing := _fit_swing([each for each in used if len(each[0]) > 24], noise)) is not None:
            return swing
    return None


def _fit_swing(used: Sequence[tuple[Array, Array]], noise: float) -> Swing | None:
    """Fit one damped swing to windows; return None if it does not stand out from the noise."""
    if not used:
        return None

    def left(parameters: Array) -> Array:
        found = []
        for time, x in used:
            basis = _shapes(time, float(np.exp(parameters[0])), float(parameters[1]))
            found.append((x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0]).ravel())
        return np.concatenate(found)

    plain = 0.0
    for time, x in used:
        basis = _shapes(time, 1.0, 0.5)[:, :2]
        plain += float(np.sum((x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0]) ** 2))
    rows = sum(x.size for _, x in used)
    if plain / rows < 3 * noise**2:
        return None
    grid = [(np.log(f), d) for f in _FREQUENCIES for d in _DAMPINGS]
    misses = [float(np.sum(left(np.array(each)) ** 2)) for each in grid]
    if min(misses) > 0.5 * plain:
        return None
    from scipy.optimize import least_squares

    found = least_squares(
        left, grid[int(np.argmin(misses))], bounds=([np.log(0.2), 0.0], [np.log(20.0), 0.6])
    )
    log_frequency, damping = found.x
    variance = 2 * found.cost / rows * np.linalg.inv(found.jac.T @ found.jac)
    frequency = float(np.exp(log_frequency))
    amplitude = 0.0
    for time, x in used:
        basis = _shapes(time, frequency, damping)
        numbers = np.linalg.lstsq(basis, x, rcond=None)[0]
        amplitude = max(amplitude, float(np.linalg.norm(numbers[2:])))
    if amplitude < 3 * noise:
        return None
    return Swing(
        frequency, float(damping), amplitude, frequency * float(np.sqrt(variance[0, 0])),
        float(np.sqrt(variance[1, 1])),
    )  # fmt: skip


def settled(time: Array, values: Array, swing: Swing | None, *, last: float) -> Array:
    """Return the mean (c,) of values (m, c) in the `last` s of a window, without the swing."""
    rows = time > time[-1] - last
    if swing is None or rows.sum() < 12:
        return np.asarray(values[rows].mean(axis=0))
    basis = _shapes(time[rows], swing.frequency, swing.damping)[:, [0, 2, 3]]
    return np.asarray(np.linalg.lstsq(basis, values[rows], rcond=None)[0][0])


# -- regulators ------------------------------------------------------------------------------------


def delays_of(readings: StepReadings) -> Delays:
    """Fit a dead time and a lag to the response of each channel's gauge to its command."""
    r = readings
    found = []
    for step in r.steps:
        k = step.channel
        if np.isnan(r.measured[:, k]).all():
            found.append((np.nan,) * 5)
            continue
        up, down = (
            _delay(r, k, begin, min(begin + _LOOK, end))
            for begin, end in ((step.up, step.down), (step.down, step.end))
        )
        dead = [each[0] for each in (up, down) if np.isfinite(each[0])]
        found.append((float(np.mean(dead)) if dead else np.nan, up[1], down[1], up[2], down[2]))
    return Delays(*np.array(found).T)


def _delay(r: StepReadings, channel: int, begin: float, end: float) -> tuple[float, float, float]:
    """Return dead time and lag, in s, and rate, in Pa/s, of a channel after a step."""
    rows = (r.tick > begin - 0.1) & (r.tick <= end)
    time, y = r.tick[rows], r.measured[rows, channel]
    known = np.isfinite(y)
    if known.sum() < 10 or np.ptp(y[known]) < 0.2 * r.size:
        return np.nan, np.nan, np.nan
    history = (r.tick > begin - 0.6) & (r.tick <= end)
    moments, command = r.tick[history], r.commanded[history, channel]
    off = y[known] - y[known].mean()

    def miss(parameters: Sequence[float] | Array) -> float:
        dead, lag = float(parameters[0]), float(max(parameters[1], 0.0))
        x = np.interp(time[known] - dead, moments, _followed(moments, command, lag))
        x -= x.mean()
        return float(off @ off - (x @ off) ** 2 / max(float(x @ x), 1e-12))

    from scipy.optimize import minimize

    start = min(((dead, lag) for lag in _LAGS for dead in _DEAD_TIMES), key=miss)
    found = minimize(miss, start, method="Nelder-Mead", options={"xatol": 2e-4, "maxiter": 60})
    dead, lag = np.maximum(found.x, 0.0)
    share = (y[known] - y[known][:5].mean()) / (y[known][-20:].mean() - y[known][:5].mean())
    marks = [time[known][np.argmax(share >= level)] for level in _RISE]
    rate = (_RISE[1] - _RISE[0]) * np.ptp(command) / max(float(marks[1] - marks[0]), 1e-3)
    return float(dead), float(lag), float(rate)


def _followed(time: Array, command: Array, lag: float) -> Array:
    """Return pressures (m,) behind a lag in s; each command holds until the next."""
    return command if lag == 0 else lagged(time, command, lag, command[0])


# -- the tip ---------------------------------------------------------------------------------------


def tip_delay(readings: StepReadings, shift: Array, swing: Swing | None) -> float:
    """Estimate the delay in s of the tip behind the gauges, by the tracker's times.

    The tip's motion is regressed on the measured pressure, its creep and, if the arm swings, the
    response of a damped oscillator to it, all delayed by the same time. NaN without gauges.

    `shift`: displacements (n, 3) in the steps, in m. `swing`: of the tip, or None.
    """
    r, total = readings, np.zeros(len(_TIP_DELAYS))
    for step in r.steps:
        gauge = r.measured[:, step.channel]
        known = np.isfinite(gauge)
        rows = (r.time > step.up - 0.2) & (r.time < min(step.up + _LOOK, step.down))
        rows &= np.isfinite(r.position).all(axis=1)
        way = r.position[rows] @ shift[step.channel]
        if known.sum() < 50 or np.ptp(gauge[known]) < 0.2 * r.size or not rows.any():
            continue
        fine = np.arange(step.first - 0.3, step.up + _LOOK + 0.1, _FINE)
        pressure = np.interp(fine, r.tick[known], gauge[known])
        shapes = [pressure, _followed(fine, pressure, _CREEP)]
        if swing is not None:
            shapes.append(_oscillator(pressure, swing))
        for index, delay in enumerate(_TIP_DELAYS):
            moments = r.time[rows] - delay
            basis = np.stack(
                [np.ones_like(way), *(np.interp(moments, fine, each) for each in shapes)], axis=1
            )
            miss = way - basis @ np.linalg.lstsq(basis, way, rcond=None)[0]
            total[index] += float(miss @ miss) / float(shift[step.channel] @ shift[step.channel])
    return float(_TIP_DELAYS[np.argmin(total)]) if total.any() else np.nan


def _oscillator(driven: Array, swing: Swing) -> Array:
    """Return the response (m,) of a damped oscillator to an input, in steps of `_FINE`."""
    omega, damping = 2 * np.pi * swing.frequency, swing.damping
    found, speed = np.full_like(driven, driven[0]), 0.0
    for i in range(1, len(driven)):
        force = omega**2 * (driven[i - 1] - found[i - 1]) - 2 * damping * omega * speed
        speed += _FINE * force
        found[i] = found[i - 1] + _FINE * speed
    return found
