"""The probe: the real zaber-motion and nidaqmx, against a stage and a sensor of our own."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from fake_bench import FakeBench
from stiffopt.errors import CommandError, DeviceError, InputError, MissingExtraError
from stiffopt.lab.probe_peer import ProbePeer, ZaberPeer
from stiffopt.rig.drivers.probe import (
    ZaberProbe,
    ZaberProbeSettings,
    ZaberStage,
    ZaberStageSettings,
    ask_at_the_terminal,
)
from stiffopt.rig.interface import SystemClock

pytestmark = pytest.mark.real_time

ENDING = ("daq", "zaber", "Thread-")  # names of threads that must end with their peer
MICROSTEP = 0.047625e-6  # m; of the X-LSM100A, from its data sheet


def settings(stage: dict[str, Any] | None = None, **changes: Any) -> ZaberProbeSettings:
    data: dict[str, Any] = {
        "driver": "probe",
        "stage": {"max_speed": "50 mm/s", **(stage or {})},
        "force": {"channel": "Dev1/ai3", "sensitivity": "0.5 N/V", "tare_samples": 5},
    }
    return ZaberProbeSettings(**{**data, **changes})


@pytest.fixture
def bench() -> FakeBench:
    """A bench whose tip begins at 1 mm and has 100 N/m; the sensor is 0.2 N off."""
    made = FakeBench()
    made.force_at = lambda x: 0.2 + max(0.0, 100.0 * (x - 0.001))
    return made


class Rig:
    """A probe, its peers, and what it asked a person to do."""

    def __init__(self, made: ZaberProbeSettings, bench: FakeBench, *, homed: bool = True) -> None:
        self.said: list[str] = []
        self.peer = ProbePeer(made, bench, homed=homed)
        self.settings = self.peer.start()
        probe = self.settings.device(prompt=self.said.append)
        assert isinstance(probe, ZaberProbe)
        self.probe = probe

    def close(self) -> None:
        self.probe.close()
        self.peer.close()
        self.peer.close()


@pytest.fixture
def started(bench: FakeBench) -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(made: ZaberProbeSettings | None = None, *, homed: bool = True) -> Rig:
        rigs.append(Rig(made or settings(), bench, homed=homed))
        return rigs[-1]

    yield make
    bench.faults.clear()
    for rig in rigs:
        rig.close()
    give_up = time.monotonic() + 5.0
    while left := [t.name for t in threading.enumerate() if t.name.startswith(ENDING)]:
        assert time.monotonic() < give_up, left
        time.sleep(0.01)


@pytest.fixture
def aligned(started: Callable[..., Rig]) -> ZaberProbe:
    probe = started().probe
    probe.open()
    probe.align([1, 0, 0])
    return probe


# moves ----------------------------------------------------------------------------------------


def test_it_moves_and_feels(aligned: ZaberProbe, bench: FakeBench) -> None:
    began = time.monotonic()
    aligned.move_to(0.006, 0.02)
    assert 0.25 < time.monotonic() - began < 2.0  # 6 mm at 20 mm/s take 0.3 s
    assert bench.stage_position == pytest.approx(0.006, abs=MICROSTEP)
    sample = aligned.sample()
    assert sample.position == pytest.approx(0.006, abs=MICROSTEP)
    assert sample.force == pytest.approx(0.5, abs=1e-4)  # 5 mm at 100 N/m, tared
    assert 0 <= aligned.clock.now() - sample.time < 5
    aligned.move_to(-0.002, 0.05)
    assert aligned.sample().force == pytest.approx(0.0, abs=1e-9)
    assert aligned.sample().position == pytest.approx(-0.002, abs=MICROSTEP)


@pytest.mark.parametrize("sign", [1, -1])
def test_native_units_on_the_wire(bench: FakeBench, sign: int) -> None:
    lines: list[str] = []
    made = settings({"towards_tip": sign, "travel": ["10 mm", "90 mm"]})
    peer = ProbePeer(made, bench)
    reply = peer._stage._reply
    peer._stage._reply = lambda line: (lines.append(line), reply(line))[1]  # type: ignore
    probe = peer.start().device(prompt=lambda request: None)
    with probe:
        probe.align([0, 0, 1])
        probe.move_to(0.004, 0.01)
        assert probe.sample().position == pytest.approx(0.004, abs=MICROSTEP)
    peer.close()
    words = next(line for line in lines if "move abs" in line).split(":")[0].split()
    place, speed = (float(word) for word in words[-2:])
    # The middle of 10 to 90 mm is 50 mm, and 1 mm is 20997.375... microsteps.
    assert place == pytest.approx((50 + sign * 4) / 0.000047625, abs=1)
    assert speed == pytest.approx(10 / 0.000047625 * 1.6384, abs=1)
    assert speed <= 10 / 0.000047625 * 1.6384


@pytest.mark.parametrize(
    ("position", "speed", "message"),
    [
        (0.0501, 0.01, "the stage would be at 100.1 mm; it may be moved from 0 to 100 mm"),
        (-0.0501, 0.01, "the stage would be at -0.0999"),
        (float("nan"), 0.01, "nan mm"),
        (float("inf"), 0.01, "inf mm"),
        (0.001, 0.051, "51 mm/s is out of range; the stage may move at up to 50 mm/s"),
        (0.001, 0.0, "0 mm/s is out of range"),
        (0.001, -0.01, "-10 mm/s"),
        (0.001, float("nan"), "nan mm/s"),
    ],
)
def test_moves_that_are_refused(
    aligned: ZaberProbe, bench: FakeBench, position: float, speed: float, message: str
) -> None:
    with pytest.raises(CommandError) as caught:
        aligned.move_to(position, speed)
    assert message in str(caught.value)
    assert bench.stage_position == 0
    assert not bench.stage_moving


def test_it_does_not_move_before_it_is_aligned(started: Any, bench: FakeBench) -> None:
    rig = started()
    with pytest.raises(DeviceError, match="not open"):
        rig.probe.move_to(0.001, 0.01)
    rig.probe.open()
    with pytest.raises(CommandError, match="align it first"):
        rig.probe.move_to(0.001, 0.01)
    rig.probe.sample()
    assert not rig.said


def test_stop(aligned: ZaberProbe, bench: FakeBench) -> None:
    failed: list[BaseException] = []

    def move() -> None:
        try:
            aligned.move_to(0.004, 0.004)
        except DeviceError as error:
            failed.append(error)

    thread = threading.Thread(target=move, name="mover")
    thread.start()
    while bench.stage_position < 0.0005:
        time.sleep(0.002)
    aligned.stop()
    thread.join(timeout=5)
    assert not thread.is_alive()
    assert not bench.stage_moving
    assert bench.stage_position < 0.004
    assert "has stopped at" in str(failed[0])


# alignment ------------------------------------------------------------------------------------


def test_a_person_aligns_it(started: Any, bench: FakeBench) -> None:
    rig = started()
    with rig.probe as probe:
        bench.stage_move(0.0005, np.inf)  # the person turns the knob
        probe.align(np.array([0, -1, 0]))
        assert "along [0, -1, 0] in the base frame" in rig.said[0]
        sample = probe.sample()
        assert (sample.position, sample.force) == pytest.approx((0, 0), abs=1e-12)
        probe.move_to(0.001, 0.05)
        assert bench.stage_position == pytest.approx(0.0015, abs=2 * MICROSTEP)
        for bad in ([1, 0], [0, 0, 0], [1, 1, 0], [float("nan"), 0, 0]):
            with pytest.raises(CommandError, match="of length 1"):
                probe.align(bad)
        assert len(rig.said) == 1


def test_a_person_takes_it_away(aligned: ZaberProbe, started: Any, bench: FakeBench) -> None:
    said: list[str] = []
    aligned._prompt = said.append
    aligned.move_to(0.003, 0.05)
    aligned.withdraw()
    assert said == ["take the probe out of the arm's reach"]
    assert bench.stage_position == pytest.approx(0, abs=MICROSTEP)
    with pytest.raises(CommandError, match="align it first"):
        aligned.move_to(0.001, 0.01)


def test_an_alignment_that_fails_is_none(started: Any, bench: FakeBench) -> None:
    rig = started()
    with rig.probe as probe:
        probe.align([1, 0, 0])
        bench.force_at = lambda x: 4.0  # of 5 N: it would saturate at 1 N more
        with pytest.raises(DeviceError, match=r"would saturate before it feels 2 N"):
            probe.align([0, 1, 0])
        with pytest.raises(CommandError, match="align it first"):
            probe.move_to(0.001, 0.01)


def test_the_terminal_is_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text) or "")
    ask_at_the_terminal("mount it")
    assert asked == ["mount it, then press Enter: "]

    def nobody(text: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", nobody)
    with pytest.raises(DeviceError, match="nobody is at the terminal"):
        ask_at_the_terminal("mount it")


# homing ---------------------------------------------------------------------------------------


def test_a_stage_that_is_lost_is_refused_or_homed(started: Any, bench: FakeBench) -> None:
    never = started(settings({"travel": ["0 mm", "20 mm"]}), homed=False)
    with pytest.raises(DeviceError, match=r"does not know where it is.*home: if_needed"):
        never.probe.open()
    assert not never.probe.is_open
    assert bench.stage_position == 0
    rig = started(settings({"travel": ["0 mm", "20 mm"], "home": "if_needed"}), homed=False)
    with rig.probe:
        assert "take the probe out of the arm's reach" in rig.said[0]
        assert bench.stage_position == pytest.approx(-0.01, abs=MICROSTEP)
        assert not bench.stage_moving


def test_the_sensor_is_tared_before_it_watches_over_homing(started: Any, bench: FakeBench) -> None:
    bench.force_at = lambda x: 2.5
    rig = started(settings({"travel": ["0 mm", "4 mm"], "home": "if_needed"}), homed=False)
    with rig.probe as probe:
        assert probe.sample().force == pytest.approx(0.0, abs=1e-12)
    assert bench.stage_position == pytest.approx(-0.002, abs=MICROSTEP)


def test_a_stage_that_meets_the_arm_while_it_homes_is_stopped(
    started: Any, bench: FakeBench
) -> None:
    bench.force_at = lambda x: -max(0.0, -1000.0 * (x + 0.003))
    rig = started(settings({"home": "if_needed"}), homed=False)
    with pytest.raises(DeviceError, match=r"the probe feels -.* N; at most 2 N"):
        rig.probe.open()
    assert -0.02 < bench.stage_position < -0.005
    assert not bench.stage_moving


# force ----------------------------------------------------------------------------------------


def test_too_much_force_stops_it(aligned: ZaberProbe, bench: FakeBench) -> None:
    with pytest.raises(DeviceError, match=r"the probe feels 2(\.\d+)? N; at most 2 N are allowed"):
        aligned.move_to(0.04, 0.02)
    assert not bench.stage_moving
    stopped = bench.stage_position
    assert 0.0209 < stopped < 0.025  # 2 N are felt at 21 mm
    with pytest.raises(DeviceError, match="only be moved away"):
        aligned.move_to(stopped + 0.001, 0.01)
    assert bench.stage_position == stopped
    aligned.move_to(0.015, 0.02)
    assert aligned.sample().force == pytest.approx(1.4, abs=1e-3)


def test_a_force_that_grows_while_it_backs_off_stops_it(
    aligned: ZaberProbe, bench: FakeBench
) -> None:
    with pytest.raises(DeviceError):
        aligned.move_to(0.04, 0.02)
    bench.force_at = lambda x: 0.2 + 2.1 + 100 * (0.021 - x)
    with pytest.raises(DeviceError, match="the probe feels"):
        aligned.move_to(0.0, 0.02)
    assert 0.01 < bench.stage_position < 0.021
    bench.force_at = lambda x: 0.2


def test_a_sensor_that_saturates_or_is_silent_stops_it(
    aligned: ZaberProbe, bench: FakeBench
) -> None:
    bench.force_at = lambda x: 0.2 if x < 0.002 else -99.0
    with pytest.raises(DeviceError, match=r"reads -10 V, the end of its range"):
        aligned.move_to(0.02, 0.02)
    assert not bench.stage_moving
    assert bench.stage_position < 0.01
    with pytest.raises(DeviceError, match="the end of its range"):
        aligned.sample()
    bench.force_at = lambda x: float("nan")
    with pytest.raises(DeviceError, match="the end of its range"):
        aligned.move_to(0.0, 0.02)


@pytest.mark.parametrize("kind", [KeyboardInterrupt, ZeroDivisionError])
def test_whatever_happens_in_a_move_stops_it(
    aligned: ZaberProbe, bench: FakeBench, kind: type[BaseException]
) -> None:
    def force(x: float) -> float:
        return 0.2

    read = aligned._input.read

    def interrupted() -> Any:
        if bench.stage_position > 0.002:
            raise kind
        return read()

    bench.force_at = force
    aligned._input.read = interrupted  # type: ignore[method-assign]
    with pytest.raises(kind):
        aligned.move_to(0.02, 0.02)
    assert not bench.stage_moving
    assert bench.stage_position < 0.01
    aligned._input.read = read  # type: ignore[method-assign]


# closing --------------------------------------------------------------------------------------


def test_close_backs_off_to_where_it_was_aligned(aligned: ZaberProbe, bench: FakeBench) -> None:
    def fail() -> None:
        with aligned:
            aligned.move_to(0.006, 0.05)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert bench.stage_position == pytest.approx(0, abs=MICROSTEP)
    assert not aligned.is_open
    aligned.close()


def test_close_never_moves_towards_the_tip(started: Any, bench: FakeBench) -> None:
    with started().probe as probe:
        probe.align([1, 0, 0])
        probe.move_to(-0.003, 0.05)
    assert bench.stage_position == pytest.approx(-0.003, abs=MICROSTEP)


def test_close_leaves_a_stage_that_nobody_has_aligned(started: Any, bench: FakeBench) -> None:
    with started().probe:
        bench.stage_move(0.005, 0.01)
        time.sleep(0.05)
    assert not bench.stage_moving
    assert 0 < bench.stage_position < 0.005


def test_close_when_nothing_answers(started: Any, bench: FakeBench) -> None:
    rig = started(settings(timeout="0.5 s"))
    rig.probe.open()
    rig.probe.align([1, 0, 0])
    rig.probe.move_to(0.002, 0.05)
    bench.faults["probe"] = "off"
    began = time.monotonic()
    rig.probe.close()
    assert time.monotonic() - began < 3.0
    assert not rig.probe.is_open


# failures -------------------------------------------------------------------------------------


def test_a_stage_that_falls_silent_while_it_moves(started: Any, bench: FakeBench) -> None:
    rig = started(settings(timeout="0.5 s"))
    rig.probe.open()
    rig.probe.align([1, 0, 0])
    began = time.monotonic()

    def force(x: float) -> float:
        if x > 0.001:
            bench.faults["probe"] = "off"
        return 0.2

    bench.force_at = force
    with pytest.raises(DeviceError, match=r"press the emergency stop if the stage still moves"):
        rig.probe.move_to(0.01, 0.02)
    assert time.monotonic() - began < 3.0
    bench.force_at = lambda x: 0.2


def test_a_stage_that_does_not_arrive(aligned: ZaberProbe, bench: FakeBench) -> None:
    bench.stage_move = lambda position, speed: None  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"has stopped at 50.0000 mm instead of 52.0000 mm"):
        aligned.move_to(0.002, 0.05)


def test_a_stage_that_never_rests(started: Any, bench: FakeBench) -> None:
    probe = started(settings(timeout="0.5 s")).probe
    probe.open()
    probe.align([1, 0, 0])
    bench.stage_move(0.02, 0.001)
    bench.stage_move = lambda position, speed: None  # type: ignore[method-assign]
    began = time.monotonic()
    with pytest.raises(DeviceError, match="takes too long"):
        probe.move_to(0.0005, 0.05)
    assert time.monotonic() - began < 5.0
    assert not bench.stage_moving
    del bench.stage_move


def test_a_slow_probe_still_works(started: Any, bench: FakeBench) -> None:
    with started().probe as probe:
        bench.faults["probe"] = "slow"
        assert probe.sample().position == pytest.approx(0, abs=MICROSTEP)
        bench.faults.clear()


def test_no_stage(started: Any) -> None:
    rig = started()
    stage = rig.settings.stage.model_copy(update={"port": 1})
    lost = rig.settings.model_copy(update={"stage": stage}).device()
    with pytest.raises(DeviceError, match=r"connecting to the stage at 127.0.0.1:1 failed.*refus"):
        lost.open()
    stage = ZaberStageSettings(serial="/dev/stiffopt-nothing")
    lost = rig.settings.model_copy(update={"stage": stage}).device()
    with pytest.raises(DeviceError, match=r"the stage at /dev/stiffopt-nothing failed"):
        lost.open()
    lost = rig.settings.model_copy(update={"stage": ZaberStageSettings()}).device()
    with pytest.raises(DeviceError, match="the stage has no address"):
        lost.open()
    assert not rig.peer._sensor._sessions  # nothing was left open


def test_a_stage_that_accepts_and_says_nothing(started: Any) -> None:
    rig = started()
    with socket.create_server(("127.0.0.1", 0)) as mute:
        stage = rig.settings.stage.model_copy(update={"port": mute.getsockname()[1]})
        lost = rig.settings.model_copy(update={"stage": stage, "timeout": 0.2}).device()
        began = time.monotonic()
        with pytest.raises(DeviceError, match=r"has not responded"):
            lost.open()
        assert time.monotonic() - began < 3.0


def test_a_port_that_takes_no_connection() -> None:
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        callers = [socket.socket() for _ in range(4)]  # more than can wait there
        for caller in callers:
            caller.setblocking(False)
            caller.connect_ex(full.getsockname())
        port = full.getsockname()[1]
        failed: list[DeviceError] = []

        def connect() -> None:
            try:
                ZaberStage(ZaberStageSettings(host="127.0.0.1", port=port), 0.3, SystemClock())
            except DeviceError as error:
                failed.append(error)

        thread = threading.Thread(target=connect, name="caller")
        thread.start()
        thread.join(2.0)
        in_time = not thread.is_alive()
        for caller in callers:
            caller.close()
    thread.join(30)  # what still waits is refused now
    assert in_time
    assert f"connecting to the stage at 127.0.0.1:{port} failed: no answer for 0.3 s" in str(failed)


def test_a_name_that_no_host_has() -> None:
    for host in ("stage.invalid", "a..b"):
        with pytest.raises(
            DeviceError, match=rf"connecting to the stage at {host}:55550 failed: \w"
        ):
            ZaberStage(ZaberStageSettings(host=host), 0.5, SystemClock())


def test_a_stage_that_takes_one_connection_at_a_time(
    started: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    attend, taken = ZaberPeer._attend, []

    async def take_one(self: ZaberPeer, reader: Any, writer: Any) -> None:
        taken.append(time.monotonic())
        if len(taken) == 1 or taken[-1] - taken[-2] > 0.05:  # it takes a moment to see the end
            await attend(self, reader, writer)
        else:
            writer.close()

    monkeypatch.setattr(ZaberPeer, "_attend", take_one)
    rig = started()
    with rig.probe as probe:
        assert probe.sample().position == pytest.approx(0, abs=MICROSTEP)
    assert len(taken) == 2


def test_no_sensor(started: Any) -> None:
    rig = started()
    force = rig.settings.force.model_copy(update={"grpc": "127.0.0.1:1"})
    with pytest.raises(DeviceError, match=r"opening Dev1/ai3 failed.*cannot be reached"):
        rig.settings.model_copy(update={"force": force}).device().open()


@pytest.mark.parametrize(
    ("module", "package"), [("zaber_motion.ascii", "zaber-motion"), ("nidaqmx", "nidaqmx")]
)
def test_without_the_library_the_error_names_the_extra(
    started: Any, monkeypatch: pytest.MonkeyPatch, module: str, package: str
) -> None:
    rig = started()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"{package}.*stiffopt\[probe\]"):
        rig.probe.open()


# the peer -------------------------------------------------------------------------------------


@pytest.fixture
def talk(bench: FakeBench) -> Iterator[Callable[[str], str]]:
    """Return what sends a line to an emulated stage and returns the answer."""
    peer = ZaberPeer(settings({"max_speed": "10 mm/s"}), bench, homed=False)
    stage = peer.start().stage
    with socket.create_connection((stage.host, stage.port), timeout=1) as connection:
        stream = connection.makefile("rw", newline="\r\n")

        def send(line: str) -> str:
            stream.write(f"{line}\n")
            stream.flush()
            try:
                return str(stream.readline())
            except TimeoutError:
                return ""

        yield send
        stream.close()
    peer.close()


def test_the_ascii_protocol(talk: Callable[[str], str], bench: FakeBench) -> None:
    # Formats and example of the checksum are those of Zaber's ASCII protocol manual.
    assert talk("/1 1 get pos") == "@01 1 OK IDLE WR 1049869\r\n"
    assert talk("/1 1 07 move abs 0") == "@01 1 07 RJ IDLE WR BADDATA\r\n"
    assert talk("/1 warnings") == "@01 0 OK IDLE WR 01 WR\r\n"
    assert talk("/1 1 home") == "@01 1 OK BUSY -- 0\r\n"
    assert talk("/1 1") == "@01 1 OK BUSY -- 0\r\n"
    assert talk("/1 1 stop") == "@01 1 OK IDLE NI 0\r\n"
    assert talk("/1 1 warnings clear") == "@01 1 OK IDLE NI 01 NI\r\n".replace("NI 01", "-- 01")
    assert talk("/1 1 warnings") == "@01 1 OK IDLE -- 00\r\n"
    assert talk("/1 1 move abs 99999999").split()[2:] == ["RJ", "IDLE", "--", "BADDATA"]
    assert talk("/1 1 move abs 5 999999999").split()[2:] == ["RJ", "IDLE", "--", "BADDATA"]
    assert talk("/1 1 move abs five").split()[2:] == ["RJ", "IDLE", "--", "BADDATA"]
    assert talk("/1 1 dance").split()[2:] == ["RJ", "IDLE", "--", "BADCOMMAND"]
    assert talk("/1 2 home").split()[2:] == ["RJ", "IDLE", "--", "BADAXIS"]
    assert talk("/01 1 get resolution").endswith(" 64\r\n")
    checked = talk("/1 1 get resolution:{:02X}".format(-sum(b"1 1 get resolution") & 255))
    body, checksum = checked.strip().lstrip("@").split(":")
    assert (sum(body.encode()) + int(checksum, 16)) % 256 == 0


def test_the_stage_ignores_damaged_and_foreign_lines(talk: Callable[[str], str]) -> None:
    assert talk("/1 1 home:00\n/2 1 home\nnoise\n/1 1").split()[3] == "IDLE"


def test_the_stage_in_use(bench: FakeBench) -> None:
    first = ZaberPeer(settings(), bench)
    stage = first.start().stage
    made = settings({"host": "127.0.0.1", "port": stage.port})
    second = ProbePeer(made, bench)
    with pytest.raises(DeviceError, match=rf"cannot listen on 127.0.0.1:{stage.port}.*in use"):
        second.start()
    second.close()
    first.close()
    again = ZaberPeer(made, bench)
    assert again.start().stage.port == stage.port
    again.close()


def test_a_program_that_forgets_to_close_ends(bench: FakeBench) -> None:
    """zaber-motion has threads of its own; they must not keep a program alive."""
    peer = ProbePeer(settings(), bench)
    made = peer.start()
    script = (
        "import sys\n"
        "from stiffopt.rig.drivers.probe import ZaberProbeSettings\n"
        "probe = ZaberProbeSettings.model_validate_json(sys.argv[1]).device(prompt=print)\n"
        "probe.open(); probe.align([1, 0, 0]); probe.move_to(0.001, 0.05)\n"
        "raise SystemExit(7)\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", script, made.model_dump_json(exclude_none=True)],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
        cwd=Path(__file__).parent,
    )
    peer.close()
    assert child.returncode == 7, child.stderr
    assert bench.stage_position == pytest.approx(0.001, abs=MICROSTEP)


# the rig file ---------------------------------------------------------------------------------

FORCE = {"channel": "Dev1/ai3", "sensitivity": "0.5 N/V"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_force": "6 N"}, r"max_force: the sensor saturates at 5 N|at 4.99 N|at 5 N"),
        ({"max_force": "0 N"}, "must be greater than 0"),
        ({"stage": {"host": "a", "serial": "/dev/ttyUSB0"}}, "one of 'host' and 'serial'"),
        ({"stage": {"travel": ["1 mm", "0 mm"]}}, "the first place must be below"),
        ({"stage": {"towards_tip": 0}}, "not one of"),
        ({"stage": {"home": "always"}}, "not one of"),
        ({"stage": {"max_speed": "1 m/s"}}, "must be at most 0.1"),
        ({"force": {**FORCE, "sensitivity": "0 N/V"}}, "must not be 0"),
        ({"force": {**FORCE, "sensitivity": "1 N"}}, "not a unit of force per voltage"),
        ({"force": {**FORCE, "channel": "Dev1/ao0"}}, "force.channel"),
        ({"force": {**FORCE, "range": ["5 V", "-5 V"]}}, "must be below"),
    ],
)
def test_a_bad_rig_file(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, ValidationError), match=message):
        settings(**changes) if "stage" not in changes else settings(changes["stage"])
