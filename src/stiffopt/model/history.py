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
equilibrium, which is the business of the strain law.  After a long monotone way u differs from p
by ``sum_j share_j width_j``, the most that it can.

This module knows nothing of the rest of the model, so that a simulated plant, an estimator and a
calibration can run the same operators.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Annotated

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from stiffopt.errors import InputError
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Pressure, Ratio

__all__ = ["Creep", "History", "Memory", "Play"]

Array = NDArray[np.float64]

_Share = Annotated[Ratio, Field(ge=0, lt=1)]


class Play(Schema):
    """One play operator.

    Attributes
    ----------
    width : half of the way that a pressure must go back before the operator follows, in Pa.
    share : of the pressure that acts through it.
    """

    width: Annotated[Pressure, Field(gt=0)]
    share: _Share


class Creep(Schema):
    """One slow state.

    Attributes
    ----------
    time : its time constant, in s.
    share : of the pressure that acts through it.
    """

    time: Annotated[Duration, Field(gt=0)]
    share: _Share


class History(Schema):
    """How the shape of a segment follows the pressures of its channels, all in the same way.

    Attributes
    ----------
    dead_time : until a pressure has any effect, in s.
    lag : time constant with which it then has its effect, in s.
    play : hysteresis.
    creep : slow effects.
    """

    dead_time: Annotated[Duration, Field(ge=0)] = 0.0
    lag: Annotated[Duration, Field(ge=0)] = 0.0
    play: Items[Play] = ()
    creep: Items[Creep] = ()

    @model_validator(mode="after")
    def _check(self) -> History:
        total = sum(part.share for part in self.parts)
        if total >= 1:
            raise BadKeyError(
                "play" if self.play else "creep",
                f"the shares of play and creep add up to {total:g}; expected less than 1",
            )
        return self

    @property
    def parts(self) -> tuple[Play | Creep, ...]:
        """What has a share, in the order of its states."""
        return (*self.play, *self.creep)

    @property
    def largest_memory(self) -> float:
        """How far hysteresis can take the shape from equilibrium, as a pressure, in Pa."""
        return sum(part.share * part.width for part in self.play)

    @property
    def n_states(self) -> int:
        """Number of states of one channel: x, each y and each z."""
        return 1 + len(self.parts)

    def next_state(self, state: ca.SX, before: ca.SX, now: ca.SX, step: ca.SX) -> ca.SX:
        """State (m,) of a channel after a step, through which the (delayed) pressure runs evenly.

        Parameters
        ----------
        state : (m,)
            Before the step: x, every y_j, every z_k.
        before, now : scalar
            Delayed pressure before and after the step, in Pa.
        step : scalar
            In s, positive.
        """
        x = state[0]
        if ca.SX(self.lag).is_zero():
            following = now
        else:  # x - p + lag p' decays; p' is constant
            decay = ca.exp(-step / self.lag)
            behind = self.lag / step * (now - before)
            following = now - behind + (x - before + behind) * decay
        end: list[ca.SX] = [following]
        for index, play in enumerate(self.play, start=1):
            y = state[index]
            end.append(ca.fmax(following - play.width, ca.fmin(following + play.width, y)))
        for index, creep in enumerate(self.creep, start=1 + len(self.play)):
            z, decay = state[index], ca.exp(-step / creep.time)
            end.append(decay * z + (1 - decay) * (x + following) / 2)
        return ca.vertcat(*end)

    def effective(self, state: ca.SX) -> ca.SX:
        """Pressure u that in equilibrium would give the shape which belongs to a state (m,)."""
        x = u = state[0]
        for index, part in enumerate(self.parts, start=1):
            u = u + part.share * (state[index] - x)
        return u

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


class Memory:
    """The histories of all channels of an arm, run as time goes by.

    Parameters
    ----------
    histories : sequence
        One per channel; None for a channel whose shape follows at once.
    """

    def __init__(self, histories: Sequence[History | None]) -> None:
        self._histories = [history or NO_HISTORY for history in histories]
        self._ends = np.cumsum([history.n_states for history in self._histories])
        self._dead_times = np.array([history.dead_time for history in self._histories])
        self._step = self._step_function()
        self._state = np.zeros(self._ends[-1])
        self._time = 0.0
        self._commands: deque[tuple[float, Array]] = deque()
        self.effective = np.zeros(len(self._histories))
        self.start(np.zeros(len(self._histories)))

    def start(self, pressures: ArrayLike) -> None:
        """Begin anew with an arm that was brought from no pressure to these (n,), in Pa."""
        p = self._checked(pressures)
        self._begin([h.from_rest(v) for h, v in zip(self._histories, p.tolist(), strict=True)], p)

    def settle(self, pressures: ArrayLike, side: float = 0.0) -> None:
        """Begin anew with an arm long at these pressures (n,); `side` as in `History.settled`."""
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
        if not step > 0:
            raise InputError(f"a step takes time; expected a positive number of s, not {step!r}")
        self._commands.append((self._time, self._checked(pressures)))
        self._time += step
        delayed = self._delayed_to(self._time - self._dead_times)
        state, effective = self._step(self._state, delayed, step)
        self._state, self.effective = np.asarray(state)[:, 0], np.asarray(effective)[:, 0]
        return self.effective

    def _begin(self, states: list[Array], pressures: Array) -> None:
        self._state = np.concatenate(states)
        self._time = 0.0
        self._commands.clear()
        self._commands.append((-np.inf, pressures))
        parts = np.split(self._state, self._ends[:-1])
        self.effective = np.array(
            [float(h.effective(ca.DM(x))) for h, x in zip(self._histories, parts, strict=True)]
        )

    def _delayed_to(self, times: Array) -> Array:
        """Pressures (n,) that were commanded at one time (n,) for each channel."""
        while len(self._commands) > 1 and self._commands[1][0] < times.min():
            self._commands.popleft()
        delayed = np.empty(len(times))
        for channel, time in enumerate(times):
            sent = next(p for at, p in reversed(self._commands) if at < time)
            delayed[channel] = sent[channel]
        return delayed

    def _step_function(self) -> ca.Function:
        state, delayed = ca.SX.sym("state", self._ends[-1]), ca.SX.sym("p", len(self._histories))
        step = ca.SX.sym("step")
        parts = ca.vertsplit(state, [0, *self._ends.tolist()])
        ends = [
            h.next_state(x, delayed[c], delayed[c], step)
            for c, (h, x) in enumerate(zip(self._histories, parts, strict=True))
        ]
        effective = [h.effective(x) for h, x in zip(self._histories, ends, strict=True)]
        return ca.Function(
            "advance", [state, delayed, step], [ca.vertcat(*ends), ca.vertcat(*effective)]
        )

    def _checked(self, pressures: ArrayLike) -> Array:
        p = np.array(pressures, dtype=float)
        if p.shape != (len(self._histories),) or not np.isfinite(p).all():
            raise InputError(f"expected {len(self._histories)} finite pressures, not {p}")
        return p
