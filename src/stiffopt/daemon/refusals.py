"""Why a request is not done: a status, a word for programs and a sentence for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stiffopt.errors import CommandError, InputError, StiffoptError, dotted, printable

__all__ = ["RefusedError", "refusal_of", "sentence"]

_TOLD = 5  # mistakes told at once
_LONGEST = 1000  # characters of a message


class RefusedError(StiffoptError):
    """A request that is not done.

    Parameters
    ----------
    status :
        The HTTP status.
    code :
        A word for programs.
    message :
        A sentence for people.
    """

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(status, code, message)
        self.status = status
        self.code = code
        self.message = printable(message)[:_LONGEST]

    def __str__(self) -> str:
        return self.message

    @property
    def body(self) -> dict[str, Any]:
        """What the client is sent."""
        return {"error": {"code": self.code, "message": self.message}}


def refusal_of(error: StiffoptError) -> RefusedError:
    """Return what a client is told of an error of the control loop."""
    if isinstance(error, RefusedError):
        return error
    if isinstance(error, InputError) and not isinstance(error, CommandError):
        return RefusedError(422, "input", str(error))
    return RefusedError(409, "refused", str(error))


def sentence(mistakes: Sequence[Any]) -> str:
    """Return what pydantic found wrong as one sentence."""
    told = []
    for mistake in mistakes[:_TOLD]:
        place = dotted([step for step in mistake["loc"] if not str(step).startswith("<")])
        reason = str(mistake["msg"])
        told.append(f"{place}: {reason}" if place else reason)
    more = f"; and {len(mistakes) - _TOLD} more" if len(mistakes) > _TOLD else ""
    return "; also ".join(told) + more
