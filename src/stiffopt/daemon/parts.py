"""Work that may hang, and is not waited for longer than that is worth."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

__all__ = ["Part"]


class Part:
    """Some work in a thread of its own, which keeps nothing from ending.

    Parameters
    ----------
    name :
        Of the thread.
    work :
        Is begun at once.

    Attributes
    ----------
    error : what the work has raised, if anything.
    """

    def __init__(self, name: str, work: Callable[[], Any]) -> None:
        self.name = name
        self.error: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ends_within(self, seconds: float) -> bool:
        """Wait for some time at most; return whether the work has ended."""
        self._thread.join(max(seconds, 0.0))
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self.error = error
