"""Time all kinds of tasks, and loaded arms, relative to the plain task."""

from collections.abc import Callable

import numpy as np

import settings as bars
import tasks
from peers.base import Vector
from peers.own import Stiffopt
from report import Section, at_least, at_most, milliseconds, percent, times
from settings import Settings
from timing import interleaved, median

TEXT = """\
The same times for tasks of other kinds, by stiffopt alone. *Ratio*: median cold time over that
of the plain task (position and one free translational stiffness) of the same arm, interleaved
with it. *Reached*: share of the cold answers within all tolerances. Random targets of all kinds
are within reach. *hanging*: two segments under gravity with 20 g at the tip; *tip load*: 0.02 N
along the arm."""

PLAIN = "position"


def section(sizes: Settings) -> Section:
    """The table of kinds."""
    out = Section(
        "Other kinds of tasks",
        TEXT,
        ("kind", "segments", "cold, ms", "ratio", "warm, ms", "reached", "tasks"),
    )
    free = ("pose-6", "several") if sizes.quick else tasks.FREE_KINDS
    for segments in (s for s in (2, 3) if s in sizes.few_segments):
        _table(out, [PLAIN, *free], segments, sizes)
    _table(out, [PLAIN, *(tasks.LOADED_KINDS[:1] if sizes.quick else tasks.LOADED_KINDS)], 2, sizes)
    return out


def _table(out: Section, kinds: list[str], segments: int, sizes: Settings) -> None:
    count = sizes.kind_tasks
    cases = {k: [tasks.task_of(k, segments, sizes.seed, i) for i in range(count)] for k in kinds}
    solvers = {
        kind: [Stiffopt(segments, robot) for robot, _ in of_kind] for kind, of_kind in cases.items()
    }
    answers: dict[tuple[str, int], Vector | None] = {}
    ready: dict[tuple[str, int], Callable[[], Vector | None]] = {}

    def cold_call(kind: str) -> Callable[[int], None]:
        def call(item: int) -> None:
            answers[kind, item] = solvers[kind][item].cold(cases[kind][item][1])

        return call

    def prepare(kind: str, item: int) -> None:
        robot, task = cases[kind][item]
        p = answers.get((kind, item))
        target = task.target if p is None else tasks.moved(robot, task, p)
        again = solvers[kind][item].remember_from(task, p)
        ready[kind, item] = lambda: again(target)

    for kind in kinds:
        for item in range(count):  # tasks of one kind may differ in structure
            cold_call(kind)(item)  # what is built once
    cold = interleaved(
        {kind: cold_call(kind) for kind in kinds}, count, sizes.repetitions, sizes.most_seconds
    )
    warm = interleaved(
        {kind: lambda item, k=kind: ready[k, item]() for kind in kinds}, count,
        sizes.repetitions, sizes.most_seconds, prepare,
    )  # fmt: skip
    loaded = kinds[-1] in tasks.LOADED_KINDS
    factor = bars.LOADED_FACTOR if loaded else bars.KIND_FACTOR
    for kind in kinds[1:]:
        done = [item for item in range(count) if (kind, item) in answers]
        reached = float(
            np.mean(
                [
                    tasks.holds(robot, task, task.target, answers[kind, item])
                    for item, (robot, task) in enumerate(cases[kind])
                    if item in done
                ]
            )
        )
        cold_s, warm_s = median(cold[kind]), median(warm[kind])
        out.rows.append(
            (
                kind, str(segments), milliseconds(cold_s), times(cold_s / median(cold[PLAIN])),
                milliseconds(warm_s), percent(reached), str(len(done)),
            )
        )  # fmt: skip
        out.data[f"{kind} {segments}"] = {"cold_s": cold_s, "warm_s": warm_s, "reached": reached}
        arm = f"{kind}, {segments} segments"
        out.verdicts += [
            at_most(f"cold, {arm}", factor * bars.COLD_MS[segments], cold_s * 1e3, "ms"),
            at_most(f"warm, {arm}", factor * bars.WARM_MS[segments], warm_s * 1e3, "ms"),
            at_least(f"reached, {arm}", 100, 100 * reached, "%"),
        ]
