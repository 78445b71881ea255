"""Convert a solved task to data: JSON in SI units, or an entry of a result file with units."""

import math
from dataclasses import asdict
from typing import Any

from stiffopt.cli.console import plain_data
from stiffopt.cli.solved_task import SolvedTask
from stiffopt.model.contact.equilibrium import Contact
from stiffopt.model.contact.push import ContactLoss
from stiffopt.optimise.solution import PressureSolution, Sensitivities
from stiffopt.optimise.term import Term
from stiffopt.plots.wording import least_maximised
from stiffopt.units import format_quantity

Record = dict[str, Any]

_WRITTEN = {"m": "mm", "rad": "deg"}
"""Units of errors in result files, whatever units are displayed."""

_BLOCKS = {
    "translation_per_force": (slice(0, 3), slice(0, 3), "m/N"),
    "translation_per_moment": (slice(0, 3), slice(3, 6), "m/(N*m)"),
    "rotation_per_force": (slice(3, 6), slice(0, 3), "rad/N"),
    "rotation_per_moment": (slice(3, 6), slice(3, 6), "rad/(N*m)"),
}
"""Blocks of the compliance: rows, columns and unit."""


def priced(solution: PressureSolution) -> Sensitivities | None:
    """Return a solution's sensitivities if their objective is a stiffness, else None."""
    given = solution.sensitivities
    if given is None or not solution.found or given.objective_unit not in ("N/m", "N*m/rad"):
        return None
    return given


def _relaxed(term: Term) -> str:
    """Return the name under which the price of a term's tolerance or margin is reported."""
    return f"{term.name}_{'margin' if term.is_inequality else 'tolerance'}"


# -- JSON -----------------------------------------------------------------------------------------


def json_record(solved: SolvedTask) -> Record:
    """Return a solved task for JSON, in SI units."""
    solution, known = solved.solution, solved.uncertainty
    record: Record = {
        "task": solved.file,
        "status": solution.status,
        "found": solution.found,
        "pressures_pa": solution.pressures,
        "tip_position_m": solution.tip_position,
        "tip_quaternion_wxyz": solution.tip_quaternion,
        "position_error_m": None,
        "angle_error_rad": None,
        **{
            f"{term.result_name}_{term.unit}": solution.errors.get(term.name)
            for term in solution.task.target.terms
        },
        **_clearance(solution),
        **_brace(solution),
        "stiffness": solution.stiffness,
        "stiffness_unit": solution.stiffness_unit,
        "stiffnesses": solution.stiffnesses,
        "stiffnesses_plain": solved.plain,
        "stiffness_interval": solved.intervals[0] if solved.intervals else None,
        "matrix_distance": solution.matrix_distance,
        "tip_uncertainty_m": known.semi_axes if known and known.semi_axes.any() else None,
        "inside_recorded_range": None if known is None else known.inside,
        "compliance": solution.compliance,
        "active_bounds": solution.active_bounds,
        "freedom": solution.freedom,
        "confidence": None if solution.confidence is None else asdict(solution.confidence),
        "sensitivities": _json_sensitivities(solution),
        "solve_time_s": solution.timings.get("total"),
        "message": solution.message,
    }
    if solved.front is not None:
        record["pareto"] = [_json_point(point) for point in solved.front]
    if solved.supports is not None:
        record["supports"] = [
            {
                "kind": each.kind,
                "at_m": each.at,
                "side_rad": each.side,
                "force_n": each.force,
                "stiffnesses": each.solution.stiffnesses,
                "times": solved.supports.times(each),
                "pressures_pa": each.solution.pressures,
                "object": each.object.model_dump(mode="json", by_alias=True, exclude_none=True),
            }
            for each in solved.supports.supports
        ]
    return record


def _clearance(solution: PressureSolution) -> Record:
    if solution.task.scene is None:
        return {}
    record: Record = {
        "clearance_m": solution.clearance,
        "nearest_object": solution.nearest_object,
    }
    if solution.mesh_error is not None:
        record["mesh_error_m"] = solution.mesh_error
    return record


def _brace(solution: PressureSolution) -> Record:
    """Return the contacts of a braced arm, its stiffness without them, and what they hold."""
    if solution.task.brace is None:
        return {}
    return {
        "contacts": [contact_record(each) for each in solution.contacts],
        "friction_tip_m": solution.equilibrium.friction.tip if solution.equilibrium else None,
        "stiffness_free": solution.stiffness_free,
        "preload": [
            {"direction": each.direction, "contacts": each.contacts, **loss_record(each.loss)}
            for each in solution.preloads
        ],
        "limited_by": solution.limited_by,
    }


def contact_record(contact: Contact) -> Record:
    """Return a contact for JSON, in SI units."""
    return {
        "object": contact.object,
        "at_m": contact.at,
        "force_n": contact.force,
        "position_m": contact.position,
        "max_force_n": contact.max_force if math.isfinite(contact.max_force) else None,
    }


def loss_record(loss: ContactLoss) -> Record:
    """Return the push that loses a contact for JSON, in SI units; null where none does."""
    return {
        "force_n": loss.force if math.isfinite(loss.force) else None,
        "object": loss.object,
        "how": loss.how,
        "stiffness_after_n_per_m": loss.stiffness_after,
    }


def _json_sensitivities(solution: PressureSolution) -> Record | None:
    given = solution.sensitivities
    if given is None:
        return None
    record: Record = {
        "tip_jacobian_per_pa": given.tip_jacobian,
        "stiffness_gradient_per_pa": given.stiffness_gradient,
    }
    if priced(solution):
        record |= {
            "per_bound_per_pa": given.per_bound,
            "per_position_tolerance_per_m": None,
            "per_angle_tolerance_per_rad": None,
            **{
                f"per_{_relaxed(term)}_per_{term.unit}": given.per_tolerance.get(term.name)
                for term in solution.task.target.terms
            },
            **({"per_clearance_per_m": given.per_clearance} if given.per_clearance else {}),
            "objective_unit": given.objective_unit,
        }
    return record


def _json_point(solution: PressureSolution) -> Record:
    return {
        "position_error_m": solution.position_error,
        "angle_error_rad": solution.angle_error,
        "stiffness": least_maximised(solution),
        "pressures_pa": solution.pressures,
    }


# -- the result file ------------------------------------------------------------------------------


def result_record(solved: SolvedTask) -> Record:
    """Return a solved task as the entry of a result file: quantities as text with their units."""
    solution = solved.solution
    record: Record = {
        "task": solved.file,
        "robot": solved.robot.description.name,
        "status": solution.status,
        "message": solution.message or None,
        "pressures": _quantities(solution.pressures, "Pa", "bar"),
        "tip": _tip(solution),
        "uncertainty": _uncertainty(solved),
        **{
            term.result_name: _quantity(
                solution.errors.get(term.name), term.unit, _WRITTEN.get(term.unit, term.unit)
            )
            for term in solution.task.target.terms
        },
        "clearance": _quantity(solution.clearance, "m", "mm"),
        "nearest_object": solution.nearest_object,
        "mesh_error": _quantity(solution.mesh_error, "m", "mm"),
        "stiffness": _stiffnesses(solved),
        "brace": _brace_with_units(solution),
        "matrix_distance": solution.matrix_distance,
        "compliance": _compliance(solution),
        "active_bounds": list(solution.active_bounds) or None,
        "freedom": solution.freedom if solution.pressures is not None else None,
        "confidence": None if solution.confidence is None else asdict(solution.confidence),
        "worth": _worth(solution),
        "pareto": None if solved.front is None else [_point(point) for point in solved.front],
        "solve_time": _quantity(solution.timings.get("total"), "s"),
    }
    return {key: _without_none(value) for key, value in record.items() if value is not None}


def _brace_with_units(solution: PressureSolution) -> Record | None:
    if solution.task.brace is None:
        return None
    return {
        "stiffness_free": _quantity(solution.stiffness_free, solution.stiffness_unit or ""),
        "contacts": [
            {
                "object": each.object,
                "at": _quantity(each.at, "m", "mm"),
                "force": _quantities(each.force, "N", "N"),
            }
            for each in solution.contacts
        ]
        or None,
        "preload": [
            {
                "direction": plain_data(each.direction),
                "contacts": each.contacts,
                "push": _quantity(each.loss.force, "N"),
                "how": each.loss.how,
            }
            for each in solution.preloads
        ]
        or None,
        "limited_by": list(solution.limited_by) or None,
    }


def _tip(solution: PressureSolution) -> Record | None:
    if solution.tip_pose is None:
        return None
    return {
        "position": _quantities(solution.tip_position, "m", "mm"),
        "orientation": solution.tip_quaternion,
    }


def _uncertainty(solved: SolvedTask) -> Record | None:
    known = solved.uncertainty
    if known is None:
        return None
    return {
        "tip_semi_axes": _quantities(known.semi_axes, "m", "mm"),
        "tip_axes": plain_data(known.axes.T),
        "inside_recorded_range": known.inside,
    }


def _stiffnesses(solved: SolvedTask) -> list[Record] | None:
    solution = solved.solution
    plain = solved.plain or (None,) * len(solution.stiffnesses)
    intervals = solved.intervals or (None,) * len(solution.stiffnesses)
    return [
        {
            "value": _quantity(value, measure.unit),
            "interval": None if ends is None else [_quantity(end, measure.unit) for end in ends],
            "plain": _quantity(at_plain, measure.unit),
            **measure.task_keys(),
        }
        for measure, value, at_plain, ends in zip(
            solution.task.measures, solution.stiffnesses, plain, intervals, strict=False
        )
    ] or None


def _compliance(solution: PressureSolution) -> Record | None:
    matrix = solution.compliance
    if matrix is None:
        return None
    return {
        "frame": "tip",
        **{
            name: {"matrix": plain_data(matrix[rows, columns]), "unit": unit}
            for name, (rows, columns, unit) in _BLOCKS.items()
        },
    }


def _worth(solution: PressureSolution) -> Record | None:
    """Return the stiffness gained by relaxing limits and tolerances."""
    given = priced(solution)
    if given is None:
        return None
    gained = given.objective_unit
    return {
        **{name: _quantity(value, f"{gained}/Pa") for name, value in given.per_bound.items()},
        **{
            _relaxed(term): _quantity(given.per_tolerance.get(term.name), f"{gained}/{term.unit}")
            for term in solution.task.target.terms
        },
        "clearance": {
            name: _quantity(value, f"{gained}/m") for name, value in given.per_clearance.items()
        }
        or None,
    }


def _point(solution: PressureSolution) -> Record:
    unit = solution.stiffness_unit or ""
    return {
        "position_error": _quantity(solution.position_error, "m", "mm"),
        "angle_error": _quantity(solution.angle_error, "rad", "deg"),
        "stiffness": _quantity(least_maximised(solution), unit),
        "pressures": _quantities(solution.pressures, "Pa", "bar"),
    }


def _quantity(value: float | None, unit: str, written: str | None = None) -> str | None:
    if value is None or not math.isfinite(value):
        return None
    return format_quantity(float(value), unit, written)


def _quantities(values: Any, unit: str, written: str) -> list[str | None] | None:
    return None if values is None else [_quantity(value, unit, written) for value in values]


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return [_without_none(item) for item in value] if isinstance(value, list) else value
