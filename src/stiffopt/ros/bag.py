"""Recorded runs as bags: MCAP in rosbag2's layout, with the messages that the node publishes."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import yaml
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence

from stiffopt.daemon.run_log import RecordedRun
from stiffopt.documents import document_of
from stiffopt.errors import StiffoptError
from stiffopt.files import from_document
from stiffopt.logs.mcap_file import McapWriter
from stiffopt.logs.table import writing
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.ros.messages import ros_name
from stiffopt.ros.names import NodeNames
from stiffopt.ros.published import PUBLISHED, Message, StateMessages

_NODE = "stiffopt"
_VERSION = 5  # of the layout: that of Humble, which later versions read
_SHAPE = 0.2  # s between messages of the arm's shape
_STATE = 1.0  # s between messages of the state
_COMMIT = 1000  # messages in a chunk
_BASIC = {str: "string", bool: "bool"}
_RULE = "=" * 80


def write_bag(
    run: RecordedRun, folder: Path, name: str, check: Callable[[], None] = lambda: None
) -> int:
    """Write a run into an empty folder, as the bag `name`; return the number of messages.

    `check` is called now and then, and may raise.

    Raises `FileError`: the bag cannot be written; `MissingExtraError`: foxglove-sdk is not
    installed.
    """
    from foxglove import Channel, Context, Schema

    description = from_document(
        document_of(run.about["robot_file"], "robot"), "robot", RobotDescription
    )
    epoch = int(run.about["start_ns"])
    made = StateMessages(Manipulator(description), run.about["rig"], _NODE, epoch * 1e-9)
    names, context = NodeNames(_NODE), Context()
    kinds = {topic: kind for topic, (kind, _, _) in PUBLISHED.items()}
    channels: dict[str, Any] = {}
    counts: Counter[str] = Counter()
    moments = [epoch + round(float(time) * 1e9) for time in run.time[[0, -1]]]
    file = f"{name}_0.mcap"
    with writing(folder / file):
        target = os.open(folder / file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        writer = McapWriter(target, context, {"stiffopt": dict(run.about)}, profile="ros2")
        for time, (topic, message) in _messages(run, made):
            if topic not in channels:
                text = definition(kinds[topic]).encode()
                channels[topic] = Channel(
                    names.full(topic), message_encoding="cdr", context=context,
                    schema=Schema(name=ros_name(kinds[topic]), encoding="ros2msg", data=text),
                )  # fmt: skip
            moment = epoch + round(time * 1e9)
            channels[topic].log(bytes(message.serialize()), log_time=moment)
            counts[topic] += 1
            if counts.total() % _COMMIT == 0:
                writer.commit()
                check()
        writer.close()
        about = _about(
            file, {names.full(t): (ros_name(kinds[t]), counts[t]) for t in counts}, moments
        )
        content = yaml.safe_dump(about, sort_keys=False)
        (folder / "metadata.yaml").write_text(content, encoding="utf-8")
    return counts.total()


def definition(kind: type[Any]) -> str:
    """Return a message's definition with those of all messages in it, in the form of bags."""
    found: dict[str, str] = {}

    def visit(each: type[Any]) -> None:
        lines = []
        for field, hint in each.__annotations__.items():
            many = next((part for part in get_args(hint) if isinstance(part, sequence)), None)
            inner = hint if many is None else many.subtype
            if isinstance(inner, type) and issubclass(inner, IdlStruct):
                visit(inner)
                package, _, last = ros_name(inner).split("/")
                word = f"{package}/{last}"
            else:
                word = _BASIC.get(inner) or str(get_args(inner)[1])
            lines.append(f"{word}{'' if many is None else '[]'} {field}")
        found[ros_name(each)] = "\n".join(lines)

    visit(kind)
    own = found.pop(ros_name(kind))
    parts = [own]
    for full, text in found.items():
        package, _, last = full.split("/")
        parts.append(f"{_RULE}\nMSG: {package}/{last}\n{text}")
    return "\n".join(parts) + "\n"


def _messages(run: RecordedRun, made: StateMessages) -> Iterator[tuple[float, Message]]:
    """Yield times, in s from the beginning, and messages, in order."""
    events = list(run.events)
    shape_due = state_due = -float("inf")
    last = None
    for now in run.snapshots():
        while events and events[0].time <= now.time:
            event = events.pop(0)
            yield max(event.time, float(run.time[0])), ("/rosout", made.log(event))
        for each in made.often(now):
            yield now.time, each
        if now.time >= shape_due:
            shape_due = now.time + _SHAPE
            try:
                shapes = list(made.shape(now))
            except StiffoptError:  # an arm without a known shape is not drawn
                shapes = []
            for each in shapes:
                yield now.time, each
        state = made.state(now)
        if state != last or now.time >= state_due:
            last, state_due = state, now.time + _STATE
            yield now.time, ("~/state", state)


def _about(file: str, topics: dict[str, tuple[str, int]], moments: list[int]) -> dict[str, Any]:
    """Return the content of ``metadata.yaml``."""
    begin = {"nanoseconds_since_epoch": moments[0]}
    duration = {"nanoseconds": moments[1] - moments[0]}
    total = sum(count for _, count in topics.values())
    listed = [
        {
            "topic_metadata": {
                "name": name,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": count,
        }
        for name, (kind, count) in topics.items()
    ]
    one = {"path": file, "starting_time": begin, "duration": duration, "message_count": total}
    return {
        "rosbag2_bagfile_information": {
            "version": _VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [file],
            "duration": dict(duration),
            "starting_time": dict(begin),
            "message_count": total,
            "topics_with_message_count": listed,
            "compression_format": "",
            "compression_mode": "",
            "files": [one],
        }
    }
