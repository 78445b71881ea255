"""A strain law is one class: a new one is read from files, solved with and calibrated."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

import stiffopt
from conftest import is_long
from made_logs import course, made_log
from stiffopt import CalibrationSettings
from stiffopt.errors import FileError, InputError
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.structures import other_laws
from stiffopt.model import laws
from stiffopt.model.actuation import Section, StrainLaw
from stiffopt.model.calibration import FittedNumber
from stiffopt.model.laws import strain_laws
from stiffopt.model.laws.rest_length import RestLengthLaw
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.schema import Schema
from stiffopt.units import Angle

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
TURN = "segments[0].law.turn"
WHAT_TELLS = "the tip's orientation, with all channels at the same pressure"
ROBOT = """\
format: stiffopt-robot/1
name: wound
segments:
  - length: 90 mm
    outer_radius: 15 mm
    inner_radius: 4.5 mm
    chambers:
      radius: 2.25 mm
      offset: 10.1 mm
      angles: [-30 deg, 30 deg, 90 deg, 150 deg, 210 deg, 270 deg]
    channels: [[1, 2], [3, 4], [5, 6]]
    material: {youngs_modulus: 100 kPa}
    strain_law: wound
    law: {turn: 20 deg}
pressure: {min: 0 bar, max: 1.5 bar}
"""


class WoundKeys(Schema):
    turn: Annotated[Angle, FittedNumber("turn at 1 bar", "rad", 0.3, experiment=WHAT_TELLS)] = 0.0


@pytest.fixture
def wound() -> Iterator[type[StrainLaw]]:
    """Linear fibres that are wound like a screw, so that pressure turns the tip about its axis."""

    class WoundLaw(RestLengthLaw):
        name = "wound"
        words = "fibres wound like a screw"
        Keys = WoundKeys

        def section(self, p: ca.SX) -> Section:
            straight = super().section(p)
            twist = self.keys.turn * ca.sum1(p) / p.numel() / 1e5 / self.segment.length
            strain = ca.vertcat(straight.strain[:5], twist)
            return Section(strain, straight.compliance)

    yield WoundLaw
    del StrainLaw.registered["wound"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "wound.yaml"
    path.write_text(ROBOT, encoding="utf-8")
    return path


def test_the_laws_of_the_package() -> None:
    ours = ["paper", "rest-length", "neo-hookean"]
    assert [name for name in strain_laws() if name in ours] == ours
    assert all(law.words for law in strain_laws().values())


def test_a_new_law_is_read_from_a_robot_file(wound: type[StrainLaw], path: Path) -> None:
    robot = stiffopt.load_robot(path)
    tip = robot.tip_pose(np.full(3, 0.5e5))
    c, s = np.cos(np.radians(10)), np.sin(np.radians(10))
    assert tip[:3, :3] == pytest.approx(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), abs=1e-12)
    copy = path.with_name("copy.yaml")
    save_robot(copy, robot.description)
    assert load_description(copy) == robot.description
    assert Parameter(TURN).name == "turn at 1 bar, segment 1"
    assert Parameter(TURN).number.experiment == WHAT_TELLS
    changed = with_values(robot.description, {Parameter(TURN): 0.1})
    assert Parameter(TURN).value(changed) == 0.1


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "turn: 20 deg",
            "turns: 20 deg",
            r":14: segments\[0\].law.turns: unknown key; did .*'turn'",
        ),
        ("turn: 20 deg", "turn: 20", r":14: segments\[0\].law.turn: .*unit"),
        ("turn: 20 deg", "turn: 20 bar", r":14: segments\[0\].law.turn: "),
        ("{turn: 20 deg}", "20 deg", r":14: segments\[0\].law: expected a mapping"),
        ("law: wound", "law: paper", r":14: segments\[0\].law: the strain law 'paper' has no keys"),
        ("law: wound", "law: wind", r":13: .*'wind' is not one of 'paper', .*'wound'"),
    ],
)
def test_mistakes_in_the_keys_of_a_law(
    wound: type[StrainLaw], path: Path, old: str, new: str, told: str
) -> None:
    path.write_text(ROBOT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileError, match=told):
        load_description(path)


def test_keys_without_a_default_are_required(path: Path) -> None:
    class Needed(Schema):
        turn: Angle

    class NeedyLaw(RestLengthLaw):
        name = "wound"
        Keys = Needed

    try:
        assert stiffopt.load_robot(path).description.segments[0].law == Needed(turn=np.radians(20))
        path.write_text(ROBOT.replace("    law: {turn: 20 deg}\n", ""), encoding="utf-8")
        with pytest.raises(FileError, match=r"law: the strain law 'wound' needs the keys turn"):
            load_description(path)
    finally:
        del StrainLaw.registered[NeedyLaw.name]


def test_a_name_is_given_once(wound: type[StrainLaw]) -> None:
    with pytest.raises(TypeError, match="two strain laws of the name 'wound'"):
        type("Other", (RestLengthLaw,), {"name": "wound"})

    class OtherKeys(Schema):
        turn: Annotated[Angle, FittedNumber("turn", "rad", 0.1)] = 0.0

    with pytest.raises(TypeError, match=r"'wound' share law\.turn"):
        type("Other", (RestLengthLaw,), {"name": "other", "Keys": OtherKeys})


def test_the_law_of_the_documentation_is_one_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code of docs/extending.md as a file of the package: robots may name it."""
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    code = page.partition("## A strain law")[2].partition("```python\n")[2].partition("```")[0]
    (path.parent / "wound.py").write_text(code, encoding="utf-8")
    before = set(strain_laws())
    assert "wound" not in before
    monkeypatch.setattr(laws, "__path__", [*laws.__path__, str(path.parent)])
    laws._import_all.cache_clear()
    try:
        assert set(strain_laws()) == {*before, "wound"}
        pose = stiffopt.load_robot(path).tip_pose(np.full(3, 1e5))
        assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(np.radians(20))
    finally:
        StrainLaw.registered.pop("wound", None)
        sys.modules.pop("stiffopt.model.laws.wound", None)


@pytest.mark.parametrize("law", strain_laws())
def test_the_documentation_describes_every_law(law: str) -> None:
    for page in ("model.md", "files.md"):
        assert f"`{law}`" in (ROOT / "docs" / page).read_text(encoding="utf-8").replace(
            "strain_law: ", ""
        )


def test_solving_with_a_new_law(wound: type[StrainLaw], path: Path) -> None:
    """The tip's y axis is where the winding has turned it."""
    robot = stiffopt.load_robot(path)
    pressures = np.array([0.9e5, 0.4e5, 0.6e5])
    position = robot.tip_pose(pressures)[:3, 3].tolist()
    target = {"position": position, "tolerance": {"position": 1e-4}}
    task = stiffopt.Task(robot="wound", target=target)
    solution = stiffopt.solve_pressure(robot, task)
    assert solution.found
    assert solution.tip_pose == pytest.approx(robot.tip_pose(solution.pressures), abs=1e-12)
    assert solution.pressures == pytest.approx(pressures, abs=2e3)


def test_calibration_tries_a_new_law(wound: type[StrainLaw], path: Path) -> None:
    true = load_description(path)
    log = made_log(true, *course(3, 20.0, 3, highest=1.2e5), noise=1e-4, turns=True)
    segment = true.segments[0].model_copy(update={"strain_law": "rest-length", "law": None})
    other = true.model_copy(update={"segments": (segment,)})
    rows = {"rows": 60 if is_long() else 50, "trial_rows": 50}
    told = CalibrationSettings(structure="static", **rows)
    result = calibrate(other, [("a.csv", log)], settings=told)
    tried = {each.structure.strain_law for each in result.candidates}
    assert tried == {"", *strain_laws()} - {"rest-length"}
    assert result.robot.segments[0].strain_law == "wound"
    assert result.structure.words.endswith("fibres wound like a screw")
    assert Parameter(TURN).value(result.robot) == pytest.approx(np.radians(20), rel=0.1)
    (turn,) = (each for each in result.estimates if each.key == TURN)
    assert turn.low < np.radians(20) < turn.high
    assert result.robot.calibration is not None
    assert TURN in [each.key for each in result.robot.calibration.parameters]
    copy = path.with_name("calibrated.yaml")
    save_robot(copy, result.robot)
    assert load_description(copy) == result.robot


def test_what_a_law_cannot_describe_is_not_tried(wound: type[StrainLaw]) -> None:
    one = load_description("stiff-flop-1")
    material = one.segments[0].material.model_copy(update={"poisson_ratio": 0.4})
    segment = one.segments[0].model_copy(update={"material": material})
    compressible = one.model_copy(update={"segments": (segment,)})
    names = [law.name for law in other_laws(compressible)]
    assert {"rest-length", "wound"} <= set(names)
    assert "neo-hookean" not in names
    with pytest.raises(InputError, match="incompressible"):
        type(segment)(**segment.model_dump() | {"strain_law": "neo-hookean"})
