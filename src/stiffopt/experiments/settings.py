"""What every experiment is told, and how it tells how far it has come."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from pydantic import Field

from stiffopt.schema import Schema

__all__ = ["ExperimentSettings", "Progress"]

Progress = Callable[[float, float, str], None]
"""Is told what is done, of how much, and in words."""


class ExperimentSettings(Schema):
    """What is the same in all experiments.

    Attributes
    ----------
    rig, robot : names, for people.
    channels : number of channels.
    repetitions : of all that is done.
    """

    rig: str = "rig"
    robot: str = "robot"
    channels: Annotated[int, Field(ge=1)]
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 5
