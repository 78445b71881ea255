"""Change the code between a command and the arm, mutant by mutant, and see whether a test objects.

``python tests/mutation.py`` lets mutmut make and try all mutants of the files of ``[tool.mutmut]``
in pyproject.toml, in a copy of this checkout, or of those files alone that are named (``gate``);
``--short`` a part of those of gate and goals, with their own tests. It prints what became of them
by file, and those that nobody noticed.

A mutant that no test notices must be in ``mutation_survivors.txt``, with the reason why that is no
defect; else the exit code is 1. Not counted are mutants of nothing but the text of a message: of a
string with a space in it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REVIEWED = Path(__file__).with_name("mutation_survivors.txt")
PACKAGE = "stiffopt.safety"
SHORT = {
    "gate": ["tests/test_safety.py"],
    "goal": ["tests/test_goal.py", "tests/test_goal_checks.py", "tests/test_goal_supply.py"],
}
SAMPLE = [
    *(f"{PACKAGE}.gate.xǁSafetyGateǁ{name}__mutmut_*" for name in ("apply", "vent", "expire")),
    *(f"{PACKAGE}.goal.xǁGoalFollowerǁ{name}__mutmut_*" for name in ("tick", "fail")),
    *(f"{PACKAGE}.{name}.*__mutmut_*5" for name in SHORT),
]
"""Of the short form: all mutants of what decides most, and those of the rest that end with a 5."""
GUARD = [f"{PACKAGE}.guard.{name}" for name in ("xǁ*", "x__sentence__*", "x__on_monotonic__*")]
"""What is tried of guard.py: how its process begins and ends needs processes, which mutants do not
reach; and a mutant there that catches all signals cannot be ended by mutmut."""

Change = tuple[str, str, str]  # in which function, and what from and to


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, add_help=True)
    parser.add_argument("files", nargs="*", help="modules of stiffopt.safety; by default all")
    parser.add_argument("--short", action="store_true", help="a part of gate and goals")
    parser.add_argument("--all-changes", action="store_true", help="print all that nobody noticed")
    options = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as made:
        folder = Path(made)
        copy(folder, options.files, short=options.short)
        outcomes = run(folder, SAMPLE if options.short else patterns(folder))
        if not outcomes:
            print("no mutant was tried: see above")
            return 1
        unnoticed = dict(changes(folder, outcomes))
    reviewed = read_reviewed()
    bad = [change for change in unnoticed.values() if change and change not in reviewed]
    tell(outcomes, unnoticed, reviewed)
    for change in bad if not options.all_changes else filter(None, unnoticed.values()):
        print("\n".join(("", change[0], *lines("-", change[1]), *lines("+", change[2]))))
    print(f"\n{len(outcomes)} mutants in {time.monotonic() - began:.0f} s")
    if bad:
        print(f"{len(bad)} mutants were not noticed by any test, and are not in {REVIEWED.name}")
    return 1 if bad else 0


def copy(folder: Path, files: list[str], *, short: bool) -> None:
    """Copy what mutants need, with the settings of this run."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    settings = tomllib.loads(text)["tool"]["mutmut"]
    if files or short:
        names = files or list(SHORT)
        settings["only_mutate"] = [f"src/stiffopt/safety/{name}.py" for name in names]
    if short:
        settings["pytest_add_cli_args_test_selection"] = [
            test for tests in SHORT.values() for test in tests
        ]
    for name in ("src", "tests", *settings["also_copy"]):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.pyc")
        )
    rest = re.sub(r"(?ms)^\[tool\.mutmut\].*?(?=^\[)", "", text)
    ours = "".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items())
    (folder / "pyproject.toml").write_text(f"{rest}\n[tool.mutmut]\n{ours}", encoding="utf-8")


def run(folder: Path, names: list[str]) -> dict[str, str]:
    """Try the mutants of these names and return what became of each."""
    begin = [sys.executable, "-m", "mutmut"]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "COLUMNS": "200"}
    environment["STIFFOPT_LONG"] = "1"  # all cases of a test, also where one in some is usual
    environment.pop("PYTHONPATH", None)
    children = ["--max-children", str(os.cpu_count() or 1)]
    how = {"cwd": folder, "env": environment, "text": True}
    done = subprocess.run([*begin, "run", *children, *names], capture_output=True, **how)  # type: ignore[call-overload]
    said = re.split(r"[\r\n]", done.stdout + done.stderr)
    if done.returncode:
        print("\n".join(said[-60:]))
        return {}
    told = subprocess.run(  # type: ignore[call-overload]
        [*begin, "results", "--all", "true"], capture_output=True, check=True, **how
    )
    pairs = (line.strip().rsplit(": ", 1) for line in told.stdout.splitlines() if ": " in line)
    return {name: what for name, what in pairs if what != "not checked"}


def patterns(folder: Path) -> list[str]:
    """Return the names of what is tried in the long form."""
    text = (folder / "pyproject.toml").read_text(encoding="utf-8")
    files = [Path(file).stem for file in tomllib.loads(text)["tool"]["mutmut"]["only_mutate"]]
    names = [f"{PACKAGE}.{name}.*" for name in files if name != "guard"]
    return names + GUARD * ("guard" in files)


def changes(folder: Path, outcomes: dict[str, str]) -> Iterator[tuple[str, Change | None]]:
    """Return what was changed in each mutant that nobody noticed; None: a message."""
    os.chdir(folder)
    from mutmut.mutation.diff_apply import get_diff_for_mutant

    for name, what in outcomes.items():
        if what in ("killed", "timeout", "suspicious", "segfault"):
            continue
        module = name[: name.index(".x", len(PACKAGE))]
        path = f"src/{module.replace('.', '/')}.py"
        diff = get_diff_for_mutant(name, path=path).splitlines()[2:]
        before = [line[1:].strip() for line in diff if line.startswith("-")]
        after = [line[1:].strip() for line in diff if line.startswith("+")]
        function = re.sub(r"__mutmut_\d+$", "", name)
        function = function.replace(".xǁ", ".").replace(".x_", ".").replace("ǁ", ".")
        change = (function, "\n".join(before), "\n".join(after))
        yield name, None if is_message(*change[1:]) else change
    os.chdir(ROOT)


def is_message(before: str, after: str) -> bool:
    """Say whether two pieces of code differ in sentences alone."""
    return before != after and without_sentences(before) == without_sentences(after)


def without_sentences(code: str) -> str:
    def shorten(found: re.Match[str]) -> str:
        return '""' if " " in found[0] else found[0]

    return re.sub(r'f?"(?:[^"\\]|\\.)*"', shorten, code)


def read_reviewed() -> set[Change]:
    """Return the mutants that are no defects: blocks of function, ``-``, ``+`` and the reason."""
    found: set[Change] = set()
    for block in re.split(r"\n\s*\n", REVIEWED.read_text(encoding="utf-8")):
        rows = [row for row in block.splitlines() if row and not row.startswith("#")]
        if rows:
            assert rows[-1].startswith("= "), f"a reason is missing: {block}"
            parts: dict[str, list[str]] = defaultdict(list)
            for row in rows[1:-1]:
                parts[row[0]].append(row[1:].strip())
            found.add((rows[0].strip(), "\n".join(parts["-"]), "\n".join(parts["+"])))
    return found


def tell(
    outcomes: dict[str, str], unnoticed: dict[str, Change | None], reviewed: set[Change]
) -> None:
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for name, what in outcomes.items():
        row = table[name.removeprefix(PACKAGE + ".").split(".")[0]]
        row["mutants"] += 1
        if name not in unnoticed:
            row["killed"] += 1
            row["timeout"] += what == "timeout"
        elif unnoticed[name] is None:
            row["messages"] += 1
        else:
            row["reviewed" if unnoticed[name] in reviewed else "not noticed"] += 1
    heads = ("mutants", "killed", "timeout", "messages", "reviewed", "not noticed")
    print(f"{'':12}" + "".join(f"{head:>13}" for head in heads))
    for file, row in table.items():
        print(f"{file:12}" + "".join(f"{row[head]:13}" for head in heads))


def lines(sign: str, code: str) -> list[str]:
    return [f"{sign} {line}" for line in code.splitlines()]


if __name__ == "__main__":
    sys.exit(main())
