"""Which pressures are sampled: sample i is a function of i (and of a seed) alone.

So any stretch of samples can be computed anywhere, and the pressures of a sample are known from
its number.  All is integer arithmetic but for the last step, which rounds the same everywhere.
"""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import InputError

Vector = NDArray[np.float64]

MOST_SAMPLES = 10**12


@dataclass(frozen=True)
class Sampling(ABC):
    """Pressures between limits, by number.

    Attributes
    ----------
    lower, upper : limits of each channel, in Pa.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    @abstractmethod
    def total(self) -> int:
        """Number of samples."""

    @abstractmethod
    def shares(self, start: int, stop: int) -> Vector:
        """Samples start to stop - 1 as shares (k, n) of each channel's range, 0 to 1."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """What makes these samples what they are, as plain data."""

    def pressures(self, start: int, stop: int) -> Vector:
        """Pressures (k, n) of samples start to stop - 1, in Pa."""
        lower, upper = np.array(self.lower), np.array(self.upper)
        return np.asarray(lower + (upper - lower) * self.shares(start, stop))


@dataclass(frozen=True)
class QuasiRandom(Sampling):
    """Additive recurrence with the generalised golden ratio (M. Roberts, 2018), in 64 bits.

    Sample i is ``frac(shift + (i + 1) ratio^-j)`` of the range of channel j, in fixed point; the
    seed gives the shifts.

    Attributes
    ----------
    count : number of samples.
    seed : shifts the sequence.
    """

    count: int
    seed: int = 0

    @property
    def total(self) -> int:
        """Number of samples."""
        return self.count

    def shares(self, start: int, stop: int) -> Vector:
        """Samples start to stop - 1 as shares (k, n) of each channel's range, 0 to below 1."""
        n = len(self.lower)
        steps = np.array(_golden_steps(n), dtype=np.uint64)
        shifts = np.array([_shift(self.seed, channel) for channel in range(n)], dtype=np.uint64)
        numbers = np.arange(start + 1, stop + 1, dtype=np.uint64)
        fixed = numbers[:, np.newaxis] * steps + shifts  # modulo 2^64
        return np.asarray((fixed >> np.uint64(11)).astype(np.float64) * 2.0**-53)

    def record(self) -> dict[str, Any]:
        """Kind, count and seed."""
        return {"sampling": "quasi-random", "samples": self.count, "seed": self.seed}


@dataclass(frozen=True)
class Grid(Sampling):
    """Equally spaced levels of each channel, limits included; the last channel runs fastest.

    Attributes
    ----------
    levels : of each channel, at least 2.
    """

    levels: int

    @property
    def total(self) -> int:
        """Number of samples: levels to the power of the number of channels."""
        return int(self.levels ** len(self.lower))

    def shares(self, start: int, stop: int) -> Vector:
        """Samples start to stop - 1 as shares (k, n) of each channel's range, 0 to 1."""
        left = np.arange(start, stop, dtype=np.int64)
        digits = np.empty((len(left), len(self.lower)))
        for channel in reversed(range(len(self.lower))):
            left, digits[:, channel] = np.divmod(left, self.levels)
        return digits / (self.levels - 1)

    def record(self) -> dict[str, Any]:
        """Kind, levels and the number of samples that they make."""
        return {"sampling": "grid", "samples": self.total, "levels": self.levels}


def checked_sampling(sampling: Sampling) -> Sampling:
    """Raise if there are more samples than anyone can wait for."""
    if sampling.total > MOST_SAMPLES:
        raise InputError(
            f"{sampling.total:.3g} samples are too many; expected at most {MOST_SAMPLES:.0e}. "
            "Take fewer levels, or quasi-random samples"
        )
    return sampling


@cache
def _golden_steps(n: int) -> tuple[int, ...]:
    """Steps of the recurrence per channel in units of 2^-64; the ratio solves r^(n+1) = r + 1."""
    with localcontext() as context:
        context.prec = 60
        ratio, change = Decimal(2), Decimal(1)
        while abs(change) > Decimal("1e-50"):  # Newton from above: each step is nearer
            change = (ratio ** (n + 1) - ratio - 1) / ((n + 1) * ratio**n - 1)
            ratio -= change
        return tuple(int(2**64 / ratio**power) for power in range(1, n + 1))


def _shift(seed: int, channel: int) -> int:
    digest = hashlib.sha256(f"stiffopt workspace {seed} {channel}".encode()).digest()
    return int.from_bytes(digest[:8], "big")
