"""Who has control of the arm over ROS 2, and for how long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ros_messages import nothing
from stiffopt.errors import CommandError
from stiffopt.ros.lease import GraphLease
from stiffopt.ros.node import Writer


class FakeClient:
    def __init__(self) -> None:
        self.calls: list[str] = []
        self.in_control = False

    def take_control(self) -> None:
        self.calls.append("take")
        self.in_control = True

    def release(self) -> None:
        self.calls.append("release")
        self.in_control = False

    def renew(self) -> None:
        self.calls.append("renew")

    def hold(self, reason: str) -> None:
        self.calls.append("hold")


class FakeSource:
    alive = True

    def lives(self, writer: Writer) -> bool:
        return self.alive


class Leased:
    """A lease, with a clock and a client that a test looks at."""

    def __init__(self) -> None:
        self.time, self.client, self.source = 0.0, FakeClient(), FakeSource()
        self.told: list[str] = []
        self.lease = GraphLease(self.client, 1.0, self.told.append, clock=lambda: self.time)

    def look(self, time: float) -> list[str]:
        self.time = time
        self.client.calls.clear()
        self.lease.look()
        return self.client.calls


QUICK, FOREVER = Writer(1, "a", 0.5), Writer(1, "a", np.inf)


SISTER, OTHER = Writer(2, "a", np.inf), Writer(3, "b", np.inf)


def test_control_lasts_as_long_as_its_writer_lives() -> None:
    it = Leased()
    it.lease.move(it.source, QUICK, nothing)
    assert it.client.calls == ["take"]
    assert it.look(60) == ["renew"]  # DDS says that it lives
    it.source.alive = False
    assert it.look(61) == ["hold", "release"]
    assert "is gone" in it.told[-1]
    assert it.look(62) == []


def test_a_writer_that_offers_no_liveliness_has_to_write() -> None:
    it = Leased()
    it.lease.move(it.source, FOREVER, nothing)
    assert it.look(0.9) == ["renew"]
    it.lease.hear(OTHER)
    it.lease.hear(SISTER)  # of the same process
    assert it.look(1.8) == ["renew"]
    it.lease.hear(OTHER)
    assert it.look(2.0) == ["hold", "release"]
    slow = replace(QUICK, lease=5.0)  # longer than the heartbeat: none
    it.lease.move(it.source, slow, nothing)
    assert it.look(3.1) == ["hold", "release"]


def test_one_process_at_a_time_has_control() -> None:
    it = Leased()
    it.lease.move(it.source, QUICK, nothing)
    with pytest.raises(CommandError, match="another writer has control"):
        it.lease.move(it.source, OTHER, nothing)
    with pytest.raises(CommandError, match="another writer has control"):
        it.lease.once(OTHER, nothing)
    it.client.calls.clear()
    it.lease.once(SISTER, nothing)
    assert "release" not in it.client.calls
    it.lease.move(it.source, SISTER, nothing)
    it.lease.end("that is enough")
    assert it.client.calls[-2:] == ["hold", "release"]
    it.lease.once(OTHER, nothing)
    assert it.client.calls[-2:] == ["take", "release"]
    assert it.lease.holder == ""


def test_a_refused_command_gives_control_to_nobody() -> None:
    it = Leased()

    def refused() -> None:
        raise CommandError("not now")

    with pytest.raises(CommandError, match="not now"):
        it.lease.move(it.source, QUICK, refused)
    assert it.client.calls == ["take", "release"]
    it.lease.move(it.source, OTHER, nothing)
    with pytest.raises(CommandError, match="not now"):
        it.lease.move(it.source, OTHER, refused)
    assert it.lease.holder
    it.client.in_control = False  # the daemon has taken it back
    assert it.look(1) == []
    assert it.lease.holder == ""
