"""Settings of a rig that belong to no device: safety, control, service and recordings."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from stiffopt.files import folder_of
from stiffopt.model.description import PerChannelPressure, PerChannelRate
from stiffopt.schema import BadKeyError, Schema
from stiffopt.units import Duration, Force, Frequency, Length, Ratio, Speed

MAX_GUARD_TIMEOUT = 2.0  # s


def _none(value: Any) -> Any:
    """Read the word ``none`` as None: a file has no other way to write it."""
    return None if value == "none" else value


def _beside(value: Any, info: ValidationInfo) -> Any:
    """Make a path in a file independent of the working directory."""
    return str(folder_of(info) / value) if isinstance(value, str) else value


_Port = Annotated[int, Field(ge=0, le=65535, strict=True)]
_Time = Annotated[Duration, Field(gt=0, le=3600)]
_TimeOrNone = Annotated[
    _Time | None, BeforeValidator(_none, json_schema_input_type=_Time | Literal["none"])
]
_PortOrNone = Annotated[
    _Port | None, BeforeValidator(_none, json_schema_input_type=_Port | Literal["none"])
]


class Safety(Schema):
    """Limits of commands, and definitions of faults.

    Attributes
    ----------
    max_pressure : one value or one per channel, in Pa; None: that of the robot.
    max_slew : one value or one per channel, in Pa/s; None: that of the robot.
    max_force : largest sum over all chambers of pressure times area, in N; None: no limit.
    command_timeout : time after which a command expires unless repeated, in s.
    guard_timeout : time without a command of the loop after which the guard vents, in s.
    tracker_timeout : time without sight of the tip after which the tracker counts as lost and the
        pressures are let down, in s.
    tracker_frames : successive missing frames after which the pressures are held.
    max_tip_speed : greatest speed of the tip, in m/s; samples that imply a greater one are
        rejected.
    max_jumps : successive rejected samples that are a fault.
    max_pressure_error : largest difference between the pressure that a regulator should have
        reached and the measured one, in Pa; exceeding it for `pressure_error_time` is a fault.
    pressure_error_time : in s.
    max_overruns : successive late ticks that are a fault.
    ramp_time : duration of letting the pressures down, in s.
    heartbeat : time of silence after which a client loses control, in s.
    hold_timeout : time after which pressures that the loop holds on its own are let down, in s; a
        client's own hold lasts while its heartbeat does. None, in a file ``none``: never, which
        requires `unlimited_hold`.
    unlimited_hold : ``accepted``: the loop may hold pressures for ever, even on an arm whose state
        it does not know; ``refused``: it may not.
    unprotected_supply : ``accepted``: a supply may be armed although it has neither a watchdog nor
        a dump valve, so that nothing vents the arm when this computer fails; ``refused``: it may
        not. Simulated supplies are exempt.
    """

    max_pressure: PerChannelPressure | None = None
    max_slew: PerChannelRate | None = None
    max_force: Annotated[Force, Field(gt=0)] | None = None
    command_timeout: Annotated[Duration, Field(gt=0, le=10)] = 0.5
    guard_timeout: Annotated[Duration, Field(ge=0.01, le=MAX_GUARD_TIMEOUT)] = 0.05
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
                "without one, pressures may be held for ever on an arm whose motion is not "
                "explained; give a time, or add 'unlimited_hold: accepted'",
            )
        return self


class ControlSettings(Schema):
    """Settings of the control loop.

    Attributes
    ----------
    regulator_lag : time constant with which a regulator follows its set-point, in s.
    regulator_dead_time : time until a set-point has any effect, in s.
    tracker_noise : standard deviation of a tracked position in each axis, in m.
    vibration : ``modelled``: the arm vibrates according to its robot file; ``none``: it follows its
        pressures at once, as a damped arm does; ``auto``: ``none`` on a simulated rig without
        inertia, otherwise ``modelled``.
    damping : share of critical damping of that vibration; if the rig file has none, the result of
        commissioning.
    frequency : frequency of the vented arm's vibration, in Hz; None: the result of commissioning,
        or the one that the robot file implies.
    solver : solver of each tick's small quadratic program.
    adaptation : ``auto``: the model's numbers are adapted to where the tip is seen at rest;
        ``none``: they are not.
    tip_speed : speed that neither the tip nor the part of its motion by any channel exceeds on the
        way to a plan, in m/s, so that a fault that only the tip shows moves it less before it is
        told. Feedback comes on top. None: the slew alone bounds it.
    """

    regulator_lag: Annotated[Duration, Field(ge=0, le=2)] = 0.06
    regulator_dead_time: Annotated[Duration, Field(ge=0, le=1)] = 0.01
    tracker_noise: Annotated[Length, Field(gt=0)] = 5e-5
    vibration: Literal["auto", "modelled", "none"] = "auto"
    damping: Annotated[Ratio, Field(ge=0, lt=1)] = 0.06
    frequency: Annotated[Frequency, Field(gt=0, le=50)] | None = None
    solver: Literal["daqp", "osqp"] = "daqp"
    adaptation: Literal["auto", "none"] = "auto"
    tip_speed: Annotated[Speed, Field(gt=0)] | None = None


class ServiceSettings(Schema):
    """Addresses at which the daemon listens. Use loopback unless you know what you do.

    Attributes
    ----------
    host : address.
    port : port of the control interface (HTTP and WebSocket) and of the metrics; 0: any free one.
    foxglove_port : port of the Foxglove WebSocket, which anyone who reaches it may read, including
        web pages of any site; 0: any free one; None, in a file ``none``: no such server.
    token : environment variable with the token of those who may move the arm; if it is empty, a
        token is drawn and written to `token_file`.
    token_file : file that only this user can read; by default next to the recordings.
    """

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: _Port = 8470
    foxglove_port: _PortOrNone = None
    token: Annotated[str, Field(min_length=1)] = "STIFFOPT_TOKEN"
    token_file: str | None = None

    @model_validator(mode="after")
    def _has_two_ports(self) -> ServiceSettings:
        if self.foxglove_port and self.foxglove_port == self.port:
            raise BadKeyError("foxglove_port", f"{self.port} is the port of the service itself")
        return self


class RosSettings(Schema):
    """What `stiffopt ros` publishes on a ROS 2 graph, and what it accepts from there.

    Attributes
    ----------
    commands : whether anyone on the graph may move the arm; venting is always accepted.
    interface : network interface, such as ``eth0``; None: loopback, which no other machine can
        reach. Required if commands are accepted, even for ``lo``.
    domain : DDS domain; None: the environment variable ROS_DOMAIN_ID, by default 0.
    distro : ROS 2 distribution whose discovery messages are used.
    namespace, node : names of the node.
    frame_prefix : prefix of the names of the frames: ``base``, ``tip``, ``target``, ``station_1``
        ...
    remap : names that replace those of topics and services, such as ``~/tip: /arm/tip``.
    rate : rate of publishing the state, in Hz.
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
    folder : folder of the recordings; made if it does not exist.
    """

    folder: Annotated[str, Field(min_length=1)] = "runs"


class CommissioningSettings(Schema):
    """The record of `stiffopt commission` that is required before the arm may be armed.

    Attributes
    ----------
    record : path of the record, relative to the rig file; by default next to it, with its name and
        the ending ``.commissioning.yaml``.
    max_age : greatest valid age of a record, in s.
    required : whether arming requires a record that fits; by default it does, except for simulated
        supplies. An existing record that reports a misfit always counts.
    """

    record: Annotated[str, BeforeValidator(_beside)] | None = None
    max_age: Annotated[Duration, Field(gt=0)] = 24 * 3600.0
    required: bool | None = None


class Published(Schema):
    """Published results of this arm, which experiments show next to theirs.

    Attributes
    ----------
    stiffness : path of a table of stiffness, relative to the rig file.
    tip_error : error of a model's tip along each axis that was mostly not exceeded, in m.
    largest_tip_error : the largest error along an axis, in m.
    """

    stiffness: str | None = None
    tip_error: Annotated[Length, Field(gt=0)] | None = None
    largest_tip_error: Annotated[Length, Field(gt=0)] | None = None
