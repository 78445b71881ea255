"""Small formulas that every tick evaluates, compiled for CasADi's virtual machine.

The virtual machine runs a hundred operations in the time of one NumPy call. With NumPy, a tick
would take most of a period of 2 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from stiffopt.arrays import Array
from stiffopt.model.batch import Buffer


def are_within(bound: float, values: Array) -> bool:
    """Return whether all values (k,) lie between -`bound` and `bound`; False if one is NaN.

    For a few values this is quicker than NumPy.
    """
    return all(abs(value) <= bound for value in values.tolist())


class Formula:
    """A function of arrays, given by CasADi symbols and expressions; for one thread at a time.

    Columns (k, 1) are passed and returned as (k,); scalars are returned as (1,).

    Parameters
    ----------
    inputs, outputs : symbols, and expressions of them.
    matrices : inputs and outputs that stay matrices even with a single column, such as a Jacobian
        with one column per channel.
    before : a formula whose outputs are the first inputs. They stay where it leaves them, and are
        no arguments of a call.
    """

    def __init__(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        matrices: Sequence[Any] = (),
        before: Formula | None = None,
    ) -> None:
        dense = ca.cse([ca.densify(output) for output in outputs])
        function = ca.Function("formula", list(inputs), dense)
        self._buffer: Buffer = Buffer(function, 1, None if before is None else before._buffer)
        self._evaluate = self._buffer.evaluate
        own = {id(matrix) for matrix in matrices}
        asked = inputs[len(inputs) - len(self._buffer.targets) :]
        self._arguments = [
            target[:, None] if id(symbol) in own and target.ndim == 1 else target
            for symbol, target in zip(asked, self._buffer.targets, strict=True)
        ]
        self._results = [
            result[:, 0] if result.shape[1] == 1 and id(expression) not in own else result
            for expression, result in zip(outputs, self._buffer.results, strict=True)
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """Return the outputs' values."""
        return [result.copy() for result in self.view(*arguments)]

    def view(self, *arguments: Any) -> list[Array]:
        """Return the outputs' values, in memory that the next call overwrites."""
        for target, argument in zip(self._arguments, arguments, strict=True):
            target[...] = argument
        self._evaluate()
        return self._results

    def again(self, first: Any) -> list[Array]:
        """Return as `view` for another first argument; the others stay as they were."""
        self._arguments[0][...] = first
        self._evaluate()
        return self._results
