"""Calibration: fit a robot file, with its covariance, to recordings of an arm.

`calibrate` fits models of growing complexity to few rows and compares their errors on held-back
data. It compares the best one under the other strain laws too, and fits the winner to more rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError, PressureError, StoppedError
from stiffopt.identify.correction import inverse_placement, put_right
from stiffopt.identify.detection import without_drift
from stiffopt.identify.error_model import covariance_with, error_model, kept_unknowns
from stiffopt.identify.fit import Fit, fit
from stiffopt.identify.folds import held_back
from stiffopt.identify.results import (
    Comparison,
    Errors,
    FittedEstimate,
    doubts,
    estimates,
    is_unfit,
    outliers,
    what_to_look_at,
)
from stiffopt.identify.settings import REPORT, START, CalibrationSettings
from stiffopt.identify.setup import (
    LogSource,
    RobotSource,
    Setup,
    TableSource,
    description_of,
    recordings_of,
    tables_of,
)
from stiffopt.identify.structures import (
    STRUCTURES,
    Candidate,
    ModelStructure,
    best,
    other_laws,
)
from stiffopt.identify.unknowns import BASE
from stiffopt.identify.validation import compare
from stiffopt.logs import StiffnessTable
from stiffopt.model.actuation import StrainLaw
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter
from stiffopt.model.description import Recordings, RobotDescription
from stiffopt.model.history import NO_HISTORY
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.stopping import Cancel, checkpoint, giving_up
from stiffopt.registration import Registration

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of a calibration.

    Attributes
    ----------
    before, robot : RobotDescription
        The robot file before the calibration, and after it.
    structure : ModelStructure
        The model that was chosen.
    candidates : tuple of Candidate
        The models that were compared, the simplest first.
    estimates : tuple of FittedEstimate
        Every number that was fitted.
    nominal, calibrated : tuple of Comparison
        The logs with the predictions of the robot before and after.
    held_back : dict of str to Errors
        Errors on each held-back log, or part of the logs, when the rest is fitted.
    tables : tuple of StiffnessTable
        Measured stiffness that was fitted.
    remarks : tuple of str
        Findings in the logs and doubts about the result, one sentence each.
    """

    before: RobotDescription
    robot: RobotDescription
    structure: ModelStructure
    candidates: tuple[Candidate, ...]
    estimates: tuple[FittedEstimate, ...]
    nominal: tuple[Comparison, ...]
    calibrated: tuple[Comparison, ...]
    held_back: dict[str, Errors]
    tables: tuple[StiffnessTable, ...]
    remarks: tuple[str, ...]

    @property
    def unfit(self) -> bool:
        """Whether the fit misses its own recordings by more than 10 % of the arm's length."""
        return self.robot.calibration is not None and self.robot.calibration.unfit


def calibrate(
    robot: RobotSource,
    logs: Sequence[LogSource] = (),
    tables: Sequence[TableSource] = (),
    settings: CalibrationSettings | None = None,
    progress: Progress | None = None,
    *,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> CalibrationResult:
    """Fit a robot to recordings.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
        Where the fit begins; its tolerances are the prior deviations of its numbers.
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    tables : sequence of path or StiffnessTable
        Measured stiffness, fitted together with the logs.
    settings : CalibrationSettings, optional
    progress : callable, optional
        Called with the work done, the total and a description. It may raise `CancelledError`; the
        error's `found` is then the best result so far.

    Returns
    -------
    The result. `stiffopt.save_robot` writes its `robot` to a file; `stiffopt.load_robot` turns it
    into a `Manipulator`.

    Raises
    ------
    InputError
        There is nothing to fit, or a log is not usable; the message names it.
    FileError
        A file cannot be read or is invalid.
    EquilibriumError
        An arm under gravity buckles during the fit.
    OutOfTimeError, CancelledError
        Where `timeout`, `cancel` or `progress` ended it. Its `found` is the result with the best
        model fitted so far, to `trial_rows` rows; None if there is none yet.
    """
    description, settings = description_of(robot), settings or CalibrationSettings()
    if not logs and not tables:
        raise InputError("there is nothing to fit to; expected a log or a table of stiffness")
    if not settings.holds_back and settings.structure == "auto":
        raise InputError("models are compared by what is held back; name one, or hold parts back")
    read = tables_of(tables, description)
    structures = _structures(settings.structure)
    for key in settings.fixed:
        Parameter(key).value(description)  # raises if there is no such number
    laws = other_laws(description) if settings.strain_law == "auto" else []
    fits = len(structures) + len(laws) + 1 if logs and settings.holds_back else 0
    teller = _Teller(progress, 2 * fits + (4 if logs else 2))
    candidates: list[Candidate] = []
    try:
        with giving_up(timeout, cancel):
            recordings = recordings_of(description, logs, settings)
            if "drift" not in settings.keep:
                recordings = [without_drift(each) for each in recordings]
            setup = Setup.of(description, recordings, read, settings)
            if recordings:
                teller.begin("checking how the logs were recorded")
                setup = put_right(setup)
            if not recordings:  # tables alone: trust the robot file's poses
                teller.begin("fitting the stiffness")
                alone = ModelStructure(
                    "stiffness", "stiffness alone", ("compensation.stiffness",), as_given=True
                )
                return _result(setup, _final(setup, alone, {}, teller), alone, [], teller)
            if settings.holds_back:
                chosen = _chosen(setup, structures, laws, candidates, teller)
                structure, near = chosen.structure, chosen.fit.problem.named(chosen.fit.x)
            else:
                structure, near = structures[0], _screened(setup, teller)
            teller.begin(f"final fit: {structure.words}")
            final = _final(setup, structure, near, teller)
            return _result(setup, final, structure, candidates, teller)
    except StoppedError as stop:
        if candidates:
            leader = best(candidates)
            silent = _Teller(None, 0)
            found = _result(setup, leader.fit, leader.structure, candidates, silent)
            remark = (
                f"the calibration was interrupted: '{leader.structure.words}' is the best of the "
                f"models that were compared by then, fitted to {settings.trial_rows} rows"
            )
            stop.found = replace(found, remarks=(remark, *found.remarks))
        raise


def _chosen(
    setup: Setup,
    structures: Sequence[ModelStructure],
    laws: Sequence[type[StrainLaw]],
    candidates: list[Candidate],
    teller: _Teller,
) -> Candidate:
    """Fit structures, then the best one under other strain laws; return the best candidate.

    It is then tried with a memory of strain, where that is another model, and has it if it predicts
    better. Every fitted candidate is appended to `candidates`.
    """
    description, recordings = setup.description, setup.recordings
    first = near = _screened(setup, teller)
    for structure in structures:
        if len(structures) > 1 and not (
            structure.is_possible(description)
            and structure.can_be_told(recordings)
            and _is_worth_it(structure, candidates)
        ):
            teller.skip_fit()
            continue
        candidates.append(_candidate(setup, structure, (first, near), teller))
        leader = min(candidates, key=lambda each: each.score).fit
        near = {**near, **leader.problem.named(leader.x)}
    chosen = best(candidates)
    if laws:  # `best` prefers the robot file's law, which comes first
        near = chosen.fit.problem.named(chosen.fit.x)
        others = [chosen]
        for law in laws:
            structure = replace(
                chosen.structure,
                strain_law=law.name,
                name=f"{chosen.structure.name}, {law.name}",
                words=f"{chosen.structure.words}; {law.words}",
            )
            others.append(_candidate(setup, structure, (near,), teller))
            candidates.append(others[-1])
        chosen = best(others)
    if _may_remember_strain(setup, chosen):
        near = chosen.fit.problem.named(chosen.fit.x)
        candidates.append(_candidate(setup, chosen.structure.of_strain(), (near,), teller))
        chosen = min(chosen, candidates[-1], key=lambda each: each.score)
    else:
        teller.skip_fit()
    return chosen


def _may_remember_strain(setup: Setup, chosen: Candidate) -> bool:
    """Return whether to try the chosen model with a memory of strain.

    The settings may name both model and law, or the robot file may have this memory already.
    Without softening it is the same as a memory of pressure. A table of stiffness is compared with
    quick pushes: with a memory of strain their stiffness depends on the pressures, in a way that
    the fit does not describe.
    """
    robot = chosen.fit.problem.description
    softens = any((segment.history or NO_HISTORY).softening for segment in robot.segments)
    if "auto" not in (setup.settings.structure, setup.settings.strain_law):
        return False
    if not robot.creeps or not softens or setup.tables:
        return False
    of_strain = chosen.structure.of_strain().applied(setup.description, setup.seen, setup.is_fine)
    return of_strain != robot


def _candidate(
    setup: Setup, structure: ModelStructure, near: Sequence[Mapping[str, float]], teller: _Teller
) -> Candidate:
    """Fit a structure to few rows, and to their rest with each fold held back."""
    settings = setup.settings
    teller.begin(f"fitting {structure.words}")
    problem = setup.problem(structure, settings.trial_rows)
    found = fit(problem, [problem.start(each) for each in near], teller, rounds=1)
    teller.begin(f"predicting held-back logs: {structure.words}")
    return Candidate(structure, found, held_back(found, settings.settle, teller))


class _Teller:
    """Reports progress in phases, each with an unknown number of evaluations."""

    def __init__(self, progress: Progress | None, phases: int) -> None:
        self._progress = progress
        self._phases = float(phases)
        self._phase = 0
        self._evaluations = 0
        self._words = ""

    def begin(self, words: str) -> None:
        self._phase += 1
        self._evaluations = 0
        self._words = words
        self()

    def skip_fit(self) -> None:
        """Leave out the two phases of a candidate."""
        self._phases -= 2

    def __call__(self) -> None:
        checkpoint()
        if self._progress is not None:
            # approaches the end of the phase asymptotically
            share = 1 - 1 / (1 + self._evaluations / 60)
            done = min(self._phase - 1 + share, self._phases)
            self._progress(done, self._phases, self._words)
        self._evaluations += 1


def _structures(name: str) -> list[ModelStructure]:
    """Return the model structure of this name, or all for ``auto``."""
    known = {structure.name: structure for structure in STRUCTURES}
    if name == "auto":
        return list(STRUCTURES)
    if name not in known:
        raise InputError(f"there is no model '{name}'; choose one of auto, {', '.join(known)}")
    return [known[name]]


def _is_worth_it(structure: ModelStructure, candidates: Sequence[Candidate]) -> bool:
    """Whether one of the models that a structure extends is the best so far."""
    if not structure.after:
        return True
    return min(candidates, key=lambda each: each.score).structure.name in structure.after


def _screened(setup: Setup, teller: _Teller) -> dict[str, float]:
    """Fit few rows from several starts; return the best coordinates by name."""
    teller.begin("looking for a start")
    problem = setup.problem(STRUCTURES[1], setup.settings.start_rows)
    tolerances = setup.tolerances
    turns = (0.0,) if tolerances.has_known_turn else START.turns
    starts = []
    for turn, modulus in itertools.product(turns, START.moduli):
        start = problem.start({})
        for i, unknown in enumerate(problem.unknowns.all):
            if unknown.name == f"{BASE}, about z":
                start[i] = turn / unknown.deviation
            if unknown.parameter is not None and unknown.parameter.key.endswith("youngs_modulus"):
                start[i] = modulus
        starts.append(start)
    most = setup.settings.start_evaluations
    return problem.named(fit(problem, starts, teller, rounds=1, most=most).x)


def _final(
    setup: Setup, structure: ModelStructure, near: Mapping[str, float], teller: _Teller
) -> Fit:
    """Fit a structure to all chosen rows; with tables, start with and without softening.

    Poses alone cannot show whether pressure softens the arm or acts more strongly the higher it
    is; measured stiffness can. The fit that matches the tables better is returned.
    """
    found = []
    for description in _softenings(setup):
        own = replace(setup, description=description)
        problem = own.problem(structure, setup.settings.rows)
        start = problem.start(near)
        found.append(fit(problem, [start], teller, rounds=setup.settings.rounds))
    return min(found, key=_misfit_of_tables)


def _misfit_of_tables(found: Fit) -> float:
    """Return the sum of the tables' squared residuals; the two fits hardly differ in poses."""
    tables = [found.problem.of_table(table, found.x)[0] for table in found.problem.tables]
    return float(sum((residuals**2).sum() for residuals in tables))


def _softenings(setup: Setup) -> list[RobotDescription]:
    """Return the robot as it is and, if there are tables, also without softening."""
    description = setup.description
    slopes = [
        segment.compensation and segment.compensation.modulus_per_pressure
        for segment in description.segments
    ]
    if not setup.tables or not any(slopes):
        return [description]
    values = {
        Parameter(f"segments[{s}].compensation.softening"): 0.0
        for s, segment in enumerate(description.segments)
    }
    return [description, with_values(description, values)]


def _result(
    setup: Setup,
    found: Fit,
    structure: ModelStructure,
    candidates: Sequence[Candidate],
    teller: _Teller,
) -> CalibrationResult:
    chosen = [each for each in candidates if each.structure is structure]
    errors = None
    if setup.recordings:
        trial, parts = (chosen[0].fit, chosen[0].held_back) if chosen else (found, {})
        errors = error_model(trial, parts, _recorded(setup))
        found = replace(found, covariance=covariance_with(found, errors))
    listed = estimates(found)
    robot = _robot(setup, found, errors)
    teller.begin("comparing")

    def compared(
        description: RobotDescription, known: Mapping[str, float]
    ) -> tuple[Comparison, ...]:
        return compare(Setup.of(description, setup.recordings, (), setup.settings), known, teller)

    remarks = list(setup.found)
    remarks += [
        f"{recording.name}: {remark}"
        for recording in setup.recordings
        for remark in recording.remarks
    ]
    known = setup.description.calibration
    remarks += [
        f"{recording.name} was fitted before: what it tells counts twice; begin with the robot "
        "file as it was before that calibration"
        for recording in setup.recordings
        if known is not None and recording.name in known.logs
    ]
    calibrated = compared(robot, found.problem.named(found.x)) if setup.recordings else ()
    if is_unfit(calibrated, robot.length) and robot.calibration is not None:
        known = robot.calibration.model_copy(update={"unfit": True})
        robot = robot.model_copy(update={"calibration": known})
        remarks.insert(0, what_to_look_at(calibrated, robot.length))
    return CalibrationResult(
        before=setup.description,
        robot=robot,
        structure=structure,
        candidates=tuple(candidates),
        estimates=listed,
        nominal=compared(setup.description, {}) if setup.recordings else (),
        calibrated=calibrated,
        held_back=chosen[0].folds if chosen else {},
        tables=setup.tables,
        remarks=(*remarks, *outliers(found), *doubts(found, listed)),
    )


def _robot(setup: Setup, found: Fit, errors: ErrorModel | None) -> RobotDescription:
    """Return the calibrated robot with its registration and its covariance."""
    problem, x = found.problem, found.x
    recordings = setup.description.recordings
    given = recordings or Recordings()
    if setup.recordings:
        base, sensors, _, _ = problem.unknowns.slices()
        moves = x * problem.scale
        base_in_tracker = problem.base_in_tracker @ _motion(moves[base])
        places = {
            point.name: inverse_placement(_motion(moves[own]) @ point.sensor)
            for point, own in zip(problem.points, sensors, strict=True)
        }
        recordings = Recordings(
            channels=given.channels,
            frame=given.frame,
            registration=Registration(
                tracker_in_base=inverse_placement(base_in_tracker),
                tip_in_sensor=places["tip"],
            ),
            bodies={
                name: body.model_copy(
                    update={
                        "point_in_sensor": places[name],
                        "at": _moved_along(body.at, setup.description, found.robot),
                    }
                )
                for name, body in given.bodies.items()
            },
        )
    robot = _with_the_same_mass(found.robot, setup.description)
    _check_usable(robot)
    return robot.model_copy(
        update={"recordings": recordings, "calibration": _record(setup, found, errors)}
    )


def _moved_along(at: float, before: RobotDescription, after: RobotDescription) -> float:
    """Return a point's new arc length in m after segments changed their lengths."""
    begin, moved = 0.0, 0.0
    for old, new in zip(before.segments, after.segments, strict=True):
        soft = min(max(at - begin, 0.0), old.length)
        rigid = min(max(at - begin - old.length, 0.0), old.connector)
        moved += soft * new.length / old.length + rigid
        begin += old.length + old.connector
    return float(f"{min(moved, after.length):.8g}")


def _with_the_same_mass(robot: RobotDescription, before: RobotDescription) -> RobotDescription:
    """Return the robot with densities adapted so that segments keep their masses."""
    if not any(robot.gravity):
        return robot
    segments = []
    for segment, old in zip(robot.segments, before.segments, strict=True):
        density = segment.material.density
        if density is not None:
            density = float(f"{density * old.length / segment.length:.7g}")
        material = segment.material.model_copy(update={"density": density})
        segments.append(segment.model_copy(update={"material": material}))
    return robot.model_copy(update={"segments": tuple(segments)})


def _check_usable(robot: RobotDescription) -> None:
    """Raise `InputError` if the fitted law breaks down within the robot's pressure limits."""
    try:
        Manipulator(robot.model_copy(update={"calibration": None}))
    except PressureError as error:
        raise InputError(
            f"the fitted robot cannot be used within its own pressure limits: {error}; record "
            "higher pressures, or begin with 'modulus_law: exponential'"
        ) from None


def _record(setup: Setup, found: Fit, errors: ErrorModel | None) -> Calibration:
    """Return the robot file's record of the calibration: covariance, pressure range and errors.

    A fit to tables alone keeps an earlier calibration's record of all other numbers.
    """
    from scipy.linalg import block_diag  # a large library; only fits need it

    unknowns = found.problem.unknowns.all
    places = kept_unknowns(found.problem)
    deviations = np.sqrt(np.diag(found.covariance))[places]
    correlation = found.covariance[np.ix_(places, places)] / np.outer(deviations, deviations)
    correlation = np.round(correlation, REPORT.correlation_digits)
    fitted: list[FittedParameter] = []
    frames: list[float] = []
    for deviation, unknown in zip(deviations, (unknowns[i] for i in places), strict=True):
        deviation = float(f"{deviation * unknown.deviation:.6g}")
        if unknown.parameter is None:
            frames.append(deviation)
        else:
            key, prior = unknown.parameter.key, unknown.deviation
            fitted.append(FittedParameter(key=key, deviation=deviation, prior=prior))
    known = setup.description.calibration
    before = known if known is not None and not setup.recordings else Calibration()
    unlearnt = _softening(setup, found)
    keys = {each.key for each in (*fitted, *unlearnt)}
    n = len(before.parameters)
    kept = [i for i in range(n) if before.parameters[i].key not in keys]
    size = n + len(before.frames)
    old = np.reshape(before.correlation, (size, size))
    k = len(fitted)
    whole = block_diag(
        correlation[:k, :k], np.eye(len(unlearnt)), old[np.ix_(kept, kept)], correlation[k:, k:]
    )
    if frames:
        whole[:k, -len(frames) :] = correlation[:k, k:]
        whole[-len(frames) :, :k] = correlation[k:, :k]
    else:
        rows = [*kept, *range(n, size)]
        whole = block_diag(correlation, np.eye(len(unlearnt)), old[np.ix_(rows, rows)])
    pressures = [recording.pressures for recording in setup.recordings]
    seen = np.concatenate([*pressures, *(table.pressures for table in setup.tables)])
    ends = np.cumsum([0, *(segment.n_channels for segment in setup.description.segments)])
    norms = [float(np.linalg.norm(seen[:, a:b], axis=1).max()) for a, b in itertools.pairwise(ends)]
    low, high = seen.min(axis=0), seen.max(axis=0)
    if before.pressure_min:
        low, high = np.minimum(low, before.pressure_min), np.maximum(high, before.pressure_max)
        norms = np.maximum(norms, before.pressure_norm).tolist()
    noise = found.problem.noise
    turns = any(point.turns for point in found.problem.points)
    return Calibration(
        logs=before.logs + tuple(recording.name for recording in setup.recordings),
        parameters=(*fitted, *unlearnt, *(before.parameters[i] for i in kept)),
        frames=tuple(frames) or before.frames,
        correlation=tuple(tuple(row) for row in whole.tolist()),
        position_residual=noise.position if setup.recordings else before.position_residual,
        angle_residual=noise.angle if turns else before.angle_residual,
        pressure_min=tuple(low.tolist()),
        pressure_max=tuple(high.tolist()),
        pressure_norm=tuple(norms),
        errors=errors or before.errors,
    )


def _softening(setup: Setup, found: Fit) -> list[FittedParameter]:
    """Return the softening of each segment as not learnt; without tables, poses cannot show it."""
    if setup.tables:
        return []
    tolerance = setup.tolerances.softening
    return [
        FittedParameter(
            key=f"segments[{s}].compensation.softening", deviation=tolerance, prior=tolerance
        )
        for s, segment in enumerate(found.robot.segments)
        if segment.compensation is not None and segment.compensation.modulus_per_pressure
    ]


def _recorded(setup: Setup) -> Array:
    """All recorded pressures (N, n), in Pa."""
    return np.concatenate([recording.pressures for recording in setup.recordings])


def _motion(twist: Array) -> Array:
    """Return the transform (4, 4) of a twist (6,), a translation (3,) or nothing (0,)."""
    full = np.zeros(6)
    full[: len(twist)] = twist
    return np.asarray(lie.exp(full))
