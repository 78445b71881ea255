"""The WebSocket of the daemon: sends states at a steady rate, receives targets and answers them."""

from __future__ import annotations

import asyncio
import json
import math
from contextlib import suppress
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect

from stiffopt.daemon.access import Token
from stiffopt.daemon.connections import GRACE, MAX_STREAMS, Crowd, Member
from stiffopt.daemon.messages import MAX_MESSAGE, TargetMessage, sentence
from stiffopt.daemon.operations import Operations
from stiffopt.daemon.reports import LEASE_HEADER, RefusalError

__all__ = ["DEFAULT_RATE", "MAX_RATE", "Stream"]

ModelT = TypeVar("ModelT", bound=BaseModel)

DEFAULT_RATE = 20.0
MAX_RATE = 100.0
"""Of states, in Hz."""


class AccessMessage(BaseModel):
    """The token and the lease that let a stream move the arm; a missing one stays as it was."""

    model_config = ConfigDict(extra="forbid", strict=True)

    token: str | None = None
    lease: str | None = None


class StreamedTarget(BaseModel):
    """A target, and a number by which its answer is known."""

    model_config = ConfigDict(extra="forbid", strict=True)

    target: TargetMessage
    seq: Annotated[int, Field(ge=0, le=2**53)]


class Stream:
    """One WebSocket connection.

    Of targets that come faster than the control loop takes them, only the newest is passed on:
    a stale one would move the arm to where the client no longer wants it.

    Parameters
    ----------
    websocket :
        Not accepted yet; `Access` has looked at its headers.
    operations :
        What is to be done.
    token :
        Of those who may move the arm.
    crowd, member :
        All connections, and which of them this is.
    """

    def __init__(
        self,
        websocket: WebSocket,
        operations: Operations,
        token: Token,
        crowd: Crowd,
        member: Member,
    ) -> None:
        self._socket = websocket
        self._operations = operations
        self._token = token
        self._crowd, self._member = crowd, member
        self._lease = websocket.headers.get(LEASE_HEADER)
        self._next: StreamedTarget | None = None
        self._arrived = asyncio.Event()
        self._shown = asyncio.Event()  # the token, in a message
        self._sending = asyncio.Lock()

    async def run(self) -> None:
        """Serve until the client goes, unless there are too many others."""
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
            await self._be_seated(tasks[0])
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

    async def _be_seated(self, receiving: asyncio.Task[None]) -> None:
        """Find room among the streams; where there is none, the token may still be shown."""
        if self._crowd.seat(self._member):
            return
        if not self._member.trusted:
            shown = asyncio.create_task(self._shown.wait())
            await asyncio.wait([shown, receiving], timeout=GRACE, return_when="FIRST_COMPLETED")
            shown.cancel()
            if receiving.done() or self._crowd.seat(self._member):
                return
        kind = "with" if self._member.trusted else "without"
        raise RefusalError(503, "busy", f"there are {MAX_STREAMS} streams {kind} the token already")

    async def _report(self, period: float) -> None:
        clock = asyncio.get_running_loop()
        due = clock.time()
        while True:
            await self._send({"type": "state", "state": self._operations.state()})
            due = max(due + period, clock.time())  # a slow reader gets fewer, not older ones
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
            await self._send({"type": "access", "trusted": self._member.trusted})
            return
        target = _valid(StreamedTarget, given)
        if not self._member.trusted:
            self._token.check(None)
        replaced, self._next = self._next, target
        self._arrived.set()
        if replaced is not None:
            newer = RefusalError(409, "superseded", "a newer target came before this one was taken")
            await self._answer(replaced.seq, newer)

    def _show(self, token: str) -> None:
        """Trust the client from now on, or no longer, by what it shows."""
        try:
            self._token.check(token)
        except RefusalError:
            self._crowd.distrust(self._member)
            raise
        if not self._crowd.trust(self._member):
            text = f"there are {MAX_STREAMS} streams with the token already"
            raise RefusalError(503, "busy", text)
        self._shown.set()

    async def _work(self) -> None:
        loop = self._operations.loop
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            streamed, self._next = self._next, None
            if streamed is None:
                continue
            try:
                await self._operations.command(self._lease, loop.set_target, streamed.target.read)
            except RefusalError as refusal:
                await self._answer(streamed.seq, refusal)
            else:
                await self._answer(streamed.seq)

    async def _answer(self, seq: int, refusal: RefusalError | None = None) -> None:
        told = {} if refusal is None else refusal.body
        await self._send({"type": "answer", "seq": seq, "accepted": refusal is None, **told})

    async def _send(self, message: dict[str, Any]) -> None:
        await self._send_text(json.dumps(message))

    async def _send_text(self, text: str) -> None:
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
    """Return the number of a message, if it has one, even if the rest of it is wrong."""
    seq = given.get("seq") if isinstance(given, dict) else None
    return seq if type(seq) is int and 0 <= seq <= 2**53 else None


def _valid(model: type[ModelT], given: Any) -> ModelT:
    try:
        return model.model_validate(given)
    except ValidationError as error:
        raise RefusalError(422, "input", sentence(error.errors())) from None
