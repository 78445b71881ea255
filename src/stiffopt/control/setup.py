"""`ControlSetup`: what the parts of a controller have in common."""

from __future__ import annotations

from dataclasses import dataclass

from stiffopt.arrays import Array
from stiffopt.control.tuning import ControlTuning
from stiffopt.control.vibration import BendingMode
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.rig.interface import PressureLimits
from stiffopt.rig.settings import ControlSettings, Safety


@dataclass(frozen=True, eq=False)
class ControlSetup:
    """The arm, the rig and the tuning of a controller; see `TipController`."""

    robot: Manipulator
    limits: PressureLimits  # of the commands
    slew: Array  # greatest rate of change (n,), in Pa/s
    period: float  # of the loop, in s
    control: ControlSettings
    safety: Safety
    mode: BendingMode | None  # the arm's first one; None: it does not vibrate
    scene: Scene | None  # objects that the arm has to keep clear of
    tuning: ControlTuning  # on this rig, see `ControlTuning.on_rig`
