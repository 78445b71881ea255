"""What a calibration is told."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from stiffopt.identify.structure import STRUCTURES
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration

__all__ = ["CalibrationSettings"]


class CalibrationSettings(Schema):
    """How logs are read, and what is fitted to them.

    Attributes
    ----------
    structure : name of a model of `STRUCTURES`, or ``auto``: the one that predicts held-back
        logs (of a single log, held-back parts) best; of those that are as good, the simplest.
    strain_law : ``auto``: the robot file's, unless another law of `stiffopt.model.laws` predicts
        what is held back clearly better; or ``keep``.
    sequence : whether the logs follow each other, so that each begins in the state in which the
        one before it ended.
    rezero : whether positions are counted anew in each log.
    pressures : which of the recorded pressures lead.
    fixed : keys of parameters that stay as they are.
    settle : time at the beginning of a log that does not begin at rest, from which its state (and
        its zero) is estimated where the log is only predicted, in s.
    rows : that are fitted, of all logs together; chosen so as to cover them.
    trial_rows : the same, while models are compared.
    """

    structure: str = "auto"
    strain_law: Literal["auto", "keep"] = "auto"
    sequence: bool = False
    rezero: bool = False
    pressures: Literal["commanded", "measured"] = "commanded"
    fixed: Items[str] = ()
    settle: Annotated[Duration, Field(gt=0)] = 2.0
    rows: Annotated[int, Field(ge=50, le=100_000)] = 2000
    trial_rows: Annotated[int, Field(ge=50, le=100_000)] = 600

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the models to compare."""
        if self.structure == "auto":
            return tuple(structure.name for structure in STRUCTURES)
        return (self.structure,)
