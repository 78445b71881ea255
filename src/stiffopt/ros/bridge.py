"""The bridge between a ROS 2 graph and the daemon: publishes the state, forwards commands."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stiffopt.control.state import Event, Severity, Snapshot
from stiffopt.daemon.client import Client
from stiffopt.errors import InputError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import solve_pressure
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.rig.config import RigDescription, limits_of
from stiffopt.ros.action import NAME as FOLLOW
from stiffopt.ros.action import Done, FollowAction
from stiffopt.ros.lease import GraphLease
from stiffopt.ros.messages import (
    Empty,
    JointState,
    JointTrajectory,
    PointStamped,
    PoseStamped,
    SolvePressureRequest,
    SolvePressureResponse,
    String,
    TriggerRequest,
    TriggerResponse,
)
from stiffopt.ros.node import Received, RosNode, Service, Subscription, Writer
from stiffopt.ros.published import PUBLISHED, StateMessages, channel_names
from stiffopt.ros.requests import target_of, task_in, trajectory_of
from stiffopt.safety.vent import vent_rig

SIMPLE = ("arm", "disarm", "hold", "reset")
"""Commands without arguments: services, and topics of `Empty`."""
MOTIONS: dict[str, type[Any]] = {
    "set_target": PoseStamped,
    "set_target_point": PointStamped,
    "set_task": String,
    "follow_trajectory": JointTrajectory,
}
"""Topics of commands that set the arm in motion."""
_FURTHER = ("vent", "renew", "solve", "solution", "solve_pressure")
NAMES = (*PUBLISHED, FOLLOW, *(f"~/{name}" for name in (*SIMPLE, *MOTIONS, *_FURTHER)))
"""Names of all topics, services and actions."""

_QUICK = 2.0  # s for the daemon to answer before the guard is called to vent
_SHAPE = 0.2  # s between messages of the arm's shape
_SLOW = 1.0  # s between diagnostics, and between checks for new readers of the scene
_EVENTS = 0.2  # s between polls of events
_WAITING = 32  # commands; more than any lively node needs
_SILENT = 5.0  # s without a state after which the daemon counts as ended
_LISTEN = 0.05  # s
_GONE = "its writer is gone already, and control belongs to a writer as long as it lives"


@dataclass(frozen=True)
class _Job:
    """A waiting command; a later one of the same writer replaces it if both are `newest`."""

    name: str
    writer: Writer
    command: Callable[[], None]
    done: Done
    newest: bool = False


class Bridge:
    """A node that shows a daemon's arm on a ROS 2 graph, and commands it if that is allowed.

    The bridge decides nothing about safety: commands use the daemon's interface, with its token and
    lease. Requests to vent are passed on at once, by a thread of their own, and to the guard if the
    daemon does not answer.

    Parameters
    ----------
    rig, description, robot : path and content of the rig file, and the arm.
    url, token : URL and token of the daemon.
    node : the node that publishes everything.
    say : called with notices for people.
    """

    def __init__(
        self,
        rig: str,
        description: RigDescription,
        robot: Manipulator,
        url: str,
        token: str,
        node: RosNode,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._rig, self._description, self._robot, self._node = rig, description, robot, node
        self._say = say
        name = node.names.full("~/tip").rpartition("/")[0].strip("/")
        client = partial(Client, url, token, name=f"ros: {name}"[:80], heartbeat="manual")
        self._client, self._quick = client(), client(timeout=_QUICK)
        self._lease = GraphLease(self._client, description.safety.heartbeat, self._warn)
        # the daemon is on this machine, so its clock has the same time 0 as ours
        epoch = time.time() - time.monotonic()
        settings = description.ros
        self._messages = StateMessages(robot, description.name, name, epoch, settings.frame_prefix)
        self._publishers = {
            topic: node.publisher(topic, kind, depth, latched=latched)
            for topic, (kind, depth, latched) in PUBLISHED.items()
        }
        self._solution = node.publisher("~/solution", JointState)
        self._jobs: deque[_Job] = deque()
        self._questions: deque[tuple[str, PoseStamped | None, Callable[..., None]]] = deque()
        self._vents: deque[Done] = deque()
        self._news = {name: threading.Event() for name in ("jobs", "questions", "vents")}
        self._over = threading.Event()
        # a reply may wait for its reader; nothing else waits for replies
        self._answers = ThreadPoolExecutor(1, "replies")
        self._now: Snapshot | None = None
        self._state: String | None = None
        self._seen: frozenset[int] = frozenset()
        self._next_event = 0
        self._action: FollowAction | None = None
        self._subscribe(commands=settings.commands)
        node.announce()

    def run(self, over: threading.Event) -> None:
        """Publish until `over` is set. Raises `ServiceError`: the daemon has ended."""
        works = [self._listen, self._command, self._solve, self._vent]
        threads = [threading.Thread(target=work, daemon=True) for work in works]
        with ExitStack() as stack:
            stream = stack.enter_context(self._quick.stream(self._description.ros.rate))
            for thread in threads:
                thread.start()
            stack.callback(self._end, threads)
            due = dict.fromkeys(("shape", "slow", "events"), 0.0)
            while not over.is_set():
                self._now = now = stream.state(_SILENT)
                self._publish(now, due)
                if self._action is not None:
                    self._action.look(now)

    def close(self) -> None:
        """Leave the graph."""
        for client in (self._client, self._quick):
            client.close()
        self._node.close()

    def _end(self, threads: list[threading.Thread]) -> None:
        self._over.set()
        for event in self._news.values():
            event.set()
        for thread in threads:
            thread.join(20)
        self._answers.shutdown()
        self._lease.end("the ROS 2 node has ended")

    # Publishing ----------------------------------------------------------------------------------

    def _publish(self, now: Snapshot, due: dict[str, float]) -> None:
        moment = time.monotonic()
        for topic, message in self._messages.often(now):
            self._publishers[topic].publish(message)
        if moment >= due["shape"]:
            due["shape"] = moment + _SHAPE
            with suppress(StiffoptError):  # an arm without a known shape is not drawn
                for topic, message in self._messages.shape(now):
                    self._publishers[topic].publish(message)
        state = self._messages.state(now)
        if state != self._state or moment >= due["slow"]:
            self._state = state
            self._publishers["~/state"].publish(state)
        if moment >= due["slow"]:
            due["slow"] = moment + _SLOW
            control = self._lease.holder
            self._publishers["/diagnostics"].publish(self._messages.diagnostics(now, control))
            readers = self._publishers["~/scene"].readers
            if readers - self._seen:
                scene = self._messages.scene(self._description.scene, now.time)
                self._publishers["~/scene"].publish(scene)
            self._seen = readers
        if moment >= due["events"]:
            due["events"] = moment + _EVENTS
            with suppress(StiffoptError):  # if the daemon is busy, the next poll gets them
                events, self._next_event = self._quick.events(self._next_event)
                for event in events:
                    self._publishers["/rosout"].publish(self._messages.log(event))

    def _log(self, kind: str, text: str, severity: Severity) -> None:
        """Log something that is no event of the loop."""
        event = Event(time.monotonic(), kind, text, severity)
        self._publishers["/rosout"].publish(self._messages.log(event))

    def _warn(self, text: str) -> None:
        self._log("ros", text, Severity.WARNING)
        self._say(text)

    # Listening -----------------------------------------------------------------------------------

    def _subscribe(self, *, commands: bool) -> None:
        node = self._node
        for reliable in (True, False):  # accept both kinds of writers
            node.subscribe("~/vent", Empty, self._vent_topic, reliable=reliable)
        node.serve("~/vent", TriggerRequest, self._vent_service)
        node.subscribe("~/solve", PoseStamped, self._solve_topic, 1)
        node.serve("~/solve_pressure", SolvePressureRequest, self._solve_service)
        if not commands:
            return
        for name in SIMPLE:
            node.subscribe(f"~/{name}", Empty, partial(self._simple_topic, name))
            node.serve(f"~/{name}", TriggerRequest, partial(self._simple_service, name))
        for name, kind in MOTIONS.items():
            node.subscribe(f"~/{name}", kind, partial(self._motion_topic, name))
        node.subscribe("~/renew", Empty, self._renew_topic)
        self._action = FollowAction(
            node,
            self._client,
            channel_names(self._robot.description),
            lambda message: trajectory_of(message, self._robot, time.time()),
            self._move,
            self._once,
            self._reply,
            self._answer_topic("follow_joint_trajectory"),
        )

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                self._node.wait(_LISTEN)
            except Exception as error:  # one bad message must not block the others
                self._warn(f"a message could not be taken: {type(error).__name__}: {error}")

    def _vent_topic(self, source: Subscription) -> None:
        for _ in source.take():  # possibly twice, by both subscriptions, which does no harm
            self._post("vents", self._vents, self._answer_topic("vent"))

    def _vent_service(self, service: Service, received: Received) -> None:
        self._post("vents", self._vents, self._answer_trigger(service, received))

    def _solve_topic(self, source: Subscription) -> None:
        for received in source.take():
            self._ask("", received.message, self._answer_solution)

    def _solve_service(self, service: Service, received: Received) -> None:
        asked = received.message
        target = asked.target if asked.target.header.frame_id else None
        self._ask(asked.task, target, partial(self._answer_solve, service, received))

    def _simple_topic(self, name: str, source: Subscription) -> None:
        for received in source.take():
            self._simple(name, received, self._answer_topic(name))

    def _simple_service(self, name: str, service: Service, received: Received) -> None:
        self._simple(name, received, self._answer_trigger(service, received))

    def _simple(self, name: str, received: Received, done: Done) -> None:
        commands: dict[str, Callable[[], None]] = {
            "arm": self._client.arm,
            "disarm": self._client.disarm,
            "hold": partial(self._client.hold, "asked for by ROS 2"),
            "reset": self._client.reset,
        }
        self._once(name, received, commands[name], done)

    def _motion_topic(self, name: str, source: Subscription) -> None:
        done, newest = self._answer_topic(name), name.startswith("set_target")
        for received in source.take():
            command = partial(self._motion, name, received.message)
            self._move(name, source, received, command, done, newest=newest)

    def _once(self, name: str, received: Received, command: Callable[[], None], done: Done) -> None:
        """Queue a command that needs control only while it is carried out."""
        if received.writer is None:
            done(False, _GONE)
        else:
            once = partial(self._lease.once, received.writer, command)
            self._queue(_Job(name, received.writer, once, done))

    def _move(
        self,
        name: str,
        source: Subscription,
        received: Received,
        command: Callable[[], None],
        done: Done,
        *,
        newest: bool = False,
    ) -> None:
        """Queue a command that sets the arm in motion."""
        if received.writer is None:
            done(False, _GONE)
        else:
            move = partial(self._lease.move, source, received.writer, command)
            self._queue(_Job(name, received.writer, move, done, newest))

    def _renew_topic(self, source: Subscription) -> None:
        for received in source.take():
            if received.writer is not None:
                self._lease.hear(received.writer)

    def _queue(self, job: _Job) -> None:
        self._lease.hear(job.writer)
        last = self._jobs[-1] if self._jobs else None
        if job.newest and last is not None and last.newest:
            if last.writer == job.writer:
                with suppress(ValueError):  # it is already being carried out
                    self._jobs.remove(last)
        elif len(self._jobs) >= _WAITING:
            job.done(False, "too many commands wait already")
            return
        self._post("jobs", self._jobs, job)

    def _ask(self, task: str, target: PoseStamped | None, answer: Callable[..., None]) -> None:
        if len(self._questions) >= _WAITING:
            answer(None, "too many questions wait already")
            return
        self._post("questions", self._questions, (task, target, answer))

    def _post(self, kind: str, queue: deque[Any], item: Any) -> None:
        queue.append(item)
        self._news[kind].set()

    # Working -------------------------------------------------------------------------------------

    def _command(self) -> None:
        """Carry out commands, and check the lease between them."""
        while not self._over.is_set():
            self._news["jobs"].wait(self._lease.period)
            self._news["jobs"].clear()
            self._guarded(self._lease.look)
            while self._jobs and not self._over.is_set():
                with suppress(IndexError):  # a vent has dropped the waiting commands
                    job = self._jobs.popleft()
                    self._guarded(partial(self._carry_out, job))
                    self._guarded(self._lease.look)

    def _carry_out(self, job: _Job) -> None:
        try:
            job.command()
        except StiffoptError as error:
            job.done(False, str(error))
        else:
            job.done(True, "")

    def _motion(self, name: str, message: Any) -> None:
        now, client = time.time(), self._client
        if name == "set_task":
            client.set_task(task_in(message.data, self._robot.description.name))
        elif name == "follow_trajectory":
            client.follow_trajectory(trajectory_of(message, self._robot, now))
        else:
            client.set_target(target_of(message, self._messages.base, now))
        if self._action is not None:
            self._action.replaced()

    def _vent(self) -> None:
        """Vent as soon as it is requested, whatever else is being done."""
        while not self._over.is_set():
            self._news["vents"].wait()
            self._news["vents"].clear()
            answers = []
            while self._vents:
                answers.append(self._vents.popleft())
            if answers:
                with suppress(IndexError):
                    while True:  # drop all commands that were requested before
                        self._jobs.popleft().done(False, "not done: somebody vents")
                self._guarded(partial(self._vent_now, answers))

    def _vent_now(self, answers: list[Done]) -> None:
        done, text = True, "vented"
        try:
            self._quick.vent()
        except StiffoptError as error:
            self._warn(f"the daemon did not vent ({error}); asking the guard")
            try:
                text = vent_rig(self._rig)
            except StiffoptError as failed:
                done, text = False, f"THE ARM MAY BE UNDER PRESSURE: {failed}"
        for answer in answers:
            answer(done, text)

    def _solve(self) -> None:
        """Solve the requested tasks for pressures, one after the other."""
        while not self._over.is_set():
            self._news["questions"].wait()
            self._news["questions"].clear()
            while self._questions and not self._over.is_set():
                text, target, answer = self._questions.popleft()
                self._guarded(partial(self._solve_one, text, target, answer))

    def _solve_one(
        self, text: str, target: PoseStamped | None, answer: Callable[..., None]
    ) -> None:
        try:
            task = self._task(text, target)
            now = self._now
            guess = None if now is None or not np.isfinite(now.commanded).all() else now.commanded
            answer(solve_pressure(self._robot, task, guess=guess), "")
        except StiffoptError as error:
            answer(None, str(error))

    def _task(self, text: str, target: PoseStamped | None) -> Task:
        """Return the requested task, within the rig's limits."""
        task = task_in(text, self._robot.description.name) if text else None
        if target is not None:
            wanted = target_of(target, self._messages.base, time.time())
            task = Task(target=wanted) if task is None else task.model_copy(
                update={"target": wanted}
            )  # fmt: skip
        if task is None:
            raise InputError("give a task, or a target with a frame_id")
        low, high = task.pressure_bounds(self._robot.description)
        high = np.minimum(high, limits_of(self._description, self._robot.description).high)
        within = PressureRange(min=tuple(low.tolist()), max=tuple(high.tolist()))
        return task.model_copy(update={"pressure": within})

    def _guarded(self, work: Callable[[], object]) -> None:
        """Run a piece of work; report an error in it and carry on."""
        try:
            work()
        except Exception as error:
            self._warn(f"unexpected {type(error).__name__}: {error}")

    # Answering -----------------------------------------------------------------------------------

    def _answer_topic(self, name: str) -> Done:
        """Return the callback for a command from a topic: it logs a refusal."""

        def answer(done: bool, text: str) -> None:
            if not done:
                self._log("refused", f"{name}: {text}", Severity.ERROR)

        return answer

    def _answer_trigger(self, service: Service, received: Received) -> Done:
        """Return the callback for a command from a service: it answers the request."""

        def answer(done: bool, text: str) -> None:
            self._reply(service, received, TriggerResponse(success=done, message=text))

        return answer

    def _reply(self, service: Service, received: Received, answer: Any) -> None:
        self._answers.submit(service.reply, received, answer)

    def _answer_solution(self, found: PressureSolution | None, text: str) -> None:
        if found is not None and found.found and found.pressures is not None:
            self._solution.publish(self._messages.answer(found.pressures, time.monotonic()))
        else:
            reason = text if found is None else found.message
            self._log("refused", f"solve: {reason}", Severity.ERROR)

    def _answer_solve(
        self, service: Service, received: Received, found: PressureSolution | None, text: str
    ) -> None:
        answer = SolvePressureResponse(status="refused", message=text)
        if found is not None:
            nan = float("nan")
            answer.status, answer.message = found.status, found.message
            answer.position_error = nan if found.position_error is None else found.position_error
            answer.angle_error = nan if found.angle_error is None else found.angle_error
            answer.stiffness = nan if found.stiffness is None else found.stiffness
            answer.stiffness_unit = found.stiffness_unit or ""
            now = time.monotonic()
            if found.pressures is not None:
                answer.pressures = self._messages.answer(found.pressures, now)
            if found.tip_pose is not None:
                answer.tip = self._messages.pose(found.tip_pose, now)
        self._reply(service, received, answer)
