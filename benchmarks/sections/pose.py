"""Compare reaching a position, without stiffness, with pink on an equivalent rigid chain."""

from collections.abc import Callable

import numpy as np

import tasks
from peers.base import PeerMissingError, Vector
from peers.own import Stiffopt
from peers.pink_chain import Pink
from report import Comparison, Section, milliseconds, percent, times
from settings import Settings
from timing import interleaved, median, ratio

TEXT = """\
A random position within 0.1 mm, nothing else. stiffopt finds the pose with the least pressure
(a global search); pink takes full steps of inverse kinematics from one bent start, on a rigid
chain with the same poses (its file says how) until it is within 0.1 mm. *Reached*: share within
the tolerance. *Pressures exist*: share of the answers that the arm's chambers can take within
their limits; the chain's joint limits cannot say that."""


def section(sizes: Settings) -> Section:
    """The table of poses."""
    out = Section(
        "Pose alone",
        TEXT,
        ("segments", "solver", "time, ms", "ratio", "reached", "pressures exist", "tasks"),
    )
    for segments in sizes.segments:
        try:
            pink = Pink.of(segments)
        except PeerMissingError as error:
            out.skipped[Pink.name] = str(error)
            return out
        _table(out, pink, segments, sizes)
    return out


def _table(out: Section, pink: Pink, segments: int, sizes: Settings) -> None:
    own, robot = Stiffopt(segments), tasks.arm(segments)
    count = sizes.warm_tasks
    kind = "least-pressure"
    cases = [tasks.task_of(kind, segments, sizes.seed, i)[1] for i in range(count)]
    positions = [np.array(task.target.position) for task in cases]
    answers: dict[int, Vector | None] = {}
    chain: dict[int, tuple[bool, Vector]] = {}

    def solve(item: int) -> None:
        answers[item] = own.cold(cases[item])

    def reach(item: int) -> None:
        chain[item] = pink.reach(positions[item])

    solve(0)
    reach(0)
    calls: dict[str, Callable[[int], None]] = {own.name: solve, pink.name: reach}
    taken = interleaved(calls, count, sizes.repetitions, sizes.most_seconds)
    mine = [tasks.holds(robot, cases[i], cases[i].target, p) for i, p in answers.items()]
    reached = {own.name: float(np.mean(mine))}
    reached[pink.name] = float(np.mean([good for good, _ in chain.values()]))
    possible = {own.name: reached[own.name]}
    possible[pink.name] = float(np.mean([pink.pressures(q) is not None for _, q in chain.values()]))
    done = {own.name: len(answers), pink.name: len(chain)}
    for name in calls:
        relative = ratio(taken[name], taken[own.name])
        out.rows.append(
            (
                str(segments), name, milliseconds(median(taken[name])), times(relative),
                percent(reached[name]), percent(possible[name]), str(done[name]),
            )
        )  # fmt: skip
    out.data[str(segments)] = {name: median(taken[name]) for name in calls}
    out.comparisons.append(
        Comparison(
            f"pose alone, {tasks.arm_words(segments)}", pink.name,
            ratio(taken[pink.name], taken[own.name]),
            remark=f"its answer is within the pressure limits in {percent(possible[pink.name])}",
        )
    )  # fmt: skip
