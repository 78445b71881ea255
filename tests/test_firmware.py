"""The open regulator's firmware: its logic on this machine, and what it is built to."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from board_host import (
    ARM,
    ERROR,
    IDENTITY,
    LIMITS,
    READ,
    SET,
    STATISTICS,
    VENT,
    Report,
    command,
    crc16,
    frame_of,
    stuffed,
    unstuffed,
)
from conftest import is_long
from firmware_loop import FIRMWARE, Loop, make
from stiffopt.rig.drivers import open_regulator_line as driver

PAGE = FIRMWARE.parent / "docs" / "open-regulator.md"
SUPPLY, VENTED, RANGE, EXPIRED, FAULTY, ARMED = 0, 6, 4, 5, 7, 8
POWER_ON, ASKED, SILENCE, BAD_SENSOR, ABOVE_LIMIT, NOT_FOLLOWING, STUCK = 1, 5, 6, 7, 8, 9, 10


@pytest.fixture(scope="session")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The logic of both kinds of board: 3 channels with pairs of valves, 6 with 3-way valves."""
    folder = tmp_path_factory.mktemp("logic")
    return {
        3 if pairs else 6: make(folder / str(pairs), "loop.so", PAIRS=pairs) for pairs in (0, 1)
    }


@pytest.fixture(params=[3, 6])
def board(request: pytest.FixtureRequest, libraries: dict[int, Path]) -> Loop:
    return Loop(libraries[request.param])


def error_of(answer: tuple[int, bytes]) -> int:
    kind, payload = answer
    assert kind == ERROR, answer
    return payload[0]


def limits(board: Loop, most: int, slew: int = 200) -> bytes:
    return struct.pack(f"<H{board.n}h", slew, *[most] * board.n)


# frames ------------------------------------------------------------------------------------------


def test_the_crc_is_the_catalogues() -> None:
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE (IBM-3740)


def test_the_examples_of_the_page(board: Loop) -> None:
    """Byte by byte, so that who writes another host or board can check his own."""
    examples = dict(re.findall(r"^(request|answer): +([0-9A-F ]+)$", PAGE.read_text(), re.M))
    request, answer = (bytes.fromhex(examples[name]) for name in ("request", "answer"))
    assert request == frame_of(READ, sequence=7)
    assert driver.framed(bytes((1, 1, 7, READ))) == b"\0" + request
    fresh = Report(20, 0, POWER_ON, 0, 0, (0, 0, 0), (0, 0, 0))
    body = bytes((1, 1, 7, READ | 0x80)) + struct.pack("<IBBBh6h", 20, 0, 1, 0, 0, *[0] * 6)
    assert driver.Status.of(body[4:]).time == fresh.time
    assert answer == stuffed(body + struct.pack("<H", crc16(body)))


def test_frames_of_driver_and_test_agree() -> None:
    rng = np.random.default_rng(5)
    for length in range(50):
        payload = bytes(rng.choice([0, 0, 1, 255, 7], length).astype(np.uint8))
        frame = frame_of(SET, payload, sequence=9)
        assert driver.framed(bytes((1, 1, 9, SET)) + payload) == b"\0" + frame
        assert driver.body_of(frame[:-1]) == bytes((1, 1, 9, SET)) + payload
        assert unstuffed(frame[:-1])[4:-2] == payload
        spoilt = bytearray(frame[:-1])
        spoilt[rng.integers(len(spoilt))] ^= 1 << rng.integers(8)
        assert driver.body_of(bytes(spoilt)) is None


def test_what_is_spoilt_is_not_answered_and_counted(board: Loop) -> None:
    good = frame_of(READ)
    for place in range(len(good) - 1):
        for bit in range(8):
            spoilt = bytearray(good)
            spoilt[place] ^= 1 << bit
            assert board.send(bytes(spoilt)) == []
    assert board.send(good[:-2]) == board.send(b"\0") == []  # a byte was lost
    assert board.send(b"\x05" * 300 + b"\0") == []
    assert board.send(b"\0\0\0" + good + good[:3]) != []  # zeros do no harm
    assert len(board.send(b"\0" + good)) == 1  # and end what was cut
    good_count, bad = struct.unpack_from("<HH", board.ask(STATISTICS)[1], 5)
    assert good_count == 3
    assert bad >= 8 * (len(good) - 1) + 3  # a zero among them ends a frame


def test_only_this_board_answers_and_in_its_own_version(board: Loop) -> None:
    assert board.send(frame_of(READ, board=2)) == []
    assert board.send(frame_of(READ, board=0)) == []
    for kind in (IDENTITY, VENT):  # whoever hears it
        assert len(board.send(frame_of(kind, board=0))) == 1
    kind, payload = board.ask(IDENTITY, version=9)
    assert kind == IDENTITY | 0x80
    identity = driver.Identity.of(1, payload)
    assert identity == driver.Identity(1, 1, "1.0", board.n, 0.1, 2e5, 2e6)
    assert error_of(board.ask(READ, version=2)) == 1
    assert error_of(board.ask(99)) == 2
    assert error_of(board.ask(READ, b"\0")) == 3
    assert error_of(board.ask(SET, bytes(5))) == 3
    assert struct.unpack_from("<H", board.ask(STATISTICS)[1], 9) == (4,)


# commands ----------------------------------------------------------------------------------------


def test_it_starts_vented_and_takes_no_pressure_until_it_is_armed(board: Loop) -> None:
    start = board.report(READ)
    assert (start.armed, start.cause) == (0, POWER_ON)
    pressure = [5000] * board.n
    assert error_of(board.ask(SET, command(start, *pressure))) == VENTED
    assert not board.report(SET, command(start, *[0] * board.n)).armed  # nothing is always taken
    armed = board.report(ARM)
    assert armed.armed
    assert not any(armed.set_points)
    assert board.report(SET, command(armed, *pressure)).set_points == tuple(pressure)
    board.press(*[0.5] * board.n, ms=200)
    vented = board.report(VENT)
    assert (vented.armed, vented.cause, any(vented.set_points)) == (0, ASKED, False)
    assert error_of(board.ask(SET, command(vented, *pressure))) == VENTED
    assert board.run(200)[-1].max() < 0.01


def test_limits_are_enforced_on_the_board(board: Loop) -> None:
    for bad in (limits(board, 20001), limits(board, -1), limits(board, 1, 0)):
        assert error_of(board.ask(LIMITS, bad)) == RANGE
    assert error_of(board.ask(LIMITS, limits(board, 1, 201))) == RANGE
    kind, told = board.ask(LIMITS, limits(board, 8000, 30))
    assert (kind, told) == (LIMITS | 0x80, limits(board, 8000, 30))
    last = board.report(ARM)
    assert error_of(board.ask(LIMITS, limits(board, 9000))) == ARMED
    before = board.report(SET, command(last, *[7000] * board.n)).set_points
    for bad in (8001, -1, 32767, -32768):
        assert error_of(board.ask(SET, command(last, *[100] * (board.n - 1), bad))) == RANGE
        assert board.report(READ).set_points == before  # nothing of it was taken


@pytest.mark.parametrize("validity", [1, 2, 33, 100])
@pytest.mark.parametrize("age", [0, 10, 32])
def test_a_command_expires_with_what_the_host_knew(board: Loop, validity: int, age: int) -> None:
    known = board.report(ARM)
    board.run(age)
    answer = board.ask(SET, command(known, *[5000] * board.n, validity=validity))
    if age >= validity:
        assert error_of(answer) == EXPIRED
        return
    assert answer[0] == SET | 0x80
    while (last := board.report(READ)).armed:  # which does not make it last longer
        board.run(2)
    assert last.cause == SILENCE
    assert 0 <= last.time - known.time - validity <= 2


@pytest.mark.parametrize("validity", [0, 101, 65535])
def test_no_command_holds_for_longer_than_the_silence(board: Loop, validity: int) -> None:
    known = board.report(ARM)
    answer = board.ask(SET, command(known, *[100] * board.n, validity=validity))
    assert error_of(answer) == RANGE
    future = known._replace(time=known.time + 1000)
    assert error_of(board.ask(SET, command(future, *[100] * board.n))) == EXPIRED


def test_silence_vents_within_100_ms_and_empties_the_arm(board: Loop) -> None:
    board.report(ARM)
    board.press(*[1.0] * board.n, ms=400)
    last = board.report(READ)
    board.report(SET, command(last, *[10000] * board.n))
    assert board.run(98).min() > 0.98
    falling = board.run(300)
    assert board.report(READ).cause == SILENCE
    assert falling[-1].max() < 0.01
    assert struct.unpack_from("<H", board.ask(STATISTICS)[1], 11) == (1,)


# readings that are not believed -------------------------------------------------------------------


@pytest.mark.parametrize("counts", [1, 50, 973, 1023])
def test_a_broken_wire_vents_at_once(board: Loop, counts: int) -> None:
    for sensor in range(board.n + 1):  # the last one is that of the supply line
        board.report(ARM)
        board.press(*[0.5] * board.n, ms=60)
        board.force(sensor, counts)
        board.run(2)
        report = board.report(READ)
        assert (report.armed, report.cause, report.channel) == (0, BAD_SENSOR, sensor + 1)
        kind, payload = board.ask(ARM)
        assert (kind, payload[0]) == (ERROR, FAULTY)
        assert tuple(payload[4:6]) == (BAD_SENSOR, sensor + 1)
        board.force(sensor, 0)
        board.run(300)


def test_a_sensor_that_is_stuck_low_does_not_burst_the_arm(board: Loop) -> None:
    board.report(ARM)
    board.press(0.3, ms=200)
    board.force(0, 200)  # it shows 0.3 bar from now on, whatever happens
    highest = 0.0
    with suppress(AssertionError):  # some time the board refuses
        for _ in range(100):
            highest = max(highest, board.press(1.0, ms=20)[:, 0].max())
    report = board.report(READ)
    assert (report.cause, report.channel) == (STUCK, 1)
    assert highest < 0.8  # not even where it was told to go
    assert board.run(300)[-1, 0] < 0.01


def test_a_valve_that_is_stuck_open_vents_at_the_limit(board: Loop) -> None:
    board.ask(LIMITS, limits(board, 10000))
    board.report(ARM)
    board.press(0.9, ms=200)
    board.air.faults[0] = 1
    trace = board.run(90)[:, 0]
    report = board.report(READ)
    assert (report.cause, report.channel) == (ABOVE_LIMIT, 1)
    assert trace.max() < 1.0 + 0.05 + 0.35  # what flows in until the dump valve has acted
    assert board.run(500)[-1, 0] < 0.1  # through the check valve, past the stuck one


@pytest.mark.parametrize("what", ["supply", "leak"])
def test_a_pressure_that_is_not_reached_vents(board: Loop, what: str) -> None:
    board.report(ARM)
    board.press(0.5, ms=200)
    if what == "supply":
        board.air.source = 1.2
    else:
        board.air.leak[0] = 0.3
    with pytest.raises(AssertionError):
        board.press(1.5, ms=1500)
    assert board.report(READ).cause in (NOT_FOLLOWING, STUCK)
    assert board.report(READ).channel == 1


def test_pressure_that_does_not_leave_forbids_arming(board: Loop) -> None:
    board.force(0, 300)  # 0.6 bar
    board.run(600)
    kind, payload = board.ask(ARM)
    assert (kind, payload[0], payload[4]) == (ERROR, FAULTY, NOT_FOLLOWING)


# control ------------------------------------------------------------------------------------------

CONDITIONS: dict[str, dict[str, float]] = {
    "as configured": {},
    "noisy sensors": {"noise": 2.0},
    "supply of 2 bar": {"supply": 2.0},
    "supply of 3 bar": {"supply": 3.0},
    "supply sags": {"source_flow": 0.1},
    "leak": {"leak": 0.003},
    "greater leak": {"leak": 0.006},
    "dead volume of 1 ml": {"dead_volume": 0.001},
    "dead volume of 5 ml": {"dead_volume": 0.005},
    "weak valves": {"valve_flow": 0.17},
    "strong valves": {"valve_flow": 0.23},
    "quick valves": {"valve_lag": 0.003},
    "valves open early": {"offset": 2.0},
    "valves open late": {"offset": -2.0},
}
STEPS = ((0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (1.5, 1.0))


def step_response(board: Loop, before: float, after: float) -> tuple[float, float, float]:
    """Return settling time to 2 % in ms, overshoot as a share, and the highest rate in bar/s."""
    board.report(ARM)
    board.press(before, ms=1000)  # also for the supply line, which was vented
    trace = board.press(after, ms=300)[:, 0]
    height = abs(after - before)
    away = np.flatnonzero(np.abs(trace - after) > 0.02 * height)
    overshoot = max(0.0, float(((trace - after) * np.sign(after - before)).max())) / height
    return 2.0 * (away[-1] + 2), overshoot, float(np.abs(np.diff(trace)).max() / 0.002)


@pytest.mark.parametrize("n", [3, 6])
@pytest.mark.parametrize("name", CONDITIONS)
def test_half_a_bar_into_20_ml_settles_in_80_ms(
    libraries: dict[int, Path], name: str, n: int
) -> None:
    for before, after in STEPS:
        for seed in range(10 if is_long() else 2):
            board = Loop(libraries[n], seed=seed, **CONDITIONS[name])
            settled, overshoot, rate = step_response(board, before, after)
            assert settled <= 80.0, (before, after, seed)
            assert overshoot < 0.03, (before, after, seed)
            assert rate <= 20.0, (before, after, seed)


@pytest.mark.parametrize("slew", [10, 50, 100])
def test_the_slew_limit_is_kept(board: Loop, slew: int) -> None:
    board.ask(LIMITS, limits(board, 15000, slew))
    _, overshoot, rate = step_response(board, 0.2, 1.5)
    assert rate < 0.1 * slew * 1.05 + 0.2  # the noise of valves and sensors on top
    assert overshoot < 0.01


def test_all_channels_at_once_with_a_sagging_supply(libraries: dict[int, Path]) -> None:
    board = Loop(libraries[3], source_flow=0.1)
    board.report(ARM)
    board.press(*[0.5] * 3, ms=500)
    trace = board.press(*[1.0] * 3, ms=300)
    assert np.abs(trace[40:] - 1.0).max() < 0.01
    assert trace.max() < 1.0 + 0.03 * 0.5


@pytest.mark.parametrize("name", CONDITIONS)
@pytest.mark.parametrize("n", [3, 6])
def test_at_the_limit_nothing_is_exceeded(libraries: dict[int, Path], n: int, name: str) -> None:
    for most in (0.6, 1.2, 1.4):
        board = Loop(libraries[n], **CONDITIONS[name])
        board.ask(LIMITS, limits(board, round(most * 1e4)))
        board.report(ARM)
        trace = board.press(*[most] * n, ms=1200)  # all channels at once
        assert trace.max() < most
        assert trace[-100:].min() > most - 0.03


@pytest.mark.parametrize("volume", [0.005, 0.01, 0.03, 0.05])
def test_it_is_stable_with_other_volumes(board: Loop, volume: float) -> None:
    for channel in range(6):
        board.air.volume[channel] = volume
    board.report(ARM)
    board.press(*[0.5] * board.n, ms=1000)
    trace = board.press(*[1.0] * board.n, ms=1500)
    assert np.abs(trace[-200:] - 1.0).max() < 0.012


# builds -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fuzzers(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the fuzzers of both kinds of board; skip where they cannot be built."""
    return [make(tmp_path_factory.mktemp("fuzz"), "fuzz", PAIRS=pairs) for pairs in (0, 1)]


@pytest.mark.parametrize("pairs", [0, 1])
def test_the_parser_stands_random_bytes_under_sanitizers(fuzzers: list[Path], pairs: int) -> None:
    fuzz = fuzzers[pairs]
    seeds, rounds = (20, 3_000_000) if is_long() else (1, 250_000)
    for seed in range(seeds):
        done = subprocess.run([fuzz, str(seed), str(rounds)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.usefixtures("fuzzers")
def test_the_fuzzer_finds_a_fault_that_is_put_in(tmp_path: Path) -> None:
    sources = tmp_path / "firmware"
    shutil.copytree(FIRMWARE, sources, ignore=shutil.ignore_patterns("build"))
    parser = sources / "src" / "protocol.c"
    text = parser.read_text()
    assert "if (end > length - from + 1) return 0;" in text
    parser.write_text(text.replace("if (end > length - from + 1) return 0;", ""))
    command = ["make", "--silent", "-C", str(sources), "fuzz", f"BUILD={tmp_path / 'bad'}"]
    subprocess.run(command, check=True)
    done = subprocess.run([tmp_path / "bad" / "fuzz", "0", "500000"], capture_output=True)
    assert done.returncode != 0


@pytest.mark.parametrize("pairs", [0, 1])
def test_it_fits_the_microcontroller(tmp_path: Path, pairs: int) -> None:
    if shutil.which("avr-gcc") is None:
        pytest.skip("avr-gcc is not installed; install gcc-avr and avr-libc")
    make(tmp_path, "all", PAIRS=pairs)
    size = subprocess.run(
        ["avr-size", tmp_path / "regulator.elf"], capture_output=True, text=True, check=True
    )
    text, data, bss = map(int, size.stdout.splitlines()[1].split()[:3])
    assert text + data < 16_384  # of 32 768
    assert data + bss < 1024  # of 2048: the rest is stack
    assert (tmp_path / "regulator.hex").read_text().startswith(":")


def test_driver_page_and_firmware_agree_on_codes() -> None:
    header = (FIRMWARE / "src" / "protocol.h").read_text() + (
        FIRMWARE / "src" / "channel.h"
    ).read_text()
    page = PAGE.read_text()

    def names(first: str) -> list[str]:
        found: Any = re.search(rf"\{{[^{{}}]*\b{first} = 1,([^{{}}]*)\}}", header)
        return [first, *re.findall(r"\w+", re.sub(r"//.*", "", found[1]))]

    requests, causes, errors = names("IDENTITY"), names("POWER_ON"), names("BAD_VERSION")
    assert [getattr(driver, name) for name in requests] == list(range(1, len(requests) + 1))
    assert sorted(driver._CAUSES) == list(range(1, len(causes) + 1))
    assert sorted([*driver._ERRORS, driver.IS_VENTED]) == list(range(1, len(errors) + 1))
    for family in (requests, causes, errors):
        for code, name in enumerate(family, start=1):
            assert re.search(rf"^\| {code} \| `{name.lower()}` \|", page, re.M), (code, name)
    assert f"version {driver.VERSION}" in page
