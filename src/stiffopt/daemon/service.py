"""The HTTP and WebSocket interface of a control loop, as a FastAPI application.

Anyone may read; a client with the token may stop the arm; a client with the token and control may
move it. A request that is refused changes nothing.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from functools import partial
from typing import Annotated, Any

from pydantic import WrapValidator

from stiffopt.control.loop import ControlLoop
from stiffopt.daemon.messages import (
    ChannelsRequest,
    ControlRequest,
    HoldRequest,
    TargetMessage,
    TaskRequest,
    TrajectoryMessage,
    sentence,
    trajectory_of,
)
from stiffopt.daemon.operations import Operations
from stiffopt.daemon.page import POLICY, page_of
from stiffopt.daemon.reports import (
    LEASE_HEADER,
    DoneReport,
    ErrorReport,
    EventsReport,
    GrantReport,
    RefusalError,
    RobotReport,
    StateReport,
    TaskReport,
)
from stiffopt.daemon.state_json import json_of
from stiffopt.errors import MissingExtraError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.interface import Clock, SystemClock

try:
    from fastapi import APIRouter, Depends, FastAPI, Header, Query, Request, WebSocket
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import HTMLResponse, JSONResponse, Response
    from fastapi.security import HTTPBearer
    from starlette.exceptions import HTTPException
except ModuleNotFoundError as error:
    raise MissingExtraError("fastapi", "daemon") from error

from stiffopt.daemon.access import Access, Token
from stiffopt.daemon.server import CONNECTION, ConnectionLimiter, LimitedConnection
from stiffopt.daemon.stream import Stream

_WHY = {
    401: "The token is missing.",
    403: "The token is wrong, or the request comes from another site.",
    409: "You do not have control, or the control loop refuses this now.",
    413: "The request is too long.",
    422: "The request makes no sense.",
    503: "The control loop does not answer; the message says whether it may still do this.",
}
_ABOUT = """Reads the state of a soft arm's control loop, and commands it.

Reading needs nothing. What moves the arm needs the token (Authorization: Bearer TOKEN) and control
(POST /v1/lease), which one client has at a time and loses when it is not heard. To vent needs the
token alone. The stream of states and targets is the WebSocket /v1/stream.

SI units stand in the names; null is what is not known. Gauge pressures; poses in the base frame."""
_log = logging.getLogger(__name__)

_UNREAD = WrapValidator(lambda given, _: given)
"""Leaves a body that may be long unparsed: `Operations` parses it in another thread."""
LeaseHeader = Annotated[
    str | None,
    Header(alias=LEASE_HEADER, description="from POST /v1/lease", max_length=100),
]


def create_app(
    loop: ControlLoop,
    *,
    robot: RobotDescription,
    token: str,
    heartbeat: float = 1.0,
    clock: Clock | None = None,
    metrics: Callable[[], bytes] | None = None,
    hosts: Iterable[str] = (),
    patience: float = 10.0,
) -> FastAPI:
    """Return the interface as an ASGI application.

    Parameters
    ----------
    loop, robot, heartbeat, clock, patience : see `Operations`.
    token : the token that a client needs to move the arm.
    metrics : returns the metrics for ``/metrics``; None: there is no such page.
    hosts : names of this machine besides localhost to which clients may send requests.

    The application's ``state.limiter`` limits the connections in a `Server`. `InputError`: a header
    cannot carry the token.
    """
    secret = Token(token)
    operations = Operations(loop, robot, heartbeat, clock or SystemClock(), patience)

    @asynccontextmanager
    async def watching(app: FastAPI) -> AsyncIterator[None]:
        watch = asyncio.create_task(_watch(operations))
        try:
            yield
        finally:
            watch.cancel()
            await asyncio.gather(watch, return_exceptions=True)

    app = FastAPI(
        title="stiffopt daemon",
        version="1",
        description=_ABOUT,
        lifespan=watching,
        docs_url=None,  # that page would load code from the internet
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.operations = operations
    app.add_middleware(Access, token=secret, hosts=tuple(hosts))
    app.include_router(_reading(operations), prefix="/v1")
    app.include_router(_control(operations), prefix="/v1")
    app.include_router(_moving(operations), prefix="/v1")

    limiter = app.state.limiter = ConnectionLimiter(secret.is_shown)

    @app.websocket("/v1/stream")
    async def stream(websocket: WebSocket) -> None:
        connection = websocket.scope.get("state", {}).get(CONNECTION) or LimitedConnection()
        await Stream(websocket, operations, secret, limiter, connection).run()

    @app.get("/", include_in_schema=False)
    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(page_of(app.openapi()), headers={"Content-Security-Policy": POLICY})

    if metrics is not None:

        @app.get("/metrics", include_in_schema=False)
        async def prometheus() -> Response:
            return Response(metrics(), media_type="text/plain; version=0.0.4; charset=utf-8")

    _add_refusals(app)
    return app


async def _watch(operations: Operations) -> None:
    period = min(operations.lease.heartbeat / 10, 0.1)
    while True:
        try:
            await operations.watch()
        except Exception:  # the watch must go on
            _log.exception("the watch over who has control failed; it goes on")
        await asyncio.sleep(period)


def _responses(*codes: int) -> dict[int | str, dict[str, Any]]:
    return {code: {"model": ErrorReport, "description": _WHY[code]} for code in codes}


def _reading(operations: Operations) -> APIRouter:
    """Return the calls that anyone may make."""
    router = APIRouter(tags=["read"], responses=_responses(403, 413))

    @router.get("/state", response_model=StateReport)
    async def state() -> Response:
        """The state of the control loop, and who has control."""
        return JSONResponse(operations.state())

    @router.get("/events", response_model=EventsReport, responses=_responses(422))
    async def events(since: Annotated[int, Query(ge=0, le=2**53)] = 0) -> Response:
        """What has happened since an earlier answer's `next`; from the beginning without it."""
        found, after = operations.loop.events.since(since)
        return JSONResponse({"events": [json_of(event) for event in found], "next": after})

    @router.get("/robot")
    async def robot() -> RobotReport:
        """What arm this is, its channels and what may be commanded."""
        return operations.robot_report()

    @router.get("/task")
    async def task() -> TaskReport:
        """What is being done."""
        return operations.task()

    return router


def _trusted(codes: Iterable[int], tag: str) -> APIRouter:
    """Return a router for calls that need the token, which `Access` checks."""
    scheme = HTTPBearer(auto_error=False, description="The token.", scheme_name="token")
    return APIRouter(
        tags=[tag], dependencies=[Depends(scheme)], responses=_responses(401, 403, 413, *codes)
    )


def _control(operations: Operations) -> APIRouter:
    """Return the calls about who has control."""
    router = _trusted((409, 422), "control")

    @router.post("/lease")
    async def take_control(request: ControlRequest) -> GrantReport:
        """Take control. One client has it at a time, for as long as it is heard.

        Any command counts, and so does `POST /v1/lease/renew`. When nothing is heard for
        `heartbeat_s`, control is lost and the arm is held.
        """
        return await operations.take(request.client)

    @router.post("/lease/renew", status_code=204)
    async def renew(lease: LeaseHeader = None) -> None:
        """Be heard."""
        operations.lease.renew(lease)

    @router.delete("/lease", status_code=204)
    async def release(lease: LeaseHeader = None) -> None:
        """Give control back. The arm goes on with what it does; disarm it before.

        A hold ends after `safety.hold_timeout`: the pressures are let down then.
        """
        await operations.release(lease)

    return router


def _moving(operations: Operations) -> APIRouter:
    """Return the calls that change what the arm does."""
    loop = operations.loop
    router = _trusted((409, 422, 503), "move")
    stopping = _trusted((409, 503), "stop")

    @router.post("/arm")
    async def arm(lease: LeaseHeader = None) -> DoneReport:
        """Check everything and put the arm under control."""
        return await operations.command(lease, loop.arm, ends_task=True)

    @router.post("/disarm")
    async def disarm(lease: LeaseHeader = None) -> DoneReport:
        """Let the pressures down slowly, then vent."""
        return await operations.command(lease, loop.disarm, ends_task=True)

    @router.post("/task")
    async def set_task(
        request: Annotated[TaskRequest, _UNREAD], lease: LeaseHeader = None
    ) -> DoneReport:
        """Pursue a task, given as a message or as the text of a task file."""
        return await operations.set_task(lease, request)  # still unparsed JSON

    @router.post("/target")
    async def set_target(request: TargetMessage, lease: LeaseHeader = None) -> DoneReport:
        """Go to another target, with the stiffness goal and the limits of the task."""
        return await operations.command(lease, lambda: loop.set_target(request.read()))

    @router.post("/trajectory")
    async def follow_trajectory(
        request: Annotated[TrajectoryMessage, _UNREAD], lease: LeaseHeader = None
    ) -> DoneReport:
        """Go through waypoints; time begins now, or when the arm can be at the first one."""
        return await operations.command(
            lease, lambda: loop.follow_trajectory(trajectory_of(request))
        )

    @router.post("/channels")
    async def set_channels(request: ChannelsRequest, lease: LeaseHeader = None) -> DoneReport:
        """Take channels out of use, and give all others back; plans do without them."""
        without = [channel - 1 for channel in request.without]
        return await operations.command(lease, partial(loop.set_channels, without))

    @router.post("/hold")
    async def hold(request: HoldRequest | None = None, lease: LeaseHeader = None) -> DoneReport:
        """Keep the pressures as they are, until the next task, target or trajectory."""
        reason = (request or HoldRequest()).reason
        return await operations.command(lease, partial(loop.hold, reason), urgent=True)

    @router.post("/reset")
    async def reset(lease: LeaseHeader = None) -> DoneReport:
        """Leave the state fault; the arm stays vented."""
        return await operations.command(lease, loop.reset, ends_task=True)

    @stopping.post("/vent")
    async def vent() -> DoneReport:
        """Let all pressure out at once.

        Needs no control: any client with the token that sees something go wrong may stop the arm,
        also while a planner that does not listen any more has control. A body is not looked at.
        """
        return await operations.vent()

    router.include_router(stopping)
    return router


def _add_refusals(app: FastAPI) -> None:
    """Answer every request that is not carried out with an `ErrorReport`."""

    @app.exception_handler(RefusalError)
    async def refused(request: Request, error: RefusalError) -> JSONResponse:
        return _answered(error)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        mistakes = [{**m, "loc": [s for s in m["loc"] if s != "body"]} for m in error.errors()]
        return _answered(RefusalError(422, "input", sentence(mistakes)))

    @app.exception_handler(HTTPException)
    async def other(request: Request, error: HTTPException) -> JSONResponse:
        if error.status_code == 400:  # a body that cannot be parsed at all
            return _answered(RefusalError(422, "input", "the body is not JSON that can be read"))
        answer = _answered(RefusalError(error.status_code, "http", f"{error.detail}".lower()))
        answer.headers.update(error.headers or {})
        return answer

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        return _answered(
            RefusalError(500, "internal", "the daemon failed at this; its log says more")
        )


def _answered(refusal: RefusalError) -> JSONResponse:
    return JSONResponse(refusal.body, refusal.status)
