"""What clients send, and how it becomes a task, a target or a trajectory, and back.

Plain numbers in SI; the unit of a quantity stands in its name. Unknown keys, text for numbers, NaN
and infinities are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    TypeAdapter,
    ValidationError,
)

from stiffopt.control.contents import contents, differences, listed
from stiffopt.control.trajectory import MAX_WAYPOINTS, Trajectory, Waypoint
from stiffopt.daemon.refusals import sentence
from stiffopt.documents import document_of
from stiffopt.errors import InputError, Loc, shown
from stiffopt.files import from_document
from stiffopt.optimise.goal import MatchMatrix, StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, PressureRange, Task

__all__ = [
    "MAX_MESSAGE",
    "MAX_WAYPOINTS",
    "ControlRequest",
    "HoldRequest",
    "TargetMessage",
    "TaskMessage",
    "TaskRequest",
    "TaskText",
    "TrajectoryMessage",
    "task_of",
    "trajectory_of",
]

MAX_MESSAGE = 16_384
"""Characters of the longest message to a stream."""
_MAX_TEXT = 65_536  # characters of a task file; to read more would keep the control loop waiting
_MAX_MEASURES = 50
_MAX_CHANNELS = 200

ModelT = TypeVar("ModelT")
MessageT = TypeVar("MessageT", bound="_Message")

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Coordinate = Annotated[float, Field(ge=-1e3, le=1e3)]
Position = Annotated[list[Coordinate | None], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[float], Field(min_length=4, max_length=4)]
Positive = Annotated[float, Field(gt=0)]
PerChannel = float | Annotated[list[float | None], Field(max_length=_MAX_CHANNELS)]
Frame = Literal["base", "tip"]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _example(**example: Any) -> ConfigDict:
    """Return the configuration of a message whose schema shows an example."""
    return ConfigDict(json_schema_extra={"examples": [example]})


class ControlRequest(_Message):
    """Who wants control: a name for the people who find it taken."""

    model_config = _example(client="planner")

    client: Annotated[str, Field(min_length=1, max_length=80)]


class HoldRequest(_Message):
    """Why the pressures shall stay as they are."""

    reason: Annotated[str, Field(min_length=1, max_length=200)] = "a client asked for it"


class ToleranceMessage(_Message):
    """How near is near enough."""

    position_m: Positive = 1e-4
    angle_rad: Positive = math.radians(1)


class TargetMessage(_Message):
    """A tip pose in the base frame: a position (null: this axis is free), a direction in which
    the tip points, or an orientation (w, x, y, z).
    """  # noqa: D205

    model_config = _example(position_m=[0.0, None, 0.2])

    position_m: Position | None = None
    pointing: Vector | None = None
    orientation_wxyz: Quaternion | None = None
    tolerance: ToleranceMessage = ToleranceMessage()

    def target(self) -> Target:
        """Return it in code; raise `InputError` if it makes no sense."""
        return Target(
            position=self.position_m,
            pointing=self.pointing,
            orientation=self.orientation_wxyz,
            tolerance=Tolerance(position=self.tolerance.position_m, angle=self.tolerance.angle_rad),
        )

    @classmethod
    def of(cls, target: Target) -> TargetMessage:
        """Return the message that says this; raise `InputError` if it cannot say all of it."""
        return _saying_all_of(target, lambda: _target_message(target), cls.target)


class WaypointMessage(_Message):
    """A target, and when to be there, counted from the beginning."""

    time_s: Annotated[float, Field(ge=0)]
    target: TargetMessage

    def waypoint(self) -> Waypoint:
        """Return it in code; raise `InputError` if it makes no sense."""
        return Waypoint(time=self.time_s, target=self.target.target())


class TrajectoryMessage(_Message):
    """Waypoints in order of time, all of which ask for the same axes of the pose."""

    model_config = _example(
        waypoints=[
            {"time_s": 0.0, "target": {"position_m": [0.0, 0.0, 0.2]}},
            {"time_s": 2.0, "target": {"position_m": [0.01, 0.0, 0.2]}},
        ]
    )

    waypoints: Annotated[list[WaypointMessage], Field(min_length=1, max_length=MAX_WAYPOINTS)]

    @classmethod
    def of(cls, trajectory: Trajectory) -> TrajectoryMessage:
        """Return the message that says this; raise `InputError` if it cannot say all of it."""
        return _saying_all_of(trajectory, lambda: _trajectory_message(trajectory), cls.trajectory)

    def trajectory(self) -> Trajectory:
        """Return it in code; raise `InputError` if it makes no sense."""
        return Trajectory(waypoints=[waypoint.waypoint() for waypoint in self.waypoints])


def trajectory_of(given: Any) -> Trajectory:
    """Return the trajectory that the JSON of a `TrajectoryMessage` asks for.

    Its waypoints are read one by one: in one go, ten thousand would keep the control thread, which
    has to share the interpreter, from its ticks.

    Raises
    ------
    InputError
        It makes no sense.
    """
    waypoints = given.get("waypoints") if isinstance(given, dict) else None
    if not isinstance(waypoints, list) or not 1 <= len(waypoints) <= MAX_WAYPOINTS:
        raise InputError(f"waypoints: expected a list of 1 to {MAX_WAYPOINTS}")
    _valid(_TRAJECTORY, {**given, "waypoints": waypoints[:1]}, ())
    read = []
    for index, waypoint in enumerate(waypoints):
        read.append(_valid(_WAYPOINT, waypoint, ("waypoints", index)).waypoint())
    return Trajectory(waypoints=read)


class MeasureMessage(_Message):
    """A stiffness along a direction or, of the kind rotation, about it."""

    direction: Vector
    frame: Frame = "base"
    kind: Literal["translation", "rotation"] = "translation"
    boundary: Literal["free", "guided", "clamped"] = "free"


class AtLeastMessage(MeasureMessage):
    """A stiffness that shall not be less than a value in N/m, for a rotation in N m/rad."""

    value: Positive


class MatchMessage(AtLeastMessage):
    """A stiffness that shall be a value in N/m, for a rotation in N m/rad."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.01


class MatrixMessage(_Message):
    """A stiffness matrix that the tip shall have against translation."""

    matrix_n_per_m: Annotated[list[Vector], Field(min_length=3, max_length=3)]
    frame: Frame = "base"
    boundary: Literal["guided", "clamped"] = "guided"
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.01


class StiffnessMessage(_Message):
    """What is asked of the stiffness: the smallest of `maximise` as great as can be, or a match."""

    maximise: Annotated[list[MeasureMessage], Field(max_length=_MAX_MEASURES)] = []
    at_least: Annotated[list[AtLeastMessage], Field(max_length=_MAX_MEASURES)] = []
    match: MatchMessage | MatrixMessage | None = None


class LoadMessage(_Message):
    """A load at the tip; in the frame of the tip it follows the tip."""

    force_n: Vector = [0.0, 0.0, 0.0]
    moment_nm: Vector = [0.0, 0.0, 0.0]
    frame: Frame = "base"


class PressureMessage(_Message):
    """Limits that tighten the robot's: one for all channels, or one per channel."""

    min_pa: PerChannel | None = None
    max_pa: PerChannel | None = None


class TaskMessage(_Message):
    """What the arm shall do. A robot, if it is named, must be the daemon's."""

    model_config = _example(
        target={"position_m": [0.0, 0.0, 0.18]},
        stiffness={"maximise": [{"direction": [1.0, 0.0, 0.0]}]},
        load={"force_n": [0.0, 0.0, -0.02]},
        pressure={"max_pa": 120000.0},
    )

    target: TargetMessage
    stiffness: StiffnessMessage | None = None
    load: LoadMessage | None = None
    pressure: PressureMessage = PressureMessage()
    robot: Annotated[str, Field(min_length=1, max_length=200)] | None = None

    @classmethod
    def of(cls, task: Task, robot: str | None = None) -> TaskMessage:
        """Return the message that says this of the robot of a name.

        Raises
        ------
        InputError
            It cannot say all of it; the text names what it cannot.
        """
        return _saying_all_of(
            task, lambda: _task_message(task, robot), lambda message: message.task(task.robot)
        )

    def task(self, robot: str) -> Task:
        """Return it in code, for the robot of a name; raise `InputError` if it makes no sense."""
        load, limits = self.load, self.pressure
        return Task(
            robot=robot,
            target=self.target.target(),
            stiffness=None if self.stiffness is None else _stiffness(self.stiffness),
            load=None
            if load is None
            else Load(force=load.force_n, moment=load.moment_nm, frame=load.frame),
            pressure=PressureRange(min=limits.min_pa, max=limits.max_pa),
        )


class TaskText(_Message):
    """The text of a task file. A robot, if it is named, must be the daemon's; no file is read."""

    model_config = _example(
        text="format: stiffopt-task/1\ntarget: {position: [0 mm, 0 mm, 180 mm]}\n"
    )

    text: Annotated[str, Field(min_length=1, max_length=_MAX_TEXT)]


def _which(value: Any) -> str:
    is_text = "text" in value if isinstance(value, dict) else isinstance(value, TaskText)
    return "<text>" if is_text else "<task>"


TaskRequest = Annotated[
    Annotated[TaskText, Tag("<text>")] | Annotated[TaskMessage, Tag("<task>")],
    Discriminator(_which),
]
"""A task as a message, or as the text of its file."""


def task_of(given: Any, robot: str) -> Task:
    """Return the task that the JSON of a `TaskRequest` asks for. No file is read, whatever it says.

    Parameters
    ----------
    given :
        From a client.
    robot :
        Name of the robot that there is.

    Raises
    ------
    InputError
        It makes no sense, or is for another robot.
    """
    request = _valid(_TASK, given, ())
    if isinstance(request, TaskText):
        return _task_of_text(request.text, robot)
    _same_robot(request.robot, robot)
    return request.task(robot)


def _task_of_text(text: str, robot: str) -> Task:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise InputError("the text of the task is not UTF-8") from None
    document = document_of(text, "task")
    _same_robot(document.data.get("robot"), robot)
    document.data["robot"] = robot
    return from_document(document, "task", Task)


def _same_robot(given: Any, robot: str) -> None:
    if given is not None and given != robot:
        raise InputError(
            f"robot: {shown(given)} is not the robot here, '{robot}'; name that, or leave it out"
        )


def _valid(adapter: TypeAdapter[ModelT], given: Any, place: Loc) -> ModelT:
    try:
        return adapter.validate_python(given)
    except ValidationError as error:
        mistakes = [{**mistake, "loc": (*place, *mistake["loc"])} for mistake in error.errors()]
        raise InputError(sentence(mistakes)) from None


_WAYPOINT = TypeAdapter(WaypointMessage)
_TRAJECTORY = TypeAdapter(TrajectoryMessage)
_TASK: TypeAdapter[TaskText | TaskMessage] = TypeAdapter(TaskRequest)


def _stiffness(message: StiffnessMessage) -> StiffnessGoal:
    match = message.match
    wanted: Any = None if match is None else match.model_dump()
    if isinstance(match, MatrixMessage):
        wanted = {"matrix": wanted.pop("matrix_n_per_m"), **wanted}
    return StiffnessGoal(
        maximise=[m.model_dump() for m in message.maximise],
        at_least=[m.model_dump() for m in message.at_least],
        match=wanted,
    )


def _saying_all_of(
    given: BaseModel, said: Callable[[], MessageT], heard: Callable[[MessageT], BaseModel]
) -> MessageT:
    """Return a message, if whoever gets it hears all that was to be said.

    Parameters
    ----------
    given :
        What is to be said.
    said :
        Makes the message.
    heard :
        Makes of the message what its receiver makes of it.

    Raises
    ------
    InputError
        The message cannot say all of it, or says it differently; the text names the keys.
    """
    try:
        message = said()
    except ValidationError as error:
        raise InputError(sentence(error.errors())) from None
    if lost := differences(contents(given), contents(heard(message))):
        raise InputError(
            f"{listed(lost)}: the daemon's messages cannot say this, and it would be lost"
        )
    return message


def _target_message(target: Target) -> TargetMessage:
    return TargetMessage(
        position_m=_listed(target.position),
        pointing=_listed(target.pointing),
        orientation_wxyz=_listed(target.orientation),
        tolerance=ToleranceMessage(
            position_m=target.tolerance.position, angle_rad=target.tolerance.angle
        ),
    )


def _trajectory_message(trajectory: Trajectory) -> TrajectoryMessage:
    return TrajectoryMessage(
        waypoints=[
            WaypointMessage(time_s=w.time, target=_target_message(w.target))
            for w in trajectory.waypoints
        ]
    )


def _task_message(task: Task, robot: str | None) -> TaskMessage:
    load, limits = task.load, task.pressure
    return TaskMessage(
        target=_target_message(task.target),
        stiffness=None if task.stiffness is None else _stiffness_message(task.stiffness),
        load=None
        if load is None
        else LoadMessage(force_n=list(load.force), moment_nm=list(load.moment), frame=load.frame),
        pressure=PressureMessage(min_pa=_per_channel(limits.min), max_pa=_per_channel(limits.max)),
        robot=robot,
    )


def _stiffness_message(goal: StiffnessGoal) -> StiffnessMessage:
    match: MatchMessage | MatrixMessage | None = None
    if isinstance(goal.match, MatchMatrix):
        match = MatrixMessage(
            matrix_n_per_m=[list(row) for row in goal.match.matrix],
            frame=goal.match.frame,
            boundary=goal.match.boundary,
            tolerance=goal.match.tolerance,
        )
    elif goal.match is not None:
        match = MatchMessage(**_measure(goal.match, MatchMessage))
    return StiffnessMessage(
        maximise=[MeasureMessage(**_measure(m, MeasureMessage)) for m in goal.maximise],
        at_least=[AtLeastMessage(**_measure(m, AtLeastMessage)) for m in goal.at_least],
        match=match,
    )


def _measure(measure: StiffnessMeasure, message: type[_Message]) -> dict[str, Any]:
    said = {name: getattr(measure, name) for name in message.model_fields}
    return {**said, "direction": list(measure.direction)}


def _listed(values: Any) -> Any:
    return None if values is None else list(values)


def _per_channel(values: float | tuple[float | None, ...] | None) -> Any:
    return list(values) if isinstance(values, tuple) else values
