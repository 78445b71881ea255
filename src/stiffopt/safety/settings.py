"""Timing and thresholds of the safety layer that no rig file changes.

What a lab adapts to its arm (limits, timeouts, tolerances) is in the ``safety`` block of the rig
file, `stiffopt.rig.settings.Safety`. The values here follow from how the guard process, its client
and the monitors work; each group is a frozen dataclass with one instance that the package uses.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CommandRules:
    """What the gate and the goal follower allow where no file says otherwise.

    Attributes
    ----------
    default_slew : limit of the rate of change, in Pa/s, of a channel for which neither robot nor
        rig file has one.
    pause_periods : a pause between two commands allows no greater step than this many periods.
    longest_goal : seconds for which a goal may be valid at most; after an hour nobody may be there.
    repeat_after : periods after a goal until the follower repeats it, so that a program that
        commands in every period is never repeated.
    repeats : how often at least a goal is repeated within the gate's command timeout.
    """

    default_slew: float = 5e5
    pause_periods: int = 3
    longest_goal: float = 3600.0
    repeat_after: float = 1.5
    repeats: int = 4


@dataclass(frozen=True)
class GuardTiming:
    """When the guard process does what, in s; see `stiffopt.safety.guard`.

    Attributes
    ----------
    first_command : from arming to the first command of a stream; nothing is under pressure yet.
    idle : between two looks at deadlines, callers and the client when no message comes.
    hosting : the same for a simulated rig, whose world should not fall far behind real time.
    retry : from a failed attempt to vent to the next one.
    attempts : number of attempts to vent before the process ends all the same.
    collect : between two garbage collections, which happen only while the arm is vented.
    priority : real-time priority (SCHED_FIFO) of the guard, above that of the control loop.
    """

    first_command: float = 1.0
    idle: float = 0.05
    hosting: float = 0.002
    retry: float = 0.05
    attempts: int = 20
    collect: float = 10.0
    priority: int = 81


@dataclass(frozen=True)
class ClientTiming:
    """How long the client of a guard waits for it, in s; see `stiffopt.safety.guard_client`.

    Several times grow with the driver's `PressureSupply.patience`, the time that one call of the
    device may take; they are the least values, for a driver that answers at once.

    Attributes
    ----------
    start : until a guard is ready.
    slow : the same, once it has said that the simulator is compiled first.
    end : until a guard that was told to end has vented and ended; then it is terminated, killed.
    exit : until a guard whose connection is closed has ended, before the supply is vented directly.
    answer, answer_calls : until a request is answered; number of driver calls it may wait for.
    fresh : how long a command of a stream waits for its own answer.
    silent : without an answer to a stream, after which the guard counts as silent.
    ping : between two signs of life that the client asks for.
    hung, hung_calls : without any answer, after which a guard is hung and is killed; number of
        driver calls that one step of the guard makes at most, which are added.
    hung_simulated : the same for a simulated rig, which may be compiling.
    rescue : how long the supply of a lost guard is tried to be vented directly before giving up.
    rescue_retry : between two attempts at that.
    claim : how long the claim of a supply may still be that of a guard that is just ending.
    """

    start: float = 120.0
    slow: float = 900.0
    end: float = 4.0
    exit: float = 1.0
    answer: float = 2.0
    answer_calls: int = 4
    fresh: float = 1e-3
    silent: float = 0.25
    ping: float = 0.1
    hung: float = 1.0
    hung_calls: int = 3
    hung_simulated: float = 10.0
    rescue: float = 5.0
    rescue_retry: float = 0.1
    claim: float = 0.2


@dataclass(frozen=True)
class MonitorRules:
    """How the pressure monitor tells leaks from regulators at the end of their supply.

    `Safety.max_pressure_error` (the tolerance) and `Safety.pressure_error_time` come from the rig
    file; these refine them, see `stiffopt.safety.monitors` and `stiffopt.safety.shortage`.

    Attributes
    ----------
    looks : number of readings, at least, that it takes to find a regulator wrong.
    idle_readings : number of readings above the tolerance, while nothing has been commanded since
        arming, that show a stuck regulator.
    still : change of a command, in Pa, below which it counts as at rest.
    settled : time, in s, after which a channel at rest has reached its pressure.
    leak_share : a channel at rest leaks if it loses more than this share of a pressure it had.
    learn_change : change of a command, in Pa, from which a channel's response tells a leak.
    learn_share : share of the proportional response from which a channel counts as leaking.
    nothing, much : a channel with less than the share `nothing` of what is due, while another one
        has more than the share `much` of it, has lost its tube.
    nothing_time : time, in s, that this must last at least.
    line_channels : number of short channels from which a sagging supply line can be told.
    line_lost : share of the highest pressure read below which a line has failed altogether.
    """

    looks: int = 3
    idle_readings: int = 3
    still: float = 5e3
    settled: float = 0.5
    leak_share: float = 0.1
    learn_change: float = 1e4
    learn_share: float = 0.5
    nothing: float = 0.25
    much: float = 0.5
    nothing_time: float = 1.0
    line_channels: int = 2
    line_lost: float = 0.5


COMMANDS = CommandRules()
GUARD = GuardTiming()
CLIENT = ClientTiming()
MONITOR = MonitorRules()
