"""Which state may follow which, and what may be asked for in each."""

from __future__ import annotations

from stiffopt.control.state import State
from stiffopt.errors import CommandError

__all__ = ["ARMED", "Lifecycle"]

ARMED = frozenset({State.ACTIVE, State.HOLDING})
"""States in which there may be pressure."""

_FOLLOWING = {
    State.UNCONFIGURED: {State.INACTIVE, State.FAULT},
    State.INACTIVE: {State.ACTIVE, State.FAULT},
    State.ACTIVE: {State.HOLDING, State.INACTIVE, State.FAULT},
    State.HOLDING: {State.ACTIVE, State.INACTIVE, State.FAULT},
    State.FAULT: {State.INACTIVE},
}

_ALLOWED = {
    "configure": {State.UNCONFIGURED, State.INACTIVE},
    "arm": {State.INACTIVE},
    "set a task": ARMED,
    "set a target": ARMED,
    "follow a trajectory": ARMED,
    "hold": ARMED,
    "disarm": {State.UNCONFIGURED, State.INACTIVE, *ARMED},
    "reset": {State.FAULT},
}

_ADVICE = {
    State.UNCONFIGURED: "configure first, or wait until that is done",
    State.INACTIVE: "it is vented; arm first",
    State.ACTIVE: "disarm first",
    State.HOLDING: "disarm first",
    State.FAULT: "it is vented; find the reason, then reset",
}


class Lifecycle:
    """The state of a control loop, and why it is so.

    Attributes
    ----------
    state : State
        Now.
    reason : str
        Why, where it is not as asked.
    """

    def __init__(self) -> None:
        self.state = State.UNCONFIGURED
        self.reason = ""

    @property
    def armed(self) -> bool:
        """Whether there may be pressure."""
        return self.state in ARMED

    def change(self, state: State, reason: str = "") -> None:
        """Go to another state.

        Raises
        ------
        CommandError
            It cannot follow this one.
        """
        if state not in _FOLLOWING[self.state]:
            raise CommandError(f"{state} cannot follow {self.state}")
        self.state, self.reason = state, reason

    def permit(self, request: str) -> None:
        """Refuse a request that does not suit the state.

        Raises
        ------
        CommandError
            It says what to do instead.
        """
        if self.state not in _ALLOWED[request]:
            advice = _ADVICE[self.state] if request != "reset" else "there is no fault"
            why = f" ({self.reason})" if self.state is State.FAULT else ""
            raise CommandError(f"cannot {request} while {self.state}{why}: {advice}")
