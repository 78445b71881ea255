"""Compare how well methods, fitted to some recordings, predict the tip in other recordings.

A bench file splits the recordings of each arm into training and test files. Every method predicts
the tip in the frame of the recordings, and a covariance, from which the coverage of its 95 %
regions follows. The baselines map lagged pressures to the tip: with more of the past as input,
they predict other manoeuvres worse.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import as_file, files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.errors import InputError, require_package
from stiffopt.files import read_file
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.detection import lagged_pressures
from stiffopt.identify.recording import Recording
from stiffopt.identify.results import Comparison
from stiffopt.identify.settings import START, CalibrationSettings
from stiffopt.identify.setup import chosen_rows, recordings_of
from stiffopt.identify.tracker_faults import whole
from stiffopt.identify.validation import validate
from stiffopt.logs import Log, read_log
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description
from stiffopt.schema import Items, Schema

Progress = Callable[[float, float, str], None]

_LAG = 0.3  # s, of the baselines' input
_CHI_SQUARED = 7.814727903251179  # 95 % quantile, three degrees of freedom
_COVERED_ROWS = 200  # rows of a file at which the model's region is computed


class BenchArm(Schema):
    """An arm of a bench.

    Attributes
    ----------
    name : shown in reports.
    robot : a built-in robot, or a robot file relative to the bench file; where fits begin.
    train, test : logs, relative to the folder of the recordings.
    sequence : whether the logs of `train`, and those of `test`, were recorded without a break.
    """

    name: Annotated[str, Field(min_length=1)]
    robot: Annotated[str, Field(min_length=1)]
    train: Annotated[Items[str], Field(min_length=1)]
    test: Items[str] = ()
    sequence: bool = False


class BenchFile(Schema):
    """Arms with their splits, `format: stiffopt-bench/1`."""

    arms: Annotated[Items[BenchArm], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class BenchErrors:
    """Errors of a method on one file.

    Attributes
    ----------
    errors : (N, 3), predicted minus measured tip, in m.
    covered : (M,), whether the measured tip lies in the 95 % region, at some of the rows.
    """

    errors: Array
    covered: NDArray[np.bool_]


@dataclass(frozen=True)
class BenchScore:
    """How well a method predicts an arm.

    Attributes
    ----------
    arm, method : their names.
    length : of the arm, in m.
    train : mean error in the training files, in m.
    test, p95 : mean and 95th percentile of the error in the test files, in m; NaN without any.
    coverage : share of test rows whose tip lies in the method's 95 % region; NaN without any.
    rows : number of compared rows of the test files.
    """

    arm: str
    method: str
    length: float
    train: float
    test: float
    p95: float
    coverage: float
    rows: int


def load_bench(path: str | None = None) -> tuple[BenchFile, Path]:
    """Read a bench file, by default stiffopt's own; return it and the base of its paths."""
    if path is not None:
        return read_file(path, "bench", BenchFile), Path(path).parent
    with as_file(files("stiffopt").joinpath("benches", "recordings.yaml")) as built_in:
        return read_file(built_in, "bench", BenchFile), Path()


def run_bench(
    folder: Path,
    methods: Sequence[str],
    bench: BenchFile,
    base: Path,
    *,
    rows: int,
    full: bool = False,
    seed: int = 0,
    progress: Progress = lambda done, total, text: None,
) -> Iterator[BenchScore]:
    """Yield the score of each method on each arm whose files are all in a folder.

    Parameters
    ----------
    folder : of the recordings.
    methods : names, see `METHODS`.
    bench, base : see `load_bench`.
    rows : number of fitted rows, and largest number of compared rows of each file.
    full : let stiffopt compare all its models; by default it fits one quickly.
    seed : of learnt methods.
    progress : called with the work done, the total and a description.

    Raises
    ------
    InputError
        A method is unknown, or no arm has its files in the folder.
    """
    for name in methods:
        if name not in METHODS:
            raise InputError(f"there is no method '{name}'; expected some of {', '.join(METHODS)}")
    if set(methods) & LEARNT:
        require_package("scikit-learn", "baselines", "sklearn")
    available = [
        arm
        for arm in bench.arms
        if all((folder / each).exists() for each in (*arm.train, *arm.test))
    ]
    if not available:
        raise InputError(f"{folder}: none of the arms of the bench has its files here")
    total = len(available) * len(methods)
    for i, arm in enumerate(available):
        robot = load_description(arm.robot, base=base)
        logs = {name: read_log(folder / name) for name in (*arm.train, *arm.test)}
        settings = CalibrationSettings(rows=rows, trial_rows=rows, sequence=arm.sequence)
        if not full:
            settings = settings.quick(is_loaded=any(robot.gravity))
        task = BenchTask(arm, robot, logs, settings, rows, seed)
        for k, method in enumerate(methods):
            progress(i * len(methods) + k, total, f"{arm.name}: {method}")
            yield _score(task, method, METHODS[method](task))


@dataclass(frozen=True, eq=False)
class BenchTask:
    """The input of a method: one arm with its logs.

    Attributes
    ----------
    arm : BenchArm
    robot : where fits begin.
    logs : by name.
    settings : of reading logs, and of stiffopt's own fit.
    rows : number of fitted rows, and largest number of compared rows of each file.
    seed : of random numbers.
    """

    arm: BenchArm
    robot: RobotDescription
    logs: dict[str, Log]
    settings: CalibrationSettings
    rows: int
    seed: int

    def recordings(self, names: Sequence[str]) -> list[Recording]:
        """Return logs as stiffopt reads them: in the robot's order of channels, without faults."""
        return recordings_of(self.robot, [(name, self.logs[name]) for name in names], self.settings)

    def chosen(self, recording: Recording, limit: int) -> tuple[Array, Array]:
        """Return lagged pressures (N, n), as shares of the maximum, and tips (N, 3) in m.

        Of at most `limit` rows.
        """
        rows = chosen_rows(recording, limit)
        p = recording.pressures / np.max(self.robot.pressure_max)
        return lagged_pressures(recording.time, p, _LAG)[rows], recording.tracks[0].position[rows]


Method = Callable[[BenchTask], dict[str, BenchErrors]]


def _score(task: BenchTask, method: str, found: dict[str, BenchErrors]) -> BenchScore:
    def distances(names: Sequence[str]) -> Array:
        parts = [np.linalg.norm(found[name].errors, axis=1) for name in names]
        return np.concatenate([*parts, np.zeros(0)])

    train, test = distances(task.arm.train), distances(task.arm.test)
    covered = np.concatenate([*(found[name].covered for name in task.arm.test), np.zeros(0)])
    return BenchScore(
        task.arm.name,
        method,
        task.robot.length,
        float(train.mean()),
        float(test.mean()) if len(test) else np.nan,
        float(np.quantile(test, 0.95)) if len(test) else np.nan,
        float(covered.mean()) if len(covered) else np.nan,
        len(test),
    )


def stiffopt_method(task: BenchTask) -> dict[str, BenchErrors]:
    """Fit with `stiffopt.calibrate`, and predict the test files with `stiffopt.validate`."""
    logs = [(name, task.logs[name]) for name in task.arm.train]
    result = calibrate(task.robot, logs, settings=task.settings)
    compared = [*result.calibrated]
    if task.arm.test:
        tests = [(name, task.logs[name]) for name in task.arm.test]
        compared += validate(result.robot, tests, task.settings)
    arm = Manipulator(result.robot)
    recordings = result.robot.recordings
    axes = np.eye(3)
    if recordings is not None:
        axes = recordings.registration.tracker_in_base.transform()[:3, :3]
    return {each.name: _of_model(each, arm, axes) for each in compared}


def _of_model(found: Comparison, arm: Manipulator, axes: Array) -> BenchErrors:
    """Return errors, and coverage by the region of `tip_pose`, moved to the prediction."""
    seen = np.flatnonzero(whole(found.measured))
    errors = (found.predicted - found.measured)[seen]
    some = np.unique(np.linspace(0, len(seen) - 1, min(len(seen), _COVERED_ROWS)).astype(int))
    covered = []
    for k in some:
        region = arm.tip_uncertainty(found.pressures[seen[k]]).covariance
        e = axes @ errors[k]
        covered.append(float(e @ np.linalg.solve(region, e)) <= _CHI_SQUARED)
    return BenchErrors(errors, np.array(covered))


def constant_curvature(task: BenchTask) -> dict[str, BenchErrors]:
    """Fit arcs whose curvature and length are linear in pressure, with gains and base unknown."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    segments = task.robot.segments
    azimuths = [
        [
            np.angle(sum(np.exp(1j * s.chambers.angles[c - 1]) for c in channel))
            for channel in s.channels
        ]
        for s in segments
    ]
    known = task.robot.recordings
    base = np.eye(4) if known is None else known.registration.tracker_in_base.inverse()
    ends = np.cumsum([0, *(segment.n_channels for segment in segments)])
    tolerances = task.robot.tolerances or Tolerances()
    turns = (0.0,) if tolerances.has_known_turn else START.turns

    def tips(x: Array, p: Array) -> Array:
        turned = np.broadcast_to(Rotation.from_rotvec(x[:3]).as_matrix(), (len(p), 3, 3))
        at = np.broadcast_to(0.05 * x[3:6], (len(p), 3))
        for k, (segment, (a, b)) in enumerate(zip(segments, pairwise(ends), strict=True)):
            bend, stretch = x[6 + 2 * k : 8 + 2 * k]
            w = -bend * (p[:, a:b] @ np.exp(1j * np.array(azimuths[k])))
            length = segment.length * (1 + stretch * p[:, a:b].sum(axis=1))
            angle = np.maximum(np.abs(w), 1e-9)
            out = length * (1 - np.cos(angle)) / angle
            local = np.column_stack(
                [out * (w / angle).real, out * (w / angle).imag, length * np.sin(angle) / angle]
            )
            at = at + np.einsum("nij,nj->ni", turned, local)
            turn = Rotation.from_rotvec(np.column_stack([-w.imag, w.real, np.zeros(len(w))]))
            turned = turned @ turn.as_matrix()
            at = at + segment.connector * turned[:, :, 2]
        return np.asarray(at @ base[:3, :3].T + base[:3, 3])

    def fitted(features: Array, tip: Array) -> Callable[[Array], Array]:
        starts = [[0, 0, turn, 0, 0, 0, *[1.0, 0.1] * len(segments)] for turn in turns]
        found = [
            least_squares(
                lambda x: (tips(x, features) - tip).ravel(), start, loss="soft_l1", f_scale=5e-3
            )
            for start in starts
        ]
        best = min(found, key=lambda each: float(each.cost)).x
        return lambda features: tips(best, features)

    return _regressed(task, fitted)


def _learnt(make: Callable[[int], Any]) -> Method:
    """Return the method that uses a regressor of scikit-learn, made from a seed."""

    def method(task: BenchTask) -> dict[str, BenchErrors]:
        from sklearn.compose import TransformedTargetRegressor
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.preprocessing import StandardScaler

        def fitted(features: Array, tip: Array) -> Callable[[Array], Array]:
            scaled = TransformedTargetRegressor(make(task.seed), transformer=StandardScaler())
            with warnings.catch_warnings():  # an end at a bound or a limit of steps is no error
                warnings.simplefilter("ignore", ConvergenceWarning)
                scaled.fit(features, tip)
            return lambda features: np.asarray(scaled.predict(features))

        return _regressed(task, fitted)

    return method


def _regressed(
    task: BenchTask, fitted: Callable[[Array, Array], Callable[[Array], Array]]
) -> dict[str, BenchErrors]:
    """Predict tips with a regression on features.

    Its region is the spread of the residuals in five-fold cross-validation on the training rows.
    """
    each = task.rows // len(task.arm.train)
    rows = [task.chosen(one, each) for one in task.recordings(task.arm.train)]
    features, tip = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    part = np.arange(len(tip)) * 5 // len(tip)
    left = [
        tip[part == k] - fitted(features[part != k], tip[part != k])(features[part == k])
        for k in range(5)
    ]
    off = np.concatenate(left)
    region = np.linalg.inv(off.T @ off / len(off) + 1e-12 * np.eye(3))
    predict = fitted(features, tip)
    found = {}
    for one in task.recordings((*task.arm.train, *task.arm.test)):
        seen, measured = task.chosen(one, task.rows)
        errors = predict(seen) - measured
        covered = np.einsum("ni,ij,nj->n", errors, region, errors) <= _CHI_SQUARED
        found[one.name] = BenchErrors(errors, covered)
    return found


def _polynomial(seed: int) -> Any:
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    return make_pipeline(StandardScaler(), PolynomialFeatures(2), Ridge(1.0))


def _gaussian_process(seed: int) -> Any:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    kernel = 1.0 * RBF(3.0, (0.3, 100.0)) + WhiteKernel(0.01, (1e-6, 1.0))
    return make_pipeline(StandardScaler(), GaussianProcessRegressor(kernel, random_state=seed))


def _network(seed: int) -> Any:
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    network = MLPRegressor(
        hidden_layer_sizes=(32, 32), alpha=1e-2, solver="lbfgs", max_iter=500, random_state=seed
    )
    return make_pipeline(StandardScaler(), network)


METHODS: dict[str, Method] = {
    "stiffopt": stiffopt_method,
    "constant-curvature": constant_curvature,
    "polynomial": _learnt(_polynomial),
    "gaussian-process": _learnt(_gaussian_process),
    "network": _learnt(_network),
}
"""Methods by name; add an entry here to add a method."""
LEARNT = {"polynomial", "gaussian-process", "network"}
"""Methods that need scikit-learn."""
