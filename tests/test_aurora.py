"""The Aurora driver on the real ndicapi, against a peer that is checked by itself first."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import signal
import struct
import subprocess
import sys
import termios
import textwrap
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import crcmod.predefined
import numpy as np
import pytest

from fake_bench import FakeBench
from running import wait_for
from stiffopt.errors import DeviceError, InputError, MissingExtraError
from stiffopt.lab.aurora_peer import AuroraPeer, crc16
from stiffopt.rig.drivers import ndi_reader
from stiffopt.rig.drivers.aurora import AuroraSettings, AuroraTracker
from stiffopt.rig.interface import PoseSample, SystemClock

pytestmark = pytest.mark.real_time

PLACE = (0.0123, -0.0456, -0.1512)  # m
TURN = np.array([0.2, 0.4, -0.5, 0.7]) / np.sqrt(0.94)  # w first
reference_crc = crcmod.predefined.mkPredefinedCrcFun("crc-16")


@contextmanager
def peer(firmware: str = "AURORA Rev 013", **settings: Any) -> Iterator[AuroraPeer]:
    bench = FakeBench()
    bench.position, bench.quaternion = PLACE, TURN
    device = AuroraPeer(AuroraSettings(driver="aurora", **settings), bench, firmware)
    device.settings = device.start()
    try:
        yield device
    finally:
        device.close()


@contextmanager
def tracked(firmware: str = "AURORA Rev 013", **settings: Any) -> Iterator[tuple[Any, ...]]:
    with peer(firmware, **settings) as device, device.settings.device() as tracker:
        yield tracker, device.bench, device


def next_sample(tracker: AuroraTracker) -> PoseSample:
    tracker.read()
    found: list[PoseSample] = []
    wait_for(lambda: found.extend(tracker.read()) or found)
    return found[-1]


class Line:
    """A terminal without any library: the peer's other end."""

    def __init__(self, path: str) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.set_speed(termios.B9600)

    def set_speed(self, speed: int) -> None:
        attributes = termios.tcgetattr(self.fd)
        attributes[4] = attributes[5] = speed
        termios.tcsetattr(self.fd, termios.TCSANOW, attributes)

    def send(self, command: str, crc: int | None = None) -> bytes:
        data = command.encode()
        if ":" in command:
            data += f"{reference_crc(data) if crc is None else crc:04X}".encode()
        os.write(self.fd, data + b"\r")
        reply = b""
        while select.select([self.fd], [], [], 0.1 if reply else 0.5)[0]:
            reply += os.read(self.fd, 4096)
            if reply.endswith(b"\r") and not reply.startswith(b"\xc4\xa5"):
                break
        return reply

    def text(self, command: str) -> str:
        reply = self.send(command)
        assert reply.endswith(f"{reference_crc(reply[:-5]):04X}\r".encode())
        return reply[:-5].decode()


@pytest.fixture
def line() -> Iterator[tuple[Line, FakeBench, AuroraPeer]]:
    with peer() as device:
        end = Line(device.settings.port)
        try:
            yield end, device.bench, device
        finally:
            os.close(end.fd)


# The peer ----------------------------------------------------------------------------------------


def test_crc_is_that_of_the_protocol() -> None:
    assert crc16(b"INIT:") == 0xE3A5
    assert crc16(b"OKAY") == 0xA896
    assert crc16(bytes(range(256))) == reference_crc(bytes(range(256)))


def start(line: Line) -> None:
    for command in ("INIT:", "PINIT:0A", "PENA:0AD", "TSTART:"):
        assert line.text(command) == "OKAY"


def test_peer_sets_up_as_a_device(line: tuple[Line, FakeBench, AuroraPeer]) -> None:
    end, _, _ = line
    assert end.send("INIT:") == b"OKAYA896\r"
    assert end.text("VER 0").startswith("Northern Digital Inc.\nAurora")
    assert end.text("PHSR:02") == "010A001"
    assert end.text("PENA:0AD") == "ERROR0E"  # not initialised
    assert end.text("PINIT:0A") == "OKAY"
    assert end.text("PHSR:03") == "010A011"
    assert end.text("PENA:0AX") == "ERROR09"
    assert end.text("PENA:0AD") == "OKAY"
    assert (end.text("PHSR:02"), end.text("PHSR:04")) == ("00", "010A031")
    assert len(end.text("PHINF:0A0001")) == 33
    assert end.text("TX:0001") == "ERROR0C"  # it does not track
    assert end.text("TSTART:") == "OKAY"
    assert end.text("PENA:0AD") == "ERROR0C"  # it tracks
    assert end.text("TSTOP:") == "OKAY"


@pytest.mark.parametrize(
    ("command", "crc", "error"),
    [
        ("INIT:", 0x1234, "ERROR04"),
        ("TX:0001", None, "ERROR10"),
        ("NONSENSE:", None, "ERROR01"),
        ("COMM:90000", None, "ERROR07"),
    ],
)
def test_peer_refuses(
    line: tuple[Line, FakeBench, AuroraPeer], command: str, crc: int | None, error: str
) -> None:
    assert line[0].send(command, crc)[:-5].decode() == error


def test_peer_refuses_handles_it_does_not_have(
    line: tuple[Line, FakeBench, AuroraPeer],
) -> None:
    assert line[0].text("INIT:") == "OKAY"
    assert line[0].text("PINIT:0B") == "ERROR08"
    assert line[0].text("PINIT:ZZ") == "ERROR07"


def test_peer_writes_frames_as_text(line: tuple[Line, FakeBench, AuroraPeer]) -> None:
    end, bench, _ = line
    start(end)
    bench.frozen, bench.quaternion = 0x1A2B, (0.5, -0.5, 0.5, -0.5)
    expected = "010A+05000-05000+05000-05000+001230-004560-015120+010000000003100001A2B\n0000"
    assert end.text("TX:0001") == expected
    bench.position = (np.nan,) * 3
    assert end.text("TX:0801") == "010AMISSING0000003100001A2B\n0000"


def test_peer_writes_frames_in_binary(line: tuple[Line, FakeBench, AuroraPeer]) -> None:
    end, bench, _ = line
    start(end)
    bench.frozen = 7
    reply = end.send("BX:0001")
    begin, length, header_crc = struct.unpack_from("<HHH", reply)
    assert (begin, length + 8) == (0xA5C4, len(reply))
    assert header_crc == reference_crc(reply[:4])
    body, (body_crc,) = reply[6:-2], struct.unpack("<H", reply[-2:])
    assert body_crc == reference_crc(body)
    count, handle, state, *numbers, port_status, frame, system = struct.unpack("<BBB8fIIH", body)
    assert (count, handle, state, port_status, frame, system) == (1, 0x0A, 1, 0x31, 7, 0)
    assert numbers[:4] == pytest.approx(TURN, abs=1e-6)
    assert numbers[4:7] == pytest.approx(np.array(PLACE) * 1e3, abs=1e-4)
    bench.position = (np.nan,) * 3
    assert struct.unpack("<BBBIIH", end.send("BX:0001")[6:-2]) == (1, 0x0A, 2, 0x31, 7, 0)


def test_peer_repeats_a_frame_until_the_next(line: tuple[Line, FakeBench, AuroraPeer]) -> None:
    end, _, _ = line
    start(end)
    numbers: list[int] = []
    deadline = time.monotonic() + 60  # on a busy machine an answer may take longer than a frame
    while len(set(numbers)) < 4 or len(numbers) == len(set(numbers)):
        numbers.append(int(end.text("TX:0001")[-13:-5], 16))
        assert time.monotonic() < deadline, "no frame came twice"
    assert np.all(np.diff(numbers) >= 0)


def test_peer_hears_only_its_own_speed(line: tuple[Line, FakeBench, AuroraPeer]) -> None:
    end, _, _ = line
    assert end.text("INIT:") == "OKAY"
    assert end.text("COMM:50000") == "OKAY"
    assert end.send("INIT:") == b""  # the device is at 115200 by now, this end is not
    end.set_speed(termios.B115200)
    assert end.text("INIT:") == "OKAY"


def test_peer_serves_another_driver() -> None:
    """scikit-surgerynditracker, which lets ndicapi find the device, sees the same pose."""
    if importlib.util.find_spec("sksurgerynditracker") is None:
        pytest.skip("scikit-surgerynditracker is not installed")
    script = """
        import sys
        from sksurgerynditracker.nditracker import NDITracker
        tracker = NDITracker(
            {"tracker type": "aurora", "serial port": sys.argv[1], "use quaternions": True}
        )
        tracker.start_tracking()
        print(*tracker.get_frame()[3][0].ravel())
        tracker.close()
    """
    with peer() as device:
        ran = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script), device.settings.port],
            capture_output=True,
            text=True,
            timeout=30,
        )
    seen = [float(number) for number in ran.stdout.split("\n")[-2].split()]
    assert seen == pytest.approx([*TURN, *(np.array(PLACE) * 1e3)], abs=1e-3)


# The driver --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("firmware", "settings", "resolution"),
    [
        ("AURORA Rev 013", {}, 1e-8),
        ("AURORA Rev 007", {}, 1e-5),
        ("AURORA Rev 013", {"reply": "text", "baud": 9600}, 1e-5),
        ("AURORA Rev 007", {"reply": "binary", "outside_volume": True}, 1e-8),
        ("AURORA Rev 013", {"sensor": 3}, 1e-8),
    ],
)
def test_reads_either_kind_of_reply(
    firmware: str, settings: dict[str, Any], resolution: float
) -> None:
    place = np.array(PLACE) + 3e-6  # which text cannot say
    with tracked(firmware, **settings) as (tracker, bench, _):
        bench.position = place
        time.sleep(0.1)
        sample = next_sample(tracker)
    assert sample.position == pytest.approx(place, abs=resolution)
    assert (np.abs(sample.position - place).max() > 1e-6) == (resolution == 1e-5)
    assert sample.quaternion == pytest.approx(TURN, abs=1e-4)


def test_all_frames_come_once() -> None:
    with tracked() as (tracker, _, _):
        next_sample(tracker)
        began = time.monotonic()
        numbers: list[int] = []
        wait_for(lambda: numbers.extend(s.frame for s in tracker.read()) or len(numbers) >= 20)
        assert np.array_equal(np.diff(numbers), np.ones(len(numbers) - 1))
        assert time.monotonic() - began == pytest.approx(0.5, abs=0.2)
        assert tracker.errors == 0


class ShiftedClock(SystemClock):
    def now(self) -> float:
        return super().now() - 1e5

    def sleep_until(self, moment: float) -> None:
        super().sleep_until(moment + 1e5)


def test_times_are_on_the_given_clock_and_before_the_latency() -> None:
    clock = ShiftedClock()
    with peer(latency=0.05) as device, device.settings.device(clock) as tracker:
        sample = next_sample(tracker)
        assert sample.received <= clock.now()
        assert 0.05 <= sample.received - sample.time < 0.09


def test_a_slow_reply_makes_the_pose_old() -> None:
    with tracked() as (tracker, bench, _):
        bench.faults["tracker"] = "slow"
        time.sleep(0.5)
        sample = next_sample(tracker)
        assert 0.2 <= sample.received - sample.time < 0.5
        assert tracker.errors == 0


def test_what_is_out_of_range_is_not_believed() -> None:
    with tracked(range=1.0) as (tracker, bench, _):
        assert next_sample(tracker).visible
        bench.position = (0.0, 0.9, -0.9)
        wait_for(lambda: not next_sample(tracker).visible)
        assert tracker.out_of_range > 0
        bench.position = (0.0, 0.9, 0.0)
        wait_for(lambda: next_sample(tracker).visible)


def test_bad_checksums_are_counted_and_survived() -> None:
    with tracked() as (tracker, _, device):
        next_sample(tracker)
        device.garble = True
        wait_for(lambda: tracker.errors >= 5)
        assert "CRC" in tracker.last_error
        time.sleep(0.1)
        tracker.read()
        time.sleep(0.1)
        assert tracker.read() == ()
        device.garble = False
        process = tracker._process
        assert next_sample(tracker).visible
        assert tracker._process is process


def test_a_silent_device_is_connected_anew() -> None:
    with tracked(reconnect_after=0.4) as (tracker, bench, _):
        last = next_sample(tracker).frame
        bench.faults["tracker"] = "off"
        process = tracker._process
        wait_for(lambda: tracker._process is not process)
        began = time.perf_counter()
        assert all(sample.frame >= last for sample in tracker.read())
        assert time.perf_counter() - began < 0.05
        assert "lost" in tracker.last_error
        bench.faults.clear()
        assert next_sample(tracker).frame > last


def test_a_lost_reply_costs_little_time() -> None:
    with tracked() as (tracker, bench, _):
        next_sample(tracker)
        bench.faults["tracker"] = "off"
        wait_for(lambda: tracker.age() > 0.15)
        bench.faults.clear()
        wait_for(lambda: tracker.age() < 0.1, 1.5)  # the library would wait 5 s
        assert tracker.errors >= 1


def test_frame_numbers_grow_when_the_device_counts_anew() -> None:
    with tracked() as (tracker, bench, _):
        last = next_sample(tracker).frame
        bench._began = time.monotonic()
        samples: list[PoseSample] = []
        wait_for(lambda: samples.extend(tracker.read()) or len(samples) > 4)
        assert np.all(np.diff([last, *(sample.frame for sample in samples)]) > 0)


def test_a_device_that_was_unplugged_comes_back(tmp_path: Path) -> None:
    port = tmp_path / "tracker"
    with peer() as first:
        port.symlink_to(first.settings.port)
        settings = first.settings.model_copy(update={"port": str(port)})
        tracker = settings.device()
        tracker.open()
        next_sample(tracker)
    try:
        wait_for(lambda: "lost" in tracker.last_error or "no port" in tracker.last_error)
        with peer() as second:
            port.unlink()
            port.symlink_to(second.settings.port)
            assert next_sample(tracker).visible
    finally:
        tracker.close()


def test_a_crash_of_the_reader_is_survived() -> None:
    with tracked() as (tracker, _, _):
        last = next_sample(tracker).frame
        os.kill(tracker._process.pid, signal.SIGSEGV)
        wait_for(lambda: tracker.errors)
        assert next_sample(tracker).frame > last


def test_closing_is_prompt_while_the_device_is_looked_for() -> None:
    with peer(reconnect_after=0.3) as device:
        tracker = device.settings.device()
        tracker.open()
        next_sample(tracker)
        device.bench.faults["tracker"] = "off"
        process = tracker._process
        wait_for(lambda: tracker._process is not process)
        process = tracker._process
        time.sleep(0.3)  # the library waits for an answer to INIT
        began = time.monotonic()
        tracker.close()
        assert time.monotonic() - began < 1.2
        assert process is not None
        assert process.poll() is not None


def test_closing_ends_a_reader_that_hangs() -> None:
    with peer() as device:
        tracker = device.settings.device()
        tracker.open()
        process = tracker._process
        assert process is not None
        process.send_signal(signal.SIGSTOP)
        began = time.monotonic()
        tracker.close()
        assert time.monotonic() - began < 1.2
        assert process.poll() is not None


def test_the_reader_ends_when_nobody_needs_it_though_the_library_waits() -> None:
    settings = {"port": "", "baud": 115200, "likely_baud": 9600}
    with stranger(b"") as port:
        command = [sys.executable, ndi_reader.__file__, json.dumps({**settings, "port": port})]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
            time.sleep(0.4)
            assert reader.poll() is None
            assert reader.stdin is not None
            reader.stdin.close()
            reader.wait(2)


def test_the_reader_does_not_outlive_its_owner() -> None:
    script = """
        import os, sys
        from stiffopt.rig.drivers.aurora import AuroraSettings
        tracker = AuroraSettings(driver="aurora", port=sys.argv[1]).device()
        tracker.open()
        print(tracker._process.pid, flush=True)
        os._exit(1)
    """
    with peer() as device:
        ran = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script), device.settings.port],
            stdout=subprocess.PIPE,
            text=True,
            timeout=30,
        )
        assert ran.returncode == 1
        wait_for(lambda: not runs(int(ran.stdout)), 2)


def test_ctrl_c_does_not_reach_the_reader() -> None:
    with tracked() as (tracker, _, _):
        assert os.getpgid(tracker._process.pid) != os.getpgid(0)


def runs(pid: int) -> bool:
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


# What cannot be opened ---------------------------------------------------------------------------


def refusal(settings: AuroraSettings) -> str:
    tracker = settings.device()
    threads = threading.active_count()
    began = time.monotonic()
    with pytest.raises(DeviceError) as error:
        tracker.open()
    assert time.monotonic() - began < 8
    assert not tracker.is_open
    assert threading.active_count() == threads
    return str(error.value)


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    port = str(tmp_path / "ttyUSB0")
    assert f"no port {port}" in refusal(AuroraSettings(driver="aurora", port=port))


def test_a_port_that_is_no_serial_port() -> None:
    message = refusal(AuroraSettings(driver="aurora", port="/dev/null"))
    assert "/dev/null is not a serial port" in message


def test_a_port_without_permission(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(ndi_reader.os, "open", refuse)
    with pytest.raises(ndi_reader.LostError, match=r"no permission to use /dev/ttyUSB0.*dialout"):
        ndi_reader.SerialPort("/dev/ttyUSB0")


def test_a_port_that_another_program_uses() -> None:
    with tracked() as (tracker, _, device):
        message = refusal(device.settings)
        assert f"{device.settings.port} cannot be opened" in message
        assert "another program" in message
        assert next_sample(tracker).visible  # and the other program is not disturbed


@contextmanager
def stranger(reply: bytes) -> Iterator[str]:
    """Something else on a serial port."""
    master, slave = os.openpty()
    tty.setraw(slave)
    stopping = threading.Event()

    def answer() -> None:
        while not stopping.is_set():
            if select.select([master], [], [], 0.05)[0]:
                os.read(master, 4096)
                os.write(master, reply)

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        stopping.set()
        thread.join()
        os.close(master)
        os.close(slave)


def test_another_device() -> None:
    with stranger(b"@01 0 RJ IDLE -- BADCOMMAND\r") as port:
        message = refusal(AuroraSettings(driver="aurora", port=port))
    assert f"no NDI tracker answers at {port}; check" in message


def test_a_device_that_is_silent() -> None:
    with stranger(b"") as port:
        message = refusal(AuroraSettings(driver="aurora", port=port, connect_timeout=1))
    assert f"no NDI tracker answers at port {port} within 1 s" in message


def test_a_sensor_that_is_not_plugged_in() -> None:
    with peer() as device:
        message = refusal(device.settings.model_copy(update={"sensor": 2}))
    assert "no sensor 2 (port handles: 0A)" in message


class Port:
    def __init__(self, device: str, vid: int | None, pid: int | None) -> None:
        self.device, self.vid, self.pid = device, vid, pid


def test_the_port_is_found_by_its_maker(monkeypatch: pytest.MonkeyPatch) -> None:
    from serial.tools import list_ports

    ports = [Port("/dev/ttyUSB0", 0x0403, 0x6001), Port("/dev/ttyS0", None, None)]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    with pytest.raises(ndi_reader.LostError, match=r"the ports here are /dev/ttyS0, /dev/ttyUSB0"):
        ndi_reader.find_port()
    ports.append(Port("/dev/ttyUSB1", 0x0403, 0xDA74))
    assert ndi_reader.find_port() == "/dev/ttyUSB1"
    ports.append(Port("/dev/ttyUSB2", 0x23F2, 0x0003))
    with pytest.raises(ndi_reader.LostError, match="several NDI devices"):
        ndi_reader.find_port()


def test_a_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stiffopt.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"ndicapi.*stiffopt\[aurora\]"):
        AuroraSettings(driver="aurora").device().open()


@pytest.mark.parametrize(
    "wrong", [{"sensor": 0}, {"baud": 1234}, {"port": ""}, {"latency": -1}, {"range": 0}]
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        AuroraSettings(driver="aurora", **wrong)
