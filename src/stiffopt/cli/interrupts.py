"""Ctrl-C that is not lost.

CasADi clears Python errors while it converts its arguments, a KeyboardInterrupt among them: the
work would go on, or stumble over a value that is missing. So the interrupt is repeated until it
has got through.
"""

import _thread
import signal
import threading
from types import FrameType, TracebackType

_REPEAT = 0.02  # s


class Interruptible:
    """Context in which Ctrl-C raises KeyboardInterrupt for certain."""

    def __init__(self) -> None:
        self._asked = False
        self._over = threading.Event()
        self._mine = False

    def __enter__(self) -> "Interruptible":
        in_main_thread = threading.current_thread() is threading.main_thread()
        if in_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._handle)
            self._mine = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        if self._mine:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed and has not got through yet."""
        if self._asked:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._over.is_set():
            return
        if not self._asked:
            self._asked = True
            threading.Thread(target=self._insist, daemon=True).start()
        raise KeyboardInterrupt

    def _insist(self) -> None:
        while not self._over.wait(_REPEAT):
            _thread.interrupt_main()
