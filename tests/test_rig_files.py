"""Rig files: those that come with stiffopt, and what is said about bad ones."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stiffopt.errors import DeviceError, FileError, InputError, MissingExtraError
from stiffopt.files import read_file, save_file
from stiffopt.model.description import Recordings
from stiffopt.model.robot_files import load_description, save_robot
from stiffopt.plant.devices import SimulatedRig
from stiffopt.registration import Placement, Registration
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, load_rig_description, slew_of
from stiffopt.rig.drivers.modbus import ModbusSettings
from stiffopt.rig.drivers.nidaq import NidaqDumpValve
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import ControlSettings, Safety, ServiceSettings
from stiffopt.safety.rigs import open_rig
from stiffopt.schema import Schema

RIGS = sorted((Path(__file__).parent.parent / "rig").glob("*.yaml"))
SIMULATED = ("sim", "sim-two-segment", "paper", "palpation")
EXPECTED = {
    *("sim", "sim-two-segment", "paper", "palpation", "virtual-lab"),
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


@pytest.mark.parametrize("path", [p for p in RIGS if p.stem in SIMULATED], ids=lambda p: p.stem)
def test_every_simulated_rig_runs(path: Path) -> None:
    with open_rig(path) as rig:
        tracker = rig.tracker
        assert tracker is not None
        rig.clock.sleep(0.5)
        before = tracker.latest
        rig.supply.arm()
        rig.command(np.linspace(0, 8e4, rig.supply.n), valid_for=3.0)
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


# A rig with a calibrated robot --------------------------------------------------------------------

OFF = Placement(position=(0.003, -0.002, 0.001), orientation=(0.99875, 0.03, 0.04, 0.0))
TURNED = {"position": (0.1, -0.2, 0.3), "orientation": (0.5, -0.5, 0.5, 0.5)}
SENSOR = {"position": (0.0, 0.002, -0.005), "orientation": (0.6, 0.0, 0.8, 0.0)}


def displaced_rig(recordings: Recordings | None, *, calibrated: bool = True) -> Rig:
    """Return a rig whose tracker is not where its registration says."""
    robot = load_description("stiff-flop-1").model_copy(update={"recordings": recordings})
    description = RigDescription(
        robot="stiff-flop-1",
        supply={"driver": "simulated", "ripple": 0.0},
        tracker={
            "driver": "simulated",
            "noise": 0.0,
            "angular_noise": 0.0,
            "registration": {"tracker_in_base": TURNED, "tip_in_sensor": SENSOR},
            "calibrated": calibrated,
        },
        plant={
            "dynamics": "quasi-static",
            "discretisation": {"step": 0.01},
            "silicone": {"law": "linear", "creep": (), "hysteresis": ()},
            "mismatch": {"registration": OFF},
        },
    )
    return make_rig(description, robot)


def seen_and_true(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Poses (4, 4) of the tip: as the rig sees it, and as it is."""
    assert isinstance(rig, SimulatedRig)
    assert rig.tracker is not None
    with rig:
        rig.supply.arm()
        rig.command([1e5, 0.5e5, 0.0])
        rig.clock.sleep(6.0)
        sample = rig.tracker.latest
        assert sample is not None
        assert sample.quaternion is not None
        turn = Rotation.from_quat(sample.quaternion, scalar_first=True).as_matrix()
        seen = np.block([[turn, sample.position[:, np.newaxis]], [np.eye(4)[3:]]])
        return seen, rig.world.plant.tip_pose()


def test_the_registration_of_a_calibrated_robot_corrects_what_a_tracker_sees() -> None:
    correction = Recordings(channels=(1, 2, 3), registration=Registration(tracker_in_base=OFF))
    seen, true = seen_and_true(displaced_rig(correction))
    np.testing.assert_allclose(seen, true, atol=2e-6)  # the arm hardly moves any more
    for rig in (displaced_rig(correction, calibrated=False), displaced_rig(None, calibrated=False)):
        seen, true = seen_and_true(rig)
        assert np.linalg.norm(seen[:3, 3] - true[:3, 3]) > 3e-3
        np.testing.assert_allclose(OFF.transform() @ seen, true, atol=2e-6)


def test_so_does_where_a_calibrated_robot_has_the_sensor() -> None:
    there = Placement(position=(0.001, 0.0, 0.004), orientation=(0.8, 0.0, 0.6, 0.0))
    registration = Registration(tracker_in_base=OFF, tip_in_sensor=there)
    seen, true = seen_and_true(displaced_rig(Recordings(registration=registration)))
    np.testing.assert_allclose(seen, true @ there.transform(), atol=2e-6)


def test_real_trackers_are_corrected_too() -> None:
    description = load_rig_description(Path(__file__).parent.parent / "rig" / "openigtlink.yaml")
    assert description.tracker is not None
    tracker = description.tracker.model_copy(update={"calibrated": True})
    robot = load_description(description.robot).model_copy(
        update={"recordings": Recordings(registration=Registration(tracker_in_base=OFF))}
    )
    rig = make_rig(description.model_copy(update={"tracker": tracker}), robot)
    assert rig.tracker is not None
    np.testing.assert_allclose(
        rig.tracker.registration.tracker_in_base.transform(),
        OFF.transform() @ tracker.registration.tracker_in_base.transform(),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("recordings", "message"),
    [
        (None, "the robot 'stiff-flop-1' has no 'recordings', which would say how to correct"),
        (Recordings(frame="base"), "'stiff-flop-1' are not of a rig"),
        (Recordings(channels=(2, 1, 3)), "'stiff-flop-1' are not of a rig"),
    ],
)
def test_a_robot_that_cannot_correct_a_tracker_says_so(
    recordings: Recordings | None, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        displaced_rig(recordings)
    robot = load_description("stiff-flop-1").model_copy(update={"recordings": recordings})
    save_robot(tmp_path / "arm.yaml", robot)
    rig = (
        "format: stiffopt-rig/1\nrobot: arm.yaml\nsupply: {driver: simulated}\n"
        "tracker:\n  driver: simulated\n  calibrated: true\n"
    )
    (tmp_path / "rig.yaml").write_text(rig)
    with pytest.raises(FileError, match=message) as caught:
        open_rig(tmp_path / "rig.yaml")
    assert (caught.value.key, caught.value.line) == ("tracker.calibrated", 6)


@pytest.mark.parametrize(
    "path", [p for p in RIGS if p.stem in EXPECTED - {*SIMULATED}], ids=lambda p: p.stem
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
SUPPLY, TRACKER = "supply: {driver: simulated}\n", "tracker: {driver: simulated}"
BEFORE = "{driver: simulated}\ntracker"
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
        (TRACKER, "tracker: {driver: modbus}", 5, "no driver 'modbus'"),
        ("stiff-flop-1", "stiff-flop-9", 3, "there is no robot"),
        ("stiff-flop-1", "nowhere/arm.yaml", None, "there is no such file"),
        (BEFORE, "{driver: simulated, lagg: 1 s}\ntracker", 4, "'lag'"),
        (BEFORE, "{driver: simulated, lag: 60}\ntracker", 4, "no unit"),
        (BEFORE, "{driver: simulated, lag: -1 s}\ntracker", 4, "at least 0"),
        (SUPPLY, MODBUS, 8, "2 channels; the robot"),
        (TRACKER, "safety: {max_pressure: 2 bar}", 5, "above the robot's"),
        (TRACKER, "safety: {max_slew: 9 bar/s}", 5, "above the robot's"),
        (TRACKER, "control: {tip_speed: 0 mm/s}", 5, "greater than 0"),
        (TRACKER, "control: {tip_speed: 20}", 5, "no unit"),
        (
            TRACKER,
            "control: {tip_speed: 700 mm/s}",
            5,
            "700 mm/s is above safety.max_tip_speed, 600 mm/s",
        ),
        (TRACKER, "safety: {max_pressure: [1 bar, 1 bar]}", 5, "2 values; expected one, or 3"),
        (TRACKER, "tracker: {driver: aurora}", 4, "is simulated and the"),
        (TRACKER, "plant: {mismatch: {gain: [1, 1]}}", 5, "2 values"),
        (TRACKER, "plant: {dynamics: slow}", 5, "is not one of"),
        ("name: mine", "rate: 0 Hz", 2, "greater than 0"),
        (TRACKER, "safety: {max_pressure: -1 bar}", 5, "below the robot's"),
        (TRACKER, "tracker: {driver: simulated, rate: 2000 Hz}", 5, "faster than the steps"),
        (TRACKER, "plant: {discretisation: {sub_intervals: 3}}", 5, "too few for these degrees"),
        (
            SUPPLY,
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


@pytest.mark.parametrize(
    ("kind", "given", "said"),
    [
        (Safety, {"guard_timeout": "5 ms"}, "at least 10 ms, not '5 ms'"),
        (Safety, {"guard_timeout": "1 min"}, "at most 2 s, not '1 min'"),  # no number of minutes
        (Safety, {"guard_timeout": 3}, "at most 2 s, not 3"),
        (Safety, {"guard_timeout": np.float64(2.5)}, "at most 2 s, not 2.5"),
        (Safety, {"hold_timeout": "2 h"}, "at most 1 h, not '2 h'"),  # a time, or 'none'
        (Safety, {"ramp_time": "0 s"}, "greater than 0, not '0 s'"),
        (Safety, {"max_overruns": 2.5}, "a whole number, not 2.5"),
        (Safety, {"max_overruns": float("nan")}, "a finite number, not nan"),
        (ControlSettings, {"damping": "120 %"}, "less than 100 %, not '120 %'"),
        (ModbusSettings, {"read_write": 3}, "read_write: expected true or false, not 3"),
        (NidaqDumpValve, {"line": "Dev1"}, "'Dev1' is not a name such as 'Dev1/port0/line0'"),
    ],
)
def test_bounds_have_the_unit_of_what_was_given(
    kind: type[Schema], given: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        kind(**given)


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
    path = written(tmp_path, text)
    rig = make_rig(load_rig_description(path), load_description("stiff-flop-1"))
    for name in [name for name in sys.modules if name.split(".")[0] == "pymodbus"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pymodbus", None)
    with pytest.raises(MissingExtraError, match=r"stiffopt\[modbus\]"):
        rig.open()


def test_in_code_mistakes_are_input_errors() -> None:
    with pytest.raises(InputError, match="no driver"):
        RigDescription(robot="stiff-flop-1", supply={"driver": "steam"})


@pytest.mark.parametrize(("text", "port"), [("none", None), ("0", 0), ("8765", 8765)])
def test_foxglove_is_served_only_where_a_file_names_a_port(
    tmp_path: Path, text: str, port: int | None
) -> None:
    path = tmp_path / "rig.yaml"
    content = "format: stiffopt-rig/1\nrobot: stiff-flop-2\nsupply: {driver: simulated}\n"
    path.write_text(content)
    assert load_rig_description(path).service.foxglove_port is None
    path.write_text(f"{content}service: {{foxglove_port: {text}}}\n")
    read = load_rig_description(path)
    assert read.service.foxglove_port == port
    save_file(path, "rig", read)
    assert load_rig_description(path) == read
    assert ServiceSettings(foxglove_port=port).foxglove_port == port


@pytest.mark.parametrize("text", ["null", "off", "65536", "-1", "8470"])
def test_what_is_no_port_for_foxglove_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "format: stiffopt-rig/1\nrobot: stiff-flop-2\nsupply: {driver: simulated}\n"
        f"service: {{foxglove_port: {text}}}\n"
    )
    with pytest.raises(FileError, match=r"service\.foxglove_port"):
        load_rig_description(path)
