"""`Concerns`: what is reported of the contacts of a brace, and for how long."""

from __future__ import annotations

from typing import NamedTuple

from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.control.interface import Notice
from stiffopt.control.state import Severity

UNCERTAIN, SLIPS = "brace-uncertain", "brace-slips"


class Concern(NamedTuple):
    """A reason to report a contact."""

    kind: str  # `brace-uncertain` or `brace-slips`
    contact: int  # its index
    cause: str  # `slide` or `lift` under a push, or `drift` of the model's error


class Concerns:
    """The present concerns about the contacts of a brace.

    A concern begins when it is first seen. It ends when it has not been seen for the time `again`.

    Parameters
    ----------
    tuning : has the time `again`, in s.

    Attributes
    ----------
    doubted : for how long contacts have been uncertain, in s.
    """

    def __init__(self, tuning: BracingTuning) -> None:
        self._again, self.doubted = tuning.again, 0.0
        self._texts: dict[Concern, str] = {}
        self._calm: dict[Concern, float] = {}  # how long it has not been seen, in s

    @property
    def doubt(self) -> str:
        """Why contacts are uncertain; empty if they are not."""
        return "; also ".join(t for each, t in self._texts.items() if each.kind == UNCERTAIN)

    @property
    def uncertain(self) -> list[int]:
        """Indices of the contacts that are uncertain, one for each reason."""
        return [each.contact for each in self._texts if each.kind == UNCERTAIN]

    def take(self, found: dict[Concern, str], elapsed: float) -> list[Notice]:
        """Take in the concerns of a sample, with their texts; return notices of those that come.

        A concern keeps the text with which it came.
        """
        new = {each: text for each, text in found.items() if each not in self._texts}
        self._texts.update(new)
        for each in list(self._texts):
            self._calm[each] = 0.0 if each in found else self._calm[each] + elapsed
            if self._calm[each] >= self._again:
                del self._texts[each]
        if not self.doubt:
            self.doubted = 0.0
        if any(each.kind == UNCERTAIN for each in found):
            self.doubted += elapsed
        return [Notice(each.kind, text, Severity.WARNING) for each, text in new.items()]

    def clear(self) -> None:
        """End all concerns."""
        self._texts.clear()
