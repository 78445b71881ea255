"""Calibration: from recordings of an arm to a robot file that predicts it, with its covariance.

Models of growing complexity are fitted and compared by their errors in what was held back; the
chosen one is then compared under the other strain laws, and fitted to all rows at the end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.errors import CancelledError, InputError, PressureError
from stiffopt.identify.detection import Comparer, Hypothesis, found_wrong
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
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.identify.unknowns import BASE
from stiffopt.identify.validation import compare
from stiffopt.logs import StiffnessTable
from stiffopt.model.actuation import StrainLaw
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter
from stiffopt.model.description import Recordings, RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.registration import Placement, Registration

Array = NDArray[np.float64]
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
        Errors in logs (or parts of a log) when the others are fitted.
    tables : tuple of StiffnessTable
        Measured stiffness that was fitted.
    remarks : tuple of str
        What was found in the logs, and what to make of the result, one sentence each.
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
) -> CalibrationResult:
    """Fit a robot to recordings.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
        Where the fit begins; its tolerances say how far it may be expected to go.
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    tables : sequence of path or StiffnessTable
        Measured stiffness, fitted together with the logs.
    settings : CalibrationSettings, optional
    progress : callable, optional
        Is told what is done, of how much, and in words. If it raises `CancelledError`, the best
        model so far becomes the error's `found`.

    Returns
    -------
    The result; `stiffopt.save_robot` writes its `robot` to a file, `stiffopt.load_robot` makes it a
    `Manipulator`.

    Raises
    ------
    InputError
        There is nothing to fit, or a log is not usable; it names the log.
    FileError
        A file cannot be read or is wrong.
    EquilibriumError
        An arm under gravity buckles on the way.
    CancelledError
        From `progress`. Its `found` is the result with the best of the models that were fitted by
        then, to `trial_rows` rows; None if there was none yet.
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
    teller = _Teller(progress, len(structures) + len(laws))
    recordings = recordings_of(description, logs, settings)
    setup = _put_right(Setup.of(description, recordings, read, settings), teller)
    if not recordings:  # poses are taken to be as the robot file has them
        teller.begin("fitting the stiffness")
        alone = ModelStructure(
            "stiffness", "stiffness alone", ("compensation.stiffness",), as_given=True
        )
        return _result(setup, _final(setup, alone, {}, teller), alone, [], teller)
    candidates: list[Candidate] = []
    try:
        if settings.holds_back:
            chosen = _chosen(setup, structures, laws, candidates, teller)
            structure, near = chosen.structure, chosen.fit.problem.named(chosen.fit.x)
        else:
            structure, near = structures[0], _screened(setup, teller)
        teller.begin(f"final fit: {structure.words}")
        final = _final(setup, structure, near, teller)
        return _result(setup, final, structure, candidates, teller)
    except CancelledError as stop:
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
    """Fit structures, then the best of them under other laws; list them all, return the best."""
    description, recordings = setup.description, setup.recordings
    first = near = _screened(setup, teller)
    for structure in structures:
        if len(structures) > 1 and not (
            structure.is_possible(description)
            and structure.can_be_told(recordings)
            and _is_worth_it(structure, candidates)
        ):
            continue
        candidates.append(_candidate(setup, structure, (first, near), teller))
        leader = min(candidates, key=lambda each: each.score).fit
        near = {**near, **leader.problem.named(leader.x)}
    chosen = best(candidates)
    if laws:  # the robot file's, unless another predicts clearly better
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
    return chosen


def _candidate(
    setup: Setup, structure: ModelStructure, near: Sequence[Mapping[str, float]], teller: _Teller
) -> Candidate:
    """Fit a structure to few rows, and to what is left of them when parts are held back."""
    settings = setup.settings
    teller.begin(f"fitting {structure.words}")
    problem = setup.problem(structure, settings.trial_rows)
    found = fit(problem, [problem.start(each) for each in near], teller, rounds=1)
    teller.begin(f"predicting held-back logs: {structure.words}")
    return Candidate(structure, found, held_back(found, settings.settle, teller))


class _Teller:
    """Progress of a calibration in phases, each of an unknown number of evaluations."""

    def __init__(self, progress: Progress | None, fits: int) -> None:
        self._progress = progress
        self._phases = 2.0 * fits + 3.0
        self._phase = 0
        self._evaluations = 0
        self._words = ""

    def begin(self, words: str) -> None:
        self._phase += 1
        self._evaluations = 0
        self._words = words
        self()

    def __call__(self) -> None:
        if self._progress is not None:
            # nears the end of the phase, however many there are
            share = 1 - 1 / (1 + self._evaluations / 60)
            done = min(self._phase - 1 + share, self._phases)
            self._progress(done, self._phases, self._words)
        self._evaluations += 1


def _structures(name: str) -> list[ModelStructure]:
    """Models of this name, or all of them where it is ``auto``."""
    known = {structure.name: structure for structure in STRUCTURES}
    if name == "auto":
        return list(STRUCTURES)
    if name not in known:
        raise InputError(f"there is no model '{name}'; choose one of auto, {', '.join(known)}")
    return [known[name]]


def _is_worth_it(structure: ModelStructure, candidates: Sequence[Candidate]) -> bool:
    """Whether one of those that a structure adds to is the best so far."""
    if not structure.after:
        return True
    return min(candidates, key=lambda each: each.score).structure.name in structure.after


def _screened(setup: Setup, teller: _Teller) -> dict[str, float]:
    """Coordinates by name near the best of several starts, from few rows."""
    teller.begin("looking for a start")
    problem = setup.problem(STRUCTURES[1], setup.settings.start_rows)
    tolerances = setup.tolerances
    turns = START.turns if tolerances.base_turn > START.unknown_turn else (0.0,)
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


def _put_right(setup: Setup, teller: _Teller) -> Setup:
    """The setup with what is wrong with all recordings put right, if the evidence is overwhelming.

    See `stiffopt.identify.detection`.
    """
    recordings, description = setup.recordings, setup.description
    if not recordings:
        return setup
    teller.begin("checking how the logs were recorded")
    stations = [description.length if each.at is None else each.at for each in setup.points]
    comparer = Comparer(description, setup.base, stations, recordings)
    found = found_wrong(comparer, description, setup.settings.keep)
    if found is None:
        return setup
    told = found.hypothesis.told(description, [each.name for each in recordings])
    remark = (
        f"{told}; the robot file's arm then misses the tip by {found.then * 1e3:.1f} mm instead of "
        f"{found.as_is * 1e3:.1f} mm, however soft it is; --keep {found.hypothesis.kind} leaves "
        "that as it was recorded"
    )
    return replace(_under(setup, found.hypothesis, comparer.low), found=(remark,))


def _under(setup: Setup, hypothesis: Hypothesis, low: Array) -> Setup:
    """The setup as it is if a hypothesis holds; the robot file keeps an order and a common turn."""
    given = setup.description.recordings or Recordings()
    recordings = hypothesis.applied(setup.recordings, low)
    if hypothesis.kind == "channels":
        columns = given.channels or tuple(range(1, len(hypothesis.sources) + 1))
        given = given.model_copy(update={"channels": tuple(columns[k] for k in hypothesis.sources)})
    elif hypothesis.kind == "axes" and len(set(hypothesis.turns)) == 1:  # of the tracker
        recordings = hypothesis.with_turns(0).applied(setup.recordings, low)
        turn = lie.transform(CUBE_ROTATIONS[hypothesis.turns[0]], np.zeros(3))
        places = {"tracker_in_base": _inverse_placement(np.linalg.inv(turn) @ setup.base)}
        registration = given.registration.model_copy(update=places)
        given = given.model_copy(update={"registration": registration})
    description = setup.description.model_copy(update={"recordings": given})
    return Setup.of(description, recordings, setup.tables, setup.settings)


def _final(
    setup: Setup, structure: ModelStructure, near: Mapping[str, float], teller: _Teller
) -> Fit:
    """Fit all that counts; with tables, both as soft as poses say and not softened by pressure.

    Poses alone do not tell whether pressure softens the arm or acts ever more strongly on it;
    stiffness does, and the better of the two extremes is taken.
    """
    found = []
    for description in _softenings(setup):
        own = replace(setup, description=description)
        problem = own.problem(structure, setup.settings.rows)
        start = problem.start(near)
        found.append(fit(problem, [start], teller, rounds=setup.settings.rounds))
    return min(found, key=_misfit_of_tables)


def _misfit_of_tables(found: Fit) -> float:
    """Sum of the squared residuals of the tables; what is compared does not move the poses."""
    tables = [found.problem.of_table(table, found.x)[0] for table in found.problem.tables]
    return float(sum((residuals**2).sum() for residuals in tables))


def _softenings(setup: Setup) -> list[RobotDescription]:
    """The robot as it is and, if there are tables, with the other extreme of softening."""
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
            point.name: _inverse_placement(_motion(moves[own]) @ point.sensor)
            for point, own in zip(problem.points, sensors, strict=True)
        }
        recordings = Recordings(
            channels=given.channels,
            frame=given.frame,
            registration=Registration(
                tracker_in_base=_inverse_placement(base_in_tracker),
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
    """Arc length in m of the point of the arm that was at another before lengths changed."""
    begin, moved = 0.0, 0.0
    for old, new in zip(before.segments, after.segments, strict=True):
        soft = min(max(at - begin, 0.0), old.length)
        rigid = min(max(at - begin - old.length, 0.0), old.connector)
        moved += soft * new.length / old.length + rigid
        begin += old.length + old.connector
    return float(f"{min(moved, after.length):.8g}")


def _with_the_same_mass(robot: RobotDescription, before: RobotDescription) -> RobotDescription:
    """The robot with the masses of the file that was fitted, whatever its lengths."""
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
    """Return the covariance and the range of the calibration, for the robot file.

    A fit to tables alone keeps what an earlier calibration knew of everything else.
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
    """Softening, which poses alone cannot tell from pressure that acts ever more strongly."""
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
    """Transform (4, 4) of a twist (6,), (3,) without a turn, or of nothing."""
    full = np.zeros(6)
    full[: len(twist)] = twist
    return np.asarray(lie.exp(full))


def _inverse_placement(transform: Array) -> Placement:
    """Placement of the inverse of a transform (4, 4), with as many digits as a file needs."""
    found = Placement.of(np.asarray(np.linalg.inv(transform), dtype=float))
    return Placement(
        position=tuple(round(x, 8) for x in found.position),
        orientation=tuple(round(q, 8) for q in found.orientation),
    )
