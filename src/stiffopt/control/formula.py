"""Small formulas that are evaluated in each tick.

CasADi's machine takes a hundred of operations in the time of one NumPy call, which is what most of
a tick would consist of otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.native_calls import Buffer

__all__ = ["Formula"]

Array = NDArray[np.float64]


class Formula:
    """A function of arrays, from CasADi symbols to expressions; it belongs to one thread.

    Columns (k, 1) are given, and come, as (k,), and numbers come as (1,).

    Parameters
    ----------
    inputs, outputs :
        Symbols, and expressions of them.
    """

    def __init__(self, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        dense = ca.cse([ca.densify(output) for output in outputs])
        self._buffer = Buffer(ca.Function("formula", list(inputs), dense), 1)
        self._targets, self._evaluate = self._buffer.targets, self._buffer.evaluate
        self._results = [
            result[:, 0] if result.shape[1] == 1 else result for result in self._buffer.results
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """Values of the outputs."""
        for target, argument in zip(self._targets, arguments, strict=True):
            target[...] = argument
        self._evaluate()
        return [result.copy() for result in self._results]
