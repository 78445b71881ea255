"""The daemon's WebSocket: sends states at a steady rate, receives and answers targets."""

from __future__ import annotations

import asyncio
import json
import math
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect

from stiffopt.daemon.access import Token
from stiffopt.daemon.messages import MAX_MESSAGE, TargetMessage, sentence
from stiffopt.daemon.operations import Operations
from stiffopt.daemon.reports import LEASE_HEADER, RefusalError
from stiffopt.daemon.server import GRACE, MAX_STREAMS, ConnectionLimiter, LimitedConnection

ModelT = TypeVar("ModelT", bound=BaseModel)

DEFAULT_RATE = 20.0
MAX_RATE = 100.0
"""Rate of states, in Hz."""


class AccessMessage(BaseModel):
    """The token and the lease that let a stream move the arm; one that is missing is kept."""

    model_config = ConfigDict(extra="forbid", strict=True)

    token: str | None = None
    lease: str | None = None


class StreamedTarget(BaseModel):
    """A target, and the number that its answer will have."""

    model_config = ConfigDict(extra="forbid", strict=True)

    target: TargetMessage
    seq: Annotated[int, Field(ge=0, le=2**53)]


class Stream:
    """One WebSocket connection.

    If targets come faster than the control loop takes them, only the newest is passed on: a stale
    one would move the arm to where the client no longer wants it.

    The WebSocket is not accepted yet; `Access` has checked its headers.
    """

    def __init__(
        self,
        websocket: WebSocket,
        operations: Operations,
        token: Token,
        limiter: ConnectionLimiter,
        connection: LimitedConnection,
    ) -> None:
        self._socket = websocket
        self._operations = operations
        self._token = token
        self._limiter, self._connection = limiter, connection
        self._lease = websocket.headers.get(LEASE_HEADER)
        self._next: StreamedTarget | None = None
        self._arrived = asyncio.Event()
        self._shown = asyncio.Event()  # set when a message shows the token
        self._sending = asyncio.Lock()

    async def run(self) -> None:
        """Serve until the client disconnects, unless there are too many streams."""
        await self._socket.accept()
        with suppress(WebSocketDisconnect):
            try:
                await self._serve(_rate(self._socket.query_params.get("rate")))
            except RefusalError as refusal:
                await self._send({"type": "error", "seq": None, **refusal.body})
                await self._socket.close(1008)

    async def _serve(self, rate: float) -> None:
        tasks = [asyncio.create_task(self._receive())]
        try:
            await self._be_admitted(tasks[0])
            tasks.append(asyncio.create_task(self._work()))
            if rate > 0:
                tasks.append(asyncio.create_task(self._report(1 / rate)))
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _be_admitted(self, receiving: asyncio.Task[None]) -> None:
        """Wait for admission; a stream beyond the limit may still show the token."""
        if self._limiter.admit_stream(self._connection):
            return
        if not self._connection.trusted:
            shown = asyncio.create_task(self._shown.wait())
            await asyncio.wait([shown, receiving], timeout=GRACE, return_when="FIRST_COMPLETED")
            shown.cancel()
            if receiving.done() or self._limiter.admit_stream(self._connection):
                return
        kind = "with" if self._connection.trusted else "without"
        raise RefusalError(503, "busy", f"there are {MAX_STREAMS} streams {kind} the token already")

    async def _report(self, period: float) -> None:
        clock = asyncio.get_running_loop()
        due = clock.time()
        while True:
            await self._send({"type": "state", "state": self._operations.state()})
            due = max(due + period, clock.time())  # a slow reader gets fewer states, not older
            await asyncio.sleep(due - clock.time())

    async def _receive(self) -> None:
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            seq = None
            try:
                given = _parsed(message.get("text"))
                seq = _seq(given)
                await self._take(given)
            except RefusalError as refusal:
                await self._send({"type": "error", "seq": seq, **refusal.body})

    async def _take(self, given: Any) -> None:
        if isinstance(given, dict) and "target" not in given and "seq" not in given:
            access = _valid(AccessMessage, given)
            if access.token is not None:
                self._show(access.token)
            self._lease = access.lease or self._lease
            await self._send({"type": "access", "trusted": self._connection.trusted})
            return
        target = _valid(StreamedTarget, given)
        if not self._connection.trusted:
            self._token.check(None)
        replaced, self._next = self._next, target
        self._arrived.set()
        if replaced is not None:
            newer = RefusalError(409, "superseded", "a newer target came before this one was taken")
            await self._answer(replaced.seq, newer)

    def _show(self, token: str) -> None:
        """Trust the client or not, by the token that it shows."""
        try:
            self._token.check(token)
        except RefusalError:
            self._limiter.distrust(self._connection)
            raise
        if not self._limiter.trust(self._connection):
            text = f"there are {MAX_STREAMS} streams with the token already"
            raise RefusalError(503, "busy", text)
        self._shown.set()

    async def _work(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            streamed, self._next = self._next, None
            if streamed is None:
                continue
            try:
                await self._operations.command(
                    self._lease, partial(self._set_target, streamed.target)
                )
            except RefusalError as refusal:
                await self._answer(streamed.seq, refusal)
            else:
                await self._answer(streamed.seq)

    def _set_target(self, target: TargetMessage) -> None:
        self._operations.loop.set_target(target.read())

    async def _answer(self, seq: int, refusal: RefusalError | None = None) -> None:
        error = {} if refusal is None else refusal.body
        await self._send({"type": "answer", "seq": seq, "accepted": refusal is None, **error})

    async def _send(self, message: dict[str, Any]) -> None:
        text = json.dumps(message)
        async with self._sending:
            await self._socket.send_text(text)


def _rate(text: str | None) -> float:
    try:
        rate = DEFAULT_RATE if text is None else float(text)
    except ValueError:
        rate = math.nan
    if not rate >= 0:
        raise RefusalError(422, "input", f"rate: expected 0 to {MAX_RATE:g}, in Hz")
    return min(rate, MAX_RATE)


def _parsed(text: str | None) -> Any:
    if text is None:
        raise RefusalError(422, "input", "expected text, not bytes")
    if len(text) > MAX_MESSAGE:
        raise RefusalError(413, "too-long", f"the message is longer than {MAX_MESSAGE} characters")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RefusalError(422, "input", f"this is not JSON: {error}") from None


def _seq(given: Any) -> int | None:
    """Return the number of a message, if it has one, even if the rest is wrong."""
    seq = given.get("seq") if isinstance(given, dict) else None
    return seq if type(seq) is int and 0 <= seq <= 2**53 else None


def _valid(model: type[ModelT], given: Any) -> ModelT:
    try:
        return model.model_validate(given)
    except ValidationError as error:
        raise RefusalError(422, "input", sentence(error.errors())) from None
