"""Run all speed benchmarks, as `make bench` does.

    python benchmarks/run.py [--quick] [--seed N] [--only NAME ...] [--set NAME=NUMBER ...]
        [--keep] [--update]

Writes `results.md`, `results.json` and a plot to out/bench/; `--keep` also copies them to
benchmarks/results/, which is committed.  Exit code 1 if a count got worse (see `counts.py`);
missed bars are reported but are not failures, since times depend on the machine.
"""

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter

import counts
import environment
import plots
import report
from report import Section
from sections import (
    body,
    calls,
    full_task,
    kinds,
    kinematics,
    motions,
    paths,
    pose,
    processes,
    rates,
)
from settings import Settings, quick
from stiffopt.errors import MissingExtraError

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "out" / "bench"
KEPT = HERE / "results"


SECTIONS: dict[str, Callable[[Settings], Section]] = {
    "full": full_task.section,
    "calls": calls.section,
    "kinds": kinds.section,
    "without-compiler": processes.without_compiler,
    "build": processes.build,
    "command": processes.command,
    "throughput": rates.batch,
    "evaluations": kinematics.section,
    "body": body.section,
    "pose": pose.section,
    "paths": paths.section,
    "motions": motions.section,
    "simulator": rates.simulated_arm,
}


def run(sizes: Settings, only: list[str], out: Path, update: bool) -> bool:
    """Measure, write the report; whether no count got worse."""
    begin, before = perf_counter(), environment.load()
    done: dict[str, Section] = {}
    for name, measure in SECTIONS.items():
        if only and name not in only:
            continue
        started = perf_counter()
        print(f"{name} ...", end=" ", flush=True)
        try:
            done[name] = measure(sizes)
        except MissingExtraError as error:
            print(f"left out: {error}")
            continue
        print(f"{perf_counter() - started:.0f} s", flush=True)
    counted = counts.count()
    if "build" in done and not sizes.quick:
        counted["compiled code"] = _code(done["build"])
    differences = counts.compare(counted)
    if update:
        counts.update(counted)
    sections = list(done.values())
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
    if "full" in done:
        plots.draw(done["full"].data, out / "full_task.png")
    print(report.summary(sections, differences))
    print(f"{minutes:.1f} minutes; {out / 'results.md'}")
    return update or not any(difference.fails for difference in differences)


def keep(out: Path) -> None:
    """Copy the results to where they are committed."""
    KEPT.mkdir(exist_ok=True)
    for file in (*out.glob("*.png"), out / "results.md", out / "results.json"):
        shutil.copy(file, KEPT / file.name)


def _code(build: Section) -> dict[str, int]:
    found = {
        f"{segments} segments": int(record["waiting"]["code_bytes"])
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
    parser.add_argument("--only", nargs="+", default=[], choices=list(SECTIONS))
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--keep", action="store_true", help="copy to benchmarks/results/ too")
    parser.add_argument("--update", action="store_true", help="put the counts on record")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=NUMBER", help="other sizes")
    given = parser.parse_args()
    sizes = quick(given.seed) if given.quick else Settings(seed=given.seed)
    try:
        other = {name: int(size) for name, size in (each.split("=") for each in given.set)}
        sizes = replace(sizes, **other)
    except (TypeError, ValueError):
        parser.error("--set: expected names of `Settings` with whole numbers, NAME=NUMBER")
    fine = run(sizes, given.only, given.out, given.update)
    if given.keep:
        keep(given.out)
    return 0 if fine else 1


if __name__ == "__main__":
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")  # times and seeds are of compiled code
    sys.exit(main())
