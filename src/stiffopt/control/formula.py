"""Small formulas that every tick evaluates, compiled for CasADi's virtual machine.

The virtual machine runs a hundred operations in the time of one NumPy call. With NumPy, a tick
would take most of a period of 2 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.batch import Buffer

Array = NDArray[np.float64]


def are_within(bound: float, values: Array) -> bool:
    """Whether the size of each value (k,) is at most `bound`; that of NaN is not.

    For a few values this is quicker than NumPy.
    """
    return all(abs(value) <= bound for value in values.tolist())


class Formula:
    """A function of arrays, given by CasADi symbols and expressions; for one thread at a time.

    Columns (k, 1) are passed and returned as (k,); scalars are returned as (1,).

    Parameters
    ----------
    inputs, outputs :
        Symbols, and expressions of them.
    matrices :
        Inputs and outputs that stay matrices even with a single column, such as a Jacobian with
        one column per channel.
    """

    def __init__(
        self, inputs: Sequence[Any], outputs: Sequence[Any], matrices: Sequence[Any] = ()
    ) -> None:
        dense = ca.cse([ca.densify(output) for output in outputs])
        self._buffer = Buffer(ca.Function("formula", list(inputs), dense), 1)
        self._evaluate = self._buffer.evaluate
        own = {id(matrix) for matrix in matrices}
        self._arguments = [
            target[:, None] if id(symbol) in own and target.ndim == 1 else target
            for symbol, target in zip(inputs, self._buffer.targets, strict=True)
        ]
        self._results = [
            result[:, 0] if result.shape[1] == 1 and id(expression) not in own else result
            for expression, result in zip(outputs, self._buffer.results, strict=True)
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """Return the outputs' values."""
        for target, argument in zip(self._arguments, arguments, strict=True):
            target[...] = argument
        self._evaluate()
        return [result.copy() for result in self._results]
