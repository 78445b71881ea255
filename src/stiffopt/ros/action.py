"""The action ``FollowJointTrajectory``: a trajectory of pressures as a goal that is followed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from stiffopt.control.state import Snapshot, State
from stiffopt.daemon.client import Client
from stiffopt.errors import InputError
from stiffopt.paths.trajectory import Trajectory
from stiffopt.ros.messages import (
    CancelGoalRequest,
    CancelGoalResponse,
    Duration,
    FeedbackMessage,
    FollowFeedback,
    FollowResult,
    GetResultRequest,
    GetResultResponse,
    GoalInfo,
    GoalStatus,
    GoalStatusArray,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
    SendGoalRequest,
    SendGoalResponse,
)
from stiffopt.ros.node import Received, RosNode, Service
from stiffopt.ros.published import seconds_of, time_of

Done = Callable[[bool, str], None]
NAME = "~/follow_joint_trajectory"

_UNKNOWN, _EXECUTING, _SUCCEEDED, _CANCELED, _ABORTED = 0, 2, 4, 5, 6  # states of goals
_NO_ERROR, _PATH_VIOLATED = 0, -4  # error codes of results
_NONE, _REJECTED, _UNKNOWN_GOAL, _TERMINATED = range(4)  # return codes of a cancellation
_KEPT = 20  # goals whose results are kept
_LATE = 0.2  # s after the beginning, in which the state may still be older


@dataclass
class _Goal:
    """An accepted goal; `waiting` are the requests for its result."""

    info: Any
    client: Received
    trajectory: Trajectory
    begin: float  # on the rig's clock
    status: int = _EXECUTING
    result: Any = None
    waiting: list[tuple[Service, Received]] = field(default_factory=list)


class FollowAction:
    """Accepts one goal at a time; a further goal, or any other motion, aborts it.

    A goal succeeds when its time is over and the arm was controlled all the time. Otherwise it is
    aborted, and the arm is held.

    Parameters
    ----------
    node, client : the node on the graph, and the client of the daemon.
    channels : names of all channels.
    read : makes a trajectory from a message, or raises `InputError`.
    move, once : queue a command that sets the arm in motion, or another one.
    reply, refuse : answer a request, and report why something is not done.
    """

    def __init__(
        self,
        node: RosNode,
        client: Client,
        channels: list[str],
        read: Callable[[JointTrajectory], Trajectory],
        move: Callable[..., None],
        once: Callable[..., None],
        reply: Callable[[Service, Received, Any], object],
        refuse: Done,
    ) -> None:
        self._client, self._channels, self._read = client, channels, read
        self._move, self._once, self._reply, self._refuse = move, once, reply, refuse
        self._goals: dict[bytes, _Goal] = {}
        self._goal: _Goal | None = None
        self._lock = threading.RLock()
        own = f"{node.names.full(NAME)}/_action"
        self._feedback = node.publisher(f"{own}/feedback", FeedbackMessage)
        self._status = node.publisher(f"{own}/status", GoalStatusArray, 1, latched=True)
        node.serve(f"{own}/send_goal", SendGoalRequest, self._send)
        node.serve(f"{own}/cancel_goal", CancelGoalRequest, self._cancel)
        node.serve(f"{own}/get_result", GetResultRequest, self._ask_result)

    def look(self, now: Snapshot) -> None:
        """Publish the goal's progress, or end it, depending on the state."""
        goal = self._goal
        if goal is None or now.time < goal.begin + _LATE:
            return
        gone = now.time - goal.begin
        if now.state is not State.ACTIVE:
            why = f"the arm is {now.state}{': ' if now.reason else ''}{now.reason}"
            self._end(goal, _ABORTED, why)
            hold = partial(self._client.hold, "the goal was aborted")
            self._once(NAME, goal.client, hold, lambda done, text: None)
        elif gone >= goal.trajectory.duration:
            self._end(goal, _SUCCEEDED, "")
        else:
            self._feedback.publish(
                FeedbackMessage(goal.info.goal_id, self._progress(goal, now, gone))
            )

    def replaced(self) -> None:
        """Abort the goal because another motion was requested."""
        if self._goal is not None:
            self._end(self._goal, _ABORTED, "another motion was asked for")

    def _progress(self, goal: _Goal, now: Snapshot, gone: float) -> Any:
        times = [waypoint.time for waypoint in goal.trajectory.waypoints]
        columns = np.asarray(goal.trajectory.pressures).T
        desired = np.array([np.interp(gone, times, column) for column in columns])
        since = Duration(int(gone), int(gone % 1 * 1e9))
        points = [
            JointTrajectoryPoint(positions=row.tolist(), time_from_start=since)
            for row in (desired, now.measured, desired - now.measured)
        ]
        return FollowFeedback(Header(time_of(time.time())), self._channels, *points)

    def _send(self, service: Service, received: Received) -> None:
        asked, found = received.message, list[Trajectory]()

        def command() -> None:
            wanted = asked.goal
            if bytes(asked.goal_id.uuid) in self._goals:
                raise InputError("there was a goal with this identity")
            if wanted.multi_dof_trajectory.points or any(
                getattr(wanted, f"{part}_tolerance")
                for part in ("path", "component_path", "goal", "component_goal")
            ):
                raise InputError(
                    "tolerances, and joints of several degrees of freedom, are not supported"
                )
            found.append(self._read(wanted.trajectory))
            self._client.follow_trajectory(found[0])

        def done(accepted: bool, text: str) -> None:
            stamp = time_of(time.time())
            if accepted:
                self._begin(GoalInfo(asked.goal_id, stamp), received, found[0])
            else:
                self._refuse(False, text)
            self._reply(service, received, SendGoalResponse(accepted=accepted, stamp=stamp))

        self._move(NAME, service.requests, received, command, done)

    def _begin(self, info: Any, client: Received, trajectory: Trajectory) -> None:
        with self._lock:
            self.replaced()
            self._goal = _Goal(info, client, trajectory, time.monotonic())
            self._goals[bytes(info.goal_id.uuid)] = self._goal
            if len(self._goals) > _KEPT:
                del self._goals[next(iter(self._goals))]
        self._publish_status()

    def _end(self, goal: _Goal, status: int, why: str) -> None:
        with self._lock:
            if goal.result is not None:
                return
            error = _NO_ERROR if status == _SUCCEEDED else _PATH_VIOLATED
            goal.status, goal.result = status, FollowResult(error, why)
            waiting, goal.waiting = goal.waiting, []
            if self._goal is goal:
                self._goal = None
        self._publish_status()
        for service, received in waiting:
            self._reply(service, received, GetResultResponse(status=status, result=goal.result))

    def _publish_status(self) -> None:
        listed = [GoalStatus(goal.info, goal.status) for goal in self._goals.values()]
        self._status.publish(GoalStatusArray(listed))

    def _ask_result(self, service: Service, received: Received) -> None:
        answer = GetResultResponse(status=_UNKNOWN)
        with self._lock:
            goal = self._goals.get(bytes(received.message.goal_id.uuid))
            if goal is not None:
                if goal.result is None:
                    goal.waiting.append((service, received))
                    return
                answer.status, answer.result = goal.status, goal.result
        self._reply(service, received, answer)

    def _cancel(self, service: Service, received: Received) -> None:
        """Cancel the goal if the request selects it by identity, by age, or selects all goals."""
        wanted, goal = received.message.goal_info, self._goal
        identity, latest = bytes(wanted.goal_id.uuid), seconds_of(wanted.stamp)

        def answer(code: int, *goals: Any) -> None:
            response = CancelGoalResponse(return_code=code, goals_canceling=list(goals))
            self._reply(service, received, response)

        def done(held: bool, text: str) -> None:
            if held and goal is not None:
                self._end(goal, _CANCELED, "it was canceled")
                answer(_NONE, goal.info)
            else:
                self._refuse(False, text)
                answer(_REJECTED)

        if goal is not None and (
            identity == bytes(goal.info.goal_id.uuid)
            or seconds_of(goal.info.stamp) <= latest
            or not (any(identity) or latest)
        ):
            hold = partial(self._client.hold, "the goal was canceled")
            self._once(NAME, received, hold, done)
        elif any(identity):
            answer(_TERMINATED if identity in self._goals else _UNKNOWN_GOAL)
        else:
            answer(_NONE)
