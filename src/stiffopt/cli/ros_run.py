"""Run `stiffopt ros`: find or start the daemon, and run the node until a signal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from stiffopt.cli.console import report_error, report_note
from stiffopt.cli.exits import BAD_INPUT, ENDING_SIGNALS, FAULT, SOLVED, handled
from stiffopt.daemon.client import Client, daemon_url
from stiffopt.daemon.secret import Secret
from stiffopt.errors import InputError, ServiceError, require_package
from stiffopt.model.manipulator import load_robot
from stiffopt.rig.config import RigDescription, load_rig
from stiffopt.rig.settings import RosSettings

_START = 600.0  # s; a first start compiles the model
_FIRST_NOTE = 10.0  # s until a note says that the daemon is still starting; later ones are rarer
_LATE = 30.0  # s that a daemon may take to end, beyond the ramp
_LOOPBACK = (None, "lo")


def run(rig: str, given: Mapping[str, Any], remap: Sequence[str], token_file: str | None) -> int:
    """Run the node of a rig; return the exit code. `given` are options that override `ros:`."""
    require_package("cyclonedds", "ros")
    from stiffopt.ros.bridge import NAMES, Bridge
    from stiffopt.ros.names import NodeNames, remap_rules
    from stiffopt.ros.node import RosNode, network_interface

    description, robot = load_rig(rig)
    settings = _settings(description.ros, given, remap_rules(remap))
    description = description.model_copy(update={"ros": settings})
    names = NodeNames(settings.node, settings.namespace, settings.remap)
    if strange := names.unused(NAMES):
        raise InputError(
            f"there is no topic or service '{strange[0]}' that could have another name"
        )
    domain = _domain() if settings.domain is None else settings.domain
    network_interface(settings.interface)  # before a daemon is started
    arm, over = load_robot(robot), threading.Event()
    daemon = _Daemon(rig, description, robot.name, token_file)

    def handle(number: int, frame: Any) -> None:
        over.set()
        daemon.begin_end()

    with handled(dict.fromkeys(ENDING_SIGNALS, handle)):
        try:
            url, token = daemon.find(over)
            if not over.is_set():
                node = RosNode(
                    names, domain=domain, interface=settings.interface, distro=settings.distro
                )
                bridge = Bridge(rig, description, arm, url, token, node, report_note)
                with closing(bridge):
                    _announce(names, domain, settings)
                    # a daemon started here stays visible, and can be vented, until it has ended
                    bridge.run(daemon.left)
        except ServiceError as error:
            if not over.is_set():
                report_error(str(error))
                return daemon.end() or BAD_INPUT
        finally:
            code = daemon.end()
    return code


def _settings(
    settings: RosSettings, given: Mapping[str, Any], rules: Mapping[str, str]
) -> RosSettings:
    """Return the rig file's settings, overridden by options."""
    options = {key: value for key, value in given.items() if value is not None}
    changes = {**settings.model_dump(), **options, "remap": {**settings.remap, **rules}}
    try:
        return RosSettings.model_validate(changes)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"--{first['loc'][0]}: {first['msg']}") from None


def _domain() -> int:
    """Return the domain of the environment, as nodes of ROS 2 read it."""
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not (text.isdecimal() and len(text) < 4 and int(text) <= 232):
        raise InputError(f"ROS_DOMAIN_ID is '{text}'; expected a number from 0 to 232")
    return int(text)


def _announce(names: Any, domain: int, settings: RosSettings) -> None:
    where = settings.interface or "lo"
    node = names.full("~/tip").removesuffix("/tip")
    may = "takes commands" if settings.commands else "takes no command but to vent"
    report_note(f"the node {node} is on domain {domain}, interface {where}, and {may}")
    if settings.commands and settings.interface not in _LOOPBACK:
        report_note(f"whoever is on the network of {where} can move the arm: DDS has no token")


class _Daemon:
    """The daemon of a rig: one that already runs, or one that is started and ended here."""

    def __init__(
        self, rig: str, description: RigDescription, robot: str, token_file: str | None
    ) -> None:
        self._rig, self._description, self._token_file = rig, description, token_file
        self._robot = robot
        self._process: subprocess.Popen[str] | None = None
        self._asked = False  # whether it was asked to end
        self.left = threading.Event()
        """Set to disconnect from a daemon that others have started."""

    def find(self, over: threading.Event) -> tuple[str, str]:
        """Return the URL and the token of the daemon; start one if none runs.

        Raises `StiffoptError`: it belongs to another arm, does not start, or its token cannot be
        read.
        """
        service = self._description.service
        url = daemon_url(service)
        if service.port and self._runs(url):
            return url, self._token(self._token_file)
        return self._start(over)

    def _runs(self, url: str) -> bool:
        try:
            with Client(url, "") as client:
                robot = client.robot().name
        except ServiceError:
            return False
        if robot != self._robot:
            raise InputError(f"the daemon at {url} has the robot '{robot}', not '{self._robot}'")
        return True

    def _token(self, file: str | None) -> str:
        """Return the token; without it, not even venting would be possible."""
        description = self._description
        secret = Secret(description.service, description.log.folder, description.name)
        place = file or secret.path
        if place is None:
            return secret.token
        try:
            return Path(place).read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            raise InputError(
                f"the daemon runs, and its token cannot be read from '{place}'; without it not "
                "even venting is possible. Give --token-file, or the token in the environment "
                f"variable {description.service.token}"
            ) from None

    def _start(self, over: threading.Event) -> tuple[str, str]:
        """Start a daemon in its own session, so that Ctrl-C reaches it only through here."""
        report_note(f"no daemon of {self._description.name} runs: one is started")
        command = [sys.executable, "-m", "stiffopt", "run", self._rig, "--json-lines"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        started: dict[str, Any] = {}
        ready = threading.Event()
        threading.Thread(target=self._listen, args=(started, ready), daemon=True).start()
        begin, next_note = time.monotonic(), _FIRST_NOTE
        while not ready.wait(0.05) and not over.is_set():
            if self._process.poll() is not None:
                raise ServiceError("the daemon did not start; it says why above")
            if (gone := time.monotonic() - begin) > _START:
                raise ServiceError(f"the daemon did not start within {_START:g} s")
            if gone > next_note:
                next_note *= 2
                report_note(f"it is starting, for {gone:.0f} s now; a first start compiles models")
        if over.is_set():
            return "", ""
        return started["url"], self._token(started.get("token_file"))

    def _listen(self, started: dict[str, Any], ready: threading.Event) -> None:
        """Forward the daemon's messages, and store its address."""
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with suppress(OSError, ValueError):
                print(line, end="", flush=True)
            if not ready.is_set():
                with suppress(ValueError):
                    said = json.loads(line)
                    if said.get("kind") == "started":
                        started.update(said)
                        ready.set()

    def begin_end(self) -> None:
        """Ask the daemon to end if it was started here, else disconnect; does not wait.

        Asked a second time, the daemon vents at once.
        """
        if self._process is None:
            self.left.set()
        elif self._process.poll() is None:
            self._asked = True
            self._process.send_signal(signal.SIGTERM)

    def end(self) -> int:
        """End the daemon if it was started here; return its exit code, or 0."""
        process = self._process
        if process is None:
            return SOLVED
        if not self._asked:
            self.begin_end()
        try:
            code = process.wait(self._description.safety.ramp_time + _LATE)
        except subprocess.TimeoutExpired:
            report_error("the daemon does not end; 'stiffopt vent' lets the pressure out")
            return FAULT
        return code if code >= 0 else FAULT
