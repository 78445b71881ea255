"""The errors of stiffopt: each message says what was wrong, where, and what to do about it."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from traceback import walk_stack

MAX_MISTAKES = 10
"""Largest number of mistakes of a file in one message."""
Loc = tuple[str | int, ...]
"""The place of a value in nested data: keys, and indices of items counted from 0."""


class StiffoptError(Exception):
    """Root of every error that stiffopt raises on purpose."""


class InputError(StiffoptError, ValueError):
    """Something given to stiffopt, in a file or in a call, is wrong.

    It is also a `ValueError`, as Python callers expect for a bad argument.
    """


class FileError(InputError):
    """A file cannot be read or written, or its content is wrong.

    Parameters
    ----------
    path :
        The file, as the user named it.
    reason :
        What is wrong and what was expected, as one sentence.
    line :
        Line number, counted from 1, if the mistake is on one line.
    key :
        Dotted key such as ``target.position[0]``, if the mistake is at one key.
    others :
        The file's further mistakes.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        reason: str,
        *,
        line: int | None = None,
        key: str | None = None,
        others: Sequence[FileError] = (),
    ) -> None:
        super().__init__(path, reason, line, key)
        self.path = os.fspath(path)
        self.line = line
        self.key = key
        self.others = tuple(others)
        self.own_reason = reason
        for other in self.others[: MAX_MISTAKES - 1]:
            reason += f"; also line {other.line or 0}: {other.key or ''}: {other.own_reason}"
        more = len(self.others) + 1 - MAX_MISTAKES
        self.reason = f"{reason}; and {more} more" if more > 0 else reason

    def __str__(self) -> str:
        return self._placed(self.reason)

    @property
    def alone(self) -> str:
        """The text without the file's other mistakes."""
        return self._placed(self.own_reason)

    def _placed(self, reason: str) -> str:
        where = self.path if self.line is None else f"{self.path}:{self.line}"
        return f"{where}: {self.key}: {reason}" if self.key else f"{where}: {reason}"

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling with all fields, so that the error can cross process boundaries."""
        return _rebuild_file_error, (self.path, self.own_reason, self.line, self.key, self.others)


def _rebuild_file_error(
    path: str, reason: str, line: int | None, key: str | None, others: Sequence[FileError]
) -> FileError:
    return FileError(path, reason, line=line, key=key, others=others)


class PressureError(InputError):
    """Pressures are not finite, have the wrong shape or are outside the strain law's range."""


class EquilibriumError(StiffoptError):
    """The arm has no stable equilibrium that is reached continuously from rest.

    It buckles or falls over on the way to the pressures and loads asked for.
    """


class DerivativeError(StiffoptError):
    """An answer has no derivatives: it is not a strict optimum."""


class StoppedError(StiffoptError):
    """A computation was stopped before it had a result.

    Attributes
    ----------
    found :
        Results so far, for example the first points of a trade-off; None if there are none.
    """

    found: object = None


class OutOfTimeError(StoppedError, TimeoutError):
    """A call's timeout has passed."""


class CancelledError(StoppedError):
    """The caller cancelled the computation."""


class MissingExtraError(StiffoptError):
    """An optional package is needed but not installed.

    Parameters
    ----------
    package :
        Name of the missing package, for example ``matplotlib``.
    extra :
        Name of stiffopt's extra that includes it, for example ``plot``.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(package, extra)
        self.package = package
        self.extra = extra

    def __str__(self) -> str:
        return (
            f"this needs {self.package}, which is not installed; "
            f"run: pip install 'stiffopt[{self.extra}]'"
        )


def require_package(package: str, extra: str, module: str | None = None) -> None:
    """Raise `MissingExtraError` if an optional package is not installed; it is not imported.

    `package`, `extra`: as for `MissingExtraError`. `module`: name under which it is imported, if
    that differs from `package`.
    """
    try:
        found = find_spec(module or package) is not None
    except ValueError:  # a placeholder in sys.modules
        found = False
    if not found:
        raise MissingExtraError(package, extra)


class DeviceError(StiffoptError):
    """A device of the rig cannot be reached, does not answer or answers nonsense."""


class GuardTripped(DeviceError):  # noqa: N818
    """The guard has vented on its own; the message says why. It need not be a device failure."""


class CommandError(InputError):
    """A command to the rig is rejected; nothing was written to any device."""


class ServiceError(StiffoptError, ConnectionError):
    """The daemon cannot be reached, or does not answer in time.

    It is then unknown whether it carried out the request.
    """


class SlowWarning(UserWarning):
    """Machine code cannot be compiled or stored here; results are the same but slower."""


def warn_slow(text: str) -> None:
    """Give a `SlowWarning` at the line of the program that called this package."""
    outermost = 1
    for level, (frame, _) in enumerate(walk_stack(sys._getframe()), start=1):
        if str(frame.f_globals.get("__name__")).partition(".")[0] == __package__:
            outermost = level
    warnings.warn(text, SlowWarning, stacklevel=outermost + 1)


class UnfitWarning(UserWarning):
    """The calibration of a robot file missed its own recordings by far."""


def os_reason(error: OSError | ValueError) -> str:
    """Return the operating system's reason for an error, as the end of a sentence."""
    return (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)


def shown(value: object) -> str:
    """Return a value for an error message: text in quotes, on one line, never long."""
    if hasattr(value, "tolist"):  # of NumPy
        value = value.tolist()
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    try:
        text = f"'{printable(value[:100])}'" if isinstance(value, str) else repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a huge {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:56]}...{text[-1]}"


def printable(text: str) -> str:
    """Return text with line breaks and control characters escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def dotted(loc: Sequence[str | int]) -> str:
    """Return a place in readable form: ``target.position[0]``."""
    text = ""
    for step in loc:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return printable(text)
