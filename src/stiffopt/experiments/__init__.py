"""The paper's experiments: protocols that run on any rig, and what they find."""

from stiffopt.experiments.arm_map import ArmMap, TipMap, map_arm, map_tip
from stiffopt.experiments.coverage_result import CoverageResult, evaluate_coverage
from stiffopt.experiments.kinematics import (
    KinematicsSettings,
    PressureSequence,
    run_kinematics,
)
from stiffopt.experiments.kinematics_result import KinematicsResult, evaluate_kinematics
from stiffopt.experiments.stiffness import StiffnessSettings, run_stiffness
from stiffopt.experiments.stiffness_result import StiffnessResult, evaluate_stiffness

__all__ = [
    "ArmMap",
    "CoverageResult",
    "KinematicsResult",
    "KinematicsSettings",
    "PressureSequence",
    "StiffnessResult",
    "StiffnessSettings",
    "TipMap",
    "evaluate_coverage",
    "evaluate_kinematics",
    "evaluate_stiffness",
    "map_arm",
    "map_tip",
    "run_kinematics",
    "run_stiffness",
]
