"""The virtual lab: real drivers over real protocols against a simulated arm."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from running import wait_for
from stiffopt.cli.main import main
from stiffopt.errors import DeviceError, InputError
from stiffopt.files import read_file, save_file
from stiffopt.lab.virtual import VirtualLab
from stiffopt.model.robot_files import load_description
from stiffopt.plant.settings import PlantSettings, Silicone
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.rig.interface import Rig
from stiffopt.safety.rigs import open_rig

pytestmark = pytest.mark.real_time

RIGS = Path(__file__).parent.parent / "rig"
ROBOT = load_description("stiff-flop-1")


def anywhere(description: RigDescription) -> RigDescription:
    """Let the Modbus peer listen on a free port."""
    supply = description.supply
    if supply.driver != "modbus":
        return description
    tcp = supply.tcp.model_copy(update={"port": free_port()})
    return description.model_copy(update={"supply": supply.model_copy(update={"tcp": tcp})})


def patient(description: RigDescription) -> RigDescription:
    """Wait longer for the devices than one should for real ones: the machine may be busy."""
    supply = description.supply.model_copy(update={"timeout": 5.0})
    return description.model_copy(update={"supply": supply})


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def moves(rig: Rig, lab: VirtualLab) -> None:
    """Drive an arm and see it move through all devices."""
    tracker = rig.tracker
    assert tracker is not None
    with rig:
        rest = wait_for(lambda: tracker.latest)
        np.testing.assert_allclose(rest.position, [0, 0, 0.09], atol=0.004)
        rig.supply.arm()

        def pressed() -> Any:  # again and again: the device's watchdog vents otherwise
            rig.command([1e5, 0, 0])
            return rig.observe().pressure.pressures[0] > 0.9e5

        def bent_sample() -> Any:
            sample = tracker.latest
            return pressed() and sample and sample.position[0] < -0.02 and sample

        wait_for(pressed)
        bent = wait_for(bent_sample)
        truth = lab.world.plant.tip_pose()[:3, 3]
        assert np.linalg.norm(bent.position - truth) < 0.02  # it still swings
    wait_for(lambda: (lab.world.pressures < 1e3).all())  # vented by closing


@pytest.mark.parametrize("supply", ["modbus", "nidaq"])
@pytest.mark.parametrize("tracker", ["aurora", "openigtlink"])
def test_a_simulated_rig_is_driven_over_real_protocols(supply: str, tracker: str) -> None:
    description = load_rig_description(RIGS / "sim.yaml").model_copy(update={"probe": None})
    with VirtualLab(description, ROBOT, supply, tracker) as lab:
        lab.description = anywhere(lab.description)
        addressed = patient(lab.start())
        moves(make_rig(addressed, ROBOT), lab)


@pytest.mark.parametrize("name", ["modbus-aurora", "nidaq-aurora", "openigtlink"])
def test_the_files_of_real_rigs_can_be_rehearsed(name: str) -> None:
    description = load_rig_description(RIGS / f"{name}.yaml")
    with VirtualLab(anywhere(description), ROBOT) as lab:
        addressed = lab.start()
        assert addressed.plant is None
        moves(make_rig(addressed.model_copy(update={"probe": None}), ROBOT), lab)


@pytest.fixture(scope="module")
def virtual_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[VirtualLab, Path]]:
    description = anywhere(load_rig_description(RIGS / "virtual-lab.yaml"))
    path = tmp_path_factory.mktemp("lab") / "lab.yaml"
    with VirtualLab(description, ROBOT) as lab:
        save_file(path, "rig", lab.start())
        yield lab, path


def test_the_printed_file_drives_the_arm(virtual_lab: tuple[VirtualLab, Path]) -> None:
    lab, path = virtual_lab
    moves(open_rig(path), lab)


def test_the_probe_measures_stiffness_over_its_protocols() -> None:
    """Tracker, stage, sensor and NI-DAQ together find the golden stiffness of the straight arm."""
    description = load_rig_description(RIGS / "virtual-lab.yaml")
    plant = PlantSettings(silicone=Silicone(law="linear", damping=0.3, creep=(), hysteresis=()))
    description = anywhere(description.model_copy(update={"plant": plant}))
    with VirtualLab(description, ROBOT) as lab:
        rig = make_rig(lab.start(), ROBOT)
        probe, tracker = rig.probe, rig.tracker
        assert probe is not None
        assert tracker is not None
        probe._prompt = lambda request: lab.bench.mount([1, 0, 0])  # type: ignore[attr-defined]
        with rig:
            probe.align([1, 0, 0])
            places, forces = [], []
            for position in (0.003, 0.004, 0.005, 0.006):
                probe.move_to(position, 0.01)
                time.sleep(0.6)
                tracker.read()
                time.sleep(0.4)
                seen = [s for s in tracker.read() if s.visible]
                places.append(np.mean([sample.position[0] for sample in seen]))
                forces.append(np.mean([probe.sample().force for _ in range(10)]))
                assert probe.sample().position == pytest.approx(position, abs=1e-6)
            assert np.polyfit(places, forces, 1)[0] == pytest.approx(14.03, rel=0.05)  # N/m


def test_faults_reach_the_drivers(virtual_lab: tuple[VirtualLab, Path]) -> None:
    lab, path = virtual_lab
    rig = open_rig(path)
    tracker = rig.tracker
    assert tracker is not None
    with rig:
        wait_for(lambda: tracker.age() < 0.2)
        lab.world.inject("tracker", "missing")
        wait_for(lambda: tracker.age() > 0.3)
        assert not tracker.latest.visible
        lab.world.inject("tracker", "ok")
        wait_for(lambda: tracker.age() < 0.2)
        lab.world.inject("tracker", "stuck")
        wait_for(lambda: tracker.age() > 0.3)
        lab.world.inject("tracker", "ok")
        lab.world.inject("supply", "wrong", 1)
        wait_for(lambda: rig.supply.read().pressures[1] > 1e4)
        lab.world.inject("supply", "ok")
        lab.world.inject("supply", "off")
        wait_for(lambda: not answers(rig))
        lab.world.inject("supply", "ok")
        wait_for(lambda: answers(rig))


def answers(rig: Rig) -> bool:
    try:
        rig.supply.read()
    except DeviceError:
        return False
    return True


def test_a_lost_controller_is_vented_by_the_device(virtual_lab: tuple[VirtualLab, Path]) -> None:
    """The coupler's watchdog acts when commands stop, whatever the program does."""
    lab, path = virtual_lab
    with open_rig(path) as rig:
        rig.supply.arm()
        for _ in range(20):
            rig.command([1e5, 1e5, 0])
            time.sleep(0.05)
        assert lab.world.pressures[0] > 0.9e5
        wait_for(lambda: lab.world.pressures.max() < 1e3, 3.0)


# The command -------------------------------------------------------------------------------------


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-c",
        "import sys; from stiffopt.cli.main import main; sys.exit(main())",
    ]
    return subprocess.Popen(
        [*command, "lab", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def told(process: subprocess.Popen[str], words: str) -> str:
    """Return the first line of stderr that has these words."""
    assert process.stderr is not None
    for line in process.stderr:
        if words in line:
            return line
    raise AssertionError(f"the command ended without saying '{words}'")


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None and not stream.closed:
            stream.close()


def test_the_command_writes_a_file_takes_commands_and_ends(tmp_path: Path) -> None:
    rig_file, out = tmp_path / "rig.yaml", tmp_path / "lab.yaml"
    save_file(rig_file, "rig", anywhere(load_rig_description(RIGS / "virtual-lab.yaml")))
    process = start(str(rig_file), "--out", str(out))
    try:
        assert process.stdin is not None
        told(process, "the lab runs")
        with open_rig(out) as rig:
            assert rig.supply.read().pressures.max() < 5e3
            process.stdin.write("fault supply wrong 2\nfault door open\nmount 0 1 0\nstatus\n")
            process.stdin.flush()
            wait_for(lambda: rig.supply.read().pressures[1] > 1e4)
        told(process, "there is no fault 'open' of 'door'")
        told(process, "rail is along 0 1 0")
        told(process, "faults: supply wrong")
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    finally:
        end(process)


def test_the_rig_file_is_printed(tmp_path: Path) -> None:
    process = start(str(RIGS / "sim.yaml"), "--supply", "nidaq", "--tracker", "openigtlink")
    try:
        told(process, "the lab runs")
        out, _ = process.communicate("quit\n", 15)
        assert process.returncode == 0
    finally:
        end(process)
    printed = tmp_path / "printed.yaml"
    printed.write_text(out)
    description = read_file(printed, "rig", RigDescription)
    assert (description.supply.driver, description.tracker.driver) == ("nidaq", "openigtlink")


def test_a_port_in_use_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig_file = tmp_path / "rig.yaml"
    description = anywhere(load_rig_description(RIGS / "virtual-lab.yaml"))
    save_file(rig_file, "rig", description)
    with socket.create_server(("127.0.0.1", description.supply.tcp.port)):
        assert main(["lab", str(rig_file)]) == 2
    error = capsys.readouterr().err
    assert str(description.supply.tcp.port) in error
    assert "Traceback" not in error


def test_the_rig_file_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (RIGS / "sim.yaml").read_text()
    rig_file = tmp_path / "rig.yaml"
    rig_file.write_text(text)
    assert main(["lab", str(rig_file), "--out", str(tmp_path / "." / "rig.yaml")]) == 2
    assert "is the rig file itself" in capsys.readouterr().err
    assert rig_file.read_text() == text


def test_without_numba_there_is_no_lab() -> None:
    script = (
        "import sys; sys.modules['numba'] = None\n"
        f"from stiffopt.cli.main import main; sys.exit(main(['lab', {str(RIGS / 'sim.yaml')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2
    assert "pip install 'stiffopt[sim]'" in " ".join(done.stderr.split())


def test_two_labs_run_beside_each_other_and_without_anybody_at_the_terminal(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-c", "from stiffopt.cli.main import main; main()", "lab"]
    outs = [tmp_path / f"{k}.yaml" for k in range(2)]
    labs = [
        subprocess.Popen(
            [*command, str(RIGS / "sim.yaml"), "--quiet", "--out", str(out)],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for out in outs
    ]
    try:
        for out in outs:
            wait_for(out.exists, 60.0)
            with open_rig(out) as rig:
                assert rig.supply.read().pressures.max() < 5e3
    finally:
        for lab in labs:
            end(lab)


def test_unknown_drivers_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lab", str(RIGS / "sim.yaml"), "--supply", "steam"]) == 2
    told = capsys.readouterr().err  # drivers of other tests may be known too
    assert "modbus" in told
    assert "nidaq" in told


def test_faults_must_be_enabled() -> None:
    description = load_rig_description(RIGS / "sim.yaml")
    with VirtualLab(description, ROBOT) as lab, pytest.raises(InputError, match="faults: true"):
        lab.world.inject("tracker", "off")
