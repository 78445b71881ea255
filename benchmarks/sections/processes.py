"""Measure in separate processes: first solutions, no compiler, the command line.

python -m sections.processes first|full SEGMENTS SETTINGS   # one of these processes
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from time import perf_counter

import numpy as np

import settings as bars
import tasks
from peers.ipopt import Ipopt
from peers.own import Stiffopt
from report import Section, at_most, milliseconds, times
from sections.full_task import measure
from settings import Settings
from stiffopt import solve_pressure
from timing import interleaved, median

HERE = Path(__file__).resolve().parent.parent
TASK = HERE.parent / "problems" / "two_segment_stiff_x.yaml"
IMPORTS = "import casadi, numpy, pint, pydantic, rich, typer"

BUILD_TEXT = """\
The first `solve_pressure` of a process, with a filled cache of compiled code; with an empty one,
while the code is made in the background; without a compiler; and where it waits for the compiler
(`STIFFOPT_COMPILE=wait`). *Ratio*: the first answer with an empty cache over that without a
compiler."""
COMPILER_TEXT = """\
The full task, cold and warm as above, in a process that is told to use no C compiler
(`STIFFOPT_COMPILER=none`), beside IPOPT in the same process."""
COMMAND_TEXT = """\
Wall time of `solve-pressure` on one two-segment task file, from the start of the process to its
end, compiled code cached ("second run"), interleaved with a Python process that does nothing,
and one that only imports the libraries which the command needs. *Ratio*: over the one that
imports."""


def build(sizes: Settings) -> Section:
    """The table of first solutions."""
    out = Section(
        "First solution",
        BUILD_TEXT,
        (
            "segments",
            "cache filled, s",
            "cache empty, s",
            "no compiler, s",
            "ratio",
            "waiting, s",
            "later, ms",
            "code, kB",
        ),
    )
    for segments in (2,) if sizes.quick else sizes.segments:
        with tempfile.TemporaryDirectory() as cache:
            first = _worker("first", segments, sizes, STIFFOPT_CACHE_DIR=cache)
            second = _worker("first", segments, sizes, STIFFOPT_CACHE_DIR=cache)
        empty = _first_answers(segments, sizes, STIFFOPT_COMPILE="background")
        without = _first_answers(segments, sizes, STIFFOPT_COMPILER="none")
        relative = empty / without
        out.rows.append(
            (
                str(segments), f"{second['first_s']:.2f}", f"{empty:.2f}", f"{without:.2f}",
                times(relative), f"{first['first_s']:.2f}", milliseconds(first["later_s"]),
                f"{first['code_bytes'] / 1e3:.0f}",
            )
        )  # fmt: skip
        out.data[str(segments)] = {
            "waiting": first, "filled": second, "empty_s": empty, "no_compiler_s": without
        }  # fmt: skip
        arms = f"first answer, {tasks.arm_words(segments)}"
        out.verdicts.append(
            at_most(f"{arms}, empty cache over no compiler", bars.FIRST_ANSWER, relative, "times")
        )
        if segments == 3:
            took = first["first_s"] - first["later_s"]
            out.verdicts.append(
                at_most("building, 3 segments, empty cache", bars.COMPILE_SECONDS, took, "s")
            )
    return out


def _first_answers(segments: int, sizes: Settings, **environment: str) -> float:
    """Median time of the first answer in a process with an empty cache."""
    seconds = []
    for _ in range(3):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
            found = _worker("first", segments, sizes, STIFFOPT_CACHE_DIR=cache, **environment)
            seconds.append(found["first_s"])
    return float(np.median(seconds))


def without_compiler(sizes: Settings) -> Section:
    """The table of times in the CasADi virtual machine."""
    out = Section(
        "Without a C compiler",
        COMPILER_TEXT,
        ("segments", "cold, ms", "IPOPT's time over it", "warm, ms", "IPOPT's time over it"),
    )
    for segments in sizes.few_segments:
        with tempfile.TemporaryDirectory() as cache:
            found = _worker(
                "full", segments, sizes, STIFFOPT_COMPILER="none", STIFFOPT_CACHE_DIR=cache
            )
        own, ipopt = found["stiffopt"], found["CasADi + IPOPT"]
        out.rows.append(
            (
                str(segments), milliseconds(own["cold_s"]), times(ipopt["ratio_cold"]),
                milliseconds(own["warm_s"]), times(ipopt["ratio_warm"]),
            )
        )  # fmt: skip
        arm = f"no compiler, {tasks.arm_words(segments)}"
        cold, warm = bars.VM_COLD_MS[segments], bars.VM_WARM_MS[segments]
        out.verdicts += [
            at_most(f"cold, {arm}", cold, own["cold_s"] * 1e3, "ms"),
            at_most(f"warm, {arm}", warm, own["warm_s"] * 1e3, "ms"),
        ]
        out.data[str(segments)] = found
    return out


def command(sizes: Settings) -> Section:
    """The table of the command line."""
    out = Section("Command line", COMMAND_TEXT, ("process", "wall time, s", "ratio"))
    with tempfile.TemporaryDirectory() as cache:
        environment = _environment(STIFFOPT_CACHE_DIR=cache)
        solve = [str(Path(sys.executable).parent / "solve-pressure"), str(TASK)]
        if not Path(solve[0]).exists():
            out.skipped["solve-pressure"] = "the command is not installed beside this Python"
            return out
        begin = perf_counter()
        _run(solve, environment)
        first = perf_counter() - begin
        calls = {
            "python -c pass": lambda _: _run([sys.executable, "-c", "pass"], environment),
            "imports": lambda _: _run([sys.executable, "-c", IMPORTS], environment),
            "solve-pressure": lambda _: _run(solve, environment),
        }
        taken = interleaved(calls, 1, sizes.repetitions * (1 if sizes.quick else 2))
    base = median(taken["imports"])
    labels = {"imports": f'python -c "{IMPORTS}"'}
    out.rows.append(("`solve-pressure`, first run", f"{first:.2f}", times(first / base)))
    for name, of_name in taken.items():
        seconds = median(of_name)
        out.rows.append((f"`{labels.get(name, name)}`", f"{seconds:.2f}", times(seconds / base)))
        out.data[name] = seconds
    wall = median(taken["solve-pressure"])
    out.verdicts.append(at_most("solve-pressure, second run", bars.COMMAND_SECONDS, wall, "s"))
    return out


# -- processes ----------------------------------------------------------------------------------


def _environment(**changes: str) -> dict[str, str]:
    return {**os.environ, "STIFFOPT_COMPILE": "wait", **changes}


def _run(command: list[str], environment: dict[str, str]) -> str:
    done = subprocess.run(
        command, env=environment, cwd=HERE, capture_output=True, text=True, check=True
    )
    return done.stdout


def _worker(what: str, segments: int, sizes: Settings, **environment: str) -> dict[str, dict]:
    """What `main` measures in a process of its own."""
    command = [sys.executable, "-m", "sections.processes", what, str(segments)]
    command.append(json.dumps(asdict(sizes)))
    lines = _run(command, _environment(**environment)).splitlines()
    return dict(json.loads(lines[-1]))


# -- in a process of its own ----------------------------------------------------------------------


def first(segments: int, sizes: Settings) -> dict[str, float]:
    """Time of the first solution in this process, of later ones, and size of the code it left."""
    robot = tasks.arm(segments)
    cases = [tasks.task_of("position", segments, sizes.seed, i)[1] for i in range(6)]
    seconds = []
    for task in cases:
        begin = perf_counter()
        solve_pressure(robot, task)
        seconds.append(perf_counter() - begin)
    cache = Path(os.environ["STIFFOPT_CACHE_DIR"])
    code = sum(file.stat().st_size for file in cache.rglob("*.so"))
    return {"first_s": seconds[0], "later_s": float(np.median(seconds[1:])), "code_bytes": code}


def full(segments: int, sizes: Settings) -> dict[str, dict[str, float]]:
    """The full task on fewer tasks, beside IPOPT."""
    few = {"tasks": max(2, sizes.tasks // 4), "warm_tasks": max(2, sizes.warm_tasks // 4)}
    small = Settings(**{**vars(sizes), **few, "reference_starts": 0})
    return measure([Stiffopt, Ipopt], segments, small).record()


def main() -> None:
    """Print one measurement as JSON in the last line: WORK SEGMENTS SETTINGS."""
    work, segments, given = sys.argv[1:]
    fields = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(given).items()}
    answer = {"first": first, "full": full}[work](int(segments), Settings(**fields))
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
