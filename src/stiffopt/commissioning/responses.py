"""Evaluate the readings at rest and in each step: poses, gauges, lags, swing and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.expected import rotation_vectors
from stiffopt.commissioning.procedure import ChannelStep, StepReadings
from stiffopt.commissioning.timing import Delays, Swing, delays_of, fit_swing, settled, tip_delay

_BEGIN = 0.25  # s after a step, in which the regulators still follow


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses to one step of each of n lines, in SI and in the base's axes."""

    # rest_position, rest_rotation: of the tip at rest (3,), and (3, 3) or None
    rest_position: Array
    rest_rotation: Array | None
    rest_noise: float  # standard deviation of `rest_position` in each axis
    # shift, turn: displacement and rotation vector (n, 3) in each step; `turn` is None without
    # orientations
    shift: Array
    turn: Array | None
    # shift_noise, turn_noise: their standard deviations (n,) in each axis due to tracker noise
    shift_noise: Array
    turn_noise: Array
    # share (n,) of the displacement that the tip lost during the hold; NaN after short holds
    drift: Array
    # noise, angular_noise: standard deviation of the tracker's samples at rest in each axis
    noise: float
    angular_noise: float
    # rate, latency, missing: of the tracker: samples per s, median age on arrival in s, share of
    # the samples in which the tip was not seen
    rate: float
    latency: float
    missing: float
    # gauge_offset, gauge_noise: mean and standard deviation of each gauge at rest (n,), in Pa; NaN
    # for a gauge without readings
    gauge_offset: Array
    gauge_noise: Array
    # (n, n), rise of gauge j (column) in the step of channel k (row), as a share of the step
    gauge: Array
    gauge_deviation: float  # standard deviation of these
    size: float  # of the steps, in Pa
    delays: Delays  # of the regulators, by channel
    tip_delay: float  # of the tip behind the gauges, beyond that of the arm's dynamics, in s
    swing: Swing | None  # of the tip, or None


def responses_of(readings: StepReadings) -> Responses:
    """Evaluate all readings of a commissioning."""
    r = readings
    seen = np.isfinite(r.position).all(axis=1)
    resting = seen & (r.time >= r.rest[0]) & (r.time <= r.rest[1])
    place, noise = _still(r.time[resting], r.position[resting])
    count = int(resting.sum())
    rotation, vectors, angular_noise = None, None, 0.0
    if r.quaternion is not None:
        mean = r.quaternion[resting].mean(axis=0)
        rotation = _rotations(mean[np.newaxis] / np.linalg.norm(mean))[0]
        vectors = np.full_like(r.position, np.nan)
        vectors[seen] = rotation_vectors(_rotations(r.quaternion[seen]) @ rotation.T)
        angular_noise = _still(r.time[resting], vectors[resting])[1]
    swing = fit_swing([_window(r, r.position, begin, end) for begin, end in _holds(r)], noise)
    shift, turn, drift = [], [], []
    rows = []
    for step in r.steps:
        moved, back, number = _response(r, r.position, step, swing)
        shift.append(moved)
        rows.append(number)
        drift.append(back)
        if vectors is not None:
            turn.append(_response(r, vectors, step, swing)[0])
    gauge_offset, gauge_noise, gauge, deviation = _gauges(r)
    spread = np.sqrt(2 / np.maximum(rows, 1))
    steps = np.diff(r.time[seen])
    return Responses(
        rest_position=place,
        rest_rotation=rotation,
        rest_noise=noise / np.sqrt(count),
        shift=np.array(shift),
        turn=None if vectors is None else np.array(turn),
        shift_noise=noise * spread,
        turn_noise=angular_noise * spread,
        drift=np.array(drift),
        noise=noise,
        angular_noise=angular_noise,
        rate=float(1 / np.median(steps)),
        latency=float(np.median(r.age)),
        missing=1 - float(seen.mean()),
        gauge_offset=gauge_offset,
        gauge_noise=gauge_noise,
        gauge=gauge,
        gauge_deviation=deviation,
        size=r.size,
        delays=delays_of(r),
        tip_delay=tip_delay(r, np.array(shift), swing),
        swing=swing,
    )


def _still(time: Array, values: Array) -> tuple[Array, float]:
    """Return the mean (3,) of readings at rest, and their deviation about a linear drift."""
    slopes = np.polyfit(time - time.mean(), values, 1)[0]
    rest = values - values.mean(axis=0) - np.outer(time - time.mean(), slopes)
    return values.mean(axis=0), float(np.sqrt(np.mean(rest**2)))


def _holds(r: StepReadings) -> list[tuple[float, float]]:
    """Return begin and end of each step's hold, and of the rest after it."""
    return [each for step in r.steps for each in ((step.up, step.down), (step.down, step.end))]


def _window(r: StepReadings, values: Array, begin: float, end: float) -> tuple[Array, Array]:
    """Return times (m,) since a step, and values (m, c), from when its regulator had followed."""
    rows = (r.time > begin + _BEGIN) & (r.time <= end) & np.isfinite(values).all(axis=1)
    return r.time[rows] - begin, values[rows]


def _response(
    r: StepReadings, values: Array, step: ChannelStep, swing: Swing | None
) -> tuple[Array, float, int]:
    """Return the change (c,) by a step, the share lost in a long hold, and the number of rows."""
    since = r.steps[r.steps.index(step) - 1].down if step.channel else r.rest[0] - _BEGIN
    before = settled(*_window(r, values, since, step.first), swing, last=1.5)
    after = settled(*_window(r, values, step.down, step.end), swing, last=1.5)
    time, held = _window(r, values, step.up, step.down)
    early = time < 3.5
    up = settled(time[early], held[early], swing, last=2.0)
    moved = up - (before + after) / 2
    back = np.nan
    if step.down - step.up > 8.0:
        late = settled(time, held, swing, last=3.0)
        back = 1 - float((late - before) @ (up - before)) / max(float(moved @ moved), 1e-18)
    return moved, back, int(early.sum())


def _gauges(r: StepReadings) -> tuple[Array, Array, Array, float]:
    """Return `gauge_offset`, `gauge_noise`, `gauge` and `gauge_deviation` of `Responses`."""
    resting = (r.tick >= r.rest[0]) & (r.tick <= r.rest[1])
    offset, noise = r.measured[resting].mean(axis=0), r.measured[resting].std(axis=0)
    rises, least = [], np.inf
    for step in r.steps:
        held = (r.tick > (step.up + step.down) / 2) & (r.tick <= step.down)
        free = (r.tick > (step.down + step.end) / 2) & (r.tick <= step.end)
        least = min(least, float(held.sum()), float(free.sum()))
        rises.append((r.measured[held].mean(axis=0) - r.measured[free].mean(axis=0)) / r.size)
    deviation = float(np.sqrt(2 / least) * np.nanmax([0.0, *noise])) / r.size
    return offset, noise, np.array(rises), deviation


def _rotations(quaternions: Array) -> Array:
    """Return rotations (N, 3, 3) of quaternions (N, 4), w first."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternions, scalar_first=True).as_matrix())
