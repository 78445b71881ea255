"""The errors of stiffopt: each says what was wrong, where, and what to do about it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec

MAX_MISTAKES = 10
"""How many mistakes of a file one message tells."""
Loc = tuple[str | int, ...]
"""The place of a value in nested data: keys, and indices of items counted from 0."""


class StiffoptError(Exception):
    """Root of every error that stiffopt raises on purpose."""


class InputError(StiffoptError, ValueError):
    """Something given to stiffopt, in a file or in a call, is wrong.

    It is a `ValueError` too, which is what a Python caller expects of a bad argument.
    """


class FileError(InputError):
    """A file cannot be read or written, or says something wrong.

    Parameters
    ----------
    path :
        The file, as the user named it.
    reason :
        What is wrong and what was expected, as one sentence.
    line :
        Line number, counted from 1, if one line is to blame.
    key :
        Dotted key such as ``target.position[0]``, if one key is to blame.
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
        """Support pickling, so that the error crosses process boundaries whole."""
        return _rebuild_file_error, (self.path, self.own_reason, self.line, self.key, self.others)


def _rebuild_file_error(
    path: str, reason: str, line: int | None, key: str | None, others: Sequence[FileError]
) -> FileError:
    return FileError(path, reason, line=line, key=key, others=others)


class PressureError(InputError):
    """Pressures are not finite, have the wrong shape or drive the modulus to zero."""


class EquilibriumError(StiffoptError):
    """The arm has no stable equilibrium that is reached continuously from rest.

    It buckles or falls over on the way to the pressures and loads asked for.
    """


class DerivativeError(StiffoptError):
    """An answer has no derivatives: it is no strict optimum."""


class StoppedError(StiffoptError):
    """A computation was ended before it had a result.

    Attributes
    ----------
    found :
        What there was by then, for example the first points of a trade-off; None if nothing.
    """

    found: object = None


class OutOfTimeError(StoppedError, TimeoutError):
    """The time that a call was given is over."""


class CancelledError(StoppedError):
    """The caller no longer wants what he asked for."""


class MissingExtraError(StiffoptError):
    """An optional package is needed that is not installed.

    Parameters
    ----------
    package :
        Name of the missing package, for example ``matplotlib``.
    extra :
        Name of stiffopt's extra that brings it, for example ``plot``.
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

    Parameters
    ----------
    package, extra :
        As for `MissingExtraError`.
    module :
        Name under which it is imported, if that differs from `package`.
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
    """The guard has vented by itself; the message says why. No device need have failed."""


class CommandError(InputError):
    """A command to the rig is refused; nothing was written to any device."""


class ServiceError(StiffoptError, ConnectionError):
    """The daemon cannot be reached, or does not answer in time.

    Whether it did what it was asked to is not known then.
    """


class SlowWarning(UserWarning):
    """Machine code cannot be made or kept here; the same results come more slowly."""


class UnfitWarning(UserWarning):
    """A robot file was read whose calibration missed its own recordings widely."""


def os_reason(error: OSError | ValueError) -> str:
    """Return why the operating system refused a file, as the end of a sentence."""
    return (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)


def shown(value: object) -> str:
    """Return a value as an error message shows it: text in quotes, on one line, never long."""
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
    """Return a place as people write it: ``target.position[0]``."""
    text = ""
    for step in loc:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return printable(text)
