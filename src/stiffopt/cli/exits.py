"""Exit codes of the commands."""

from collections.abc import Iterable

SOLVED = 0
BAD_INPUT = 2
UNREACHABLE = 3
FAILED = 4
FAULT = 5
"""The rig failed; it was vented."""
INTERRUPTED = 130
"""Ctrl-C."""
CLOSED_PIPE = 141
"""Whoever read the output has had enough (as a shell reports it for other programs)."""

OF_STATUS = {"solved": SOLVED, "unreachable": UNREACHABLE, "failed": FAILED}

_MOST_SERIOUS_FIRST = (BAD_INPUT, FAILED, UNREACHABLE)


def most_serious(codes: Iterable[int]) -> int:
    """Return the code that speaks for all: 2, then 4, then 3, then 0."""
    seen = set(codes)
    return next((code for code in _MOST_SERIOUS_FIRST if code in seen), SOLVED)
