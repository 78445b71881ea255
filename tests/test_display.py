"""Units in which answers are shown: their choice, and that a table and its figure follow it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import degrees
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt import plots
from stiffopt.cli.main import main
from stiffopt.display import DisplayUnits, choose_units, display_units
from stiffopt.errors import InputError

TASK = """\
format: stiffopt-task/1
robot: stiff-flop-1
target: {position: [-20 mm, 0 mm, free], tolerance: {position: 1 mm}}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""
OTHERS = "inch, psi, N/mm, rad"


@pytest.fixture(autouse=True)
def _usual_units_again() -> Iterator[None]:
    yield
    choose_units(None)


@pytest.fixture
def task(tmp_path: Path) -> str:
    file = tmp_path / "task.yaml"
    file.write_text(TASK)
    return str(file)


# -- units ----------------------------------------------------------------------------------------


def test_usual_units_convert_exactly() -> None:
    units = DisplayUnits.named()
    values = np.random.default_rng(0).uniform(-3, 3, 50)
    np.testing.assert_array_equal(units.length.of(values), values * 1e3)
    np.testing.assert_array_equal(units.pressure.of(values), values * 1e-5)
    np.testing.assert_array_equal(units.angle.of(values), np.degrees(values))
    assert units.angle.of(0.7) == degrees(0.7)
    assert [str(units.of_si(si)) for si in ("m", "N*m/rad", "bar^2", None)] == [
        "mm", "N m/rad", "bar^2", "",
    ]  # fmt: skip


def test_numbers_have_the_resolution_of_the_usual_unit() -> None:
    units = DisplayUnits.named("m, kPa, N/mm")
    assert units.length.text(0.1234567, ".3f") == "0.123457 m"
    assert units.pressure.text(123456.0, ".3f") == "123.5 kPa"
    assert units.stiffness.text(1.3, "#.4g") == "0.001300 N/mm"
    assert units.pressure.number(-0.0, ".2f") == "0"
    assert DisplayUnits.named("Pa").pressure.text(1.5e5, ".3g") == "150000 Pa"
    assert units.length.to_si(units.length.of(0.2)) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("mm, furlongs per week", "'furlongs per week' is no unit of length, pressure"),
        ("mm, inch", "'mm' and 'inch' are both units of length"),
        ("N*m", "no unit of"),  # a moment is not shown anywhere
        ("mm,", "'' is no unit"),
        ("kg", "no unit of length, pressure, force, stiffness, rotational stiffness or angle"),
    ],
)
def test_a_wrong_choice_is_explained(
    text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=said):
        choose_units(text)
    assert main(["robots", "--units", text]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --units: ")
    assert said in error


def test_the_environment_chooses_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STIFFOPT_UNITS", "cm")
    assert display_units().length.name == "cm"
    assert main(["robots"]) == 0
    assert "18 cm" in capsys.readouterr().out
    assert main(["robots", "--units", "kPa"]) == 0  # the option replaces it
    out = capsys.readouterr().out
    assert "180 mm" in out
    assert "150 kPa" in out
    monkeypatch.setenv("STIFFOPT_UNITS", "cm, mm")
    assert main(["robots"]) == 2
    assert "STIFFOPT_UNITS: 'cm' and 'mm' are both units of length" in capsys.readouterr().err


# -- answers --------------------------------------------------------------------------------------


def test_a_task_is_told_in_the_units_that_are_asked_for(
    task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answer.yaml"
    assert main(["solve", task, "--units", OTHERS, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "3.54331 inch" in text
    assert "tolerance 0.0393701 inch" in text
    assert "N/mm  (plain" in text
    assert "per inch of position tolerance" in text
    assert not any(f" {unit}" in text for unit in ("mm", "bar", "N/m "))
    assert " mm" in out.read_text()  # files stay as they are
    assert main(["solve", task, "--units", OTHERS, "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert main(["solve", task, "--json"]) == 0
    second = json.loads(capsys.readouterr().out)
    same = set(first) - {"solve_time_s", "sensitivities"}
    assert {"pressures_pa", "tip_position_m"} <= same
    assert {key: first[key] for key in same} == {key: second[key] for key in same}


def test_a_figure_has_the_units_of_its_table(task: str) -> None:
    choose_units(OTHERS)
    robot = stiffopt.load_robot("stiff-flop-1")
    solution = stiffopt.solve_pressure(robot, stiffopt.load_task(task))
    figure = plots.plot_solution(robot, solution)
    space, bars = figure.axes[:2]
    assert space.get_xlabel() == "x (inch)"
    assert bars.get_ylabel() == "pressure (psi)"
    highest = bars.get_ylim()[1]
    assert 21.7 < highest < 1.3 * 21.8  # 1.5 bar
    assert space.get_zlim()[1] < 6  # of an arm of 3.54 inch
    words = " ".join(each.get_text() for each in figure.findobj(lambda a: hasattr(a, "get_text")))
    assert "N/mm" in words
    assert not any(f" {unit}" in words for unit in ("mm", "bar", "N/m\n"))
    assert "inch" in repr(solution)


def test_messages_follow(task: str) -> None:
    choose_units("cm, psi")
    robot = stiffopt.load_robot("stiff-flop-1")
    far = stiffopt.Task(target={"position": (0.0, 0.0, 0.3)})
    answer = stiffopt.solve_pressure(robot, far)
    assert answer.status == "unreachable"
    assert " cm away" in answer.message
    assert "mm" not in answer.message
