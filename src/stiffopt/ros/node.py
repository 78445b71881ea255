"""A node of ROS 2 on the wire: topics, services, and the discovery information of its graph."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from cyclonedds.core import (
    DDSException,
    InstanceState,
    Listener,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from stiffopt.errors import InputError
from stiffopt.ros import messages
from stiffopt.ros.hashes import TYPE_HASHES
from stiffopt.ros.names import NodeNames

_LOOPBACK = "lo"
_CONFIG = """\
<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface name="{interface}" {more}/></Interfaces></General>
  {discovery}
</Domain></CycloneDDS>"""
_LOCAL = """\
<Discovery>
  <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
  <Peers><Peer address="localhost"/></Peers>
</Discovery>"""
_FOREVER = (1 << 63) - 1  # ns, infinite in DDS
_ANY = SampleState.Any | ViewState.Any | InstanceState.Any
_BLOCKED = 20  # ms for which a reader that does not acknowledge may block a write
_KNOWN = 1000  # writers that are remembered
_REPLY = 0.5  # s to wait for the discovery of a client's reader of replies
_HANDLE = (1 << 64) - 1  # handles are unsigned, but listeners get signed ones


def _qos(depth: int, *more: Any, reliable: bool = True, latched: bool = False) -> Qos:
    """Return ROS 2's default quality of service, with a depth of history.

    `latched` is what ROS 2 calls transient local: later readers get the last messages.
    """
    kind, keep = Policy.Reliability, Policy.Durability
    return Qos(
        kind.Reliable(duration(milliseconds=_BLOCKED)) if reliable else kind.BestEffort,
        keep.TransientLocal if latched else keep.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        *more,
    )


@dataclass(frozen=True)
class Writer:
    """The writer of a message."""

    handle: int  # of the writer, in this process
    participant: UUID  # of its process; a context in ROS 2
    lease: float  # time within which it must assert its liveliness, in s; infinite if it need not


@dataclass(frozen=True)
class Received:
    """A message and its writer, which is None if unknown."""

    message: Any
    writer: Writer | None


class Publisher:
    """Writes messages to a topic."""

    def __init__(self, writer: DataWriter) -> None:
        self._writer = writer

    def publish(self, message: Any) -> None:
        """Write a message; drop it if a reader that does not acknowledge blocks it."""
        with suppress(DDSException):
            self._writer.write(message)

    @property
    def readers(self) -> frozenset[int]:
        """Handles of the readers."""
        return frozenset(self._writer.get_matched_subscriptions())


class _Lives(Listener):
    """Notes which writers have stopped asserting their liveliness."""

    def __init__(self) -> None:
        super().__init__()
        self.lost: set[int] = set()

    def on_liveliness_changed(self, reader: Any, status: Any) -> None:
        if status.alive_count_change < 0:
            self.lost.add(status.last_publication_handle & _HANDLE)


class Subscription:
    """Messages of a topic, in order of arrival, and the liveliness of their writers."""

    def __init__(self, reader: DataReader, lives: _Lives) -> None:
        self._reader, self._lives = reader, lives
        self._writers: dict[int, Writer] = {}
        self.condition = ReadCondition(reader, _ANY)

    def take(self) -> Iterator[Received]:
        """Yield the messages since the last call."""
        for sample in self._reader.take(100):
            if isinstance(sample, InvalidSample):  # the end of a writer, not a message
                continue
            writer = self._writer_of(sample.sample_info.publication_handle & _HANDLE)
            if writer is not None:
                self._lives.lost.discard(writer.handle)
            yield Received(sample, writer)

    def lives(self, writer: Writer) -> bool:
        """Whether a writer exists, and has asserted its liveliness since its last message."""
        matched = {handle & _HANDLE for handle in self._reader.get_matched_publications()}
        return writer.handle in matched and writer.handle not in self._lives.lost

    def _writer_of(self, handle: int) -> Writer | None:
        """Return the writer of a handle; None if it is unknown and gone."""
        if handle not in self._writers:
            try:
                found = self._reader.get_matched_publication_data(handle)
            except DDSException:
                found = None
            if found is None:
                return None
            if len(self._writers) >= _KNOWN:
                self._writers.clear()
            lease = found.qos[Policy.Liveliness].lease_duration
            seconds = math.inf if lease >= _FOREVER else lease * 1e-9
            self._writers[handle] = Writer(handle, found.participant_key, seconds)
        return self._writers[handle]


class Service:
    """Requests for a service, and its replies, with the header of rmw_cyclonedds."""

    def __init__(self, requests: Subscription, replies: DataWriter) -> None:
        self.requests, self._replies = requests, replies

    def reply(self, asked: Received, answer: Any) -> None:
        """Answer a request once the client's reader of replies is known, or after a short wait."""
        answer.guid, answer.number = asked.message.guid, asked.message.number
        end = time.monotonic() + _REPLY
        while not self._is_heard(asked.writer) and time.monotonic() < end:
            time.sleep(0.005)
        Publisher(self._replies).publish(answer)

    def _is_heard(self, writer: Writer | None) -> bool:
        if writer is None:
            return True  # no reader to wait for
        for handle in self._replies.get_matched_subscriptions():
            found = self._replies.get_matched_subscription_data(handle)
            if found is not None and found.participant_key == writer.participant:
                return True
        return False


def network_interface(name: str | None) -> str:
    """Return the name of a network interface; None: that of loopback.

    Raises `InputError`: there is no such interface.
    """
    place = name or _LOOPBACK
    existing = [name for _, name in socket.if_nameindex()]
    if place not in existing:
        raise InputError(
            f"there is no network interface '{place}'; this machine has {', '.join(existing)}"
        )
    return place


class RosNode:
    """A node with topics and services; other nodes find it once `announce` is called.

    Raises `InputError`: there is no such interface, or DDS refuses it.

    Parameters
    ----------
    names : names of the node, its topics and services.
    domain, interface : the DDS domain, and the network interface; None for loopback, which no other
        machine can reach.
    distro : ``humble`` or ``jazzy``: the layout of the discovery messages.
    """

    def __init__(
        self,
        names: NodeNames,
        *,
        domain: int = 0,
        interface: str | None = None,
        distro: str = "jazzy",
    ) -> None:
        self.names = names
        self._distro = distro
        place = network_interface(interface)
        # DDS finds others by multicast, which Linux does not report for loopback. Local nodes of
        # Jazzy do not use it; they look for others at the ports of localhost.
        local = place == _LOOPBACK
        more, discovery = ('multicast="true"', _LOCAL) if local else ("", "")
        config = _CONFIG.format(interface=place, more=more, discovery=discovery)
        try:
            self._domain = Domain(domain, config)
            self._participant = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise InputError(f"DDS cannot use the interface '{place}': {error}") from None
        self._readers: list[DataReader] = []
        self._writers: list[DataWriter] = []
        self._topics: dict[tuple[str, type[Any]], Topic] = {}
        self._waiting = WaitSet(self._participant)
        self._subscriptions: list[tuple[Subscription, Callable[[Subscription], None]]] = []
        self._graph = self._write_graph()

    def close(self) -> None:
        """Leave the graph; no part of the node may be used afterwards."""
        # cyclonedds has no function for this; deleting an entity deletes everything in it
        self._participant.__del__()
        self._domain.__del__()

    def publisher(self, name: str, kind: type[Any], depth: int = 10, **how: Any) -> Publisher:
        """Return the publisher of a topic; `how` may set `reliable` and `latched`."""
        more = self._about(kind)
        return Publisher(self._writer(f"rt{self.names.full(name)}", kind, depth, *more, **how))

    def subscribe(
        self,
        name: str,
        kind: type[Any],
        take: Callable[[Subscription], None],
        depth: int = 10,
        *,
        reliable: bool = True,
    ) -> Subscription:
        """Register `take`, which `wait` calls when a topic has messages."""
        more = self._about(kind)
        return self._subscribe(
            f"rt{self.names.full(name)}", kind, take, depth, *more, reliable=reliable
        )

    def serve(
        self, name: str, request: type[Any], take: Callable[[Service, Received], None]
    ) -> None:
        """Register `take`, which `wait` calls for each request of a service."""
        full, reply = self.names.full(name), messages.SERVICES[request]
        mark = ".".join(f"{byte:02x}" for byte in self._participant.guid.bytes[:12])
        more = self._about(request, f"serviceid={mark}.{len(self._writers):08x};")
        replies = self._writer(f"rr{full}Reply", reply, 10, *more)

        def each(requests: Subscription) -> None:
            for received in requests.take():
                take(service, received)

        service = Service(self._subscribe(f"rq{full}Request", request, each, 10, *more), replies)

    def announce(self) -> None:
        """Report this node's readers and writers to other nodes; call it after making them."""
        gid, node, info = messages.LAYOUTS[self._distro]
        size = len(gid().data)

        def named(entity: Any) -> Any:
            return gid(list(entity.guid.bytes.ljust(size, b"\0")))

        here = node(
            self.names.namespace,
            self.names.node,
            [named(reader) for reader in self._readers],
            [named(writer) for writer in self._writers],
        )
        self._graph.write(info(named(self._participant), [here]))

    def wait(self, seconds: float) -> None:
        """Wait for messages, for so many seconds at most, and pass them on."""
        self._waiting.wait(duration(nanoseconds=round(seconds * 1e9)))
        for subscription, take in self._subscriptions:
            take(subscription)

    def _about(self, kind: type[Any], more: str = "") -> tuple[Any, ...]:
        """Return the user data of an endpoint about its type: in Jazzy, the definition's hash."""
        if self._distro == "jazzy":
            name = messages.ros_name(kind).removesuffix("_Request").removesuffix("_Response")
            more += f"typehash=RIHS01_{TYPE_HASHES[name]};"
        return (Policy.Userdata(more.encode()),) if more else ()

    def _topic(self, name: str, kind: type[Any]) -> Topic:
        if (name, kind) not in self._topics:
            self._topics[name, kind] = Topic(self._participant, name, kind)
        return self._topics[name, kind]

    def _writer(self, name: str, kind: type[Any], depth: int, *more: Any, **how: Any) -> DataWriter:
        qos = _qos(depth, *more, **how)
        writer = DataWriter(self._participant, self._topic(name, kind), qos=qos)
        self._writers.append(writer)
        return writer

    def _subscribe(
        self,
        name: str,
        kind: type[Any],
        take: Callable[[Subscription], None],
        depth: int,
        *more: Any,
        reliable: bool = True,
    ) -> Subscription:
        lives = _Lives()
        qos = _qos(depth, *more, reliable=reliable)
        reader = DataReader(self._participant, self._topic(name, kind), qos=qos, listener=lives)
        self._readers.append(reader)
        subscription = Subscription(reader, lives)
        self._waiting.attach(subscription.condition)
        self._subscriptions.append((subscription, take))
        return subscription

    def _write_graph(self) -> DataWriter:
        kind = messages.LAYOUTS[self._distro][2]
        topic = Topic(self._participant, "ros_discovery_info", kind)
        return DataWriter(self._participant, topic, qos=_qos(1, latched=True))
