"""The standard definitions of ROS 2, as rosbags has them: an oracle of bytes, hashes and IDL."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

STORES = {"humble": Stores.ROS2_HUMBLE, "jazzy": Stores.ROS2_JAZZY}
_IDL = {
    "float64": "double",
    "float32": "float",
    "int32": "long",
    "uint32": "unsigned long",
    "uint8": "octet",
    "byte": "octet",
    "string": "string",
    "bool": "boolean",
}
_IDS = {
    "int8": 2,
    "uint8": 3,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "float64": 11,
    "bool": 15,
}
_IDS |= {"uint16": 5, "string": 17}
_KINDS = {None: 0, 0: 144}  # added for one value, for any number of them; 48 for a fixed number
_NUMPY = {"byte": "uint8", "char": "uint8"}
_MANY = (Nodetype.SEQUENCE, Nodetype.ARRAY)
_FOLLOW = "control_msgs/action/FollowJointTrajectory"
CONTROL = {  # of control_msgs 4.0 to 5.8, which are those of Humble and Jazzy; rosbags has none
    "control_msgs/msg/JointTolerance": """
        string name
        float64 position
        float64 velocity
        float64 acceleration""",
    "control_msgs/msg/JointComponentTolerance": """
        string joint_name
        uint16 component
        float64 position
        float64 velocity
        float64 acceleration""",
    f"{_FOLLOW}_Goal": """
        trajectory_msgs/JointTrajectory trajectory
        trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
        control_msgs/JointTolerance[] path_tolerance
        control_msgs/JointComponentTolerance[] component_path_tolerance
        control_msgs/JointTolerance[] goal_tolerance
        control_msgs/JointComponentTolerance[] component_goal_tolerance
        builtin_interfaces/Duration goal_time_tolerance""",
    f"{_FOLLOW}_Result": """
        int32 error_code
        string error_string""",
    f"{_FOLLOW}_Feedback": """
        std_msgs/Header header
        string[] joint_names
        trajectory_msgs/JointTrajectoryPoint desired
        trajectory_msgs/JointTrajectoryPoint actual
        trajectory_msgs/JointTrajectoryPoint error
        string[] multi_dof_joint_names
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
        trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error""",
}
ID, TIME = "unique_identifier_msgs/UUID goal_id", "builtin_interfaces/Time stamp"
# what rosidl makes of an action
FEEDBACK = {f"{_FOLLOW}_FeedbackMessage": f"{ID}\n{_FOLLOW}_Feedback feedback"}
CALLS = {
    "action_msgs/srv/CancelGoal": (
        "action_msgs/GoalInfo goal_info",
        "int8 return_code\naction_msgs/GoalInfo[] goals_canceling",
    ),
    f"{_FOLLOW}_SendGoal": (f"{ID}\n{_FOLLOW}_Goal goal", f"bool accepted\n{TIME}"),
    f"{_FOLLOW}_GetResult": (ID, f"int8 status\n{_FOLLOW}_Result result"),
}


def typestore(distro: str) -> Typestore:
    store = get_typestore(STORES[distro])
    for name, text in {**CONTROL, **FEEDBACK}.items():
        add_message(store, name, text)
    return store


def add_message(store: Typestore, name: str, text: str) -> None:
    (made,) = get_types_from_msg(text, name).values()  # under another name, for a service
    store.register({name: made})


def fields_of(store: Typestore, name: str) -> Iterator[tuple[str, Any, int | None, Any]]:
    """Yield name, kind, count (None: one; 0: any number) and type of each field."""
    for field, (kind, inner) in store.fielddefs[name][1]:
        count = None
        if kind in _MANY:
            count = inner[1] if kind == Nodetype.ARRAY else 0
            kind, inner = inner[0]
        yield field, kind, count, inner if kind == Nodetype.NAME else inner[0]


# IDL ----------------------------------------------------------------------------------------------


def idl_of(store: Typestore, names: Iterable[str]) -> str:
    """Return the IDL of types and of what they are made of."""
    found: dict[str, str] = {}

    def visit(name: str) -> None:
        if name in found:
            return
        lines = []
        for field, kind, count, inner in fields_of(store, name):
            if kind == Nodetype.NAME:
                visit(inner)
            word = inner.replace("/", "::") if kind == Nodetype.NAME else _IDL[inner]
            lines.append(f"{word if count is None else f'sequence<{word}>'} {field};")
        package, folder, last = name.split("/")
        body = " ".join(lines)
        found[name] = f"module {package} {{ module {folder} {{ struct {last} {{ {body} }}; }}; }};"

    for name in names:
        visit(name)
    return "\n".join(found.values())


# Bytes --------------------------------------------------------------------------------------------


def random_pair(
    store: Typestore, name: str, ours: dict[str, type[Any]], rng: np.random.Generator
) -> tuple[Any, Any]:
    """Return the same random message as one of ours and as one of rosbags'."""
    mine, theirs = {}, {}
    for field, kind, count, inner in fields_of(store, name):
        size = 1 if count is None else count or int(rng.integers(0, 4))
        if kind == Nodetype.NAME:
            pairs = [random_pair(store, inner, ours, rng) for _ in range(size)]
            one, other = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        else:
            one = [_random(inner, rng) for _ in range(size)]
            numbers = inner not in ("string", "bool")
            other = np.array(one, dtype=_NUMPY.get(inner, inner)) if numbers else one
            if count is None:
                other = one
        mine[field], theirs[field] = (one[0], other[0]) if count is None else (one, other)
    if not mine:
        theirs["structure_needs_at_least_one_member"] = 0
    return ours[name](**mine), store.types[name](**theirs)


def _random(kind: str, rng: np.random.Generator) -> Any:
    if kind == "string":
        return "".join(map(chr, rng.integers(0x20, 0x17F, int(rng.integers(0, 9)))))
    if kind == "bool":
        return bool(rng.integers(2))
    if kind.startswith("float"):
        return float(np.float32(rng.normal()))
    if kind == "byte":  # which rosbags takes as signed
        return int(rng.integers(128))
    info = np.iinfo(_NUMPY.get(kind, kind))
    return int(rng.integers(info.min, info.max, endpoint=True, dtype=info.dtype))


# Hashes -------------------------------------------------------------------------------------------


def service_hash(name: str, request: str, response: str, store: Typestore) -> str:
    """Return the hash of a service's definition (REP 2016), which rosbags does not know."""
    time, info = "builtin_interfaces/msg/Time", "service_msgs/msg/ServiceEventInfo"
    described: dict[str, list[dict[str, Any]]] = {
        info: [
            _field("event_type", 3),
            _field("stamp", 1, time),
            _field("client_gid", 51, capacity=16),  # rosidl reads `char` as `uint8`
            _field("sequence_number", 8),
        ]
    }

    def visit(kind: str) -> None:
        fields = []
        for field, sort, count, inner in fields_of(store, kind):
            named = sort == Nodetype.NAME
            if named:
                visit(inner)
            number = (1 if named else _IDS[inner]) + _KINDS.get(count, 48)
            fields.append(_field(field, number, inner if named else "", count or 0))
        described[kind] = fields or [_field("structure_needs_at_least_one_member", 3)]

    for part, text in {"Request": request, "Response": response}.items():
        add_message(store, f"{name}_{part}", text)
        visit(f"{name}_{part}")
    visit(time)
    described[f"{name}_Event"] = [
        _field("info", 1, info),
        _field("request", 97, f"{name}_Request", capacity=1),
        _field("response", 97, f"{name}_Response", capacity=1),
    ]
    parts = ("request", "response", "event")
    own = [_field(f"{p}_message", 1, f"{name}_{p.capitalize()}") for p in parts]
    rest = [{"type_name": each, "fields": described[each]} for each in sorted(described)]
    whole = {
        "type_description": {"type_name": name, "fields": own},
        "referenced_type_descriptions": rest,
    }
    return hashlib.sha256(json.dumps(whole).encode()).hexdigest()


def _field(name: str, number: int, nested: str = "", capacity: int = 0) -> dict[str, Any]:
    kind = {
        "type_id": number,
        "capacity": capacity,
        "string_capacity": 0,
        "nested_type_name": nested,
    }
    return {"name": name, "type": kind}
