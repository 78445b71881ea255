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

from stiffopt.model.batch import Buffer

__all__ = ["Formula"]

Array = NDArray[np.float64]


class Formula:
    """A function of arrays, from CasADi symbols to expressions; it belongs to one thread.

    Columns (k, 1) are given, and come, as (k,), and numbers come as (1,).

    Parameters
    ----------
    inputs, outputs :
        Symbols, and expressions of them.
    matrices :
        Those of them that stay matrices with a single column: with a column for each channel, say.
    """

    def __init__(
        self, inputs: Sequence[Any], outputs: Sequence[Any], matrices: Sequence[Any] = ()
    ) -> None:
        dense = ca.cse([ca.densify(output) for output in outputs])
        self._buffer = Buffer(ca.Function("formula", list(inputs), dense), 1)
        self._evaluate = self._buffer.evaluate
        own = {id(matrix) for matrix in matrices}
        self._targets = [
            target[:, None] if id(symbol) in own and target.ndim == 1 else target
            for symbol, target in zip(inputs, self._buffer.targets, strict=True)
        ]
        self._results = [
            result[:, 0] if result.shape[1] == 1 and id(expression) not in own else result
            for expression, result in zip(outputs, self._buffer.results, strict=True)
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """Values of the outputs."""
        for target, argument in zip(self._targets, arguments, strict=True):
            target[...] = argument
        self._evaluate()
        return [result.copy() for result in self._results]
