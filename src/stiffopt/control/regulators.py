"""Pressures in the chambers, estimated from commands and readings, and their effect on the arm.

Each regulator follows its set-point after a dead time, as a first-order lag of limited slew::

    tau x' = u + b - x

Readings correct the pressure x and the offset b, so that the model follows a regulator that
saturates, leaks or is slightly off. An arm with hysteresis or creep has the shape of another
pressure, the effective one (`stiffopt.model.history`).

The discrete lag ``x += (1 - exp(-h / tau)) (u - x)``, limited by the slew, is in four places that
must not share code: here with readings as feedback; in `stiffopt.safety.expected_pressure` as a
bound that no reading may move; in the simulated plant, against which the others are tested; and in
`stiffopt.model.history`, exact for steps of any length, for calibration. A test checks that they
agree where they describe the same regulator.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.control.channels import Channels
from stiffopt.control.formula import Formula
from stiffopt.control.lags import LagEstimator
from stiffopt.control.tuning import LagTuning, RegulatorTuning
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History, Memory
from stiffopt.rig.settings import ControlSettings


class RegulatorModel:
    """Pressures behind the regulators of n channels, in steps of `period`, in s.

    The regulators have lags (n,) and a dead time, in s, and a greatest slew (n,), in Pa/s. The
    healthy range has the least and greatest pressures of regulators that follow at once, or more
    slowly than these by a factor (`RegulatorTuning.slow`). Readings do not correct that range.
    """

    def __init__(
        self,
        period: float,
        lag: ArrayLike,
        dead_time: float,
        slew: Array,
        tuning: RegulatorTuning | None = None,
    ) -> None:
        self._period, tuning = period, tuning or RegulatorTuning()
        lag = np.broadcast_to(np.asarray(lag, dtype=float), len(slew))
        self.set_lag(lag)
        slow = _share(period, tuning.slow * lag), round(tuning.slow * dead_time / period) + 1
        depth = round(dead_time / period) + 1
        self._depth = max(depth, slow[1])
        self._step = _step(slew * period, depth, slow, period, tuning)
        self.begin(np.zeros(len(slew)))

    def set_lag(self, lag: Array) -> None:
        """Change the lags (n,), in s."""
        self._share = _share(self._period, lag)

    def begin(self, pressures: Array) -> None:
        """Restart, settled at pressures (n,)."""
        state = np.tile(pressures, (5 + self._depth, 1))
        state[1] = 0.0
        self._set(state)

    def _set(self, state: Array) -> None:
        """Set the state (5 + k, n); its last rows are k commands under way, the oldest first."""
        self._state = state
        self.pressures: Array = state[0]  # now, in Pa
        self.offset: Array = state[1]  # b, in Pa: settled pressures relative to commands
        self.ahead: Array = state[2]  # a dead time from now; no further command can change them
        self.healthy: Array = state[3:5]  # healthy range (2, n), in Pa

    def advance(self, commanded: Array, reading: Array) -> Array:
        """Take a step with commands (n,) and, at its end, readings (n,); NaN: not measured.

        Return the pressures (n,) after it, in Pa.
        """
        (state,) = self._step(self._state, commanded, reading, self._share)
        self._set(state)
        return self.pressures


class PressureEstimator:
    """Commanded, chamber and effective pressures of an arm, in steps of `period`, in s.

    The robot may have a history: hysteresis, creep, and a lag that replaces the regulators'.
    """

    def __init__(
        self,
        robot: RobotDescription,
        control: ControlSettings,
        period: float,
        slew: Array,
        tuning: RegulatorTuning,
        channels: Channels,
        lag_tuning: LagTuning | None = None,
    ) -> None:
        lag, self.dead_time = _regulation(robot, control)
        self.lag = float(np.mean(lag))  # of all channels, in s
        self._robot, self._period, self.channels = robot, period, channels
        self.lags_are_regulators = not _has_lags(robot)  # not those of the arm as well
        self._regulators = RegulatorModel(period, lag, self.dead_time, slew, tuning)
        self._lag_tuning = lag_tuning or LagTuning()
        self.lags: LagEstimator | None = None
        if control.adaptation != "none" and self.lags_are_regulators:
            self.lags = LagEstimator(period, lag, self.dead_time, slew, self._lag_tuning)
        self._modelled_lags = lag
        self.begin()

    def begin(self) -> None:
        """Restart with a vented arm; adapted lags stay."""
        zero = np.zeros(self._robot.n_pressures)
        self._memory = _memory(self._robot)
        self._regulators.begin(zero)
        if self.lags is not None:
            self.lags.begin()
        self.channels.begin()
        self.command = zero  # last commanded pressures, in Pa
        self.chamber = zero  # pressures in the chambers
        self.effective = zero  # pressures that would give a settled arm its present shape
        self.history_offset = zero  # effective pressures relative to those in the chambers
        self.effective_ahead = zero  # effective pressures a dead time from now
        # settled effective pressures relative to commands (n,), in Pa; they contain the part of the
        # regulators' offset that commands may compensate
        self.command_offset = zero

    def advance(self, steps: int, commanded: Array, reading: Array) -> None:
        """Take steps with commands (n,) and readings (n,) in Pa; NaN: not measured."""
        for _ in range(steps):
            self.chamber = self._regulators.advance(commanded, reading)
            if self.lags is not None:
                self.lags.advance(commanded, reading, self.channels.lost)
        elapsed, offset = steps * self._period, self._regulators.offset
        self.channels.update(elapsed, commanded, reading, offset, self._regulators.healthy)
        self.command = commanded.copy()
        self.effective = self.chamber
        if self._memory is not None:
            self.effective = self._memory.advance(steps * self._period, self.chamber)
        self.history_offset = self.effective - self.chamber
        self.effective_ahead = self._regulators.ahead + self.history_offset
        self.command_offset = self.history_offset + self.channels.compensated

    def adapt(self) -> bool:
        """Use the adapted lags from now on, at rest; return whether that changes anything."""
        if self.lags is None:
            return False
        found = self.lags.lag
        if (np.abs(np.log(found / self._modelled_lags)) < self._lag_tuning.change).all():
            return False
        self._modelled_lags, self.lag = found, float(np.mean(found))
        self._regulators.set_lag(found)
        return True


def _share(period: float, lag: Array) -> Array:
    """Return the shares (n,) of their way that pressures with lags (n,) go in a step."""
    return 1 - np.exp(-period / np.maximum(lag, 1e-6))


def _step(
    reach: Array, depth: int, slow: tuple[Array, int], period: float, tuning: RegulatorTuning
) -> Formula:
    """Return the formula of a step of the state (5 + k, n), see `RegulatorModel`.

    Inputs: the state, commands and readings (n,), and the share (n,) of its way that a pressure
    goes in a step. Of the k commands under way the pressures know the last `depth`; `slow` are
    share and depth of the slowest healthy regulators.
    """
    n, most = len(reach), max(depth, slow[1])
    state, commanded = ca.SX.sym("state", 5 + most, n), ca.SX.sym("commanded", n)
    reading, share = ca.SX.sym("reading", n), ca.SX.sym("share", n)
    x, offset, low, high = (state[row, :].T for row in (0, 1, 3, 4))
    sent = ca.vertcat(state[6:, :], commanded.T)

    def limited(change: Any) -> Any:
        return ca.fmin(ca.fmax(change, -ca.DM(reach)), ca.DM(reach))

    def lagged(x: Any, offset: Any, command: Any) -> Any:
        return x + limited(share * (command.T + offset - x))

    now = lagged(x, offset, sent[most - depth, :])
    error = ca.if_else(ca.fabs(reading) < np.inf, reading - now, 0)  # 0 for NaN
    offset_after = offset + tuning.offset_gain * period**2 * error / share
    now = now + min(1.0, tuning.pressure_gain * period) * error
    ahead = now
    for k in range(most - depth + 1, most):
        ahead = lagged(ahead, offset_after, sent[k, :])
    late = sent[most - slow[1] :, :]
    least, greatest = (
        ca.vertcat(*(choose(late[:, k]) for k in range(n))) for choose in (ca.mmin, ca.mmax)
    )
    low = ca.fmin(least, low + limited(ca.DM(slow[0]) * (least - low)))
    high = ca.fmax(greatest, high + limited(ca.DM(slow[0]) * (greatest - high)))
    after = ca.vertcat(ca.horzcat(now, offset_after, ahead, low, high).T, sent)
    return Formula([state, commanded, reading, share], [after], [state, after])


def _regulation(robot: RobotDescription, control: ControlSettings) -> tuple[Array, float]:
    """Return lags (n,) and dead time, in s, of the robot file or, if unknown there, of the rig.

    The control loop needs the likeliest values; `safety.expected_pressure` uses the slowest.
    """
    lags, dead_time = [], control.regulator_dead_time
    for segment in robot.segments:
        history = segment.history
        own = history is not None and history.lag > 0
        lags += [history.lag if own and history else control.regulator_lag] * segment.n_channels
        if own and history is not None:
            dead_time = history.dead_time or dead_time
    return np.array(lags), dead_time


def _has_lags(robot: RobotDescription) -> bool:
    """Return whether the robot file has lags; such a lag includes that of the arm."""
    return any(s.history is not None and s.history.lag > 0 for s in robot.segments)


def _memory(robot: RobotDescription) -> Memory | None:
    """Return hysteresis and creep of a rested arm; the regulators' model has the lags."""
    histories: list[History | None] = []
    places: list[int] = []
    for segment in robot.segments:
        history = segment.history
        if history is not None:
            without_lag = {"lag": 0.0, "lag_falling": 0.0, "dead_time": 0.0}
            history = history.model_copy(update=without_lag)
        histories += [history] * segment.n_channels
        places += list(range(segment.n_channels))
    if not any(history is not None and history.parts for history in histories):
        return None
    return Memory(histories, places)
