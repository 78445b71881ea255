"""Calls that may hang, in threads that cannot keep the process from ending."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any


def call_in_thread(name: str, function: Callable[[], Any]) -> Future[Any]:
    """Call a function in a new daemon thread; the future has its result or exception."""
    call: Future[Any] = Future()
    call.set_running_or_notify_cancel()  # it cannot be cancelled

    def run() -> None:
        try:
            call.set_result(function())
        except BaseException as error:
            call.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return call


def ends_within(seconds: float, call: Future[Any]) -> bool:
    """Wait for a call for at most so many seconds; return whether it has ended."""
    return bool(wait([call], max(seconds, 0.0)).done)
