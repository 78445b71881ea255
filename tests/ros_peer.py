"""A node on the graph for tests: writers, readers and service clients, on loopback only."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from running import wait_for
from stiffopt.ros.messages import SERVICES

LOOPBACK = """<CycloneDDS><Domain><General><Interfaces>
<NetworkInterface name="lo" multicast="true"/></Interfaces></General></Domain></CycloneDDS>"""


def own_domain(number: int = 0) -> int:
    """Return a domain that no other process of the tests uses; on ports below the ephemeral."""
    return 2 + (2 * os.getpid() + number) % 98


def qos(*more: Any, reliable: bool = True, depth: int = 100) -> Qos:
    kind = Policy.Reliability
    return Qos(
        kind.Reliable(duration(seconds=1)) if reliable else kind.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        *more,
    )


class Peer:
    """A participant with readers and writers of the topics and services of one node.

    `alone` has it make the domain; else the process has done so.
    """

    def __init__(self, domain: int, node: str = "/stiffopt", *, alone: bool = False) -> None:
        self._domain = Domain(domain, LOOPBACK) if alone else None
        self.participant = DomainParticipant(domain)
        self.node = node
        self._number = 0

    def close(self) -> None:
        self.participant.__del__()
        if self._domain is not None:
            self._domain.__del__()

    def full(self, name: str) -> str:
        return name.replace("~", self.node, 1)

    def reader(self, name: str, kind: type[Any], *more: Any) -> Reader:
        topic = Topic(self.participant, f"rt{self.full(name)}", kind)
        return Reader(DataReader(self.participant, topic, qos=qos(*more)))

    def writer(
        self, name: str, kind: type[Any], *more: Any, reliable: bool = True, wait: bool = True
    ) -> DataWriter:
        topic = Topic(self.participant, f"rt{self.full(name)}", kind)
        writer = DataWriter(self.participant, topic, qos=qos(*more, reliable=reliable))
        if wait:
            wait_for(writer.get_matched_subscriptions)
        return writer

    def client(self, name: str, request: type[Any], *more: Any) -> Callable[[Any], Any]:
        """Return a function that asks a service and returns its answer."""
        full = self.full(name)
        asks = DataWriter(
            self.participant, Topic(self.participant, f"rq{full}Request", request), qos=qos(*more)
        )
        topic = Topic(self.participant, f"rr{full}Reply", SERVICES[request])
        answers = Reader(DataReader(self.participant, topic, qos=qos()))
        guid = int.from_bytes(asks.guid.bytes[-8:], "little")

        def call(asked: Any) -> Any:
            wait_for(asks.get_matched_subscriptions)
            self._number += 1
            asked.guid, asked.number = guid, self._number
            asks.write(asked)
            return answers.wait(lambda a: (a.guid, a.number) == (asked.guid, asked.number))

        return call


class Reader:
    """What has come on a topic."""

    def __init__(self, reader: DataReader) -> None:
        self._reader = reader
        self.all: list[Any] = []
        self._new: deque[Any] = deque()

    @property
    def has_writer(self) -> bool:
        return bool(self._reader.get_matched_publications())

    def take(self) -> None:
        new = [each for each in self._reader.take(1000) if not isinstance(each, InvalidSample)]
        self.all += new
        self._new += new

    def wait(self, condition: Callable[[Any], bool] = lambda _: True, timeout: float = 60) -> Any:
        """Return the first new message that is so."""
        end = time.monotonic() + timeout
        while True:
            self.take()
            while self._new:
                if condition(each := self._new.popleft()):
                    return each
            assert time.monotonic() < end, f"that was not heard; last: {self.all[-1:]}"
            time.sleep(0.005)
