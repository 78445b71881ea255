"""Timing and thresholds of the safety layer that no rig file changes.

What a lab adapts to its arm (limits, timeouts, tolerances) is in the ``safety`` block of the rig
file, `stiffopt.rig.settings.Safety`. The values here follow from how the guard process, its client
and the monitors work. Each group is a frozen dataclass with one instance that the package uses.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CommandRules:
    """Rules of the gate and the goal follower that files do not override."""

    # limit of the rate of change, in Pa/s, of channels without one in the robot and rig files
    default_slew: float = 5e5
    pause_periods: int = 3  # a step after a pause is no larger than this many periods allow
    # longest validity of a goal, in s; after an hour nobody may be present
    longest_goal: float = 3600.0
    # periods after a goal until the follower repeats it, so that the commands of a program that
    # commands in every period are never repeated
    repeat_after: float = 1.5
    repeats: int = 4  # minimum number of repetitions of a goal within the gate's command timeout


@dataclass(frozen=True)
class GuardTiming:
    """Times of the guard process, in s; see `stiffopt.safety.guard`."""

    # from arming to the first command of a stream; nothing is under pressure yet
    first_command: float = 1.0
    idle: float = 0.05  # between checks of deadlines, callers and the client if no message comes
    # the same for a simulated rig, whose world should not fall far behind real time
    hosting: float = 0.002
    retry: float = 0.05  # from a failed attempt to vent to the next one
    attempts: int = 20  # number of attempts to vent before the process ends without success
    collect: float = 10.0  # between garbage collections, which happen only while the arm is vented
    # real-time priority (SCHED_FIFO) of the guard, above that of the control loop
    priority: int = 81


@dataclass(frozen=True)
class ClientTiming:
    """How long the client of a guard waits for it, in s; see `stiffopt.safety.guard_client`.

    Several times grow with the driver's `PressureSupply.patience`, the time that one call of the
    device may take; the values are minima, for a driver that answers at once.
    """

    start: float = 120.0  # until a guard is ready
    slow: float = 900.0  # the same, once it has reported that the simulator is compiled first
    # until a guard that shall end has vented and ended; then it is terminated, then killed
    end: float = 4.0
    # until a guard whose connection is closed has ended, before the supply is vented directly
    exit: float = 1.0
    # answer, answer_calls: until a request is answered; number of driver calls it may wait for
    answer: float = 2.0
    answer_calls: int = 4
    fresh: float = 1e-3  # how long a command of a stream waits for its own answer
    # time without an answer to a stream, after which the guard counts as silent
    silent: float = 0.25
    ping: float = 0.1  # between two signs of life that the client requests
    # hung, hung_calls: time without any answer, after which a guard hangs and is killed; number of
    # driver calls, at most, in one step of the guard, whose time is added
    hung: float = 1.0
    hung_calls: int = 3
    hung_simulated: float = 10.0  # the same for a simulated rig, which may be compiling
    rescue: float = 5.0  # how long the client tries to vent the supply of a lost guard directly
    rescue_retry: float = 0.1  # between two of these attempts
    claim: float = 0.2  # how long a guard that is ending may still have the claim of a supply


@dataclass(frozen=True)
class MonitorRules:
    """How the pressure monitor distinguishes leaks from regulators at the end of their supply.

    `Safety.max_pressure_error` (the tolerance) and `Safety.pressure_error_time` come from the rig
    file; these refine them, see `stiffopt.safety.monitors` and `stiffopt.safety.shortage`.
    """

    looks: int = 3  # minimum number of readings for finding a regulator wrong
    # number of readings above the tolerance, before the first command since arming, that show a
    # stuck regulator
    idle_readings: int = 3
    still: float = 5e3  # change of a command, in Pa, below which it counts as at rest
    settled: float = 0.5  # time, in s, after which a channel at rest has reached its pressure
    # a channel at rest leaks if it loses more than this share of a pressure it had
    leak_share: float = 0.1
    # change of a command, in Pa, from which a channel's response can show a leak
    learn_change: float = 1e4
    # share of the proportional response above which a channel counts as leaking
    learn_share: float = 0.5
    # nothing, much: a channel below the share `nothing` of its expected pressure has lost its tube
    # if another one is above the share `much` of it
    nothing: float = 0.25
    much: float = 0.5
    nothing_time: float = 1.0  # minimum duration of that, in s
    line_channels: int = 2  # number of short channels that can show a sagging supply line
    # share of the highest pressure read below which a line has failed altogether
    line_lost: float = 0.5


COMMANDS = CommandRules()
GUARD = GuardTiming()
CLIENT = ClientTiming()
MONITOR = MonitorRules()
