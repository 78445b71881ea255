"""Numbers of a robot file by name: read, changed as by hand in the file, varied symbolically."""

from __future__ import annotations

import math
import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

import stiffopt
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation
from stiffopt.model.laws import strain_laws
from stiffopt.model.parameters import Parameter, explicit, parametric, with_values
from stiffopt.model.robot_files import load_description

Vector = NDArray[np.float64]

FILE = """\
format: stiffopt-robot/1
name: two-of-a-kind
segments:
  - length: 90 mm
    outer_radius: 15 mm
    inner_radius: 4.5 mm
    chambers: {radius: 2.25 mm, offset: 10.1 mm, angles: ANGLES}
    channels: [[1, 2], [3, 4], [5, 6]]
    material: {youngs_modulus: 110 kPa, density: 1070 kg/m^3}
  - length: <length> m
    outer_radius: 15 mm
    inner_radius: 4.5 mm
    chambers: {radius: 2.25 mm, offset: 10.1 mm, angles: ANGLES}
    channels: [[1, 2], [3, 4], [5, 6]]
    material: {youngs_modulus: <material.youngs_modulus> Pa, density: 1070 kg/m^3}
    strain_law: LAW
    compensation:
      modulus_per_pressure: <compensation.modulus_per_pressure>
      area: <compensation.area>
      inertia: <compensation.inertia>
      stiffness: <compensation.stiffness>
      softening: <compensation.softening>
      bending_radius: <compensation.bending_radius> m
      lengthening: <compensation.lengthening>
    corrections:
      gain: [1.1, 0.9, <corrections.gain[2]>]
      offset: [<corrections.offset[0]> Pa, 0 Pa, -300 Pa]
      dead_band: <corrections.dead_band> Pa
      azimuth: [0 rad, <corrections.azimuth[1]> rad, 0.02 rad]
    history:
      dead_time: <history.dead_time> s
      lag: <history.lag> s
      lag_falling: <history.lag_falling> s
      memory: [1, <history.memory[1]>, 0.9]
      play: [{width: 4 kPa, share: 0.1}, {width: 20 kPa, share: <history.play[1].share>}]
      creep: [{time: 4 s, share: <history.creep[0].share>}]
pressure: {min: 0 bar, max: 1.2 bar}
"""
ANGLES = "[-30 deg, 30 deg, 90 deg, 150 deg, 210 deg, 270 deg]"
VALUES = {  # of segment 2; what it is changed to; its SI unit; whether it is varied by a factor
    "length": (0.08, 0.082, "m", True),
    "material.youngs_modulus": (95e3, 101e3, "Pa", True),
    "compensation.modulus_per_pressure": (-0.2, -0.15, "", False),
    "compensation.area": (1.2, 1.1, "", True),
    "compensation.inertia": (1.05, 0.97, "", True),
    "compensation.stiffness": (1.3, 1.4, "", True),
    "compensation.softening": (0.4, 0.25, "", False),
    "compensation.bending_radius": (0.05, 0.06, "m", True),
    "compensation.lengthening": (0.5, -0.25, "", False),
    "corrections.gain[2]": (1.02, 0.98, "", True),
    "corrections.offset[0]": (500.0, -700.0, "Pa", False),
    "corrections.dead_band": (8e3, 5e3, "Pa", True),
    "corrections.azimuth[1]": (0.05, -0.02, "rad", False),
    "history.dead_time": (0.05, 0.07, "s", False),
    "history.lag": (0.3, 0.2, "s", True),
    "history.lag_falling": (0.4, 0.5, "s", True),
    "history.memory[1]": (1.1, 1.3, "", True),
    "history.play[1].share": (0.15, 0.2, "", False),
    "history.creep[0].share": (0.05, 0.1, "", False),
}
LAWS = tuple(strain_laws())
PRESSURES = 1e5 * np.array([[0.2, 0.9, 0.4, 0.7, 0.3, 1.1], [0.0] * 6])


def full(key: str) -> str:
    return f"segments[1].{key}"


def robot_file(folder: Path, law: str = "paper", **changes: float) -> RobotDescription:
    """Robot of the file above with some values written into it by hand."""
    text = FILE.replace("ANGLES", ANGLES).replace("LAW", law)
    for key, (value, *_) in VALUES.items():
        text = text.replace(f"<{key}>", repr(changes.get(key, value)))
    path = folder / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    return load_description(path)


def test_every_kind_of_number_of_a_segment_is_tested_here() -> None:
    with pytest.raises(InputError) as told:
        assert Parameter("segments[0].outer_radius").number
    listed = str(told.value).partition("of a segment, ")[2].removesuffix(" can").split(", ")
    common = {key for key in listed if not key.startswith("law.")}
    assert common == {re.sub(r"\[\d+\]", "", key) for key in VALUES}


@pytest.mark.parametrize("key", VALUES)
def test_a_parameter_is_the_number_in_the_file(key: str, tmp_path: Path) -> None:
    before, after, unit, positive = VALUES[key]
    description = robot_file(tmp_path)
    parameter = Parameter(full(key))
    assert parameter.value(description) == before
    assert parameter.segment == 1
    assert parameter.number.unit == unit
    assert parameter.number.positive == positive
    assert parameter.is_history == key.startswith("history")
    by_hand = robot_file(tmp_path, **{key: after})
    changed = with_values(description, {parameter: after})
    assert parameter.value(changed) == after
    assert changed == explicit(by_hand)
    assert changed != explicit(description)


@pytest.mark.parametrize("key", VALUES)
def test_coordinates_are_differences_or_logarithms(key: str) -> None:
    before, after, _, positive = VALUES[key]
    parameter = Parameter(full(key))
    assert parameter.coordinate(before, before) == 0
    coordinate = parameter.coordinate(before, after)
    assert coordinate == pytest.approx(math.log(after / before) if positive else after - before)
    assert parameter.at(before, coordinate) == pytest.approx(after, rel=1e-14)
    step = 1e-6
    slope = (parameter.at(after, step) - parameter.at(after, -step)) / (2 * step)
    assert parameter.per_coordinate(after) == pytest.approx(slope, rel=1e-8)


@pytest.mark.parametrize("law", LAWS)
def test_several_values_at_once(law: str, tmp_path: Path) -> None:
    changes = {key: after for key, (_, after, *_) in VALUES.items()}
    description = robot_file(tmp_path, law)
    changed = with_values(description, {Parameter(full(k)): v for k, v in changes.items()})
    assert changed == explicit(robot_file(tmp_path, law, **changes))
    assert changed.segments[0] == explicit(description).segments[0]


def test_names_are_words() -> None:
    for key, name in {
        "segments[0].length": "rest length, segment 1",
        "segments[1].corrections.gain[2]": "gain, segment 2 channel 3",
        "segments[0].history.play[1].share": "share of play, segment 1 number 2",
        "segments[0].compensation.stiffness": "factor on the stiffness, segment 1",
    }.items():
        assert Parameter(key).name == name


@pytest.mark.parametrize("law", LAWS)
def test_defaults_written_out_change_nothing(law: str) -> None:
    mapping = load_description("stiff-flop-2").model_dump()
    for segment in mapping["segments"]:
        segment |= {"strain_law": law, "compensation": None}
    plain = RobotDescription(**mapping)
    spelled = explicit(plain)
    for segment in spelled.segments:
        assert segment.compensation is not None
        assert segment.corrections is not None
        assert segment.corrections.gain == (1.0,) * 3
        assert segment.history is not None
    assert explicit(spelled) == spelled
    poses = [stiffopt.load_robot(robot).tip_pose(PRESSURES) for robot in (plain, spelled)]
    assert poses[1] == pytest.approx(poses[0], abs=1e-15)
    # each of them can be given another value
    parameter = Parameter("segments[1].compensation.stiffness")
    assert parameter.value(with_values(plain, {parameter: 1.5})) == 1.5


# -- symbols --------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
def test_a_parametric_robot_is_the_robot_built_anew(law: str, tmp_path: Path) -> None:
    """Every parameter at once, far from where it was."""
    description = robot_file(tmp_path, law)
    changes = {Parameter(full(key)): after for key, (_, after, *_) in VALUES.items()}
    actuation, coordinates = parametric(description, list(changes))
    at = [p.coordinate(p.value(description), value) for p, value in changes.items()]
    varied = sections_of(actuation, coordinates)
    for q in PRESSURES:
        rebuilt = sections_of(Actuation.of(with_values(description, changes)))
        for s, ratio in enumerate((1.0, 0.082 / 0.08)):
            strain, compliance, margin = (part.full() for part in varied[s](q, at))
            expected, flexibility, room = (part.full() for part in rebuilt[s](q, []))
            assert strain == pytest.approx(ratio * expected, rel=1e-12, abs=1e-15)
            size = np.abs(flexibility).max()
            assert compliance == pytest.approx(ratio * flexibility, rel=1e-10, abs=1e-13 * size)
            assert margin == pytest.approx(room, rel=1e-12)


def sections_of(actuation: Actuation, coordinates: ca.SX | None = None) -> list[ca.Function]:
    """Strain, compliance and margin of each segment by pressures and coordinates."""
    inputs = [actuation.pressures, ca.SX(0, 1) if coordinates is None else coordinates]
    return [
        ca.Function(
            "section", inputs, [part.strain, ca.densify(part.compliance), actuation.margin[s]]
        )
        for s, part in enumerate(actuation.sections)
    ]


@pytest.mark.parametrize("key", VALUES)
def test_every_parameter_but_those_of_histories_matters(key: str, tmp_path: Path) -> None:
    description = robot_file(tmp_path)
    actuation, coordinates = parametric(description, [Parameter(full(key))])
    (_, second) = sections_of(actuation, coordinates)
    values = [part.full() for part in second(PRESSURES[0], 0.01)[:2]]
    nominal = [part.full() for part in second(PRESSURES[0], 0.0)[:2]]
    same = all(np.array_equal(*pair) for pair in zip(values, nominal, strict=True))
    assert same == key.startswith("history")


# -- mistakes -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "key",
    [
        "",
        "length",
        "segments",
        "segments[0]",
        "segment[0].length",
        "segments[0]length!",
        "tip.mass.x",
    ],
)
def test_what_is_no_key(key: str) -> None:
    with pytest.raises(InputError, match="is not the key of a parameter"):
        Parameter(key).value(load_description("stiff-flop-1"))


@pytest.mark.parametrize("key", ["segments[0].connector", "segments[0].chambers.radius"])
def test_what_is_no_parameter(key: str) -> None:
    with pytest.raises(InputError, match=r"cannot be a parameter; of a segment, length, .* can"):
        assert Parameter(key).number


@pytest.mark.parametrize(
    "key",
    [
        "segments[1].length",
        "segments[0].corrections.gain[3]",
        "segments[0].history.play[0].share",
        "segments[0].length[0]",
        "segments[0].corrections.gain",
    ],
)
def test_what_a_robot_does_not_have(key: str) -> None:
    with pytest.raises(InputError, match="has no parameter"):
        Parameter(key).value(load_description("stiff-flop-1"))


@pytest.mark.parametrize(
    "key", ["compensation.bending_radius", "corrections.dead_band", "history.lag"]
)
def test_what_is_zero_cannot_be_varied_by_a_factor(key: str) -> None:
    description = load_description("stiff-flop-1")
    parameter = Parameter(f"segments[0].{key}")
    assert parameter.value(description) == 0
    with pytest.raises(InputError, match=rf"{key} is 0; only from a positive value"):
        parametric(description, [parameter])
    with pytest.raises(InputError, match=rf"{key} is 0; only from a positive value"):
        parameter.coordinate(0.0, 1.0)
    with pytest.raises(InputError, match=rf"{key} is -1; only from a positive value"):
        parameter.coordinate(1.0, -1.0)


def test_values_are_checked_as_in_a_file() -> None:
    description = load_description("stiff-flop-1")
    for key, value, told in (
        ("corrections.gain[1]", 0.0, r"gain\W1\b"),
        ("compensation.softening", 1.1, "softening"),
        ("material.youngs_modulus", math.nan, "youngs_modulus"),
    ):
        with pytest.raises(InputError, match=told):
            with_values(description, {Parameter(f"segments[0].{key}"): value})
