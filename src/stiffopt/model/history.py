"""How the shape of a soft arm lags behind its pressures, and remembers them.

Between a channel's commanded pressure p and the pressure u that an arm in equilibrium would need
for the shape that it has are, in this order,

* a dead time and a first-order lag of regulator, tubes and silicone:
  ``lag x' = p(t - dead_time) - x``;
* hysteresis, by the play operators of Prandtl and Ishlinskii (M. A. Krasnosel'skii and
  A. V. Pokrovskii, Systems with Hysteresis, 1989): y_j follows x only when it is dragged along,
  ``x - width_j <= y_j <= x + width_j``;
* creep, ``time_k z_k' = x - z_k``;

and ``u = x + sum_j share_j (y_j - x) + sum_k share_k (z_k - x)``.

Settled, and in the middle between loading and unloading, ``u = p``: a history says nothing about
equilibrium, which the strain law describes.  After a long monotone way u differs from p
by ``sum_j share_j width_j``, the most that it can.

This module knows nothing of the rest of the model, so that a simulated plant, an estimator and a
calibration can run the same operators.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from stiffopt.errors import InputError
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Pressure, Ratio

Array = NDArray[np.float64]

_Share = Annotated[Ratio, Field(ge=0, lt=1)]

_SAME = 1e-9  # s; moments that are closer are one, whatever was lost by rounding
_CLOSE = 1e-3  # below it, a series is better than a difference of exponentials


class Play(Schema):
    """One play operator.

    Attributes
    ----------
    width : half of the way that a pressure must go back before the operator follows, in Pa.
    share : share of the pressure that acts through the operator.
    """

    width: Annotated[Pressure, Field(gt=0)]
    share: _Share


class Creep(Schema):
    """One slow state.

    Attributes
    ----------
    time : its time constant, in s.
    share : share of the pressure that acts through the operator.
    """

    time: Annotated[Duration, Field(gt=0)]
    share: _Share


class History(Schema):
    """How the shape of a segment follows the pressures of its channels, all in the same way.

    Attributes
    ----------
    dead_time : until a pressure has any effect, in s.
    lag : time constant with which it then has its effect, in s.
    lag_falling : the same while the pressure falls, in s, as chambers empty otherwise than they
        fill; 0: the same.
    memory : of each channel, factor on the shares of play and creep; one for all if empty.
    play : hysteresis.
    creep : slow effects.
    """

    dead_time: Annotated[Duration, Field(ge=0)] = 0.0
    lag: Annotated[Duration, Field(ge=0)] = 0.0
    lag_falling: Annotated[Duration, Field(ge=0)] = 0.0
    memory: Items[Annotated[Ratio, Field(ge=0)]] = ()
    play: Items[Play] = ()
    creep: Items[Creep] = ()

    @model_validator(mode="after")
    def _check(self) -> History:
        total = sum(part.share for part in self.parts) * max(self.memory, default=1.0)
        if total >= 1:
            raise BadKeyError(
                "play" if self.play else "creep",
                f"the shares of play and creep add up to {total:g}; expected less than 1",
            )
        return self

    @property
    def parts(self) -> tuple[Play | Creep, ...]:
        """The operators that have a share, in the order of their states."""
        return (*self.play, *self.creep)

    @property
    def largest_memory(self) -> float:
        """How far hysteresis can take the shape from equilibrium, as a pressure, in Pa.

        Of a channel with another `memory` it is that many times as far.
        """
        return sum(part.share * part.width for part in self.play)

    @property
    def quick_share(self) -> float:
        """Share of a small, quick change that has its effect at once, of all channels together.

        Play and creep hold on to the rest; what holds against pressure holds against a push too,
        so that such a push meets an arm that is 1 / quick_share times as stiff as in equilibrium.
        """
        memory = sum(self.memory) / len(self.memory) if self.memory else 1.0
        return 1 - memory * sum(part.share for part in self.parts)

    @property
    def n_states(self) -> int:
        """Number of states of one channel: x, each y and each z."""
        return 1 + len(self.parts)

    def next_state(self, state: ca.SX, before: ca.SX, now: ca.SX, step: ca.SX) -> ca.SX:
        """State (m,) of a channel after a step in which the (delayed) pressure changes linearly.

        Lag and creep are exact however long the step.  So is play while the lagged pressure runs
        one way, which it does under a constant pressure.

        Parameters
        ----------
        state : (m,)
            Before the step: x, every y_j, every z_k.
        before, now : scalar
            Delayed pressure before and after the step, in Pa.
        step : scalar
            In s, positive.
        """
        ramp = (now - before) / step
        if ca.SX(self.lag).is_zero():
            start, transient, following = before, None, now
        else:  # x(t) = start + ramp t + transient exp(-t / lag)
            lag = self.lag
            if not ca.SX(self.lag_falling).is_zero():
                lag = ca.if_else(now < state[0], self.lag_falling, self.lag)
            start = before - ramp * lag
            transient = state[0] - start
            following = now - ramp * lag + transient * ca.exp(-step / lag)
        end: list[ca.SX] = [following]
        for index, play in enumerate(self.play, start=1):
            y = state[index]
            end.append(ca.fmax(following - play.width, ca.fmin(following + play.width, y)))
        for index, creep in enumerate(self.creep, start=1 + len(self.play)):
            decay = ca.exp(-step / creep.time)
            late = (1 - decay) * start + ramp * (step - creep.time * (1 - decay))
            if transient is not None:
                late += transient * _convolution(step / creep.time, step / lag)
            end.append(decay * state[index] + late)
        return ca.vertcat(*end)

    def effective(self, state: ca.SX, channel: int = 0) -> ca.SX:
        """Pressure u at which an arm in equilibrium has the shape of this state (m,)."""
        x = u = state[0]
        for index, part in enumerate(self.parts, start=1):
            u = u + self.memory_of(channel) * part.share * (state[index] - x)
        return u

    def memory_of(self, channel: int) -> float:
        """Factor on the shares of a channel of the segment, from 0."""
        return self.memory[channel] if len(self.memory) else 1.0

    def settled(self, pressure: float, side: float) -> Array:
        """State (m,) long after a pressure was reached.

        Parameters
        ----------
        pressure :
            In Pa.
        side :
            Where in its play each operator is: -1 after a long rise, 1 after a long fall, 0 in the
            middle.
        """
        plays = [pressure + side * play.width for play in self.play]
        return np.array([pressure, *plays, *[pressure] * len(self.creep)])

    def from_rest(self, pressure: float) -> Array:
        """State (m,) long after a rise from no pressure, on an arm that knew none before."""
        widths = [play.width for play in self.play]
        plays = [float(np.clip(0.0, pressure - w, pressure + w)) for w in widths]
        return np.array([pressure, *plays, *[pressure] * len(self.creep)])


NO_HISTORY = History()


def _convolution(a: ca.SX, b: ca.SX) -> ca.SX:
    """``int_0^1 a exp(-a (1 - t)) exp(-b t) dt``, also where the rates a and b are the same."""
    apart = ca.fabs(a - b)
    far = ca.fmax(apart, _CLOSE)
    series = 1 - apart / 2 * (1 - apart / 3 * (1 - apart / 4))
    mean = ca.if_else(apart < _CLOSE, series, (1 - ca.exp(-far)) / far)
    return a * ca.exp(-ca.fmin(a, b)) * mean


class Memory:
    """State of the histories of all channels of an arm, advanced in time.

    A ``copy.copy`` of it is independent of it.

    Parameters
    ----------
    histories : sequence
        One per channel; None for a channel whose shape follows at once.
    places : sequence of int, optional
        Index of each channel within its segment, from 0; matters where memories differ.

    Attributes
    ----------
    effective : ndarray
        Effective pressures (n,) now, in Pa.
    """

    def __init__(
        self, histories: Sequence[History | None], places: Sequence[int] | None = None
    ) -> None:
        if not histories:
            raise InputError("expected the history of at least one channel")
        self._places = list(places or [0] * len(histories))
        self._histories = [history or NO_HISTORY for history in histories]
        self._ends = np.cumsum([history.n_states for history in self._histories])
        self._dead_times = np.array([history.dead_time for history in self._histories])
        self._delays = np.unique(self._dead_times)
        self._late = bool(self._dead_times.any())
        self._step = self._step_function()
        self.effective: Array
        self.start(np.zeros(len(self._histories)))

    def start(self, pressures: ArrayLike) -> None:
        """Set the state of an arm that was brought from no pressure to these (n,), in Pa."""
        p = self._checked(pressures)
        self._begin([h.from_rest(v) for h, v in zip(self._histories, p.tolist(), strict=True)], p)

    def settle(self, pressures: ArrayLike, side: float = 0.0) -> None:
        """Set the state of an arm long at these pressures (n,); `side` as in `History.settled`."""
        p = self._checked(pressures)
        self._begin(
            [h.settled(v, side) for h, v in zip(self._histories, p.tolist(), strict=True)], p
        )

    def advance(self, step: float, pressures: ArrayLike) -> Array:
        """Let time pass at constant commanded pressures (n,) and return the effective ones (n,).

        Parameters
        ----------
        step :
            In s, positive.
        pressures :
            In Pa.
        """
        self.run(step, self._checked(pressures)[None, :])
        return self.effective

    def run(self, step: float, pressures: ArrayLike) -> Array:
        """Take one step at each row of commanded pressures.

        The result does not depend on how a time of constant pressures is cut into steps.

        Parameters
        ----------
        step :
            In s, positive.
        pressures :
            Constant during each step (m, n), in Pa.

        Returns
        -------
        Effective pressures (m, n) at the end of each step, in Pa.
        """
        if not 0 < step < math.inf:
            raise InputError(f"a step takes time; expected a positive number of s, not {step!r}")
        p = self._checked(pressures, rows=True)
        if not len(p):
            return p
        effective = self._follow_late(step, p) if self._late else self._follow(step, p)
        self.effective = effective[-1].copy()
        return effective

    def _begin(self, states: list[Array], pressures: Array) -> None:
        self._state = np.concatenate(states)
        self._time = 0.0
        self._times = np.array([-np.inf])  # from when on each of the commands (k, n) was given
        self._commands = pressures[None, :]
        self.effective = np.array(
            [
                float(h.effective(ca.DM(x), c))
                for h, x, c in zip(self._histories, states, self._places, strict=True)
            ]
        )

    def _follow_late(self, step: float, pressures: Array) -> Array:
        """Effective pressures (m, n) after equal steps at pressures (m, n), dead times included."""
        ends: Array = self._time + step * np.arange(len(pressures) + 1, dtype=np.float64)
        times = np.concatenate([self._times, ends[:-1]])
        commands = np.concatenate([self._commands, pressures])
        marks = self._marks(times, ends)
        middles = (marks[1:] + marks[:-1]) / 2
        sent = np.searchsorted(times, middles[:, None] - self._dead_times, side="right") - 1
        delayed = commands[sent, np.arange(len(self._histories))]
        at_marks = self._follow(np.diff(marks), delayed)
        self._time = float(ends[-1])
        oldest = np.searchsorted(times, self._time - self._delays[-1], side="right") - 1
        self._times, self._commands = times[oldest:], commands[oldest:]
        effective: Array = at_marks[np.searchsorted(marks, ends[1:]) - 1]
        return effective

    def _marks(self, times: Array, ends: Array) -> Array:
        """Ends of steps (m + 1,) and, between them, moments at which a command begins to act."""
        acting = (times[1:, None] + self._delays).ravel()
        acting = acting[(acting > ends[0] + _SAME) & (acting < ends[-1] - _SAME)]
        if not len(acting):
            return ends
        after = np.searchsorted(ends, acting)
        apart = np.minimum(acting - ends[after - 1], ends[after] - acting)
        acting = np.sort(acting[apart > _SAME])
        acting = acting[np.diff(acting, prepend=-np.inf) > _SAME]
        return np.sort(np.concatenate([ends, acting]))

    def _follow(self, steps: float | Array, delayed: Array) -> Array:
        """Effective pressures (k, n) after steps (k,) at constant delayed pressures (k, n)."""
        state, end = self._state.copy(), np.empty_like(self._state)
        p, step, u = np.empty(delayed.shape[1]), np.empty(1), np.empty(delayed.shape[1])
        # A call with arrays costs ten times as much as one in place.
        buffer, take = self._step.buffer()
        for place, values in enumerate((state, p, step)):
            buffer.set_arg(place, values.data)
        for place, values in enumerate((end, u)):
            buffer.set_res(place, values.data)
        effective = np.empty_like(delayed)
        for i, duration in enumerate(np.broadcast_to(steps, len(delayed)).tolist()):
            p[:], step[0] = delayed[i], duration
            take()
            state[:], effective[i] = end, u
        self._state = state
        return effective

    def _step_function(self) -> Any:
        state, delayed = ca.SX.sym("state", self._ends[-1]), ca.SX.sym("p", len(self._histories))
        step = ca.SX.sym("step")
        parts = ca.vertsplit(state, [0, *self._ends.tolist()])
        ends = [
            h.next_state(x, delayed[c], delayed[c], step)
            for c, (h, x) in enumerate(zip(self._histories, parts, strict=True))
        ]
        effective = [
            h.effective(x, c) for h, x, c in zip(self._histories, ends, self._places, strict=True)
        ]
        outputs = [ca.densify(ca.vertcat(*ends)), ca.densify(ca.vertcat(*effective))]
        return ca.Function("advance", [state, delayed, step], outputs)

    def _checked(self, pressures: ArrayLike, *, rows: bool = False) -> Array:
        p = np.array(pressures, dtype=float)
        n = len(self._histories)
        if p.ndim != 1 + rows or p.shape[-1] != n:
            expected = f"rows of {n} pressures" if rows else f"{n} pressures"
            raise InputError(f"expected {expected}, not an array of shape {p.shape}")
        if not np.isfinite(p).all():
            raise InputError("expected finite pressures")
        return p
