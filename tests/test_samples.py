"""Which rows of a log are fitted, and which its pressures cannot do without."""

from __future__ import annotations

import time as clock

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from made_logs import course, effective_pressures
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.past import Past, Start
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.settings import SAMPLING, CalibrationSettings
from stiffopt.identify.setup import begins, chosen_rows, sampled, thinned
from stiffopt.identify.validation import validate
from stiffopt.logs import Log
from stiffopt.model.history import History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

SPAN = np.full(3, 1.5e5)
TOLERANCE = 1e-3  # of the span
FINE = 0.04  # s; where commands change in every row they may be early or late by so much
ONE = load_description("stiff-flop-1")


def recording(time: Array, pressures: Array, position: Array | None = None) -> Recording:
    """A recording with a tip that tells its row, and another body."""
    index = np.arange(len(time), dtype=float)
    tip = np.column_stack([index, index, index]) if position is None else position
    turned = np.tile(np.eye(3), (len(time), 1, 1))
    tracks = (Track("tip", tip, turned), Track("mid", tip + 1, None))
    return Recording("a log", time, pressures, pressures[0], tracks, ("a remark",))


def ramps(seed: int = 0, duration: float = 400.0, rate: float = 20.0) -> tuple[Array, Array]:
    return course(3, duration, seed, rate=rate, hold=10.0)


def interpolated(smaller: Recording, time: Array) -> Array:
    columns = [np.interp(time, smaller.time, p) for p in smaller.pressures.T]
    return np.column_stack(columns)


def missed(smaller: Recording, time: Array, pressures: Array, rate: float) -> Array:
    """By what share of the span (N, 3) thinned commands were never commanded about that time."""
    around = 2 * int(np.ceil(FINE * rate) + 1) + 1
    lowest = minimum_filter1d(pressures, around, axis=0)
    highest = maximum_filter1d(pressures, around, axis=0)
    found = interpolated(smaller, time)
    return np.asarray(np.maximum(found - highest, lowest - found) / SPAN)


@pytest.mark.parametrize("kind", ["ramps", "steps", "waves", "noise"])
def test_thinned_commands_stay_within_the_tolerance(kind: str) -> None:
    time, pressures = ramps()
    random = np.random.default_rng(1)
    if kind == "steps":
        pressures = random.uniform(0, 1e5, (100, 3))[(time / 4).astype(int)]
    elif kind == "waves":
        pressures = 5e4 * (1 + np.sin(time[:, None] * [0.1, 0.3, 0.5]))
    elif kind == "noise":
        pressures = pressures + random.normal(0, 500, pressures.shape)
    time = time + random.uniform(-0.01, 0.01, len(time))
    wanted = np.sort(random.choice(len(time), 50, replace=False))
    smaller, places = thinned(recording(time, pressures), wanted, SPAN)
    assert missed(smaller, time, pressures, 20.0).max() <= TOLERANCE * (1 + 1e-9)
    error = np.abs(interpolated(smaller, time) - pressures) / SPAN
    assert np.quantile(error, 0.9) <= 2 * TOLERANCE
    assert (np.diff(smaller.time) > 0).all()
    assert smaller.time[places] == pytest.approx(time[wanted])
    assert smaller.pressures[places] == pytest.approx(pressures[wanted])
    share = len(smaller.time) / len(time)
    limits = {"ramps": 0.4, "steps": 0.4, "waves": 0.7, "noise": 1.0}
    assert share <= limits[kind]


def test_thinning_keeps_what_belongs_to_the_rows() -> None:
    time, pressures = ramps(duration=60.0)
    whole = recording(time, pressures)
    smaller, places = thinned(whole, np.array([3, 7, 500]), SPAN)
    assert smaller.tracks[0].position[places, 0] == pytest.approx([3, 7, 500])
    assert smaller.tracks[1].position[places, 0] == pytest.approx([4, 8, 501])
    assert smaller.tracks[0].rotation is not None
    assert len(smaller.tracks[0].rotation) == len(smaller.time)
    assert smaller.tracks[1].rotation is None
    assert smaller.name == whole.name
    assert smaller.remarks == whole.remarks
    assert smaller.before == pytest.approx(whole.before)
    assert (smaller.time[0], smaller.time[-1]) == (time[0], time[-1])


@pytest.mark.parametrize("count", [1, 2, 3, 63, 64, 65, 66])
def test_short_logs(count: int) -> None:
    time, pressures = ramps()
    smaller, places = thinned(
        recording(time[:count], pressures[:count]), np.array([count - 1]), SPAN
    )
    assert smaller.time[places] == pytest.approx(time[count - 1])
    assert interpolated(smaller, time[:count]) == pytest.approx(pressures[:count], abs=150.0)


def test_what_remains_has_the_same_history() -> None:
    history = History(lag=0.4, play=(Play(width=1e4, share=0.3),))
    time, pressures = ramps(seed=2)
    rows = np.arange(0, len(time), 40)
    smaller, places = thinned(recording(time, pressures), rows, SPAN)
    assert len(smaller.time) < 0.5 * len(time)
    past, start = Past(history, 3), Start.from_rest(history, pressures[0])
    whole = past.effective(time, pressures, rows, start, history)
    thin = past.effective(smaller.time, smaller.pressures, places, start, history)
    assert thin.pressures == pytest.approx(whole.pressures, abs=600.0)  # the play's kinks
    assert np.abs(thin.pressures - whole.pressures).mean() < 60.0


def test_chosen_rows_are_even_and_seen() -> None:
    time, pressures = ramps(duration=100.0)
    position = np.zeros((len(time), 3))
    position[100:1000] = np.nan
    position[1500, 1] = np.nan
    rows = chosen_rows(recording(time, pressures, position), 200)
    assert len(rows) == 200
    assert np.isfinite(position[rows]).all()
    assert (np.diff(rows) > 0).all()
    seen = np.cumsum(np.isfinite(position).all(axis=1))[rows]
    assert np.ptp(np.diff(seen)) <= 1
    assert len(chosen_rows(recording(time, pressures, position), 10_000)) == 2000 - 901


def test_a_sample() -> None:
    time, pressures = ramps(duration=100.0)
    whole = recording(time, pressures)
    found = sampled(whole, chosen_rows(whole, 50), SPAN, "unknown")
    assert len(found.rows) == 50
    assert found.begin == "unknown"
    assert found.weight == pytest.approx(np.ones(50))
    assert found.recording.tracks[0].position[found.rows[-1], 0] == len(time) - 1


def test_how_logs_begin() -> None:
    time = np.arange(3.0)
    states = {"zero": 0.0, "nearly": 0.01 * 1.5e5, "pressed": 0.3 * 1.5e5}
    logs = [recording(time, np.full((3, 3), p)) for p in states.values()]
    assert begins(logs, SPAN, sequence=False) == ["rest", "rest", "unknown"]
    assert begins(logs, SPAN, sequence=True) == ["rest", "previous", "previous"]
    assert begins(logs[::-1], SPAN, sequence=True) == ["unknown", "previous", "previous"]


def long_log(count: int) -> tuple[Log, Array]:
    """A log of a known arm at 100 Hz, without noise but in every hundredth row's reading."""
    true = with_values(
        ONE.model_copy(
            update={"segments": (ONE.segments[0].model_copy(update={"history": History(lag=0.5)}),)}
        ),
        {Parameter("segments[0].material.youngs_modulus"): 1.15e5},
    )
    time, pressures = course(3, count / 100, 3, rate=100.0, hold=5.0)
    assert len(time) == count
    # the first minutes again and again
    part = min(count, 20_000)
    times = -(-count // part)
    pressures = np.tile(pressures[:part] * np.linspace(0, 1, part)[::-1, None], (times, 1))[:count]
    u = effective_pressures(true, time[:part], pressures[:part])
    tip = np.tile(Manipulator(true).tip_pose(u)[:, :3, 3], (times, 1))[:count]
    tip = tip + np.random.default_rng(0).normal(0, 2e-4, tip.shape)
    return Log(time, pressures, tip), pressures


def test_a_million_rows_are_thinned_in_seconds() -> None:
    time, pressures = course(3, 10_000.0, 3, rate=100.0, hold=5.0)
    whole = recording(time, pressures)
    begun = clock.process_time()
    rows = chosen_rows(whole, 2000)
    smaller, places = thinned(whole, rows, SPAN)
    assert clock.process_time() - begun < 10
    assert len(time) == 1_000_000
    assert len(smaller.time) < 300_000
    assert smaller.time[places] == pytest.approx(time[rows])
    assert missed(smaller, time, pressures, 100.0).max() <= TOLERANCE * (1 + 1e-9)


@pytest.mark.long
def test_a_million_rows_are_calibrated_in_minutes() -> None:
    log, _ = long_log(1_000_000)
    begun = clock.process_time()
    result = calibrate(ONE, [("long", log)], settings=CalibrationSettings(structure="lag"))
    fitted = clock.process_time() - begun
    print(f"{fitted:.0f} s for {len(log)} rows")
    assert fitted < 300
    (found,) = (e for e in result.estimates if e.key.endswith("youngs_modulus"))
    assert found.value == pytest.approx(1.15e5, rel=0.03)
    assert result.calibrated[0].errors.mean < 0.5e-3
    assert result.calibrated[0].errors.n == SAMPLING.rows
    begun = clock.process_time()
    (compared,) = validate(result.robot, [("long", log)])
    assert clock.process_time() - begun < 100
    assert compared.errors.mean < 0.5e-3
