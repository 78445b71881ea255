"""The Python client of the daemon: its methods are the commands of the control loop."""

from __future__ import annotations

import itertools
import json
import math
import os
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self
from urllib.parse import urlsplit

from numpy.typing import ArrayLike

from stiffopt.control.state import Event, Snapshot, State
from stiffopt.daemon.address import local_url
from stiffopt.daemon.messages import TargetMessage, TaskMessage, TrajectoryMessage
from stiffopt.daemon.reports import LEASE_HEADER, RobotReport, error_of
from stiffopt.daemon.state_json import record_of
from stiffopt.errors import (
    CommandError,
    InputError,
    MissingExtraError,
    ServiceError,
    StiffoptError,
    require_package,
)
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task, load_task
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.settings import ServiceSettings

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

_TOKEN = "STIFFOPT_TOKEN"
_POLL = 0.05  # s between polls of the state
_STEADY = 0.3  # s for which the tip must stay near its target to have settled
_LOST = "lease"  # code of a refusal because the client does not have control
_STATUS = {"input": 422, "too-long": 413, "no-answer": 503, "busy": 503, "internal": 500}


class Client:
    """A connection to a running daemon, to read the state of an arm and to command it.

    ::

        with Client(name="planner") as client:
            client.take_control()
            client.arm()
            client.set_target(position=[0, 0, 0.2])
            client.wait_until_settled(1e-3, timeout=10)
            client.disarm()

    Control is lost, and the arm held, when the daemon does not hear from the client for a time.
    With the heartbeat ``"automatic"``, a thread of the client renews control as long as the thread
    that took it lives. That proves that the process runs, not that the program in it makes any
    progress: a planner that hangs keeps control. With ``"manual"``, only what the program does
    renews control: commands, `renew`, targets of a stream, `wait_until_settled`. Use that where no
    person watches the arm.

    A `with` block that ends by an exception holds the arm where it is. One that ends normally gives
    control back; the arm continues what it does. Methods may be called from any thread.

    Parameters
    ----------
    url :
        URL of the daemon.
    token :
        The token, or the path of its file; None: from the environment variable STIFFOPT_TOKEN,
        which may be either. Reading needs no token.
    name :
        Name shown to others who find that control is taken.
    heartbeat :
        How control is renewed, see above.
    timeout :
        Time to wait for an answer, in s.

    Raises
    ------
    InputError
        The URL is invalid, or the token's file cannot be read.
    MissingExtraError
        httpx is not installed.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8470",
        token: str | os.PathLike[str] | None = None,
        *,
        name: str = "client",
        heartbeat: Literal["automatic", "manual"] = "automatic",
        timeout: float = 15.0,
    ) -> None:
        if heartbeat not in ("automatic", "manual"):
            raise InputError(f"heartbeat must be 'automatic' or 'manual', not {heartbeat!r}")
        require_package("httpx", "daemon")
        import httpx

        try:
            parts = urlsplit(url)
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            good = False
        if not good:
            raise InputError(f"'{url}' is no URL of a daemon; one is http://127.0.0.1:8470")
        self.name = name
        self.url = url.rstrip("/")
        self.heartbeat = heartbeat
        self._token = _token(os.environ.get(_TOKEN) if token is None else token)
        self._lease: str | None = None
        self._httpx = httpx
        # No proxy of the environment: it would see the token.
        self._http = httpx.Client(trust_env=False, timeout=timeout, follow_redirects=False)
        self._beat: threading.Thread | None = None
        self._enough = threading.Event()

    def close(self) -> None:
        """Give control back, if this client has it, and disconnect."""
        with suppress(StiffoptError):
            self.release()
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self.in_control:
            with suppress(StiffoptError):
                self.hold(f"the client ended by {kind.__name__}")
        self.close()

    # Reading ------------------------------------------------------------------------------------

    def state(self) -> Snapshot:
        """Return the state of the control loop."""
        return record_of(Snapshot, self._ask("GET", "state"))

    def events(self, since: int = 0) -> tuple[list[Event], int]:
        """Return the events since an index, and the next index."""
        answer = self._ask("GET", "events", query={"since": since})
        return [record_of(Event, event) for event in answer["events"]], int(answer["next"])

    def robot(self) -> RobotReport:
        """Return the arm's name, channels, limits and length."""
        return RobotReport.model_validate(self._ask("GET", "robot"))

    def wait_until_settled(
        self, position_tolerance: float, timeout: float, *, angle_tolerance: float = math.inf
    ) -> Snapshot:
        """Wait until the tip is at its target and stays there.

        Parameters
        ----------
        position_tolerance, angle_tolerance :
            Largest errors, in m and rad, which must hold for 0.3 s without a break.
        timeout :
            Time to wait, in s.

        Returns
        -------
        Snapshot
            The last state.

        Raises
        ------
        CommandError
            The arm is not being moved (any more), or the tip has no target.
        ServiceError
            The tip did not settle in time.
        """
        end = time.monotonic() + timeout
        near_since = math.inf
        while True:
            if self.in_control and self.heartbeat == "manual":
                self.renew()
            now = time.monotonic()
            state = self.state()
            if state.state is not State.ACTIVE:
                reason = f": {state.reason}" if state.reason else ""
                raise CommandError(f"the arm does not move; it is {state.state}{reason}")
            errors = (state.position_error, state.angle_error)
            if all(map(math.isnan, errors)):
                raise CommandError("the tip has no target; set one first")
            limits = (position_tolerance, angle_tolerance)
            near = not any(e > limit for e, limit in zip(errors, limits, strict=True))
            near_since = min(near_since, now) if near else math.inf
            if now - near_since >= _STEADY:
                return state
            if now > end:
                raise ServiceError(
                    f"the tip did not settle within {timeout:g} s; its error is "
                    f"{state.position_error * 1e3:.3g} mm"
                )
            time.sleep(_POLL)

    # Control ------------------------------------------------------------------------------------

    @property
    def in_control(self) -> bool:
        """Whether this client has taken control and does not know of its loss."""
        return self._lease is not None

    def take_control(self) -> None:
        """Take control of the arm.

        Raises
        ------
        CommandError
            Another client has it.
        """
        if self.in_control:
            return
        grant = self._ask("POST", "lease", body={"client": self.name})
        self._lease = str(grant["lease"])
        if self.heartbeat == "automatic":
            self._enough = threading.Event()
            self._beat = threading.Thread(
                target=self._keep_control,
                args=(threading.current_thread(), float(grant["renew_every_s"]), self._enough),
                name="heartbeat",
                daemon=True,
            )
            self._beat.start()

    def release(self) -> None:
        """Give control back; the arm continues what it does."""
        self._enough.set()
        if self.in_control:
            try:
                self._ask("DELETE", "lease")
            finally:
                self._lease = None

    def renew(self) -> None:
        """Send a heartbeat: keep control for another interval."""
        self._ask("POST", "lease/renew")

    def _keep_control(
        self, owner: threading.Thread, period: float, enough: threading.Event
    ) -> None:
        while not enough.wait(period) and owner.is_alive():
            try:
                self._ask("POST", "lease/renew", timeout=4 * period)
            except ServiceError:
                continue  # it may answer the next time
            except StiffoptError:
                return  # control is lost; the next command reports it

    # Commands -----------------------------------------------------------------------------------

    def arm(self) -> None:
        """Check everything and put the arm under control."""
        self._ask("POST", "arm")

    def disarm(self) -> None:
        """Let the pressures down slowly, then vent."""
        self._ask("POST", "disarm")

    def set_task(
        self,
        task: Task | str | os.PathLike[str] | None = None,
        *,
        position: Sequence[float | None] | None = None,
        pointing: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
        **rest: Any,
    ) -> None:
        """Pursue a task.

        Parameters
        ----------
        task :
            A `Task`, or the path of a task file on this machine. Its robot must be the daemon's.
        position, pointing, orientation :
            Instead of a task: its target, see `set_target`.
        rest :
            Instead of a task: its `tolerance`, `stiffness`, `load` and `pressure`.
        """
        robot = None
        if task is not None:
            if rest or not (position is pointing is orientation is None):
                raise InputError("give a task or its parts, not both")
            task = task if isinstance(task, Task) else load_task(task)
            robot = None if task.robot is None else task.resolve_robot().name
        else:
            tolerance = {"tolerance": rest.pop("tolerance")} if "tolerance" in rest else {}
            target = _target(position, pointing, orientation, **tolerance)
            task = Task(target=target, **rest)
        body = TaskMessage.of(task, robot=robot).model_dump()
        self._ask("POST", "task", body=body)

    def set_target(
        self,
        target: Target | None = None,
        *,
        position: Sequence[float | None] | None = None,
        pointing: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
    ) -> None:
        """Go to another target, with the stiffness goal and the limits of the task.

        Parameters
        ----------
        target :
            A `Target`; or instead of it:
        position :
            x, y, z in m, in the base frame; None for a free axis.
        pointing, orientation :
            Direction of the tip, or its quaternion (w, x, y, z).
        """
        target = target or _target(position, pointing, orientation)
        self._ask("POST", "target", body=TargetMessage.of(target).model_dump())

    def follow_trajectory(
        self,
        trajectory: Trajectory | None = None,
        *,
        times: Sequence[float] | None = None,
        positions: ArrayLike | Sequence[Sequence[float | None]] | None = None,
    ) -> None:
        """Go through waypoints; time begins now, or when the arm can be at the first one.

        Parameters
        ----------
        trajectory :
            A `Trajectory`; or instead of it:
        times, positions :
            (k,) in s and (k, 3) in m.
        """
        if trajectory is None:
            trajectory = _trajectory(times, positions)
        body = TrajectoryMessage.of(trajectory).model_dump()
        self._ask("POST", "trajectory", body=body)

    def set_channels(self, without: Sequence[int]) -> None:
        """Take channels, counted from 1, out of use, and give all others back.

        Their pressure is let down, and plans do without them; an empty list gives all back.
        """
        self._ask("POST", "channels", body={"without": list(without)})

    def hold(self, reason: str = "asked to") -> None:
        """Keep the pressures as they are."""
        self._ask("POST", "hold", body={"reason": reason[:200] or "asked to"})

    def vent(self) -> None:
        """Let all pressure out at once; needs the token, not control."""
        self._ask("POST", "vent")

    def reset(self) -> None:
        """Leave the state fault; the arm stays vented."""
        self._ask("POST", "reset")

    def stream(self, rate: float = 20.0) -> ClientStream:
        """Return a stream of states and targets, to be used in a `with` block.

        Parameters
        ----------
        rate :
            Rate of the states, in Hz; 0 for none.
        """
        return ClientStream(self, rate)

    @property
    def _headers(self) -> dict[str, str]:
        """The token and the lease."""
        headers = {} if self._token is None else {"Authorization": f"Bearer {self._token}"}
        return headers if self._lease is None else {**headers, LEASE_HEADER: self._lease}

    def _ask(
        self,
        method: str,
        path: str,
        *,
        body: Any = None,
        query: dict[str, Any] | None = None,
        timeout: float | None = None,
    ) -> Any:
        """Return the daemon's answer; raise a refusal as an exception."""
        lease = self._lease
        try:
            answer = self._http.request(
                method,
                f"{self.url}/v1/{path}",
                json=body,
                params=query,
                headers=self._headers,
                timeout=self._httpx.USE_CLIENT_DEFAULT if timeout is None else timeout,
            )
        except (self._httpx.HTTPError, RuntimeError) as error:  # RuntimeError: closed client
            raise ServiceError(
                f"the daemon at {self.url} cannot be reached: {error or type(error).__name__}"
            ) from None
        if answer.is_success:
            return answer.json() if answer.content else None
        code, message = _refusal_in(answer)
        if code == _LOST and self._lease == lease:
            self._lease = None
        raise error_of(answer.status_code, _in_python(code, message))


class ClientStream:
    """A WebSocket that carries targets to the daemon and states back; see `Client.stream`.

    `send` does not wait for the answer. A refused target raises `CommandError` or `InputError` at
    the next `send` or `state`. The exception are targets that a newer one has superseded: that
    happens if they come faster than the arm takes them, and does no harm.
    """

    def __init__(self, client: Client, rate: float) -> None:
        self._client = client
        self._rate = rate
        self._open = ExitStack()
        self._socket: ClientConnection | None = None
        self._numbers = itertools.count()
        self._news = threading.Condition()
        self._state: Snapshot | None = None
        self._refused: StiffoptError | None = None
        self._ended: StiffoptError | None = None
        self._lease: str | None = None
        self.accepted = 0
        """Targets that the daemon has accepted so far."""
        self.superseded = 0
        """Targets that a newer one has superseded so far."""

    def __enter__(self) -> Self:
        """Connect; raise `ServiceError` if the daemon does not answer."""
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ModuleNotFoundError as error:
            raise MissingExtraError("websockets", "daemon") from error
        url = "ws" + self._client.url.removeprefix("http") + f"/v1/stream?rate={self._rate:g}"
        self._lease = self._client._lease
        try:
            self._socket = connect(
                url,
                additional_headers=self._client._headers,
                compression=None,
                proxy=None,  # it would see the token
                open_timeout=5,
                close_timeout=2,
            )
            self._open.enter_context(self._socket)
        except (OSError, WebSocketException) as error:
            raise ServiceError(f"no stream from {self._client.url}: {error}") from None
        threading.Thread(
            target=self._listen, args=(self._socket,), name="stream", daemon=True
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def send(
        self, target: Target | None = None, *, position: Sequence[float | None] | None = None
    ) -> None:
        """Go to a target, or to a position in m, from now on.

        Raises `CommandError` or `InputError`: an earlier target was refused; `ServiceError`: the
        stream has ended.
        """
        self._raise_refusal()
        message = TargetMessage.of(target or Target(position=position)).model_dump()
        if self._client._lease != self._lease:  # control was taken after the stream began
            self._lease = self._client._lease
            if self._lease is not None:
                self._send({"lease": self._lease})
        self._send({"target": message, "seq": next(self._numbers)})

    def state(self, timeout: float = 5.0) -> Snapshot:
        """Return the newest state that was not returned before; wait for it if necessary.

        Raises `CommandError` or `InputError`: a target was refused; `ServiceError`: none came in
        time, or the stream has ended.
        """
        with self._news:
            is_there = self._news.wait_for(
                lambda: self._state is not None or self._ended or self._refused, timeout
            )
            if is_there and self._state is not None:
                state, self._state = self._state, None
                if self._refused is None:
                    return state
        self._raise_refusal()
        raise ServiceError(f"no state came within {timeout:g} s")

    def _raise_refusal(self) -> None:
        with self._news:
            refused, self._refused = self._refused, None
            error = refused or self._ended
        if error is not None:
            raise error

    def _send(self, message: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed

        if self._socket is None:
            raise ServiceError("the stream is not open; use it in a 'with' block")
        try:
            self._socket.send(json.dumps(message))
        except ConnectionClosed as error:
            raise ServiceError(f"the stream has ended: {error}") from None

    def _listen(self, socket: ClientConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        reason = "the daemon sends what no daemon sends"
        try:
            while True:
                message = json.loads(socket.recv())
                with self._news:
                    self._take(message)
                    self._news.notify_all()
        except ConnectionClosed as error:
            reason = str(error)
        except Exception as error:  # whatever it is, the waiting thread must learn of it
            reason = f"{reason} ({type(error).__name__})"
        with self._news:
            self._ended = ServiceError(f"the stream has ended: {reason}")
            self._news.notify_all()

    def _take(self, message: dict[str, Any]) -> None:
        if message["type"] == "state":
            self._state = record_of(Snapshot, message["state"])
        elif message["type"] == "answer" and message["accepted"]:
            self.accepted += 1
        elif "error" in message:
            error = message["error"]
            if error["code"] == "superseded":
                self.superseded += 1
            else:
                reason = _in_python(error["code"], error["message"])
                self._refused = error_of(_STATUS.get(error["code"], 409), reason)


def daemon_url(service: ServiceSettings) -> str:
    """Return the URL of a daemon for clients on its machine, from the rig file's `service`."""
    return local_url(service.host, service.port)


def _token(given: str | os.PathLike[str] | None) -> str | None:
    """Return a token that is given itself or by the path of its file."""
    if given is None or given == "":
        return None
    try:
        token = Path(given).read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        if not isinstance(given, str) or os.sep in given:
            raise InputError(f"the token's file '{os.fspath(given)}' cannot be read") from None
        token = given
    if not (token.isascii() and token.isprintable()):
        raise InputError("the token has characters that a token cannot have")
    return token


def _target(position: Any, pointing: Any, orientation: Any, **tolerance: Any) -> Target:
    return Target(position=position, pointing=pointing, orientation=orientation, **tolerance)


def _trajectory(times: Any, positions: Any) -> Trajectory:
    if times is None or positions is None:
        raise InputError("give a trajectory, or times and positions")
    if len(times) != len(positions):
        raise InputError(f"there are {len(times)} times and {len(positions)} positions")
    return Trajectory(
        waypoints=[
            Waypoint(time=float(time), target=Target(position=position))
            for time, position in zip(times, positions, strict=True)
        ]
    )


def _in_python(code: str, message: str) -> str:
    """Return what to do about a refusal, where the daemon's own words are of HTTP."""
    if code == "no-token":
        give = f"give 'token' to the Client or set {_TOKEN}, to the token or its file"
        return f"this needs the daemon's token: {give}"
    return (
        "this needs control: take it first ('take_control')" if LEASE_HEADER in message else message
    )


def _refusal_in(answer: Any) -> tuple[str, str]:
    """Return code and message of a refusal, even if it does not come from a daemon."""
    try:
        error = answer.json()["error"]
        return str(error["code"]), str(error["message"])
    except (ValueError, KeyError, TypeError):
        return "", f"what answers is no stiffopt daemon; it says {answer.status_code}"
