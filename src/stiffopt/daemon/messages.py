"""JSON messages of clients (tasks, targets, trajectories), derived from the schemas of the files.

A message is the JSON form of a `Schema`: the same keys, plain numbers in SI units, and names that
end in the unit. It is generated from the fields of the schema, so that a key added to a schema is
also in its message. Unknown keys, text instead of numbers, NaN and infinities are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from operator import or_
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import annotated_types as bounds
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    TypeAdapter,
    ValidationError,
    create_model,
)
from pydantic.fields import FieldInfo

from stiffopt.control.checks import listed
from stiffopt.documents import document_of
from stiffopt.errors import InputError, Loc, dotted, shown
from stiffopt.files import from_document
from stiffopt.model.obstacles.mesh import Mesh
from stiffopt.optimise.measure import Measure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import MAX_WAYPOINTS, Trajectory, Waypoint
from stiffopt.schema import Schema
from stiffopt.units import QuantityKind, unit_suffix

MAX_MESSAGE = 16_384
"""Characters of the longest message to a stream."""
_MAX_TEXT = 65_536  # characters of a task file; reading more would delay the control loop
_MAX_ITEMS = 50  # of a list of descriptions, such as stiffness measures
_MAX_MISTAKES = 5  # in an answer
_MAX_NUMBERS = 200  # of a list with one number per channel

_UNITS_IN_NAMES = {"orientation": "orientation_wxyz", "matrix": "matrix_n_per_m"}
"""Names of fields whose type shows neither the unit nor the order of their numbers."""

ModelT = TypeVar("ModelT")
ClassT = TypeVar("ClassT", bound=type)


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _example(**example: Any) -> ConfigDict:
    """Return the configuration of a message whose schema shows an example."""
    return ConfigDict(json_schema_extra={"examples": [example]})


class ControlRequest(_Message):
    """The name of the client that wants control, for others who find it taken."""

    model_config = _example(client="planner")

    client: Annotated[str, Field(min_length=1, max_length=80)]


class HoldRequest(_Message):
    """The reason why the pressures are to be held."""

    reason: Annotated[str, Field(min_length=1, max_length=200)] = "a client asked for it"


class ChannelsRequest(_Message):
    """The channels to do without, counted from 1; all others are given back."""

    without: Annotated[list[Annotated[int, Field(ge=1)]], Field(max_length=_MAX_NUMBERS)]


def _valid(adapter: TypeAdapter[ModelT], given: Any, place: Loc) -> ModelT:
    try:
        return adapter.validate_python(given)
    except ValidationError as error:
        mistakes = [{**mistake, "loc": (*place, *mistake["loc"])} for mistake in error.errors()]
        raise InputError(sentence(mistakes)) from None


def sentence(mistakes: Sequence[Any]) -> str:
    """Format pydantic's list of mistakes as one sentence."""
    parts = []
    for mistake in mistakes[:_MAX_MISTAKES]:
        place = dotted([step for step in mistake["loc"] if not str(step).startswith("<")])
        reason = str(mistake["msg"])
        parts.append(f"{place}: {reason}" if place else reason)
    more = f"; and {len(mistakes) - _MAX_MISTAKES} more" if len(mistakes) > _MAX_MISTAKES else ""
    return "; also ".join(parts) + more


# Messages from schemas ---------------------------------------------------------------------------


class SchemaMessage(_Message):
    """The JSON form of a `Schema`; `message_of` makes a subclass for each.

    Attributes
    ----------
    schema_class : the schema.
    names : JSON names of its fields, by their names in the schema.
    """

    schema_class: ClassVar[type[Schema]]
    names: ClassVar[Mapping[str, str]]

    @classmethod
    def of(cls, given: Schema, **more: Any) -> Self:
        """Return the message for a description, with the keys in `more` replaced.

        `InputError`: the description is of a subclass with further keys, which the message would
        lose, or has values that no message may have.
        """
        lost: list[Loc] = []
        message = {**_json_of(given, (), lost), **more}
        if lost:
            places = listed([dotted(place) for place in lost])
            raise InputError(
                f"{places}: the daemon's messages cannot contain this, so it would be lost"
            )
        return _valid(TypeAdapter(cls), message, ())

    def read(self, **more: Any) -> Any:
        """Return the description, with the keys in `more` replaced; may raise `InputError`."""
        return self.schema_class(**{**_keys_of(self), **more})


def _json_of(value: Any, place: Loc, lost: list[Loc]) -> Any:
    """Return a description as JSON; add keys that its message does not have to `lost`."""
    if isinstance(value, Schema):
        message = next(_MADE[each] for each in type(value).__mro__ if each in _MADE)
        found = {}
        fields = type(value).model_fields
        for name in (*fields, *(value.model_extra or ())):
            field = getattr(value, name)
            if field is None or (name in fields and _is_implied(fields[name])):
                continue
            if name in message.names:
                found[message.names[name]] = _json_of(field, (*place, name), lost)
            else:
                lost.append((*place, name))
        return found
    if isinstance(value, list | tuple):
        return [_json_of(item, (*place, index), lost) for index, item in enumerate(value)]
    return value


def _keys_of(value: Any) -> Any:
    """Return the contents of a message under the keys of its schema."""
    if isinstance(value, SchemaMessage):
        return {name: _keys_of(getattr(value, key)) for name, key in value.names.items()}
    if isinstance(value, list):
        return [_keys_of(item) for item in value]
    return value


_MADE: dict[type[Schema], type[SchemaMessage]] = {}


def message_of(schema: type[Schema], base: type[SchemaMessage] = SchemaMessage) -> Any:
    """Return the message class of a schema, including those of the schemas in it.

    Fields of `base` replace those of the same name.
    """
    if schema not in _MADE or base is not SchemaMessage:
        hints = get_type_hints(schema, include_extras=True)
        kept = {n: info for n, info in schema.model_fields.items() if not _is_left_out(info)}
        names = {
            name: _UNITS_IN_NAMES.get(name) or name + unit_suffix(_unit(hints[name]))
            for name in kept
        }
        fields: dict[str, Any] = {
            names[name]: (_type(hints[name]), _default(info))
            for name, info in kept.items()
            if names[name] not in base.model_fields
        }
        own = base is not SchemaMessage
        made = create_model(
            base.__name__ if own else f"{schema.__name__}Message",
            __base__=base,
            __doc__=base.__doc__ if own else (schema.__doc__ or "").partition("\n\n")[0],
            **fields,
        )
        made.schema_class, made.names = schema, names
        _MADE[schema] = made
    return _MADE[schema]


def _with_fields_of(schema: type[Schema]) -> Callable[[ClassT], ClassT]:
    """Return a class decorator that adds the fields of a schema to a message."""
    return lambda base: message_of(schema, base)


def _is_implied(info: FieldInfo) -> bool:
    """Return whether a field is not part of messages: it has one value, or no key in files."""
    args = get_args(info.annotation)
    is_constant = get_origin(info.annotation) is Literal and len(args) == 1
    return bool(info.exclude) or (is_constant and not info.is_required())


def _is_left_out(info: FieldInfo) -> bool:
    """Return whether messages do not carry a field: it is implied, or names a file."""
    return _is_implied(info) or Mesh in get_args(info.annotation)


def _unit(hint: Any) -> str:
    """Return the unit in the type of a field; empty if it has none."""
    args = get_args(hint)
    own = [part.unit for part in args[1:] if isinstance(part, QuantityKind)]
    return next(filter(None, [*own, *(_unit(part) for part in args)]), "")


def _type(hint: Any) -> Any:
    """Return the JSON type, with bounds, for the type of a field in a schema."""
    origin, args = get_origin(hint), get_args(hint)
    if isinstance(hint, type) and issubclass(hint, Schema):
        return message_of(hint)
    if origin is Annotated:
        kinds = [get_args(each)[0] for each in get_args(args[0]) if get_origin(each) is Annotated]
        if kinds and all(isinstance(kind, type) and issubclass(kind, Measure) for kind in kinds):
            return _either(kinds)
        return _bounded(_type(args[0]), args[1:])
    if origin in (Union, UnionType):
        return Union[tuple(map(_type, args))]  # noqa: UP007 - made of a tuple
    if origin is tuple:
        if args[-1] is not Ellipsis:
            return Annotated[list[_type(args[0])], bounds.Len(len(args), len(args))]  # type: ignore[misc]
        item = _type(args[0])
        most = MAX_WAYPOINTS if args[0] is Waypoint else _MAX_ITEMS
        if not _is_message(item):
            most = _MAX_NUMBERS
        return Annotated[list[item], bounds.Len(0, most)]  # type: ignore[valid-type]
    return hint


def _is_message(kind: Any) -> bool:
    """Return whether a JSON type is a message, or a choice of messages."""
    if isinstance(kind, type):
        return issubclass(kind, SchemaMessage)
    return get_origin(kind) in (Annotated, Union) and _is_message(get_args(kind)[0])


def _either(kinds: list[type[Measure]]) -> Any:
    """Return the type of the messages of measures, which are told apart by their keys."""
    messages = {kind.key: message_of(kind) for kind in kinds}

    def which(value: Any) -> str:
        given = value.names if isinstance(value, SchemaMessage) else value
        for key, message in reversed(messages.items()):
            name = key if given is not value else message.names[key]
            if isinstance(given, Mapping) and name in given:
                return f"<{key}>"
        return f"<{kinds[0].key}>"

    tagged = [Annotated[message, Tag(f"<{key}>")] for key, message in messages.items()]
    return Annotated[reduce(or_, tagged), Discriminator(which)]


def _bounded(kind: Any, metadata: tuple[Any, ...]) -> Any:
    """Return a type with those of a field's validators that apply to plain JSON."""
    flat = [p for m in metadata for p in (m.metadata if isinstance(m, FieldInfo) else [m])]
    if kind is float:
        kept = [part for part in flat if isinstance(part, bounds.BaseMetadata | AfterValidator)]
    else:
        kept = [part for part in flat if isinstance(part, bounds.BaseMetadata)]
    return Annotated[kind, *kept] if kept else kind


def _default(info: FieldInfo) -> Any:
    if info.is_required():
        return ...
    if isinstance(info.default, Schema):
        return message_of(type(info.default)).of(info.default)
    return list(info.default) if isinstance(info.default, tuple) else info.default


@_with_fields_of(Target)
class TargetMessage(SchemaMessage):
    """A tip pose in the base frame: a position (null: this axis is free), a direction in which
    the tip points, or an orientation (w, x, y, z).
    """  # noqa: D205

    model_config = _example(position_m=[0.0, None, 0.2])


@_with_fields_of(Trajectory)
class TrajectoryMessage(SchemaMessage):
    """Waypoints in order of time, all of which ask for the same axes of the pose."""

    model_config = _example(
        waypoints=[
            {"time_s": 0.0, "target": {"position_m": [0.0, 0.0, 0.2]}},
            {"time_s": 2.0, "target": {"position_m": [0.01, 0.0, 0.2]}},
        ]
    )


@_with_fields_of(Task)
class TaskMessage(SchemaMessage):
    """A task for the arm. A robot, if it is named, must be the daemon's."""

    model_config = _example(
        target={"position_m": [0.0, 0.0, 0.18]},
        stiffness={"maximise": [{"direction": [1.0, 0.0, 0.0]}]},
        load={"force_n": [0.0, 0.0, -0.02]},
        pressure={"max_pa": 120000.0},
    )

    robot: Annotated[str, Field(min_length=1, max_length=200)] | None = None


# Reading them ------------------------------------------------------------------------------------


def trajectory_of(given: Any) -> Trajectory:
    """Return the trajectory in the JSON of a `TrajectoryMessage`; `InputError` for a mistake.

    Waypoints are read one by one: ten thousand at once would block the interpreter, and so the
    control thread, for too long.
    """
    waypoints = given.get("waypoints") if isinstance(given, dict) else None
    if not isinstance(waypoints, list) or not 1 <= len(waypoints) <= MAX_WAYPOINTS:
        raise InputError(f"waypoints: expected a list of 1 to {MAX_WAYPOINTS}")
    _valid(_TRAJECTORY, {**given, "waypoints": waypoints[:1]}, ())
    read = []
    for index, waypoint in enumerate(waypoints):
        read.append(_valid(_WAYPOINT, waypoint, ("waypoints", index)).read())
    return Trajectory(waypoints=read)


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
    """Return the task in the JSON of a `TaskRequest`; `robot` is the name of the daemon's.

    No file is read, whatever the text of a task file names. `InputError`: there is a mistake, or
    the task is for another robot.
    """
    request = _valid(_TASK, given, ())
    if isinstance(request, TaskText):
        return _task_of_text(request.text, robot)
    _check_robot(request.robot, robot)
    return request.read(robot=robot)


def _task_of_text(text: str, robot: str) -> Task:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise InputError("the text of the task is not UTF-8") from None
    document = document_of(text, "task")
    _check_robot(document.data.get("robot"), robot)
    _check_scene(document.data.get("scene"))
    document.data["robot"] = robot
    return from_document(document, "task", Task)


def _check_scene(given: Any) -> None:
    """Refuse a scene that needs a file here: a scene file, or a mesh."""
    objects = given.get("objects") if isinstance(given, dict) else None
    meshes = [each for each in objects or () if isinstance(each, dict) and "mesh" in each]
    if isinstance(given, str) or meshes:
        what = "a mesh" if meshes else "a scene file"
        raise InputError(f"scene: no file is read here, so {what} cannot be sent; send the objects")


def _check_robot(given: Any, robot: str) -> None:
    if given is not None and given != robot:
        raise InputError(
            f"robot: {shown(given)} is not the robot here, '{robot}'; name that, or leave it out"
        )


_WAYPOINT: TypeAdapter[SchemaMessage] = TypeAdapter(message_of(Waypoint))
_TRAJECTORY = TypeAdapter(TrajectoryMessage)
_TASK: TypeAdapter[TaskText | TaskMessage] = TypeAdapter(TaskRequest)
