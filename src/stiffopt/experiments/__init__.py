"""The paper's experiments: protocols that run on any rig, and the evaluation of their data.

`kinematics` and `coverage` record the tip while pressures change; `stiffness` and `probing` push
it; `poses` holds the poses of a file. The `conductor` commands the rig for all of them; `folder`
manages their files. `kinematics_result` and `stiffness_result` compare the data with a model;
`slope` fits stiffnesses. `arm_map` maps a model's stiffness and needs no rig.
"""

from stiffopt.experiments.kinematics import KinematicsSettings, run_kinematics
from stiffopt.experiments.kinematics_result import (
    CoverageResult,
    KinematicsResult,
    evaluate_coverage,
    evaluate_kinematics,
)
from stiffopt.experiments.stiffness import StiffnessSettings, run_stiffness
from stiffopt.experiments.stiffness_result import StiffnessResult, evaluate_stiffness

__all__ = [
    "CoverageResult",
    "KinematicsResult",
    "KinematicsSettings",
    "StiffnessResult",
    "StiffnessSettings",
    "evaluate_coverage",
    "evaluate_kinematics",
    "evaluate_stiffness",
    "run_kinematics",
    "run_stiffness",
]
