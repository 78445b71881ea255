"""Topics of telemetry, live and recorded: the fields of the loop's state as messages.

The definition of a field in `stiffopt.control.state` names its topic. The messages are JSON.
Frames, the arm as a line and events are also sent as Foxglove's own message types, which its panels
show without set-up. Foxglove refuses union types in a schema (``["number", "null"]``), so a schema
has the type of a known value; an unknown scalar is left out, an unknown item is null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.state import Event, SeenPose, Severity, Snapshot, State, Timing
from stiffopt.control.state_fields import Entry, Kind, entries
from stiffopt.daemon.state_json import plain
from stiffopt.rig.interface import PoseSample

METADATA = "stiffopt-run"
"""Name of the metadata record of a run."""
FORMAT = "stiffopt-run/1"
STATES = tuple(map(str, State))
"""The index of a state is `state_number`, which can be plotted."""

_TIME_DECIMALS = 6
_ENCODER = json.JSONEncoder(allow_nan=False, check_circular=False, separators=(",", ":"))
_COUNT = {"type": "integer"}
_FURTHER: Mapping[str, Mapping[str, Any]] = {  # entries that are no fields of the state
    "/state": {
        "state_number": {
            "type": "integer",
            "oneOf": [{"title": name, "const": number} for number, name in enumerate(STATES)],
        }
    },
    "/timing": {"dropped": _COUNT},
}


@cache
def _logged(record: type, topic: str) -> tuple[Entry, ...]:
    """Return the fields of a record that belong to a topic."""
    return tuple(entry for entry in entries(record) if entry.shown.topic == topic)


def state_topics() -> tuple[str, ...]:
    """Return the topics of the fields of a `Snapshot`."""
    return tuple(dict.fromkeys(filter(None, (e.shown.topic for e in entries(Snapshot)))))


def topic_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic."""
    records: dict[str, type] = dict.fromkeys(state_topics(), Snapshot)
    records |= {"/tracker": SeenPose, "/timing": Timing, "/event": Event}
    schemas = {}
    for topic, record in records.items():
        fields = {entry.key: _schema(entry) for entry in _logged(record, topic)}
        schemas[topic] = {
            "title": f"stiffopt{topic.replace('/', '.')}",
            "type": "object",
            "properties": {"time_s": {"type": "number"}, **fields, **_FURTHER.get(topic, {})},
        }
    return schemas


def encoded(topic: str, time: float, record: Any, **further: Any) -> bytes:
    """Return the message of a topic for a record of the state, at a time in s."""
    message: dict[str, Any] = {"time_s": round(time, _TIME_DECIMALS)}
    kind: type = type(record)
    for entry in _logged(kind, topic):
        value = plain(getattr(record, entry.name), entry, rounded=True)
        if value is not None:
            message[entry.key] = value
    message.update(further)
    return _ENCODER.encode(message).encode()


def _schema(entry: Entry) -> dict[str, Any]:
    """Return the JSON schema of a field."""
    item: dict[str, Any] | None = {
        Kind.NUMBERS: {"type": "number"},
        Kind.COUNTS: _COUNT,
        Kind.FLAGS: {"type": "boolean"},
    }.get(entry.kind)
    if entry.kind is Kind.RECORDS:
        fields = {inner.key: _schema(inner) for inner in entries(entry.type)}
        item = {"type": "object", "properties": fields}
    return {"type": entry.kind.value} if item is None else {"type": "array", "items": item}


BASE, TIP, TARGET, SEEN = "base", "tip", "target", "tip_seen"
"""Names of the frames; all are children of the base."""

_RARE = ("/state", "/limits")
_TARGET_SIZE = 0.004  # m
_ARM_COLOUR, _TARGET_COLOUR = (0.31, 0.47, 0.65, 0.7), (0.84, 0.15, 0.16, 0.8)
_FORCE_COLOUR = (0.55, 0.34, 0.29, 1.0)
_FORCE_THICKNESS = 0.002  # m
_LENGTH_OF_FORCE = 1.0  # m per N: scale of a drawn force, a millimetre for each mN
_WITHIN_95 = 2.8  # standard deviations of a 95 % region in three dimensions
_LARGEST_ELLIPSOID = 0.2  # m, along an axis in which the arm cannot feel


class TelemetryChannels:
    """Writes snapshots, events and the shape of the arm to the topics of a context of foxglove.

    `offset` is the date of time 0 on the rig's clock, in ns since 1970; `thickness` is that of the
    drawn arm, in m.
    """

    def __init__(self, context: Any, offset: int, thickness: float) -> None:
        from foxglove import Channel
        from foxglove.channels import FrameTransformsChannel, LogChannel, SceneUpdateChannel

        self._offset, self._thickness = offset, thickness
        self._seen: PoseSample | None = None
        self._json = {
            topic: Channel(topic, schema=schema, context=context)
            for topic, schema in topic_schemas().items()
        }
        self._each_tick = [topic for topic in state_topics() if topic not in _RARE]
        self._frames = FrameTransformsChannel("/tf", context=context)
        self._scene = SceneUpdateChannel("/scene", context=context)
        self._log = LogChannel("/log", context=context)

    def close(self) -> None:
        """Withdraw the topics."""
        channels: list[Any] = [*self._json.values(), self._frames, self._scene, self._log]
        for channel in channels:
            channel.close()

    def nanoseconds(self, time: float) -> int:
        """Return the date, in ns since 1970, of a time on the rig's clock."""
        return self._offset + round(time * 1e9)

    def log_tick(self, now: Snapshot) -> None:
        """Log the topics of each tick, such as pressures and the tip."""
        for topic in self._each_tick:
            self._log_json(topic, now.time, now)

    def log_samples(self, now: Snapshot) -> None:
        """Log the tracker's samples, with their capture times."""
        for sample in now.samples:
            if sample.visible and not now.rejected:
                self._seen = sample
            seen = SeenPose(
                sample.time,
                sample.received,
                sample.frame,
                sample.position,
                sample.quaternion,
                doubted=now.rejected > 0,
            )
            self._log_json("/tracker", sample.time, seen, at=now.time)

    def log_state(self, now: Snapshot) -> None:
        """Log state, alarms and limits, which change rarely."""
        self._log_json("/state", now.time, now, state_number=STATES.index(now.state))
        self._log_json("/limits", now.time, now)

    def log_timing(self, now: Snapshot, dropped: int) -> None:
        """Log the loop's timing, and the number of snapshots dropped before they were logged."""
        self._log_json("/timing", now.time, now.timing, dropped=dropped)

    def log_event(self, event: Event) -> None:
        """Log an event, for people and for programs."""
        from foxglove.messages import Log, LogLevel

        moment = self.nanoseconds(event.time)
        level = {
            Severity.INFO: LogLevel.Info,
            Severity.WARNING: LogLevel.Warning,
            Severity.ERROR: LogLevel.Error,
        }[event.severity]
        message = Log(
            timestamp=_timestamp(moment), level=level, message=event.text, name=event.kind
        )
        self._log.log(message, log_time=moment)
        self._log_json("/event", event.time, event)

    def log_arm(self, now: Snapshot, poses: Array) -> None:
        """Log the arm's shape, as poses (m, 4, 4) along it, and the target."""
        from foxglove.messages import (
            LinePrimitive,
            Point3,
            Pose,
            Quaternion,
            SceneUpdate,
            SpherePrimitive,
            Vector3,
        )

        moment = self.nanoseconds(now.time)
        points = [Point3(x=x, y=y, z=z) for x, y, z in poses[:, :3, 3].tolist()]
        line = LinePrimitive(points=points, thickness=self._thickness, color=_colour(_ARM_COLOUR))
        entities = [_entity(moment, "arm", lines=[line])]
        where = target_place(now)
        if where is not None:
            x, y, z = where.tolist()
            place = Pose(
                position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=0, y=0, z=0, w=1)
            )
            size = Vector3(x=_TARGET_SIZE, y=_TARGET_SIZE, z=_TARGET_SIZE)
            ball = SpherePrimitive(pose=place, size=size, color=_colour(_TARGET_COLOUR))
            entities.append(_entity(moment, TARGET, spheres=[ball]))
        if now.touches:
            entities.append(_force(moment, now))
        self._scene.log(SceneUpdate(entities=entities), log_time=moment)

    def log_frames(self, now: Snapshot) -> None:
        """Log the frames of the tip, of the target and of the tip in the last sample."""
        from foxglove.messages import FrameTransforms

        moment = self.nanoseconds(now.time)
        frames = [_frame(moment, TIP, now.tip_position, now.tip_quaternion)]
        where = target_place(now)
        if where is not None:
            frames.append(_frame(moment, TARGET, where, target_turn(now)))
        if self._seen is not None:
            captured = self.nanoseconds(self._seen.time)
            frames.append(_frame(captured, SEEN, self._seen.position, self._seen.quaternion))
        known = [frame for frame in frames if frame is not None]
        if known:
            self._frames.log(FrameTransforms(transforms=known), log_time=moment)

    def _log_json(
        self, topic: str, time: float, record: Any, *, at: float | None = None, **more: Any
    ) -> None:
        """Log the message of a topic for a record at a time, in the tick at `at`."""
        moment = self.nanoseconds(time if at is None else at)
        self._json[topic].log(encoded(topic, time, record, **more), log_time=moment)


def _timestamp(moment: int) -> Any:
    from foxglove.messages import Timestamp

    return Timestamp(moment // 10**9, moment % 10**9)


def _colour(parts: Sequence[float]) -> Any:
    from foxglove.messages import Color

    red, green, blue, opacity = parts
    return Color(r=red, g=green, b=blue, a=opacity)


def _frame(moment: int, name: str, position: Array, quaternion: Array | None) -> Any:
    """Return a frame in the base, or None if its place is unknown."""
    from foxglove.messages import FrameTransform, Quaternion, Vector3

    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if quaternion is None else quaternion.tolist()
    if not np.isfinite([*position.tolist(), w, x, y, z]).all():
        return None
    a, b, c = position.tolist()
    return FrameTransform(
        timestamp=_timestamp(moment),
        parent_frame_id=BASE,
        child_frame_id=name,
        translation=Vector3(x=a, y=b, z=c),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
    )


def _entity(moment: int, name: str, **shapes: Any) -> Any:
    """Return an entity of the base frame; it disappears unless redrawn within 1 s."""
    from foxglove.messages import Duration, SceneEntity

    stamp, soon = _timestamp(moment), Duration(1)
    return SceneEntity(timestamp=stamp, frame_id=BASE, id=name, lifetime=soon, **shapes)


def _force(moment: int, now: Snapshot) -> Any:
    """Return the force on the tip as a line from the tip, with its 95 % ellipsoid at the end."""
    from foxglove.messages import (
        LinePrimitive,
        Point3,
        Pose,
        Quaternion,
        SpherePrimitive,
        Vector3,
    )

    end = now.tip_position + _LENGTH_OF_FORCE * now.wrench[:3]
    variances, axes = np.linalg.eigh(now.wrench_covariance.reshape(3, 3))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    sizes = 2 * _WITHIN_95 * _LENGTH_OF_FORCE * np.sqrt(np.maximum(variances, 0.0))
    w, x, y, z = np.asarray(lie.quaternion_from_rotation(axes)).tolist()
    points = [Point3(x=a, y=b, z=c) for a, b, c in (now.tip_position.tolist(), end.tolist())]
    a, b, c = end.tolist()
    place = Pose(position=Vector3(x=a, y=b, z=c), orientation=Quaternion(x=x, y=y, z=z, w=w))
    a, b, c = np.minimum(sizes, _LARGEST_ELLIPSOID).tolist()
    colour = _colour(_FORCE_COLOUR)
    line = LinePrimitive(points=points, thickness=_FORCE_THICKNESS, color=colour)
    pale = _colour((*_FORCE_COLOUR[:3], 0.25))
    ball = SpherePrimitive(pose=place, size=Vector3(x=a, y=b, z=c), color=pale)
    return _entity(moment, "force", lines=[line], spheres=[ball])


def target_place(now: Snapshot) -> Array | None:
    """Return the position (3,) of the target, with the tip's coordinates along free axes."""
    if now.target_position is None:
        return None
    where: Array = np.where(np.isfinite(now.target_position), now.target_position, now.tip_position)
    return where if np.isfinite(where).all() else None


def target_turn(now: Snapshot) -> Array | None:
    """Return the target's orientation (4,), or the smallest rotation to its direction."""
    if now.target_quaternion is not None:
        return now.target_quaternion
    if now.target_pointing is None:
        return None
    return lie.quaternion_along(now.target_pointing)
