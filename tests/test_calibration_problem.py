"""Residuals of a calibration: what they are, and their slopes by differences."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stiffopt import lie
from stiffopt.identify.calibration import _with_the_same_mass
from stiffopt.identify.past import Past, Start
from stiffopt.identify.problem import Begin, CalibrationProblem, Noise, Sample, TrackedPoint
from stiffopt.identify.recording import Recording, Track
from stiffopt.identify.settings import FIT
from stiffopt.identify.structures import STRUCTURES, ModelStructure
from stiffopt.identify.unknowns import (
    Unknowns,
    anew_unknowns,
    history_unknowns,
    placement_unknowns,
    shape_unknowns,
    side_unknowns,
    zero_unknowns,
)
from stiffopt.logs import StiffnessTable
from stiffopt.model.description import Tolerances
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

BAR = 1e5
KPA = 1e3
EVERY = ModelStructure(
    "every",
    "all that can be fitted",
    (*next(s for s in STRUCTURES if s.name == "progressive").shape, "compensation.softening"),
)
HISTORY = History(
    dead_time=0.0523,
    lag=0.3,
    lag_falling=0.5,
    memory=(0.8, 1.1, 1.0),
    play=(Play(width=8 * KPA, share=0.2), Play(width=30 * KPA, share=0.1)),
    creep=(Creep(time=2.0, share=0.05),),
)
NOISE = Noise(2e-3, 0.05)


def recording(n: int, count: int, seed: int, bodies: tuple[str, ...], turns: bool) -> Recording:
    """Smooth pressures, and positions and rotations that are anywhere; some are missing."""
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(0.05, 0.15, count))
    waves = np.sin(time[:, None] * random.uniform(0.5, 2, n) + random.uniform(0, 6, n))
    p = BAR * (0.6 + 0.35 * waves)
    tracks = []
    for name in ("tip", *bodies):
        position = random.normal(0, 0.05, (count, 3))
        rotation = Rotation.from_rotvec(random.normal(0, 0.3, (count, 3))).as_matrix()
        position[count // 3] = np.nan
        rotation[count // 2 : count // 2 + 2] = np.nan
        tracks.append(Track(name, position, rotation if turns else None))
    return Recording(f"log {seed}", time, p, p[0] - 5 * KPA, tuple(tracks), ())


@dataclass(frozen=True)
class Case:
    robot: str
    count: int
    rows: int
    begins: tuple[Begin, ...]
    bodies: bool = False
    turns: bool = False
    tables: bool = False
    anew: tuple[str | None, ...] = (None, None, None)


CASES = {
    "one segment": Case("stiff-flop-1", 40, 25, ("rest", "unknown")),
    "one segment with a table": Case("stiff-flop-1", 20, 12, ("unknown",), tables=True),
    "two segments in sequence": Case(
        "stiff-flop-2", 25, 15, ("unknown", "previous", "previous"), bodies=True, turns=True
    ),
    "frame and body defined anew": Case(
        "stiff-flop-1", 20, 12, ("rest", "rest", "rest"), turns=True, anew=(None, "frame", "tip")
    ),
    "hanging": Case(
        "stiff-flop-2-hanging", 40, 5, ("unknown",), bodies=True, turns=True, tables=True
    ),
}


def table(n: int) -> StiffnessTable:
    return StiffnessTable(
        pressures=BAR * np.linspace(0.2, 1.0, 4 * n).reshape(4, n),
        directions=np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]]),
        boundaries=("free", "clamped", "free", "free"),
        stiffness=np.array([20.0, 70.0, np.nan, 15.0]),
        sigma=np.array([1.0, 5.0, 1.0, 2.0]),
    )


@cache
def problem_of(case: Case) -> CalibrationProblem:
    description = EVERY.applied(load_description(case.robot), 1.0 * BAR)
    segments = tuple(s.model_copy(update={"history": HISTORY}) for s in description.segments)
    description = description.model_copy(update={"segments": segments})
    n = description.n_pressures
    bodies = ("mid",) if case.bodies else ()
    random = np.random.default_rng(11)
    samples = []
    for i, begin in enumerate(case.begins):
        made = recording(n, case.count, 20 + i, bodies, case.turns)
        made = replace(made, anew=case.anew[i])
        rows = np.unique(random.integers(0, case.count, case.rows))
        samples.append(Sample(made, rows, random.uniform(0.5, 1.0, len(rows)), begin))
    points = [TrackedPoint("tip", None, lie.exp(random.normal(0, 0.01, 6)), case.turns)]
    if case.bodies:
        points.append(TrackedPoint("mid", 0.1, lie.exp(random.normal(0, 0.01, 6)), case.turns))
    known = Tolerances()
    unknowns = Unknowns(
        parameters=(
            *shape_unknowns(description, EVERY.shape, known),
            *history_unknowns(description, known),
        ),
        base=tuple(placement_unknowns("base", np.full(3, 5e-3), np.full(3, 0.1), True)),
        sensors=tuple(
            tuple(placement_unknowns("sensor", np.full(3, 2e-3), np.full(3, 0.05), case.turns))
            for _ in points
        ),
        zeros=tuple(
            tuple(
                anew_unknowns(s.recording.name, description.length)
                if s.recording.anew
                else zero_unknowns(s.recording.name, known)
            )
            for s in samples
        ),
        sides=tuple(
            tuple(side_unknowns(description, s.recording.name)) if s.begin == "unknown" else ()
            for s in samples
        ),
    )
    base = lie.exp(np.array([0.01, -0.02, 0.03, 0.2, -0.1, 0.3]))
    tables = [table(n)] if case.tables else []
    return CalibrationProblem(description, unknowns, samples, points, base, NOISE, tables)


def somewhere(problem: CalibrationProblem, seed: int = 5) -> Array:
    """Scaled coordinates (d,) near the middle, a little inside the bounds."""
    x = np.random.default_rng(seed).normal(0, 0.2, problem.size)
    return np.asarray(np.clip(x, problem.low + 0.02, problem.high - 0.02))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", CASES)
def test_slopes_are_the_derivatives(name: str) -> None:
    problem = problem_of(CASES[name])
    x = somewhere(problem)
    value, slope = problem.residuals(x)
    assert slope.shape == (len(value), problem.size)
    assert np.isfinite(value).all()
    assert np.isfinite(slope).all()
    # of arms with many, mixtures of unknowns at once
    names = [unknown.name for unknown in problem.unknowns.all]
    ways = list(zip(names, np.eye(problem.size), strict=True))
    if name in ("hanging", "two segments in sequence"):
        mixed = np.random.default_rng(6).normal(0, 0.3, (10, problem.size))
        ways = [("a mixture of unknowns", way) for way in mixed]
    step = 1e-5
    for unknown, way in ways:
        up, down = (problem.residuals(x + s * step * way)[0] for s in (1, -1))
        expected = (up - down) / (2 * step)
        scale = np.abs(expected).max()
        assert slope @ way == pytest.approx(expected, abs=2e-5 * max(scale, 0.1)), unknown
        met_by_loads_only = unknown.startswith(("factor on the stiff", "share of soft"))
        if not met_by_loads_only or problem.tables:
            assert scale > 1e-6, f"{unknown} has no effect"


def test_sides_of_the_first_log_act_on_the_next() -> None:
    problem = problem_of(CASES["two segments in sequence"])
    _, slope = problem.residuals(somewhere(problem))
    sides = problem.unknowns.slices()[3]
    rows = slice(3 * problem.starts[1], 3 * problem.starts[2])  # of the tip's positions
    first = problem.unknowns.sides[0]
    assert len(first) == 6
    assert sides[1].stop == sides[1].start
    assert np.abs(slope[rows, sides[0]]).max() > 1e-3


# -- what is predicted ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two segments in sequence", "hanging"])
def test_prediction_is_that_of_the_robot_behind_a_tracker(name: str) -> None:
    problem = problem_of(CASES[name])
    x = somewhere(problem)
    coordinates = x * problem.scale
    found = problem.predict(x)
    robot = _with_the_same_mass(problem.robot(x), problem.description)
    base, sensors, zeros, _ = problem.unknowns.slices()
    poses = Manipulator(robot).tip_pose(found.effective)
    assert found.poses[0] == pytest.approx(poses, abs=2e-6)  # the robot's values are rounded
    poses = found.poses[0]
    seen = problem.base_in_tracker @ lie.exp(coordinates[base]) @ poses
    seen = seen @ lie.exp(coordinates[sensors[0]]) @ problem.points[0].sensor
    starts = problem.starts
    for own, sample, begin, end in zip(
        zeros, problem.samples, starts[:-1], starts[1:], strict=True
    ):
        place = seen[begin:end, :3, 3] + coordinates[own]
        measured = sample.recording.tracks[0].position[sample.rows]
        assert found.read[0].position[begin:end] == pytest.approx(place, abs=1e-12)
        assert found.errors[0][begin:end] == pytest.approx(measured - place, abs=1e-12, nan_ok=True)


def test_the_weight_keeps_its_direction_in_the_trackers_frame() -> None:
    """Gravity in the file turns with the base; without gravity, the file has none afterwards."""
    problem = problem_of(CASES["hanging"])
    x = somewhere(problem)
    base = problem.unknowns.slices()[0]
    turn = lie.exp((x * problem.scale)[base])[:3, :3]
    assert not np.allclose(turn[:, 2], [0, 0, 1], atol=0.01)
    assert turn @ problem.robot(x).gravity == pytest.approx([0, 0, 9.81], abs=1e-5)
    assert problem.robot(np.zeros(problem.size)).gravity == problem.description.gravity
    # a tracker that may be tilted or, with an inclined arm, turned about its axis in any way
    other, across = copy(problem), (1.4, 0.0, 9.71)
    for gravity, known, turns in (
        (across, {}, True),
        (across, {"base_turn": np.pi}, False),
        ((0.0, 0.0, 9.81), {"base_turn": np.pi}, True),
        ((0.0, 0.0, 9.81), {"base_tilt": 0.3}, False),
    ):
        update = {"gravity": gravity, "tolerances": Tolerances(**known)}
        other.description = problem.description.model_copy(update=update)
        assert (other.robot(x).gravity != gravity) is turns
    free = problem_of(CASES["one segment"])
    assert free.robot(somewhere(free)).gravity == (0.0, 0.0, 0.0)


def test_effective_pressures_are_those_of_the_robots_history() -> None:
    problem = problem_of(CASES["one segment"])
    x = somewhere(problem)
    coordinates = x * problem.scale
    history = problem.robot(x).segments[0].history
    assert history is not None
    found = problem.predict(x).effective
    sides = problem.unknowns.slices()[3]
    for i, sample in enumerate(problem.samples):
        before = sample.recording.before
        start = Start.from_rest(history, before)
        if sample.begin == "unknown":
            visited = sample.recording.pressures
            start = Start.settled(history, before, coordinates[sides[i]], visited)
        expected = Past(history, 3).effective(
            sample.recording.time, sample.recording.pressures, sample.rows, start, history
        )
        own = slice(problem.starts[i], problem.starts[i + 1])
        assert found[own] == pytest.approx(expected.pressures, rel=1e-6)


def test_logs_of_one_clock_are_as_far_apart_as_it_says() -> None:
    problem = problem_of(CASES["two segments in sequence"])
    x, (first, second, third) = somewhere(problem), problem.samples

    def effective(pause: float) -> Array:
        begin = first.recording.time[-1] + pause
        time = second.recording.time - second.recording.time[0] + begin
        later = replace(second, recording=replace(second.recording, time=time))
        moved = CalibrationProblem(
            problem.description, problem.unknowns, [first, later, third], problem.points,
            problem.base_in_tracker, problem.noise,
        )  # fmt: skip
        return moved.predict(x).effective[problem.starts[1] : problem.starts[2]]

    own = problem.predict(x).effective[problem.starts[1] : problem.starts[2]]
    assert effective(FIT.between_logs) == pytest.approx(own, abs=1e-3)
    assert np.abs(effective(0.5) - own).max() > 10.0


def test_residuals_are_weighted_errors_over_the_noise() -> None:
    problem = problem_of(CASES["two segments in sequence"])
    x = somewhere(problem)
    value, slope = problem.residuals(x)
    found = problem.predict(x)
    weight = np.concatenate([sample.weight for sample in problem.samples])
    count = len(weight)
    blocks = value[: 12 * count].reshape(4, count, 3)  # tip, its turn, mid, its turn
    slopes = slope[: 12 * count].reshape(4, count, 3, -1)
    expected = [
        found.errors[0] / NOISE.position,
        -found.read[0].turn / NOISE.angle,  # type: ignore[operator]
        found.errors[1] / NOISE.position,
        -found.read[1].turn / NOISE.angle,  # type: ignore[operator]
    ]
    for block, slope_of, unweighted in zip(blocks, slopes, expected, strict=True):
        known = np.isfinite(unweighted).all(axis=1)
        assert 0 < known.sum() < count
        assert block[known] == pytest.approx((unweighted * weight[:, None])[known], rel=1e-12)
        assert not block[~known].any()
        assert not slope_of[~known].any()
    assert not value[12 * count :].any()  # shares are small enough


def test_a_robot_of_coordinates() -> None:
    problem = problem_of(CASES["one segment"])
    assert problem.robot(np.zeros(problem.size)).segments[0].length == pytest.approx(0.09)
    x = somewhere(problem)
    robot = problem.robot(x)
    for i, unknown in enumerate(problem.unknowns.parameters):
        assert unknown.parameter is not None
        before, after = (unknown.parameter.value(r) for r in (problem.description, robot))
        moved = x[i] * unknown.deviation
        is_ratio = unknown.unit == "" and unknown.parameter.number.positive
        expected = before * np.exp(moved) if is_ratio else before + moved
        assert after == pytest.approx(expected, rel=1e-6), unknown.name


def test_stiffness_residuals_are_those_of_the_robot() -> None:
    problem = problem_of(CASES["one segment with a table"])
    x = somewhere(problem)
    given = problem.tables[0]
    history = problem.robot(x).segments[0].history
    assert history is not None
    held = np.mean(history.memory) * sum(part.share for part in history.parts)
    key = Parameter("segments[0].compensation.stiffness")
    # a table is measured with quick pushes, against which play and creep hold
    stiffer = key.value(problem.robot(x)) / (1 - held)
    robot = Manipulator(with_values(problem.robot(x), {key: stiffer}))
    found = problem.residuals(x)[0][3 * problem.starts[-1] :][: len(given)]
    for row in range(len(given)):
        boundary = given.boundaries[row]
        assert boundary in ("free", "clamped")
        k = robot.stiffness(given.pressures[row], given.directions[row], boundary=boundary)
        expected = (given.stiffness[row] - float(k)) / given.sigma[row]
        # the robot's values are rounded
        assert found[row] == pytest.approx(0.0 if np.isnan(expected) else expected, abs=1e-4)


def penalised(kind: str) -> Array:
    """Coordinates at which a penalty is felt, of the problem of one segment."""
    problem = problem_of(CASES["one segment"])
    names = [unknown.name for unknown in problem.unknowns.all]
    x = np.zeros(problem.size)
    if kind == "memory":
        for name in ("share of play, segment 1 number 1", "share of play, segment 1 number 2"):
            x[names.index(name)] = 0.29 / problem.scale[names.index(name)]
    else:
        x[names.index("change of modulus with pressure, segment 1")] = -1.0  # -0.4
        x[names.index("Young's modulus, segment 1")] = -0.5
    return x


@pytest.mark.parametrize("kind", ["memory", "softening"])
def test_what_an_arm_cannot_be_is_penalised_with_the_right_slope(kind: str) -> None:
    problem = problem_of(CASES["one segment"])
    x = penalised(kind)
    first = 3 * problem.starts[-1]
    value, slope = (found[first:] for found in problem.residuals(x))
    assert len(value) == 3 + 1  # channels and segments
    assert (value[:3] > 0).any() == (kind == "memory")
    assert (value[3] > 0) == (kind == "softening")
    assert not problem.residuals(np.zeros(problem.size))[0][first:].any()
    step = 1e-6
    for i in range(problem.size):
        change = step * np.eye(problem.size)[i]
        up, down = (problem.residuals(x + s * change)[0][first:] for s in (1, -1))
        assert slope[:, i] == pytest.approx((up - down) / (2 * step), abs=1e-4)


def test_an_exponential_law_may_not_take_nearly_all_of_the_modulus_either() -> None:
    given = problem_of(CASES["one segment"])
    (segment,) = given.description.segments
    assert segment.compensation is not None
    law = segment.compensation.model_copy(update={"modulus_law": "exponential"})
    robot = given.description.model_copy(
        update={"segments": (segment.model_copy(update={"compensation": law}),)}
    )
    problem = CalibrationProblem(
        robot, given.unknowns, given.samples, given.points, given.base_in_tracker, given.noise
    )
    names = [unknown.name for unknown in problem.unknowns.all]
    x = np.zeros(problem.size)
    x[names.index("change of modulus with pressure, segment 1")] = -2.0
    penalties = []
    for softer in (0.0, 6.0):
        x[names.index("Young's modulus, segment 1")] = -softer
        penalties.append(problem.residuals(x)[0][3 * problem.starts[-1] + 3])
    assert penalties[0] == 0 < penalties[1]


def test_a_table_without_any_value_says_nothing() -> None:
    problem = problem_of(CASES["one segment with a table"])
    empty = replace(problem.tables[0], stiffness=np.full(4, np.nan))
    other = CalibrationProblem(
        problem.description, problem.unknowns, problem.samples, problem.points,
        problem.base_in_tracker, problem.noise, [empty],
    )  # fmt: skip
    value, slope = other.residuals(somewhere(other))
    assert not value[-8:].any()
    assert not slope[-8:].any()


def test_other_weights_and_noise() -> None:
    problem = problem_of(CASES["one segment"])
    x = somewhere(problem)
    value, slope = problem.residuals(x)
    halved = [replace(sample, weight=sample.weight / 2) for sample in problem.samples]
    other = problem.with_samples(halved, Noise(NOISE.position * 2, NOISE.angle))
    again, other_slope = other.residuals(x)
    assert again == pytest.approx(value / 4)
    assert other_slope == pytest.approx(slope / 4)
    assert problem.residuals(x)[0] == pytest.approx(value)  # the first is as it was
