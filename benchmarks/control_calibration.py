"""Robot files for `control.py` as a user would make them: recorded and calibrated, one per arm.

Each arm is recorded by the project's experiment on its own rig, with inertia, creep, hysteresis
and the tracker's noise, and `stiffopt.calibrate` fits the robot file to that. Nothing here knows
the truth.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from calibration import Sizes, recorded

if TYPE_CHECKING:
    from control_cases import Case
    from stiffopt.model.description import RobotDescription

NOISE = 10_000  # to the seed, so that the noise is not that of the control's run
SIZES = Sizes(repetitions=1, structure="creep", rows=300, trial_rows=100)
"""Two and a half minutes of the paper's sequence and poses; the model is named to save time."""


def calibrated_file(case: Case, folder: Path) -> RobotDescription:
    """The calibrated robot file of a case's arm.

    Parameters
    ----------
    case : whose arm it is; what it carries beside the robot file's mass is put on afterwards.
    folder : gets the recording and the file, or has them from a run before.
    """
    from stiffopt import CalibrationSettings, calibrate, save_robot
    from stiffopt.model.robot_files import load_description

    path = folder / f"arm-{case.seed}.yaml"
    if not path.exists():
        plant = case.description.plant.model_copy(
            update={"dynamics": "full", "seed": case.seed + NOISE, "payload": 0.0}
        )
        rig = case.description.model_copy(update={"plant": plant})
        folder.mkdir(parents=True, exist_ok=True)
        logs = recorded(rig, case.robot, SIZES, folder / f"recording-{case.seed}")
        settings = CalibrationSettings(
            structure=SIZES.structure, strain_law="keep", sequence=True,
            rows=SIZES.rows, trial_rows=SIZES.trial_rows,
        )  # fmt: skip
        save_robot(path, calibrate(case.robot, logs, settings=settings).robot)
    return load_description(path)


def with_calibrated_file(case: Case, folder: Path) -> Case:
    """The case whose controller gets that file."""
    return replace(case, believed=calibrated_file(case, folder))
