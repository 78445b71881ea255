"""The robot file and the description in code."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from stiffopt.errors import FileError, InputError
from stiffopt.files import save_file
from stiffopt.model.description import RegulatorLimits, RobotDescription
from stiffopt.model.robot_files import builtin_robots, load_description
from stiffopt.model.segment import Chambers, Compensation, Material, Segment

ROBOT = """\
format: stiffopt-robot/1
name: test-arm
segments:
  - length: 90 mm
    outer_radius: 15 mm
    inner_radius: 4.5 mm
    chambers:
      radius: 2.25 mm
      offset: 10.1 mm
      angles: [-30 deg, 30 deg, 90 deg, 150 deg, 210 deg, 270 deg]
    channels: [[1, 2], [3, 4], [5, 6]]
    material: {youngs_modulus: 100 kPa, poisson_ratio: 0.5, density: 1070 kg/m^3}
    compensation: {modulus_per_pressure: -0.2, area: 1.2, inertia: 1.05}
    connector: 5 mm
tip_mass: 20 g
gravity: [0 m/s^2, 0 m/s^2, 9.81 m/s^2]
pressure: {min: 0 bar, max: 1.5 bar, slew: 5 bar/s}
"""


def segment(**changes: Any) -> Segment:
    """Return the paper's segment with changes."""
    data: dict[str, Any] = {
        "length": 0.09,
        "outer_radius": 0.015,
        "inner_radius": 0.0045,
        "chambers": {
            "radius": 0.00225,
            "offset": 0.0101,
            "angles": np.radians(range(-30, 330, 60)),
        },
        "channels": [[1, 2], [3, 4], [5, 6]],
        "material": Material(youngs_modulus=1e5),
        **changes,
    }
    return Segment(**data)


def robot(**changes: Any) -> RobotDescription:
    data: dict[str, Any] = {
        "name": "arm",
        "segments": [segment(), segment()],
        "pressure": RegulatorLimits(min=0, max=1.5e5),
        **changes,
    }
    return RobotDescription(**data)


def read(folder: Path, text: str) -> RobotDescription:
    path = folder / "arm.yaml"
    path.write_text(text, encoding="utf-8")
    return load_description(path)


PAPERS = ("stiff-flop-1", "stiff-flop-2", "stiff-flop-2-hanging", "stiff-flop-3")


@pytest.mark.parametrize("name", PAPERS)
def test_built_in_robots_are_the_papers(name: str) -> None:
    arm = load_description(name)
    n = int(name.split("-")[2])
    assert (arm.name, arm.n_segments, arm.n_pressures) == (name, n, 3 * n)
    assert arm.length == pytest.approx(0.09 * n, abs=1e-15)
    assert arm.pressure_min == (0.0,) * 3 * n
    assert arm.pressure_max == (1.5e5,) * 3 * n
    assert arm.pressure_slew == (5e5,) * 3 * n
    for part in arm.segments:
        assert (part.length, part.outer_radius, part.inner_radius) == (0.09, 0.015, 0.0045)
        assert (part.chambers.radius, part.chambers.offset) == (0.00225, 0.0101)
        assert part.chambers.angles == pytest.approx(np.radians([-30, 30, 90, 150, 210, 270]))
        assert part.channels == ((1, 2), (3, 4), (5, 6))
        assert part.material == Material(youngs_modulus=1e5, density=1070)
        assert part.compensation == Compensation(modulus_per_pressure=-0.2, area=1.2, inertia=1.05)
        assert (part.connector, part.strain_law) == (0.0, "paper")
    hanging = name.endswith("hanging")
    assert arm.gravity == ((0, 0, 9.81) if hanging else (0, 0, 0))
    assert arm.tip_mass == (0.02 if hanging else 0)


def test_there_are_the_papers_robots_and_those_of_recorded_arms() -> None:
    modules = ("ucl-55", "ucl-2x55")
    others = ("stiff-flop-1-calibrated", "ucl-stiff-flop", "asu-two-segment", *modules)
    others += tuple(f"{name}-calibrated" for name in modules)
    assert builtin_robots() == tuple(sorted((*PAPERS, *others)))


def test_a_robot_file_is_read_in_si(tmp_path: Path) -> None:
    arm = read(tmp_path, ROBOT)
    assert arm == RobotDescription(
        name="test-arm",
        segments=[
            segment(
                chambers={
                    "radius": "2.25 mm",
                    "offset": "10.1 mm",
                    "angles": [f"{angle} deg" for angle in range(-30, 330, 60)],
                },
                material=Material(youngs_modulus=1e5, density=1070),
                compensation={"modulus_per_pressure": -0.2, "area": 1.2, "inertia": 1.05},
                connector=0.005,
            )
        ],
        tip_mass=0.02,
        gravity=[0, 0, 9.81],
        pressure={"min": 0, "max": 1.5e5, "slew": 5e5},
    )
    assert arm.length == pytest.approx(0.095)
    assert isinstance(hash(arm), int)


def test_what_is_optional_may_be_left_out(tmp_path: Path) -> None:
    data = yaml.safe_load(ROBOT)
    for key in ("tip_mass", "gravity"):
        del data[key]
    for key in ("inner_radius", "compensation", "connector"):
        del data["segments"][0][key]
    del data["segments"][0]["material"]["density"]
    del data["pressure"]["slew"]
    arm = read(tmp_path, yaml.safe_dump(data))
    assert arm.pressure_slew is None
    assert arm.gravity == (0, 0, 0)
    assert arm.segments[0].compensation is None
    assert Compensation() == Compensation(modulus_per_pressure=0, area=1, inertia=1)


MISTAKES = [
    ("length: 90 mm", "length: 90", 4, "segments[0].length: bare number 90 has no unit"),
    (
        "length: 90 mm",
        "lenght: 90 mm",
        4,
        "the key 'length' is missing; also line 4: segments[0].l",
    ),
    ("length: 90 mm", "length: 0 mm", 4, "segments[0].length: must be greater than 0, not '0 mm'"),
    ("outer_radius: 15 mm", "outer_radius: 15 g", 5, "'g' is not a unit of length"),
    ("inner_radius: 4.5 mm", "inner_radius: -1 mm", 6, "must be at least 0, not '-1 mm'"),
    ("inner_radius: 4.5 mm", "inner_radius: 15 mm", 6, "must be less than the outer radius of 15"),
    ("inner_radius: 4.5 mm", "inner_radius: 8 mm", 9, "break through the inner wall at 8 mm"),
    ("offset: 10.1 mm", "offset: 13 mm", 9, "break through the outer wall at 15 mm"),
    ("deg, 30 deg", "deg, -20 deg", 10, "chambers.angles: chambers 1 and 2 overlap; move them"),
    ("angles: [-30 deg, 30", "angles: [-30, 30", 10, "angles[0]: bare number -30"),
    ("[5, 6]]", "[5]]", 11, "channels: chamber 6 is fed by no channel"),
    ("[5, 6]]", "[5, 2]]", 11, "channels[2][1]: chamber 2 is fed by channel 1 and by channel 3"),
    ("[5, 6]]", "[5, 6, 6]]", 11, "chamber 6 is fed twice by channel 3"),
    ("[5, 6]]", "[5, 7]]", 11, "there is no chamber 7; expected a number from 1 to 6"),
    ("[5, 6]]", "[5, 0]]", 11, "there is no chamber 0"),
    ("[5, 6]]", "[5, true]]", 11, "expected a chamber number, counted from 1, not True"),
    ("[5, 6]]", "[5, 6.0]]", 11, "expected a chamber number, counted from 1, not 6.0"),
    ("[5, 6]]", "[5, 6], []]", 11, "channels[3]: must not be empty"),
    ("[[1, 2], [3, 4], [5, 6]]", "[]", 11, "channels: must not be empty"),
    ("youngs_modulus: 100 kPa", "youngs_modulus: 0 kPa", 12, "must be greater than 0"),
    ("poisson_ratio: 0.5", "poisson_ratio: 0.6", 12, "must be at most 0.5, not 0.6"),
    ("poisson_ratio: 0.5", "poisson_ratio: -1", 12, "must be greater than -1, not -1"),
    ("density: 1070 kg/m^3", "density: 0 kg/m^3", 12, "density: must be greater than 0"),
    (", density: 1070 kg/m^3", "", 12, "there is gravity, so a density is needed; add one"),
    ("area: 1.2", "area: 0", 13, "compensation.area: must be greater than 0, not 0"),
    ("inertia: 1.05", "inertia: .nan", 13, "inertia: nan is not a finite number"),
    ("inertia: 1.05", "inertia: 1 mm", 13, "inertia: '1 mm' is not a number"),
    ("connector: 5 mm", "connector: -1 mm", 14, "connector: must be at least 0"),
    ("connector: 5 mm", "strain_law: neo", 14, "'neo' is not one of 'paper', 'rest-length'"),
    ("connector: 5 mm", "history: {softening: -0.2}", 14, "-0.2 per Pa leaves no modulus"),
    (
        "connector: 5 mm",
        "history: {softening: -3e-6, remembers: strain, creep: [{time: 9 s, share: 0.6}]}",
        14,
        "at the highest pressures they add up to",
    ),
    ("tip_mass: 20 g", "tip_mass: -20 g", 15, "tip_mass: must be at least 0, not '-20 g'"),
    ("9.81 m/s^2]", "9.81 m/s^2, 0 m/s^2]", 16, "gravity: expected 3 items, not 4"),
    ("9.81 m/s^2]", "9.81 N]", 16, "gravity[2]: '9.81 N': 'N' is not a unit of acceleration"),
    ("max: 1.5 bar", "max: -1 bar", 17, "-1 bar must be greater than the min of 0 bar (segment 1"),
    (
        "max: 1.5 bar",
        "max: [1 bar, 2 bar]",
        17,
        "pressure.max: has 2 values; expected one value or a list of 3, one for each channel of "
        "the robot, proximal segment first",
    ),
    ("min: 0 bar", "min: [0 bar, 0, 0 bar]", 17, "pressure.min[1]: bare number 0 has no unit"),
    ("slew: 5 bar/s", "slew: 0 bar/s", 17, "pressure.slew: must be greater than 0"),
    ("slew: 5 bar/s", "slew: 5 bar", 17, "'bar' is not a unit of rate of pressure"),
    ("slew: 5", "slwe: 5", 17, "pressure.slwe: unknown key; did you mean 'slew'?"),
    ("name: test-arm", "name: ''", 2, "name: must not be empty"),
    ("gravity: [0 m/s^2, ", "gravity: [", 16, "gravity: expected 3 items, not 2"),
]


@pytest.mark.parametrize(("old", "new", "line", "message"), MISTAKES)
def test_a_mistake_in_a_robot_file(
    tmp_path: Path, old: str, new: str, line: int, message: str
) -> None:
    assert old in ROBOT
    with pytest.raises(FileError) as caught:
        read(tmp_path, ROBOT.replace(old, new, 1))
    assert message in str(caught.value)
    assert caught.value.line == line


@pytest.mark.parametrize("n", [0, 21])
def test_one_to_twenty_segments(n: int) -> None:
    with pytest.raises(
        InputError, match=r"RobotDescription\.segments: (must not be empty|expected at most 20)"
    ):
        robot(segments=[segment()] * n)


def test_neo_hookean_rubber_is_incompressible() -> None:
    assert segment(strain_law="neo-hookean").strain_law == "neo-hookean"
    with pytest.raises(InputError, match=r"Segment\.material\.poisson_ratio: .* expected 0\.5"):
        segment(strain_law="neo-hookean", material=Material(youngs_modulus=1e5, poisson_ratio=0.4))


def test_chambers_may_touch_but_not_overlap() -> None:
    radius = 0.01 * math.sin(math.pi / 6)
    Chambers(radius=radius, offset=0.01, angles=np.radians(range(0, 360, 60)))
    with pytest.raises(InputError, match="chambers 1 and 2 overlap"):
        Chambers(radius=radius * 1.001, offset=0.01, angles=np.radians(range(0, 360, 60)))
    with pytest.raises(InputError, match="chambers 1 and 3 overlap"):
        Chambers(radius=0.001, offset=0.01, angles=(0.0, 1.0, 2 * math.pi))


def test_limits_per_channel() -> None:
    arm = robot(pressure={"min": [0, 0, 0, 1e4, 0, 0], "max": 1e5, "slew": (1e5,) * 6})
    assert arm.pressure_min == (0, 0, 0, 1e4, 0, 0)
    assert arm.pressure_max == (1e5,) * 6
    assert arm.pressure_slew == (1e5,) * 6
    with pytest.raises(InputError, match=r"\(segment 2 channel 1\)"):
        robot(pressure={"min": [0, 0, 0, 2e5, 0, 0], "max": 1.5e5})
    with pytest.raises(InputError, match=r"pressure\.slew: has 1 values; .* a list of 6"):
        robot(pressure={"min": 0, "max": 1e5, "slew": [1e5]})


def test_channels_have_names() -> None:
    arm = robot()
    assert arm.channel_name(0) == "segment 1 channel 1"
    assert arm.channel_name(5) == "segment 2 channel 3"
    for index in (-1, 6):
        with pytest.raises(InputError, match="there is no such channel; this robot has 6"):
            arm.channel_name(index)


def test_numbers_of_the_wrong_sort_in_code() -> None:
    with pytest.raises(InputError, match=r"Segment\.length: nan is not a finite number"):
        segment(length=math.nan)
    with pytest.raises(InputError, match=r"Segment\.length: True is not a number"):
        segment(length=True)
    with pytest.raises(InputError, match=r"Segment\.lenght: unknown key; did you mean 'length'\?"):
        segment(lenght=1.0)


def test_an_unknown_robot() -> None:
    with pytest.raises(InputError) as caught:
        load_description("stif-flop-3")
    assert "there is no robot 'stif-flop-3'; did you mean 'stiff-flop-3'?" in str(caught.value)
    assert ", ".join(builtin_robots()) in str(caught.value)
    with pytest.raises(InputError, match="expected a robot's name or path, not 3"):
        load_description(3)  # type: ignore[arg-type]


def test_what_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = read(tmp_path, ROBOT)
    assert load_description("arm.yaml", base=tmp_path) == arm
    assert load_description(str(tmp_path / "arm.yaml"), base="elsewhere") == arm
    (tmp_path / "stiff-flop-1").write_text(ROBOT, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_description("./stiff-flop-1") == arm
    assert load_description(Path("stiff-flop-1")) == arm
    assert load_description("stiff-flop-1") != arm
    with pytest.raises(FileError, match=r"^none\.yml: there is no such file"):
        load_description("none.yml")


lengths = st.floats(0.01, 1)


@settings(max_examples=50, deadline=None)
@given(
    lengths,
    st.floats(1e3, 1e7),
    st.floats(0, 1),
    st.lists(st.floats(-9, 9), min_size=3, max_size=3),
)
def test_any_robot_survives_its_file(
    tmp_path_factory: Any, length: float, modulus: float, mass: float, gravity: list[float]
) -> None:
    part = segment(length=length, material=Material(youngs_modulus=modulus, density=modulus / 7))
    arm = robot(segments=[part], tip_mass=mass, gravity=gravity)
    path = tmp_path_factory.getbasetemp() / "arm.yaml"
    save_file(path, "robot", arm)
    assert load_description(path) == arm
