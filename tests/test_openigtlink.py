"""The OpenIGTLink driver against bytes made by hand, against pyigtl's own ends, and its peer."""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from fake_bench import FakeBench
from running import wait_for
from stiffopt.errors import DeviceError, InputError, MissingExtraError
from stiffopt.lab.openigtlink_peer import OpenIGTLinkPeer
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings, OpenIGTLinkTracker, SenderClock
from stiffopt.rig.interface import PoseSample

pytestmark = pytest.mark.real_time

PLACE = (0.0123, -0.0456, -0.1512)  # m
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z
ROOT = np.sqrt(0.5)


def crc64(data: bytes) -> int:
    """CRC-64 of ECMA-182, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & (2**64 - 1)
    return crc


def message(
    position: ArrayLike = PLACE,
    rotation: ArrayLike = QUARTER,
    *,
    name: str = "TipToTracker",
    kind: str = "TRANSFORM",
    stamp: float | None = None,
    crc: int | None = None,
    body: bytes | None = None,
) -> bytes:
    """Return a message of version 1, as the protocol's description has it."""
    if body is None:
        columns = (*np.array(rotation, dtype=float).T.ravel(), *(np.array(position) * 1e3))
        body = struct.pack(">12f", *columns)
    seconds, fraction = divmod(time.time() if stamp is None else stamp, 1)
    stamps = (int(seconds), int(fraction * 2**32))
    check = crc64(body) if crc is None else crc
    return (
        struct.pack(">H12s20sIIQQ", 1, kind.encode(), name.encode(), *stamps, len(body), check)
        + body
    )


class Server:
    """A server of one client, which sends what a test says."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.client: socket.socket | None = None

    def accept(self) -> None:
        self.listener.settimeout(5)
        self.client, _ = self.listener.accept()
        self.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        assert self.client is not None
        self.client.sendall(data)

    def close(self) -> None:
        if self.client is not None:
            self.client.close()
        self.listener.close()


def next_samples(tracker: OpenIGTLinkTracker, n: int = 1) -> list[PoseSample]:
    found: list[PoseSample] = []
    wait_for(lambda: found.extend(tracker.read()) or len(found) >= n)
    return found


@contextmanager
def connected(**settings: Any) -> Iterator[tuple[OpenIGTLinkTracker, Server]]:
    server = Server()
    options = {"driver": "openigtlink", "port": server.port, **settings}
    tracker = OpenIGTLinkSettings(**options).device()
    try:
        with tracker:
            server.accept()
            yield tracker, server
    finally:
        server.close()


@contextmanager
def tracked(**settings: Any) -> Iterator[tuple[OpenIGTLinkTracker, FakeBench, OpenIGTLinkPeer]]:
    bench = FakeBench()
    bench.position, bench.quaternion = PLACE, (ROOT, 0, 0, ROOT)
    peer = OpenIGTLinkPeer(OpenIGTLinkSettings(driver="openigtlink", **settings), bench)
    found = peer.start()
    try:
        with found.device() as tracker:
            yield tracker, bench, peer
    finally:
        peer.close()


# Bytes -------------------------------------------------------------------------------------------


def test_checksum_of_this_file() -> None:
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_a_pose_is_read_from_bytes() -> None:
    with connected() as (tracker, server):
        server.send(message())
        (sample,) = next_samples(tracker)
    assert sample.position == pytest.approx(PLACE, abs=1e-7)
    assert sample.quaternion == pytest.approx((ROOT, 0, 0, ROOT), abs=1e-6)


def test_a_message_may_come_in_parts() -> None:
    with connected() as (tracker, server):
        data = message()
        for part in (data[:20], data[20:61], data[61:] + message((0.01, 0, 0))):
            server.send(part)
            time.sleep(0.25)  # longer than a read waits
        first, second = next_samples(tracker, 2)
    assert first.position == pytest.approx(PLACE, abs=1e-7)
    assert second.position == pytest.approx((0.01, 0, 0), abs=1e-7)
    assert tracker.errors == 0


def test_other_messages_are_passed_over() -> None:
    with connected() as (tracker, server):
        server.send(message(name="ProbeToTracker"))
        server.send(message(kind="STATUS", body=b"x" * 77))
        server.send(message(name="Image", kind="IMAGE", body=b"y" * 100_000, crc=1))
        server.send(message())
        (sample,) = next_samples(tracker)
    assert sample.position == pytest.approx(PLACE, abs=1e-7)
    assert tracker.heard == {"ProbeToTracker", "TipToTracker", "Image"}
    assert tracker.errors == 0


def test_a_wrong_name_is_told_with_the_right_ones() -> None:
    with connected(name="TipToTrakcer") as (tracker, server):
        server.send(message())
        wait_for(lambda: tracker.last_error)
        assert "no TRANSFORM named TipToTrakcer" in tracker.last_error
        assert "it sends TipToTracker" in tracker.last_error
        assert tracker.read() == ()


@pytest.mark.parametrize(
    ("position", "rotation"),
    [
        ((np.nan, 0, 0), QUARTER),
        (PLACE, QUARTER * np.nan),
        (PLACE, QUARTER * 1.1),
        (PLACE, np.diag([1, 1, -1])),
        (PLACE, -np.eye(3)),
        (PLACE, np.eye(3)[[1, 0, 2]]),
        (PLACE, np.zeros((3, 3))),
        ((0, 0, np.inf), QUARTER),
    ],
)
def test_what_is_no_pose_is_not_visible(position: ArrayLike, rotation: ArrayLike) -> None:
    with connected() as (tracker, server):
        server.send(message(position, rotation))
        (sample,) = next_samples(tracker)
        assert not sample.visible
        assert sample.quaternion is None
        assert tracker.age() == np.inf
        server.send(message())
        assert next_samples(tracker)[0].visible


def test_what_is_out_of_range_is_not_visible() -> None:
    with connected(range="0.5 m") as (tracker, server):
        server.send(message((0.4, 0.4, 0)))
        assert not next_samples(tracker)[0].visible
        assert tracker.out_of_range == 1
        server.send(message((0.4, 0.2, 0)))
        assert next_samples(tracker)[0].visible


def test_damaged_messages_are_counted_and_skipped() -> None:
    with connected() as (tracker, server):
        spoilt = bytearray(message())
        spoilt[-3] ^= 0x10
        server.send(bytes(spoilt))
        server.send(message(body=b"short"))
        server.send(message((0.02, 0, 0), crc=0))  # from a sender that computes none
        (sample,) = next_samples(tracker)
        assert sample.position == pytest.approx((0.02, 0, 0), abs=1e-7)
        assert tracker.errors == 2
        assert "damaged" in tracker.last_error


def test_a_sample_sent_again_is_not_new() -> None:
    with connected() as (tracker, server):
        stamp = time.time()
        for _ in range(5):
            server.send(message(stamp=stamp))
        server.send(message((0, 0, 0.01), stamp=stamp + 0.025))
        samples = next_samples(tracker, 2)
        assert [sample.frame for sample in samples] == [1, 2]
        assert samples[1].position == pytest.approx((0, 0, 0.01), abs=1e-7)


def test_senders_without_a_clock() -> None:
    with connected(latency=0.03) as (tracker, server):
        for _ in range(3):
            server.send(message(stamp=0.0))
        for sample in next_samples(tracker, 3):
            assert sample.received - sample.time == pytest.approx(0.03, abs=0.02)


@pytest.mark.parametrize("offset", [-3600.0, 0.0, 7200.0])
def test_times_are_of_capture_whatever_the_sender_thinks_it_is(offset: float) -> None:
    latency = 0.03
    with connected(latency=latency) as (tracker, server):
        began = tracker.clock.now()
        captures = 0.025 * np.arange(12)
        for index, capture in enumerate(captures):
            wait = 0.06 if index in (4, 8) else 0.0  # these are held up on the way
            time.sleep(max(0.0, began + capture + wait - tracker.clock.now()))
            server.send(message(stamp=1e9 + offset + capture))
        samples = next_samples(tracker, 12)
    spent = np.array([sample.received - sample.time for sample in samples])
    times = np.array([sample.time for sample in samples])
    assert times - times[0] == pytest.approx(captures, abs=0.02)  # busy machines
    assert spent.min() >= latency - 1e-9
    assert spent[[4, 8]] == pytest.approx(latency + 0.06, abs=0.02)


def test_more_than_a_hundred_messages_a_second() -> None:
    with connected() as (tracker, server):
        for index in range(150):
            server.send(message((index * 1e-3, 0, 0), stamp=1e9 + index * 0.002))
            time.sleep(0.002)
        samples = next_samples(tracker, 150)
    places = [sample.position[0] for sample in samples]
    assert places == pytest.approx(np.arange(150) * 1e-3, abs=1e-6)


# The sender's clock ------------------------------------------------------------------------------


def test_a_delay_does_not_make_a_sample_younger() -> None:
    clock = SenderClock()
    assert clock.fastest_arrival(100.0, 5.010) == pytest.approx(5.010)
    assert clock.fastest_arrival(100.1, 5.105) == pytest.approx(5.105)  # faster: now the measure
    assert clock.fastest_arrival(100.2, 5.900) == pytest.approx(5.205, abs=2e-4)
    for late in range(40):  # all held up together, and then here at once
        stamp = 100.3 + 0.5 * late
        fastest = clock.fastest_arrival(stamp, 30.0 + 1e-4 * late)
        assert fastest == pytest.approx(stamp - 100.1 + 5.105, abs=0.03)


@pytest.mark.parametrize("drift", [-5e-4, 5e-4])
def test_clocks_may_drift(drift: float) -> None:
    clock = SenderClock()
    for step in range(40_000):
        stamp = 1000 + 0.025 * step
        arrival = (1 + drift) * 0.025 * step + 0.001
        assert 0 <= arrival - clock.fastest_arrival(stamp, arrival) < 1e-6


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_a_clock_that_was_set_is_learnt_at_once(jump: float) -> None:
    clock = SenderClock()
    for step in range(10):
        clock.fastest_arrival(5000 + step, 10.0 + step)
    assert clock.fastest_arrival(5010 + jump, 20.3) == pytest.approx(20.3)
    assert clock.fastest_arrival(5011 + jump, 21.5) == pytest.approx(21.3, abs=2e-3)


def test_no_time_is_after_arrival() -> None:
    random = np.random.default_rng(0)
    clock = SenderClock()
    for arrival in np.sort(random.uniform(0, 60, 500)):
        stamp = arrival + random.normal(1e6, 3)
        assert clock.fastest_arrival(stamp, arrival) <= arrival


# Connections -------------------------------------------------------------------------------------


def test_no_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    tracker = OpenIGTLinkSettings(driver="openigtlink", port=port).device()
    began = time.monotonic()
    with pytest.raises(DeviceError, match=rf"no server answers at 127\.0\.0\.1:{port}.*start"):
        tracker.open()
    assert time.monotonic() - began < 2
    assert not tracker.is_open


def test_an_unknown_host() -> None:
    tracker = OpenIGTLinkSettings(driver="openigtlink", host="no.host.invalid").device()
    with pytest.raises(DeviceError, match=r"no\.host\.invalid"):
        tracker.open()


def test_a_server_that_returns_is_called_again() -> None:
    with tracked() as (tracker, bench, peer):
        last = next_samples(tracker)[-1].frame
        port = tracker.settings.port
        peer.close()
        wait_for(lambda: tracker.errors)
        assert "closed the connection" in tracker.last_error
        busy = time.process_time()
        time.sleep(0.6)
        assert time.process_time() - busy < 0.3  # it waits, it does not spin
        tracker.read()
        again = OpenIGTLinkPeer(peer.settings, bench, port)
        again.start()
        try:
            assert next_samples(tracker)[0].frame > last
        finally:
            again.close()


def test_a_server_that_hangs_is_called_again() -> None:
    with connected(reconnect_after=0.3) as (tracker, server):
        wait_for(lambda: tracker.errors)
        assert "sends nothing" in tracker.last_error
        assert server.client is not None
        server.client.close()
        server.accept()
        server.send(message())
        assert next_samples(tracker)[0].visible


def test_another_kind_of_server() -> None:
    with connected() as (tracker, server):
        server.send(b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/html\r\n\r\n" * 20)
        wait_for(lambda: tracker.errors)
        assert "lost" in tracker.last_error
        assert tracker.read() == ()


@pytest.mark.parametrize("length", [0, 30, 70])
def test_closing_is_prompt_wherever_the_stream_stops(length: int) -> None:
    sent = message()[:length]
    threads = threading.active_count()
    with connected() as (tracker, server):
        server.send(sent)
        time.sleep(0.1)
        began = time.monotonic()
        tracker.close()
        assert time.monotonic() - began < 0.5
    assert threading.active_count() == threads


def test_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyigtl", None)
    with pytest.raises(MissingExtraError, match=r"pyigtl.*stiffopt\[openigtlink\]"):
        OpenIGTLinkSettings(driver="openigtlink").device().open()


@pytest.mark.parametrize(
    "wrong", [{"port": 0}, {"port": 70000}, {"name": "x" * 21}, {"host": ""}, {"latency": 2}]
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        OpenIGTLinkSettings(driver="openigtlink", **wrong)


# pyigtl's own ends, and the peer -----------------------------------------------------------------


def test_server_of_pyigtl() -> None:
    script = f"""
        import sys, time
        import numpy as np, pyigtl
        server = pyigtl.OpenIGTLinkServer(port=0)
        print(server.server_address[1], flush=True)
        matrix = np.eye(4)
        matrix[:3, 3] = {[1e3 * x for x in PLACE]}
        while True:
            message = pyigtl.TransformMessage(matrix, device_name="TipToTracker")
            server.send_message(message, wait=False)
            time.sleep(0.025)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            port = int(server.stdout.readline())
            with OpenIGTLinkSettings(driver="openigtlink", port=port).device() as tracker:
                for sample in next_samples(tracker, 10):
                    assert sample.position == pytest.approx(PLACE, abs=1e-7)
                server.kill()
                wait_for(lambda: tracker.errors)
                age = tracker.age()
                time.sleep(0.2)
                assert tracker.age() > age + 0.15
        finally:
            server.kill()


@contextmanager
def listening(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), 5) as client:
        yield client


def receive(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = client.recv(size - len(data))
        assert chunk
        data += chunk
    return data


def test_peer_sends_what_the_protocol_says() -> None:
    with tracked() as (tracker, _, _), listening(tracker.settings.port) as client:
        data = receive(client, 106)
    version, kind, name, seconds, fraction, size, crc = struct.unpack(">H12s20sIIQQ", data[:58])
    assert (version, kind.rstrip(b"\0"), name.rstrip(b"\0")) == (1, b"TRANSFORM", b"TipToTracker")
    assert size == 48
    assert crc == crc64(data[58:])
    assert abs(time.time() - seconds - fraction / 2**32) < 1
    numbers = np.array(struct.unpack(">12f", data[58:])).reshape(4, 3)
    assert pytest.approx(QUARTER, abs=1e-6) == numbers[:3].T
    assert numbers[3] == pytest.approx(np.array(PLACE) * 1e3, abs=1e-4)


def test_client_of_pyigtl() -> None:
    import pyigtl

    with tracked() as (tracker, _, _):
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", tracker.settings.port)
        try:
            received = client.wait_for_message("TipToTracker", timeout=5)
        finally:
            client.stop()
    assert received is not None
    assert received.matrix[:3, 3] == pytest.approx(np.array(PLACE) * 1e3, abs=1e-4)


def test_peer_serves_many_and_survives_those_who_leave() -> None:
    with tracked() as (tracker, _, _):
        port = tracker.settings.port
        with listening(port) as first, contextlib.ExitStack() as others:
            clients = [others.enter_context(listening(port)) for _ in range(3)]
            clients[0].sendall(b"GET_TRANSFORM and other things" * 10)
            for client in (first, *clients):
                assert receive(client, 106)[2:11] == b"TRANSFORM"
        tracker.read()
        assert next_samples(tracker, 4)[-1].visible


def test_peer_sends_nothing_for_a_missing_tool_and_in_silence() -> None:
    with tracked() as (tracker, bench, _):
        next_samples(tracker)
        for hide in (
            lambda: setattr(bench, "position", (np.nan,) * 3),
            lambda: bench.faults.update(tracker="off"),
        ):
            hide()
            time.sleep(0.1)
            tracker.read()
            time.sleep(0.2)
            assert tracker.read() == ()
            bench.position = PLACE
            bench.faults.clear()
            assert next_samples(tracker)[0].visible
        assert tracker.errors == 0


def test_a_slow_server_makes_old_samples() -> None:
    with tracked() as (tracker, bench, _):
        next_samples(tracker, 5)
        bench.faults["tracker"] = "slow"
        time.sleep(0.3)
        tracker.read()
        sample = next_samples(tracker)[-1]
        assert sample.received - sample.time == pytest.approx(0.225, abs=0.05)


def test_peer_says_that_its_port_is_taken() -> None:
    with tracked() as (tracker, bench, peer):
        second = OpenIGTLinkPeer(peer.settings, bench, tracker.settings.port)
        with pytest.raises(DeviceError, match=f"port {tracker.settings.port}"):
            second.start()
        second.close()
