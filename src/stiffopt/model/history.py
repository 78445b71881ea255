"""Lag, hysteresis and creep: how the shape of a soft arm depends on past pressures.

The effective pressure u is the pressure at which an arm in equilibrium would have the present
shape. It follows from a channel's commanded pressure p by, in this order,

* a dead time and a first-order lag of regulator, tubes and silicone:
  ``lag x' = p(t - dead_time) - x``;
* hysteresis, by the play operators of Prandtl and Ishlinskii (M. A. Krasnosel'skii and
  A. V. Pokrovskii, Systems with Hysteresis, 1989): y_j follows x only when it is dragged along,
  ``x - width_j <= y_j <= x + width_j``;
* creep, ``time_k z_k' = x - z_k``;

and ``u = x + s`` with ``s = sum_j share_j (y_j - x) + sum_k share_k (z_k - x)``.

Silicone remembers its stretch rather than pressures, and its elongation more than its bending, so
chambers stay stretched after they were deflated.  A segment's elongation depends on the mean of its
pressures, and its bending on their deviations from it.  So an operator may act on one of these
parts instead of on each channel.  With the projection A on that part (elongation: 1/c everywhere
for c channels; bending: identity minus that), y_j and z_k follow ``A x``, and the operator adds
``share A (y_j - A x)``, which does not affect or depend on the other part.

Fibres opposite to a chamber stretch with the mean of all pressures, and shorten as their chamber
bends the segment away from them.  What they remember acts likewise, so operators of these fibres
have A = 2/c - identity.

Silicone that pressure makes softer, with a modulus of ``E (1 + c |x|)`` for the pressures x of a
segment, stretches further with each pressure: by the stress, and by the softening.  What it
remembers is a stress, which does not soften it.  So along x, where softening makes a pressure act
``1 / (1 + c |x|)`` times as much as at the same modulus, s counts less, ::

    u = x + s + c x (x . s) / |x|.

Such silicone also stretches further than its pressures rise, by as much as it softens.  Operators
may remember that strain instead: x is then the lagged ``v(p) = p / (1 + c |p|)``, which y_j and z_k
follow as above, all as pressures at the modulus of rest.  The stress s stretches a softer arm more,
and u is the pressure with the strain that results, ::

    v(u) = x + (1 - c |x|) s,    where 1 - c |x| = 1 / (1 + c |p|) for x = v(p).

Settled, and in the middle between loading and unloading, ``u = p``: a history does not change the
equilibrium, which the strain law describes.  After a long monotone change of all pressures u
differs from p by ``sum_j share_j width_j`` (without operators of bending), the most that it can;
operators of bending contribute up to twice as much.  Softening makes this less, along x.

This module does not depend on the rest of the model, so that a simulated plant, an estimator and a
calibration can use the same operators.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Duration, Number, Pressure, Ratio

Part = Literal["pressure", "elongation", "bending", "opposite"]
"""The pressures on which an operator acts.

``pressure``: that of each channel.  ``elongation``: the mean of all channels.  ``bending``: each
channel's deviation from the mean.  ``opposite``: twice the mean minus each channel's pressure,
which stretches the fibres opposite it."""

_Share = Annotated[Ratio, Field(ge=0, lt=1)]

_SAME = 1e-9  # s; times that differ by less are equal up to rounding
_NONE = 1e-3  # Pa; rounds the norm of pressures at zero
_CLOSE = 1e-3  # below it, a series is more accurate than a difference of exponentials


class Play(Schema):
    """One play operator.

    Attributes
    ----------
    width : half of the pressure change after a reversal before the operator follows, in Pa.
    share : share of the pressure that acts through the operator.
    of : part of the segment's pressures on which it acts.
    """

    width: Annotated[Pressure, Field(gt=0)]
    share: _Share
    of: Part = "pressure"


class Creep(Schema):
    """One slow state.

    Attributes
    ----------
    time : its time constant, in s.
    share : share of the pressure that acts through the operator.
    of : part of the segment's pressures on which it acts.
    """

    time: Annotated[Duration, Field(gt=0)]
    share: _Share
    of: Part = "pressure"


class History(Schema):
    """How the shape of a segment follows the pressures of its channels, all in the same way.

    Operators of pressure act on each channel alone, the others on all channels of the segment.

    Attributes
    ----------
    dead_time : delay before a pressure has any effect, in s.
    lag : time constant of its effect after that, in s.
    lag_falling : the same while the pressure falls, in s, as chambers empty at another rate than
        they fill; 0: the same.
    memory : factor on the shares of play and creep for each channel; one for all if empty.
    softening : c, relative change of the modulus per norm of the segment's pressures, in 1/Pa.
    remembers : what lag, play and creep follow: pressures, or the strain that pressures have at the
        modulus that `softening` leaves.
    play : hysteresis.
    creep : slow effects.
    """

    dead_time: Annotated[Duration, Field(ge=0)] = 0.0
    lag: Annotated[Duration, Field(ge=0)] = 0.0
    lag_falling: Annotated[Duration, Field(ge=0)] = 0.0
    memory: Items[Annotated[Ratio, Field(ge=0)]] = ()
    softening: Annotated[Number, Field(le=0)] = 0.0
    remembers: Literal["pressure", "strain"] = "pressure"
    play: Items[Play] = ()
    creep: Items[Creep] = ()

    @model_validator(mode="after")
    def _check(self) -> History:
        total = self.memory_at(0.0)
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
    def shares(self) -> tuple[float, float]:
        """Shares of elongation and of bending that act through operators, without `memory`."""
        of_elongation, of_bending = (
            sum(part.share for part in self.parts if part.of != other)
            for other in ("bending", "elongation")
        )
        return of_elongation, of_bending

    def memory_at(self, norm: float) -> float:
        """Return the largest share of a small change of pressures, of a norm in Pa, that is slow.

        With a memory of strain it grows as the modulus falls: the stress that is remembered
        stretches a softer arm further.
        """
        share = max(self.shares) * max(self.memory, default=1.0)
        return share / self.left(norm)

    def left(self, norm: float) -> float:
        """Return the share of the modulus that is left at a norm of pressures, in Pa.

        1 with a memory of pressure.
        """
        return 1 + self.softening * norm if self.remembers == "strain" else 1.0

    @property
    def quick_share(self) -> float:
        """Share of a small, quick change that has its effect at once, over all channels.

        Play and creep delay the rest.  What resists pressure also resists a push, so a quick small
        push meets an arm that is 1 / quick_share times as stiff as in equilibrium. This is a mean
        over the axis and the two directions across, where these differ; with a memory of strain, it
        is the share at low pressures (`quick_softening`).
        """
        memory = sum(self.memory) / len(self.memory) if self.memory else 1.0
        of_elongation, of_bending = self.shares
        return 1 - memory * (of_elongation + 2 * of_bending) / 3

    def quick_softening(self, softening: float, most: float) -> float:
        """Return the share of softening, from 0 to 1, against a quick push.

        With a memory of strain a push at pressures of norm p meets 1 / (1 - S / (1 + c p)) times
        the stiffness of equilibrium, where 1 - S is `quick_share`. The stiffness is taken as linear
        in p, and right at zero and at the norm `most`, in Pa. `softening`: that in equilibrium.
        """
        left, c = self.left(most), self.softening
        if left == 1:
            return softening
        share = self.quick_share
        of_rest = (1 + softening * c * most) * share / (1 - (1 - share) / left)
        return min(max((of_rest - 1) / (c * most), 0.0), 1.0)

    def remembered_shares(self, n_channels: int, span: float = 0.0) -> Array:
        """Return the shares (c,) of the channels' pressures that are still former ones.

        Pressures move within a range of `span` Pa. A play of half-width w keeps a former pressure
        with the probability 2 w / span that the next one lies within w of it; otherwise it follows.
        A creep keeps all of it for a time; by default plays do so too.
        """
        of_elongation, of_bending = (
            sum(
                part.share
                * (2 * part.width / max(span, 2 * part.width) if isinstance(part, Play) else 1)
                for part in self.parts
                if part.of != other
            )
            for other in ("bending", "elongation")
        )
        memory = np.array([self.memory_of(channel) for channel in range(n_channels)])
        return np.asarray(max(of_elongation, of_bending) * memory)

    @property
    def n_states(self) -> int:
        """Number of states of one channel: x, each y and each z."""
        return 1 + len(self.parts)

    def next_state(self, state: ca.SX, before: ca.SX, now: ca.SX, step: ca.SX) -> ca.SX:
        """Return the state (m, c) of a segment after a linear change of (delayed) pressures.

        Lag and creep are exact for any step.  Play is exact while its input is monotone, as under
        constant pressures where lags do not depend on the direction.

        Parameters
        ----------
        state : (m, c)
            Before the step, for each channel: x, every y_j, every z_k.
        before, now : (c,)
            Delayed pressures before and after the step, in Pa, as the operators follow them
            (`followed`).
        step : scalar
            In s, positive.
        """
        before, now = ca.SX(before).T, ca.SX(now).T
        ramp = (now - before) / step
        if ca.SX(self.lag).is_zero():
            start, transient, following = before, None, now
        else:  # x(t) = start + ramp t + transient exp(-t / lag)
            lag = self.lag
            if not ca.SX(self.lag_falling).is_zero():
                lag = ca.if_else(now < state[0, :], self.lag_falling, self.lag)
            start = before - ramp * lag
            transient = state[0, :] - start
            following = now - ramp * lag + transient * ca.exp(-step / lag)
        end: list[ca.SX] = [following]
        for index, play in enumerate(self.play, start=1):
            y, x = state[index, :], part_of(following, play.of)
            end.append(ca.fmax(x - play.width, ca.fmin(x + play.width, y)))
        for index, creep in enumerate(self.creep, start=1 + len(self.play)):
            decay = ca.exp(-step / creep.time)
            late = (1 - decay) * start + ramp * (step - creep.time * (1 - decay))
            if transient is not None:
                late += transient * _convolution(step / creep.time, step / lag)
            end.append(decay * state[index, :] + part_of(late, creep.of))
        return ca.vertcat(*end)

    def effective(self, state: Any, first: int = 0) -> Any:
        """Return the effective pressures u (1, c) of a state (m, c).

        `first` is the index of the first of these channels within its segment, from 0.
        """
        x = state[:1, :]
        channels = range(first, first + x.shape[1])
        memory = np.array([[self.memory_of(channel) for channel in channels]])
        slow = 0 * x
        for index, part in enumerate(self.parts, start=1):
            slow += part.share * part_of(state[index, :] - part_of(x, part.of), part.of)
        return self.with_memory(x, memory * slow)

    def followed(self, pressures: Any) -> Any:
        """Return what the operators follow at pressures p (..., c): p, or ``p / (1 + c |p|)``."""
        if self.remembers == "pressure" or not self.softening:
            return pressures
        return pressures / (1 + self.softening * _norm(pressures))

    def with_memory(self, x: Any, remembered: Any) -> Any:
        """Return u (..., c) where lagged pressures, or strains, are x and s is remembered."""
        if not self.softening:
            return x + remembered
        c = self.softening
        if self.remembers == "strain":
            v = x + (1 - c * _norm(x)) * remembered
            return v / (1 - c * _norm(v))
        along = _total(x * remembered) / _norm(x)
        return x + (remembered + c * along * x)

    def slopes_with_memory(self, x: Array, remembered: Array) -> tuple[Array, Array]:
        """Return the derivatives (N, c, c) of `with_memory` by both arguments (N, c)."""
        c, one, s = self.softening, np.eye(x.shape[-1]), remembered
        norm = _norm(x)[:, np.newaxis]

        def outer(a: Array, b: Array) -> Array:
            return a[:, :, np.newaxis] * b[:, np.newaxis]

        if self.remembers == "strain":
            v = x + (1 - c * norm[:, 0]) * s
            size = _norm(v)[:, np.newaxis]
            by_v = (one + c * outer(v, v) / (size * (1 - c * size))) / (1 - c * size)
            return by_v @ (one - c * outer(s, x) / norm), by_v * (1 - c * norm)
        along = _total(x * s)[:, np.newaxis] / norm
        by_x = c * (along * (one - outer(x, x) / norm**2) + outer(x, s) / norm)
        return one + by_x, one + c * outer(x, x) / norm

    def memory_of(self, channel: int) -> float:
        """Return the factor on the shares of a channel of the segment, from 0."""
        return self.memory[channel] if len(self.memory) else 1.0

    def settled(self, pressures: Array, sides: Array) -> Array:
        """Return the state (m, c) of channels long after pressures (c,) were reached.

        Parameters
        ----------
        pressures :
            In Pa.
        sides :
            Position of each channel within its play (c,): -1 after a long rise, 1 after a long
            fall, 0 in the middle. Operators of elongation take the mean of the channels.
        """
        x = self.followed(pressures)
        rows = [x]
        rows += [part_of(x + sides * play.width, play.of) for play in self.play]
        rows += [part_of(x, creep.of) for creep in self.creep]
        return np.array(rows)

    def from_rest(self, pressures: Array) -> Array:
        """Return the state (m, c) long after the first rise from zero pressure."""
        x = self.followed(pressures)
        rows = [x]
        for play in self.play:
            part = part_of(x, play.of)
            rows.append(np.clip(0.0, part - play.width, part + play.width))
        rows += [part_of(x, creep.of) for creep in self.creep]
        return np.array(rows)


NO_HISTORY = History()


def part_of(pressures: Any, of: Part) -> Any:
    """Return the part of a segment's pressures (..., c) on which an operator acts, same shape."""
    if of == "pressure":
        return pressures
    mean = _total(pressures) / pressures.shape[-1]
    if of == "opposite":
        return 2 * mean - pressures
    return mean + 0 * pressures if of == "elongation" else pressures - mean


def _total(values: Any) -> Any:
    """Return the sum (..., 1) over channels (..., c)."""
    return values.sum(axis=-1, keepdims=True) if isinstance(values, np.ndarray) else ca.sum2(values)


def _norm(pressures: Any) -> Any:
    """Return the norm (..., 1) of pressures (..., c), rounded at zero."""
    return (_total(pressures**2) + _NONE**2) ** 0.5


def _convolution(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return ``int_0^1 a exp(-a (1 - t)) exp(-b t) dt``, also for equal rates a and b."""
    gap = ca.fabs(a - b)
    far = ca.fmax(gap, _CLOSE)
    series = 1 - gap / 2 * (1 - gap / 3 * (1 - gap / 4))
    mean = ca.if_else(gap < _CLOSE, series, (1 - ca.exp(-far)) / far)
    return a * ca.exp(-ca.fmin(a, b)) * mean


class Memory:
    """State of the histories of all channels of an arm, advanced in time.

    A ``copy.copy`` of it is independent.

    Parameters
    ----------
    histories : sequence
        One per channel; None for a channel without delay or memory.
    places : sequence of int, optional
        Index of each channel within its segment, from 0: channels with the same history and
        consecutive places form a segment. By default each is a segment of its own.

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
        self._histories = [history or NO_HISTORY for history in histories]
        self._places = list(places or [0] * len(histories))
        self._groups = self._segments()
        sizes = [h.n_states * (own.stop - own.start) for h, own in self._groups]
        self._ends = np.cumsum(sizes)
        self._dead_times = np.array([history.dead_time for history in self._histories])
        self._delays = np.unique(self._dead_times)
        self._late = bool(self._dead_times.any())
        self._step = self._step_function()
        self.effective: Array
        self.start(np.zeros(len(self._histories)))

    def start(self, pressures: ArrayLike) -> None:
        """Set the state of an arm that was brought from zero pressure to these (n,), in Pa."""
        p = self._checked(pressures)
        self._begin([h.from_rest(p[own]) for h, own in self._groups], p)

    def settle(self, pressures: ArrayLike, side: float = 0.0) -> None:
        """Set the state of an arm long at these pressures (n,); `side` as in `History.settled`."""
        p = self._checked(pressures)
        self._begin([h.settled(p[own], np.full(len(p[own]), side)) for h, own in self._groups], p)

    def advance(self, step: float, pressures: ArrayLike) -> Array:
        """Advance time at constant commanded pressures (n,); return the effective ones (n,).

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

        The result does not depend on how a time of constant pressures is divided into steps.

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

    def _segments(self) -> list[tuple[History, slice]]:
        """Return the histories of the segments, each with the slice of its channels."""
        starts = [
            c
            for c, place in enumerate(self._places)
            if c == 0
            or place != self._places[c - 1] + 1
            or self._histories[c] != self._histories[c - 1]
        ]
        ends = [*starts[1:], len(self._places)]
        return [(self._histories[a], slice(a, b)) for a, b in zip(starts, ends, strict=True)]

    def _begin(self, states: list[Array], pressures: Array) -> None:
        self._state = np.concatenate([state.ravel(order="F") for state in states])
        self._time = 0.0
        self._times = np.array([-np.inf])  # start times of the commands (k, n)
        self._commands = pressures[None, :]
        effective = [
            h.effective(x, self._places[own.start])[0]
            for (h, own), x in zip(self._groups, states, strict=True)
        ]
        self.effective = np.concatenate(effective)

    def _follow_late(self, step: float, pressures: Array) -> Array:
        """Return effective pressures (m, n) after equal steps at (m, n), with dead times."""
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
        return at_marks[np.searchsorted(marks, ends[1:]) - 1]

    def _marks(self, times: Array, ends: Array) -> Array:
        """Return the ends of steps (m + 1,) and the times between when commands take effect."""
        acting = (times[1:, None] + self._delays).ravel()
        acting = acting[(acting > ends[0] + _SAME) & (acting < ends[-1] - _SAME)]
        if not len(acting):
            return ends
        after = np.searchsorted(ends, acting)
        gap = np.minimum(acting - ends[after - 1], ends[after] - acting)
        acting = np.sort(acting[gap > _SAME])
        acting = acting[np.diff(acting, prepend=-np.inf) > _SAME]
        return np.sort(np.concatenate([ends, acting]))

    def _follow(self, steps: float | Array, delayed: Array) -> Array:
        """Return effective pressures (k, n) after steps (k,) at delayed pressures (k, n)."""
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
        ends, effective = [], []
        for (h, own), part in zip(self._groups, parts, strict=True):
            p = h.followed(delayed[own].T).T
            ends.append(h.next_state(ca.reshape(part, h.n_states, -1), p, p, step))
            effective.append(h.effective(ends[-1], self._places[own.start]).T)
        outputs = [ca.vertcat(*(ca.vec(end) for end in ends)), ca.vertcat(*effective)]
        return ca.Function("advance", [state, delayed, step], [ca.densify(x) for x in outputs])

    def _checked(self, pressures: ArrayLike, *, rows: bool = False) -> Array:
        p = np.array(pressures, dtype=float)
        n = len(self._histories)
        if p.ndim != 1 + rows or p.shape[-1] != n:
            expected = f"rows of {n} pressures" if rows else f"{n} pressures"
            raise InputError(f"expected {expected}, not an array of shape {p.shape}")
        if not np.isfinite(p).all():
            raise InputError("expected finite pressures")
        return p


def lagged(time: Array, inputs: Array, lag: float, start: ArrayLike) -> Array:
    """Return the outputs (N, ...) of a first-order lag at times (N,), from `start` on.

    Each of the inputs (N, ...) holds until the next time; the last one has no effect.
    """
    outputs = np.empty_like(inputs)
    outputs[0] = start
    for i, share in enumerate(-np.expm1(-np.diff(time) / lag)):
        outputs[i + 1] = outputs[i] + share * (inputs[i] - outputs[i])
    return outputs
