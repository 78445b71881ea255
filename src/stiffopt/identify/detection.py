"""Detect errors of single logs, and correct them if the evidence is overwhelming.

Each log is checked for different clocks of pressures and tracker, for its beginning and for a
drift. Where the evidence is not overwhelming, recordings stay unchanged. A channel that does
nothing is told even then. Errors that logs share are in `stiffopt.identify.hypotheses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import PressureError
from stiffopt.identify.discrepancy import smooth_functions
from stiffopt.identify.recording import Recording
from stiffopt.identify.settings import DETECTION, SAMPLING
from stiffopt.identify.tracker_faults import whole
from stiffopt.model.calibration import distances_from
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import lagged
from stiffopt.model.manipulator import Manipulator

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
        expected = Manipulator(weightless(description)).tip_pose(pressures)[:, :3, 3]
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


def weightless(description: RobotDescription) -> RobotDescription:
    """Return the arm of a robot file without its weight, and without what it was calibrated to."""
    return description.model_copy(update={"gravity": (0.0, 0.0, 0.0), "calibration": None})
