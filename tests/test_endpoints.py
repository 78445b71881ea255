"""Endpoints: a device has one name, however it is addressed."""

from __future__ import annotations

import os
import pty
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stiffopt.errors import DeviceError
from stiffopt.rig import endpoints
from stiffopt.rig.endpoints import serial_endpoints, tcp_endpoints


def resolving(monkeypatch: pytest.MonkeyPatch, **known: list[str]) -> None:
    """Let host names stand for addresses, without a network."""

    def found(host: str, port: int, **_: Any) -> list[tuple[Any, ...]]:
        addresses = known.get(host.replace(".", "_"))
        if addresses is None:
            raise socket.gaierror(-2, "Name or service not known")
        family = {False: socket.AF_INET, True: socket.AF_INET6}
        return [(family[":" in a], 1, 6, "", (a, port)) for a in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", found)


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.0.0.2", "0.0.0.0"])
def test_all_names_of_this_machine_are_one(host: str) -> None:
    assert tcp_endpoints(host, 502) == ("tcp this machine:502",)


def test_its_own_name_is_this_machine() -> None:
    try:
        socket.getaddrinfo(socket.gethostname(), 502)
    except OSError:
        pytest.skip("this machine does not know its own name")
    assert tcp_endpoints(socket.gethostname(), 502) == ("tcp this machine:502",)


@pytest.mark.skipif(not socket.has_ipv6, reason="there is no IPv6")
def test_the_ipv6_address_of_this_machine_is_this_machine() -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no ::1")
    assert tcp_endpoints("::1", 502) == ("tcp this machine:502",)


def test_an_ipv4_address_in_ipv6_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    resolving(monkeypatch, mapped=["::ffff:127.0.0.1"], far=["::ffff:192.0.2.7"], v4=["192.0.2.7"])
    assert tcp_endpoints("mapped", 502) == ("tcp this machine:502",)
    assert tcp_endpoints("far", 502) == tcp_endpoints("v4", 502) == ("tcp 192.0.2.7:502",)


def test_another_machine_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    resolving(
        monkeypatch,
        valves=["192.0.2.7"],
        valves_lab=["192.0.2.7", "192.0.2.7"],
        both=["2001:db8::7", "192.0.2.7"],
        near=["192.0.2.7", "127.0.0.1"],
    )
    assert tcp_endpoints("valves", 502) == ("tcp 192.0.2.7:502",)
    assert tcp_endpoints("valves.lab", 502) == ("tcp 192.0.2.7:502",)
    assert tcp_endpoints("both", 502) == ("tcp 192.0.2.7:502", "tcp 2001:db8::7:502")
    assert tcp_endpoints("near", 502) == ("tcp 192.0.2.7:502", "tcp this machine:502")


def test_another_port_is_another_device() -> None:
    assert tcp_endpoints("localhost", 502) != tcp_endpoints("localhost", 503)


@pytest.mark.parametrize("host", ["no-such-host", "", "a" * 300, "b\udc80d"])
def test_a_host_without_an_address_is_told(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if host == "no-such-host":
        resolving(monkeypatch)
    with pytest.raises(DeviceError, match=r"^the host '.*' cannot be found: "):
        tcp_endpoints(host, 502)


@pytest.fixture
def port() -> Iterator[str]:
    ours, theirs = pty.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_a_link_to_a_serial_port_is_that_port(port: str, tmp_path: Path) -> None:
    by_id, chain = tmp_path / "usb-regulator", tmp_path / "chain"
    by_id.symlink_to(port)
    chain.symlink_to(by_id)
    node = os.stat(port).st_rdev
    expected = (f"serial {os.major(node)}:{os.minor(node)}",)
    assert serial_endpoints(port) == expected
    assert serial_endpoints(str(by_id)) == serial_endpoints(str(chain)) == expected


def test_two_names_of_one_device_node_are_one(port: str, tmp_path: Path) -> None:
    node, other = os.stat(port), tmp_path / "ttyUSB9"
    try:
        os.mknod(other, node.st_mode, node.st_rdev)
    except PermissionError:
        pytest.skip("only root can make device nodes")
    assert serial_endpoints(str(other)) == serial_endpoints(port)


def test_two_ports_are_two(port: str) -> None:
    ours, theirs = pty.openpty()
    assert serial_endpoints(os.ttyname(theirs)) != serial_endpoints(port)
    os.close(ours)
    os.close(theirs)


def test_what_is_no_device_is_called_by_its_place(tmp_path: Path) -> None:
    plain, link = tmp_path / "plain", tmp_path / "link"
    link.symlink_to(plain)
    missing = serial_endpoints(str(link))
    assert missing == (f"serial {plain}",)
    plain.write_text("no port")
    assert serial_endpoints(str(link)) == serial_endpoints(str(plain)) == missing


def test_what_cannot_be_bound_to_is_another_machine() -> None:
    assert endpoints._host("192.0.2.1") == "192.0.2.1"
    assert endpoints._host("2001:db8::1") == "2001:db8::1"
