"""Time the full task, cold and warm, side by side with other solvers."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

import settings as bars
import tasks
from peers.base import TaskSolver, Vector, available
from peers.ipopt import Ipopt, IpoptEnergy
from peers.own import Stiffopt
from peers.slsqp import Slsqp
from report import Comparison, Section, at_least, at_most, milliseconds, percent, times
from settings import Settings
from stiffopt import Task
from timing import Times, interleaved, median, ratio

TEXT = """\
A random position (within 0.1 mm) and one random direction whose stiffness is maximised. *Cold*:
from the task alone. *Warm*: the target moved by 0.5 mm, from the previous solution. *Best*:
share of tasks whose stiffness is within 0.5 % of the best that any solver found, or IPOPT from
random starts. *Reached*: share, warm, within the tolerance. *Ratio*: median over the tasks of
the peer's time over stiffopt's; above 1 stiffopt is faster. *Tasks*: how many were timed, cold
/ warm. Interleaved calls find the processor's caches full of the other solvers. *In a row* are the
same calls of stiffopt one after another, as a planner's loop makes them; the bars in ms are held
against these."""

IN_A_ROW = 7  # times that a call is repeated


@dataclass
class Measured:
    """What was measured on one arm."""

    segments: int
    cold: Times
    warm: Times
    values: dict[str, Vector]
    reached: dict[str, float]
    best: Vector
    skipped: dict[str, str]
    in_a_row: tuple[float, float]

    def share(self, name: str) -> float:
        """Share of its tasks in which a solver was within 0.5 % of the best known."""
        values = self.values[name]
        done = ~np.isnan(values) & (self.best > 0)
        if not done.any():
            return float("nan")
        return float(np.mean(values[done] >= (1 - bars.NEAR_BEST) * self.best[done]))

    def missed(self, name: str) -> list[int]:
        """Numbers of the tasks in which a solver was not within 0.5 % of the best known."""
        values = self.values[name]
        near = np.isnan(values) | (values >= (1 - bars.NEAR_BEST) * self.best)
        return [int(number) for number in np.flatnonzero(~near)]

    def share_beside(self, name: str) -> float:
        """Share of stiffopt over that of a peer, on the tasks that both solved; at least 0."""
        both = ~np.isnan(self.values[name]) & ~np.isnan(self.values[Stiffopt.name])
        limit = (1 - bars.NEAR_BEST) * self.best[both]
        own, peer = (np.sum(self.values[n][both] >= limit) for n in (Stiffopt.name, name))
        return float(own / peer) if peer else float("inf")

    def record(self) -> dict[str, dict[str, float]]:
        """For the plots and the file of results."""
        return {
            name: {
                "cold_s": median(self.cold[name]),
                "warm_s": median(self.warm[name]),
                "best": self.share(name),
                "ratio_cold": ratio(self.cold[name], self.cold[Stiffopt.name]),
                "ratio_warm": ratio(self.warm[name], self.warm[Stiffopt.name]),
            }
            for name in self.cold
        }


def stiffness_of(task: Task, p: Vector | None, segments: int) -> float:
    """Stiffness of an answer, judged by one model for all; 0 where it breaks a tolerance."""
    robot = tasks.arm(segments)
    if p is None or not tasks.holds(robot, task, task.target, p):
        return 0.0
    assert task.stiffness is not None
    return float(robot.stiffness(p, task.stiffness.maximise[0].direction))


def measure(kinds: list[type[TaskSolver]], segments: int, sizes: Settings) -> Measured:
    """Time solvers on the random tasks of one arm; the first of them is stiffopt."""
    peers, skipped = available(list(kinds), segments)
    solvers = {peer.name: peer for peer in peers if isinstance(peer, TaskSolver)}
    cases = [tasks.task_of("position", segments, sizes.seed, i)[1] for i in range(sizes.tasks)]
    own = solvers[Stiffopt.name]
    for solver in solvers.values():
        solver.cold(cases[0])  # what is built once is built here
    values = {name: np.full(sizes.tasks, np.nan) for name in solvers}

    def cold_call(name: str) -> Callable[[int], None]:
        def call(item: int) -> None:
            answers[name, item] = solvers[name].cold(cases[item])

        return call

    answers: dict[tuple[str, int], Vector | None] = {}
    calls = {name: cold_call(name) for name in solvers}
    cold = interleaved(calls, sizes.tasks, sizes.repetitions, sizes.most_seconds)
    for (name, item), p in answers.items():
        values[name][item] = stiffness_of(cases[item], p, segments)
    some = cases[: sizes.warm_tasks]
    warm, reached = _warm(solvers, some, segments, sizes)
    best = np.nanmax(np.stack(list(values.values())), axis=0)
    best = np.maximum(best, _reference(cases, segments, sizes))
    in_a_row = _in_a_row(own, some, segments)
    return Measured(segments, cold, warm, values, reached, best, skipped, in_a_row)


def _in_a_row(own: TaskSolver, cases: list[Task], segments: int) -> tuple[float, float]:
    """Median seconds, cold and warm, of calls one after another."""
    robot = tasks.arm(segments)
    cold, warm = [], []
    for task in cases:
        p = own.cold(task)
        cold.append(_repeated(lambda task=task: own.cold(task)))
        if p is not None:
            again, target = own.remember(task), tasks.moved(robot, task, p)
            warm.append(_repeated(lambda again=again, target=target: again(target)))
    return float(np.median(cold)), float(np.median(warm))


def _repeated(call: Callable[[], object]) -> float:
    times_taken = []
    for _ in range(IN_A_ROW):
        begin = perf_counter()
        call()
        times_taken.append(perf_counter() - begin)
    return float(np.median(times_taken))


def _warm(
    solvers: dict[str, TaskSolver], cases: list[Task], segments: int, sizes: Settings
) -> tuple[Times, dict[str, float]]:
    """Times of solutions from the last one, and shares of the answers that reach the target."""
    robot = tasks.arm(segments)
    targets = []
    for task in cases:
        p = solvers[Stiffopt.name].cold(task)
        targets.append(tasks.moved(robot, task, p) if p is not None else task.target)
    ready: dict[tuple[str, int], Callable[..., Vector | None]] = {}
    answers: dict[tuple[str, int], Vector | None] = {}

    def prepare(name: str, item: int) -> None:
        ready[name, item] = solvers[name].remember(cases[item])

    def call(name: str) -> Callable[[int], None]:
        def run(item: int) -> None:
            answers[name, item] = ready[name, item](targets[item])

        return run

    calls = {name: call(name) for name in solvers}
    warm = interleaved(calls, len(cases), sizes.repetitions, sizes.most_seconds, prepare)
    reached: dict[str, list[bool]] = {name: [] for name in solvers}
    for (name, item), p in answers.items():
        reached[name].append(tasks.holds(robot, cases[item], targets[item], p))
    return warm, {name: float(np.mean(all_of)) for name, all_of in reached.items()}


def _reference(cases: list[Task], segments: int, sizes: Settings) -> NDArray[np.float64]:
    """Best stiffness of IPOPT from random starts, untimed."""
    solver = IpoptEnergy.of(segments)
    rng = np.random.default_rng([sizes.seed, segments])
    best = np.zeros(len(cases))
    for item, task in enumerate(cases):
        for _ in range(sizes.reference_starts):
            p = solver.from_start(task, 2 * solver.middle * rng.random(solver.n))
            best[item] = max(best[item], stiffness_of(task, p, segments))
    return best


def section(sizes: Settings) -> Section:
    """The table of the full task."""
    out = Section(
        "Full task: pose and stiffness",
        TEXT,
        ("segments", "solver", "cold, ms", "ratio", "best", "warm, ms", "ratio", "reached",
         "tasks"),
    )  # fmt: skip
    for segments in sizes.segments:
        found = measure([Stiffopt, Ipopt, IpoptEnergy, Slsqp], segments, sizes)
        out.skipped.update(found.skipped)
        record = found.record()
        out.data[str(segments)] = record
        cold, warm = found.in_a_row
        in_a_row = {f"{Stiffopt.name}, in a row": {"cold_s": cold, "warm_s": warm}}
        out.data[str(segments)] = {**record, **in_a_row}
        out.rows.append(
            (str(segments), f"{Stiffopt.name}, in a row", milliseconds(cold), "", "",
             milliseconds(warm), "", "", "")
        )  # fmt: skip
        missed = found.missed(Stiffopt.name)
        if missed:
            out.text += f" Not best, {segments} segments: stiffopt in the tasks number {missed}."
        for name, line in record.items():
            timed = (int(np.sum(~np.isnan(t[name]).all(axis=0))) for t in (found.cold, found.warm))
            out.rows.append(
                (
                    str(segments), name, milliseconds(line["cold_s"]), times(line["ratio_cold"]),
                    percent(line["best"]), milliseconds(line["warm_s"]), times(line["ratio_warm"]),
                    percent(found.reached[name]), " / ".join(map(str, timed)),
                )
            )  # fmt: skip
        _judge(out, segments, record, found)
    return out


def _judge(
    out: Section, segments: int, record: dict[str, dict[str, float]], found: Measured
) -> None:
    own = record[Stiffopt.name]
    arm = tasks.arm_words(segments)
    if segments in bars.COLD_MS:
        cold, warm = found.in_a_row
        out.verdicts += [
            at_most(f"cold, {arm}", bars.COLD_MS[segments], cold * 1e3, "ms"),
            at_most(f"warm, {arm}", bars.WARM_MS[segments], warm * 1e3, "ms"),
        ]
    if segments in bars.COLD_TIMES_IPOPT:
        measured = record[Ipopt.name]["ratio_cold"]
        limit = bars.COLD_TIMES_IPOPT[segments]
        out.verdicts.append(at_least(f"cold against {Ipopt.name}, {arm}", limit, measured, "x"))
    if segments in bars.SHARE_BEST:
        limit = 100 * bars.SHARE_BEST[segments]
        what = f"within 0.5 % of the best known, {arm}"
        out.verdicts.append(at_least(what, limit, 100 * own["best"], "%"))
    out.verdicts.append(
        at_least(f"warm, reached, {arm}", 100, 100 * found.reached["stiffopt"], "%")
    )
    for name, line in record.items():
        if name == Stiffopt.name:
            continue
        for how in ("cold", "warm"):
            remark = f"best in {percent(line['best'])}, stiffopt in {percent(own['best'])}"
            out.comparisons.append(
                Comparison(f"full task, {how}, {arm}", name, line[f"ratio_{how}"], remark=remark)
            )
        share = found.share_beside(name)
        out.comparisons.append(Comparison(f"full task, {arm}", name, share, "share best"))
