"""Settings of a rig that belong to no device: safety, control, service and recordings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from stiffopt.model.description import PerChannelPressure, PerChannelRate
from stiffopt.schema import BadKeyError, Schema
from stiffopt.units import Duration, Force, Frequency, Length, Ratio, Speed


def _none(value: Any) -> Any:
    """Read the word ``none`` as None: a file has no other way to write it."""
    return None if value == "none" else value


def _beside(value: Any, info: ValidationInfo) -> Any:
    """Make a path in a file independent of the working directory."""
    folder = info.context.get("folder") if isinstance(info.context, Mapping) else None
    return str(Path(folder) / value) if folder is not None and isinstance(value, str) else value


_Port = Annotated[int, Field(ge=0, le=65535, strict=True)]
_Time = Annotated[Duration, Field(gt=0, le=3600)]
_TimeOrNone = Annotated[
    _Time | None, BeforeValidator(_none, json_schema_input_type=_Time | Literal["none"])
]
_PortOrNone = Annotated[
    _Port | None, BeforeValidator(_none, json_schema_input_type=_Port | Literal["none"])
]


class Safety(Schema):
    """Limits of what may be commanded, and what counts as a fault.

    Attributes
    ----------
    max_pressure : one value or one per channel, in Pa; None: that of the robot.
    max_slew : one value or one per channel, in Pa/s; None: that of the robot.
    max_force : sum over all chambers of pressure times area, in N; None: no limit.
    command_timeout : a command that was not repeated for this long no longer holds, in s.
    guard_timeout : the guard vents when the loop has not commanded for this long, in s.
    tracker_timeout : a tracker that has not seen the tip for this long is lost and the pressures
        are let down, in s.
    tracker_frames : missing frames in a row after which the pressures are held.
    max_tip_speed : no tip moves faster; samples that say so are rejected, in m/s.
    max_jumps : rejected samples in a row that are a fault.
    max_pressure_error : between what a regulator should have reached and what is measured, in Pa;
        more than that, for `pressure_error_time`, is a fault.
    pressure_error_time : in s.
    max_overruns : ticks in a row that came too late, which are a fault.
    ramp_time : in which pressures are let down in a controlled way, in s.
    heartbeat : a client that has not been heard for this long has lost control, in s.
    hold_timeout : pressures that the loop holds by itself are let down after this long, in s; a
        client's own hold lasts while its heartbeat does. None, in a file ``none``: never, which
        `unlimited_hold` has to accept.
    unlimited_hold : ``accepted``: the loop may hold pressures for ever, also of an arm that it does
        not understand; ``refused``: it may not.
    unprotected_supply : ``accepted``: a supply may be armed although it has neither a watchdog nor
        a dump valve, so that nothing vents the arm when this computer fails; ``refused``: it may
        not. Simulated supplies are exempt.
    """

    max_pressure: PerChannelPressure | None = None
    max_slew: PerChannelRate | None = None
    max_force: Annotated[Force, Field(gt=0)] | None = None
    command_timeout: Annotated[Duration, Field(gt=0, le=10)] = 0.5
    guard_timeout: Annotated[Duration, Field(ge=0.01, le=2)] = 0.05
    tracker_timeout: Annotated[Duration, Field(gt=0, le=10)] = 0.5
    tracker_frames: Annotated[int, Field(ge=1, le=100)] = 3
    max_tip_speed: Annotated[Speed, Field(gt=0)] = 0.6
    max_jumps: Annotated[int, Field(ge=1, le=100)] = 5
    max_pressure_error: Annotated[PerChannelPressure, Field()] = 1.5e4
    pressure_error_time: Annotated[Duration, Field(gt=0, le=10)] = 0.3
    max_overruns: Annotated[int, Field(ge=1)] = 10
    ramp_time: Annotated[Duration, Field(gt=0, le=10)] = 1.0
    heartbeat: Annotated[Duration, Field(gt=0, le=60)] = 1.0
    hold_timeout: _TimeOrNone = 10.0
    unlimited_hold: Literal["refused", "accepted"] = "refused"
    unprotected_supply: Literal["refused", "accepted"] = "refused"

    @model_validator(mode="after")
    def _is_accepted(self) -> Safety:
        if self.hold_timeout is None and self.unlimited_hold != "accepted":
            raise BadKeyError(
                "hold_timeout",
                "without one, pressures may be held for ever on an arm that is not understood; "
                "give a time, or say 'unlimited_hold: accepted' as well",
            )
        return self


class ControlSettings(Schema):
    """Settings of the control loop.

    Attributes
    ----------
    regulator_lag : time constant with which a regulator follows its set-point, in s.
    regulator_dead_time : until a set-point has any effect, in s.
    tracker_noise : standard deviation of a tracked position in each axis, in m.
    vibration : ``modelled``: the arm swings as its robot file says; ``none``: it follows its
        pressures at once, as a damped arm does; ``auto``: ``none`` on a simulated rig without
        inertia, else ``modelled``.
    damping : share of critical damping of that vibration; where the rig file has none, that which
        commissioning has found.
    frequency : of the swing of the vented arm, in Hz; None: what commissioning has found, or else
        what the robot file implies.
    solver : of the small quadratic program of each tick.
    adaptation : ``auto``: the arm's numbers are adapted to where the tip is seen at rest; ``none``.
    """

    regulator_lag: Annotated[Duration, Field(ge=0, le=2)] = 0.06
    regulator_dead_time: Annotated[Duration, Field(ge=0, le=1)] = 0.01
    tracker_noise: Annotated[Length, Field(gt=0)] = 5e-5
    vibration: Literal["auto", "modelled", "none"] = "auto"
    damping: Annotated[Ratio, Field(ge=0, lt=1)] = 0.06
    frequency: Annotated[Frequency, Field(gt=0, le=50)] | None = None
    solver: Literal["daqp", "osqp"] = "daqp"
    adaptation: Literal["auto", "none"] = "auto"


class ServiceSettings(Schema):
    """Where the daemon listens. Loopback, unless you know what you do.

    Attributes
    ----------
    host : address.
    port : of the control interface (HTTP and WebSocket) and of the metrics; 0: any free one.
    foxglove_port : of the Foxglove WebSocket, which anyone who reaches it may read, web pages of
        any site included; 0: any free one; None, in a file ``none``: no such server.
    token : environment variable that holds the token of those who may move the arm; where it is
        empty, a token is drawn and written to `token_file`.
    token_file : for this user's eyes only; by default beside the recordings.
    """

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: _Port = 8470
    foxglove_port: _PortOrNone = None
    token: Annotated[str, Field(min_length=1)] = "STIFFOPT_TOKEN"
    token_file: str | None = None


class RosSettings(Schema):
    """What `stiffopt ros` shows on a ROS 2 graph, and what it takes from there.

    Attributes
    ----------
    commands : whether whoever is on the graph may move the arm; venting is taken in any case.
    interface : network interface, such as ``eth0``; None: loopback, on which no other machine is.
        It has to be given, as ``lo`` too, where commands are taken.
    domain : of DDS; None: the environment variable ROS_DOMAIN_ID, or else 0.
    distro : by whose layout other nodes are told what there is.
    namespace, node : of the node.
    frame_prefix : before the names of the frames: ``base``, ``tip``, ``target``, ``station_1`` ...
    remap : names of topics and services in the place of others, such as ``~/tip: /arm/tip``.
    rate : at which the state is published, in Hz.
    """

    commands: bool = False
    interface: Annotated[str, Field(min_length=1)] | None = None
    domain: Annotated[int, Field(ge=0, le=232, strict=True)] | None = None
    distro: Literal["humble", "jazzy"] = "jazzy"
    namespace: str = "/"
    node: Annotated[str, Field(min_length=1)] = "stiffopt"
    frame_prefix: str = ""
    remap: dict[str, str] = Field(default_factory=dict)
    rate: Annotated[Frequency, Field(gt=0, le=100)] = 20.0

    @model_validator(mode="after")
    def _says_where_from(self) -> RosSettings:
        if self.commands and self.interface is None:
            raise BadKeyError(
                "commands",
                "needs 'interface': DDS has no token, so whoever is on that network could move the "
                "arm; 'lo' is this machine alone",
            )
        return self


class LogSettings(Schema):
    """Settings of recordings.

    Attributes
    ----------
    folder : made if it is not there.
    """

    folder: Annotated[str, Field(min_length=1)] = "runs"


class CommissioningSettings(Schema):
    """What `stiffopt commission` has to have found before the arm may be armed.

    Attributes
    ----------
    record : path of its record, relative to the rig file; by default beside it, with its name and
        the ending ``.commissioning.yaml``.
    max_age : an older record does not count, in s.
    required : whether the arm may be armed only with a record that fits; by default so, but not
        for simulated supplies. A record that is there and says that something does not fit
        counts in any case.
    """

    record: Annotated[str, BeforeValidator(_beside)] | None = None
    max_age: Annotated[Duration, Field(gt=0)] = 24 * 3600.0
    required: bool | None = None


class Published(Schema):
    """What was published of this arm: experiments show it beside what they find.

    Attributes
    ----------
    stiffness : path of a table of stiffness, relative to the rig file.
    tip_error : error of a model's tip along each axis that most of the time was not exceeded, in m.
    largest_tip_error : the largest along an axis, in m.
    """

    stiffness: str | None = None
    tip_error: Annotated[Length, Field(gt=0)] | None = None
    largest_tip_error: Annotated[Length, Field(gt=0)] | None = None
