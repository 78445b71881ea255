"""What notebooks show: a table and a figure, at once, and never an error."""

from __future__ import annotations

import re
import sys
from base64 import b64decode
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import stiffopt
from stiffopt import notebook
from stiffopt.model import compiled
from stiffopt.model import compiler as build
from stiffopt.optimise.solution import PressureSolution
from stiffopt.plots import pages

NAME = "<b>& a name"


def robot() -> stiffopt.Manipulator:
    return stiffopt.load_robot("stiff-flop-2")


def task(**changes: Any) -> stiffopt.Task:
    given: dict[str, Any] = {
        "robot": "stiff-flop-2",
        "target": {"position": (-0.03, 0.01, None)},
        "stiffness": {"maximise": {"direction": (1, 0, 0)}},
        "scene": {"objects": [{"name": NAME, "sphere": {"centre": (0.06, 0, 0), "radius": 0.01}}]},
    }
    return stiffopt.Task(**{**given, **changes})


def solution() -> PressureSolution:
    arm, p = robot(), np.full(6, 4e4)
    return PressureSolution(
        "solved", NAME, task(), p, arm.tip_pose(p), compliance=arm.tip_compliance(p),
        stiffnesses=(1.25,), errors={"position": 1e-4}, robot=arm,
    )  # fmt: skip


def path() -> stiffopt.Path:
    line = {"from": (-0.03, -0.02, 0.19), "to": (-0.03, 0.02, 0.19)}
    return stiffopt.Path(
        robot="stiff-flop-2", path={"line": line}, points=5, timing={"speed": 0.01}
    )


def path_solution() -> stiffopt.PathSolution:
    arm = robot()
    p = np.linspace(0, 5e4, 5)[:, None] * np.ones(6)
    return stiffopt.PathSolution(
        "solved", "", arm, np.arange(5.0), p, arm.tip_pose(p), stiffness=np.linspace(2, 3, 5),
        stiffness_unit="N/m",
    )  # fmt: skip


SHOWN: dict[str, tuple[Callable[[], Any], tuple[str, ...]]] = {
    "robot": (robot, ("stiff-flop-2", "90 mm, 90 mm", "0 to 1.5 bar")),
    "task": (task, ("(-30, 10, free) mm within 0.1 mm", "maximise", "&lt;b&gt;&amp; a name")),
    "solution": (solution, ("solved", "0.400, 0.400", "0.1 mm", "1.250 N/m", "&lt;b&gt;&amp;")),
    "path": (path, ("line of 40 mm, 5 points", "4 s")),
    "path_solution": (path_solution, ("5 in 4 s", "at least 2.000 N/m")),
}


@pytest.mark.parametrize("kind", SHOWN)
def test_a_figure_and_a_table(kind: str) -> None:
    make, words = SHOWN[kind]
    html = make()._repr_html_()
    for word in words:
        assert word in html
    assert NAME not in html
    (picture,) = re.findall(r"<img src='data:image/png;base64,([^']+)'/>", html)
    assert b64decode(picture).startswith(b"\x89PNG")
    assert len(html) < 200_000


@pytest.mark.parametrize("kind", SHOWN)
def test_without_matplotlib_the_table_alone(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    make, words = SHOWN[kind]
    html = make()._repr_html_()
    assert all(word in html for word in words)
    assert "<img" not in html


def test_it_never_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = task(robot="no-such-robot")._repr_html_()
    assert "<table>" in nowhere
    assert "<img" not in nowhere
    failed = PressureSolution("failed", "no <answer>", task())._repr_html_()
    assert "no &lt;answer&gt;" in failed
    assert "<img" not in failed
    empty = stiffopt.PathSolution("failed", "", robot(), *[np.empty(0)] * 3)
    assert "<img" not in empty._repr_html_()
    monkeypatch.setattr(notebook, "_PAGES", "stiffopt.no_such_module")
    assert robot()._repr_html_() == f"<pre>{robot()!r}</pre>"
    assert "&lt;answer" in PressureSolution("failed", "<answer", task())._repr_html_()

    class Broken(notebook.ShownInNotebook):
        def __repr__(self) -> str:
            raise ValueError

    assert Broken()._repr_html_() == "<pre>Broken</pre>"


def test_what_takes_long_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "_LONGEST", 1e-9)
    html = robot()._repr_html_()
    assert "90 mm, 90 mm" in html
    assert "<img" not in html


def test_nothing_is_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """Even where a compiler is there, and code is missing that is wanted."""
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("STIFFOPT_COMPILE", "wait")
    monkeypatch.setattr(build, "find_compiler", lambda: build.Compiler(("cc",), ("one",)))

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError

    for name in ("start_background", "compile_library"):
        monkeypatch.setattr(build, name, refuse)
    with compiled.compiling_nothing():
        assert compiled.library("some code", refuse) is None
    assert "<img" in solution()._repr_html_()
