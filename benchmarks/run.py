"""All speed benchmarks, as `make bench` runs them.

    python benchmarks/run.py [--quick] [--seed N] [--only NAME ...] [--keep] [--update]

`calibration` takes many minutes and is about errors, not speed; it runs only where it is named.

Writes `results.md`, `results.json` and the plots to out/bench/; `--keep` copies them to
benchmarks/results/ too, which is committed.  Exit code 1 if a count got worse (see `counts.py`);
missed bars are told and do not fail, since times are of the machine.
"""

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import perf_counter

import calibration
import counts
import environment
import plots
import report
from report import Section
from sections import (
    full_task,
    kinds,
    kinematics,
    pose,
    processes,
    rates,
    statics,
)
from settings import Settings, quick

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "out" / "bench"
KEPT = HERE / "results"
ASKED_FOR = ("calibration",)  # sections that run only where they are named


def plan(sizes: Settings, done: dict[str, Section]) -> dict[str, Callable[[], Section]]:
    """The sections by name, in their order."""

    def growth_with_segments() -> Section:
        if "full" not in done:
            done["full"] = full_task.section(sizes)
        return full_task.with_segments(sizes, done["full"])

    return {
        "full": lambda: full_task.section(sizes),
        "kinds": lambda: kinds.section(sizes),
        "without-compiler": lambda: processes.without_compiler(sizes),
        "build": lambda: processes.build(sizes),
        "command": lambda: processes.command(sizes),
        "throughput": lambda: rates.batch(sizes),
        "evaluations": lambda: kinematics.section(sizes),
        "pose": lambda: pose.section(sizes),
        "statics": lambda: statics.section(sizes),
        "simulator": lambda: rates.simulated_arm(sizes),
        "calibration": lambda: calibration.section(sizes),
        "segments": growth_with_segments,
        "starts": lambda: full_task.with_starts(sizes),
    }


def run(sizes: Settings, only: list[str], out: Path, update: bool) -> bool:
    """Measure, write the report; whether no count got worse."""
    begin, before = perf_counter(), environment.load()
    done: dict[str, Section] = {}
    for name, measure in plan(sizes, done).items():
        if name not in only if only else name in ASKED_FOR:
            continue
        started = perf_counter()
        print(f"{name} ...", end=" ", flush=True)
        done[name] = measure()
        print(f"{perf_counter() - started:.0f} s", flush=True)
    counted = counts.count()
    if "build" in done and not sizes.quick:
        counted["compiled code"] = _code(done["build"])
    differences = counts.compare(counted)
    if update:
        counts.update(counted)
    sections = [done[name] for name in plan(sizes, done) if name in done]
    loads = (before, environment.load())
    about = environment.environment()
    minutes = (perf_counter() - begin) / 60
    out.mkdir(parents=True, exist_ok=True)
    text = report.markdown(sections, differences, about, loads, sizes.seed, sizes.quick, minutes)
    (out / "results.md").write_text(text, encoding="utf-8")
    data = {
        "settings": asdict(sizes),
        "environment": about,
        "load": loads,
        "verdicts": [asdict(verdict) for section in sections for verdict in section.verdicts],
        "comparisons": [asdict(each) for section in sections for each in section.comparisons],
        "sections": {section.title: section.data for section in sections},
        "counts": counted,
    }
    (out / "results.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    made = plots.draw(data["sections"], out)
    print(report.summary(sections, differences))
    print(f"{minutes:.1f} minutes; {out / 'results.md'} and {len(made)} plots")
    return update or not any(difference.fails for difference in differences)


def keep(out: Path) -> None:
    """Copy the results to where they are committed."""
    KEPT.mkdir(exist_ok=True)
    for file in (*out.glob("*.png"), out / "results.md", out / "results.json"):
        shutil.copy(file, KEPT / file.name)


def _code(build: Section) -> dict[str, int]:
    found = {
        f"{segments} segments": int(record["empty"]["code_bytes"])
        for segments, record in build.data.items()
    }
    return {name: size for name, size in found.items() if size}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1, help="of the random tasks")
    parser.add_argument("--quick", action="store_true", help="under a minute; proves nothing")
    parser.add_argument("--only", nargs="+", default=[], choices=list(plan(Settings(), {})))
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--keep", action="store_true", help="copy to benchmarks/results/ too")
    parser.add_argument("--update", action="store_true", help="put the counts on record")
    given = parser.parse_args()
    sizes = quick(given.seed) if given.quick else Settings(seed=given.seed)
    fine = run(sizes, given.only, given.out, given.update)
    if given.keep:
        keep(given.out)
    return 0 if fine else 1


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    sys.exit(main())
