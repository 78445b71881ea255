"""The numbers behind a commissioning: how the arm is moved, what is believed, what does not fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ProcedureTuning:
    """How the arm is moved.

    Attributes
    ----------
    motion : that the model expects of the channel that moves the tip farthest, in m.
    share : of a channel's range, that no step exceeds.
    first : share of the step that comes first, so that danger shows early.
    rest, first_hold, up, down : times of the rest, of that first part, of the step and of the rest
        after it, in s.
    long, long_down : of step and rest in a full commissioning, in which leaks and creep show, in s.
    danger, slack : the arm is vented where the tip moves by so many times the most that is expected
        of any channel or pair, and by `slack` in m more.
    restless : motion of the vented arm, in m, that ends it before it begins.
    """

    motion: float = 4e-3
    share: float = 0.15
    first: float = 0.35
    rest: float = 3.0
    first_hold: float = 0.7
    up: float = 3.0
    down: float = 2.6
    long: float = 15.0
    long_down: float = 5.0
    danger: float = 2.0
    slack: float = 5e-4
    restless: float = 8e-3


@dataclass(frozen=True)
class Belief:
    """What is believed of a set-up before it is seen: standard deviations, in SI.

    Attributes
    ----------
    tilt, turn : of the tracker's frame about the base's x and y, and about its z.
    move : of the tracker's frame.
    sensor, sensor_angle : of the sensor on the tip.
    base_tilt : of the base against gravity; with the load that has the same effect.
    sag : displacement of the tip at rest that an unknown load or the arm's own shape causes.
    length, modulus, gain : of segments and channels, relative; a calibration knows better.
    model_share, model_floor : of a step's displacement, and of the largest of all, by which the
        model may miss it beyond all that.
    rest_position, rest_angle : the same, at rest.
    """

    tilt: float = float(np.radians(0.5))
    turn: float = float(np.radians(1.0))
    move: float = 1e-3
    sensor: float = 6e-4
    sensor_angle: float = float(np.radians(0.8))
    base_tilt: float = float(np.radians(0.5))
    sag: float = 3e-4
    length: float = 0.008
    modulus: float = 0.17
    gain: float = 0.05
    model_share: float = 0.04
    model_floor: float = 0.015
    rest_position: float = 5e-4
    rest_angle: float = float(np.radians(0.4))


@dataclass(frozen=True)
class Limits:
    """From where on a set-up does not fit, and how clear it must be; in SI.

    Attributes
    ----------
    clear : gain in log evidence from which a cause is told.
    same : causes whose log evidence is so near to the best one's cannot be told apart.
    swapped, lines : log prior of tubes in another order, and of dead or shared ones.
    tilt, turn, move, sensor, sensor_angle : of tracker frame and sensor, as in `Belief`.
    bend : of the tip at rest, by load or tilt of the base.
    length, gain, soft, weak : relative, of segments and channels; factors of response.
    dead : share of the expected response below which a channel or gauge is dead.
    gauge, gauge_least : share of a step, and pressure, by which a reading may be off.
    unexplained : share of a step's displacement that nothing explains.
    noise : factor on the noise that the rig file has.
    latency : of the tracker, in s, above what the rig file has.
    tip_delay : by which the tip may follow the gauges, in s, by the tracker's own times.
    slower : time by which the regulators may be slower than the rig file has it, in s.
    frequency : factor between the swing's frequency and the modelled one.
    drift : share of its displacement that the tip may come back while a pressure is held.
    """

    clear: float = 0.5
    same: float = 6.0
    swapped: float = -7.0
    lines: float = -5.0
    tilt: float = float(np.radians(2.8))
    turn: float = float(np.radians(6.0))
    move: float = 6e-3
    sensor: float = 5e-3
    sensor_angle: float = float(np.radians(6.0))
    bend: float = 8e-3
    length: float = 0.03
    gain: float = 0.25
    soft: float = 1.35
    weak: float = 0.68
    dead: float = 0.2
    gauge: float = 0.04
    gauge_least: float = 400.0
    unexplained: float = 0.5
    noise: float = 1.7
    latency: float = 0.05
    tip_delay: float = 0.08
    slower: float = 0.1
    frequency: float = 1.4
    drift: float = 0.1


PROCEDURE = ProcedureTuning()
BELIEF = Belief()
LIMITS = Limits()
