"""The driver of open regulators against the real firmware, in simavr with pneumatics behind it."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from board_host import ARM, READ, SET, Host, command, frame_of, need_firmware
from fake_bench import FakeBench
from running import ONE, RIGS, guard_of, patient_rig, running, virtual_lab, wait_for
from stiffopt.daemon.client import Client
from stiffopt.errors import CommandError, DeviceError, FileError, InputError
from stiffopt.lab.firmware import built_firmware
from stiffopt.lab.open_regulator_peer import OpenRegulatorPeer
from stiffopt.lab.virtual import VirtualLab
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.drivers.open_regulator import OpenRegulatorSettings, OpenRegulatorSupply
from stiffopt.rig.interface import PressureLimits

pytestmark = pytest.mark.real_time

LIMITS = PressureLimits(np.zeros(3), np.full(3, 1.5e5))
PRESSURES = np.array([1e5, 0.5e5, 0.8e5])
PLANT = {"seed": 3, "spread": {"modulus": "5 %", "length": "0.5 %"}, "faults": True}
PATIENT = 500  # ms of silence, so that a busy machine is no fault


@pytest.fixture(autouse=True)
def _firmware() -> None:
    need_firmware()


def settings(outputs: tuple[int, ...] = (1, 2, 3), **changes: Any) -> OpenRegulatorSettings:
    values = {"port": "any", "timeout": 1.0, "channels": [{"output": k} for k in outputs]}
    return OpenRegulatorSettings(**{**values, **changes})


@contextmanager
def board(
    chosen: OpenRegulatorSettings | None = None, bench: Any = None, **built: int
) -> Iterator[tuple[OpenRegulatorPeer, OpenRegulatorSettings, Any]]:
    bench = FakeBench() if bench is None else bench
    peer = OpenRegulatorPeer(chosen or settings(), bench, **{"SILENCE_MS": PATIENT, **built})
    try:
        yield peer, peer.start(), bench
    finally:
        peer.close()


def press(
    supply: OpenRegulatorSupply, bench: Any, pressures: np.ndarray = PRESSURES, within: float = 3e3
) -> None:
    """Command until the pressures are in the chambers, within so many Pa."""

    def there() -> bool:
        supply.exchange(pressures)
        return bool(np.abs(bench.pressures - pressures).max() < within)

    wait_for(there, 20)


def end_of(supply: OpenRegulatorSupply, pressures: np.ndarray = PRESSURES) -> str:
    """Command until that fails; return what is told."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            supply.exchange(pressures)
        except DeviceError as error:
            return str(error)
        time.sleep(0.005)
    raise AssertionError("nothing was told")


def armed(client: Client) -> bool:
    with suppress(CommandError):
        client.arm()
        return True
    return False


def vented(peer: OpenRegulatorPeer, bench: Any, below: float = 2e3) -> bool:
    return peer.dump_open and bool(bench.pressures.max() < below)


# what it does -------------------------------------------------------------------------------------


def test_six_channels_each_at_its_own_pressure() -> None:
    chosen, bench = settings((6, 5, 4, 3, 2, 1)), FakeBench(6)
    limits = PressureLimits(np.zeros(6), np.full(6, 1.5e5))
    pressures = np.linspace(0.2e5, 1.2e5, 6)
    with board(chosen, bench) as (_, addressed, _), addressed.device(limits) as supply:
        supply.arm()
        press(supply, bench, pressures, within=1.8e3)
        wait_for(lambda: np.abs(supply.exchange(pressures).pressures - pressures).max() < 2e3, 20)
        told = supply.statistics()
        assert told["reset"] == 1
        assert told["bad_frames"] == told["refused"] == told["vented"] == 0
        assert told["frames"] > 5


def test_no_tick_is_lost_while_frames_come_without_pause() -> None:
    chosen, bench = settings((6, 5, 4, 3, 2, 1)), FakeBench(6)
    limits = PressureLimits(np.zeros(6), np.full(6, 1.5e5))
    with board(chosen, bench) as (_, addressed, _), addressed.device(limits) as supply:
        supply.arm()
        for _ in range(300):
            supply.exchange(np.full(6, 1e5))
        # A tick that a frame delays is made good by the next. Lost time would add up to more.
        assert supply.statistics()["longest_tick_us"] < 4000


def test_the_rigs_limits_are_set_on_the_board() -> None:
    limits = PressureLimits(np.zeros(3), np.array([1.5e5, 1.2e5, 0.9e5]))
    chosen = settings((3, 1, 2), slew="7 bar/s")
    with board(chosen) as (_, addressed, _), addressed.device(limits) as supply:
        supply.arm()
        host = Host(addressed.port)
        for beyond in ((12001, 0, 0), (0, 9001, 0), (0, 0, 15001)):  # outputs 2, 3 and 1
            kind, refused = host.ask(SET, command(host.report(), *beyond))
            assert (kind, refused[0]) == (0xFF, 4)
        last = host.report(SET, command(host.report(), 12000, 9000, 15000))
        while last.readings[0] < 3000:  # it rises
            last = host.report(SET, command(last, 12000, 9000, 15000))
        begin, low = last.time, last.readings[0]
        while last.readings[0] < 10000:
            last = host.report(SET, command(last, 12000, 9000, 15000))
        assert (last.readings[0] - low) / (last.time - begin) < 70 * 1.1  # 7 bar/s, on the board
        host.close()


def test_silence_at_no_pressure_is_no_fault_and_with_pressure_is_told() -> None:
    with board(SILENCE_MS=100) as (peer, addressed, bench), addressed.device(LIMITS) as supply:
        supply.arm()
        wait_for(lambda: peer.dump_open)
        supply.command(PRESSURES)  # which arms the board again
        with suppress(DeviceError):  # a busy machine may be too late again
            for _ in range(20):
                supply.command(PRESSURES)
                time.sleep(0.01)
        wait_for(lambda: vented(peer, bench))
        for _ in range(2):  # it is not taken up again by itself
            with pytest.raises(DeviceError, match=r"vented: no command had come"):
                supply.command(PRESSURES)
        supply.vent()
        supply.arm()
        supply.command(PRESSURES)


def test_another_program_is_noticed() -> None:
    with board() as (_, addressed, _), addressed.device(LIMITS) as supply:
        supply.arm()
        supply.command(PRESSURES)
        host = Host(addressed.port)
        host.report(SET, command(host.report(), 1, 2, 3))
        host.close()
        time.sleep(0.06)  # the driver looks every 50 ms
        with pytest.raises(DeviceError, match="another program commands it"):
            supply.command(PRESSURES)


# faults: each ends vented and told ----------------------------------------------------------------

LINE = r"does not answer|noise|another request|unrequested"
FAULTS = {
    "noise": LINE,
    "losses": LINE,
    "unplugged": LINE,
    "off": LINE,
    "hung": r"vented: its program had hung",
    "reset": r"vented: it was reset",
    "brown-out": r"vented: its supply voltage had dropped",
    "garbage": r"vented: the sensor of its channel 1 is broken",
    "leak": r"vented: air was let into its channel 1",
    "high": r"vented: the pressure of its channel 1 was above its limit",
    "slow": r"vented: (air|the pressure|the valve)",
}


class FaultyBench(FakeBench):
    """A bench whose first channel alone is at fault."""

    def channel_faults(self) -> dict[int, str]:
        return {0: self.fault("supply")}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_ends_vented_and_told(fault: str) -> None:
    bench = FaultyBench()
    with board(settings(timeout="0.3 s"), bench) as (peer, addressed, _):
        supply = addressed.device(LIMITS)
        supply.open()
        supply.arm()
        press(supply, bench)
        bench.faults["supply"] = fault
        # slow valves are told when something is to change
        told = end_of(supply, np.full(3, 0.1e5) if fault == "slow" else PRESSURES)
        if FAULTS[fault] != LINE and re.search(LINE, told):  # it fell silent in an answer
            told = end_of(supply)
        assert re.search(FAULTS[fault], told), told
        # through the check valves alone, if the board has no power or a valve is stuck
        below = {"off": 3e3, "high": 2e4, "leak": 3e3}.get(fault, 2e3)
        wait_for(lambda: vented(peer, bench, below), 20)
        bench.faults["supply"] = "ok"
        wait_for(lambda: vented(peer, bench), 20)

        def works_again() -> bool:
            with suppress(DeviceError):
                supply.vent()
                supply.arm()
                supply.exchange(PRESSURES)
                return True
            return False

        wait_for(works_again, 20)
        supply.close()
        wait_for(lambda: vented(peer, bench))


def test_a_board_that_is_gone_is_told() -> None:
    with board() as (peer, addressed, bench):
        supply = addressed.device(LIMITS)
        supply.open()
        supply.arm()
        press(supply, bench)
        peer.close()  # power and line at once
        told = end_of(supply)
        assert re.search("cannot be reached|does not answer", told)
        with pytest.raises(DeviceError):
            supply.close()
        assert not supply.is_open
    with pytest.raises(DeviceError, match="cannot be reached"):
        settings(port="/dev/stiffopt-nothing", startup=0.1).device(LIMITS).open()


def test_a_port_where_nobody_answers_is_given_up() -> None:
    master, slave = os.openpty()
    try:
        chosen = settings(port=os.ttyname(slave), startup="0.3 s", timeout="0.1 s")
        began = time.monotonic()
        with pytest.raises(DeviceError, match="does not answer"):
            chosen.device(LIMITS).open()
        assert time.monotonic() - began < 5
    finally:
        os.close(master)
        os.close(slave)


def test_an_old_version_is_refused_and_stays_vented() -> None:
    with board(PROTOCOL_VERSION=0) as (peer, addressed, _):
        with pytest.raises(DeviceError, match=r"speaks version 0 .* version 1; write the firmware"):
            addressed.device(LIMITS).open()
        assert peer.dump_open


def test_the_wrong_one_of_two_boards_is_refused_and_stays_vented() -> None:
    with board(settings(board=2)) as (peer, addressed, _):
        mixed_up = addressed.model_copy(update={"board": 1})
        with pytest.raises(DeviceError, match="is board 2, and the rig file asks for board 1"):
            mixed_up.device(LIMITS).open()
        assert peer.dump_open
        with addressed.device(LIMITS) as supply:
            supply.arm()


class TwoOnOneLine:
    """Two boards whose lines are joined to one."""

    def __init__(self, *ports: str) -> None:
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._boards = [os.open(port, os.O_RDWR | os.O_NOCTTY) for port in ports]
        self.joined = 1  # how many of the boards are on the line
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def _carry(self) -> None:
        while not self._stop.is_set():
            boards = self._boards[: self.joined]
            for end in select.select([self._master, *boards], [], [], 0.02)[0]:
                data = os.read(end, 4096)
                for other in boards if end == self._master else [self._master]:
                    os.write(other, data)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for end in (self._master, self._slave, *self._boards):
            os.close(end)


def test_two_boards_on_one_line_end_vented_and_told() -> None:
    with board() as (first, addressed, bench), board() as (second, other, _):
        line = TwoOnOneLine(addressed.port, other.port)
        try:
            both = addressed.model_copy(update={"port": line.port})
            supply = both.device(LIMITS)
            supply.open()
            supply.arm()
            press(supply, bench)
            line.joined = 2
            told = end_of(supply)
            assert re.search("second board|noise|another request|does not (take|hold|answer)", told)
            wait_for(lambda: vented(first, bench))
            assert second.dump_open
            with suppress(DeviceError):
                supply.close()
        finally:
            line.close()


# the board's own time -----------------------------------------------------------------------------


class Watched:
    """A board with the silence of real ones, and what it shows by its own clock."""

    def __init__(self) -> None:
        folder = built_firmware(PAIRS=1, BOARD_NUMBER=1)
        self.process = subprocess.Popen(
            [folder / "board", folder / "regulator.elf", "3"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stdout is not None
        self.host = Host(self.process.stdout.readline().strip())
        self.shown: list[list[float]] = []  # time in ms, pressures in Pa, whether the valve is shut
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()
        wait_for(lambda: len(self.shown) > 10)

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.shown.append(list(map(float, line.split())))

    def first(self, condition: Callable[[list[float]], bool], since: int) -> list[float]:
        """Return the first thing shown after some others that is so."""
        found = lambda: next((row for row in self.shown[since:] if condition(row)), None)  # noqa: E731
        row = wait_for(found, 20)
        assert isinstance(row, list)
        return row

    def tell(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._thread.join()
        self.host.close()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()


@pytest.fixture
def watched() -> Iterator[Watched]:
    made = Watched()
    yield made
    made.close()


def pressed(watched: Watched) -> int:
    """Bring all channels to 1 bar; return the board's time in the last command."""
    for _ in range(20):
        with suppress(AssertionError):  # a busy machine: it has vented meanwhile
            last = watched.host.press(10000, 10000, 10000, seconds=0.4)
            if min(last.readings) > 9500:
                return last.time
    raise AssertionError("the machine is too busy for this test")


def test_the_firmware_vents_after_100_ms_of_its_own_time(watched: Watched) -> None:
    last = pressed(watched)
    since = len(watched.shown) - 1
    # its clock began with the simulation's; a line is shown every 5 ms, a tick takes 2, and a
    # report is up to 10 ms younger than the command before it
    opened = watched.first(lambda row: row[-1] == 0 and row[0] > last, since)[0]
    assert 80 <= opened - last <= 110
    empty = watched.first(lambda row: max(row[1:4]) < 2e3, since)[0]
    assert empty - opened < 400
    report = watched.host.report()
    assert (report.armed, report.cause) == (0, 6)


def test_noise_and_half_frames_do_not_renew_a_command(watched: Watched) -> None:
    last, stop = pressed(watched), threading.Event()

    def babble() -> None:
        while not stop.wait(0.005):
            watched.host.line.write(b"\x03\x01\0" + frame_of(READ)[:-2] + b"\0" + os.urandom(10))

    babbler = threading.Thread(target=babble)
    babbler.start()
    opened = watched.first(lambda row: row[-1] == 0, len(watched.shown) - 1)[0]
    stop.set()
    babbler.join()
    assert opened - last <= 110


@pytest.mark.parametrize(("event", "cause"), [("hang", 4), ("reset", 2), ("brown-out", 3)])
def test_it_restarts_vented(watched: Watched, event: str, cause: int) -> None:
    pressed(watched)
    since = len(watched.shown) - 1
    watched.tell(event)
    opened = watched.first(lambda row: row[-1] == 0, since)[0]
    wait_for(lambda: watched.shown[-1][0] > opened + 40)
    watched.host.line.reset_input_buffer()
    report = watched.host.report()
    assert (report.armed, report.cause) == (0, cause)
    assert not any(report.set_points)
    if event == "hang":  # it was the watchdog, before the silence was over
        restarted = watched.shown[-1][0] - report.time
        assert restarted - opened < 50
    watched.first(lambda row: max(row[1:4]) < 2e3, since)


def test_a_board_without_power_vents_through_its_check_valves(watched: Watched) -> None:
    pressed(watched)
    since = len(watched.shown) - 1
    watched.tell("power 0")
    off = watched.first(lambda row: row[-1] == 0, since)[0]
    assert watched.first(lambda row: max(row[1:4]) < 3e3, since)[0] - off < 500
    again = watched.shown[-1][0]
    watched.tell("power 1")
    wait_for(lambda: watched.shown[-1][0] > again + 100)
    assert watched.host.report(ARM).armed


# rig files ----------------------------------------------------------------------------------------


def test_bad_settings_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="output 2 is taken already"):
        settings((1, 2, 2))
    text = (RIGS / "open-regulator.yaml").read_text()
    slow = tmp_path / "slow.yaml"
    slow.write_text(text.replace("rate: 100 Hz", "rate: 10 Hz"))
    with pytest.raises(FileError, match=r"rate: .* at least 20 Hz"):
        load_rig_description(slow)
    high = PressureLimits(np.zeros(3), np.full(3, 2.5e5))
    with board() as (_, addressed, _):
        with pytest.raises(DeviceError, match="takes at most 2 bar"):
            addressed.device(high).open()
        for_six = settings((1, 2, 4), port=addressed.port)
        with pytest.raises(DeviceError, match="has 3 channels only"):
            for_six.device(LIMITS).open()
        capped = settings(
            port=addressed.port, channels=[{"output": k, "max": 9e4} for k in (1, 2, 3)]
        )
        with capped.device(LIMITS) as supply:
            supply.arm()
            with pytest.raises(CommandError, match=r"the limits are 0 to 0\.9 bar"):
                supply.command([9.1e4, 0, 0])


def test_links_to_a_port_are_one_endpoint(tmp_path: Path) -> None:
    master, slave = os.openpty()
    link = tmp_path / "by-id"
    link.symlink_to(os.ttyname(slave))
    plain, linked = (
        settings(port=str(port)).device(LIMITS).endpoints for port in (os.ttyname(slave), link)
    )
    assert plain == linked
    os.close(master)
    os.close(slave)


def test_an_arm_with_more_channels_than_a_board_is_told() -> None:
    with pytest.raises(InputError, match="6 channels at most; the arm has 9"):
        OpenRegulatorPeer.stand_in(None, 9)


def test_it_takes_the_place_of_simulated_regulators(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two segments, six channels, and the arm moves by what is in the simulated chambers."""
    monkeypatch.setenv("STIFFOPT_FIRMWARE", f"SILENCE_MS={PATIENT}")
    description = load_rig_description(RIGS / "sim-two-segment.yaml")
    robot = load_description("stiff-flop-2-hanging")
    with VirtualLab(description, robot, supply="open-regulator") as lab:
        addressed = lab.start().model_copy(update={"tracker": None, "probe": None})
        before = lab.world.plant.tip_pose()[:3, 3].copy()
        goal = np.array([0.6e5, 0, 0, 0, 0.4e5, 0])
        with make_rig(addressed, robot) as rig:
            rig.supply.arm()

            def there() -> bool:
                rig.command(goal)
                return bool(np.abs(lab.world.pressures - goal).max() < 3e3)

            wait_for(there)
            wait_for(
                lambda: (
                    there() and np.linalg.norm(lab.world.plant.tip_pose()[:3, 3] - before) > 5e-3
                )
            )
            with pytest.raises(InputError, match="hung"):
                lab.world.inject("supply", "nonsense")
        wait_for(lambda: lab.world.pressures.max() < 2e3)


def test_the_run_command_drives_simulated_silicone_through_real_firmware(
    tmp_path: Path, compiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds a pose; SIGTERM ramps down; the death of guard and program vents, and a reset."""
    monkeypatch.setenv("STIFFOPT_FIRMWARE", "SILENCE_MS=5000")
    rig, out = (
        patient_rig(tmp_path, "open-regulator", supply={"timeout": "1 s"}, plant=PLANT),
        tmp_path / "l.yaml",
    )
    task = tmp_path / "task.yaml"
    task.write_text(ONE, encoding="utf-8")
    with virtual_lab(rig, out) as (lab, pressures):
        with running("run", str(out)) as run:
            started = run.line("started")
            with Client(started["url"], started["token_file"]) as client:
                client.take_control()
                wait_for(lambda: armed(client))  # gauges and tracker have to be known for a while
                client.set_task(position=[-0.02, 0.005, None])
                client.wait_until_settled(1e-3, timeout=100)
                client.release()
            assert pressures().max() > 0.1
            assert run.end(signal.SIGTERM) == 0
            wait_for(lambda: pressures().max() < 0.02)
        with running("run", str(out), "--task", str(task), "--arm") as run:
            run.line("task")
            wait_for(lambda: pressures().max() > 0.2)
            guard = guard_of(run.popen.pid)
            os.kill(guard, signal.SIGSTOP)  # so that it cannot vent, nor the program
            run.popen.kill()
            os.kill(guard, signal.SIGKILL)
            run.wait()
            wait_for(lambda: pressures().max() < 0.02, 30)  # the board itself
        with running("run", str(out), "--task", str(task), "--arm", "--no-service") as run:
            run.line("task")
            wait_for(lambda: pressures().max() > 0.2)
            lab.say("fault supply reset")
            assert run.wait(60) == 5
            told = " ".join(" ".join([*run.out, *run.err]).split())
            assert re.search("it was reset|sends noise|does not answer", told), told
            wait_for(lambda: pressures().max() < 0.02)
