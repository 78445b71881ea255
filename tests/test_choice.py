"""The choice of a model: what is held back, and which is the simplest that predicts as well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from made_logs import course, made_log
from stiffopt.identify import folds as held
from stiffopt.identify.error_model import HeldBack
from stiffopt.identify.fit import fit
from stiffopt.identify.folds import held_back, is_region
from stiffopt.identify.problem import CalibrationProblem
from stiffopt.identify.results import Errors
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.structures import STRUCTURES, Candidate, best
from stiffopt.logs import Log
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

ONE = load_description("stiff-flop-1")
BY_NAME = {structure.name: structure for structure in STRUCTURES}


def test_memory_of_an_arm_that_softens_acts_at_its_modulus() -> None:
    """Where creep is fitted; without it, play also stands for creep."""
    softening = {
        name: BY_NAME[name].applied(ONE, 1e5).segments[0].history
        for name in ("hysteresis", "creep", "elongation-hysteresis")
    }
    values = [history.softening if history else None for history in softening.values()]
    assert values == [0.0, pytest.approx(-0.2 / 1e5), pytest.approx(-0.2 / 1e5)]
    known = ONE.segments[0].compensation
    assert known is not None
    update = {"compensation": known.model_copy(update={"modulus_law": "exponential"})}
    segment = ONE.segments[0].model_copy(update=update)
    other = BY_NAME["creep"].applied(ONE.model_copy(update={"segments": (segment,)}), 1e5)
    assert other.segments[0].history is not None
    assert other.segments[0].history.softening == 0


def test_memory_of_strain_has_operators_of_opposite_fibres() -> None:
    structure = BY_NAME["creep"].of_strain()
    arm = structure.applied(ONE, 1e5)
    history = arm.segments[0].history
    assert history is not None
    assert history.remembers == "strain"
    parts = [
        [play.width for play in history.play if play.of == of] for of in ("pressure", "opposite")
    ]
    assert parts[0] == parts[1] != []
    for each in (structure, BY_NAME["creep"]):
        assert each.applied(arm, 1e5) == arm  # what it has, it keeps
    creep = BY_NAME["creep"].applied(ONE, 1e5).segments[0].history
    assert creep is not None
    assert creep.remembers == "pressure"
    assert all(play.of == "pressure" for play in creep.play)


@dataclass(frozen=True)
class Nothing:
    """Stands for a fit that nobody asks."""


def candidate(index: int, means: list[float]) -> Candidate:
    nothing: Any = Nothing()
    folds = {
        str(i): HeldBack(np.ones(10, dtype=bool), nothing, Errors(10, mean, mean, mean, mean, None))
        for i, mean in enumerate(means)
    }
    return Candidate(STRUCTURES[index], nothing, folds)


def test_clearly_better_wins() -> None:
    found = best([candidate(0, [5e-3, 6e-3, 5e-3]), candidate(1, [1e-3, 1.1e-3, 1e-3])])
    assert found.structure is STRUCTURES[1]
    assert found.score == pytest.approx(3.1e-3 / 3)


def test_of_those_as_good_the_simplest_wins() -> None:
    worse_by_a_little = candidate(0, [1.01e-3, 1.01e-3, 1.01e-3])
    assert best([worse_by_a_little, candidate(1, [1e-3] * 3)]) is worse_by_a_little
    much = candidate(0, [1.05e-3, 1.05e-3, 1.05e-3])  # the same everywhere: that is no chance
    assert best([much, candidate(1, [1e-3] * 3)]).structure is STRUCTURES[1]


def test_what_may_be_chance_is_taken_for_chance() -> None:
    simple = candidate(0, [1.5e-3, 0.9e-3, 1.2e-3])  # on the average 20 % worse, but by one log
    assert best([simple, candidate(1, [1e-3] * 3)]).structure is STRUCTURES[1]
    simple = candidate(0, [2.2e-3, 0.9e-3, 0.8e-3])
    assert best([simple, candidate(1, [1e-3] * 3)]) is simple


def test_one_fold_alone_has_no_chance() -> None:
    assert best([candidate(0, [1.3e-3]), candidate(1, [1e-3])]).structure is STRUCTURES[1]


def log_of(seed: int, duration: float = 20.0, skip: float = 0.0) -> Log:
    time, pressures = course(3, duration + skip, seed)
    log = made_log(ONE, time, pressures, seed=seed)
    kept = time >= skip
    return Log(time[kept], pressures[kept], log.tip_position[kept])


def problem_of(
    logs: list[tuple[str, Log]], rows: int = 200, structure: str = "static"
) -> CalibrationProblem:
    told = CalibrationSettings(structure=structure)
    setup = Setup.of(ONE, recordings_of(ONE, logs, told), [], told)
    return setup.problem(BY_NAME[structure], rows)


def test_parts_and_highest_pressures_of_few_logs_are_held_back() -> None:
    problem = problem_of([("a", log_of(1)), ("b", log_of(2))])
    folds = held.folds(problem)
    parts = [f"part {i} of 4" for i in (1, 2, 3, 4)]
    levels = ["highest pressures", "lowest pressures", "rising pressures"]
    regions = [f"pressures, region {i} of 3" for i in (1, 2, 3)]
    assert list(folds) == [*parts, *levels, *regions]
    assert [name for name in folds if is_region(name)] == [*levels, *regions]
    for k in range(2):
        together = np.array([folds[part][k] for part in parts])
        assert (together.sum(axis=0) == 1).all()  # every row once
        assert (np.diff(np.argmax(together, axis=0)) >= 0).all()  # and in one piece
    high = np.concatenate(folds["highest pressures"])
    pressures = np.concatenate([s.recording.pressures[s.rows] for s in problem.samples])
    norms = np.linalg.norm(pressures, axis=1)
    assert high.mean() == pytest.approx(0.2, abs=0.03)
    assert norms[high].min() >= norms[~high].max()
    low = np.concatenate(folds["lowest pressures"])
    assert norms[low].max() <= norms[~low].min()
    of_regions = np.array([np.concatenate(folds[name]) for name in regions])
    assert (of_regions.sum(axis=0) == 1).all()
    middles = np.array([pressures[rows].mean(axis=0) for rows in of_regions])
    squared = ((pressures[:, np.newaxis] - middles) ** 2).sum(axis=2)
    assert (squared.argmin(axis=1) == of_regions.argmax(axis=0)).all()
    rising = folds["rising pressures"][0]
    change = np.diff(pressures[: len(rising)].sum(axis=1), prepend=pressures[0].sum())
    assert (rising == (change > 0)).all()


def test_a_simpler_model_is_as_good_within_what_was_recorded_and_beyond() -> None:
    names = [*(f"part {i} of 4" for i in (1, 2, 3, 4)), "highest pressures", "lowest pressures"]

    def with_means(index: int, means: list[float]) -> Candidate:
        named = dict(zip(names, candidate(index, means).held_back.values(), strict=True))
        nothing: Any = Nothing()
        return Candidate(STRUCTURES[index], nothing, named)

    rich = with_means(1, [0.8e-3] * 4 + [4e-3, 2e-3])
    scattered_beyond = [5e-3, 1.2e-3]
    assert best([with_means(0, [1e-3] * 4 + scattered_beyond), rich]) is rich
    simple = with_means(0, [0.81e-3] * 4 + scattered_beyond)
    assert best([simple, rich]) is simple


def test_logs_are_held_back_one_by_one() -> None:
    problem = problem_of([(name, log_of(i)) for i, name in enumerate("abc")])
    folds = held.folds(problem)
    assert list(folds) == ["a", "b", "c"]
    assert [[bool(rows.all()) for rows in away] for away in folds.values()] == np.eye(3).tolist()
    assert [[bool(rows.any()) for rows in away] for away in folds.values()] == np.eye(3).tolist()


def test_what_is_held_back_has_no_say() -> None:
    logs = [(name, log_of(i)) for i, name in enumerate("abc")]
    spoilt = Log(logs[2][1].time, logs[2][1].commanded, logs[2][1].tip_position + 0.01)
    problem = problem_of([*logs[:2], ("c", spoilt)])
    found = fit(problem, [np.zeros(problem.size)], rounds=0)
    part = held_back(found, 2.0, lambda: None)["c"]
    assert part.errors.mean == pytest.approx(0.01 * np.sqrt(3), rel=0.1)
    assert part.errors.n == part.rows.sum() == len(problem.samples[2].rows)
    away = [np.zeros(len(s.rows), dtype=bool) for s in problem.samples]
    away[2][:] = True
    value, slope = problem.without(away).residuals(found.x)
    rows = slice(3 * problem.starts[2], 3 * problem.starts[3])
    assert not value[rows].any()
    assert not slope[rows].any()
    assert np.abs(value[: rows.start]).max() > 0


def test_what_is_held_back_is_forgotten() -> None:
    """The fit without a fold begins where that to all rows ended, and goes on to its own end."""
    problem = problem_of(
        [(name, log_of(i)) for i, name in enumerate("abc")], structure="progressive"
    )
    found = fit(problem, [np.zeros(problem.size)], rounds=0)
    far = np.random.default_rng(3).normal(0, 0.7, problem.size)
    part = held_back(replace(found, x=far), 2.0, lambda: None)["c"].fit
    other = fit(part.problem, [found.x], rounds=0)
    assert part.cost == pytest.approx(other.cost, abs=0.01)


def test_the_beginning_of_a_log_in_an_unknown_state_is_for_its_state() -> None:
    logs = [(name, log_of(i, skip=5.0)) for i, name in enumerate("abc")]
    assert (np.abs(logs[0][1].commanded[0]) > 3e3).any()
    problem = problem_of(logs, structure="hysteresis")
    assert problem.samples[0].begin == "unknown"
    everything = np.ones(len(problem.samples[0].rows), dtype=bool)
    kept = held._without_beginning(everything, problem, 0, 2.0)
    time = problem.samples[0].recording.time[problem.samples[0].rows]
    assert kept.tolist() == (time > time[0] + 2.0).tolist()
    part = everything.copy()
    part[:10] = False
    assert held._without_beginning(part, problem, 0, 2.0) is part


def test_coordinates_by_name_go_from_model_to_model() -> None:
    one = problem_of([("a", log_of(1))], structure="lag")
    other = problem_of([("a", log_of(1))], structure="hysteresis")
    x = np.random.default_rng(0).normal(0, 0.3, one.size)
    near = one.named(np.clip(x, one.low, one.high))
    begun = other.named(other.start(near))
    assert {name: begun[name] for name in near} == near
    new = set(begun) - set(near)
    assert new
    assert all(begun[name] == 0 for name in new)
    low = other.start(dict.fromkeys(begun, -1000000000.0))
    assert low == pytest.approx(np.maximum(other.low, -1e9))


def test_what_these_logs_cannot_tell_is_not_tried() -> None:
    """Creep needs pressures that are held, a dead time rows that are close."""
    time = np.arange(0, 60, 0.05)
    circle = 4e4 * (1 + np.sin(time[:, None] + np.array([0, 2, 4])))
    steps = np.repeat(np.random.default_rng(0).uniform(0, 1e5, (12, 3)), 100, axis=0)

    def recorded(pressures: Array, every: int = 1) -> tuple[str, Log]:
        return "a", made_log(ONE, time[::every], pressures[::every])

    def tells(name: str, pressures: Array) -> bool:
        recordings = recordings_of(ONE, [recorded(pressures)], CalibrationSettings())
        return BY_NAME[name].can_be_told(recordings)

    assert tells("creep", steps)
    assert not tells("creep", circle)
    assert tells("hysteresis", circle)
    for every, fine in ((1, True), (3, True), (12, False)):
        unknowns = problem_of([recorded(steps, every)], structure="lag").unknowns.all
        assert any(unknown.name.startswith("dead time") for unknown in unknowns) == fine
