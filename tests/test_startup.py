"""What a start loads: import time is part of the product, and modules can be counted."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import stiffopt

ROOT = Path(__file__).resolve().parent.parent
TASK = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-20 mm, 5 mm, free], tolerance: {position: 0.5 mm}}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""
NUMERICS = {"casadi", "daqp", "numpy", "pydantic", "yaml"}
NEVER = {"matplotlib", "osqp", "pint", "pydantic.v1", "scipy"}
COMMAND = "from stiffopt.cli.main import solve_pressure_main; solve_pressure_main(sys.argv[1:])"


def loaded(code: str, *arguments: str) -> set[str]:
    """Return the modules that a new process has loaded after running some code."""
    script = f"import sys\n{code}\nprint('loaded', *sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
    )
    *_, last = (line for line in done.stdout.splitlines() if line.startswith("loaded "))
    return set(last.split())


@pytest.fixture
def task(tmp_path: Path) -> str:
    path = tmp_path / "task.yaml"
    path.write_text(TASK, encoding="utf-8")
    return str(path)


def test_a_bare_import_loads_nothing_else() -> None:
    assert not loaded("import stiffopt") & (NUMERICS | NEVER | {"rich", "typer"})


def test_the_library_loads_what_it_computes_with_and_no_more() -> None:
    modules = loaded(
        "import stiffopt; stiffopt.solve_pressure; stiffopt.load_robot('stiff-flop-2')"
    )
    assert modules >= NUMERICS
    assert not modules & (NEVER | {"rich", "typer"})


def test_an_error_class_needs_no_numerics() -> None:
    assert not loaded("from stiffopt import FileError, StiffoptError") & NUMERICS


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("--jason",)])
def test_what_needs_no_numbers_waits_for_none(arguments: tuple[str, ...]) -> None:
    assert not loaded(COMMAND, *arguments) & (NUMERICS | NEVER)


def test_no_help_waits_for_numbers_nor_cuts_a_description_off() -> None:
    code = """
import typer
from stiffopt.cli.main import app, main

def show(command, words):
    main([*words, '--help'])
    for name, each in getattr(command, 'commands', {}).items():
        show(each, [*words, name])

show(typer.main.get_command(app), [])
"""
    script = f"import sys\n{code}\nprint('loaded', *sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout
    assert said.count("Usage:") > 30
    lines = [line for line in said.splitlines() if "Usage:" not in line]
    assert not [line for line in lines if line.endswith("...")]
    heavy = (NUMERICS | NEVER) - {"pydantic", "pydantic.v1"}  # typer itself asks for it
    assert not set(lines[-1].split()) & heavy


def test_json_needs_neither_tables_nor_the_registry_of_units(task: str) -> None:
    modules = loaded(COMMAND, "--json", task)
    assert modules >= NUMERICS
    assert not modules & (NEVER | {"rich"})


def test_a_table_needs_no_progress_bar_where_there_is_no_terminal(task: str) -> None:
    modules = loaded(COMMAND, task)
    assert "rich.table" in modules
    assert not modules & (NEVER | {"rich.progress"})


def test_every_robot_and_problem_is_read_without_the_registry_of_units() -> None:
    code = (
        "import stiffopt\n"
        "from stiffopt.model.robot_files import load_description\n"
        "for name in stiffopt.builtin_robots(): load_description(name)\n"
        "for path in sys.argv[1:]: stiffopt.load_task(path).resolve_robot()\n"
    )
    paths = [str(path) for path in sorted((ROOT / "problems").glob("*.yaml"))]
    assert paths
    assert "pint" not in loaded(code, *paths)


# -- names that are imported when they are asked for ----------------------------------------------


def test_every_public_name_is_there() -> None:
    for name in stiffopt.__all__:
        assert getattr(stiffopt, name) is not None
        assert name in dir(stiffopt)
    assert not hasattr(stiffopt, "no_such_name")


def test_names_are_imported_from_where_the_stub_has_them() -> None:
    tree = ast.parse((ROOT / "src/stiffopt/__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    in_stub = {alias.name: node.module for node in imports for alias in node.names}
    assert len(in_stub) > 70
    assert in_stub == stiffopt._MODULE_OF
    assert set(in_stub) | {"__version__"} == set(stiffopt.__all__)
    for name, module in in_stub.items():  # and no name of the package itself hides one of them
        assert getattr(stiffopt, name) is getattr(importlib.import_module(str(module)), name)


def test_modules_need_no_import_of_their_own() -> None:
    code = "import stiffopt; stiffopt.units.parse_quantity; stiffopt.lie.exp; stiffopt.model"
    assert "stiffopt.units" in loaded(code)
