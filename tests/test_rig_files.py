"""Rig files: those that come with stiffopt, and what is said about bad ones."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from stiffopt.errors import DeviceError, FileError, InputError, MissingExtraError
from stiffopt.files import read_file, save_file
from stiffopt.model.robot_files import load_description
from stiffopt.rig.config import (
    RigDescription,
    limits_of,
    load_rig_description,
    make_rig,
    open_rig,
    slew_of,
)

RIGS = sorted((Path(__file__).parent.parent / "rig").glob("*.yaml"))
EXPECTED = {
    *("sim", "sim-two-segment", "virtual-lab"),
    *("modbus-aurora", "nidaq-aurora", "openigtlink"),
}


def test_all_rig_files_are_there() -> None:
    assert {path.stem for path in RIGS} >= EXPECTED


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_every_rig_file_loads_and_survives_writing(path: Path, tmp_path: Path) -> None:
    description = load_rig_description(path)
    robot = load_description(description.robot, base=path.parent)
    assert limits_of(description, robot).n == robot.n_pressures
    save_file(tmp_path / "again.yaml", "rig", description)
    assert read_file(tmp_path / "again.yaml", "rig", RigDescription) == description
    text = path.read_text()
    assert text.startswith("# "), "say what it is and how it is wired"
    if description.supply.driver != "simulated":
        assert not re.search(r"plant:", text) or "lab" in path.stem


@pytest.mark.parametrize(
    "path", [p for p in RIGS if p.stem.startswith("sim")], ids=lambda p: p.stem
)
def test_every_simulated_rig_runs(path: Path) -> None:
    with open_rig(path) as rig:
        tracker = rig.tracker
        assert tracker is not None
        rig.clock.sleep(0.5)
        before = tracker.latest
        rig.supply.arm()
        rig.command(np.linspace(0, 8e4, rig.supply.n))
        rig.clock.sleep(2.0)
        observation = rig.observe()
        assert observation.pressure.pressures == pytest.approx(
            np.linspace(0, 8e4, rig.supply.n), abs=2e3
        )
        assert before is not None
        assert np.linalg.norm(observation.poses[-1].position - before.position) > 0.005
        rig.vent()
        rig.clock.sleep(1.0)
        assert rig.supply.read().pressures.max() < 1e3


@pytest.mark.parametrize(
    "path", [p for p in RIGS if p.stem in EXPECTED and "sim" not in p.stem], ids=lambda p: p.stem
)
def test_real_rigs_without_their_hardware_say_so(path: Path) -> None:
    """No device answers here: one clear sentence, in bounded time, and nothing stays open."""
    if path.stem == "virtual-lab":
        pytest.skip("its devices are started by `stiffopt lab`")
    description = load_rig_description(path)
    if description.supply.driver == "modbus":  # nobody listens on this machine
        tcp = description.supply.tcp.model_copy(update={"host": "127.0.0.1", "port": 9})
        supply = description.supply.model_copy(update={"tcp": tcp})
        description = description.model_copy(update={"supply": supply})
    rig = make_rig(description, load_description(description.robot))
    with pytest.raises(DeviceError) as error:
        rig.open()
    assert not any(device.is_open for device in rig.devices)
    assert str(error.value)[-1] != "\n"
    assert len(str(error.value)) < 400


# Mistakes ----------------------------------------------------------------------------------------

GOOD = """\
format: stiffopt-rig/1
name: mine
robot: stiff-flop-1
supply: {driver: simulated}
tracker: {driver: simulated}
"""
MODBUS = """\
supply:
  driver: modbus
  tcp: {host: 127.0.0.1}
  scale: 1 mbar
  channels: [{setpoint: 0}, {setpoint: 1}]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        (
            "driver: simulated}\ntracker",
            "driver: simulatd}\ntracker",
            4,
            "did you mean 'simulated'",
        ),
        ("supply: {driver: simulated}", "supply: {lag: 1 s}", 4, "'driver' is missing"),
        ("tracker: {driver: simulated}", "tracker: {driver: modbus}", 5, "no driver 'modbus'"),
        ("stiff-flop-1", "stiff-flop-9", 3, "there is no robot"),
        ("stiff-flop-1", "nowhere/arm.yaml", None, "there is no such file"),
        ("{driver: simulated}\ntracker", "{driver: simulated, lagg: 1 s}\ntracker", 4, "'lag'"),
        ("{driver: simulated}\ntracker", "{driver: simulated, lag: 60}\ntracker", 4, "no unit"),
        (
            "{driver: simulated}\ntracker",
            "{driver: simulated, lag: -1 s}\ntracker",
            4,
            "at least 0",
        ),
        ("supply: {driver: simulated}\n", MODBUS, 8, "2 channels; the robot"),
        ("tracker: {driver: simulated}", "safety: {max_pressure: 2 bar}", 5, "above the robot's"),
        ("tracker: {driver: simulated}", "safety: {max_slew: 9 bar/s}", 5, "above the robot's"),
        (
            "tracker: {driver: simulated}",
            "safety: {max_pressure: [1 bar, 1 bar]}",
            5,
            "2 values; expected one, or 3",
        ),
        ("tracker: {driver: simulated}", "tracker: {driver: aurora}", 4, "is simulated and the"),
        ("tracker: {driver: simulated}", "plant: {mismatch: {gain: [1, 1]}}", 5, "2 values"),
        ("tracker: {driver: simulated}", "plant: {dynamics: slow}", 5, "is not one of"),
        ("name: mine", "rate: 0 Hz", 2, "greater than 0"),
        ("tracker: {driver: simulated}", "safety: {max_pressure: -1 bar}", 5, "below the robot's"),
        (
            "tracker: {driver: simulated}",
            "tracker: {driver: simulated, rate: 2000 Hz}",
            5,
            "faster than the steps",
        ),
        (
            "tracker: {driver: simulated}",
            "plant: {discretisation: {sub_intervals: 3}}",
            5,
            "too few for these degrees",
        ),
        (
            "supply: {driver: simulated}\n",
            MODBUS.replace("{setpoint: 1}]", "{setpoint: 1, max: 9 bar}, {setpoint: 2}]"),
            8,
            "9 bar is above the robot's 1.5 bar",
        ),
    ],
)
def test_mistakes_are_told(tmp_path: Path, old: str, new: str, line: int | None, said: str) -> None:
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new))
    with pytest.raises(FileError, match=re.escape(said)) as error:
        open_rig(path)
    assert error.value.line == line
    assert "\n" not in str(error.value)


def test_limits_are_the_tightest_of_robot_and_rig(tmp_path: Path) -> None:
    text = GOOD + "safety: {max_pressure: [1 bar, 1.2 bar, 1.5 bar], max_slew: 2 bar/s}\n"
    description = load_rig_description(written(tmp_path, text))
    robot = load_description("stiff-flop-1")
    limits = limits_of(description, robot)
    assert limits.high == pytest.approx([1e5, 1.2e5, 1.5e5])
    assert limits.low == pytest.approx([0, 0, 0])
    assert slew_of(description, robot) == pytest.approx([2e5] * 3)
    assert open_rig(tmp_path / "rig.yaml").slew == pytest.approx([2e5] * 3)


def test_a_missing_extra_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = GOOD.replace("supply: {driver: simulated}\ntracker: {driver: simulated}\n", MODBUS)
    text = text.replace("{setpoint: 1}]", "{setpoint: 1}, {setpoint: 2}]")
    rig = open_rig(written(tmp_path, text))
    for name in [name for name in sys.modules if name.split(".")[0] == "pymodbus"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pymodbus", None)
    with pytest.raises(MissingExtraError, match=r"stiffopt\[modbus\]"):
        rig.open()


def test_in_code_mistakes_are_input_errors() -> None:
    with pytest.raises(InputError, match="no driver"):
        RigDescription(robot="stiff-flop-1", supply={"driver": "steam"})
