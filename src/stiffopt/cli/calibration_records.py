"""Calibrations and validations as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, isfinite
from typing import Any

import numpy as np

from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.results import Comparison, Errors, together
from stiffopt.model.description import RobotDescription

_MM = 1e3  # per m


def validation(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    """Return errors of all logs together and of each."""
    return {
        **_with_outside(robot, found),
        "robot": robot.name,
        "remarks": [f"{each.name}: {remark}" for each in found for remark in each.remarks],
        "logs": {each.name: _with_outside(robot, [each]) for each in found},
    }


def calibration(result: CalibrationResult, out: str, report: str | None) -> dict[str, Any]:
    """Return what a calibration has found."""
    length = result.before.length
    return {
        "robot": result.robot.name,
        "out": out,
        "report": report,
        "model": result.structure.name,
        "strain_laws": [segment.strain_law for segment in result.robot.segments],
        "models": [
            {
                "name": each.structure.name,
                "held_back_mean_mm": _number(each.score * _MM),
                "held_back": {name: _errors(e, length) for name, e in each.folds.items()},
            }
            for each in result.candidates
        ],
        "before": _comparisons(result.nominal, length),
        "after": _comparisons(result.calibrated, result.robot.length),
        "held_back": {name: _errors(e, length) for name, e in result.held_back.items()},
        "parameters": [
            {
                "name": each.name,
                "key": each.key or None,
                "unit": each.unit,
                "before": each.before,
                "value": each.value,
                "interval_95": [_number(each.low), _number(each.high)],
                "learnt": each.learnt,
                "tolerances_from_before": each.far,
            }
            for each in result.estimates
        ],
        "remarks": list(result.remarks),
    }


def _comparisons(found: Sequence[Comparison], length: float) -> dict[str, Any] | None:
    if not found:
        return None
    logs = {each.name: _errors(each.errors, length) for each in found}
    return {**_errors(together(found), length), "logs": logs}


def _with_outside(robot: RobotDescription, found: Sequence[Comparison]) -> dict[str, Any]:
    record = _errors(together(found), robot.length)
    if robot.calibration is None:
        return {**record, "outside_training_percent": None, "outside_training": None}
    inside = np.concatenate([each.inside for each in found])
    beyond = [each.rows(~each.inside) for each in found if not each.inside.all()]
    return {
        **record,
        "outside_training_percent": float(np.mean(~inside) * 100),
        "outside_training": _errors(together(beyond), robot.length) if beyond else None,
    }


def _errors(errors: Errors, length: float) -> dict[str, Any]:
    values = {
        "mean": errors.mean,
        "median": errors.median,
        "p95": errors.p95,
        "max": errors.max,
    }
    return {
        "n": errors.n,
        "position_error_mm": {name: _number(value * _MM) for name, value in values.items()},
        "position_error_percent_of_length": _number(errors.mean / length * 100),
        "angle_error_deg": None if errors.angle is None else degrees(errors.angle),
    }


def _number(value: float) -> float | None:
    return float(value) if isfinite(value) else None
