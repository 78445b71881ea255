"""Messages between the loop and the guard: whole, broken, and too many."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from guard_scene import sample
from stiffopt.rig.interface import PoseSample
from stiffopt.safety.messages import (
    CommandFrame,
    GuardAnswer,
    GuardChannel,
    GuardNotice,
    GuardRequest,
    Message,
    TrackedPoses,
    unpack,
)


@pytest.mark.parametrize(
    "message",
    [
        CommandFrame(3, 1.0, 2.0, 0.5, np.array([1e5, np.nan])),
        GuardAnswer(4, np.array([1.0, 2.0]), np.array([3.0, np.nan]), 5.0, True, True, True, 6, 7),
        GuardAnswer(
            4, np.zeros(9), np.ones(9), 5.0, tripped="a", refused="b", error="µ", value=[[1.5]]
        ),
        GuardRequest(5, "inject", {"device": "supply", "channel": None}),
        GuardNotice("ready", {"real_time": "yes"}),
        TrackedPoses(
            (sample(3), PoseSample(1.0, 2.0, 4, np.full(3, np.nan), np.array([1.0, 0, 0, 0])))
        ),
        TrackedPoses(()),
    ],
)
def test_messages_arrive_as_they_were_sent(message: Message) -> None:
    again = unpack(message.pack())
    assert type(again) is type(message)
    np.testing.assert_equal(again.pack(), message.pack())
    np.testing.assert_equal(_plain(again), _plain(message))


def _plain(message: Any) -> Any:
    parts = dict(vars(message))
    if isinstance(message, TrackedPoses):
        parts["samples"] = [vars(s) for s in message.samples]
    return parts


@pytest.mark.parametrize(
    "packet",
    [b"X", b"C", b"C123", b"A12", b"R", b"R[1]", b"R5", b"W{}", b"P123", b"R\xff", b"",
     b'R["1", "read", {}]', b'R[null, "read", {}]', b'R[-1, "read", {}]', b'R[1.0, "read", {}]',
     b'R[true, "read", {}]', b'R[18446744073709551616, "read", {}]', b'R[NaN, "read", {}]',
     b'R[1, ["read"], {}]', b'R[1, "read", []]', b'R[1, "read", {}, 2]', b'W["ready", 1]',
     b"W[1, {}]", b"R" + 30000 * b"[", b"R" + 30000 * b'{"a":', b"W" + 30000 * b"[",
     b"R[" + 9000 * b"1" + b', "read", {}]', b"P" + np.full(10, np.inf).tobytes(),
     GuardAnswer(1, np.zeros(2), np.zeros(2), 0.0).pack()[:-3],
     CommandFrame(1, 0.0, 0.0, 0.0, np.zeros(2)).pack()[:-3]],
)  # fmt: skip
def test_a_broken_packet_is_no_message(packet: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  # of struct, json, numpy or ours
        unpack(packet)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        channel = GuardChannel(ours)
        theirs.send(packet)
        theirs.send(GuardNotice("ready").pack())
        assert channel.receive(1.0) == [GuardNotice("ready")]
        assert channel.broken == 1
        assert not channel.closed
        channel.close()


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_is_a_message_or_left_out(seed: int) -> None:
    draw = np.random.default_rng(seed)
    good = [
        GuardRequest(5, "arm", {"told": 0}).pack(),
        GuardNotice("ready").pack(),
        TrackedPoses((sample(3),)).pack(),
        CommandFrame(1, 0.0, 0.0, 0.0, np.zeros(2)).pack(),
        GuardAnswer(1, np.zeros(2), np.zeros(2), 0.0).pack(),
    ]
    for _ in range(3000):
        packet = bytearray(good[draw.integers(len(good))])
        for place in draw.integers(len(packet), size=draw.integers(1, 4)):
            packet[place] = draw.integers(256)
        with suppress(ValueError):
            unpack(bytes(packet[: draw.integers(1, len(packet) + 1)]))


def test_who_sends_without_end_keeps_nobody_from_the_rest() -> None:
    class Endless:
        def setblocking(self, _: bool) -> None:
            pass

        def fileno(self) -> int:
            return 0

        def recv(self, _: int) -> bytes:
            return b"X"

    channel = GuardChannel(Endless())  # type: ignore[arg-type]
    assert channel.receive() == []
    assert channel.broken == 1000


def test_a_channel_that_nobody_reads_waits_for_nothing() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        channel = GuardChannel(ours)
        for _ in range(100000):
            if not channel.send(GuardNotice("ready")):
                break
        else:
            raise AssertionError("it took everything")
        assert not channel.closed
    assert not channel.send(GuardNotice("ready"))
    assert channel.closed
    assert channel.receive(5.0) == []
    channel.close()


def test_a_closed_end_is_noticed() -> None:
    for unread in (False, True):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel = GuardChannel(ours)
        if unread:
            assert channel.send(GuardNotice("ready"))
        theirs.close()
        assert channel.receive(5.0) == []
        assert channel.closed
        channel.close()
