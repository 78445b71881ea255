"""Time the calls that motion planners make, separately for warm and cold caches."""

from collections.abc import Callable
from functools import partial
from time import thread_time

import numpy as np

import settings as bars
import tasks
from report import Section, at_most
from settings import Settings
from stiffopt import Load, Manipulator, PressureSolver, Target, load_robot

TEXT = """\
CPU time of calls one after another. *Hot*: least of many repetitions. *Cold*: median, each after
48 MB were written, so that the processor's caches are full of other things. *Machine code*: the
call of `warm`'s search alone, found next to the guess and not judged; *nothing*: a call of a C
function that does nothing. The target moves by 0.5 mm, from the previous answer. *Unreachable*:
median over random targets around the arm, hot, of `solve` and of `reachable`."""

COLD_BYTES = 48 * 2**20
REPETITIONS, COLD_REPETITIONS = 400, 30


def section(sizes: Settings) -> Section:
    """The table of calls."""
    out = Section("Calls of planners", TEXT, ("arm", "call", "hot, us", "cold, us"))
    share = 10 if sizes.quick else 1
    for segments in sizes.few_segments:
        _warm_calls(out, segments, sizes, share)
    _unreachable(out, sizes, share)
    return out


def _warm_calls(out: Section, segments: int, sizes: Settings, share: int) -> None:
    robot, arm = tasks.arm(segments), tasks.arm_words(segments)
    above_hot, above_cold = [], []
    table: dict[str, list[tuple[float, float]]] = {}
    for item in range(max(1, sizes.warm_tasks // 2 // share)):
        _, task = tasks.task_of("position", segments, sizes.seed, item)
        solver = PressureSolver(robot, task)
        p = solver.solve().pressures
        if p is None:
            continue
        target = tasks.moved(robot, task, p)
        place = np.array(target.position)
        if not solver.warm(place, p).found:
            continue
        hot: dict[str, float] = {}
        cold: dict[str, float] = {}
        for name, call in _calls(solver, target, place, np.array(p)).items():
            hot[name] = _hot(call, REPETITIONS // share)
            cold[name] = _cold(call, max(3, COLD_REPETITIONS // share))
            table.setdefault(name, []).append((hot[name], cold[name]))
        above_hot.append(hot["warm"] - hot["machine code"])
        above_cold.append(cold["warm"] - cold["nothing"])
    for name, pairs in table.items():
        hot_us, cold_us = np.median(np.array(pairs), axis=0) * 1e6
        out.rows.append((arm, name, f"{hot_us:.1f}", f"{cold_us:.0f}"))
        out.data[f"{segments} {name}"] = {"hot_us": hot_us, "cold_us": cold_us}
    out.verdicts += [
        at_most(f"warm above machine code, hot, {arm}", bars.WARM_ABOVE_HOT_US,
                float(np.median(above_hot)) * 1e6, "us"),
        at_most(f"warm above nothing, cold, {arm}", bars.WARM_ABOVE_COLD_US,
                float(np.median(above_cold)) * 1e6, "us"),
    ]  # fmt: skip


def _calls(
    solver: PressureSolver, target: Target, place: np.ndarray, p: np.ndarray
) -> dict[str, Callable[[], object]]:
    """What is timed, by name."""
    calls = solver._warm_calls
    assert calls is not None
    block, _, start, search, _ = calls._spare[0]
    block[calls.fast.targets], start[...] = place, p
    return {
        "nothing": calls.fast._library.cdll.stiffopt_setup_size,
        "machine code": search,
        "warm": lambda: solver.warm(place, p).pressures,
        "warm, found": lambda: solver.warm(place, p).found,
        "solve": lambda: solver.solve(target, guess=p),
        "reachable": lambda: solver.reachable(target),
    }


def _unreachable(out: Section, sizes: Settings, share: int) -> None:
    """Targets that the arm does not come to, with and without gravity and a load."""
    for words, segments, gravity, load in (
        ("free, 2 segments", 2, False, None),
        ("hanging, 1 segment", 1, True, None),
        ("hanging, 2 segments", 2, True, None),
        ("tip load, 2 segments", 2, False, Load(force=(0.005, 0, -0.02))),
    ):
        robot = _hanging(segments) if gravity else tasks.arm(segments)
        rng = np.random.default_rng([sizes.seed, segments])
        _, like = tasks.task_of("position", segments, sizes.seed, 0)
        solver = PressureSolver(robot, like.model_copy(update={"load": load}))
        solver.solve(_outside(rng, robot.length))
        times = []
        for _ in range(max(2, 20 // share)):
            target = _outside(rng, robot.length)
            calls = (partial(solver.solve, target), partial(solver.reachable, target))
            times.append([_hot(call, 3) for call in calls])
        solve, reachable = np.median(np.array(times), axis=0) * 1e6
        out.rows += [
            (words, "solve, unreachable", f"{solve:.0f}", ""),
            (words, "reachable, false", f"{reachable:.0f}", ""),
        ]
        out.data[f"{words}, unreachable"] = {"solve_us": solve, "reachable_us": reachable}
        if gravity or load:
            bar = at_most(f"unreachable, {words}", bars.UNREACHABLE_MS, solve / 1e3, "ms")
            out.verdicts.append(bar)


def _hanging(segments: int) -> Manipulator:
    """Arm under gravity, without a mass at the tip."""
    description = tasks.arm(segments).description
    return load_robot(description.model_copy(update={"gravity": (0.0, 0.0, 9.81)}))


def _outside(rng: np.random.Generator, length: float) -> Target:
    way = rng.normal(size=3)
    way[2] = abs(way[2])
    place = way / np.linalg.norm(way) * length * rng.uniform(1.15, 1.8)
    return Target(position=tuple(place.tolist()))


def _hot(call: Callable[[], object], repetitions: int) -> float:
    """Least seconds of CPU."""
    return min(_seconds(call) for _ in range(repetitions))


def _cold(call: Callable[[], object], repetitions: int) -> float:
    """Median seconds of CPU, each after much else was written."""
    other = np.zeros(COLD_BYTES, dtype=np.uint8)
    times = []
    for i in range(repetitions):
        other[:] = i
        times.append(_seconds(call))
    return float(np.median(times))


def _seconds(call: Callable[[], object]) -> float:
    begin = thread_time()
    call()
    return thread_time() - begin
