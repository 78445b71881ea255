"""Opening a rig so that whoever commands it does so through the gate."""

from __future__ import annotations

import os
from pathlib import Path

from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import Rig

__all__ = ["open_rig"]


def open_rig(path: str | os.PathLike[str], *, real_time: bool = False) -> Rig:
    """Return the rig that a rig file describes; nothing is connected before `Rig.open`.

    Parameters
    ----------
    path :
        The rig file.
    real_time :
        Whether time passes by itself on a simulated rig; otherwise it passes while one sleeps on
        the rig's clock. Real devices always run in real time.

    Raises
    ------
    FileError
        A file is wrong.
    MissingExtraError
        The simulator is asked for and numba is not installed.
    """
    description = load_rig_description(path)
    robot = load_description(description.robot, base=Path(path).parent)
    return make_rig(description, robot, real_time=real_time)
